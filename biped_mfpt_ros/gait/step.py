"""One step: from a state just after impact to the next one, or to a fall (eq. 23, section 2.1).

One swing, simulated down to the steepest downhill slope of a set, yields the outcome for every
slope of the set: the swing foot crosses them in order.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.closed_loop import closed_loop, margin, switch
from biped_mfpt_ros.gait.events import (
    body_root,
    body_touches,
    foot_lowest,
    foot_root,
    forces_at,
    slip_root,
    switch_root,
)
from biped_mfpt_ros.gait.integrate import (
    ORDER,
    ROWS,
    SIZE,
    STAGE,
    STAGES,
    Y_AT,
    Y_NEW,
    Y,
    interpolate,
    prepare_dense,
    trial_step,
)
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import dynamics, impact
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import TORQUE, swing_foot
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, SLOPE_LIMIT_DEG, check_slopes

FOOT_TOLERANCE = 1e-3
"""m, how far below the ground behind a swing foot may start: states are typed in rounded."""

_CLEARANCE = 1e-9  # m, rounding of the height of a foot that stands on the ground
_MOST_STEPS = 20_000  # integrator steps before a swing is given up
_MOST_EVALUATIONS = 500_000  # the same for evaluations: a swing may crawl without a step accepted
_UNBOUNDED = 2**62
_SLIP_SAMPLES = 6  # in an integrator step that may contain a slip
_LONGEST_STEP = 0.025  # s: the foot moves one way at most within a step, and back
_TRACE_SAMPLES = 4  # of every integrator step
SAMPLE_COLUMNS = 18  # of a trace: t, a (5), da (5), u (4), tangential, normal force, energy

_STEP = int(Outcome.STEP)
_LIFTS = int(Outcome.STANCE_LIFTS)
_SLIPS = int(Outcome.STANCE_SLIPS)
_SCUFFS = int(Outcome.SWING_SCUFFS)
_BEHIND = int(Outcome.FOOT_BEHIND)
_PULLS = int(Outcome.IMPACT_PULLS)
_IMPACT_SLIPS = int(Outcome.IMPACT_SLIPS)
_NO_LIFT = int(Outcome.NO_LIFT_OFF)
_BODY = int(Outcome.BODY_TOUCHES)
_TIME = int(Outcome.TIME_LIMIT)
_NOT_FINITE = int(Outcome.NOT_FINITE)
_OPEN = 255  # not yet decided


@kernel
def _land(rob, work, s, slope, after):
    """Impact on a slope, from the state in _Y_AT. Returns the outcome and sets ``after``."""
    px, py, vx, vy = impact.impact(rob, work, s[Y_AT], after)
    cosine = math.cos(slope)
    sine = math.sin(slope)
    normal = py * cosine - px * sine
    tangential = px * cosine + py * sine
    for i in range(10):
        if not math.isfinite(after[i]):
            return _NOT_FINITE
    if not normal > 0.0:
        return _PULLS
    if rob[r.VERTICAL_FRICTION] != 0.0:
        sticks = abs(px) < rob[r.FRICTION] * py
    else:
        sticks = abs(tangential) < rob[r.FRICTION] * normal
    if not sticks:
        return _IMPACT_SLIPS
    if not vy * cosine - vx * sine > 0.0:
        return _NO_LIFT
    return _STEP


@kernel
def _swing(
    scheme,
    rob,
    par,
    previous,
    slopes,
    s,
    work,
    outcomes,
    durations,
    lengths,
    energies,
    after,
    trace,
):
    """Simulate one swing and decide its outcome for every slope.

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    rob, par : numpy.ndarray
        Packed model and controller.
    previous : float
        rad, slope of the ground behind the stance foot.
    slopes : numpy.ndarray
        rad, shape (m,), ascending.
    s : numpy.ndarray
        Scratch, shape (ROWS, SIZE); the state after impact stands in row _Y.
    work : numpy.ndarray
        Workspace of the dynamics.
    outcomes, durations, lengths, energies : numpy.ndarray
        Results, shape (m,).
    after : numpy.ndarray
        States after impact (absolute angles) where the outcome is STEP, shape (m, 10).
    trace : numpy.ndarray
        Samples of the swing, shape (k, SAMPLE_COLUMNS); k = 0: none are wanted.

    Returns
    -------
    tuple of int
        Integrator steps accepted, evaluations of the right-hand side, samples in the trace.
    """
    m = slopes.size
    for i in range(m):
        outcomes[i] = _OPEN
        durations[i] = 0.0
        lengths[i] = 0.0
        energies[i] = 0.0
    todo = m  # slopes still open are 0 .. todo - 1: the steepest uphill one is next
    t = 0.0
    steps = 0
    evaluations = 1
    samples = 0
    first_step = 1e-3 * (rob[r.TOLERANCE] / 1e-9) ** (1.0 / ORDER)
    # A foot that slips under no load to speak of is one that lifts.
    unloaded = 1e-6 * rob[r.MASS] * rob[r.GRAVITY]
    failure = -1

    s[Y, 10] = 0.0
    back_sin, back_cos = math.sin(previous), math.cos(previous)
    switched = False
    since = -1.0  # when the present slip of the stance foot began
    x, y, dx, dy = swing_foot(rob, s[Y])
    height = y * back_cos - x * back_sin
    lowest = min(height, 0.0) - _CLEARANCE
    passed = False
    switched = not switch(scheme, par, s[Y]) > 0.0
    ft, fn = closed_loop(scheme, switched, rob, par, work, s[Y], s[STAGE])
    start_margin, saturated = margin(rob, ft, fn), work[TORQUE, 4]
    for i in range(10):
        if not (math.isfinite(s[Y, i]) and math.isfinite(s[STAGE, i])):
            failure = _NOT_FINITE
    if failure < 0:
        if not (x < 0.0 and height >= -FOOT_TOLERANCE):
            failure = _SCUFFS
        elif not fn > unloaded:
            failure = _LIFTS
        elif not start_margin > 0.0:
            if rob[r.SLIP_DURATION] == 0.0:
                failure = _SLIPS
            since = 0.0
        while todo > 0 and failure < 0 and body_touches(rob, s[Y], previous, slopes[todo - 1]):
            todo -= 1
            outcomes[todo] = _BODY
    h = first_step
    while failure < 0 and todo > 0:
        if steps >= _MOST_STEPS or evaluations >= _MOST_EVALUATIONS or t >= rob[r.TIME_LIMIT]:
            failure = _TIME
            break
        h = min(h, _LONGEST_STEP, rob[r.TIME_LIMIT] - t + 1e-9)
        error, least, most, least_normal, end_ft, end_fn, end_saturated = trial_step(
            scheme, switched, rob, par, work, s, h, saturated
        )
        evaluations += STAGES
        if not error <= 1.0:
            if h < 1e-13 or (not math.isfinite(error) and h < 1e-9):
                failure = _NOT_FINITE
                break
            h *= max(0.2, 0.9 * error ** (-1.0 / ORDER)) if math.isfinite(error) else 0.1
            continue
        steps += 1
        growth = 5.0 if error < 1e-4 else min(5.0, 0.9 * error ** (-1.0 / ORDER))
        least, most = min(least, start_margin), max(most, start_margin)
        dense = False

        # The step ends early where the controller switches.
        end = 1.0
        switches = (switch(scheme, par, s[Y_NEW]) > 0.0) == switched
        if switches:
            prepare_dense(s, h)
            dense = True
            end = switch_root(scheme, par, s, switched, 1.0, h)
            interpolate(s, end)
            for i in range(SIZE):
                s[Y_NEW, i] = s[Y_AT, i]

        # Falls that end the swing for every slope: the first one in [0, end].
        stop = end
        uncertain = 0.25 * (most - least) + 1e-3 * rob[r.MASS] * rob[r.GRAVITY]
        if not (least > uncertain and least_normal > uncertain and since < 0.0):
            if not dense:
                prepare_dense(s, h)
                dense = True
            last = 0.0
            slipping = since >= 0.0
            for k in range(1, _SLIP_SAMPLES + 1):
                at = end * k / _SLIP_SAMPLES
                ft, fn = forces_at(scheme, switched, rob, par, work, s, at)
                evaluations += 1
                slips = not margin(rob, ft, fn) > 0.0
                began, until = since, t + at * h
                if slips != slipping:
                    root = slip_root(scheme, switched, rob, par, work, s, last, at, h, slips)
                    if slips:
                        since = t + root * h
                        began = since
                    else:
                        until = t + root * h
                        since = -1.0
                if (slips or slipping) and began + rob[r.SLIP_DURATION] <= until:
                    stop = min(end, max(0.0, (began + rob[r.SLIP_DURATION] - t) / h))
                    ft, fn = forces_at(scheme, switched, rob, par, work, s, stop)
                    failure = _SLIPS if fn > unloaded else _LIFTS
                    break
                if not fn > 0.0:
                    stop = at
                    failure = _LIFTS
                    break
                slipping = slips
                last = at

        new_x, new_y, new_dx, new_dy = swing_foot(rob, s[Y_NEW])
        start_ahead = 0.0  # the foot is ahead of the stance foot from here to end_ahead
        end_ahead = end
        if x < 0.0:
            start_ahead = end
            bx, by, bdx, bdy = new_x, new_y, new_dx, new_dy
            if new_x >= 0.0:
                if not dense:
                    prepare_dense(s, h)
                    dense = True
                start_ahead = foot_root(rob, s, -1.0, 0.0, 0.0, 0.0, end, h)
                interpolate(s, start_ahead)
                bx, by, bdx, bdy = swing_foot(rob, s[Y_AT])
            # Behind the stance foot: against the ground of the preceding slope.
            touch = start_ahead
            below = by * back_cos - bx * back_sin < lowest
            falls = dy * back_cos - dx * back_sin < 0.0
            if not below and falls and bdy * back_cos - bdx * back_sin > 0.0:
                if not dense:
                    prepare_dense(s, h)
                    dense = True
                touch = foot_lowest(rob, s, -back_sin, back_cos, 0.0, start_ahead)
                interpolate(s, touch)
                bx, by, _, _ = swing_foot(rob, s[Y_AT])
                below = by * back_cos - bx * back_sin < lowest
            if below:
                if not dense:
                    prepare_dense(s, h)
                    dense = True
                touch = foot_root(rob, s, -back_sin, back_cos, lowest, 0.0, touch, h)
            elif new_x >= 0.0:
                touch = start_ahead
                below = not by > 0.0
            if below and touch <= stop:
                stop = touch
                failure = _BEHIND if passed else _SCUFFS
            passed = passed or new_x >= 0.0
        elif new_x < 0.0:
            if not dense:
                prepare_dense(s, h)
                dense = True
            end_ahead = foot_root(rob, s, 1.0, 0.0, 0.0, 0.0, end, h)

        # Slopes that the foot or the body reaches in this step, the steepest first.
        # Each root is sought over the whole step, so that a slope's does not depend on the others.
        low = start_ahead
        high = min(stop, end_ahead)
        while todo > 0:
            slope = slopes[todo - 1]
            nx, ny = -math.sin(slope), math.cos(slope)
            foot_at = 2.0
            if high > low:
                fx, fy, fdx, fdy = new_x, new_y, new_dx, new_dy
                if high < end:
                    interpolate(s, high)
                    fx, fy, fdx, fdy = swing_foot(rob, s[Y_AT])
                reached = nx * fx + ny * fy <= 0.0
                until = high
                if not reached and nx * fdx + ny * fdy > 0.0:
                    # It may have dipped below the slope and risen again within the step.
                    gdx, gdy = dx, dy
                    if low > 0.0:
                        interpolate(s, low)
                        _, _, gdx, gdy = swing_foot(rob, s[Y_AT])
                    if nx * gdx + ny * gdy < 0.0:
                        if not dense:
                            prepare_dense(s, h)
                            dense = True
                        until = foot_lowest(rob, s, nx, ny, low, high)
                        interpolate(s, until)
                        fx, fy, _, _ = swing_foot(rob, s[Y_AT])
                        reached = nx * fx + ny * fy <= 0.0
                if reached:
                    if not dense:
                        prepare_dense(s, h)
                        dense = True
                    foot_at = foot_root(rob, s, nx, ny, 0.0, low, until, h)
            body_at = 2.0
            until = min(stop, foot_at)
            if until < 1.0:
                interpolate(s, until)
            else:
                for i in range(SIZE):
                    s[Y_AT, i] = s[Y_NEW, i]
            if body_touches(rob, s[Y_AT], previous, slope):
                if not dense:
                    prepare_dense(s, h)
                    dense = True
                body_at = body_root(rob, s, previous, slope, 0.0, until)
            if foot_at > 1.0 and body_at > 1.0:
                break
            todo -= 1
            if body_at < foot_at:
                interpolate(s, body_at)
                outcomes[todo] = _BODY
                durations[todo] = t + body_at * h
            else:
                interpolate(s, foot_at)
                fx, fy, _, _ = swing_foot(rob, s[Y_AT])
                outcomes[todo] = _land(rob, work, s, slope, after[todo])
                durations[todo] = t + foot_at * h
                if outcomes[todo] == _STEP:
                    lengths[todo] = math.hypot(fx, fy)
            energies[todo] = s[Y_AT, 10]

        if trace.shape[0] > 0:
            if not dense:
                prepare_dense(s, h)
                dense = True
            until = stop
            if todo == 0:
                until = min(stop, (durations[0] - t) / h)
            first = 0 if samples == 0 else 1
            for k in range(first, _TRACE_SAMPLES + 1):
                if samples < trace.shape[0]:
                    at = until * k / _TRACE_SAMPLES
                    trace[samples, 15], trace[samples, 16] = forces_at(
                        scheme, switched, rob, par, work, s, at
                    )
                    trace[samples, 0] = t + at * h
                    for i in range(10):
                        trace[samples, 1 + i] = s[Y_AT, i]
                    for i in range(4):
                        trace[samples, 11 + i] = work[TORQUE, i]
                    trace[samples, 17] = s[Y_AT, 10]
                    samples += 1

        if failure >= 0:
            if stop < 1.0:
                interpolate(s, stop)
                s[Y, 10] = s[Y_AT, 10]
            else:
                s[Y, 10] = s[Y_NEW, 10]
            t += stop * h
            break
        t += end * h
        x, y, dx, dy = new_x, new_y, new_dx, new_dy
        for i in range(SIZE):
            s[Y, i] = s[Y_NEW, i]
            s[STAGE, i] = s[STAGE + STAGES, i]
        h *= growth
        if switches:
            switched = not switched
            h = first_step
            end_ft, end_fn = closed_loop(scheme, switched, rob, par, work, s[Y], s[STAGE])
            end_saturated = work[TORQUE, 4]
            evaluations += 1
        start_margin, saturated = margin(rob, end_ft, end_fn), end_saturated
        if switches and since < 0.0 and not start_margin > 0.0:
            since = t
            if rob[r.SLIP_DURATION] == 0.0:
                failure = _SLIPS if end_fn > unloaded else _LIFTS
    for i in range(todo):
        outcomes[i] = failure
        durations[i] = t
        energies[i] = s[Y, 10]
    return steps, evaluations, samples


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
    durations,
    lengths,
    energies,
    following,
):
    """Simulate a swing from every state; the states after impact are packed into ``following``.

    No swing is begun after ``most_evaluations``. Returns how many states were simulated, how many
    steps succeeded, integrator steps and evaluations.
    """
    m = slopes.size
    s = np.zeros((ROWS, SIZE))
    work = np.zeros((dynamics.WORKSPACE_ROWS, 5))
    after = np.zeros((m, STATE_SIZE))
    trace = np.zeros((0, SAMPLE_COLUMNS))
    count = 0
    steps = 0
    evaluations = 0
    done = 0
    for n in range(states.shape[0]):
        if evaluations >= most_evaluations:
            break
        done += 1
        _set_state(s, states[n])
        swing_steps, swing_evaluations, _ = _swing(
            scheme,
            rob,
            par,
            previous[n],
            slopes,
            s,
            work,
            outcomes[n],
            durations[n],
            lengths[n],
            energies[n],
            after,
            trace,
        )
        steps += swing_steps
        evaluations += swing_evaluations
        for i in range(m):
            if outcomes[n, i] == _STEP:
                _to_joint(after[i], following[count])
                count += 1
    return done, count, steps, evaluations


@kernel
def _set_state(s, state):
    """Put a state ``[q, dq]`` into the scratch array, as absolute angles and rates."""
    for o in (0, 5):
        torso = state[o + 4]
        s[Y, o] = state[o] + torso
        s[Y, o + 1] = state[o + 1] + torso
        s[Y, o + 2] = s[Y, o] + state[o + 2]
        s[Y, o + 3] = s[Y, o + 1] + state[o + 3]
        s[Y, o + 4] = torso


@kernel
def _to_joint(absolute, state):
    """Absolute angles and rates as a state ``[q, dq]``."""
    for o in (0, 5):
        torso = absolute[o + 4]
        state[o] = absolute[o] - torso
        state[o + 1] = absolute[o + 1] - torso
        state[o + 2] = absolute[o + 2] - absolute[o]
        state[o + 3] = absolute[o + 3] - absolute[o + 1]
        state[o + 4] = torso


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
        s, to the impact or to the fall, shape (n, m).
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
    out = np.ascontiguousarray(states, dtype=np.float64)
    if out.ndim != 2 or out.shape[1] != STATE_SIZE:
        raise InputError(field, f"shape {out.shape}", f"shape (n, {STATE_SIZE}): q1..q5, dq1..dq5")
    bad = ~np.isfinite(out)
    if bad.any():
        n, i = np.argwhere(bad)[0]
        raise InputError(f"{field}[{n}][{i}]", float(out[n, i]), "finite rad and rad/s")
    return out


def simulate_steps(
    controller: Controller,
    states: ArrayLike,
    previous_slopes: ArrayLike,
    slopes: ArrayLike,
    model: WalkerModel | None = None,
    most_evaluations: int | None = None,
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
    previous = np.ascontiguousarray(previous_slopes, dtype=np.float64)
    n, m = states.shape[0], slopes.size
    if previous.shape != (n,):
        raise InputError("previous_slopes", f"shape {previous.shape}", f"shape ({n},), as states")
    if not (np.abs(previous) <= SLOPE_LIMIT).all():
        i = int(np.argmax(~(np.abs(previous) <= SLOPE_LIMIT)))
        raise InputError(
            f"previous_slopes[{i}]",
            float(previous[i]),
            f"finite, within {SLOPE_LIMIT:.4f} rad ({SLOPE_LIMIT_DEG:g} degrees)",
        )
    packed_model, packed_controller = model.packed(), controller.packed(model.robot)
    outcomes = np.empty((n, m), dtype=np.uint8)
    durations, lengths, energies = np.empty((n, m)), np.empty((n, m)), np.empty((n, m))
    following = np.empty((n * m, STATE_SIZE))
    start = time.perf_counter()
    done, count, steps, evaluations = _simulate(
        controller.code,
        packed_model,
        packed_controller,
        states,
        previous,
        slopes,
        _UNBOUNDED if most_evaluations is None else max(1, most_evaluations),
        outcomes,
        durations,
        lengths,
        energies,
        following,
    )
    seconds = time.perf_counter() - start
    return Steps(
        outcomes=outcomes[:done],
        next_states=following[:count].copy(),
        durations=durations[:done],
        step_lengths=lengths[:done],
        energies=energies[:done],
        seconds=seconds,
        integrator_steps=steps,
        evaluations=evaluations,
    )
