"""All that decides a study: equal settings and seed give equal trials."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.models import model_from, model_values
from biped_mfpt_ros.optimise.searchers import SEARCHERS
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import check_correlation, slope_set

OBJECTIVES = {
    "mfpt": "log10 of the mean first-passage time at sigma_s, steps; more is better",
    "cot": "cost of transport on flat ground; less is better",
    "speed": "speed on flat ground, m/s; more is better",
}
"""What can be searched for."""

LIMITS = {
    "speed_min": "m/s, on flat ground",
    "speed_max": "m/s, on flat ground",
    "clearance_min": "m, least height of the swing foot in the middle half of a step on the flat",
    "torque_max": "N m, largest torque of any joint on flat ground",
    "step_length_min": "m, on flat ground",
    "step_length_max": "m, on flat ground",
}
"""Constraints that a study may have."""


@dataclass(frozen=True)
class Stage:
    """A mesh that a candidate is scored on.

    Attributes
    ----------
    slope_step_deg : float
        d_s, degrees.
    threshold : float
        d_thr.
    margin : float
        Decades of MFPT (units of the score) below the best confirmed score at which a candidate
        still gets this mesh; below 0: only one that is better by as much.
    max_states : int
        A candidate that needs more states than this stays as good as nothing on this mesh.
    """

    slope_step_deg: float
    threshold: float
    margin: float = math.inf
    max_states: int = 100_000


DEFAULT_STAGES = (
    Stage(0.5, 0.3, math.inf, 5_000),
    Stage(0.5, 0.1, 1.0, 20_000),
    Stage(0.25, 0.03, -0.02, 200_000),
)
"""Screen coarse, check finer, confirm on the finest mesh."""


_RUNS, _MOST_RUNS = 4, 1000


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study. All angles in rad but the few that end in _deg.

    Attributes
    ----------
    start : Controller
        Where the search starts; it fixes the scheme.
    searcher : str
        A key of `SEARCHERS`.
    seed : int
        Of the search, >= 0.
    step : float
        First step of the search, as a multiple of the scales of the space, > 0.
    population : int
        Candidates in a generation, 2 to 100000; 0: the searcher's own.
    runs : int
        How many the search begins with, up to 1000, for ``cma-es`` alone; 0: its own choice.
    fixed : tuple of str
        Patterns of coordinates that are not searched.
    candidates : tuple of tuple of float
        All that ``given`` has tried, in the scaled coordinates of the space; for it alone.
    objectives : dict
        Names of `OBJECTIVES` with their weights in the score, > 0.
    limits : dict
        Names of `LIMITS` with their values, >= 0.
    model : WalkerModel
        What walks.
    mu_s, sigma_s : float
        rad, mean and standard deviation of the slope at which MFPT is taken.
    correlation : float
        Of each slope with the one before.
    slope_limit_deg : float
        Steepest slope of the sets, degrees.
    stages : tuple of Stage
        Meshes, coarse to fine. The last one confirms.
    check_sigmas : tuple of float
        Multiples of sigma_s: at the least of them at which the confirming mesh gives no more than
        ``check_steps`` steps, Monte Carlo has to agree. Empty: no such check.
    check_steps : float
        See there, >= 1. As many as walks can afford, since walks at a larger sigma do not tell all:
        a mesh may claim 85 steps where walks at that sigma take 12.
    check_walks : int
        Walks of that check, >= 1.
    trial_seconds : float
        s, after which a trial is given up. It keeps what it has: a safety net, far above what a
        trial takes, since what it cuts off depends on the machine.

    Raises
    ------
    InputError
        If a value is not allowed.
    """

    start: Controller
    searcher: str = "cma-es"
    seed: int = 1
    step: float = 1.0
    population: int = 0
    runs: int = 0
    fixed: tuple[str, ...] = ()
    candidates: tuple[tuple[float, ...], ...] = ()
    objectives: dict[str, float] = field(default_factory=lambda: {"mfpt": 1.0})
    limits: dict[str, float] = field(default_factory=dict)
    model: WalkerModel = field(default_factory=WalkerModel)
    mu_s: float = 0.0
    sigma_s: float = math.radians(1.0)
    correlation: float = 0.0
    slope_limit_deg: float = 20.0
    stages: tuple[Stage, ...] = DEFAULT_STAGES
    check_sigmas: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0)
    check_steps: float = 200.0
    check_walks: int = 100
    trial_seconds: float = 600.0

    def __post_init__(self) -> None:
        """Check every value."""
        _check("searcher", self.searcher, self.searcher in SEARCHERS, ", ".join(SEARCHERS))
        _check("seed", self.seed, self.seed >= 0, ">= 0")
        _check("step", self.step, 0.0 < self.step < math.inf, "> 0")
        # CMA-ES learns from the difference between two at least.
        most, size = 100_000, self.population
        _check("population", size, size == 0 or 2 <= size <= most, f"0, or 2 to {most}")
        most = _MOST_RUNS if self.searcher == "cma-es" else 1
        allowed = f"0 to {_MOST_RUNS} for cma-es, 0 or 1 for other searchers"
        _check("runs", self.runs, 0 <= self.runs <= most, allowed)
        _check("objectives", list(self.objectives), bool(self.objectives), "at least one")
        for name, weight in self.objectives.items():
            _check("objectives", name, name in OBJECTIVES, ", ".join(OBJECTIVES))
            _check(f"objectives[{name}]", weight, 0.0 < weight < math.inf, "a weight > 0")
        for name, value in self.limits.items():
            _check("limits", name, name in LIMITS, ", ".join(LIMITS))
            _check(f"limits[{name}]", value, 0.0 <= value < math.inf, ">= 0")
        several = len(self.objectives) > 1
        _check("searcher", self.searcher, self.searcher != "nsga2" or several,
               "another one, or several objectives")  # fmt: skip
        given = self.searcher == "given"
        _check("candidates", self.candidates, bool(self.candidates) == given,
               "at least one for the searcher given, none for others")  # fmt: skip
        _check("sigma_s", self.sigma_s, 0.0 < self.sigma_s < math.inf, "> 0 rad")
        check_correlation(self.correlation)
        _check("stages", self.stages, bool(self.stages), "at least one mesh")
        for stage in self.stages:
            slopes = slope_set(stage.slope_step_deg, self.slope_limit_deg)
            _check("mu_s", self.mu_s, abs(self.mu_s) <= slopes[-1], "within the slope set")
            _check("threshold", stage.threshold, 0.0 < stage.threshold < math.inf, "> 0")
            most = 2**32 - 1
            _check("max_states", stage.max_states, 2 <= stage.max_states <= most, f"2 to {most}")
            _check("margin", stage.margin, not math.isnan(stage.margin), "a number")
        for sigma in self.check_sigmas:
            _check("check_sigmas", sigma, 0.0 < sigma < math.inf, "numbers > 0")
        _check("check_steps", self.check_steps, 1.0 <= self.check_steps < math.inf, ">= 1")
        _check("check_walks", self.check_walks, self.check_walks >= 1, ">= 1")
        _check("trial_seconds", self.trial_seconds, 0.0 < self.trial_seconds < math.inf, "> 0 s")

    @cached_property
    def slopes(self) -> tuple[np.ndarray, ...]:
        """Slope set of each stage, rad."""
        return tuple(slope_set(s.slope_step_deg, self.slope_limit_deg) for s in self.stages)

    @property
    def run_count(self) -> int:
        """How many runs the search begins with."""
        return self.runs or (_RUNS if self.searcher == "cma-es" else 1)

    def as_json(self) -> dict[str, Any]:
        """All of it, of JSON's types; infinities are strings that ``float`` reads."""
        start = {"name": self.start.name, "scheme": self.start.scheme}
        out = {name: getattr(self, name) for name in self.__dataclass_fields__}
        out["start"] = start | {"parameters": self.start.parameters.tolist()}
        out["model"] = {name: _text(value) for name, value in model_values(self.model).items()}
        out["stages"] = [{k: _text(v) for k, v in asdict(s).items()} for s in self.stages]
        # A study that was begun before there were these goes on.
        for name in ("candidates", "correlation"):
            if not out[name]:
                del out[name]
        if (count := self.run_count) > 1:
            out["runs"] = count
        else:
            del out["runs"]
        return {k: list(v) if isinstance(v, tuple) else v for k, v in out.items()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> StudySettings:
        """Settings as `as_json` gave them."""
        start = data["start"]
        given = {"runs": 1} | data
        given["start"] = Controller(start["name"], start["scheme"], np.array(start["parameters"]))
        model = {k: math.inf if v == "inf" else v for k, v in data["model"].items()}
        given["model"] = model_from(model)
        given["stages"] = tuple(
            Stage(float(s["slope_step_deg"]), float(s["threshold"]), float(s["margin"]),
                  int(s["max_states"])) for s in data["stages"]
        )  # fmt: skip
        given["candidates"] = tuple(tuple(vector) for vector in data.get("candidates", ()))
        for name in ("fixed", "check_sigmas"):
            given[name] = tuple(data[name])
        return cls(**given)


def _text(value: Any) -> Any:
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _check(name: str, value: object, holds: bool, allowed: str) -> None:
    if not holds:
        raise InputError(name, value, allowed)
