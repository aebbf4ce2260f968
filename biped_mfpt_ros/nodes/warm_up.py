"""Compile the kernels before they are needed, once on a machine, and say so."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numba
from numba.core import event


class _Announcer(event.Listener):
    def __init__(self, log: Callable[[str], object], what: str) -> None:
        self._log = log
        self._what = what
        self.said = False

    def on_start(self, event: event.Event) -> None:
        if not self.said:
            self.said = True
            self._log(f"compiling {self._what}: this happens once on a machine")

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def announced(log: Callable[[str], object], what: str) -> Iterator[_Announcer]:
    """Tell ``log`` when kernels begin to be compiled inside this."""
    announcer = _Announcer(log, what)
    with event.install_listener("numba:compile", announcer):
        yield announcer


@contextmanager
def compiled(log: Callable[[str], object], what: str) -> Iterator[None]:
    """Run kernels inside this so that they are compiled by one process, and the others wait.

    Without it, simulators started together would all compile the same kernels side by side.

    Parameters
    ----------
    log : callable
        Told when a compilation starts (not when kernels come from the cache) and how long it took.
    what : str
        What is compiled.
    """
    directory = Path(numba.config.CACHE_DIR)
    directory.mkdir(parents=True, exist_ok=True)
    # The directory is another one for every state of the kernel sources, so this stays true.
    done = directory / f"{what.replace(' ', '-')}.compiled"
    start = time.monotonic()
    with ExitStack() as stack:
        if not done.exists():
            lock = stack.enter_context(open(directory / "compiling.lock", "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        announcer = stack.enter_context(announced(log, what))
        yield
        done.touch()
    if announcer.said:
        log(f"compiled {what} in {time.monotonic() - start:.1f} s")
