"""Swings, as many at once as there are lanes: from an impact to the outcome on every slope.

A driver puts a swing into a lane with `begin`, and calls `advance` until the lane's swing has
ended; `advance` takes one step of the integrator in all lanes. What a lane does depends on that
lane alone.
"""

from __future__ import annotations

import math

from biped_mfpt_ros.control import smc
from biped_mfpt_ros.control.controller import SMC
from biped_mfpt_ros.gait.closed_loop import (
    angles,
    beyond,
    cut_off,
    jumps,
    lane_angles,
    lane_rates,
    margin,
    mode_of_all,
    motion,
    next_piece,
    piece_of,
    powers,
    rates,
    within,
)
from biped_mfpt_ros.gait.energy import energy_at, energy_at_end, find_lobes
from biped_mfpt_ros.gait.events import (
    LIFT,
    SLIP,
    first_change,
    force_once,
    motion_at,
    piece_root,
    slide_root,
    slip_root,
)
from biped_mfpt_ros.gait.ground import (
    FOOT_INTERVAL,
    FOOT_PARTS,
    body_touches,
    impacts,
    may_dip,
    meet_ground,
)
from biped_mfpt_ros.gait.integrate import (
    DENSE_STAGES,
    STAGES,
    columns_of,
    eighth_root,
    interpolate,
    prepare_dense,
    state_at,
    take_step,
    trial_step,
)
from biped_mfpt_ros.gait.scratch import (
    AT,
    BACK_COS,
    BACK_SIN,
    BEYOND,
    CHANGES,
    COSINE,
    COSINES,
    CUT,
    DURATION,
    END,
    END_DX,
    END_DY,
    END_X,
    END_Y,
    ENERGY,
    ERROR,
    ERROR_ROOT,
    ESTIMATE,
    EVALUATIONS,
    FAILURE,
    FOOT_DX,
    FOOT_DY,
    FOOT_X,
    FOOT_Y,
    GOOD,
    LAST_H,
    LAST_ROOT,
    LEAST,
    LEAST_NORMAL,
    LENGTH,
    LOAD,
    LOWEST,
    MARGIN,
    MAY_CUT,
    MODE,
    MOST,
    NEAR,
    NORMAL,
    OUTCOME,
    PASSED,
    PIECE,
    PLACES,
    RESTARTS,
    SAMPLES,
    SINCE,
    SINE,
    SINES,
    SLIDE,
    SLIDES,
    SLIDING,
    SLIPS,
    SPENT,
    STAGE,
    START,
    STATES,
    STEPS,
    SWITCHES,
    TANGENTIAL,
    TIME,
    TODO,
    VALUE,
    WORK,
    Y_NEW,
    H,
    Y,
)
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import LANES, any_lane, lane_of, load, select, splat, store
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import foot, sine_cosine, sines
from biped_mfpt_ros.walker.outcome import Outcome

FOOT_TOLERANCE = 1e-3
"""m, how far below the ground behind a swing foot may start: states are typed in rounded."""

_CLEARANCE = 1e-9  # m, rounding of the height of a foot that stands on the ground
_MOST_STEPS = 20_000  # integrator steps before a swing is given up
_MOST_EVALUATIONS = 500_000  # the same for evaluations: a swing may crawl without a step accepted
_SLIP_INTERVAL = 0.004  # s between samples of a step that may contain a slip
_LONGEST_STEP = FOOT_PARTS * FOOT_INTERVAL  # s
_SHORTEST_STEP = 1e-9  # s, up to an event
_OFF_CUBIC = 3e-3  # m: what the height of the foot differs from a cubic over a step, at most
_LEAST_ROOT = 0.5623  # of an error of 0.01: smaller ones tell nothing about how errors grow
_TRACE_SAMPLES = 8  # of every integrator step
SAMPLE_COLUMNS = 18  # of a trace: t, a (5), da (5), u (4), tangential, normal force, energy

