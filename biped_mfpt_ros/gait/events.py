"""Events within a step of the integrator, located on its dense output.

Times within the step are fractions of it, 0 to 1.
"""

from __future__ import annotations

import math

import numpy as np

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
from biped_mfpt_ros.gait.scratch import (
    AT,
    CUT,
    FEET,
    IMPACTS,
    MODE,
    PLACES,
    SPARE,
    SWITCHED,
    TRIED,
    TRIED_VALUE,
    VALUE,
)
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import LANES, any_lane, lane_of, load, load_from, select, splat, store
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import foot, sines

TIME_RESOLUTION = 1e-12
"""s, to which events are located."""

_NEWTON_RESOLUTION = 1e-7
"""s: what a last step of Newton's method may move to leave less than `TIME_RESOLUTION`."""
CUT_RESOLUTION = 1e-9
"""Of the torque limit: how far a torque may be beyond it before it is cut off."""
TORQUES, SLIP, LIFT = range(3)
"""What changes its sign: torques beyond their limits, the margin against slipping, the load."""
TRIED_AT_ONCE = 4
"""Places in a step; where there are more lanes, the others repeat the last one."""
_MOST_ROUNDS = 60
FOOT_PARTS = 8
"""Of a step, at most, at the ends of which the swing foot is looked at."""
_OFF_CUBIC = 3e-4
"""m: what the height of the foot differs from a cubic within 10 ms, at most."""
_LOWEST_RESOLUTION = 1e-7  # s
_COUNT = np.minimum(np.arange(1.0, FOOT_PARTS + LANES), FOOT_PARTS)[None]


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
    low, high = 0.0 * f0, 0.0 * f0 + 1.0
    at = f0 / (f0 - f1)
    c2 = 3.0 * (f1 - f0) - 2.0 * d0 - d1
    c3 = 2.0 * (f0 - f1) + d0 + d1
    for _ in range(3):
        value = f0 + at * (d0 + at * (c2 + at * c3))
        above = value > 0.0
        low = select(above, at, low)
        high = select(above, high, at)
        at = at - value / (d0 + at * (2.0 * c2 + 3.0 * at * c3))
        at = select((at > low) & (at < high), at, 0.5 * (low + high))
    return at


@inner_kernel
def foot_root(rob, w, lane, nx, ny, low, high, at, searching, span):
    """Where ``nx x + ny y`` of the swing foot falls through zero, in lanes, by a guarded Newton.

    ``low`` and ``high`` are fractions of the step, of ``span`` seconds, with a positive value at
    ``low`` and one not above zero at ``high``; ``at`` is a guess. Not all lanes need be searched.

    Returns
    -------
    tuple
        A fraction next to it and how far it is from there, by a last step of Newton's method; at
        the fraction: angles and rates, sines and cosines of the angles, position of the foot (m).
    """
    a, da = state_at(w, lane, at)
    s, c = sines(a)
    x, y, dx, dy = foot(rob, s, c, da)
    away = 0.0 * at
    for _ in range(100):
        value = nx * x + ny * y
        above = value > 0.0
        low = select(above, at, low)
        high = select(above, high, at)
        nearer = at - value / ((nx * dx + ny * dy) * span)
        inside = (nearer >= low) & (nearer <= high)
        nearer = select(inside, nearer, 0.5 * (low + high))
        away = nearer - at
        searching = searching & (
            abs(away) * span >= select(inside, _NEWTON_RESOLUTION, TIME_RESOLUTION)
        )
        if not any_lane(searching):
            break
        at = select(searching, nearer, at)
        a, da = state_at(w, lane, at)
        s, c = sines(a)
        x, y, dx, dy = foot(rob, s, c, da)
    return at, away, a, da, s, c, x, y


@inner_kernel
def root_once(rob, w, lane, nx, ny, low, high, at, span):
    """The same for one, as a number."""
    one = splat(at)
    found, away, _, _, _, _, _, _ = foot_root(
        rob, w, lane, splat(nx), splat(ny), splat(low), splat(high), one, one == one, span
    )
    return lane_of(found + away, 0)


