"""Scores of candidates, in stages: what is cheap decides first, and only what is confirmed counts.

1. Parameters that stand for a controller at all.
2. The limit cycle on flat ground: whether there is one, stable, within the constraints.
3. Meshes, coarse to fine. A candidate gets the next one only if its score so far is close to the
   best confirmed one, or above it, as the stage's ``margin`` says.
4. Monte Carlo at a larger sigma_s, for one that has come through the last mesh.

The score is taken from the *least* MFPT of the meshes that a candidate was given. A mesh of a few
dozen states may claim far more than is true, and a search would go straight for such errors; with
the least, an error pays off only below the best confirmed score, where it is of no use, and what
lies above has been confirmed on the last mesh.

Scores come in tiers that do not overlap, so that a search may start anywhere and finds its way
up: no controller, no gait, an unstable one, one that breaks constraints, one without a mesh, the
others. Within each tier the score is graded.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import LimitCycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.optimise.flat import FlatGait, flat_gait
from biped_mfpt_ros.optimise.settings import Stage, StudySettings

MOST_DECADES = 300.0
"""Largest log10 of an MFPT that is told apart."""

_TIER = 1000.0  # between the tiers of the score; no score of a gait is as large
_LEAST = -0.5 * _TIER  # of a gait that holds all constraints


class Stopped(Exception):
    """The study is to stop; the trial is left as if it had not been begun."""


class TooLong(Exception):
    """The time of the trial is over."""


class MeshFailed(Exception):
    """A mesh or its chain could not be had, for a reason that lies in the candidate.

    Parameters
    ----------
    reason : str
        Why.
    states : int
        States that it had by then.
    """

    def __init__(self, reason: str, states: int = 0) -> None:
        self.states = states
        super().__init__(reason)


class BackendLost(Exception):
    """The backend failed, for no fault of the candidate: its trial is given back."""


class GrownMesh(Protocol):
    """A mesh that a backend has grown."""

    @property
    def mesh_id(self) -> str:
        """Under which the pipeline knows it; empty for one in memory."""

    @property
    def states(self) -> int:
        """States, the failure state counted."""

    @property
    def seconds(self) -> float:
        """Wall time, s."""

    @property
    def step_map_seconds(self) -> float:
        """Time in the step map, summed over who worked on it, s."""

    def mfpt(self, mu_s: float, sigma_s: float, correlation: float) -> float:
        """MFPT in steps; MeshFailed if its chain cannot be solved."""


class Backend(Protocol):
    """Who grows meshes: this process, or the pipeline."""

    def grow(
        self,
        cycle: LimitCycle,
        settings: StudySettings,
        stage: Stage,
        slopes: np.ndarray,
        check: Callable[[], None],
    ) -> GrownMesh:
        """Grow a mesh from a limit cycle; MeshFailed if the candidate does not allow it.

        ``check`` is called often while it grows, and may raise.
        """


@dataclass(frozen=True)
class Best:
    """The best confirmed scores of the generations before; what decides how far a trial goes.

    Attributes
    ----------
    score : float
        Best confirmed score, -inf without one.
    front : tuple of tuple of float
        Costs of the confirmed candidates that no other dominates; for studies with a front only.
    """

    score: float = -math.inf
    front: tuple[tuple[float, ...], ...] = ()


@dataclass
class Evaluation:
    """What a trial found.

    Attributes
    ----------
    stage : str
        How far it came: ``invalid``, ``falls``, ``unstable``, ``infeasible``, ``unmeshed``,
        ``mesh 1``, ..., ``confirmed`` or ``refuted``.
    score : float
        To be maximised; finite.
    costs : tuple of float
        One for each objective, to be minimised; nan where there is no value.
    violation : float
        0, or how far it is from a gait that holds every constraint.
    values : dict
        What was measured: mfpt, cot, speed, ...; only what there is.
    states : int
        Of the finest mesh, 0 without one.
    mesh_id : str
        Of the finest mesh, empty without one.
    meshes : list of dict
        Each mesh: its settings, states, MFPT, seconds.
    note : str
        Why it came no further, for readers.
    seconds, step_map_seconds : float
        s, wall time of the trial, and of it in the step map (summed over threads or simulators).
    """

    stage: str = "invalid"
    score: float = -5.0 * _TIER
    costs: tuple[float, ...] = ()
    violation: float = 5.0
    values: dict[str, float] = field(default_factory=dict)
    states: int = 0
    mesh_id: str = ""
    meshes: list[dict[str, Any]] = field(default_factory=list)
    note: str = ""
    seconds: float = 0.0
    step_map_seconds: float = 0.0

    @property
    def confirmed(self) -> bool:
        """Whether its score may be reported as a best one."""
        return self.stage == "confirmed"


class _Clock:
    """Simulates steps and adds up the time that they take; ends a trial that takes too long."""

    def __init__(self, seconds: float, stopping: Callable[[], bool]) -> None:
        self._deadline = time.monotonic() + seconds
        self._stopping = stopping
        self.step_map_seconds = 0.0

    def check(self) -> None:
        if self._stopping():
            raise Stopped
        if time.monotonic() > self._deadline:
            raise TooLong

    def simulate(self, *args: Any) -> Steps:
        self.check()
        steps = simulate_steps(*args)
        self.step_map_seconds += steps.seconds
        return steps


def evaluate(
    make: Callable[[], Controller],
    settings: StudySettings,
    best: Best,
    backend: Backend,
    stopping: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Score a candidate.

    Parameters
    ----------
    make : callable
        Makes the candidate's controller, or raises InputError.
    settings : StudySettings
        Of the study.
    best : Best
        Best confirmed scores of the generations before.
    backend : Backend
        Who grows meshes.
    stopping : callable, optional
        Whether the study is to stop.

    Returns
    -------
    Evaluation
        Equal for equal arguments, but for its seconds, unless it ran out of time.

    Raises
    ------
    Stopped
        If the study is to stop.
    """
    start = time.monotonic()
    clock = _Clock(settings.trial_seconds, stopping)
    out = Evaluation(costs=(math.nan,) * len(settings.objectives))
    try:
        _evaluate(make, settings, best, backend, clock, out)
    except InputError as error:
        out.note = str(error)
    except TooLong:
        out.note = f"given up after {settings.trial_seconds:g} s"
    except (Stopped, BackendLost):
        raise
    except Exception:
        # Whatever one candidate brings to light must not end the study.
        out.note = f"internal error: {traceback.format_exc()}"
    out.seconds = time.monotonic() - start
    out.step_map_seconds += clock.step_map_seconds
    return out