_LIFTS = int(Outcome.STANCE_LIFTS)
_SLIPS = int(Outcome.STANCE_SLIPS)
_SCUFFS = int(Outcome.SWING_SCUFFS)
_BODY = float(Outcome.BODY_TOUCHES)
_TIME = int(Outcome.TIME_LIMIT)
_NOT_FINITE = int(Outcome.NOT_FINITE)


@inner_kernel
def _unloaded(rob):
    """N: a foot that slips under no load to speak of is one that lifts."""
    return 1e-6 * rob[r.MASS] * rob[r.GRAVITY]


@inner_kernel
def _of_lane(x, lane):
    """Five numbers of one lane."""
    return (
        lane_of(x[0], lane),
        lane_of(x[1], lane),
        lane_of(x[2], lane),
        lane_of(x[3], lane),
        lane_of(x[4], lane),
    )


@inner_kernel
def begin(scheme, rob, par, w, v, lane, state, previous, ahead):
    """Put a swing into a lane.

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    rob, par : numpy.ndarray
        Packed model and controller.
    w, v : numpy.ndarray
        Scratch and variables of all lanes.
    lane : int
        Which.
    state : numpy.ndarray
        ``[q, dq]`` just after impact, rad and rad/s, shape (10,).
    previous : float
        rad, slope of the ground behind the stance foot.
    ahead : numpy.ndarray
        The ground ahead of the lane, with the slopes that `slopes_ahead` puts there, shape
        (AHEAD, m + LANES); what happens on it is put there too.
    """
    m = ahead.shape[1] - LANES
    for i in range(m):
        for row in (DURATION, LENGTH, SPENT):
            ahead[row, i] = 0.0
    for o in (0, 5):
        torso = state[o + 4]
        w[Y, o, lane] = state[o] + torso
        w[Y, o + 1, lane] = state[o + 1] + torso
        w[Y, o + 2, lane] = w[Y, o, lane] + state[o + 2]
        w[Y, o + 3, lane] = w[Y, o + 1, lane] + state[o + 3]
        w[Y, o + 4, lane] = torso
    for i in range(4):
        w[Y, WORK + i, lane] = 0.0
    v[TIME, lane] = 0.0
    v[ENERGY, lane] = 0.0
    v[SINCE, lane] = -1.0
    v[PASSED, lane] = 0.0
    v[TODO, lane] = m
    v[STEPS, lane] = 0.0
    v[EVALUATIONS, lane] = 0.0
    v[SAMPLES, lane] = 0.0
    v[FAILURE, lane] = -1.0
    v[LAST_H, lane] = 0.0
    v[BACK_SIN, lane], v[BACK_COS, lane] = sine_cosine(previous)
    w[MODE, H, lane] = 0.013 * eighth_root(rob[r.TOLERANCE] / 1e-9)
    w[MODE, PIECE, lane] = piece_of(scheme, par, lane_angles(w, Y, lane))
    v[RESTARTS, lane] = 2.0
    lanes_s, lanes_c, normal = _restart(scheme, rob, par, w, v)
    s, c = _of_lane(lanes_s, lane), _of_lane(lanes_c, lane)
    x, y, dx, dy = foot(rob, s, c, lane_rates(w, Y, lane))
    v[FOOT_X, lane], v[FOOT_Y, lane], v[FOOT_DX, lane], v[FOOT_DY, lane] = x, y, dx, dy
    height = y * v[BACK_COS, lane] - x * v[BACK_SIN, lane]
    v[LOWEST, lane] = min(height, 0.0) - _CLEARANCE
    for i in range(STATES):
        if not (math.isfinite(w[Y, i, lane]) and math.isfinite(w[STAGE, i, lane])):
            v[FAILURE, lane] = _NOT_FINITE
            return
    if not (x < 0.0 and height >= -FOOT_TOLERANCE):
        v[FAILURE, lane] = _SCUFFS
        return
    if not lane_of(normal, lane) > _unloaded(rob):
        v[FAILURE, lane] = _LIFTS
        return
    if v[FAILURE, lane] >= 0.0:
        return
    back = (v[BACK_SIN, lane], v[BACK_COS, lane])
    i = 0
    while i < m and body_touches(rob, s, c, back, (ahead[SINE, i], ahead[COSINE, i])):
        ahead[OUTCOME, i] = _BODY
        i += 1
    v[TODO, lane] = m - i


