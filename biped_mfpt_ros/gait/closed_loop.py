"""The closed loop: angles and rates to accelerations, under a controller with limited torques.

A torque beyond the limit is cut off, joint by joint. That makes a kink in the right-hand side
wherever a torque reaches its limit, so the integrator keeps the set of those that are cut off fixed
within a step and takes its change for an event: `motion` is smooth, also beyond the point where the
set should have changed.

So are the pieces of a control law: torques on and then off in hybrid zero dynamics, references
before and after the switch in sliding mode, the polynomials of a spline.

A further control scheme is a kernel ``command(par, a, da)`` that returns the accelerations of the
five links as ``alpha + beta z``, two tuples of five. It takes a line in `_command`, and others in
`piece_of`, `within` and `next_piece` if it has pieces; ``control/controller.py`` gives it a code
and a name. Written without branches and tables it goes through all lanes at once; otherwise lane by
lane, as the spline does.
"""

from __future__ import annotations

import math

from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.control.controller import HZD, SMC, SPLINE
from biped_mfpt_ros.gait.scratch import COMMAND, CUT, MODE, PIECE, SLIDES, SPARE
from biped_mfpt_ros.jit import inlined_kernel, inner_kernel
from biped_mfpt_ros.lanes import LANES, any_lane, lane_of, load, select, splat
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker import robot as r

CUT_RESOLUTION = 1e-9
"""Of the torque limit: how far a torque may be beyond it before it is cut off."""
_NEAR = 1e3
"""Of the torque limit: what the controller may ask for beyond it, so that the motion without it is
found as that with it and a change: as exact as solved anew, to some 1e-12, and in half the time."""


@inlined_kernel
def _command(scheme, par, w, row, a, da, piece, slides):
    """Accelerations ``alpha + beta z`` that the controller wants, for the states in a row."""
    if scheme == HZD:
        return hzd.command(par, a, da)
    if scheme == SMC:
        return smc.command(par, a, da, piece, slides)
    for lane in range(LANES):
        alpha, beta = spline.command(
            par, lane_angles(w, row, lane), lane_rates(w, row, lane), lane_of(piece, lane)
        )
        for i in range(5):
            w[COMMAND, i, lane] = alpha[i]
            w[COMMAND, 5 + i, lane] = beta[i]
    return angles(w, COMMAND), rates(w, COMMAND)


@inner_kernel
def piece_of(scheme, par, a):
    """The piece of the control law that holds at some angles."""
    if scheme == HZD:
        return 0.0 if hzd.switch(par, a) > 0.0 else 1.0
    if scheme == SMC:
        return 0.0 if smc.switch(par, a) > 0.0 else 1.0
    return spline.piece_of(par, a)


@inner_kernel
def within(scheme, par, a, piece):
    """Positive where a piece of the control law holds, negative outside of it."""
    if scheme == HZD:
        before = hzd.switch(par, a)
    elif scheme == SMC:
        before = smc.switch(par, a)
    else:
        return spline.within(par, a, piece)
    return (1.0 if piece == 0.0 else -1.0) * before


@inner_kernel
def next_piece(scheme, par, a, piece):
    """The piece of the control law that follows where one is left."""
    if scheme == SPLINE:
        return spline.next_piece(par, a, piece)
    return 1.0 - piece


@inner_kernel
def jumps(scheme):
    """Whether what the controller wants jumps from one piece of its law to the next."""
    return scheme != SPLINE


@inner_kernel
def angles(w, row):
    """Five angles in all lanes."""
    return (load(w, row, 0), load(w, row, 1), load(w, row, 2), load(w, row, 3), load(w, row, 4))


@inner_kernel
def rates(w, row):
    """Five rates in all lanes."""
    return (load(w, row, 5), load(w, row, 6), load(w, row, 7), load(w, row, 8), load(w, row, 9))


@inner_kernel
def torques_at(w, row, column):
    """Four torques in all lanes."""
    return (
        load(w, row, column),
        load(w, row, column + 1),
        load(w, row, column + 2),
        load(w, row, column + 3),
    )


@inner_kernel
def lane_angles(w, row, lane):
    """Five angles in one lane."""
    return (w[row, 0, lane], w[row, 1, lane], w[row, 2, lane], w[row, 3, lane], w[row, 4, lane])


