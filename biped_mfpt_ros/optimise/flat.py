"""How a candidate walks on flat ground: its limit cycle, or how far it is from one.

Most candidates of a search are decided here, so it has to be cheap: some 50 swings where
`find_limit_cycle` takes hundreds. The cycle is as exact as a mesh needs it for its first state, and
its eigenvalues to three digits or so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.gait.cycle import LimitCycle, limit_cycle_of
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import ABSOLUTE, STATE_SIZE, WalkerModel

_RATES = np.linspace(0.6, 3.6, 13)  # rad/s; the paper's cycles lie between 1 and 3
_MOST_STEPS = 20
_KEPT = 4  # starts that walk on after the first step: by then the others are no better
_STRIDE = 0.5  # s, a usual step
_CLOSE = 0.1  # rad and rad/s, from which on Newton's method is tried
_NEWTON_TRIES = 3
_NEWTON_STEPS = 12
_JACOBIANS = 4
# Of the integrator in Newton's method. At 3e-9 the eigenvalues of hzd are right to six digits, but
# those of the kinked references of spline/base only to 4 %; at 1e-11 these have three digits.
_TOLERANCE = 1e-11
_DIFFERENCE = 1e-4  # rad and rad/s, half the width of a central difference
_RESIDUAL = 2e-6  # rad and rad/s, far below what a mesh tells apart

Simulate = Callable[..., Steps]


@dataclass(frozen=True)
class FlatGait:
    """What came out on flat ground.

    Attributes
    ----------
    cycle : LimitCycle or None
        Its limit cycle, a stable one if one was found.
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
    """

    cycle: LimitCycle | None
    progress: float
    reason: str
    clearance: float = math.nan
    torque: float = math.nan


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
    best, falls = 0.0, Outcome.NOT_FINITE
    nearest = math.inf
    for walked in range(_MOST_STEPS):
        if not len(states):
            break
        steps = simulate(controller, states, np.zeros(len(states)), [0.0], model)
        upright = steps.outcomes[:, 0] == Outcome.STEP
        for outcome, duration in zip(
            steps.outcomes[~upright, 0], steps.durations[~upright, 0], strict=True
        ):
            share = 0.0 if outcome == Outcome.TIME_LIMIT else duration / (duration + _STRIDE)
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
            cycle = _refined(controller, model, simulate, states[order[0]])
            if cycle is not None and cycle.stable:
                return _measured(cycle, model)
            unstable = unstable or cycle
            if cycle is not None:  # no use in coming back to it
                order = order[np.abs(states[order] - cycle.state).max(axis=1) > _CLOSE]
        states = states[order[:_KEPT]]
    if unstable is not None:
        return _measured(unstable, model)
    if len(states):
        return FlatGait(None, 1.0 / (1.0 + 0.01 * nearest), "walks without becoming periodic")
    return FlatGait(None, 0.9 * best, f"falls: {falls.label}")


def _refined(
    controller: Controller, model: WalkerModel, simulate: Simulate, state: np.ndarray
) -> LimitCycle | None:
    """Limit cycle near a state by Newton's method, with a Jacobian for as long as it serves."""
    model = replace(model, tolerance=min(model.tolerance, _TOLERANCE))

    def stepped(states: np.ndarray) -> Steps | None:
        steps = simulate(controller, states, np.zeros(len(states)), [0.0], model)
        return steps if (steps.outcomes == Outcome.STEP).all() else None

    difference = _DIFFERENCE * np.concatenate([np.eye(STATE_SIZE), -np.eye(STATE_SIZE)])

    def jacobian() -> np.ndarray | None:
        around = stepped(state + difference)
        if around is None:
            return None
        ahead = around.next_states
        return (ahead[:STATE_SIZE] - ahead[STATE_SIZE:]).T / (2.0 * _DIFFERENCE)

    steps, slope = stepped(state[None]), jacobian()
    if steps is None or slope is None:
        return None
    residual = steps.next_states[0] - state
    at, used = state, 1  # where the Jacobian was taken, and how many were
    for _ in range(_NEWTON_STEPS):
        size = np.abs(residual).max()
        if size < _RESIDUAL:
            if np.abs(state - at).max() > 1e-3:
                slope = jacobian()
                if slope is None:
                    return None
            try:
                return limit_cycle_of(
                    controller, 0.0, state, steps, slope, model.robot, float(size)
                )
            except np.linalg.LinAlgError:
                return None
        try:
            move = np.linalg.solve(slope - np.eye(STATE_SIZE), -residual)
        except np.linalg.LinAlgError:
            return None
        tried = stepped((state + move)[None]) if np.isfinite(move).all() else None
        new = math.inf if tried is None else np.abs(tried.next_states[0] - state - move).max()
        if tried is None or new >= size:
            # A new Jacobian, and if this one is new already a shorter way.
            if used >= _JACOBIANS:
                return None
            if at is state:
                move = 0.25 * move
                tried = stepped((state + move)[None]) if np.isfinite(move).all() else None
                if tried is None or np.abs(tried.next_states[0] - state - move).max() >= size:
                    return None
            else:
                slope, at, used = jacobian(), state, used + 1
                if slope is None:
                    return None
                continue
        state, steps = state + move, tried
        residual = steps.next_states[0] - state
        if np.abs(residual).max() > 0.1 * size and used < _JACOBIANS:
            slope, at, used = jacobian(), state, used + 1
            if slope is None:
                return None
    return None


def _measured(cycle: LimitCycle, model: WalkerModel) -> FlatGait:
    """Clearance and torque of a cycle, from one swing."""
    trace = trace_swing(cycle.controller, cycle.state, 0.0, 0.0, model)
    absolute = trace.states[:, :5] @ ABSOLUTE.T
    reach = model.robot.swing_foot_position
    x, y = -np.sin(absolute) @ reach, np.cos(absolute) @ reach
    middle = np.abs(x) <= 0.5 * cycle.step_length
    clearance = float(y[middle].min()) if middle.any() else math.nan
    return FlatGait(cycle, 1.0, "", clearance, float(np.abs(trace.torques).max()))
