"""What processes of Fast DDS that were killed leave in shared memory."""

from __future__ import annotations

import fcntl
import re
import time
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")

_LEAST_AGE = 10.0  # s: between making its file and locking it, an owner may seem to be dead


def remove_left_segments(directory: Path = SHARED_MEMORY) -> int:
    """Remove the segments whose owners are dead; returns how many.

    A participant has a segment ``fastdds_ID`` of some 0.5 MB, and holds a lock on ``fastdds_ID_el``
    as long as it lives. Killed by SIGKILL it leaves both for good: Fast DDS removes them only by
    ``fastdds shm clean``, which the wheels do not have, and which does what this does. The files
    ``fastdds_portN`` are not touched: whoever listens on the port next takes them over.
    """
    removed = 0
    for lock in directory.glob("fastdds_*_el"):
        if not re.fullmatch(r"fastdds_[0-9a-f]+_el", lock.name):
            continue
        # Gone meanwhile, held by its owner, or another user's.
        with suppress(OSError), lock.open("rb") as file:
            if time.time() - lock.stat().st_mtime < _LEAST_AGE:
                continue
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            lock.with_name(lock.name.removesuffix("_el")).unlink(missing_ok=True)
            lock.unlink(missing_ok=True)
            removed += 1
    return removed