def _evaluate(
    make: Callable[[], Controller],
    settings: StudySettings,
    best: Best,
    backend: Backend,
    clock: _Clock,
    out: Evaluation,
) -> None:
    controller = make()
    out.stage, out.score, out.violation = "falls", -4.0 * _TIER, 4.0
    gait = flat_gait(controller, settings.model, clock.simulate)
    cycle = gait.cycle
    if cycle is None:
        out.score += gait.progress
        out.violation -= gait.progress
        out.note = gait.reason
        return
    out.values = {
        "cot": cycle.cost_of_transport,
        "speed": cycle.speed,
        "step_length": cycle.step_length,
        "period": cycle.period,
        "clearance": gait.clearance,
        "torque": gait.torque,
        "eigenvalue": float(abs(cycle.eigenvalues[0])),
    }
    if not cycle.stable:
        excess = math.log(out.values["eigenvalue"])
        out.stage, out.note = "unstable", f"largest eigenvalue {out.values['eigenvalue']:.3g}"
        out.score, out.violation = -3.0 * _TIER - _bounded(excess), 2.0 + _bounded(excess)
        return
    broken = _violations(settings.limits, out.values)
    if broken:
        total = _bounded(sum(broken.values()))
        out.stage, out.note = "infeasible", "breaks " + ", ".join(broken)
        out.score, out.violation = -2.0 * _TIER - total, 1.0 + total
        return
    if "mfpt" not in settings.objectives:
        _weigh(settings, out)
        out.stage = "confirmed"
        return
    out.stage, out.score, out.violation = "unmeshed", -_TIER, 0.5
    _mesh(controller, gait, settings, best, backend, clock, out)


def _mesh(
    controller: Controller,
    gait: FlatGait,
    settings: StudySettings,
    best: Best,
    backend: Backend,
    clock: _Clock,
    out: Evaluation,
) -> None:
    """Meshes, coarse to fine, then Monte Carlo."""
    assert gait.cycle is not None
    grown: GrownMesh | None = None
    for number, (stage, slopes) in enumerate(zip(settings.stages, settings.slopes, strict=True)):
        if number > 0 and not _promising(settings, best, out, stage.margin):
            return
        row: dict[str, Any] = {"slope_step_deg": stage.slope_step_deg, "threshold": stage.threshold}
        out.meshes.append(row)
        try:
            grown = backend.grow(gait.cycle, settings, stage, slopes, clock.check)
            out.step_map_seconds += grown.step_map_seconds
            out.states, out.mesh_id = grown.states, grown.mesh_id
            row |= {"states": grown.states, "mesh_id": grown.mesh_id, "seconds": grown.seconds}
            mfpt = grown.mfpt(settings.mu_s, settings.sigma_s, settings.correlation)
        except MeshFailed as error:
            row |= {"states": error.states, "problem": str(error)}
            out.note = str(error)
            return
        row["mfpt"] = mfpt
        out.values["mfpt"] = min(mfpt, out.values.get("mfpt", math.inf))
        _weigh(settings, out)
        out.stage = f"mesh {number + 1}"
    assert grown is not None
    _check_by_walks(controller, gait.cycle, grown, settings, clock, out)


