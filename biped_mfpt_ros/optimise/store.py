"""Studies and their trials in an SQLite file.

Any number of processes may work on a study at the same time. The candidates of a generation are
put in by whoever comes first, in one transaction; each is claimed by one owner, in another. An
owner that dies, or does not show that it lives, loses its claims, and another takes them over.
"""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.optimise.scoring import Evaluation
from biped_mfpt_ros.optimise.settings import StudySettings

_WAIT_SECONDS = 60.0  # for others that write, before it is an error
STALE_SECONDS = 30.0
"""s without a sign of life, after which an owner loses its claims."""

_VERSION = 1
_SCHEMA = """
CREATE TABLE IF NOT EXISTS studies (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, settings TEXT NOT NULL, created REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS trials (
    study INTEGER NOT NULL REFERENCES studies (id),
    number INTEGER NOT NULL,
    generation INTEGER NOT NULL,
    vector BLOB NOT NULL,
    status TEXT NOT NULL DEFAULT 'pending' CHECK (status IN ('pending', 'running', 'done')),
    owner TEXT, heartbeat REAL, finished REAL,
    score REAL, stage TEXT, states INTEGER, seconds REAL, step_map_seconds REAL,
    step_map TEXT, found TEXT,
    PRIMARY KEY (study, number)
);
CREATE INDEX IF NOT EXISTS open_trials ON trials (study, status, number);
CREATE INDEX IF NOT EXISTS generations ON trials (study, generation);
"""


class StoreBusy(RuntimeError):
    """Someone else has been writing to a store for longer than others wait for it."""


@dataclass(frozen=True)
class Trial:
    """A candidate of a study.

    Attributes
    ----------
    number : int
        From 0, in the order in which the searcher asked.
    generation : int
        From 0.
    vector : numpy.ndarray
        In the scaled coordinates of the study's space, shape (n,).
    status : str
        ``pending``, ``running`` or ``done``.
    found : Evaluation or None
        What came out, once it is done.
    owner : str
        Who runs or ran it.
    finished : float
        s since 1970; 0 unless done.
    step_map : str
        Identity of the step map that scored it.
    """

    number: int
    generation: int
    vector: np.ndarray
    status: str
    found: Evaluation | None
    owner: str
    finished: float
    step_map: str


def this_owner() -> str:
    """Name of this process as an owner of trials, which no other has: host, pid, start."""
    return f"{socket.gethostname()}:{os.getpid()}:{_started(os.getpid())}"


