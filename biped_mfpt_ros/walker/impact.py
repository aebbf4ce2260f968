"""The impact map, eq. (3): the swing foot lands without rebound, and the legs change roles.

All impulses act at the landing foot. So the generalised momenta of the motions that keep that foot
at rest are conserved: with positions measured from it,

    D_new da+ = sum_j K_ij cos(a_i - a_j) da_j- + I_i da_i-,   K_ij = sum_k m_k (c_ki - f_i) c_kj

is a 5x5 system with the inertia matrix of the new stance leg; ``K_ij = C_ij - f_i w_j`` for a
landing foot at ``sum_i f_i e(a_i)``. It follows from the conservation of angular momentum about the
new stance foot and about the joints [13], [14].
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import coupling, sines, solve, to_absolute, to_joint, weighted
from biped_mfpt_ros.walker.robot import Robot, WalkerModel


@inner_kernel
def swapped(x):
    """Five numbers with the legs' roles exchanged."""
    return (x[1], x[0], x[3], x[2], x[4])


@inner_kernel
def impact(rob, s, c, da):
    """Impact of the swing foot, in absolute angles.

    Parameters
    ----------
    rob : numpy.ndarray
        Packed robot.
    s, c, da : tuple of five
        Sines and cosines of the angles, and the rates before the impact, rad/s.

    Returns
    -------
    tuple
        Rates after it, the legs swapped (a tuple of five); impulse of the ground on the landing
        foot (x, y), N s, and the velocity of the old stance foot after the impact (x, y), m/s.
    """
    femur, tibia = rob[r.FEMUR], rob[r.TIBIA]
    mc = (c[0] * da[0], c[1] * da[1], c[2] * da[2], c[3] * da[3], c[4] * da[4])
    ms = (s[0] * da[0], s[1] * da[1], s[2] * da[2], s[3] * da[3], s[4] * da[4])
    p = coupling(rob, mc)
    q = coupling(rob, ms)
    px = weighted(rob, mc)  # momentum of the whole: -x, -y
    py = weighted(rob, ms)
    # The landing foot is at f_i e(a_i), f = (-femur, femur, -tibia, tibia, 0).
    right = (
        c[0] * (p[0] + femur * px) + s[0] * (q[0] + femur * py) + rob[r.I_LINK] * da[0],
        c[1] * (p[1] - femur * px) + s[1] * (q[1] - femur * py) + rob[r.I_LINK + 1] * da[1],
        c[2] * (p[2] + tibia * px) + s[2] * (q[2] + tibia * py) + rob[r.I_LINK + 2] * da[2],
        c[3] * (p[3] - tibia * px) + s[3] * (q[3] - tibia * py) + rob[r.I_LINK + 3] * da[3],
        c[4] * p[4] + s[4] * q[4] + rob[r.I_LINK + 4] * da[4],
    )
    new_s, new_c = swapped(s), swapped(c)
    rates = solve(rob, new_s, new_c, swapped(right))
    nc = (
        new_c[0] * rates[0],
        new_c[1] * rates[1],
        new_c[2] * rates[2],
        new_c[3] * rates[3],
        new_c[4] * rates[4],
    )
    ns = (
        new_s[0] * rates[0],
        new_s[1] * rates[1],
        new_s[2] * rates[2],
        new_s[3] * rates[3],
        new_s[4] * rates[4],
    )
    # Change of the momentum, about the landing foot after, about the stance foot before.
    impulse_x = px - weighted(rob, nc)
    impulse_y = py - weighted(rob, ns)
    lift_x = femur * (nc[0] - nc[1]) + tibia * (nc[2] - nc[3])
    lift_y = femur * (ns[0] - ns[1]) + tibia * (ns[2] - ns[3])
    return rates, impulse_x, impulse_y, lift_x, lift_y


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
    y = to_absolute(np.asarray(state, dtype=np.float64))
    sin, cos = sines(tuple(y[:5]))
    rates, px, py, _, _ = impact(WalkerModel(robot=robot).packed(), sin, cos, tuple(y[5:]))
    return to_joint(np.array(swapped(tuple(y[:5])) + rates)), np.array([px, py])