@inner_kernel
def _restart(scheme, rob, par, w, v):
    """Evaluate the closed loop at row Y, for the next step, in the lanes that RESTARTS names.

    Where what is cut off is found afresh, torques have jumped, and the stance foot may slip.
    Returns sines and cosines of the angles, and the normal force, in all lanes.
    """
    for lane in range(LANES):
        if v[RESTARTS, lane] > 1.0:
            for i in range(4):
                w[MODE, CUT + i, lane] = 0.0
                w[MODE, SLIDES + i, lane] = 0.0
    mode = mode_of_all(w)
    dda, wanted, applied, force, s, c = motion(scheme, rob, par, w, Y, mode)
    over = beyond(rob, mode[0], wanted)
    again = False
    for lane in range(LANES):
        if v[RESTARTS, lane] > 1.0 and lane_of(over, lane) > 0.0:
            for i in range(4):
                w[MODE, CUT + i, lane] = cut_off(rob, lane_of(wanted[i], lane))
            v[EVALUATIONS, lane] += 1
            again = True
    if again:
        mode = mode_of_all(w)
        dda, wanted, applied, force, s, c = motion(scheme, rob, par, w, Y, mode)
        over = beyond(rob, mode[0], wanted)
    da = rates(w, Y)
    power = powers(applied, da)
    spare = margin(rob, force)
    unloaded = _unloaded(rob)
    for lane in range(LANES):
        if v[RESTARTS, lane] != 0.0:
            v[EVALUATIONS, lane] += 1
            for i in range(5):
                w[STAGE, i, lane] = lane_of(da[i], lane)
                w[STAGE, 5 + i, lane] = lane_of(dda[i], lane)
            for i in range(4):
                w[STAGE, WORK + i, lane] = lane_of(power[i], lane)
                w[START, i, lane] = lane_of(wanted[i], lane)
            v[MARGIN, lane] = lane_of(spare, lane)
            if v[RESTARTS, lane] > 1.0 and v[SINCE, lane] < 0.0 and not v[MARGIN, lane] > 0.0:
                v[SINCE, lane] = v[TIME, lane]
                if rob[r.SLIP_DURATION] == 0.0:
                    v[FAILURE, lane] = _SLIPS if lane_of(force[1], lane) > unloaded else _LIFTS
            v[RESTARTS, lane] = 0.0
    return s, c, force[1]


@inner_kernel
def _find_slides(rob, par, w):
    """How far outputs are from sliding at the end of the step, in all lanes, into the row SLIDING.

    Not at all where a torque is at its limit or near, or an output slides already.
    """
    a, da = angles(w, Y_NEW), rates(w, Y_NEW)
    cut, piece, slides = mode_of_all(w)
    may = (cut[0] == 0.0) & (cut[1] == 0.0) & (cut[2] == 0.0) & (cut[3] == 0.0)
    may = may & (load(w, ESTIMATE, BEYOND) <= -smc.CLEAR * rob[r.TORQUE_LIMIT])
    for i in range(4):
        store(w, SLIDING, i, math.inf)
        if any_lane(may):
            off = smc.off_slide(par, i, a, da, piece)
            store(w, SLIDING, i, select(may & (slides[i] == 0.0), off, math.inf))