def _started(pid: int) -> str:
    """When a process of this host started, in clock ticks since boot; empty if there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return ""


def _has_ended(owner: str) -> bool:
    """Whether an owner on this host is known to be gone."""
    host, pid, started = owner.split(":")
    return host == socket.gethostname() and _started(int(pid)) != started


class Store:
    """An SQLite file of studies; for any number of threads and processes.

    Parameters
    ----------
    path : pathlib.Path
        The file; made if missing.

    Raises
    ------
    InputError
        If the file holds something else.
    StoreBusy
        If someone else writes to it all the time that is waited; so do all methods that write.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._lock = threading.RLock()
        # Waits for other processes rather than fail; autocommit but for explicit transactions.
        self._database = sqlite3.connect(
            path, timeout=_WAIT_SECONDS, isolation_level=None, check_same_thread=False
        )
        try:
            with self._patience():
                self._use_wal()
                # A commit that is lost with the power costs a trial, and a sync milliseconds.
                self._database.execute("PRAGMA synchronous = NORMAL")
                (version,) = self._database.execute("PRAGMA user_version").fetchone()
            if version not in (0, _VERSION):
                raise InputError("store", str(path), f"a store of version {_VERSION}")
            with self._transaction():
                for statement in _SCHEMA.split(";"):
                    self._database.execute(statement)
                self._database.execute(f"PRAGMA user_version = {_VERSION}")
        except sqlite3.DatabaseError as error:
            raise InputError("store", str(path), f"an SQLite file of studies ({error})") from None

    def _use_wal(self) -> None:
        """Keep a write-ahead log, which readers need not wait for.

        While another one writes to a new file SQLite refuses at once, however long it may wait.
        """
        until = time.monotonic() + _WAIT_SECONDS
        while True:
            try:
                self._database.execute("PRAGMA journal_mode = WAL")
                return
            except sqlite3.OperationalError as error:
                if "locked" not in str(error) or time.monotonic() > until:
                    raise
            time.sleep(0.01)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._database.close()

    @contextmanager
    def _patience(self) -> Iterator[None]:
        """Say so when it has come to an end."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if "locked" not in str(error):
                raise
            raise StoreBusy(
                f"store {self.path}: someone else has been writing to it for {_WAIT_SECONDS:g} s; "
                "try again when that is done, or end the process that has the file open"
            ) from None

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            with self._patience():
                self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
            except BaseException:
                self._database.execute("ROLLBACK")
                raise
            self._database.execute("COMMIT")

    def _rows(self, query: str, *values: Any) -> list[Any]:
        with self._lock, self._patience():
            return self._database.execute(query, values).fetchall()

    # Studies ------------------------------------------------------------------------------------

    def names(self) -> list[str]:
        """Names of all studies, in the order in which they were made."""
        return [name for (name,) in self._rows("SELECT name FROM studies ORDER BY id")]

    def create(self, name: str, settings: StudySettings) -> int:
        """Make a study, or find the one of that name; returns its id.

        Raises
        ------
        InputError
            If there is one of that name with other settings.
        """
        text = json.dumps(settings.as_json(), allow_nan=False)
        with self._transaction() as database:
            database.execute(
                "INSERT OR IGNORE INTO studies (name, settings, created) VALUES (?, ?, ?)",
                (name, text, time.time()),
            )
            study, kept = database.execute(
                "SELECT id, settings FROM studies WHERE name = ?", (name,)
            ).fetchone()
        if kept != text:
            before, now = json.loads(kept), json.loads(text)
            changed = [key for key in now if before.get(key) != now[key]]
            raise InputError(
                "study",
                name,
                "a new name, or the settings it was begun with; now different: "
                + ", ".join(f"{k} (was {_short(before.get(k))})" for k in changed),
            )
        return int(study)

    def open(self, name: str) -> tuple[int, StudySettings]:
        """Id and settings of a study; raises InputError if there is none."""
        rows = self._rows("SELECT id, settings FROM studies WHERE name = ?", name)
        if not rows:
            names = ", ".join(self.names()) or "none"
            raise InputError("study", name, f"one of those in {self.path}: {names}")
        return rows[0][0], StudySettings.from_json(json.loads(rows[0][1]))

    # Trials -------------------------------------------------------------------------------------

    def propose(self, study: int, generation: int, first: int, vectors: np.ndarray) -> None:
        """Put in a generation, unless it is there already.

        Raises
        ------
        RuntimeError
            If it is there with other candidates: the searcher is not the function that it was.
        """
        with self._transaction() as database:
            kept = database.execute(
                "SELECT vector FROM trials WHERE study = ? AND generation = ? ORDER BY number",
                (study, generation),
            ).fetchall()
            blobs = [np.ascontiguousarray(v, dtype=np.float64).tobytes() for v in vectors]
            if kept:
                if [blob for (blob,) in kept] != blobs:
                    raise RuntimeError(
                        f"generation {generation} of the study in {self.path} was proposed by "
                        "another version of the searcher; begin a new study"
                    )
                return
            database.executemany(
                "INSERT INTO trials (study, number, generation, vector) VALUES (?, ?, ?, ?)",
                [(study, first + i, generation, blob) for i, blob in enumerate(blobs)],
            )

    def claim(self, study: int, owner: str, below: int) -> Trial | None:
        """Claim the next trial with a number below ``below``; None if there is none to be had."""
        now = time.time()
        with self._transaction() as database:
            running = database.execute(
                "SELECT DISTINCT owner, max(heartbeat) FROM trials "
                "WHERE study = ? AND status = 'running' GROUP BY owner",
                (study,),
            ).fetchall()
            for other, heartbeat in running:
                if other != owner and (now - heartbeat > STALE_SECONDS or _has_ended(other)):
                    database.execute(
                        "UPDATE trials SET status = 'pending' "
                        "WHERE study = ? AND status = 'running' AND owner = ?",
                        (study, other),
                    )
            row = database.execute(
                "SELECT number, generation, vector FROM trials "
                "WHERE study = ? AND status = 'pending' AND number < ? ORDER BY number LIMIT 1",
                (study, below),
            ).fetchone()
            if row is None:
                return None
            database.execute(
                "UPDATE trials SET status = 'running', owner = ?, heartbeat = ? "
                "WHERE study = ? AND number = ?",
                (owner, now, study, row[0]),
            )
        return Trial(row[0], row[1], np.frombuffer(row[2]), "running", None, owner, 0.0, "")

    def beat(self, owner: str) -> None:
        """Show that an owner lives."""
        with self._transaction() as database:
            database.execute(
                "UPDATE trials SET heartbeat = ? WHERE status = 'running' AND owner = ?",
                (time.time(), owner),
            )

    def finish(self, study: int, number: int, owner: str, found: Evaluation, step_map: str) -> bool:
        """Keep what a trial found; False if the owner had lost it, and nothing is kept."""
        kept = {k: v for k, v in vars(found).items() if k not in _COLUMNS}
        with self._transaction() as database:
            cursor = database.execute(
                "UPDATE trials SET status = 'done', finished = ?, score = ?, stage = ?, "
                "states = ?, seconds = ?, step_map_seconds = ?, step_map = ?, found = ? "
                "WHERE study = ? AND number = ? AND status = 'running' AND owner = ?",
                (time.time(), *(getattr(found, name) for name in _COLUMNS), step_map,
                 json.dumps(kept), study, number, owner),
            )  # fmt: skip
        return cursor.rowcount == 1

    def release(self, study: int, owner: str, number: int | None = None) -> None:
        """Give back what an owner has not finished: one trial, or all of them."""
        with self._transaction() as database:
            database.execute(
                "UPDATE trials SET status = 'pending' "
                "WHERE study = ? AND status = 'running' AND owner = ? "
                "AND number = ifnull(?, number)",
                (study, owner, number),
            )

    def counts(self, study: int) -> tuple[int, int]:
        """Trials proposed, and trials done."""
        rows = self._rows(
            "SELECT count(*), coalesce(sum(status = 'done'), 0) FROM trials WHERE study = ?", study
        )
        return rows[0][0], rows[0][1]

    def trials(self, study: int, generation: int | None = None) -> list[Trial]:
        """Trials of a study, or of one generation of it, by number."""
        where, values = ("", ()) if generation is None else (" AND generation = ?", (generation,))
        rows = self._rows(
            "SELECT number, generation, vector, status, owner, finished, step_map, found, "
            + ", ".join(_COLUMNS)
            + f" FROM trials WHERE study = ?{where} ORDER BY number",
            study,
            *values,
        )
        out = []
        for number, gen, vector, status, owner, finished, step_map, found, *columns in rows:
            evaluation = None
            if status == "done":
                evaluation = Evaluation(
                    **dict(zip(_COLUMNS, columns, strict=True)), **json.loads(found)
                )
                evaluation.costs = tuple(evaluation.costs)
            out.append(
                Trial(number, gen, np.frombuffer(vector), status, evaluation, owner or "",
                      finished or 0.0, step_map or "")
            )  # fmt: skip
        return out


_COLUMNS = ("score", "stage", "states", "seconds", "step_map_seconds")


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else text[:57] + "..."