def _check_by_walks(
    controller: Controller,
    cycle: LimitCycle,
    grown: GrownMesh,
    settings: StudySettings,
    clock: _Clock,
    out: Evaluation,
) -> None:
    """Confirm by Monte Carlo, at the least multiple of sigma_s where walks end soon enough."""
    out.stage = "confirmed"
    for multiple in sorted(settings.check_sigmas):
        sigma = multiple * settings.sigma_s
        if 3.0 * sigma > math.radians(settings.slope_limit_deg):
            break
        clock.check()
        try:
            claimed = grown.mfpt(settings.mu_s, sigma, settings.correlation)
        except MeshFailed:
            continue
        if claimed > settings.check_steps:
            continue
        start = time.monotonic()
        # The stream of random numbers is the same for all candidates, which makes them comparable.
        found = monte_carlo(
            controller,
            sigma,
            settings.check_walks,
            settings.seed,
            mu_s=settings.mu_s,
            correlation=settings.correlation,
            model=settings.model,
            state=cycle.state,
            max_steps=int(20 * settings.check_steps),
            threads=1,
            progress=lambda done, total: clock.check(),
        )
        out.step_map_seconds += time.monotonic() - start  # it does nothing else
        counted = found.counted
        steps = float(counted.mean()) if counted.size else 0.0
        out.values |= {"check_sigma": sigma, "check_claimed": claimed, "check_steps": steps}
        error = float(counted.std() / math.sqrt(counted.size)) if counted.size > 1 else 0.0
        if steps + 3.0 * error < 0.5 * claimed:
            # The mesh claims more than twice of what walks show, beyond three standard errors.
            # What the walks show at the larger sigma is still a lower bound.
            out.stage = "refuted"
            out.note = f"{steps:.3g} steps by Monte Carlo where the mesh claims {claimed:.3g}"
            out.values["mfpt"] = min(out.values["mfpt"], max(steps, 1.0))
            _weigh(settings, out)
        return


def utilities(names: Iterable[str], values: dict[str, float]) -> tuple[float, ...]:
    """What is to be maximised, for each of the objectives named."""
    known = {
        "mfpt": lambda v: min(MOST_DECADES, math.log10(max(v, 1.0))),
        "cot": lambda v: -v,
        "speed": lambda v: v,
    }
    return tuple(float(known[name](values[name])) for name in names)


def _weigh(settings: StudySettings, out: Evaluation) -> None:
    wanted = utilities(settings.objectives, out.values)
    weights = settings.objectives.values()
    score = sum(w * u for w, u in zip(weights, wanted, strict=True))
    out.score = min(-_LEAST, max(_LEAST, score))
    out.costs = tuple(-u for u in wanted)
    out.violation = 0.0


def _promising(settings: StudySettings, best: Best, out: Evaluation, margin: float) -> bool:
    """Whether a candidate may be worth the next mesh."""
    if settings.searcher != "nsga2":
        return out.score > best.score - margin
    # Not one that a confirmed candidate beats in every objective, by as much as the margin.
    weights = np.array(list(settings.objectives.values()))
    mine = weights * np.array(out.costs) - margin
    return not any(bool(np.all(weights * np.array(costs) <= mine)) for costs in best.front)


def _violations(limits: dict[str, float], values: dict[str, float]) -> dict[str, float]:
    """Relative violation of each limit that is broken."""
    out = {}
    for name, limit in limits.items():
        quantity, _, side = name.rpartition("_")
        value = values[quantity]
        excess = limit - value if side == "min" else value - limit
        if not excess <= 0.0:  # nan breaks every limit
            out[name] = excess / max(limit, 1e-3) if math.isfinite(excess) else 10.0
    return out


def _bounded(value: float) -> float:
    """0 to 1, ascending."""
    return value / (1.0 + value)


def front_of(costs: Sequence[tuple[float, ...]]) -> list[int]:
    """Indices of those that no other dominates, in the order given; of equals the first."""
    out = []
    for i, mine in enumerate(costs):
        dominated = any(
            all(a <= b for a, b in zip(other, mine, strict=True)) and (other != mine or j < i)
            for j, other in enumerate(costs)
            if j != i
        )
        if not dominated:
            out.append(i)
    return out