@inner_kernel
def _begins_to_slide(w, lane):
    """Whether an output may slide at the end of the step, and did not before."""
    least = min(w[SLIDING, 0, lane], w[SLIDING, 1, lane])
    return min(least, w[SLIDING, 2, lane], w[SLIDING, 3, lane]) <= 0.0


@inner_kernel
def _choose_slides(par, w, lane, may):
    """Put outputs into sliding mode, or take them out; returns whether any changed."""
    changed = False
    cut = False
    for i in range(4):
        cut = cut or w[MODE, CUT + i, lane] != 0.0
    a, da = lane_angles(w, Y_NEW, lane), lane_rates(w, Y_NEW, lane)
    for i in range(4):
        slides = w[MODE, SLIDES + i, lane] != 0.0
        off = math.inf
        if may and not cut:
            off = smc.off_slide(par, i, a, da, w[MODE, PIECE, lane])
        if slides == cut and (cut or off <= 0.0):
            w[MODE, SLIDES + i, lane] = 0.0 if slides else 1.0
            changed = True
    return changed


@inner_kernel
def advance(scheme, rob, par, w, v, active, ahead, trace):
    """One step of the integrator in all lanes, and what happens in it.

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    rob, par, w, v : numpy.ndarray
        As for `begin`.
    active : numpy.ndarray
        Which lanes hold a swing that has not ended, bool, shape (LANES,); updated.
    ahead : numpy.ndarray
        The ground ahead of all lanes, as for `begin`, shape (LANES, AHEAD, m + LANES). Where a
        swing has ended, all is decided, and `to_joint` gives the states after impact.
    trace : numpy.ndarray
        Samples of the swing in lane 0, shape (k, SAMPLE_COLUMNS); k = 0: none are wanted.
    """
    for lane in range(LANES):
        w[MODE, GOOD, lane] = 0.0
        if active[lane]:
            _propose(rob, w, v, lane)
            if v[FAILURE, lane] >= 0.0 or v[TODO, lane] == 0.0:
                _end(rob, v, lane, ahead[lane])
                active[lane] = False
    if not active.any():
        return
    trial_step(scheme, rob, par, w)
    if scheme == SMC:
        _find_slides(rob, par, w)
    dense = False
    for lane in range(LANES):
        if active[lane]:
            v[EVALUATIONS, lane] += STAGES
            if _inspect(scheme, rob, par, w, v, lane, ahead[lane]) or trace.shape[0] > 0:
                v[EVALUATIONS, lane] += DENSE_STAGES
                dense = True
    if dense:
        prepare_dense(scheme, rob, par, w)
    for lane in range(LANES):
        if w[MODE, GOOD, lane] != 0.0:
            _finish(scheme, rob, par, w, v, lane, ahead[lane], trace)
    take_step(w)
    if v[RESTARTS].any():
        _restart(scheme, rob, par, w, v)


@inner_kernel
def _propose(rob, w, v, lane):
    """Limit the length of the next step, or end the swing."""
    left = rob[r.TIME_LIMIT] - v[TIME, lane]
    if v[FAILURE, lane] < 0.0 and v[TODO, lane] > 0.0:
        crawls = v[STEPS, lane] >= _MOST_STEPS or v[EVALUATIONS, lane] >= _MOST_EVALUATIONS
        if crawls or left <= 0.0:
            v[FAILURE, lane] = _TIME
        w[MODE, H, lane] = min(w[MODE, H, lane], _LONGEST_STEP, left + 1e-9)


@inner_kernel
def _end(rob, v, lane, ahead):
    """Decide the rest: slopes that are still open share the failure that ended the swing."""
    m = ahead.shape[1] - LANES
    landed = m - int(v[TODO, lane])
    impacts(rob, ahead, landed)
    for i in range(landed, m):
        ahead[OUTCOME, i] = v[FAILURE, lane]
        ahead[DURATION, i] = v[TIME, lane]
        ahead[LENGTH, i] = 0.0
        ahead[SPENT, i] = v[ENERGY, lane]


