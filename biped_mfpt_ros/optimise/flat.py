"""How a candidate walks on flat ground: its limit cycle, or how far it is from one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.cycle import LimitCycle, limit_cycle_near
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import ABSOLUTE, WalkerModel

_RATES = np.linspace(0.6, 3.6, 13)  # rad/s; the paper's cycles lie between 1 and 3
_MOST_STEPS = 20
_CLOSE = 0.1  # rad and rad/s, from which on Newton's method is tried
_NEWTON_TRIES = 4
_KEPT = 3  # starts that walk on after the third step
_STRIDE = 0.5  # s, a usual step

Simulate = Callable[..., Steps]


@dataclass(frozen=True)
class FlatGait:
    """What came out on flat ground.

    Attributes
    ----------
    cycle : LimitCycle or None
        Its limit cycle, a stable one if there is one.
    progress : float
        0 to 1, for one without a limit cycle: the best start's share of steps that it walked, the
        one in which it fell counted by how long it lasted. Of those that walked to the end, the
        most periodic is nearest to 1.
    reason : str
        Why there is no cycle, empty otherwise.
    clearance : float
        m, least height of the swing foot over the middle half of the step; nan without a cycle.
    torque : float
        N m, largest torque of any joint in the cycle; nan without one.
    refining_seconds : float
        s spent in the step map by Newton's method, which ``simulate`` has not seen.
    """

    cycle: LimitCycle | None
    progress: float
    reason: str
    clearance: float = math.nan
    torque: float = math.nan
    refining_seconds: float = 0.0


def flat_gait(controller: Controller, model: WalkerModel, simulate: Simulate) -> FlatGait:
    """Look for the limit cycle of a candidate, cheaply and with an end.

    States without tracking error, over a range of speeds, walk until one of them is nearly
    periodic; from there Newton's method finishes. A stable cycle ends the search, an unstable one
    is kept in case that there is no other.

    Parameters
    ----------
    controller : Controller
        The candidate.
    model : WalkerModel
        Torque limit, friction and so on.
    simulate : callable
        Simulates steps, with arguments and answer of `simulate_steps`.

    Returns
    -------
    FlatGait
        The cycle, or a grade of how far it is from one.
    """
    with np.errstate(all="ignore"):
        starts = np.array([controller.reference_state(rate, model.robot) for rate in _RATES])
    states = starts[np.isfinite(starts).all(axis=1)]
    unstable: LimitCycle | None = None
    tries = 0
    refining = 0.0
    best = 0.0
    nearest = math.inf
    falls = Outcome.NOT_FINITE
    for walked in range(_MOST_STEPS):
        if not len(states):
            break
        steps = simulate(controller, states, np.zeros(len(states)), [0.0], model)
        upright = steps.outcomes[:, 0] == Outcome.STEP
        if not upright.all():
            for outcome, duration in zip(
                steps.outcomes[~upright, 0], steps.durations[~upright, 0], strict=True
            ):
                share = duration / (duration + _STRIDE) if outcome != Outcome.TIME_LIMIT else 0.0
                if (walked + share) / _MOST_STEPS >= best:
                    best, falls = (walked + share) / _MOST_STEPS, Outcome(int(outcome))
        states, previous = steps.next_states, states[upright]
        if not len(states):
            break
        distances = np.abs(states - previous).max(axis=1)
        order = np.argsort(distances, kind="stable")
        nearest = float(distances[order[0]])
        if nearest < _CLOSE and tries < _NEWTON_TRIES:
            tries += 1
            cycle, spent = limit_cycle_near(controller, states[order[0]], 0.0, model)
            refining += spent
            if cycle is not None and cycle.stable:
                return _measured(cycle, model, refining)
            unstable = unstable or cycle
            if cycle is not None:  # no use in coming back to it
                order = order[np.abs(states[order] - cycle.state).max(axis=1) > _CLOSE]
        # By then starts that end alike are alike.
        states = states[order[:_KEPT] if walked >= 2 else order]
    if unstable is not None:
        return _measured(unstable, model, refining)
    if len(states):
        return FlatGait(
            None, 1.0 / (1.0 + 0.01 * nearest), "walks without becoming periodic",
            refining_seconds=refining,
        )  # fmt: skip
    return FlatGait(None, 0.9 * best, f"falls: {falls.label}", refining_seconds=refining)


def _measured(cycle: LimitCycle, model: WalkerModel, refining: float) -> FlatGait:
    """Clearance and torque of a cycle, from one swing."""
    trace = trace_swing(cycle.controller, cycle.state, 0.0, 0.0, model)
    angles = trace.states[:, :5]
    foot = _swing_foot(angles, model)
    middle = np.abs(foot[:, 0]) <= 0.5 * cycle.step_length
    clearance = float(foot[middle, 1].min()) if middle.any() else math.nan
    return FlatGait(cycle, 1.0, "", clearance, float(np.abs(trace.torques).max()), refining)


def _swing_foot(joints: np.ndarray, model: WalkerModel) -> np.ndarray:
    """Swing foot from the stance foot, m, shape (k, 2), for joint angles of shape (k, 5)."""
    absolute = joints @ ABSOLUTE.T
    reach = model.robot.swing_foot_position
    return np.stack([-np.sin(absolute) @ reach, np.cos(absolute) @ reach], axis=1)