@inner_kernel
def lane_rates(w, row, lane):
    """Five rates in one lane."""
    return (w[row, 5, lane], w[row, 6, lane], w[row, 7, lane], w[row, 8, lane], w[row, 9, lane])


@inner_kernel
def _applied(rob, cut, off, wanted):
    """Torques that act: wanted, at the limit where ``cut`` is not 0, or none where ``off``."""
    limit = rob[r.TORQUE_LIMIT]
    return (
        select(off, 0.0, select(cut[0] == 0.0, wanted[0], cut[0] * limit)),
        select(off, 0.0, select(cut[1] == 0.0, wanted[1], cut[1] * limit)),
        select(off, 0.0, select(cut[2] == 0.0, wanted[2], cut[2] * limit)),
        select(off, 0.0, select(cut[3] == 0.0, wanted[3], cut[3] * limit)),
    )


@inner_kernel
def _is_cut(cut, off):
    return (cut[0] != 0.0) | (cut[1] != 0.0) | (cut[2] != 0.0) | (cut[3] != 0.0) | off


@inner_kernel
def powers(u, da):
    """Mechanical power of the joints, W."""
    return (
        u[0] * (da[0] - da[4]),
        u[1] * (da[1] - da[4]),
        u[2] * (da[2] - da[0]),
        u[3] * (da[3] - da[1]),
    )


@inner_kernel
def _off(scheme, piece):
    """Whether the controller has switched the torques off."""
    return piece > (0.5 if scheme == HZD else math.inf)


@inner_kernel
def mode_of_all(w):
    """Of all lanes: torques cut off, the piece of the control law, which outputs slide."""
    return (
        (
            load(w, MODE, CUT),
            load(w, MODE, CUT + 1),
            load(w, MODE, CUT + 2),
            load(w, MODE, CUT + 3),
        ),
        load(w, MODE, PIECE),
        (
            load(w, MODE, SLIDES),
            load(w, MODE, SLIDES + 1),
            load(w, MODE, SLIDES + 2),
            load(w, MODE, SLIDES + 3),
        ),
    )


@inner_kernel
def mode_of(w, lane):
    """The same of one lane, in all lanes."""
    return (
        (
            splat(w[MODE, CUT, lane]),
            splat(w[MODE, CUT + 1, lane]),
            splat(w[MODE, CUT + 2, lane]),
            splat(w[MODE, CUT + 3, lane]),
        ),
        splat(w[MODE, PIECE, lane]),
        (
            splat(w[MODE, SLIDES, lane]),
            splat(w[MODE, SLIDES + 1, lane]),
            splat(w[MODE, SLIDES + 2, lane]),
            splat(w[MODE, SLIDES + 3, lane]),
        ),
    )


@inlined_kernel
def motion(scheme, rob, par, w, row, mode):
    """Motion under a controller, with a given set of torques cut off (eq. 2, 8, 16).

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    rob, par : numpy.ndarray
        Packed model and controller.
    w : numpy.ndarray
        Scratch.
    row : int
        Where the states stand.
    mode : tuple
        As `mode_of` gives it. A torque cut off is held at the limit of which it has the sign.

    Returns
    -------
    tuple
        Accelerations (5, rad/s^2), torques that the controller wants and those that act (4 each,
        N m), force of the ground on the stance foot (tangential, normal, N), and sines and cosines
        of the angles (5 each).
    """
    a, da = angles(w, row), rates(w, row)
    cut, piece, slides = mode
    s, c = dynamics.sines(a)
    alpha, beta = _command(scheme, par, w, row, a, da, piece, slides)
    dda = dynamics.prescribed_motion(rob, s, c, da, alpha, beta)
    x, y = dynamics.link_accelerations(s, c, da, dda)
    wanted = dynamics.required_torques(rob, s, c, dda, x, y)
    applied = wanted
    off = _off(scheme, piece)
    is_cut = _is_cut(cut, off)
    if any_lane(is_cut):
        applied = _applied(rob, cut, off, wanted)
        cut_away = (
            applied[0] - wanted[0],
            applied[1] - wanted[1],
            applied[2] - wanted[2],
            applied[3] - wanted[3],
        )
        # Linear in the torques.
        change = dynamics.change_of_motion(rob, s, c, cut_away)
        dda = (
            select(is_cut, dda[0] + change[0], dda[0]),
            select(is_cut, dda[1] + change[1], dda[1]),
            select(is_cut, dda[2] + change[2], dda[2]),
            select(is_cut, dda[3] + change[3], dda[3]),
            select(is_cut, dda[4] + change[4], dda[4]),
        )
        # Where the controller asks for nearly infinite torques, too few digits are left of that.
        most = abs(cut_away[0]) + abs(cut_away[1]) + abs(cut_away[2]) + abs(cut_away[3])
        near = most < _NEAR * (1.0 + rob[r.TORQUE_LIMIT])
        if any_lane(select(near, 0.0, 1.0 + 0.0 * s[0]) > 0.5):
            moved = dynamics.free_motion(rob, s, c, da, applied)
            dda = (
                select(near, dda[0], moved[0]),
                select(near, dda[1], moved[1]),
                select(near, dda[2], moved[2]),
                select(near, dda[3], moved[3]),
                select(near, dda[4], moved[4]),
            )
        x, y = dynamics.link_accelerations(s, c, da, dda)
    return dda, wanted, applied, dynamics.ground_force(rob, x, y), s, c


