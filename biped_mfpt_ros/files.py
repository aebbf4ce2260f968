"""Files that are there as a whole or not at all, whatever ends the process that writes them."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: str | os.PathLike[str], *, new: bool = False) -> Iterator[BinaryIO]:
    """Write a file beside its place and move it there when it is complete.

    Parameters
    ----------
    path : path-like
        Where it belongs.
    new : bool, optional
        Whether there must be nothing there yet; else it is replaced.

    Yields
    ------
    file
        To write bytes to. After an exception nothing is left of it.

    Raises
    ------
    FileExistsError
        There is something at `path`, and `new` is true.
    OSError
        The disk is full, or not writable.
    """
    path = Path(path)
    if new and path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        if error.filename is None:  # as of a write
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        beside.unlink(missing_ok=True)