@inner_kernel
def foot_lowest(rob, w, lane, nx, ny, low, high, span):
    """Where ``nx x + ny y`` of the swing foot is least, in lanes, given that it falls, then rises.

    Also how much that is, m: to some 1e-12, as it changes with the square of what the place is off.
    """
    while any_lane((high - low) * span > _LOWEST_RESOLUTION):
        at = 0.5 * (low + high)
        _, _, dx, dy = foot_at(rob, w, lane, at)
        falls = nx * dx + ny * dy < 0.0
        low = select(falls, at, low)
        high = select(falls, high, at)
    x, y, _, _ = foot_at(rob, w, lane, high)
    return high, nx * x + ny * y


@inner_kernel
def may_dip(f0, d0, f1, d1, slack):
    """Whether a smooth function with these values and slopes at 0 and 1 may fall to zero between.

    The cubic through them is above the least of its four control points. What the function differs
    from it is covered by ``slack`` and a tenth of what they spread.
    """
    p0, p1 = f0 + d0 / 3.0, f1 - d1 / 3.0
    p0_first, f1_first = p0 < f0, f1 < p1
    least, most = select(p0_first, p0, f0), select(p0_first, f0, p0)
    low, high = select(f1_first, f1, p1), select(f1_first, p1, f1)
    least, most = select(low < least, low, least), select(high > most, high, most)
    return least <= slack + 0.1 * (most - least)


