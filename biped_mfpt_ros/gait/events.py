"""Events within a step of the integrator, located on its dense output.

Times within the step are fractions of it, 0 to 1.
"""

from __future__ import annotations

import math

from biped_mfpt_ros.control import smc
from biped_mfpt_ros.gait.closed_loop import (
    beyond,
    lane_angles,
    lane_rates,
    margin,
    mode_of,
    motion,
    switch,
)
from biped_mfpt_ros.gait.integrate import state_at
from biped_mfpt_ros.gait.scratch import AT, FEET, MODE, PLACES, SPARE, SWITCHED, VALUE
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import LANES, any_lane, lane_of, load, select, splat, store
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import foot, sines

TIME_RESOLUTION = 1e-12
"""s, to which events are located."""

_NEWTON_RESOLUTION = 1e-7
"""s: what a last step of Newton's method may move to leave less than `TIME_RESOLUTION`."""
CUT_RESOLUTION = 1e-9
"""Of the torque limit: how far a torque may be beyond it before it is cut off."""


@inner_kernel
def next_guess(low, low_value, high, high_value):
    """Where a function that changes sign between two places would vanish if it were linear."""
    at = low + (high - low) * (low_value / (low_value - high_value))
    return at if low < at < high else 0.5 * (low + high)


@inner_kernel
def foot_at(rob, w, lane, at):
    """Position and velocity of the swing foot at fractions in lanes: x, y (m), dx, dy (m/s)."""
    a, da = state_at(w, lane, at)
    s, c = sines(a)
    return foot(rob, s, c, da)


@inner_kernel
def foot_once(rob, w, lane, at):
    """The same at one fraction."""
    x, y, dx, dy = foot_at(rob, w, lane, splat(at))
    return lane_of(x, 0), lane_of(y, 0), lane_of(dx, 0), lane_of(dy, 0)


@inner_kernel
def cubic_root(f0, d0, f1, d1):
    """Where the cubic with values f0 > 0 >= f1 and slopes d0, d1 at 0 and 1 vanishes, about."""
    low, high = 0.0, 1.0
    at = f0 / (f0 - f1)
    c2 = 3.0 * (f1 - f0) - 2.0 * d0 - d1
    c3 = 2.0 * (f0 - f1) + d0 + d1
    for _ in range(3):
        value = f0 + at * (d0 + at * (c2 + at * c3))
        if value > 0.0:
            low = at
        else:
            high = at
        at = at - value / (d0 + at * (2.0 * c2 + 3.0 * at * c3))
        if not low < at < high:
            at = 0.5 * (low + high)
    return at


@inner_kernel
def foot_root(rob, w, lane, nx, ny, low, high, at, span):
    """Where ``nx x + ny y`` of the swing foot falls through zero, in lanes, by a guarded Newton.

    ``low`` and ``high`` are fractions of the step, of ``span`` seconds, with a positive value at
    ``low`` and one not above zero at ``high``; ``at`` is a guess.
    """
    searching = at == at
    for _ in range(100):
        x, y, dx, dy = foot_at(rob, w, lane, at)
        value = nx * x + ny * y
        above = value > 0.0
        low = select(above, at, low)
        high = select(above, high, at)
        nearer = at - value / ((nx * dx + ny * dy) * span)
        inside = (nearer >= low) & (nearer <= high)
        nearer = select(inside, nearer, 0.5 * (low + high))
        moved = abs(nearer - at) * span
        at = select(searching, nearer, at)
        searching = searching & (moved >= select(inside, _NEWTON_RESOLUTION, TIME_RESOLUTION))
        if not any_lane(searching):
            break
    return at


@inner_kernel
def root_once(rob, w, lane, nx, ny, low, high, at, span):
    """The same for one, as a number."""
    found = foot_root(rob, w, lane, splat(nx), splat(ny), splat(low), splat(high), splat(at), span)
    return lane_of(found, 0)


@inner_kernel
def foot_lowest(rob, w, lane, nx, ny, low, high):
    """Where ``nx x + ny y`` of the swing foot is least, given that it falls, then rises."""
    for _ in range(50):
        at = 0.5 * (low + high)
        _, _, dx, dy = foot_once(rob, w, lane, at)
        if nx * dx + ny * dy < 0.0:
            low = at
        else:
            high = at
    return high


@inner_kernel
def may_dip(f0, d0, f1, d1):
    """Whether a smooth function with these values and slopes at 0 and 1 may fall to zero between.

    The cubic through them is above the least of its four control points. What the function differs
    from it is covered by 3 mm and a tenth of what they spread.
    """
    p0, p1 = f0 + d0 / 3.0, f1 - d1 / 3.0
    least = min(min(f0, p0), min(p1, f1))
    most = max(max(f0, p0), max(p1, f1))
    return not least > 3e-3 + 0.1 * (most - least)


