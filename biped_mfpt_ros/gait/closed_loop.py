"""The closed loop: angles and rates to accelerations, under a controller with limited torques.

A torque beyond the limit is cut off, joint by joint. That makes a kink in the right-hand side
wherever a torque reaches its limit, so the integrator keeps the set of those that are cut off fixed
within a step and takes its change for an event: `motion` is smooth, also beyond the point where the
set should have changed.

A further control scheme is a kernel ``command(par, a, da)`` that returns the accelerations of the
five links as ``alpha + beta z``, two tuples of five numbers. It takes a line in `_command`, and
another in `switch` if it has a switch; ``control/controller.py`` gives it a code and a name. A
scheme without branches and tables may be called with lanes, as hybrid zero dynamics is in
`lanes_motion`, and is then some three times faster.
"""

from __future__ import annotations

from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.control.controller import HZD, SMC
from biped_mfpt_ros.gait.scratch import COMMAND, CUT, MODE, SWITCHED
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES, any_lane, load, select
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker import robot as r


@kernel
def _command(scheme, par, a, da, switched):
    """Accelerations ``alpha + beta z`` that the controller wants."""
    if scheme == HZD:
        return hzd.command(par, a, da)
    if scheme == SMC:
        return smc.command(par, a, da, switched > 0.5)
    return spline.command(par, a, da)


@kernel
def switch(scheme, par, a):
    """Positive before the controller's switch, negative after it."""
    if scheme == HZD:
        return hzd.switch(par, a)
    if scheme == SMC:
        return smc.switch(par, a)
    return 1.0


@kernel
def _wanted(rob, s, c, da, alpha, beta):
    """Accelerations and torques that the controller wants."""
    dda = dynamics.prescribed_motion(rob, s, c, da, alpha, beta)
    return dda, dynamics.required_torques(rob, s, c, da, dda)


@kernel
def _applied(rob, cut, off, wanted):
    """Torques that act: wanted, at the limit where ``cut`` is not 0, or none where ``off``."""
    limit = rob[r.TORQUE_LIMIT]
    return (
        select(off, 0.0, select(cut[0] == 0.0, wanted[0], cut[0] * limit)),
        select(off, 0.0, select(cut[1] == 0.0, wanted[1], cut[1] * limit)),
        select(off, 0.0, select(cut[2] == 0.0, wanted[2], cut[2] * limit)),
        select(off, 0.0, select(cut[3] == 0.0, wanted[3], cut[3] * limit)),
    )


@kernel
def _is_cut(cut, off):
    return (cut[0] != 0.0) | (cut[1] != 0.0) | (cut[2] != 0.0) | (cut[3] != 0.0) | off


@kernel
def powers(u, da):
    """Mechanical power of the joints, W."""
    return (
        u[0] * (da[0] - da[4]),
        u[1] * (da[1] - da[4]),
        u[2] * (da[2] - da[0]),
        u[3] * (da[3] - da[1]),
    )


@kernel
def _off(scheme, switched):
    """Whether the controller has switched the torques off."""
    return switched > (0.5 if scheme == HZD else 2.0)


@kernel
def motion(scheme, rob, par, cut, switched, a, da):
    """Motion under a controller, with a given set of torques cut off (eq. 2, 8, 16).

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    rob, par : numpy.ndarray
        Packed model and controller.
    cut : tuple of 4
        For each joint: 0, or the sign of the limit at which its torque is held.
    switched : float
        1 if the controller has switched, else 0.
    a, da : tuple of 5
        Absolute angles (rad) and rates (rad/s).

    Returns
    -------
    tuple
        Accelerations (5, rad/s^2), torques that the controller wants and those that act (4 each,
        N m), force of the ground on the stance foot (tangential, normal, N), and sines and cosines
        of the angles (5 each).
    """
    s, c = dynamics.sines(a)
    alpha, beta = _command(scheme, par, a, da, switched)
    dda, wanted = _wanted(rob, s, c, da, alpha, beta)
    applied = wanted
    off = _off(scheme, switched)
    if _is_cut(cut, off):
        applied = _applied(rob, cut, off, wanted)
        dda = dynamics.free_motion(rob, s, c, da, applied)
    return dda, wanted, applied, dynamics.ground_force(rob, s, c, da, dda), s, c


@kernel
def mode_of(w, lane):
    """Which torques are cut off in a lane, and whether its controller has switched."""
    cut = (
        w[MODE, CUT, lane],
        w[MODE, CUT + 1, lane],
        w[MODE, CUT + 2, lane],
        w[MODE, CUT + 3, lane],
    )
    return cut, w[MODE, SWITCHED, lane]


@kernel
def any_cut(scheme, w):
    """Whether any lane has a torque cut off, or all."""
    cut = (
        load(w, MODE, CUT),
        load(w, MODE, CUT + 1),
        load(w, MODE, CUT + 2),
        load(w, MODE, CUT + 3),
    )
    return any_lane(_is_cut(cut, _off(scheme, load(w, MODE, SWITCHED))))


@kernel
def angles(w, row):
    """Five angles in all lanes."""
    return (load(w, row, 0), load(w, row, 1), load(w, row, 2), load(w, row, 3), load(w, row, 4))


