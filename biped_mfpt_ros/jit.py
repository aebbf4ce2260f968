"""Compilation of the numeric kernels, and the identity of the step map they make up.

Numba decides from a function's own file whether its cached machine code is still good, and does
not see changes in the functions that it calls from other files. So the cache directory carries a
digest of every kernel source: any change gives a fresh directory, and nothing stale is ever run.
The same digest, with the robot's data, identifies the step map to other processes: two processes
with equal `STEP_MAP` compute the same steps.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numba

from biped_mfpt_ros import __version__

_PACKAGE = Path(__file__).parent
# What decides the result of a step: the kernels and the robot's data.
_STEP_SOURCES = (
    "walker/*.py",
    "control/*.py",
    "gait/*.py",
    "data/rabbit.json",
    "jit.py",
    "lanes.py",
)
_KERNEL_SOURCES = (*_STEP_SOURCES, "chain/*.py")


def _digest(patterns: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(_PACKAGE.glob(pattern)):
            digest.update(str(path.relative_to(_PACKAGE)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


STEP_MAP: str = f"{__version__}+{_digest(_STEP_SOURCES)}"
"""Version and digest of the code and data that simulate a step."""

KERNELS: str = _digest(_KERNEL_SOURCES)
"""Digest of the code and data that decide a mesh, given the answers, and those too."""

CACHE_DIR = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "biped_mfpt_ros"
"""Where compiled kernels are kept, in one directory for each state of the kernel sources."""

if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(CACHE_DIR / f"{numba.__version__}-{KERNELS}")

kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
"""Decorator of every numeric kernel: compiled once, cached on disk, run without the GIL."""

inner_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
"""The same for kernels that neither allocate nor return arrays: they do not count references.

Numba counts them, atomically, for every array that is passed on; in the many small kernels of the
step map that was a third of the time. Whoever calls from outside holds the arrays meanwhile.
"""

inlined_kernel = numba.njit(
    cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True
)
"""The same, made part of whoever calls it: what a call returns goes through memory, zeroed before.
For tuples of lanes that was a seventh of the time."""
