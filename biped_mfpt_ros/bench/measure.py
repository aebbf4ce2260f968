"""What every benchmark uses: timing, rows of the result, and the error for a wrong result."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from biped_mfpt_ros.walker.terrain import slope_set

SLOPES = slope_set(0.5)


class BenchError(AssertionError):
    """What was timed came out wrong."""


def timed(
    work: Callable[[], object],
    repetitions: int,
    clock: Callable[[], float] = time.perf_counter,
) -> np.ndarray:
    """Seconds of each repetition, after one that is not counted; shape (repetitions,)."""
    work()
    out = np.empty(repetitions)
    for i in range(repetitions):
        start = clock()
        work()
        out[i] = clock() - start
    return out


def row(what: str, seconds: np.ndarray, per: float, unit: str) -> dict[str, Any]:
    """A line of the result: median and extremes of ``seconds / per``, in a unit of seconds."""
    scale = {"us": 1e6, "ns": 1e9, "ms": 1e3, "s": 1.0}[unit] / per
    return {
        "what": what,
        "median": float(np.median(seconds) * scale),
        "low": float(seconds.min() * scale),
        "high": float(seconds.max() * scale),
        "unit": unit,
    }


@dataclass(frozen=True)
class Section:
    """What one file of benchmarks found.

    Attributes
    ----------
    rows : list of dict
        Measured times, as `row` makes them.
    ratios : dict of str to float
        Times over times of the same run, which say more than the times.
    facts : dict of str to Any
        What else is to be printed: counts, sizes, of JSON's types.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    ratios: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
