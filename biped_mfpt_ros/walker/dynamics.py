"""Equations of motion of the single support phase, eq. (1) and (2), in absolute angles.

With ``p_k = sum_j c_kj e(a_j)`` for every centre of mass, the inertia matrix is
``D_ij = C_ij cos(a_i - a_j) + I_i delta_ij`` with constant ``C``, and the equations are

    sum_j [D_ij dda_j + C_ij sin(a_i - a_j) da_j^2] - g w_i sin a_i = Q_i

with the joint torques ``Q = (u1 - u3, u2 - u4, u3, u4, -u1 - u2)``. Their sum holds no torque: it
is the angular momentum about the stance foot. So where a controller prescribes four accelerations,
``dda = alpha + beta z``, that one scalar equation gives ``z``, the others the torques, and no
system has to be solved (`prescribed_motion`). Where torques are given, the inertia matrix is
factorised (`solve`).

Every link beyond a joint hangs from it, so that ``C_ij`` is a product of ``w_j`` and a length for
most pairs of links, and zero for the torso and the swing leg (`coupling`).

The kernels take five angles, rates, sines ... as tuples, of numbers or of `Lanes`.
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import negated_if_odd
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.robot import ABSOLUTE, C, Robot, W, WalkerModel

# pi in two parts, the first of 33 bits: a multiple of it up to 2^20 is exact.
_ONE_OVER_PI = 1.0 / math.pi
_PI_1, _PI_2 = 3.14159265346825122833, 1.21542010130123852030e-10
# Minimax polynomials of z = x^2 on |x| <= pi/2, sin x = x + x z P(z) and cos x = 1 + z Q(z), good
# to 1.1e-16 and 2.1e-15 (Remez's algorithm in 60 digits). Reducing by pi/2 would take shorter ones,
# but selections between the two.
_S0, _S1, _S2 = -0.166666666666658124517, 8.33333333326290254085e-3, -1.98412698200999517168e-4
_S3, _S4, _S5 = 2.75573160776629966540e-6, -2.50518515347172535256e-8, 1.60473022579651046159e-10
_S6 = -7.36465807087021042561e-13
_C0, _C1, _C2 = -0.499999999999931192942, 4.16666666659542008159e-2, -1.38888888639337315290e-3
_C3, _C4, _C5 = 2.48015831562832136637e-5, -2.75569507514182938429e-7, 2.08587350659186485214e-9
_C6 = -1.10124905199128749597e-11
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and subtracting it rounds to an integer


def plain_sine_cosine(angle):
    """Sine and cosine at once, to within 3e-15 for angles up to 1e5 rad.

    The C library's differ in their last bit from machine to machine, with the instructions that it
    chooses; these do not, so that every machine simulates the same step to the last bit.
    """
    rounded = angle * _ONE_OVER_PI + _ROUND
    half_turns = rounded - _ROUND
    x = (angle - half_turns * _PI_1) - half_turns * _PI_2
    z = x * x
    sine = (((((_S6 * z + _S5) * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0
    cosine = (((((_C6 * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0
    return negated_if_odd(x + x * z * sine, rounded), negated_if_odd(1.0 + z * cosine, rounded)


sine_cosine = inner_kernel(plain_sine_cosine)
"""The same for kernels: what only reads parameters should not wait for a compiler."""


def direction(x: float, y: float) -> float:
    """Angle of the vector (x, y) from the first axis, rad, -pi to pi.

    By Newton's method on `plain_sine_cosine`: the same bits on every machine, unlike the C
    library's.
    """
    angle = 0.0
    if abs(y) > abs(x):
        angle = 0.5 * math.pi if y > 0.0 else -0.5 * math.pi
    elif x < 0.0:
        angle = math.pi if y >= 0.0 else -math.pi
    # At most 45 degrees are left. An error e becomes e^3 / 3 or less: 0.22, 4e-3, 2e-8, rounding.
    for _ in range(5):
        s, c = plain_sine_cosine(angle)
        angle += (y * c - x * s) / (x * c + y * s)
    return angle


@inner_kernel
def sines(a):
    """Sines and cosines of five angles."""
    s0, c0 = sine_cosine(a[0])
    s1, c1 = sine_cosine(a[1])
    s2, c2 = sine_cosine(a[2])
    s3, c3 = sine_cosine(a[3])
    s4, c4 = sine_cosine(a[4])
    return (s0, s1, s2, s3, s4), (c0, c1, c2, c3, c4)


@inner_kernel
def coupling(rob, x):
    """``C x`` for five numbers, one for each link."""
    x0, x1, x2, x3, x4 = x
    beyond = rob[W + 1] * x1 + rob[W + 3] * x3 + rob[W + 4] * x4  # the hip: swing leg and torso
    hip = rob[r.FEMUR] * x0 + rob[r.TIBIA] * x2
    return (
        rob[C] * x0 + rob[C + 2] * x2 - rob[r.FEMUR] * beyond,
        rob[C + 6] * x1 + rob[C + 8] * x3 - rob[W + 1] * hip,
        rob[C + 12] * x2 + rob[C + 2] * x0 - rob[r.TIBIA] * beyond,
        rob[C + 18] * x3 + rob[C + 8] * x1 - rob[W + 3] * hip,
        rob[C + 24] * x4 - rob[W + 4] * hip,
    )


@inner_kernel
def weighted(rob, x):
    """``sum_i w_i x_i`` for five numbers, one for each link."""
    return (
        rob[W] * x[0]
        + rob[W + 1] * x[1]
        + rob[W + 2] * x[2]
        + rob[W + 3] * x[3]
        + rob[W + 4] * x[4]
    )


@inner_kernel
def link_accelerations(s, c, da, dda):
    """Second derivatives of the five ``-e(a_i)``, 1/s^2: tuples of x and of y."""
    q0, q1, q2 = da[0] * da[0], da[1] * da[1], da[2] * da[2]
    q3, q4 = da[3] * da[3], da[4] * da[4]
    x = (
        c[0] * dda[0] - s[0] * q0,
        c[1] * dda[1] - s[1] * q1,
        c[2] * dda[2] - s[2] * q2,
        c[3] * dda[3] - s[3] * q3,
        c[4] * dda[4] - s[4] * q4,
    )
    y = (
        s[0] * dda[0] + c[0] * q0,
        s[1] * dda[1] + c[1] * q1,
        s[2] * dda[2] + c[2] * q2,
        s[3] * dda[3] + c[3] * q3,
        s[4] * dda[4] + c[4] * q4,
    )
    return x, y


@inner_kernel
def ground_force(rob, x, y):
    """Force of the ground on the stance foot in the vertical frame: tangential, normal, N.

    ``x`` and ``y`` are `link_accelerations`.
    """
    return -weighted(rob, x), rob[r.MASS] * rob[r.GRAVITY] - weighted(rob, y)


@inner_kernel
def required_torques(rob, s, c, dda, x, y):
    """Torques u1 to u4 for given accelerations, N m; ``x``, ``y`` are `link_accelerations`."""
    u = coupling(rob, x)
    v = coupling(rob, y)
    g = rob[r.GRAVITY]
    q0 = c[0] * u[0] + s[0] * (v[0] - g * rob[W]) + rob[r.I_LINK] * dda[0]
    q1 = c[1] * u[1] + s[1] * (v[1] - g * rob[W + 1]) + rob[r.I_LINK + 1] * dda[1]
    q2 = c[2] * u[2] + s[2] * (v[2] - g * rob[W + 2]) + rob[r.I_LINK + 2] * dda[2]
    q3 = c[3] * u[3] + s[3] * (v[3] - g * rob[W + 3]) + rob[r.I_LINK + 3] * dda[3]
    return (q0 + q2, q1 + q3, q2, q3)


@inner_kernel
def prescribed_motion(rob, s, c, da, alpha, beta):
    """Accelerations ``alpha + beta z`` that fulfil the torque-free equation, rad/s^2.

    Where the factor of ``z`` vanishes, the controller cannot be realised and they are not finite.
    """
    p = coupling(rob, c)
    q = coupling(rob, s)
    d0 = c[0] * p[0] + s[0] * q[0] + rob[r.I_LINK]
    d1 = c[1] * p[1] + s[1] * q[1] + rob[r.I_LINK + 1]
    d2 = c[2] * p[2] + s[2] * q[2] + rob[r.I_LINK + 2]
    d3 = c[3] * p[3] + s[3] * q[3] + rob[r.I_LINK + 3]
    d4 = c[4] * p[4] + s[4] * q[4] + rob[r.I_LINK + 4]
    centrifugal = (
        (q[0] * c[0] - p[0] * s[0]) * da[0] * da[0]
        + (q[1] * c[1] - p[1] * s[1]) * da[1] * da[1]
        + (q[2] * c[2] - p[2] * s[2]) * da[2] * da[2]
        + (q[3] * c[3] - p[3] * s[3]) * da[3] * da[3]
        + (q[4] * c[4] - p[4] * s[4]) * da[4] * da[4]
    )
    rest = (d0 * alpha[0] + d1 * alpha[1] + d2 * alpha[2] + d3 * alpha[3] + d4 * alpha[4]) + (
        centrifugal - rob[r.GRAVITY] * weighted(rob, s)
    )
    factor = d0 * beta[0] + d1 * beta[1] + d2 * beta[2] + d3 * beta[3] + d4 * beta[4]
    z = -rest / factor
    return (
        alpha[0] + beta[0] * z,
        alpha[1] + beta[1] * z,
        alpha[2] + beta[2] * z,
        alpha[3] + beta[3] * z,
        alpha[4] + beta[4] * z,
    )


@inner_kernel
def solve(rob, s, c, right):
    """Solve ``D x = right``, D the inertia matrix, by an L D L^T factorisation.

    The torso and the swing tibia come first: they are coupled to few links.
    """
    i = r.I_LINK
    over44, over33 = 1.0 / (rob[C + 24] + rob[i + 4]), 1.0 / (rob[C + 18] + rob[i + 3])
    d40 = rob[C + 20] * (c[4] * c[0] + s[4] * s[0])
    d42 = rob[C + 22] * (c[4] * c[2] + s[4] * s[2])
    d30 = rob[C + 15] * (c[3] * c[0] + s[3] * s[0])
    d31 = rob[C + 16] * (c[3] * c[1] + s[3] * s[1])
    d32 = rob[C + 17] * (c[3] * c[2] + s[3] * s[2])
    d10 = rob[C + 5] * (c[1] * c[0] + s[1] * s[0])
    d12 = rob[C + 7] * (c[1] * c[2] + s[1] * s[2])
    d02 = rob[C + 2] * (c[0] * c[2] + s[0] * s[2])
    d00, d11, d22 = rob[C] + rob[i], rob[C + 6] + rob[i + 1], rob[C + 12] + rob[i + 2]

    l40, l42 = d40 * over44, d42 * over44
    l30, l31, l32 = d30 * over33, d31 * over33, d32 * over33
    d00 = d00 - l40 * d40 - l30 * d30
    d02 = d02 - l40 * d42 - l30 * d32
    d22 = d22 - l42 * d42 - l32 * d32
    d11 = d11 - l31 * d31
    d10 = d10 - l31 * d30
    d12 = d12 - l31 * d32
    over11 = 1.0 / d11
    l10, l12 = d10 * over11, d12 * over11
    d00 = d00 - l10 * d10
    d02 = d02 - l10 * d12
    d22 = d22 - l12 * d12
    over00 = 1.0 / d00
    l02 = d02 * over00
    d22 = d22 - l02 * d02

    y1 = right[1] - l31 * right[3]
    y0 = right[0] - l40 * right[4] - l30 * right[3] - l10 * y1
    y2 = right[2] - l42 * right[4] - l32 * right[3] - l12 * y1 - l02 * y0
    x2 = y2 / d22
    x0 = y0 * over00 - l02 * x2
    x1 = y1 * over11 - l10 * x0 - l12 * x2
    x3 = right[3] * over33 - l30 * x0 - l31 * x1 - l32 * x2
    x4 = right[4] * over44 - l40 * x0 - l42 * x2
    return (x0, x1, x2, x3, x4)


@inner_kernel
def free_motion(rob, s, c, da, u):
    """Accelerations under the torques u1 to u4 (eq. 2), rad/s^2."""
    qc = (
        c[0] * da[0] * da[0],
        c[1] * da[1] * da[1],
        c[2] * da[2] * da[2],
        c[3] * da[3] * da[3],
        c[4] * da[4] * da[4],
    )
    qs = (
        s[0] * da[0] * da[0],
        s[1] * da[1] * da[1],
        s[2] * da[2] * da[2],
        s[3] * da[3] * da[3],
        s[4] * da[4] * da[4],
    )
    p = coupling(rob, qc)
    q = coupling(rob, qs)
    g = rob[r.GRAVITY]
    right = (
        u[0] - u[2] + s[0] * (g * rob[W] - p[0]) + c[0] * q[0],
        u[1] - u[3] + s[1] * (g * rob[W + 1] - p[1]) + c[1] * q[1],
        u[2] + s[2] * (g * rob[W + 2] - p[2]) + c[2] * q[2],
        u[3] + s[3] * (g * rob[W + 3] - p[3]) + c[3] * q[3],
        -u[0] - u[1] + s[4] * (g * rob[W + 4] - p[4]) + c[4] * q[4],
    )
    return solve(rob, s, c, right)


@inner_kernel
def change_of_motion(rob, s, c, u):
    """By how much accelerations change with a change of the torques u1 to u4, rad/s^2."""
    return solve(rob, s, c, (u[0] - u[2], u[1] - u[3], u[2], u[3], -u[0] - u[1]))


@inner_kernel
def foot(rob, s, c, da):
    """Position and velocity of the swing foot from the stance foot: x, y (m), dx, dy (m/s)."""
    femur, tibia = rob[r.FEMUR], rob[r.TIBIA]
    return (
        femur * (s[0] - s[1]) + tibia * (s[2] - s[3]),
        femur * (c[1] - c[0]) + tibia * (c[3] - c[2]),
        femur * (c[0] * da[0] - c[1] * da[1]) + tibia * (c[2] * da[2] - c[3] * da[3]),
        femur * (s[0] * da[0] - s[1] * da[1]) + tibia * (s[2] * da[2] - s[3] * da[3]),
    )


@inner_kernel
def swing_foot(rob, y):
    """Position and velocity of the swing foot, for angles and rates in an array."""
    s, c = sines((y[0], y[1], y[2], y[3], y[4]))
    return foot(rob, s, c, (y[5], y[6], y[7], y[8], y[9]))


def to_absolute(states: np.ndarray) -> np.ndarray:
    """States ``[q, dq]``, shape (..., 10), as absolute angles and their rates."""
    return np.concatenate([states[..., :5] @ ABSOLUTE.T, states[..., 5:] @ ABSOLUTE.T], axis=-1)


def to_joint(absolute: np.ndarray) -> np.ndarray:
    """Absolute angles and rates, shape (..., 10), as states ``[q, dq]``."""
    out = np.empty_like(absolute)
    for o in (0, 5):
        a = absolute[..., o : o + 5]
        out[..., o] = a[..., 0] - a[..., 4]
        out[..., o + 1] = a[..., 1] - a[..., 4]
        out[..., o + 2] = a[..., 2] - a[..., 0]
        out[..., o + 3] = a[..., 3] - a[..., 1]
        out[..., o + 4] = a[..., 4]
    return out


def inertia_matrix(q: np.ndarray, robot: Robot) -> np.ndarray:
    """Inertia matrix D(q) of eq. (1) in the joint angles, kg m^2, shape (5, 5)."""
    a = ABSOLUTE @ q
    packed = WalkerModel(robot=robot).packed()
    coupling = packed[C : C + 25].reshape(5, 5)
    absolute = coupling * np.cos(a[:, None] - a[None, :]) + np.diag(robot.link_inertias)
    return ABSOLUTE.T @ absolute @ ABSOLUTE


def accelerations(state: np.ndarray, torques: np.ndarray, robot: Robot) -> np.ndarray:
    """Joint accelerations of eq. (2).

    Parameters
    ----------
    state : numpy.ndarray
        ``[q, dq]``, rad and rad/s, shape (10,).
    torques : numpy.ndarray
        u1 to u4, N m, shape (4,).
    robot : Robot
        The links.

    Returns
    -------
    numpy.ndarray
        ddq, rad/s^2, shape (5,).
    """
    y = to_absolute(np.asarray(state, dtype=np.float64))
    s, c = sines(tuple(y[:5]))
    packed = WalkerModel(robot=robot).packed()
    found = free_motion(packed, s, c, tuple(y[5:]), tuple(np.asarray(torques, dtype=np.float64)))
    return np.linalg.solve(ABSOLUTE, np.array(found))


def energy(state: np.ndarray, robot: Robot) -> tuple[float, float]:
    """Kinetic and potential energy, J, the stance foot at height zero."""
    q, dq = state[:5], state[5:]
    kinetic = 0.5 * float(dq @ inertia_matrix(q, robot) @ dq)
    height = float(robot.link_masses @ robot.link_positions @ np.cos(ABSOLUTE @ q))
    return kinetic, robot.gravity * height
