"""Events within a step of the integrator, located on its dense output.

Times within the step are fractions of it, 0 to 1.
"""

from __future__ import annotations

import math

from biped_mfpt_ros.control import smc
from biped_mfpt_ros.gait.closed_loop import (
    CUT_RESOLUTION,
    beyond,
    beyond_each,
    greatest,
    margin,
    mode_of,
    motion,
    within,
)
from biped_mfpt_ros.gait.integrate import state_at
from biped_mfpt_ros.gait.scratch import (
    AT,
    CUT,
    EACH,
    MODE,
    PIECE,
    PLACES,
    SPARE,
    START,
    TRIED,
    TRIED_TORQUES,
    TRIED_VALUE,
    VALUE,
)
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import LANES, any_lane, lane_of, load, select, splat, store
from biped_mfpt_ros.walker import robot as r

TIME_RESOLUTION = 1e-12
"""s, to which events are located."""
TORQUES, SLIP, LIFT = range(3)
"""What changes its sign: torques beyond their limits, the margin against slipping, the load."""
_MOST_ROUNDS = 60


@inner_kernel
def next_guess(low, low_value, high, high_value):
    """Where a function that changes sign between two places would vanish if it were linear."""
    at = low + (high - low) * (low_value / (low_value - high_value))
    return at if low < at < high else 0.5 * (low + high)


@inner_kernel
def _seek(scheme, rob, par, w, lane, output):
    """What `_first_negative` is about, at the places of row PLACES; ``output`` -1: the piece."""
    at = load(w, PLACES, AT)
    if output < 0:
        a, _ = state_at(w, lane, at)
        store(w, PLACES, VALUE, within(scheme, par, a, w[MODE, PIECE, lane]))
    else:
        store(w, PLACES, VALUE, _off_slide(scheme, rob, par, w, lane, output, at))


@inner_kernel
def _first_negative(scheme, rob, par, w, lane, output, span):
    """Where a function that may jump first falls below zero, as a fraction: just on the far side.

    It is positive at the start of the step and not at its end.
    """
    low, high = 0.0, 1.0
    while (high - low) * span > TIME_RESOLUTION:
        # Five parts at once.
        width = (high - low) / (LANES + 1)
        if low + width <= low or high - width >= high:
            break
        for k in range(LANES):
            w[PLACES, AT, k] = low + (k + 1) * width
        _seek(scheme, rob, par, w, lane, output)
        for k in range(LANES):
            if w[PLACES, VALUE, k] > 0.0:
                low = w[PLACES, AT, k]
            else:
                high = w[PLACES, AT, k]
                break
    return high


