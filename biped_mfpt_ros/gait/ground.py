"""Where the swing foot and the body meet the ground within a step of the integrator, and impacts.

The ground ahead is a set of slopes; the swing foot crosses them in order, the steepest first. Each
is decided by itself, so that what happens on it does not depend on the others, but as many at once
as there are lanes. Their impacts are computed when the swing has ended.

Times within the step are fractions of it, 0 to 1.
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.gait.closed_loop import lane_angles, lane_rates
from biped_mfpt_ros.gait.energy import energy_at
from biped_mfpt_ros.gait.integrate import interpolated_slope, state_at
from biped_mfpt_ros.gait.scratch import (
    ANGLES,
    BACK_COS,
    BACK_SIN,
    COSINE,
    DURATION,
    END,
    END_DX,
    END_DY,
    END_X,
    END_Y,
    FEET,
    FOOT_DX,
    FOOT_DY,
    FOOT_X,
    FOOT_Y,
    LENGTH,
    LOWEST,
    MODE,
    OUTCOME,
    PASSED,
    RATES,
    SINE,
    SPENT,
    TIME,
    TODO,
    TRIG,
    H,
)
from biped_mfpt_ros.jit import inlined_kernel, inner_kernel
from biped_mfpt_ros.lanes import (
    LANES,
    any_lane,
    lane_of,
    load_from,
    select,
    splat,
    store,
    store_into,
)
from biped_mfpt_ros.walker import impact
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import foot, sine_cosine, sines
from biped_mfpt_ros.walker.outcome import Outcome

FOOT_PARTS = 8
"""Of a step, at most, between which the swing foot is looked at."""
FOOT_INTERVAL = 0.01
"""s: the foot moves one way at most within it, and back."""
_OFF_CUBIC = 3e-4  # m: what the height of the foot differs from a cubic within it, at most
_LOWEST_RESOLUTION = 1e-7  # s
_ROOT_RESOLUTION = 1e-12  # s
_NEWTON_RESOLUTION = 1e-7  # s: what Newton's method may move to leave less than that
_COUNT = np.arange(1.0, FOOT_PARTS + 1)[None]

_STEP = float(Outcome.STEP)
_SCUFFS = int(Outcome.SWING_SCUFFS)
_BEHIND = int(Outcome.FOOT_BEHIND)
_PULLS = float(Outcome.IMPACT_PULLS)
_IMPACT_SLIPS = float(Outcome.IMPACT_SLIPS)
_NO_LIFT = float(Outcome.NO_LIFT_OFF)
_BODY = float(Outcome.BODY_TOUCHES)
_NOT_FINITE = float(Outcome.NOT_FINITE)
_LANDS = 254.0  # the outcome of the impact is not computed yet


@inner_kernel
def slopes_ahead(slopes, ahead):
    """Put ascending slopes, rad, shape (m,), into the rows SINE and COSINE of ``ahead``.

    The steepest up comes first, the last one LANES times more.
    """
    m = slopes.size
    for i in range(m):
        ahead[SINE, i], ahead[COSINE, i] = sine_cosine(slopes[m - 1 - i])
    ahead[SINE, m:], ahead[COSINE, m:] = ahead[SINE, m - 1], ahead[COSINE, m - 1]


@inner_kernel
def meet_ground(rob, w, v, lane, ahead, end, stop, failure):
    """Where the swing foot and the body meet the ground before ``stop``.

    Decides the slopes that are reached, and returns where the step stops and the outcome of all
    others, which is ``failure`` if the foot does not come down behind.
    """
    h = w[MODE, H, lane]
    parts = min(FOOT_PARTS, int(end * h / FOOT_INTERVAL) + 1)
    _place_feet(rob, w, lane, end, parts)
    at_start = (v[FOOT_X, lane], v[FOOT_Y, lane], v[FOOT_DX, lane], v[FOOT_DY, lane])
    at_end = (v[END_X, lane], v[END_Y, lane], v[END_DX, lane], v[END_DY, lane])
    back = (v[BACK_SIN, lane], v[BACK_COS, lane])
    low, at_low = 0.0, at_start  # the foot is ahead of the stance foot from low to high
    high = end
    if at_start[0] < 0.0:
        low, at_low = end, at_end
        if at_end[0] >= 0.0:
            low = _passing(rob, w, lane, -1.0, at_start, at_end, end, h)
            at_low = _foot_once(rob, w, lane, low)
        # Behind the stance foot: against the ground of the preceding slope.
        nx, ny, lowest = -back[0], back[1], v[LOWEST, lane]
        before, after, guess = _first_below(
            rob, w, lane, splat(nx), splat(ny), lowest, 0.0, at_start, low, at_low, end, parts, h
        )
        touch = lane_of(guess, 0)
        if touch <= 1.0:
            first, last = lane_of(before, 0), lane_of(after, 0)
            touch = _root_once(rob, w, lane, nx, ny, lowest, first, last, touch, h)
        elif at_end[0] >= 0.0 and not at_low[1] > 0.0:
            touch = low
        if touch <= stop:
            stop = touch
            failure = _BEHIND if v[PASSED, lane] != 0.0 else _SCUFFS
        if at_end[0] >= 0.0:
            v[PASSED, lane] = 1.0
    elif at_end[0] < 0.0:
        high = _passing(rob, w, lane, 1.0, at_start, at_end, end, h)
    high = min(stop, high)
    at_high = at_end if high == end else _foot_once(rob, w, lane, high)

    m = ahead.shape[1] - LANES
    i = m - int(v[TODO, lane])
    reached = LANES
    while reached == LANES and i < m and low < high:
        sine, cosine = load_from(ahead, SINE, i), load_from(ahead, COSINE, i)
        before, after, guess = _first_below(
            rob, w, lane, -sine, cosine, 0.0, low, at_low, high, at_high, end, parts, h
        )
        reached = 0
        while reached < LANES and lane_of(guess, reached) <= 1.0:
            reached += 1
        if reached > 0:
            touches = _land(rob, w, v, lane, ahead, i, before, after, guess, h)
            for k in range(i, min(m, i + reached)):
                if touches and ahead[OUTCOME, k] == _BODY:
                    at = (ahead[DURATION, k] - v[TIME, lane]) / h
                    _body_lands(rob, w, v, lane, ahead, k, at, h)
            i = min(m, i + reached)
    # Slopes that the body reaches before the foot.
    while i < m:
        slope = (ahead[SINE, i], ahead[COSINE, i])
        if stop == end:
            s, c = lane_angles(w, END, lane), lane_rates(w, END, lane)  # stand there
            touches = body_touches(rob, s, c, back, slope)
        else:
            touches = _body_touches_at(rob, w, lane, stop, back, slope)
        if not touches:
            break
        _body_lands(rob, w, v, lane, ahead, i, stop, h)
        i += 1
    v[TODO, lane] = m - i
    return stop, failure


@inner_kernel
def _passing(rob, w, lane, side, at_start, at_end, end, h):
    """When the swing foot passes the stance foot, from ``side`` of it (1: from ahead)."""
    f0, f1 = side * at_start[0], side * at_end[0]
    d0, d1 = side * at_start[2] * end * h, side * at_end[2] * end * h
    guess = end * _cubic_root(f0, d0, f1, d1)
    return _root_once(rob, w, lane, side, 0.0, 0.0, 0.0, end, guess, h)


@inner_kernel
def _body_lands(rob, w, v, lane, ahead, i, at, h):
    """The body touches the ground of a slope, at the fraction ``at`` or before."""
    back = (v[BACK_SIN, lane], v[BACK_COS, lane])
    at = _body_root(rob, w, lane, back, (ahead[SINE, i], ahead[COSINE, i]), at)
    ahead[OUTCOME, i] = _BODY
    ahead[DURATION, i] = v[TIME, lane] + at * h
    ahead[LENGTH, i] = 0.0
    ahead[SPENT, i] = lane_of(energy_at(w, v, lane, splat(at)), 0)


@inner_kernel
def _land(rob, w, v, lane, ahead, i, low, high, guess, h):
    """The motion just before impacts, on slopes from the i-th on where ``guess`` is at most 1.

    Returns whether the body touches the ground in any of them.
    """
    sine, cosine = load_from(ahead, SINE, i), load_from(ahead, COSINE, i)
    searching = guess <= 1.0
    guess = select(searching, guess, 0.5)
    at, away, a, da, s, c = _foot_root(
        rob, w, lane, -sine, cosine, 0.0, low, high, guess, searching, h
    )
    # There by first order: the motion is not evaluated again.
    a, da, s, c = _moved(w, lane, at, away, a, da, s, c, h)
    at = at + away
    x, y, _, _ = foot(rob, s, c, da)
    touches = searching & body_touches(
        rob, s, c, (splat(v[BACK_SIN, lane]), splat(v[BACK_COS, lane])), (sine, cosine)
    )
    store_into(ahead, OUTCOME, i, select(touches, _BODY, 0.0 * at + _LANDS))
    store_into(ahead, DURATION, i, v[TIME, lane] + at * h)
    store_into(ahead, LENGTH, i, math.sqrt(x * x + y * y))
    store_into(ahead, SPENT, i, energy_at(w, v, lane, at))
    for k in range(5):
        store_into(ahead, ANGLES + k, i, a[k])
        store_into(ahead, RATES + k, i, da[k])
        store_into(ahead, TRIG + k, i, s[k])
        store_into(ahead, TRIG + 5 + k, i, c[k])
    return any_lane(touches)


@inlined_kernel
def _moved(w, lane, at, away, a, da, s, c, h):
    """Angles, rates, sines and cosines a little ``away`` from where they are, at ``at``."""
    t = away * h
    d = (t * da[0], t * da[1], t * da[2], t * da[3], t * da[4])
    return (
        (a[0] + d[0], a[1] + d[1], a[2] + d[2], a[3] + d[3], a[4] + d[4]),
        (
            da[0] + away * interpolated_slope(w, lane, 5, at),
            da[1] + away * interpolated_slope(w, lane, 6, at),
            da[2] + away * interpolated_slope(w, lane, 7, at),
            da[3] + away * interpolated_slope(w, lane, 8, at),
            da[4] + away * interpolated_slope(w, lane, 9, at),
        ),
        (
            s[0] + d[0] * c[0],
            s[1] + d[1] * c[1],
            s[2] + d[2] * c[2],
            s[3] + d[3] * c[3],
            s[4] + d[4] * c[4],
        ),
        (
            c[0] - d[0] * s[0],
            c[1] - d[1] * s[1],
            c[2] - d[2] * s[2],
            c[3] - d[3] * s[3],
            c[4] - d[4] * s[4],
        ),
    )


@inlined_kernel
def _foot_at(rob, w, lane, at):
    """Position and velocity of the swing foot at fractions in lanes: x, y (m), dx, dy (m/s)."""
    a, da = state_at(w, lane, at)
    s, c = sines(a)
    return foot(rob, s, c, da)


@inner_kernel
def _foot_once(rob, w, lane, at):
    """The same at one fraction."""
    x, y, dx, dy = _foot_at(rob, w, lane, splat(at))
    return lane_of(x, 0), lane_of(y, 0), lane_of(dx, 0), lane_of(dy, 0)


@inner_kernel
def _cubic_root(f0, d0, f1, d1):
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
def _foot_root(rob, w, lane, nx, ny, offset, low, high, at, searching, span):
    """Where the swing foot falls through ``nx x + ny y = offset``, in lanes, by a guarded Newton.

    ``low`` and ``high`` are fractions of the step, of ``span`` seconds, with the foot above at
    ``low`` and not above at ``high``; ``at`` is a guess. Not all lanes need be searched.

    Returns
    -------
    tuple
        A fraction next to it and how far it is from there, by a last step of Newton's method; at
        the fraction: angles and rates, sines and cosines of the angles.
    """
    a, da = state_at(w, lane, at)
    s, c = sines(a)
    x, y, dx, dy = foot(rob, s, c, da)
    away = 0.0 * at
    for _ in range(100):
        value = nx * x + ny * y - offset
        above = value > 0.0
        low = select(above, at, low)
        high = select(above, high, at)
        nearer = at - value / ((nx * dx + ny * dy) * span)
        inside = (nearer >= low) & (nearer <= high)
        nearer = select(inside, nearer, 0.5 * (low + high))
        away = nearer - at
        searching = searching & (
            abs(away) * span >= select(inside, _NEWTON_RESOLUTION, _ROOT_RESOLUTION)
        )
        if not any_lane(searching):
            break
        at = select(searching, nearer, at)
        a, da = state_at(w, lane, at)
        s, c = sines(a)
        x, y, dx, dy = foot(rob, s, c, da)
    return at, away, a, da, s, c


@inner_kernel
def _root_once(rob, w, lane, nx, ny, offset, low, high, at, span):
    """The same for one, as a number."""
    one = splat(at)
    found, away, _, _, _, _ = _foot_root(
        rob, w, lane, splat(nx), splat(ny), offset, splat(low), splat(high), one, one == one, span
    )
    return lane_of(found + away, 0)


@inner_kernel
def _foot_lowest(rob, w, lane, nx, ny, low, high, span):
    """Where ``nx x + ny y`` of the swing foot is least, in lanes, given that it falls, then rises.

    Also how much that is, m: to some 1e-12, as it changes with the square of what the place is off.
    """
    while any_lane((high - low) * span > _LOWEST_RESOLUTION):
        at = 0.5 * (low + high)
        _, _, dx, dy = _foot_at(rob, w, lane, at)
        falls = nx * dx + ny * dy < 0.0
        low = select(falls, at, low)
        high = select(falls, high, at)
    x, y, _, _ = _foot_at(rob, w, lane, high)
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
def _place_feet(rob, w, lane, end, parts):
    """Put the swing foot between equal parts of the step up to ``end`` into the row FEET.

    Of place k = 0, 1 ... in lane k % LANES: x, y, dx, dy in four columns from 4 (k // LANES) on.
    """
    for n in range(0, parts - 1, LANES):
        x, y, dx, dy = _foot_at(rob, w, lane, (end / parts) * load_from(_COUNT, 0, n))
        i = 4 * (n // LANES)
        store(w, FEET, i, x)
        store(w, FEET, i + 1, y)
        store(w, FEET, i + 2, dx)
        store(w, FEET, i + 3, dy)


@inner_kernel
def _first_below(rob, w, lane, nx, ny, offset, low, at_low, high, at_high, end, parts, span):
    """Between which fractions of a step the swing foot first comes down to a line, in lanes.

    The line is ``nx x + ny y = offset``; ``at_low`` and ``at_high`` are the foot there, as
    `_foot_once` gives it. Within each of the parts of `_place_feet` it moves one way at most, and
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
            at = low + length * _cubic_root(f0, length * d0, f1, length * d1)
            before = select(arrives, low, before)
            after = select(arrives, until, after)
            guess = select(arrives, at, guess)
            searching = searching & (f1 > 0.0)
        dips = searching & (d0 < 0.0) & (d1 > 0.0)
        if any_lane(dips):
            dips = dips & may_dip(f0, length * d0, f1, length * d1, _OFF_CUBIC)
            if any_lane(dips):
                at, least = _foot_lowest(rob, w, lane, nx, ny, splat(low), splat(until), span)
                arrives = dips & (least <= offset)
                before = select(arrives, low, before)
                after = select(arrives, at, after)
                guess = select(arrives, 0.5 * (low + at), guess)
                searching = searching & (guess > 1.0)
        low, f0, d0 = until, f1, d1
    return before, after, guess


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
def _body_touches_at(rob, w, lane, at, previous, slope):
    """The same at a fraction of the step."""
    a, _ = state_at(w, lane, splat(at))
    s, c = sines(a)
    behind = (splat(previous[0]), splat(previous[1]))
    ahead = (splat(slope[0]), splat(slope[1]))
    return any_lane(body_touches(rob, s, c, behind, ahead))


@inner_kernel
def _body_root(rob, w, lane, previous, slope, high):
    """When a body point first goes below the ground, given that it does at ``high``."""
    low = 0.0
    for _ in range(50):
        at = 0.5 * (low + high)
        if _body_touches_at(rob, w, lane, at, previous, slope):
            high = at
        else:
            low = at
    return high


@inner_kernel
def _five(ahead, row, i):
    return (
        load_from(ahead, row, i),
        load_from(ahead, row + 1, i),
        load_from(ahead, row + 2, i),
        load_from(ahead, row + 3, i),
        load_from(ahead, row + 4, i),
    )


@inner_kernel
def impacts(rob, ahead, landed):
    """Outcomes of the impacts on the first slopes, and states after them (absolute angles)."""
    for i in range(0, landed, LANES):
        lands = load_from(ahead, OUTCOME, i) == _LANDS
        if not any_lane(lands):
            continue
        sine, cosine = load_from(ahead, SINE, i), load_from(ahead, COSINE, i)
        a, da = _five(ahead, ANGLES, i), _five(ahead, RATES, i)
        s, c = _five(ahead, TRIG, i), _five(ahead, TRIG + 5, i)
        rates, px, py, vx, vy = impact.impact(rob, s, c, da)
        a = impact.swapped(a)
        normal = py * cosine - px * sine
        tangential = px * cosine + py * sine
        lifts = vy * cosine - vx * sine
        if rob[r.VERTICAL_FRICTION] != 0.0:
            sticks = abs(px) < rob[r.FRICTION] * py
        else:
            sticks = abs(tangential) < rob[r.FRICTION] * normal
        outcome = select(lifts > 0.0, _STEP, 0.0 * sine + _NO_LIFT)
        outcome = select(sticks, outcome, _IMPACT_SLIPS)
        outcome = select(normal > 0.0, outcome, _PULLS)
        nothing = 0.0 * sine  # not a number as soon as one of them is not finite
        for k in range(5):
            store_into(ahead, ANGLES + k, i, a[k])
            store_into(ahead, RATES + k, i, rates[k])
            nothing = nothing + 0.0 * a[k]
            nothing = nothing + 0.0 * rates[k]
        outcome = select(nothing == 0.0, outcome, _NOT_FINITE)
        outcome = select(lands, outcome, load_from(ahead, OUTCOME, i))
        store_into(ahead, OUTCOME, i, outcome)
        store_into(ahead, LENGTH, i, select(outcome == _STEP, load_from(ahead, LENGTH, i), 0.0))


@inner_kernel
def to_joint(ahead, i, state):
    """The state after the impact on a slope, as ``[q, dq]``."""
    for row, o in ((ANGLES, 0), (RATES, 5)):
        torso = ahead[row + 4, i]
        state[o] = ahead[row, i] - torso
        state[o + 1] = ahead[row + 1, i] - torso
        state[o + 2] = ahead[row + 2, i] - ahead[row, i]
        state[o + 3] = ahead[row + 3, i] - ahead[row + 1, i]
        state[o + 4] = torso