@inner_kernel
def _inspect(scheme, rob, par, w, v, lane, ahead):
    """Whether the step just tried is good, and whether something may happen in it.

    Returns whether its dense output is needed to find out.
    """
    error = w[ESTIMATE, ERROR, lane]
    h = w[MODE, H, lane]
    if not error <= 1.0:
        if h < 1e-13 or (not math.isfinite(error) and h < 1e-9):
            v[FAILURE, lane] = _NOT_FINITE
        w[MODE, H, lane] = h * (
            max(0.2, 0.9 / w[ESTIMATE, ERROR_ROOT, lane]) if math.isfinite(error) else 0.1
        )
        return False
    w[MODE, GOOD, lane] = 1.0
    v[STEPS, lane] += 1.0
    changes = w[ESTIMATE, MAY_CUT, lane] != 0.0
    switches = not within(scheme, par, lane_angles(w, Y_NEW, lane), w[MODE, PIECE, lane]) > 0.0
    least = min(w[ESTIMATE, LEAST, lane], v[MARGIN, lane])
    most = max(w[ESTIMATE, MOST, lane], v[MARGIN, lane])
    uncertain = 0.25 * (most - least) + 1e-3 * rob[r.MASS] * rob[r.GRAVITY]
    slips = not (
        least > uncertain and w[ESTIMATE, LEAST_NORMAL, lane] > uncertain and v[SINCE, lane] < 0.0
    )
    s, c = lane_angles(w, END, lane), lane_rates(w, END, lane)  # where its sines and cosines stand
    x, y, dx, dy = foot(rob, s, c, lane_rates(w, Y_NEW, lane))
    v[END_X, lane], v[END_Y, lane], v[END_DX, lane], v[END_DY, lane] = x, y, dx, dy
    i = ahead.shape[1] - LANES - int(v[TODO, lane])
    slope = (ahead[SINE, i], ahead[COSINE, i])
    back = (v[BACK_SIN, lane], v[BACK_COS, lane])
    near = body_touches(rob, s, c, back, slope)
    if v[FOOT_X, lane] < 0.0:
        near = near or x >= 0.0 or _may_reach(v, lane, -back[0], back[1], h)
    else:
        near = near or x < 0.0 or _may_reach(v, lane, -slope[0], slope[1], h)
    slide = scheme == SMC and _begins_to_slide(w, lane)
    v[SLIDE, lane] = 1.0 if slide else 0.0
    v[CHANGES, lane] = 1.0 if changes else 0.0
    v[SWITCHES, lane] = 1.0 if switches else 0.0
    v[SLIPS, lane] = 1.0 if slips else 0.0
    v[NEAR, lane] = 1.0 if near else 0.0
    return changes or switches or slips or near or slide


@inner_kernel
def _may_reach(v, lane, nx, ny, h):
    """Whether the swing foot may come down to ``nx x + ny y = 0`` in the step."""
    f0 = nx * v[FOOT_X, lane] + ny * v[FOOT_Y, lane]
    d0 = (nx * v[FOOT_DX, lane] + ny * v[FOOT_DY, lane]) * h
    f1 = nx * v[END_X, lane] + ny * v[END_Y, lane]
    d1 = (nx * v[END_DX, lane] + ny * v[END_DY, lane]) * h
    return may_dip(f0, d0, f1, d1, _OFF_CUBIC)