@kernel
def rates(w, row):
    """Five rates in all lanes."""
    return (load(w, row, 5), load(w, row, 6), load(w, row, 7), load(w, row, 8), load(w, row, 9))


@kernel
def lanes_motion(scheme, rob, par, w, row, free):
    """`motion` in all lanes for the states in a row, and the state's rates.

    ``free`` tells whether a torque is cut off in any of them.
    """
    a, da = angles(w, row), rates(w, row)
    s, c = dynamics.sines(a)
    if scheme == HZD:
        alpha, beta = hzd.command(par, a, da)
    else:
        for lane in range(LANES):
            al, be = _command(
                scheme,
                par,
                (
                    w[row, 0, lane],
                    w[row, 1, lane],
                    w[row, 2, lane],
                    w[row, 3, lane],
                    w[row, 4, lane],
                ),
                (
                    w[row, 5, lane],
                    w[row, 6, lane],
                    w[row, 7, lane],
                    w[row, 8, lane],
                    w[row, 9, lane],
                ),
                w[MODE, SWITCHED, lane],
            )
            for i in range(5):
                w[COMMAND, i, lane] = al[i]
                w[COMMAND, 5 + i, lane] = be[i]
        alpha, beta = angles(w, COMMAND), rates(w, COMMAND)
    dda, wanted = _wanted(rob, s, c, da, alpha, beta)
    applied = wanted
    if free:
        cut = (
            load(w, MODE, CUT),
            load(w, MODE, CUT + 1),
            load(w, MODE, CUT + 2),
            load(w, MODE, CUT + 3),
        )
        off = _off(scheme, load(w, MODE, SWITCHED))
        applied = _applied(rob, cut, off, wanted)
        is_cut = _is_cut(cut, off)
        moved = dynamics.free_motion(rob, s, c, da, applied)
        dda = (
            select(is_cut, moved[0], dda[0]),
            select(is_cut, moved[1], dda[1]),
            select(is_cut, moved[2], dda[2]),
            select(is_cut, moved[3], dda[3]),
            select(is_cut, moved[4], dda[4]),
        )
    return da, dda, wanted, applied, dynamics.ground_force(rob, s, c, da, dda), s, c


@kernel
def beyond(rob, cut, wanted):
    """How far the wanted torques are beyond where ``cut`` is right, at most, N m."""
    limit = rob[r.TORQUE_LIMIT]
    u0 = select(cut[0] == 0.0, abs(wanted[0]) - limit, limit - cut[0] * wanted[0])
    u1 = select(cut[1] == 0.0, abs(wanted[1]) - limit, limit - cut[1] * wanted[1])
    u2 = select(cut[2] == 0.0, abs(wanted[2]) - limit, limit - cut[2] * wanted[2])
    u3 = select(cut[3] == 0.0, abs(wanted[3]) - limit, limit - cut[3] * wanted[3])
    u0 = select(u1 > u0, u1, u0)
    u2 = select(u3 > u2, u3, u2)
    return select(u2 > u0, u2, u0)


@kernel
def which_cut(rob, wanted):
    """Which torques are beyond the limit: 0 or a sign for each joint."""
    limit = rob[r.TORQUE_LIMIT]
    return (
        (1.0 if wanted[0] > limit else 0.0) - (1.0 if wanted[0] < -limit else 0.0),
        (1.0 if wanted[1] > limit else 0.0) - (1.0 if wanted[1] < -limit else 0.0),
        (1.0 if wanted[2] > limit else 0.0) - (1.0 if wanted[2] < -limit else 0.0),
        (1.0 if wanted[3] > limit else 0.0) - (1.0 if wanted[3] < -limit else 0.0),
    )


@kernel
def closed_loop(scheme, switched, rob, par, y, rate, torques):
    """Time derivative of angles, rates and energy under a controller, for integrators of others.

    Parameters
    ----------
    scheme : int
        Code of the control scheme.
    switched : bool
        Whether the controller has switched.
    rob, par : numpy.ndarray
        Packed model and controller.
    y : numpy.ndarray
        Absolute angles (rad), rates (rad/s), and energy (J), shape (11,).
    rate, torques : numpy.ndarray
        Set to the derivative of ``y``, shape (11,), and to u1 to u4 (N m), shape (4,).
    """
    a, da = (y[0], y[1], y[2], y[3], y[4]), (y[5], y[6], y[7], y[8], y[9])
    after = 1.0 if switched else 0.0
    none = (0.0, 0.0, 0.0, 0.0)
    dda, wanted, applied, _, _, _ = motion(scheme, rob, par, none, after, a, da)
    if beyond(rob, none, wanted) > 0.0:
        cut = which_cut(rob, wanted)
        dda, _, applied, _, _, _ = motion(scheme, rob, par, cut, after, a, da)
    power = powers(applied, da)
    for i in range(5):
        rate[i] = da[i]
        rate[5 + i] = dda[i]
    rate[10] = abs(power[0]) + abs(power[1]) + abs(power[2]) + abs(power[3])
    for i in range(4):
        torques[i] = applied[i]


@kernel
def margin(rob, force):
    """How far the stance foot is from slipping, N: negative slips (eq. 4)."""
    return rob[r.FRICTION] * force[1] - abs(force[0])
