"""One step: from a state just after impact to the next one, or to a fall (eq. 23, section 2.1).

One swing, simulated down to the steepest downhill slope of a set, yields the outcome for every
slope of the set: the swing foot crosses them in order. The closed loop is integrated with the
Dormand-Prince 5(4) pair; its dense output locates impacts, switches of the controller, and slips
between the integrator's own steps.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import RK45

from biped_mfpt_ros.control import hzd, smc
from biped_mfpt_ros.control.controller import HZD, Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import dynamics, impact
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import ACC, COS, SIN, TORQUE, swing_foot
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import STATE_SIZE, WalkerModel
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT, SLOPE_LIMIT_DEG, check_slopes

# Dormand-Prince 5(4) with Shampine's quartic dense output, as scipy tabulates it.
_A, _B, _E, _P = RK45.A, RK45.B, RK45.E, RK45.P
_C = np.append(RK45.C, 1.0)

FOOT_TOLERANCE = 1e-3
"""m, how far below the ground behind a swing foot may start: states are typed in rounded."""

_CLEARANCE = 1e-9  # m, rounding of the height of a foot that stands on the ground
_TIME_RESOLUTION = 1e-12  # s, to which events are located on the dense output
_MOST_STEPS = 20_000  # integrator steps before a swing is given up
_SLIP_SAMPLES = 8  # in an integrator step that may contain a slip
_SAMPLE_COLUMNS = 18  # of a trace: t, a (5), da (5), u (4), tangential, normal force, energy

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

# Rows of the scratch array of a swing, each of SIZE numbers: angles, rates, energy.
_SIZE = STATE_SIZE + 1
_Y, _Y_NEW, _Y_AT, _AFTER, _STAGE, _DENSE = 0, 1, 2, 3, 4, 12
_SCRATCH_ROWS = _DENSE + 4


@kernel
def _closed_loop(scheme, switched, rob, par, work, y, rate):
    """Time derivative of angles, rates and energy under a controller (eq. 2, 8, 16).

    Torques beyond the limit are cut off, joint by joint.

    Returns
    -------
    tuple of float
        Force of the ground on the stance foot: tangential, normal, N.
    """
    dynamics.set_angles(work, y)
    if scheme == HZD and switched:
        for i in range(4):
            work[TORQUE, i] = 0.0
        dynamics.free_motion(rob, work, y)
        tangential, normal = dynamics.row_sum(rob, work, y)
        for i in range(4):
            work[TORQUE, i] = 0.0
    else:
        if scheme == HZD:
            hzd.command(par, work, y)
        else:
            smc.command(par, work, y, switched)
        dynamics.prescribed_motion(rob, work, y)
        tangential, normal = dynamics.row_sum(rob, work, y)
        limit = rob[r.TORQUE_LIMIT]
        saturated = False
        for i in range(4):
            if not abs(work[TORQUE, i]) <= limit:
                saturated = True
                work[TORQUE, i] = min(limit, max(-limit, work[TORQUE, i]))
        if saturated:
            u0, u1, u2, u3 = work[TORQUE, 0], work[TORQUE, 1], work[TORQUE, 2], work[TORQUE, 3]
            dynamics.free_motion(rob, work, y)
            tangential, normal = dynamics.row_sum(rob, work, y)
            work[TORQUE, 0], work[TORQUE, 1], work[TORQUE, 2], work[TORQUE, 3] = u0, u1, u2, u3
    for i in range(5):
        rate[i] = y[5 + i]
        rate[5 + i] = work[ACC, i]
    rate[10] = (
        abs(work[TORQUE, 0] * (y[5] - y[9]))
        + abs(work[TORQUE, 1] * (y[6] - y[9]))
        + abs(work[TORQUE, 2] * (y[7] - y[5]))
        + abs(work[TORQUE, 3] * (y[8] - y[6]))
    )
    return tangential, normal


@kernel
def _switch(scheme, par, y):
    """Positive before the controller's switch, negative after it."""
    if scheme == HZD:
        return hzd.switch(par, y)
    return smc.switch(par, y)


