"""One step: from a state just after impact to the next one, or to a fall (eq. 23, section 2.1).

One swing, simulated down to the steepest downhill slope of a set, yields the outcome for every
slope of the set: the swing foot crosses them in order.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.ground import slopes_ahead, to_joint
from biped_mfpt_ros.gait.scratch import (
    AHEAD,
    DURATION,
    EVALUATIONS,
    LENGTH,
    MODE,
    OUTCOME,
    SPENT,
    STEPS,
    VARIABLES,
    WORKS,
    empty_scratch,
)
from biped_mfpt_ros.gait.swing import advance, begin
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, SLOPE_LIMIT_DEG, check_slopes

_STEP = int(Outcome.STEP)
_UNBOUNDED = 2**62


@kernel
def _simulate(
    scheme,
    rob,
    par,
    states,
    previous,
    slopes,
    most_evaluations,
    outcomes,
    measures,
):
    """Simulate a swing from every state.

    A lane that has ended its swing takes the next state. No swing is begun after
    ``most_evaluations``; those are dropped that only begun since they were under way at once, so
    that what is left does not depend on how many are. ``measures``, shape (3, n, m), is set to
    durations, lengths and energies; with shape (3, 0, m) none are wanted.

    Returns how many states were simulated, states after impact of the steps that succeeded, in
    order, integrator steps and evaluations.
    """
    n, m = outcomes.shape
    w, v = empty_scratch(), np.zeros((VARIABLES, LANES))
    w[MODE, WORKS] = 1.0 if measures.shape[1] > 0 else 0.0
    ahead = np.zeros((LANES, AHEAD, m + LANES))
    for lane in range(LANES):
        slopes_ahead(slopes, ahead[lane])
    active = np.zeros(LANES, np.bool_)
    of = np.full(LANES, -1)  # which state's swing each lane holds
    trace = np.zeros((0, 0))
    started = 0
    costs = np.zeros((n, 2), np.int64)  # integrator steps and evaluations
    # States after impact as swings end, and where those of each state begin.
    found, at = np.empty((n * m, STATE_SIZE)), np.zeros(n, np.int64)
    count = 0
    evaluations = 0
    while True:
        for lane in range(LANES):
            if active[lane]:
                continue
            k = of[lane]
            if k >= 0:
                of[lane] = -1
                costs[k, 0], costs[k, 1] = int(v[STEPS, lane]), int(v[EVALUATIONS, lane])
                if measures.shape[1] > 0:
                    for i in range(m):
                        measures[0, k, i] = ahead[lane, DURATION, m - 1 - i]
                        measures[1, k, i] = ahead[lane, LENGTH, m - 1 - i]
                        measures[2, k, i] = ahead[lane, SPENT, m - 1 - i]
                at[k] = count
                for i in range(m):
                    outcomes[k, i] = int(ahead[lane, OUTCOME, m - 1 - i])
                    if outcomes[k, i] == _STEP:
                        to_joint(ahead[lane], m - 1 - i, found[count])
                        count += 1
            if started < n and evaluations + v[EVALUATIONS].sum() < most_evaluations:
                evaluations += int(v[EVALUATIONS, lane])
                begin(
                    scheme,
                    rob,
                    par,
                    w,
                    v,
                    lane,
                    states[started],
                    previous[started],
                    ahead[lane],
                )
                of[lane], active[lane] = started, True
                started += 1
        if not active.any():
            break
        advance(scheme, rob, par, w, v, active, ahead, trace)
    done = steps = evaluations = 0
    while done < started and (done == 0 or evaluations < most_evaluations):
        steps += costs[done, 0]
        evaluations += costs[done, 1]
        done += 1
    following = np.empty(((outcomes[:done] == _STEP).sum(), STATE_SIZE))
    count = 0
    for k in range(done):
        of_state = (outcomes[k] == _STEP).sum()
        following[count : count + of_state] = found[at[k] : at[k] + of_state]
        count += of_state
    return done, following, steps, evaluations


@dataclass(frozen=True)
class Steps:
    """Outcomes of n swings, each for m slopes.

    Attributes
    ----------
    outcomes : numpy.ndarray
        `Outcome` codes, uint8, shape (n, m).
    next_states : numpy.ndarray
        ``[q, dq]`` just after impact (rad, rad/s), float64, shape (k, 10): only of the k steps with
        the outcome STEP, in row-major order of ``outcomes``.
    durations : numpy.ndarray
        s, to the impact or to the fall, shape (n, m); (0, m), as the next two, if none are wanted.
    step_lengths : numpy.ndarray
        m, from foot to foot at impact, shape (n, m); 0 for a fall.
    energies : numpy.ndarray
        J, integral of ``sum |u_i dq_i|`` to the impact or to the fall, shape (n, m).
    seconds : float
        s, wall time spent in the step map.
    integrator_steps, evaluations : int
        Integrator steps accepted and evaluations of the closed loop, over all swings.
    """

    outcomes: np.ndarray
    next_states: np.ndarray
    durations: np.ndarray
    step_lengths: np.ndarray
    energies: np.ndarray
    seconds: float
    integrator_steps: int
    evaluations: int


def check_states(states: ArrayLike, field: str = "states") -> np.ndarray:
    """Check states: shape (n, 10), finite; returned as contiguous float64, or InputError."""
    allowed = f"numbers, shape (n, {STATE_SIZE}): q1..q5, dq1..dq5"
    out = np.ascontiguousarray(numbers(states, field, allowed), dtype=np.float64)
    if out.ndim != 2 or out.shape[1] != STATE_SIZE:
        raise InputError(field, f"shape {out.shape}", allowed)
    bad = ~np.isfinite(out)
    if bad.any():
        n, i = np.argwhere(bad)[0]
        raise InputError(f"{field}[{n}][{i}]", float(out[n, i]), "finite rad and rad/s")
    return out


def check_state(state: ArrayLike, field: str = "state") -> np.ndarray:
    """Check one state, shape (10,), finite; returned as contiguous float64, or InputError."""
    given = numbers(state, field, f"numbers, shape ({STATE_SIZE},): q1..q5, dq1..dq5")
    return check_states(given[np.newaxis], field)[0]


def simulate_steps(
    controller: Controller,
    states: ArrayLike,
    previous_slopes: ArrayLike,
    slopes: ArrayLike,
    model: WalkerModel | None = None,
    most_evaluations: int | None = None,
    measures: bool = True,
) -> Steps:
    """Simulate one step from every state, for every slope ahead.

    Parameters
    ----------
    controller : Controller
        What walks.
    states : array_like
        ``[q, dq]`` just after impact, rad and rad/s, shape (n, 10).
    previous_slopes : array_like
        rad, slope of the ground behind the stance foot, shape (n,).
    slopes : array_like
        rad, slopes ahead, shape (m,), strictly ascending, negative is downhill.
    model : WalkerModel, optional
        Torque limit, friction and so on.
    most_evaluations : int, optional
        Begin no further swing after so many evaluations of the closed loop: a bound on what a
        controller costs whose swings crawl. The first swing is always simulated.
    measures : bool, optional
        Whether durations, step lengths and energies are wanted. A mesh needs none of them, and a
        swing takes a tenth less without. The steps are the same.

    Returns
    -------
    Steps
        Outcomes; of the first states only, where ``most_evaluations`` cut it short. A fall is a
        code, never an error.

    Raises
    ------
    InputError
        If an array has the wrong shape, holds a value that is not finite or a slope out of range,
        or slopes do not ascend; or if the controller's parameters are out of range.
    """
    model = model or WalkerModel()
    states = check_states(states)
    slopes = check_slopes(slopes)
    n, m = states.shape[0], slopes.size
    allowed = f"numbers, shape ({n},), as states"
    previous = np.ascontiguousarray(
        numbers(previous_slopes, "previous_slopes", allowed), dtype=np.float64
    )
    if previous.shape != (n,):
        raise InputError("previous_slopes", f"shape {previous.shape}", allowed)
    if not (np.abs(previous) <= SLOPE_LIMIT).all():
        i = int(np.argmax(~(np.abs(previous) <= SLOPE_LIMIT)))
        raise InputError(
            f"previous_slopes[{i}]",
            float(previous[i]),
            f"finite, within {SLOPE_LIMIT:.4f} rad ({SLOPE_LIMIT_DEG:g} degrees)",
        )
    packed_model, packed_controller = model.packed(), controller.packed(model.robot)
    outcomes = np.empty((n, m), dtype=np.uint8)
    measured = np.empty((3, n if measures else 0, m))
    start = time.perf_counter()
    done, following, steps, evaluations = _simulate(
        controller.code,
        packed_model,
        packed_controller,
        states,
        previous,
        slopes,
        _UNBOUNDED if most_evaluations is None else max(1, most_evaluations),
        outcomes,
        measured,
    )
    seconds = time.perf_counter() - start
    return Steps(
        outcomes=outcomes[:done],
        next_states=following,
        durations=measured[0, :done],
        step_lengths=measured[1, :done],
        energies=measured[2, :done],
        seconds=seconds,
        integrator_steps=steps,
        evaluations=evaluations,
    )