@inner_kernel
def beyond_each(rob, cut, wanted):
    """How far each wanted torque is beyond where ``cut`` is right, N m."""
    limit = rob[r.TORQUE_LIMIT]
    return (
        select(cut[0] == 0.0, abs(wanted[0]) - limit, limit - cut[0] * wanted[0]),
        select(cut[1] == 0.0, abs(wanted[1]) - limit, limit - cut[1] * wanted[1]),
        select(cut[2] == 0.0, abs(wanted[2]) - limit, limit - cut[2] * wanted[2]),
        select(cut[3] == 0.0, abs(wanted[3]) - limit, limit - cut[3] * wanted[3]),
    )


@inner_kernel
def greatest(each):
    """The most of four numbers."""
    u0, u1, u2, u3 = each
    u0 = select(u1 > u0, u1, u0)
    u2 = select(u3 > u2, u3, u2)
    return select(u2 > u0, u2, u0)


@inner_kernel
def beyond(rob, cut, wanted):
    """How far the wanted torques are beyond where ``cut`` is right, at most, N m."""
    return greatest(beyond_each(rob, cut, wanted))


@inner_kernel
def cut_off(rob, wanted):
    """Whether a torque is beyond the limit: 0 or its sign."""
    limit = rob[r.TORQUE_LIMIT]
    return select(wanted > limit, 1.0, select(wanted < -limit, -1.0, 0.0))


@inner_kernel
def closed_loop(scheme, piece, rob, par, w, y, rate, torques):
    """Time derivative of angles, rates and energy under a controller, for integrators of others.

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    piece : float
        Of the control law, as `piece_of` gives it.
    rob, par : numpy.ndarray
        Packed model and controller.
    w : numpy.ndarray
        Scratch, as `empty_scratch` gives it.
    y : numpy.ndarray
        Absolute angles (rad), rates (rad/s), and energy (J), shape (11,).
    rate, torques : numpy.ndarray
        Set to the derivative of ``y``, shape (11,), and to u1 to u4 (N m), shape (4,).
    """
    for i in range(10):
        for lane in range(LANES):
            w[SPARE, i, lane] = y[i]
    no = splat(0.0)
    none = (no, no, no, no)
    dda, wanted, applied, _, _, _ = motion(scheme, rob, par, w, SPARE, (none, splat(piece), none))
    if any_lane(beyond(rob, none, wanted) > 0.0):
        cut = (
            cut_off(rob, wanted[0]),
            cut_off(rob, wanted[1]),
            cut_off(rob, wanted[2]),
            cut_off(rob, wanted[3]),
        )
        dda, _, applied, _, _, _ = motion(scheme, rob, par, w, SPARE, (cut, splat(piece), none))
    rate[10] = 0.0
    power = powers(applied, rates(w, SPARE))
    for i in range(5):
        rate[i] = y[5 + i]
        rate[5 + i] = lane_of(dda[i], 0)
    for i in range(4):
        rate[10] += abs(lane_of(power[i], 0))
        torques[i] = lane_of(applied[i], 0)


@inner_kernel
def margin(rob, force):
    """How far the stance foot is from slipping, N: negative slips (eq. 4)."""
    return rob[r.FRICTION] * force[1] - abs(force[0])