@inner_kernel
def piece_root(scheme, rob, par, w, lane, span):
    """Where a piece of the control law ends, as a fraction of the step: just on the far side."""
    return _first_negative(scheme, rob, par, w, lane, -1, span)


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
        The fraction; in which lane of row PLACES the nearest one tried stands; evaluations made.
    """
    cut, _, _ = mode_of(w, lane)
    sign = 1.0 if high[1] > low[1] else -1.0
    low, high = (low[0], sign * low[1]), (high[0], sign * high[1])
    at = high[0]
    nearest = 0
    evaluations = 0
    for _ in range(_MOST_ROUNDS):
        for n in range(LANES):
            w[PLACES, TRIED, n] = places[n]
        wanted, _, force = motion_at(scheme, rob, par, w, lane, load(w, PLACES, TRIED))
        evaluations += LANES
        for n in range(4):
            store(w, PLACES, TRIED_TORQUES + n, wanted[n])
        if what == TORQUES:
            store(w, PLACES, TRIED_VALUE, sign * beyond(rob, cut, wanted))
        elif what == SLIP:
            store(w, PLACES, TRIED_VALUE, sign * margin(rob, force))
        else:
            store(w, PLACES, TRIED_VALUE, sign * force[1])
        nearest = 0
        for n in range(1, LANES):
            if abs(w[PLACES, TRIED_VALUE, n]) < abs(w[PLACES, TRIED_VALUE, nearest]):
                nearest = n
        at = w[PLACES, TRIED, nearest]
        if abs(w[PLACES, TRIED_VALUE, nearest]) <= enough:
            break
        values = (
            low[1],
            w[PLACES, TRIED_VALUE, 0],
            w[PLACES, TRIED_VALUE, 1],
            w[PLACES, TRIED_VALUE, 2],
            w[PLACES, TRIED_VALUE, 3],
            high[1],
        )
        t = (low[0], places[0], places[1], places[2], places[3], high[0])
        low, high, at, about, places = _narrow(t, values, 0)
        if about * span < TIME_RESOLUTION:
            break
    return at, nearest, evaluations


@inner_kernel
def _try_torques(scheme, rob, par, w, lane):
    """How far torques are beyond their limits at the places of row PLACES: each, and at most."""
    cut, _, _ = mode_of(w, lane)
    wanted, _, _ = motion_at(scheme, rob, par, w, lane, load(w, PLACES, AT))
    each = beyond_each(rob, cut, wanted)
    for i in range(4):
        store(w, PLACES, EACH + i, each[i])
    store(w, PLACES, VALUE, greatest(each))


@inner_kernel
def _parabola(low, middle, high):
    """Peak of the parabola through three values: in spacings from the middle one, and its height.

    The highest end where it lies beyond it; minus infinity where the parabola has none.
    """
    bend = low - 2.0 * middle + high
    if not bend < 0.0:
        return 0.0, -math.inf
    shift = min(max(0.5 * (low - high) / bend, -1.0), 1.0)
    return shift, middle + 0.5 * shift * (high - low) + 0.5 * shift * shift * bend


@inner_kernel
def _may_exceed(low, middle, high, peak):
    """Whether a torque may be beyond its limit by what it differs from the parabola."""
    return peak > -0.25 * (max(low, middle, high) - min(low, middle, high))


@inner_kernel
def _beyond_between(scheme, rob, par, w, lane, start, before, slack):
    """Where a torque is beyond its limit for less than a quarter of the step, by parabolas.

    ``start`` is how far each is beyond at the start of the step, and ``before`` how many of the
    fractions 1/4, 1/2, 3/4 and 1, which stand in row PLACES, come before the first at which one is
    beyond by more than ``slack``.

    Returns
    -------
    tuple
        Fraction, how far a torque is beyond there, minus infinity if nowhere; evaluations made.
    """
    torque, at, low, middle, high = -1, 0.0, 0.0, 0.0, 0.0
    shift, peak = 0.0, -math.inf
    for i in range(4):
        f0 = min(start[i], 0.0)
        f1, f2 = w[PLACES, EACH + i, 0], w[PLACES, EACH + i, 1]
        for k in range(1, min(before, 3) + 1):
            if k > 1:
                f0, f1, f2 = f1, f2, w[PLACES, EACH + i, k]
            if f2 > slack:
                break
            one, top = _parabola(f0, f1, f2)
            if abs(one) < 1.0 and top > peak and _may_exceed(f0, f1, f2, top):
                torque, at, low, middle, high = i, 0.25 * k, f0, f1, f2
                shift, peak = one, top
    part = 0.25
    evaluations = 0
    for _ in range(4):
        if torque < 0 or not _may_exceed(low, middle, high, peak):
            break
        at, part = min(max(at + shift * part, 0.25 * part), 1.0 - 0.25 * part), 0.25 * part
        for n in range(LANES):
            w[PLACES, AT, n] = min(at + (n - 1) * part, 1.0)
        _try_torques(scheme, rob, par, w, lane)
        evaluations += LANES
        for n in range(LANES):
            if w[PLACES, VALUE, n] > slack:
                return w[PLACES, AT, n], w[PLACES, VALUE, n], evaluations
        low, middle = w[PLACES, EACH + torque, 0], w[PLACES, EACH + torque, 1]
        high = w[PLACES, EACH + torque, 2]
        shift, peak = _parabola(low, middle, high)
    return 0.0, -math.inf, evaluations


@inner_kernel
def first_change(scheme, rob, par, w, lane, span):
    """When the first torque reaches its limit, or leaves it, and which.

    Returns
    -------
    tuple
        Fraction of the step, the joint and whether it is held at the limit from then on: 0 or the
        sign of its torque; 2, -1 and 0 if none does. Evaluations made.
    """
    slack = CUT_RESOLUTION * rob[r.TORQUE_LIMIT]
    for n in range(LANES):
        w[PLACES, AT, n] = (n + 1) / LANES
    _try_torques(scheme, rob, par, w, lane)
    f0, f1 = w[PLACES, VALUE, 0], w[PLACES, VALUE, 1]
    f2, f3 = w[PLACES, VALUE, 2], w[PLACES, VALUE, 3]
    before = 0
    while before < LANES and w[PLACES, VALUE, before] <= slack:
        before += 1
    cut = (
        w[MODE, CUT, lane],
        w[MODE, CUT + 1, lane],
        w[MODE, CUT + 2, lane],
        w[MODE, CUT + 3, lane],
    )
    each = beyond_each(
        rob, cut, (w[START, 0, lane], w[START, 1, lane], w[START, 2, lane], w[START, 3, lane])
    )
    at, value, evaluations = _beyond_between(scheme, rob, par, w, lane, each, before, slack)
    start = greatest(each)
    evaluations += LANES
    if value > slack:
        low, high = (0.0, min(start, -slack)), (at, value)
        places = (0.2 * at, 0.4 * at, 0.6 * at, 0.8 * at)
    elif before == LANES:
        return 2.0, -1, 0.0, evaluations
    else:
        # What is at the limit, to rounding, is not beyond it yet.
        f0, f1, f2 = f0 - slack, f1 - slack, f2 - slack
        values = (-math.inf, min(start, 0.0) - slack, f0, f1, f2, f3)
        low, high, _, _, places = _narrow((0.0, 0.0, 0.25, 0.5, 0.75, 1.0), values, 1)
        low, high = (low[0], min(low[1] + slack, -slack)), (high[0], high[1] + slack)
    at, nearest, more = _crossing(
        scheme, rob, par, w, lane, TORQUES, low, high, places, 0.1 * slack, span
    )
    evaluations += more
    joint, held = 0, 0.0
    farthest = -math.inf
    for i in range(4):
        torque, sign = w[PLACES, TRIED_TORQUES + i, nearest], w[MODE, CUT + i, lane]
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
def slide_root(scheme, rob, par, w, lane, output, span):
    """Where an output begins to slide, given that it does by the end of the step.

    1 if it was about to at the start: not a crossing.
    """
    for k in range(LANES):
        w[PLACES, AT, k] = k / (LANES - 1)
    _seek(scheme, rob, par, w, lane, output)
    if not (w[PLACES, VALUE, 0] > 0.0 and w[PLACES, VALUE, LANES - 1] <= 0.0):
        return 1.0
    return _first_negative(scheme, rob, par, w, lane, output, span)


@inner_kernel
def _off_slide(scheme, rob, par, w, lane, output, at):
    """`smc.off_slide` at fractions in lanes, positive also where a torque is near its limit."""
    a, da = state_at(w, lane, at)
    off = smc.off_slide(par, output, a, da, splat(w[MODE, PIECE, lane]))
    if any_lane(off <= 0.0):
        wanted, _, _ = motion_at(scheme, rob, par, w, lane, at)
        cut, _, _ = mode_of(w, lane)
        limited = beyond(rob, cut, wanted) > -smc.CLEAR * rob[r.TORQUE_LIMIT]
        off = select((off <= 0.0) & limited, 1.0, off)
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
    part = (high - low) / (LANES + 1)
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