@inner_kernel
def _finish(scheme, rob, par, w, v, lane, ahead, trace):
    """What happens in a step that is good, and the start of the next one."""
    h, t = w[MODE, H, lane], v[TIME, lane]
    find_lobes(w, lane)

    # The step ends early where a torque reaches or leaves its limit, or a piece of the law ends.
    end, joint, held, switches = 1.0, -1, 0.0, False
    if v[CHANGES, lane] != 0.0:
        at, joint, held, evaluations = first_change(scheme, rob, par, w, lane, h)
        v[EVALUATIONS, lane] += evaluations
        if joint >= 0:
            end = min(1.0, max(at, _SHORTEST_STEP / h))
    if v[SWITCHES, lane] != 0.0:
        at = piece_root(scheme, rob, par, w, lane, h)
        if at <= end:
            end, joint, switches = at, -1, True
    if v[SLIDE, lane] != 0.0:
        for i in range(4):
            at = 1.0
            if w[MODE, SLIDES + i, lane] == 0.0:
                at = slide_root(scheme, rob, par, w, lane, i, h)
            if at < end:
                end, joint, switches = at, -1, False
    if end < 1.0:
        _cut_short(rob, w, v, lane, end)

    stop, failure = end, -1
    if v[SLIPS, lane] != 0.0:
        stop, failure = _first_fall(scheme, rob, par, w, v, lane, end, h)
    if v[NEAR, lane] != 0.0:
        stop, failure = meet_ground(rob, w, v, lane, ahead, end, stop, failure)
    if trace.shape[0] > 0 and lane == 0:
        until = stop
        if v[TODO, lane] == 0.0:
            until = min(stop, (ahead[DURATION, 0] - t) / h)
        _sample(scheme, rob, par, w, v, trace, until)
    if failure >= 0:
        w[MODE, GOOD, lane] = 0.0
        v[FAILURE, lane] = failure
        v[ENERGY, lane] = lane_of(energy_at(w, v, lane, splat(stop)), 0)
        v[TIME, lane] = t + stop * h
        return

    v[ENERGY, lane] = energy_at_end(w, v, lane, end)
    v[TIME, lane] = t + end * h
    v[FOOT_X, lane], v[FOOT_Y, lane] = v[END_X, lane], v[END_Y, lane]
    v[FOOT_DX, lane], v[FOOT_DY, lane] = v[END_DX, lane], v[END_DY, lane]
    w[MODE, H, lane] = h * _growth(w, v, lane, h)
    if joint >= 0:
        w[MODE, CUT + joint, lane] = held
    if switches:
        a = lane_angles(w, Y_NEW, lane)
        w[MODE, PIECE, lane] = next_piece(scheme, par, a, w[MODE, PIECE, lane])
        if jumps(scheme):
            w[MODE, H, lane] = min(w[MODE, H, lane], 0.25 * h)
    slides = scheme == SMC and not switches and _choose_slides(par, w, lane, v[SLIDE, lane] != 0.0)
    v[LAST_H, lane], v[LAST_ROOT, lane] = h, max(w[ESTIMATE, ERROR_ROOT, lane], _LEAST_ROOT)
    if end < 1.0 or joint >= 0 or switches or slides:
        v[LAST_H, lane] = 0.0
        v[RESTARTS, lane] = 2.0 if switches and jumps(scheme) else 1.0
    else:
        v[MARGIN, lane] = margin(rob, (w[ESTIMATE, TANGENTIAL, lane], w[ESTIMATE, NORMAL, lane]))


@inner_kernel
def _growth(w, v, lane, h):
    """By which the next step may be longer, from the errors of this one and the one before.

    Where errors grow from step to step, the next one is shortened in time [1]_.

    .. [1] K. Gustafsson, "Control-theoretic techniques for stepsize selection in implicit
       Runge-Kutta methods", ACM Transactions on Mathematical Software 20 (1994).
    """
    root = w[ESTIMATE, ERROR_ROOT, lane]
    if 5.0 * root < 0.9:
        return 5.0
    factor = 0.9 / root
    if v[LAST_H, lane] > 0.0:
        trend = h * v[LAST_ROOT, lane] / (v[LAST_H, lane] * root)
        factor = min(factor, max(0.2, factor * trend))
    return factor


