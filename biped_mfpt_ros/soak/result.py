"""What every soak run gives: how much was done, how much of it failed, how long it took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


class PromiseBroken(AssertionError):
    """Something is not as `docs/promises.md` says."""


def check(holds: bool, what: str = "a promise was broken") -> None:
    """Raise PromiseBroken unless something holds; unlike ``assert``, also under ``python -O``."""
    if not holds:
        raise PromiseBroken(what)


@dataclass(frozen=True)
class Row:
    """A line of the result.

    Attributes
    ----------
    subject : str
        The module that did it.
    what : str
        What was done to what.
    count : int
        Faults done, inputs given, or meshes grown.
    failures : int
        How many of them broke a promise.
    seconds : float
        s, wall time.
    facts : dict of str to Any
        Further figures, of JSON's types.
    examples : sequence of str
        The first few failures, in words, so that they can be repeated.
    """

    subject: str
    what: str
    count: int
    failures: int
    seconds: float
    facts: dict[str, Any] = field(default_factory=dict)
    examples: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        """All of it as dicts, lists, strings and numbers."""
        return asdict(self) | {"examples": list(self.examples)}