@inner_kernel
def first_below(rob, w, lane, nx, ny, offset, low, at_low, high, at_high, parts, span):
    """Between which fractions the swing foot first comes down to ``nx x + ny y = offset``.

    ``at_low`` and ``at_high`` are the foot there, as `foot_once` gives it. The step is looked at in
    so many equal ``parts`` that within each the foot moves one way at most, and back; the foot
    between them stands in row FEET.

    Returns
    -------
    tuple of float
        Fractions before and after, and a guess; three times 2 if it does not before ``high``.
    """
    x, y, dx, dy = at_low
    f0, d0 = nx * x + ny * y - offset, (nx * dx + ny * dy) * span
    k = int(low * parts)
    while low < high:
        k += 1
        until = high
        x, y, dx, dy = at_high
        if k < parts and k < high * parts:
            until = k / parts
            i = 4 * (k - 1)
            x, y = w[FEET, i, lane], w[FEET, i + 1, lane]
            dx, dy = w[FEET, i + 2, lane], w[FEET, i + 3, lane]
        f1, d1 = nx * x + ny * y - offset, (nx * dx + ny * dy) * span
        length = until - low
        if not f1 > 0.0:
            at = low + length * cubic_root(f0, length * d0, f1, length * d1)
            return low, until, at
        if d0 < 0.0 and d1 > 0.0 and may_dip(f0, length * d0, f1, length * d1):
            at = foot_lowest(rob, w, lane, nx, ny, low, until)
            x, y, _, _ = foot_once(rob, w, lane, at)
            if not nx * x + ny * y - offset > 0.0:
                return low, at, 0.5 * (low + at)
        low, f0, d0 = until, f1, d1
    return 2.0, 2.0, 2.0


@inner_kernel
def switch_root(scheme, par, w, lane, switched, span):
    """Where the controller switches, as a fraction of the step: just on the far side."""
    low, high = 0.0, 1.0
    while (high - low) * span > TIME_RESOLUTION:
        # Five parts at once.
        width = (high - low) / (LANES + 1)
        if low + width <= low or high - width >= high:
            break
        for k in range(LANES):
            w[PLACES, AT, k] = low + (k + 1) * width
        a, _ = state_at(w, lane, load(w, PLACES, AT))
        store(w, PLACES, VALUE, switch(scheme, par, a))
        for k in range(LANES):
            if (w[PLACES, VALUE, k] > 0.0) != switched:
                low = w[PLACES, AT, k]
            else:
                high = w[PLACES, AT, k]
                break
    return high


@inner_kernel
def motion_at(scheme, rob, par, w, lane, at):
    """Motion of one lane at fractions of the step in lanes.

    Returns torques wanted and acting (N m), force on the stance foot (N).
    """
    a, da = state_at(w, lane, at)
    for i in range(5):
        store(w, SPARE, i, a[i])
        store(w, SPARE, 5 + i, da[i])
    _, wanted, applied, force, _, _ = motion(scheme, rob, par, w, SPARE, mode_of(w, lane))
    return wanted, applied, force


@inner_kernel
def first_change(scheme, rob, par, w, lane, span):
    """When the first torque reaches its limit, or leaves it, and which.

    Returns
    -------
    tuple
        Fraction of the step, the joint and whether it is held at the limit from then on: 0 or the
        sign of its torque; 2, -1 and 0 if none does. Evaluations made.
    """
    cut, _, _ = mode_of(w, lane)
    slack = CUT_RESOLUTION * rob[r.TORQUE_LIMIT]
    for k in range(LANES):
        w[PLACES, AT, k] = (k + 1) / LANES
    wanted, _, _ = motion_at(scheme, rob, par, w, lane, load(w, PLACES, AT))
    evaluations = LANES
    store(w, PLACES, VALUE, beyond(rob, cut, wanted))
    low, low_value = 0.0, -slack
    high, high_value = 0.0, -slack
    for k in range(LANES):
        low, low_value = high, high_value
        high, high_value = w[PLACES, AT, k], w[PLACES, VALUE, k]
        if not high_value <= slack:
            break
    if high_value <= slack:
        return 2.0, -1, 0.0, evaluations
    # Illinois: regula falsi, halving the value of an end that stays.
    low_value = min(low_value, -slack)
    at = high
    side = 0
    for _ in range(60):
        at = next_guess(low, low_value, high, high_value)
        wanted, _, _ = motion_at(scheme, rob, par, w, lane, splat(at))
        evaluations += 1
        value = lane_of(beyond(rob, cut, wanted), 0)
        if abs(value) <= 0.1 * slack or (high - low) * span < TIME_RESOLUTION:
            break
        if value > 0.0:
            high, high_value = at, value
            if side == 1:
                low_value *= 0.5
            side = 1
        else:
            low, low_value = at, value
            if side == -1:
                high_value *= 0.5
            side = -1
    joint, held = 0, 0.0
    farthest = -math.inf
    for i in range(4):
        torque, sign = lane_of(wanted[i], 0), lane_of(cut[i], 0)
        one = abs(torque) - rob[r.TORQUE_LIMIT]
        if sign != 0.0:
            one = rob[r.TORQUE_LIMIT] - sign * torque
        if one > farthest:
            joint, farthest = i, one
            held = 0.0
            if sign == 0.0:
                held = 1.0 if torque > 0.0 else -1.0
    return at, joint, held, evaluations