@inner_kernel
def _cut_short(rob, w, v, lane, end):
    """End the step at a fraction of it."""
    at = splat(end)
    for i in range(columns_of(w)):
        w[Y_NEW, i, lane] = lane_of(interpolate(w, lane, i, at), 0)
    s, c = sines(lane_angles(w, Y_NEW, lane))
    for i in range(5):
        w[END, SINES + i, lane] = s[i]
        w[END, COSINES + i, lane] = c[i]
    x, y, dx, dy = foot(rob, s, c, lane_rates(w, Y_NEW, lane))
    v[END_X, lane], v[END_Y, lane], v[END_DX, lane], v[END_DY, lane] = x, y, dx, dy


@inner_kernel
def _first_fall(scheme, rob, par, w, v, lane, end, h):
    """When the stance foot has slipped long enough, or lifts: a fraction of the step, an outcome.

    The end of the step and -1 if it does neither.
    """
    t, since = v[TIME, lane], v[SINCE, lane]
    last, last_value = 0.0, v[MARGIN, lane]
    slipping = since >= 0.0
    samples = LANES * (1 + int(end * h / (LANES * _SLIP_INTERVAL)))
    for k in range(samples):
        place = k % LANES
        if place == 0:
            for i in range(LANES):
                w[PLACES, AT, i] = end * (k + i + 1) / samples
            _, _, force = motion_at(scheme, rob, par, w, lane, load(w, PLACES, AT))
            v[EVALUATIONS, lane] += LANES
            store(w, PLACES, VALUE, margin(rob, force))
            store(w, PLACES, LOAD, force[1])
        at, value, normal = w[PLACES, AT, place], w[PLACES, VALUE, place], w[PLACES, LOAD, place]
        slips = not value > 0.0
        began, until = since, t + at * h
        if slips != slipping:
            root, evaluations = slip_root(
                scheme, rob, par, w, lane, SLIP, last, last_value, at, value, h
            )
            v[EVALUATIONS, lane] += evaluations
            if slips:
                since = t + root * h
                began = since
            else:
                until = t + root * h
                since = -1.0
        if (slips or slipping) and began + rob[r.SLIP_DURATION] <= until:
            stop = min(end, max(0.0, (began + rob[r.SLIP_DURATION] - t) / h))
            _, normal = force_once(scheme, rob, par, w, lane, stop)
            v[SINCE, lane] = since
            return stop, (_SLIPS if normal > _unloaded(rob) else _LIFTS)
        if not normal > 0.0:
            v[SINCE, lane] = since
            _, before = force_once(scheme, rob, par, w, lane, last)
            at, evaluations = slip_root(
                scheme, rob, par, w, lane, LIFT, last, before, at, normal, h
            )
            v[EVALUATIONS, lane] += evaluations
            return at, _LIFTS
        slipping, last, last_value = slips, at, value
    v[SINCE, lane] = since
    return end, -1


@inner_kernel
def _sample(scheme, rob, par, w, v, trace, until):
    """Samples of lane 0 up to a fraction of the step, into the trace."""
    samples = int(v[SAMPLES, 0])
    first = 0 if samples == 0 else 1
    for k in range(first, _TRACE_SAMPLES + 1):
        if samples < trace.shape[0]:
            at = splat(until * k / _TRACE_SAMPLES)
            a, da = state_at(w, 0, at)
            _, applied, force = motion_at(scheme, rob, par, w, 0, at)
            trace[samples, 0] = v[TIME, 0] + lane_of(at, 0) * w[MODE, H, 0]
            for i in range(5):
                trace[samples, 1 + i] = lane_of(a[i], 0)
                trace[samples, 6 + i] = lane_of(da[i], 0)
            for i in range(4):
                trace[samples, 11 + i] = lane_of(applied[i], 0)
            trace[samples, 15] = lane_of(force[0], 0)
            trace[samples, 16] = lane_of(force[1], 0)
            trace[samples, 17] = lane_of(energy_at(w, v, 0, at), 0)
            samples += 1
    v[SAMPLES, 0] = samples
