"""One line on stderr: how far long work has come, how fast it is, how long it will take."""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

from biped_mfpt_ros.report.tables import plural

_TERMINAL_INTERVAL = 0.1  # s between redrawn lines on a terminal
_PLAIN_INTERVAL = 10.0  # s between lines where they stay, such as in a log


def duration_text(seconds: float) -> str:
    """Seconds as people read them: ``"0.4 s"``, ``"42 s"``, ``"3 min 05 s"``, ``"2 h 07 min"``."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def rate_text(per_second: float) -> str:
    """A rate with three significant digits: ``"0.512"``, ``"87.3"``, ``"12300"``."""
    if per_second >= 100.0:
        digits = max(0, len(str(int(per_second))) - 3)
        return str(int(round(per_second, -digits)))
    return f"{per_second:.3g}"


class Progress:
    """A progress line: redrawn in place on a terminal, an occasional plain line elsewhere.

    Use it as a context manager: the line is taken away again at the end, also after an error.

    Parameters
    ----------
    quiet : bool, optional
        Write nothing at all.
    stream : file, optional
        Where to write; stderr if not given.
    """

    def __init__(self, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._quiet = quiet
        self._interval = _TERMINAL_INTERVAL if self._terminal else _PLAIN_INTERVAL
        self._start = time.monotonic()
        # A terminal gets its line at once; a log only if the work turns out to be long.
        self._next = self._start if self._terminal else self._start + self._interval
        self._shown = False
        self._last = ""
        self._counted: tuple[str, float, int] | None = None

    @property
    def seconds(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self._start

    def show(self, text: str) -> None:
        """Show ``text``, unless something else was shown a moment ago."""
        now = time.monotonic()
        if self._quiet or now < self._next:
            return
        self._next = now + self._interval
        if self._terminal:
            # Cut to the width: a line that wraps cannot be redrawn in place.
            width = _columns(self._stream) - 1
            self._stream.write(f"\r{text[:width]}\x1b[K")
            self._shown = True
        elif text != self._last:  # a log needs no line twice
            self._stream.write(text + "\n")
            self._last = text
        self._stream.flush()

    def count(self, label: str, done: int, total: int, unit: str) -> None:
        """Show ``done`` out of a known ``total``, the rate and the time left."""
        # From the label's first call on: before that something else was done, such as compiling.
        now = time.monotonic()
        if self._counted is None or self._counted[0] != label:
            self._counted = label, now, done
        _, since, before = self._counted
        text = f"{label}: {done} of {total} {unit}"
        if done > before and now > since:
            rate = (done - before) / (now - since)
            left = duration_text((total - done) / rate)
            text += f", {rate_text(rate)}/s, {left} left"
        self.show(text)

    def say(self, text: str) -> None:
        """Write a line that stays, above the progress line."""
        if self._quiet:
            return
        self.clear()
        self._stream.write(text + "\n")
        self._stream.flush()

    def clear(self) -> None:
        """Take the progress line away; the next `show` draws it at once."""
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._shown = False
            self._next = time.monotonic()

    def __enter__(self) -> Progress:
        """Start."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Take the line away."""
        self.clear()


class MeshProgress:
    """Progress of a growing mesh, as text.

    Nobody knows how many states a mesh will have. As long as its generations grow nothing is said
    about the time left. Once they shrink, by the factor ``f`` from one to the next, the swings to
    come are about those left in this generation plus a geometric series with the ratio ``f``.
    """

    def __init__(self) -> None:
        self._generation = -1
        self._size = 0
        self._previous_size = 0

    def text(
        self,
        *,
        generation: int,
        states: int,
        frontier: int,
        swings_per_second: float,
        simulators: int | None = None,
    ) -> str:
        """The state of the growth in a line.

        Parameters
        ----------
        generation : int
            Generation that is being simulated.
        states : int
            States in the mesh.
        frontier : int
            States known that have not been simulated.
        swings_per_second : float
            1/s; one swing explores one state.
        simulators : int, optional
            Simulators at work.
        """
        if generation != self._generation:
            self._previous_size, self._size = self._size, frontier
            self._generation = generation
        parts = [f"mesh: {plural(states, 'state')}", f"frontier {frontier}"]
        parts.append(f"{rate_text(swings_per_second)} swings/s")
        if frontier == 0:
            parts.append("finishing")
        elif 0 < self._size < self._previous_size and swings_per_second > 0.0:
            factor = self._size / self._previous_size
            swings = frontier + self._size * factor / (1.0 - factor)
            parts.append(f"about {duration_text(swings / swings_per_second)} left")
        else:
            parts.append("still growing")
        if simulators is not None:
            parts.append(plural(simulators, "simulator"))
        return ", ".join(parts)


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80
