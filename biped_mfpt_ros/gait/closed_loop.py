"""The closed loop: angles and rates to accelerations, under a controller with limited torques."""

from __future__ import annotations

from biped_mfpt_ros.control import hzd, smc, spline
from biped_mfpt_ros.control.controller import HZD, SMC
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import ACC, TORQUE


@kernel
def closed_loop(scheme, switched, rob, par, work, y, rate):
    """Time derivative of angles, rates and energy under a controller (eq. 2, 8, 16).

    Torques beyond the limit are cut off, joint by joint; which ones are stands in
    ``work[TORQUE, 4]``, as a number that is zero for none.

    Returns
    -------
    tuple of float
        Force of the ground on the stance foot: tangential, normal, N.
    """
    dynamics.set_angles(work, y)
    work[TORQUE, 4] = 0.0
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
        elif scheme == SMC:
            smc.command(par, work, y, switched)
        else:
            spline.command(par, work, y)
        dynamics.prescribed_motion(rob, work, y)
        tangential, normal = dynamics.row_sum(rob, work, y)
        limit = rob[r.TORQUE_LIMIT]
        saturated = False
        for i in range(4):
            if not abs(work[TORQUE, i]) <= limit:
                saturated = True
                work[TORQUE, 4] = 3.0 * work[TORQUE, 4] + (1.0 if work[TORQUE, i] > 0.0 else 2.0)
                work[TORQUE, i] = min(limit, max(-limit, work[TORQUE, i]))
            else:
                work[TORQUE, 4] *= 3.0
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
def switch(scheme, par, y):
    """Positive before the controller's switch, negative after it."""
    if scheme == HZD:
        return hzd.switch(par, y)
    if scheme == SMC:
        return smc.switch(par, y)
    return 1.0


@kernel
def margin(rob, tangential, normal):
    """How far the stance foot is from slipping, N: negative slips (eq. 4)."""
    return rob[r.FRICTION] * normal - abs(tangential)
