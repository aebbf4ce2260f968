"""Recorded runs: bags written so that nothing flushed is lost, and read without ROS running.

`BagWriter` writes a bag, `Bag` reads it, `read_meshes` and `inspect_bag` rebuild what was
meshed, `salvage` makes a whole bag of what is left of one whose recorder was killed.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Bag": "reader",
    "BagError": "error",
    "BagReport": "report",
    "BagWriteError": "error",
    "BagWriter": "writer",
    "inspect_bag": "report",
    "read_meshes": "meshes",
    "salvage": "repair",
}


def __getattr__(name: str) -> Any:
    # Imported when asked for: the recorder needs no chains, and is to start fast.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
