"""Answers of the step map on disk: a mesh keeps few successors in memory, and can be resumed.

A file holds a header and a record for every answer, in the order in which answers came::

    header   magic, number of slopes m, SHA-256 of what identifies the mesh, CRC-32 of these
    record   magic, first state, n states, k successors, CRC-32 of all the rest,
             n x m outcomes (uint8), k x 10 successors (float64)

Numbers are little-endian. A record is appended with one write, so a process that is killed leaves
at most a torn one at the end; it is dropped when the file is opened again. Nothing is synced to
the disk: what is promised holds when processes die, not when the machine does, but a damaged file
is noticed.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from biped_mfpt_ros.chain.nearest import STATE_SIZE

_MAGIC = b"BMJOURN1"
_HEADER = struct.Struct("<8sI32s")
_CHECKSUM = struct.Struct("<I")
_RECORD_MAGIC = 0x52534A42
_RECORD = struct.Struct("<IIIII")
_ROW_BYTES = 8 * STATE_SIZE
_KEPT_BYTES = 32 << 20  # of answers in memory, which saves their way to a file without a name

if sys.byteorder != "little":
    raise ImportError("journals are little-endian, as all machines are that this was tested on")


class JournalInUse(RuntimeError):
    """Another growth writes this journal."""


class Journal:
    """Answers in a file, in place of memory; see `biped_mfpt_ros.chain.mesh.MeshGrowth`.

    Parameters
    ----------
    slopes : int
        Slopes m of the mesh.
    identity : bytes, optional
        All that determines the answers and the mesh, in any form.
    path : path-like, optional
        The file, made if missing. If it holds the journal of an equal mesh, its answers are there
        from the beginning; otherwise it is begun anew. Without a path the file has no name, is
        gone with this object, and takes what goes beyond 32 MB, which stay in memory.

    Raises
    ------
    JournalInUse
        If another journal, of any process, has the file open.
    OSError
        If the file cannot be made, read or written.
    """

    def __init__(
        self, slopes: int, identity: bytes = b"", path: str | os.PathLike[str] | None = None
    ) -> None:
        self._slopes = slopes
        self._path = None if path is None else Path(path)
        self._places: dict[int, tuple[int, int, int]] = {}
        self._kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._room = _KEPT_BYTES if path is None else 0
        header = _HEADER.pack(_MAGIC, slopes, hashlib.sha256(identity).digest())
        header += _CHECKSUM.pack(zlib.crc32(header))
        if self._path is None:
            # Unbuffered: what is written is in the file.
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        else:
            self._file = _locked(self._path)
        self._end = 0
        if self._path is not None and os.pread(self._file.fileno(), len(header), 0) == header:
            self._end = len(header)
            self._read()
        self._file.truncate(self._end)
        if not self._end:
            self._write(header)

    def __contains__(self, start: object) -> bool:
        return start in self._places

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def rows(self, start: int) -> int:
        """Number of states of the answer that begins with state ``start``."""
        return self._places[start][1]

    def put(self, start: int, outcomes: np.ndarray, successors: np.ndarray) -> None:
        """Keep the answer for the states from ``start`` on: shapes (n, m) and (k, 10)."""
        place = self._end + _RECORD.size
        size = outcomes.nbytes + successors.nbytes
        if size <= self._room:
            self._room -= size
            self._kept[start] = outcomes, successors
        else:
            self._append(start, outcomes, successors)
        self._places[start] = place, len(outcomes), len(successors)

    def get(self, start: int) -> tuple[np.ndarray, np.ndarray]:
        """The answer for the states from ``start`` on: outcomes (n, m), successors (k, 10)."""
        if start in self._kept:
            return self._kept[start]
        place, n, k = self._places[start]
        outcomes = np.empty((n, self._slopes), dtype=np.uint8)
        successors = np.empty((k, STATE_SIZE))
        wanted = outcomes.nbytes + successors.nbytes
        parts = [part for part in (outcomes.data, successors.data) if part.nbytes]
        if wanted and os.preadv(self._file.fileno(), parts, place) != wanted:
            raise OSError(f"the journal of a mesh has become shorter: {self._path or 'unnamed'}")
        return outcomes, successors

    def close(self, remove: bool = False) -> None:
        """Close the file, and remove it if it is of no further use."""
        if remove and self._path is not None:
            self._path.unlink(missing_ok=True)
        self._kept.clear()
        self._file.close()

    def _append(self, start: int, outcomes: np.ndarray, successors: np.ndarray) -> None:
        numbers = _RECORD_MAGIC, start, len(outcomes), len(successors)
        head = _RECORD.pack(*numbers, 0)
        # The bytes as they are, without a copy.
        body = [
            np.ascontiguousarray(a).reshape(-1).view(np.uint8).data for a in (outcomes, successors)
        ]
        if self._path is not None:  # else nobody will open it again
            head = _RECORD.pack(*numbers, _checksum(head, *body))
        self._write(head, *body)

    def _write(self, *parts: bytes | memoryview) -> None:
        left = [memoryview(part) for part in parts if len(part)]
        while left:
            written = os.writev(self._file.fileno(), left)
            self._end += written
            # A write may be cut short, at 2 GiB or by a signal.
            while left and written >= len(left[0]):
                written -= len(left.pop(0))
            if left:
                left[0] = left[0][written:]

    def _read(self) -> None:
        """Find the records, up to the first that is torn."""
        file, size = self._file.fileno(), os.fstat(self._file.fileno()).st_size
        while self._end + _RECORD.size <= size:
            head = os.pread(file, _RECORD.size, self._end)
            magic, start, n, k, checksum = _RECORD.unpack(head)
            length = n * self._slopes + k * _ROW_BYTES
            place = self._end + _RECORD.size
            if magic != _RECORD_MAGIC or place + length > size or start in self._places:
                break
            body = os.pread(file, length, place)
            if len(body) != length or _checksum(_RECORD.pack(magic, start, n, k, 0), body) != (
                checksum
            ):
                break
            self._places[start] = place, n, k
            self._end = place + length
        os.lseek(file, self._end, os.SEEK_SET)


def _checksum(*parts: bytes | memoryview) -> int:
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    return checksum


def _locked(path: Path) -> io.FileIO:
    """Open a file for one owner, made if missing."""
    while True:
        file = io.FileIO(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its owner may have removed it just now: then this is a file without a name.
            with suppress(FileNotFoundError):
                if os.path.samestat(path.stat(), os.fstat(file.fileno())):
                    return file
        except BlockingIOError:
            file.close()
            raise JournalInUse(str(path)) from None
        file.close()