@inner_kernel
def place_feet(rob, w, lane, end, parts):
    """Put the swing foot between equal parts of the step up to ``end`` into the row FEET."""
    for n in range(0, parts - 1, LANES):
        x, y, dx, dy = foot_at(rob, w, lane, (end / parts) * load_from(_COUNT, 0, n))
        i = 4 * (n // LANES)
        store(w, FEET, i, x)
        store(w, FEET, i + 1, y)
        store(w, FEET, i + 2, dx)
        store(w, FEET, i + 3, dy)


@inner_kernel
def first_below(rob, w, lane, nx, ny, offset, low, at_low, high, at_high, end, parts, span):
    """Between which fractions of a step the swing foot first comes down to a line, in lanes.

    The line is ``nx x + ny y = offset``; ``at_low`` and ``at_high`` are the foot there, as
    `foot_once` gives it. Within each of the parts of `place_feet` it moves one way at most, and
    back.

    Returns
    -------
    tuple
        Fractions before and after, and a guess; three times 2 where it does not before ``high``.
    """
    x, y, dx, dy = at_low
    f0, d0 = nx * x + ny * y - offset, (nx * dx + ny * dy) * span
    before = 0.0 * nx + 2.0
    after, guess = before, before
    searching = before > 1.0
    k = 0
    while low < high and any_lane(searching):
        k += 1
        until = (end / parts) * k
        if until <= low and k < parts:
            continue
        x, y, dx, dy = at_high
        if until < high and k < parts:
            i, n = 4 * ((k - 1) // LANES), (k - 1) % LANES
            x, y, dx, dy = w[FEET, i, n], w[FEET, i + 1, n], w[FEET, i + 2, n], w[FEET, i + 3, n]
        else:
            until = high
        f1, d1 = nx * x + ny * y - offset, (nx * dx + ny * dy) * span
        length = until - low
        arrives = searching & (f1 <= 0.0)
        if any_lane(arrives):
            at = low + length * cubic_root(f0, length * d0, f1, length * d1)
            before = select(arrives, low, before)
            after = select(arrives, until, after)
            guess = select(arrives, at, guess)
            searching = searching & (f1 > 0.0)
        dips = searching & (d0 < 0.0) & (d1 > 0.0)
        if any_lane(dips):
            dips = dips & may_dip(f0, length * d0, f1, length * d1, _OFF_CUBIC)
            if any_lane(dips):
                at, least = foot_lowest(rob, w, lane, nx, ny, splat(low), splat(until), span)
                arrives = dips & (least <= offset)
                before = select(arrives, low, before)
                after = select(arrives, at, after)
                guess = select(arrives, 0.5 * (low + at), guess)
                searching = searching & (guess > 1.0)
        low, f0, d0 = until, f1, d1
    return before, after, guess


@inner_kernel
def switch_root(scheme, par, w, lane, switched, span):
    """Where the controller switches, as a fraction of the step: just on the far side."""
    low, high = 0.0, 1.0
    while (high - low) * span > TIME_RESOLUTION:
        # Five parts at once.
        width = (high - low) / (TRIED_AT_ONCE + 1)
        if low + width <= low or high - width >= high:
            break
        for k in range(LANES):
            w[PLACES, AT, k] = low + (min(k, TRIED_AT_ONCE - 1) + 1) * width
        a, _ = state_at(w, lane, load(w, PLACES, AT))
        store(w, PLACES, VALUE, switch(scheme, par, a))
        for k in range(TRIED_AT_ONCE):
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
def _inverse_cubic(t, f, i):
    """Where the inverse cubic through four points from the i-th vanishes, by Neville's scheme.

    Also how far the parabolas through the first three and the last three are apart there. Not a
    number where the values do not ascend.
    """
    t0, t1, t2, t3 = t[i], t[i + 1], t[i + 2], t[i + 3]
    f0, f1, f2, f3 = f[i], f[i + 1], f[i + 2], f[i + 3]
    if not f0 < f1 < f2 < f3:
        return math.nan, math.nan
    t0 = (t0 * f1 - t1 * f0) / (f1 - f0)
    t1 = (t1 * f2 - t2 * f1) / (f2 - f1)
    t2 = (t2 * f3 - t3 * f2) / (f3 - f2)
    t0 = (t0 * f2 - t1 * f0) / (f2 - f0)
    t1 = (t1 * f3 - t2 * f1) / (f3 - f1)
    return (t0 * f3 - t1 * f0) / (f3 - f0), abs(t1 - t0)


@inner_kernel
def _narrow(t, f, first):
    """What six points, from the ``first`` on, with ascending ``t``, tell of where ``f`` vanishes.

    Returns
    -------
    tuple
        The points before and after, (t, f) each; where it vanishes, about, and how far from there
        that may be; four places to try next.
    """
    j = first + 1
    while j < 5 and not f[j] > 0.0:
        j += 1
    low, high = (t[j - 1], f[j - 1]), (t[j], f[j])
    at, apart = _inverse_cubic(t, f, min(max(j - 2, first), 2))
    about = 0.1 * apart
    if not low[0] < at < high[0]:
        at = next_guess(low[0], low[1], high[0], high[1])
        about = 0.1 * (high[0] - low[0])
    left = at - min(max(about, 1e-13), 0.5 * (at - low[0]))
    right = at + min(max(about, 1e-13), 0.5 * (high[0] - at))
    # One more place makes sure that no large part is left, whatever the function is like.
    if at - low[0] > high[0] - at:
        return low, high, at, about, (0.5 * (low[0] + left), left, at, right)
    return low, high, at, about, (left, at, right, 0.5 * (right + high[0]))


@inner_kernel
def _crossing(scheme, rob, par, w, lane, what, low, high, places, enough, span):
    """Where a function of the motion changes its sign between two fractions of the step.

    Four places are tried at once, about where the inverse cubic through those before vanishes: two
    rounds mostly.

    Parameters
    ----------
    scheme, rob, par, w, lane
        As for `motion_at`.
    what : int
        `TORQUES`: how far torques are beyond their limits; `SLIP`: the margin against slipping;
        `LIFT`: the normal force.
    low, high : tuple of float
        Two fractions with the values there, of different sign.
    places : tuple of float
        Four fractions between them to begin with, ascending.
    enough : float
        Value that passes for zero.
    span : float
        s, length of the step.

    Returns
    -------
    tuple
        The fraction; in which lane of row IMPACTS the nearest one tried stands, with the torques
        wanted there in its first columns; evaluations made.
    """
    cut, _, _ = mode_of(w, lane)
    sign = 1.0 if high[1] > low[1] else -1.0
    low, high = (low[0], sign * low[1]), (high[0], sign * high[1])
    at = high[0]
    nearest = 0
    evaluations = 0
    for _ in range(_MOST_ROUNDS):
        for n in range(LANES):
            w[IMPACTS, TRIED, n] = places[min(n, TRIED_AT_ONCE - 1)]
        wanted, _, force = motion_at(scheme, rob, par, w, lane, load(w, IMPACTS, TRIED))
        evaluations += TRIED_AT_ONCE
        for n in range(4):
            store(w, IMPACTS, n, wanted[n])
        if what == TORQUES:
            store(w, IMPACTS, TRIED_VALUE, sign * beyond(rob, cut, wanted))
        elif what == SLIP:
            store(w, IMPACTS, TRIED_VALUE, sign * margin(rob, force))
        else:
            store(w, IMPACTS, TRIED_VALUE, sign * force[1])
        nearest = 0
        for n in range(1, TRIED_AT_ONCE):
            if abs(w[IMPACTS, TRIED_VALUE, n]) < abs(w[IMPACTS, TRIED_VALUE, nearest]):
                nearest = n
        at = w[IMPACTS, TRIED, nearest]
        if abs(w[IMPACTS, TRIED_VALUE, nearest]) <= enough:
            break
        values = (
            low[1],
            w[IMPACTS, TRIED_VALUE, 0],
            w[IMPACTS, TRIED_VALUE, 1],
            w[IMPACTS, TRIED_VALUE, 2],
            w[IMPACTS, TRIED_VALUE, 3],
            high[1],
        )
        t = (low[0], places[0], places[1], places[2], places[3], high[0])
        low, high, at, about, places = _narrow(t, values, 0)
        if about * span < TIME_RESOLUTION:
            break
    return at, nearest, evaluations


@inner_kernel
def first_change(scheme, rob, par, w, lane, start, span):
    """When the first torque reaches its limit, or leaves it, and which.

    ``start`` is how far torques are beyond their limits at the start of the step, N m.

    Returns
    -------
    tuple
        Fraction of the step, the joint and whether it is held at the limit from then on: 0 or the
        sign of its torque; 2, -1 and 0 if none does. Evaluations made.
    """
    cut, _, _ = mode_of(w, lane)
    slack = CUT_RESOLUTION * rob[r.TORQUE_LIMIT]
    for n in range(LANES):
        w[PLACES, AT, n] = min((n + 1) / TRIED_AT_ONCE, 1.0)
    wanted, _, _ = motion_at(scheme, rob, par, w, lane, load(w, PLACES, AT))
    store(w, PLACES, VALUE, beyond(rob, cut, wanted))
    f0, f1 = w[PLACES, VALUE, 0], w[PLACES, VALUE, 1]
    f2, f3 = w[PLACES, VALUE, 2], w[PLACES, VALUE, 3]
    if f0 <= slack and f1 <= slack and f2 <= slack and f3 <= slack:
        return 2.0, -1, 0.0, TRIED_AT_ONCE
    # What is at the limit, to rounding, is not beyond it yet.
    f0, f1, f2 = f0 - slack, f1 - slack, f2 - slack
    values = (-math.inf, min(start, 0.0) - slack, f0, f1, f2, f3)
    low, high, _, _, places = _narrow((0.0, 0.0, 0.25, 0.5, 0.75, 1.0), values, 1)
    low, high = (low[0], min(low[1] + slack, -slack)), (high[0], high[1] + slack)
    at, nearest, evaluations = _crossing(
        scheme, rob, par, w, lane, TORQUES, low, high, places, 0.1 * slack, span
    )
    joint, held = 0, 0.0
    farthest = -math.inf
    for i in range(4):
        torque, sign = w[IMPACTS, i, nearest], w[MODE, CUT + i, lane]
        one = abs(torque) - rob[r.TORQUE_LIMIT]
        if sign != 0.0:
            one = rob[r.TORQUE_LIMIT] - sign * torque
        if one > farthest:
            joint, farthest = i, one
            held = 0.0
            if sign == 0.0:
                held = 1.0 if torque > 0.0 else -1.0
    return at, joint, held, TRIED_AT_ONCE + evaluations


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
def slip_root(scheme, rob, par, w, lane, what, low, low_value, high, high_value, span):
    """When the stance foot begins or ends to slip, or lifts: a fraction, and evaluations made.

    ``what`` is `SLIP` or `LIFT`.
    """
    if (low_value > 0.0) == (high_value > 0.0):
        return low, 0  # it had begun (or ended) with a jump, there
    enough = 1e-9 * rob[r.MASS] * rob[r.GRAVITY]
    part = (high - low) / (TRIED_AT_ONCE + 1)
    places = (low + part, low + 2.0 * part, low + 3.0 * part, low + 4.0 * part)
    at, _, evaluations = _crossing(
        scheme,
        rob,
        par,
        w,
        lane,
        what,
        (low, low_value),
        (high, high_value),
        places,
        enough,
        span,
    )
    return at, evaluations


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