@kernel
def _interpolate(s, at, first, last):
    """Dense output at the fraction ``at`` of the step, components first to last - 1, in _Y_AT."""
    for i in range(first, last):
        s[_Y_AT, i] = s[_Y, i] + at * (
            s[_DENSE, i]
            + at * (s[_DENSE + 1, i] + at * (s[_DENSE + 2, i] + at * s[_DENSE + 3, i]))
        )


@kernel
def _foot_root(rob, s, nx, ny, offset, low, high, span):
    """Where ``nx x + ny y - offset`` of the swing foot falls through zero, by a guarded Newton.

    ``low`` and ``high`` are fractions of the step, of ``span`` seconds, with a positive value at
    ``low`` and one not above zero at ``high``.
    """
    at = 0.5 * (low + high)
    for _ in range(100):
        _interpolate(s, at, 0, 10)
        x, y, dx, dy = swing_foot(rob, s[_Y_AT])
        value = nx * x + ny * y - offset
        if value > 0.0:
            low = at
        else:
            high = at
        slope = (nx * dx + ny * dy) * span
        nearer = at - value / slope
        if not low < nearer < high:
            nearer = 0.5 * (low + high)
        if abs(nearer - at) * span < _TIME_RESOLUTION:
            return nearer
        at = nearer
    return at


@kernel
def _foot_lowest(rob, s, nx, ny, low, high):
    """Where ``nx x + ny y`` of the swing foot is least, given that it falls, then rises."""
    for _ in range(50):
        at = 0.5 * (low + high)
        _interpolate(s, at, 0, 10)
        _, _, dx, dy = swing_foot(rob, s[_Y_AT])
        if nx * dx + ny * dy < 0.0:
            low = at
        else:
            high = at
    return high


@kernel
def _switch_root(scheme, par, s, switched, high, span):
    """Where the controller switches, as a fraction of the step: just on the far side."""
    low = 0.0
    while (high - low) * span > _TIME_RESOLUTION:
        at = 0.5 * (low + high)
        if at <= low or at >= high:
            break
        _interpolate(s, at, 0, 10)
        if (_switch(scheme, par, s[_Y_AT]) > 0.0) != switched:
            low = at
        else:
            high = at
    return high


@kernel
def _body_point(rob, y, i):
    """Position of stance knee (0), hip (1), swing knee (2) or head (3), m."""
    x = rob[r.TIBIA] * math.sin(y[2])
    h = -rob[r.TIBIA] * math.cos(y[2])
    if i >= 1:
        x += rob[r.FEMUR] * math.sin(y[0])
        h -= rob[r.FEMUR] * math.cos(y[0])
    if i == 2:
        x -= rob[r.FEMUR] * math.sin(y[1])
        h += rob[r.FEMUR] * math.cos(y[1])
    elif i == 3:
        x -= rob[r.TORSO] * math.sin(y[4])
        h += rob[r.TORSO] * math.cos(y[4])
    return x, h


@kernel
def _body_touches(rob, y, previous, slope):
    """Whether a knee, the hip or the head is below the ground."""
    for i in range(4):
        x, h = _body_point(rob, y, i)
        ground = slope if x >= 0.0 else previous
        if h * math.cos(ground) - x * math.sin(ground) <= 0.0:
            return True
    return False


@kernel
def _body_root(rob, s, previous, slope, low, high):
    """When a body point first goes below the ground, given that it does at ``high``."""
    for _ in range(50):
        at = 0.5 * (low + high)
        _interpolate(s, at, 0, 10)
        if _body_touches(rob, s[_Y_AT], previous, slope):
            high = at
        else:
            low = at
    return high


@kernel
def _margin(rob, tangential, normal):
    """How far the stance foot is from slipping, N: negative slips (eq. 4)."""
    return rob[r.FRICTION] * normal - abs(tangential)