@inner_kernel
def slide_root(scheme, rob, par, w, lane, i, span):
    """Where an output begins to slide, given that it does by the end of the step.

    1 if it was about to at the start: not a crossing.
    """
    low, high = 0.0, 1.0
    low_value = _off_slide(scheme, rob, par, w, lane, i, low)
    high_value = _off_slide(scheme, rob, par, w, lane, i, high)
    if not (low_value > 0.0 and high_value <= 0.0):
        return 1.0
    while (high - low) * span > TIME_RESOLUTION:
        at = 0.5 * (low + high)
        if at <= low or at >= high:
            break
        if _off_slide(scheme, rob, par, w, lane, i, at) > 0.0:
            low = at
        else:
            high = at
    return high


@inner_kernel
def _off_slide(scheme, rob, par, w, lane, i, at):
    a, da = state_at(w, lane, splat(at))
    for k in range(5):
        store(w, SPARE, k, a[k])
        store(w, SPARE, 5 + k, da[k])
    off = smc.off_slide(
        par, i, lane_angles(w, SPARE, 0), lane_rates(w, SPARE, 0), w[MODE, SWITCHED, lane]
    )
    if off <= 0.0:
        mode = mode_of(w, lane)
        _, wanted, _, _, _, _ = motion(scheme, rob, par, w, SPARE, mode)
        if lane_of(beyond(rob, mode[0], wanted), 0) > -smc.CLEAR * rob[r.TORQUE_LIMIT]:
            off = 1.0
    return off


@inner_kernel
def force_once(scheme, rob, par, w, lane, at):
    """Force of the ground on the stance foot at one fraction: tangential, normal, N."""
    _, _, force = motion_at(scheme, rob, par, w, lane, splat(at))
    return lane_of(force[0], 0), lane_of(force[1], 0)


@inner_kernel
def slip_root(scheme, rob, par, w, lane, lifts, low, low_value, high, high_value, span):
    """When the stance foot begins (or ends) to slip: where the margin changes its sign.

    With ``lifts``, when it lifts: where the normal force does.
    """
    if (low_value > 0.0) == (high_value > 0.0):
        return low  # it had begun (or ended) with a jump, there
    side = 0
    at = high
    for _ in range(60):
        at = next_guess(low, low_value, high, high_value)
        force = force_once(scheme, rob, par, w, lane, at)
        value = force[1] if lifts else margin(rob, force)
        if abs(value) < 1e-9 * rob[r.MASS] * rob[r.GRAVITY] or (high - low) * span < 1e-10:
            break
        if (value > 0.0) == (high_value > 0.0):
            high, high_value = at, value
            if side == 1:
                low_value *= 0.5
            side = 1
        else:
            low, low_value = at, value
            if side == -1:
                high_value *= 0.5
            side = -1
    return at


@inner_kernel
def body_touches(rob, s, c, previous, slope):
    """Whether a knee, the hip or the head is below the ground; slopes as (sine, cosine)."""
    tibia, femur = rob[r.TIBIA], rob[r.FEMUR]
    knee_x, knee_y = tibia * s[2], -tibia * c[2]
    hip_x, hip_y = knee_x + femur * s[0], knee_y - femur * c[0]
    return (
        _below(knee_x, knee_y, previous, slope)
        | _below(hip_x, hip_y, previous, slope)
        | _below(hip_x - femur * s[1], hip_y + femur * c[1], previous, slope)
        | _below(hip_x - rob[r.TORSO] * s[4], hip_y + rob[r.TORSO] * c[4], previous, slope)
    )


@inner_kernel
def _below(x, y, previous, slope):
    """Whether a point is below the ground, that of the preceding slope behind the stance foot."""
    ahead = x >= 0.0
    sine = select(ahead, slope[0], previous[0])
    cosine = select(ahead, slope[1], previous[1])
    return y * cosine - x * sine <= 0.0


@inner_kernel
def body_touches_at(rob, w, lane, at, previous, slope):
    """The same at a fraction of the step."""
    a, _ = state_at(w, lane, splat(at))
    s, c = sines(a)
    behind = (splat(previous[0]), splat(previous[1]))
    ahead = (splat(slope[0]), splat(slope[1]))
    return any_lane(body_touches(rob, s, c, behind, ahead))


@inner_kernel
def body_root(rob, w, lane, previous, slope, high):
    """When a body point first goes below the ground, given that it does at ``high``."""
    low = 0.0
    for _ in range(50):
        at = 0.5 * (low + high)
        if body_touches_at(rob, w, lane, at, previous, slope):
            high = at
        else:
            low = at
    return high
