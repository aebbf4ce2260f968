"""The impact map, eq. (3): the swing foot lands without rebound, and the legs change roles.

All impulses act at the landing foot. So the generalised momenta of the motions that keep that foot
at rest are conserved: with positions measured from it,

    D_new da+ = sum_j K_ij cos(a_i - a_j) da_j- + I_i da_i-,   K_ij = sum_k m_k (c_ki - f_i) c_kj

is a 5x5 system with the inertia matrix of the new stance leg. It follows from the conservation of
angular momentum about the new stance foot and about the joints [13], [14].
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import solve_spd, to_absolute, to_joint
from biped_mfpt_ros.walker.robot import Robot, WalkerModel

_S, _C, _DA, _DA_NEW = 0, 1, 2, 3
_MATRIX = 4
_RHS = 9
WORKSPACE_ROWS = 10


@kernel
def impact(rob, work, y, out):
    """Impact of the swing foot, in absolute angles.

    Parameters
    ----------
    rob : numpy.ndarray
        Packed robot.
    work : numpy.ndarray
        Workspace, shape (WORKSPACE_ROWS, 5) or larger.
    y : numpy.ndarray
        Absolute angles and rates before the impact, shape (10,) or longer.
    out : numpy.ndarray
        Absolute angles and rates after it, the legs swapped, shape (10,).

    Returns
    -------
    tuple of float
        Impulse of the ground on the landing foot (x, y), N s, and the velocity of the old stance
        foot after the impact (x, y), m/s.
    """
    for i in range(5):
        work[_S, i] = math.sin(y[i])
        work[_C, i] = math.cos(y[i])
        work[_DA, i] = y[5 + i]
    for i in range(5):
        total = rob[r.I_LINK + i] * work[_DA, i]
        for j in range(5):
            cosine = work[_C, i] * work[_C, j] + work[_S, i] * work[_S, j]
            total += rob[r.K_NEW + 5 * i + j] * cosine * work[_DA, j]
            if j <= i:
                work[_MATRIX + i, j] = rob[r.C_NEW + 5 * i + j] * cosine
        work[_MATRIX + i, i] += rob[r.I_LINK + i]
        work[_RHS, i] = total
    solve_spd(work, _MATRIX, _RHS, _DA_NEW)

    femur, tibia = rob[r.FEMUR], rob[r.TIBIA]
    # Velocity of the landing foot for the rates after the impact with the old stance foot at rest;
    # the landing foot is at rest, so the old stance foot has the opposite one.
    lift_x = 0.0
    lift_y = 0.0
    impulse_x = 0.0
    impulse_y = 0.0
    for i in range(5):
        arm = 0.0
        if i == 0:
            arm = -femur
        elif i == 1:
            arm = femur
        elif i == 2:
            arm = -tibia
        elif i == 3:
            arm = tibia
        lift_x += arm * work[_C, i] * work[_DA_NEW, i]
        lift_y += arm * work[_S, i] * work[_DA_NEW, i]
        # Momentum of the centre of mass, about the landing foot after, the stance foot before.
        new = (rob[r.W + i] - rob[r.MASS] * arm) * work[_DA_NEW, i]
        change = new - rob[r.W + i] * work[_DA, i]
        impulse_x -= work[_C, i] * change
        impulse_y -= work[_S, i] * change
    for i in range(5):
        partner = i ^ 1 if i < 4 else 4  # the same link of the other leg
        out[i] = y[partner]
        out[5 + i] = work[_DA_NEW, partner]
    return impulse_x, impulse_y, lift_x, lift_y


def impact_map(state: np.ndarray, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """State just after the impact of the swing foot, eq. (3).

    Parameters
    ----------
    state : numpy.ndarray
        ``[q, dq]`` just before the impact, rad and rad/s, shape (10,).
    robot : Robot
        The links.

    Returns
    -------
    state : numpy.ndarray
        ``[q, dq]`` just after it, the legs swapped, shape (10,).
    impulse : numpy.ndarray
        Impulse of the ground on the landing foot, horizontal and vertical, N s, shape (2,).
    """
    out = np.empty(10)
    work = np.zeros((WORKSPACE_ROWS, 5))
    packed = WalkerModel(robot=robot).packed()
    px, py, _, _ = impact(packed, work, to_absolute(np.asarray(state, dtype=np.float64)), out)
    return to_joint(out), np.array([px, py])