@kernel
def _forces_at(scheme, switched, rob, par, work, s, at):
    """Force on the stance foot at a fraction of the step: tangential, normal, N."""
    _interpolate(s, at, 0, 11)
    return _closed_loop(scheme, switched, rob, par, work, s[_Y_AT], s[_AFTER])


@kernel
def _slip_root(scheme, switched, rob, par, work, s, low, high, span, slips_at_high):
    """When the stance foot begins (or ends) to slip, as a fraction of the step."""
    while (high - low) * span > 1e-10:
        at = 0.5 * (low + high)
        if at <= low or at >= high:
            break
        tangential, normal = _forces_at(scheme, switched, rob, par, work, s, at)
        if (_margin(rob, tangential, normal) > 0.0) == slips_at_high:
            low = at
        else:
            high = at
    return high


@kernel
def _land(rob, work, s, slope, after):
    """Impact on a slope, from the state in _Y_AT. Returns the outcome and sets ``after``."""
    px, py, vx, vy = impact.impact(rob, work, s[_Y_AT], after)
    cosine = math.cos(slope)
    sine = math.sin(slope)
    normal = py * cosine - px * sine
    tangential = px * cosine + py * sine
    for i in range(10):
        if not math.isfinite(after[i]):
            return _NOT_FINITE
    if not normal > 0.0:
        return _PULLS
    if not abs(tangential) < rob[r.FRICTION] * normal:
        return _IMPACT_SLIPS
    if not vy * cosine - vx * sine > 0.0:
        return _NO_LIFT
    return _STEP


