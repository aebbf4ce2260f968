"""Child processes that end with their parent: cleanly if it can, and also if it is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

_GRACE = 2.0  # s from SIGTERM to SIGKILL
_LAST_GRACE = 4.5  # s, for the last ones, from when the first were asked: together less than 5 s
_POLL = 0.02  # s
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(KeyboardInterrupt):
    """SIGINT, SIGTERM or SIGHUP came."""


@dataclass
class Child:
    """A child process.

    Attributes
    ----------
    name : str
        For messages.
    process : subprocess.Popen
        The process, leader of a session of its own.
    log : pathlib.Path
        What it writes to stdout and stderr.
    last : bool
        Whether it is stopped only after all others.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    last: bool

    def log_tail(self, lines: int = 15) -> str:
        """The last lines of the log."""
        text = self.log.read_text(errors="replace")
        return "\n".join(text.splitlines()[-lines:])

    def ending(self) -> str:
        """How it ended, for a message: ``"ended with code 1"``, ``"was killed by SIGKILL"``."""
        code = self.process.returncode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with code {code}"


class Processes:
    """Child processes of this one, all stopped at the end of the ``with`` block.

    Inside the block SIGINT, SIGTERM and SIGHUP raise `Stopped` in the main thread, where the block
    must be; once one came, the block ends with `Stopped` and nothing else. Each child has a session
    of its own, so that Ctrl-C on the terminal reaches this process alone and children are stopped
    in order: SIGTERM to all but the last ones, SIGKILL to those that are left after 2 s, then the
    same for the last ones, which have until 4.5 s. A second signal meanwhile kills what is left at
    once.

    Parameters
    ----------
    logs : pathlib.Path
        Directory of the children's logs; made if missing.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._children: list[Child] = []
        self._reported: set[str] = set()
        self._holding = False
        self._signals = 0
        self._handlers: dict[int, Any] = {}

    def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        last: bool = False,
    ) -> Child:
        """Start a child; its output goes to ``NAME.log``."""
        path = self._logs / f"{name}.log"
        # A signal between the start and the entry in the list would leave an orphan.
        with self._held(), path.open("wb") as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=None if environment is None else dict(environment),
                start_new_session=True,
            )
            child = Child(name, process, path, last)
            self._children.append(child)
        return child

    def running(self) -> list[Child]:
        """Children that have not ended."""
        return [child for child in self._children if child.process.poll() is None]

    def newly_ended(self) -> list[Child]:
        """Children that ended since the last call."""
        ended = [
            child
            for child in self._children
            if child.process.poll() is not None and child.name not in self._reported
        ]
        self._reported.update(child.name for child in ended)
        return ended

    def forget(self, child: Child) -> None:
        """Forget a child that has ended, so that another one may have its name."""
        self._children.remove(child)
        self._reported.discard(child.name)

    def end(self, child: Child) -> None:
        """Ask one child to end, without waiting for it; `newly_ended` will not report it."""
        self._reported.add(child.name)
        _signal(child, signal.SIGTERM)

    def stop(self, last_grace: float | None = None) -> None:
        """Stop all children, in at most 5 s.

        Parameters
        ----------
        last_grace : float, optional
            s, for the last ones if that need not be so soon.
        """
        with self._held():
            signals, start = self._signals, time.monotonic()
            for last, grace in ((False, _GRACE), (True, last_grace or _LAST_GRACE)):
                group = [child for child in self.running() if child.last == last]
                for child in group:
                    _signal(child, signal.SIGTERM)
                while self._signals == signals and time.monotonic() < start + grace:
                    if all(child.process.poll() is not None for child in group):
                        break
                    time.sleep(_POLL)
                for child in group:
                    if child.process.poll() is None:
                        _signal(child, signal.SIGKILL)
                for child in group:
                    child.process.wait()

    def __enter__(self) -> Processes:
        """Take over the signals."""
        self._logs.mkdir(parents=True, exist_ok=True)
        for number in _SIGNALS:
            # One that is ignored stays so, as SIGHUP under nohup.
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._handlers[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        """Stop all children and give the signals back."""
        # From here on a signal is only counted.
        self._holding = True
        try:
            self.stop()
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
        # A callback from C code swallows what is raised in it, and the code that called it may go
        # on or fail for that reason.
        if self._signals and not isinstance(error, KeyboardInterrupt):
            raise Stopped from error

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals += 1
        if not self._holding:
            raise Stopped(signal.Signals(number).name)

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Put off `Stopped` to the end of the block."""
        before, signals = self._holding, self._signals
        self._holding = True
        try:
            yield
        finally:
            self._holding = before
        if not before and self._signals > signals:
            raise Stopped


def _signal(child: Child, number: int) -> None:
    """Send a signal to a child and all of its session's process group."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.process.pid, number)