@kernel
def _swing(
    scheme, rob, par, previous, slopes, s, work, outcomes, durations, lengths, energies, after, trace
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
        Scratch, shape (_SCRATCH_ROWS, _SIZE); the state after impact stands in row _Y.
    work : numpy.ndarray
        Workspace of the dynamics.
    outcomes, durations, lengths, energies : numpy.ndarray
        Results, shape (m,).
    after : numpy.ndarray
        States after impact (absolute angles) where the outcome is STEP, shape (m, 10).
    trace : numpy.ndarray
        Samples of the swing, shape (k, _SAMPLE_COLUMNS); k = 0: none are wanted.

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
    tolerance = rob[r.TOLERANCE]
    first_step = 1e-3 * (tolerance / 1e-8) ** 0.2
    failure = -1

    s[_Y, 10] = 0.0
    for i in range(10):
        if not math.isfinite(s[_Y, i]):
            failure = _NOT_FINITE
    back_sin = math.sin(previous)
    back_cos = math.cos(previous)
    switched = False
    since = -1.0  # when the present slip began
    x, y, dx, dy = swing_foot(rob, s[_Y])
    height = y * back_cos - x * back_sin
    lowest = min(height, 0.0) - _CLEARANCE
    passed = False
    tangential = 0.0
    normal = 0.0
    if failure < 0:
        switched = not _switch(scheme, par, s[_Y]) > 0.0
        tangential, normal = _closed_loop(scheme, switched, rob, par, work, s[_Y], s[_STAGE])
        for i in range(10):
            if not math.isfinite(s[_STAGE, i]):
                failure = _NOT_FINITE
    if failure < 0:
        if x >= 0.0 or height < -FOOT_TOLERANCE:
            failure = _SCUFFS
        elif not normal > 0.0:
            failure = _LIFTS
        elif not _margin(rob, tangential, normal) > 0.0:
            if rob[r.SLIP_DURATION] == 0.0:
                failure = _SLIPS
            since = 0.0
        while todo > 0 and failure < 0 and _body_touches(rob, s[_Y], previous, slopes[todo - 1]):
            todo -= 1
            outcomes[todo] = _BODY
    h = first_step
    while failure < 0 and todo > 0:
        if steps >= _MOST_STEPS or t >= rob[r.TIME_LIMIT]:
            failure = _TIME
            break
        h = min(h, rob[r.TIME_LIMIT] - t + 1e-9)
        # One trial step.
        least = _margin(rob, tangential, normal)
        most = least
        least_normal = normal
        for stage in range(1, 6):
            for i in range(11):
                total = _A[stage, 0] * s[_STAGE, i]
                for k in range(1, stage):
                    total += _A[stage, k] * s[_STAGE + k, i]
                s[_Y_NEW, i] = s[_Y, i] + h * total
            ft, fn = _closed_loop(
                scheme, switched, rob, par, work, s[_Y_NEW], s[_STAGE + stage]
            )
            margin = _margin(rob, ft, fn)
            least = min(least, margin)
            most = max(most, margin)
            least_normal = min(least_normal, fn)
        for i in range(11):
            total = _B[0] * s[_STAGE, i]
            for k in range(1, 6):
                total += _B[k] * s[_STAGE + k, i]
            s[_Y_NEW, i] = s[_Y, i] + h * total
        ft, fn = _closed_loop(scheme, switched, rob, par, work, s[_Y_NEW], s[_STAGE + 6])
        margin = _margin(rob, ft, fn)
        least = min(least, margin)
        most = max(most, margin)
        least_normal = min(least_normal, fn)
        end_tangential, end_normal = ft, fn
        evaluations += 6
        error = 0.0
        for i in range(10):
            total = _E[0] * s[_STAGE, i]
            for k in range(1, 7):
                total += _E[k] * s[_STAGE + k, i]
            scale = tolerance * (1.0 + max(abs(s[_Y, i]), abs(s[_Y_NEW, i])))
            ratio = abs(h * total) / scale
            if not ratio <= error:
                error = ratio
        if not error <= 1.0:
            if h < 1e-13 or (not math.isfinite(error) and h < 1e-9):
                failure = _NOT_FINITE
                break
            h *= max(0.2, 0.9 * error**-0.2) if math.isfinite(error) else 0.1
            continue
        steps += 1
        growth = 5.0 if error < 1.9e-4 else 0.9 * error**-0.2

        for i in range(11):
            for k in range(4):
                total = _P[0, k] * s[_STAGE, i]
                for j in range(1, 7):
                    total += _P[j, k] * s[_STAGE + j, i]
                s[_DENSE + k, i] = h * total

        # The step ends early where the controller switches.
        end = 1.0
        switches = (_switch(scheme, par, s[_Y_NEW]) > 0.0) == switched
        if switches:
            end = _switch_root(scheme, par, s, switched, 1.0, h)
            _interpolate(s, end, 0, 11)
            for i in range(11):
                s[_Y_NEW, i] = s[_Y_AT, i]

        # Falls that end the swing for every slope: the first one in [0, end].
        stop = end
        uncertain = 0.25 * (most - least) + 1e-3 * rob[r.MASS] * rob[r.GRAVITY]
        if least < uncertain or least_normal <= uncertain or since >= 0.0:
            last = 0.0
            root = 0.0
            slipping = since >= 0.0
            for k in range(1, _SLIP_SAMPLES + 1):
                at = end * k / _SLIP_SAMPLES
                ft, fn = _forces_at(scheme, switched, rob, par, work, s, at)
                evaluations += 1
                now = not _margin(rob, ft, fn) > 0.0
                began = since
                if now != slipping:
                    root = _slip_root(scheme, switched, rob, par, work, s, last, at, h, now)
                    since = t + root * h if now else -1.0
                    began = since if now else began
                until = t + at * h if now else t + root * h
                slipped = now or slipping
                slipping = now
                last = at
                if slipped and began + rob[r.SLIP_DURATION] <= until:
                    stop = min(end, max(0.0, (began + rob[r.SLIP_DURATION] - t) / h))
                    failure = _SLIPS
                    break
                if not fn > 0.0:
                    stop = at
                    failure = _LIFTS
                    break
            if failure == _SLIPS:
                ft, fn = _forces_at(scheme, switched, rob, par, work, s, stop)
                if not fn > 0.0:
                    failure = _LIFTS

        new_x, new_y, new_dx, new_dy = swing_foot(rob, s[_Y_NEW])
        start_ahead = 0.0  # from where in the step the foot is ahead of the stance foot
        end_ahead = end
        end_behind = 0.0
        if x < 0.0:
            end_behind = end
            start_ahead = end
            if new_x >= 0.0:
                end_behind = _foot_root(rob, s, -1.0, 0.0, 0.0, 0.0, end, h)
                start_ahead = end_behind
            # Behind: against the ground of the preceding slope.
            _interpolate(s, end_behind, 0, 10)
            bx, by, bdx, bdy = swing_foot(rob, s[_Y_AT])
            touch = end_behind
            below = by * back_cos - bx * back_sin < lowest
            if (
                not below
                and dy * back_cos - dx * back_sin < 0.0
                and bdy * back_cos - bdx * back_sin > 0.0
            ):
                touch = _foot_lowest(rob, s, -back_sin, back_cos, 0.0, end_behind)
                _interpolate(s, touch, 0, 10)
                bx, by, bdx, bdy = swing_foot(rob, s[_Y_AT])
                below = by * back_cos - bx * back_sin < lowest
            if below:
                touch = _foot_root(rob, s, -back_sin, back_cos, lowest, 0.0, touch, h)
            elif new_x >= 0.0:
                below = not by > 0.0
            if below and touch <= stop:
                stop = touch
                failure = _BEHIND if passed else _SCUFFS
            if new_x >= 0.0:
                passed = True
        elif new_x < 0.0:
            end_ahead = _foot_root(rob, s, 1.0, 0.0, 0.0, 0.0, end, h)

        # Slopes that the foot or the body reaches in this step, the steepest first.
        low = start_ahead
        high = min(stop, end_ahead)
        body_low = 0.0
        while todo > 0:
            slope = slopes[todo - 1]
            nx = -math.sin(slope)
            ny = math.cos(slope)
            foot_at = 2.0
            if high > low:
                _interpolate(s, high, 0, 10)
                fx, fy, fdx, fdy = swing_foot(rob, s[_Y_AT])
                if nx * fx + ny * fy <= 0.0:
                    foot_at = _foot_root(rob, s, nx, ny, 0.0, low, high, h)
                elif nx * fdx + ny * fdy > 0.0:
                    _interpolate(s, low, 0, 10)
                    _, _, gdx, gdy = swing_foot(rob, s[_Y_AT])
                    if nx * gdx + ny * gdy < 0.0:
                        dip = _foot_lowest(rob, s, nx, ny, low, high)
                        _interpolate(s, dip, 0, 10)
                        fx, fy, _, _ = swing_foot(rob, s[_Y_AT])
                        if nx * fx + ny * fy <= 0.0:
                            foot_at = _foot_root(rob, s, nx, ny, 0.0, low, dip, h)
            body_at = 2.0
            until = min(stop, foot_at)
            _interpolate(s, until, 0, 10)
            if _body_touches(rob, s[_Y_AT], previous, slope):
                body_at = _body_root(rob, s, previous, slope, body_low, until)
            if foot_at > 1.0 and body_at > 1.0:
                break
            todo -= 1
            if body_at < foot_at:
                _interpolate(s, body_at, 0, 11)
                outcomes[todo] = _BODY
                durations[todo] = t + body_at * h
                body_low = body_at
            else:
                _interpolate(s, foot_at, 0, 11)
                fx, fy, _, _ = swing_foot(rob, s[_Y_AT])
                outcomes[todo] = _land(rob, work, s, slope, after[todo])
                durations[todo] = t + foot_at * h
                if outcomes[todo] == _STEP:
                    lengths[todo] = math.hypot(fx, fy)
                low = foot_at
            energies[todo] = s[_Y_AT, 10]

        if trace.shape[0] > 0:
            until = stop
            if todo == 0 and m > 0:
                until = min(stop, (durations[0] - t) / h)
            parts = 4 if samples > 0 else 5
            for k in range(parts):
                if samples < trace.shape[0]:
                    at = until * (k + 5 - parts) / 4.0
                    ft, fn = _forces_at(scheme, switched, rob, par, work, s, at)
                    trace[samples, 0] = t + at * h
                    for i in range(10):
                        trace[samples, 1 + i] = s[_Y_AT, i]
                    for i in range(4):
                        trace[samples, 11 + i] = work[TORQUE, i]
                    trace[samples, 15] = ft
                    trace[samples, 16] = fn
                    trace[samples, 17] = s[_Y_AT, 10]
                    samples += 1

        if failure >= 0:
            _interpolate(s, stop, 0, 11)
            s[_Y, 10] = s[_Y_AT, 10]
            t += stop * h
            break
        t += end * h
        x, y, dx, dy = new_x, new_y, new_dx, new_dy
        for i in range(11):
            s[_Y, i] = s[_Y_NEW, i]
        if switches:
            switched = not switched
            h = min(h, first_step)
            tangential, normal = _closed_loop(scheme, switched, rob, par, work, s[_Y], s[_STAGE])
            evaluations += 1
            if since < 0.0 and not _margin(rob, tangential, normal) > 0.0:
                since = t
                if rob[r.SLIP_DURATION] == 0.0:
                    failure = _SLIPS if normal > 0.0 else _LIFTS
        else:
            tangential, normal = end_tangential, end_normal
            for i in range(11):
                s[_STAGE, i] = s[_STAGE + 6, i]
            h *= growth
    for i in range(todo):
        outcomes[i] = failure
        durations[i] = t
        energies[i] = s[_Y, 10]
    return steps, evaluations, samples


@kernel
def _simulate(
    scheme, rob, par, states, previous, slopes, outcomes, durations, lengths, energies, following
):
    """Simulate a swing from every state; the states after impact are packed into ``following``."""
    m = slopes.size
    s = np.zeros((_SCRATCH_ROWS, _SIZE))
    work = np.zeros((dynamics.WORKSPACE_ROWS, 5))
    after = np.zeros((m, STATE_SIZE))
    trace = np.zeros((0, _SAMPLE_COLUMNS))
    count = 0
    steps = 0
    evaluations = 0
    for n in range(states.shape[0]):
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
                for o in (0, 5):
                    torso = after[i, o + 4]
                    following[count, o] = after[i, o] - torso
                    following[count, o + 1] = after[i, o + 1] - torso
                    following[count, o + 2] = after[i, o + 2] - after[i, o]
                    following[count, o + 3] = after[i, o + 3] - after[i, o + 1]
                    following[count, o + 4] = torso
                count += 1
    return count, steps, evaluations


@kernel
def _set_state(s, state):
    """Put a state ``[q, dq]`` into the scratch array, as absolute angles and rates."""
    for o in (0, 5):
        torso = state[o + 4]
        s[_Y, o] = state[o] + torso
        s[_Y, o + 1] = state[o + 1] + torso
        s[_Y, o + 2] = s[_Y, o] + state[o + 2]
        s[_Y, o + 3] = s[_Y, o + 1] + state[o + 3]
        s[_Y, o + 4] = torso


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
    """Check states: shape (n, 10), finite. Returns them as contiguous float64; raises InputError."""
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

    Returns
    -------
    Steps
        Outcomes. A fall is a code, never an error.

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
    count, steps, evaluations = _simulate(
        controller.code,
        packed_model,
        packed_controller,
        states,
        previous,
        slopes,
        outcomes,
        durations,
        lengths,
        energies,
        following,
    )
    seconds = time.perf_counter() - start
    return Steps(
        outcomes, following[:count].copy(), durations, lengths, energies, seconds, steps, evaluations
    )
