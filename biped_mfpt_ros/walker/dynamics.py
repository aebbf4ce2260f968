"""Equations of motion of the single support phase, eq. (1) and (2), in absolute angles.

With ``p_k = sum_j c_kj e(a_j)`` for every centre of mass, the inertia matrix is
``D_ij = C_ij cos(a_i - a_j) + I_i delta_ij`` with constant ``C``, and the equations are

    sum_j [D_ij dda_j + C_ij sin(a_i - a_j) da_j^2] - g w_i sin a_i = Q_i

with the joint torques ``Q = (u1 - u3, u2 - u4, u3, u4, -u1 - u2)``. Their sum holds no torque: it
is the angular momentum about the stance foot. So where a controller prescribes four accelerations,
``dda = alpha + beta z``, that one scalar equation gives ``z``, the others the torques, and no
system has to be solved (`prescribed_motion`). Where torques are given, the inertia matrix is
factorised (`free_motion`).
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.robot import ABSOLUTE, C, Robot, W, WalkerModel

# Rows of the workspace of the kernels, each of five numbers: one for each link.
SIN, COS, ALPHA, BETA, ACC, TORQUE = range(6)
WORKSPACE_ROWS = 12
_MATRIX = 6  # five more rows: a factorised inertia matrix
_RHS = 11


# Cephes' polynomials on [-pi/4, pi/4] and pi/2 in three parts (Cody and Waite).
_TWO_OVER_PI = 2.0 / math.pi
_PIO2_1, _PIO2_2 = 1.57079625129699707031e0, 7.54978941586159635335e-8
_PIO2_3 = 5.390302529957765e-15
_SIN = (
    1.58962301576546568060e-10,
    -2.50507477628578072866e-8,
    2.75573136213857245213e-6,
    -1.98412698295895385996e-4,
    8.33333333332211858878e-3,
    -1.66666666666666307295e-1,
)
_COS = (
    -1.13585365213876817300e-11,
    2.08757008419747316778e-9,
    -2.75573141792967388112e-7,
    2.48015872888517045348e-5,
    -1.38888888888730564116e-3,
    4.16666666666665929218e-2,
)


@kernel
def sine_cosine(angle):
    """Sine and cosine at once, to within 2 units in the last place for angles up to 1e5 rad.

    The C library's differ in their last bit from machine to machine, with the instructions that it
    chooses; these do not, so that every machine simulates the same step to the last bit.
    """
    quadrant = math.floor(angle * _TWO_OVER_PI + 0.5)
    x = ((angle - quadrant * _PIO2_1) - quadrant * _PIO2_2) - quadrant * _PIO2_3
    z = x * x
    sine = _SIN[0]
    cosine = _COS[0]
    for i in range(1, 6):
        sine = sine * z + _SIN[i]
        cosine = cosine * z + _COS[i]
    sine = x + x * z * sine
    cosine = 1.0 - 0.5 * z + z * z * cosine
    half = 0.5 * quadrant
    if half != math.floor(half):
        sine, cosine = cosine, -sine
    half = math.floor(half) * 0.5
    if half != math.floor(half):
        sine, cosine = -sine, -cosine
    return sine, cosine


@kernel
def set_angles(work, y):
    """Put sines and cosines of the absolute angles ``y[:5]`` into the workspace."""
    for i in range(5):
        work[SIN, i], work[COS, i] = sine_cosine(y[i])


@kernel
def row_sum(rob, work, y):
    """Right-hand sides of the torques' rows for the accelerations in the workspace.

    Sets ``work[TORQUE, :4]`` to u1 to u4 (N m) and returns the force of the ground on the stance
    foot, (tangential, normal) in the vertical frame, N.
    """
    s0, s1, s2, s3, s4 = work[SIN, 0], work[SIN, 1], work[SIN, 2], work[SIN, 3], work[SIN, 4]
    c0, c1, c2, c3, c4 = work[COS, 0], work[COS, 1], work[COS, 2], work[COS, 3], work[COS, 4]
    q0, q1, q2, q3, q4 = y[5] * y[5], y[6] * y[6], y[7] * y[7], y[8] * y[8], y[9] * y[9]
    d0, d1, d2, d3, d4 = work[ACC, 0], work[ACC, 1], work[ACC, 2], work[ACC, 3], work[ACC, 4]
    # Second derivative of e(a_j) is -(x_j, y_j).
    x0, x1, x2 = c0 * d0 - s0 * q0, c1 * d1 - s1 * q1, c2 * d2 - s2 * q2
    x3, x4 = c3 * d3 - s3 * q3, c4 * d4 - s4 * q4
    y0, y1, y2 = s0 * d0 + c0 * q0, s1 * d1 + c1 * q1, s2 * d2 + c2 * q2
    y3, y4 = s3 * d3 + c3 * q3, s4 * d4 + c4 * q4
    g = rob[r.GRAVITY]
    for i in range(4):
        k = C + 5 * i
        u = rob[k] * x0 + rob[k + 1] * x1 + rob[k + 2] * x2 + rob[k + 3] * x3 + rob[k + 4] * x4
        v = rob[k] * y0 + rob[k + 1] * y1 + rob[k + 2] * y2 + rob[k + 3] * y3 + rob[k + 4] * y4
        work[TORQUE, i] = (
            work[COS, i] * u
            + work[SIN, i] * (v - g * rob[W + i])
            + rob[r.I_LINK + i] * work[ACC, i]
        )
    work[TORQUE, 0] += work[TORQUE, 2]
    work[TORQUE, 1] += work[TORQUE, 3]
    tangential = -(
        rob[W] * x0 + rob[W + 1] * x1 + rob[W + 2] * x2 + rob[W + 3] * x3 + rob[W + 4] * x4
    )
    normal = rob[r.MASS] * g - (
        rob[W] * y0 + rob[W + 1] * y1 + rob[W + 2] * y2 + rob[W + 3] * y3 + rob[W + 4] * y4
    )
    return tangential, normal


@kernel
def prescribed_motion(rob, work, y):
    """Accelerations ``alpha + beta z`` that fulfil the torque-free equation.

    Reads SIN, COS, ALPHA and BETA of the workspace, sets ACC (rad/s^2). Returns the factor of
    ``z``; where it vanishes the controller cannot be realised and ACC is not finite.
    """
    s0, s1, s2, s3, s4 = work[SIN, 0], work[SIN, 1], work[SIN, 2], work[SIN, 3], work[SIN, 4]
    c0, c1, c2, c3, c4 = work[COS, 0], work[COS, 1], work[COS, 2], work[COS, 3], work[COS, 4]
    factor = 0.0
    rest = 0.0
    for j in range(5):
        k = C + 5 * j
        p = rob[k] * c0 + rob[k + 1] * c1 + rob[k + 2] * c2 + rob[k + 3] * c3 + rob[k + 4] * c4
        q = rob[k] * s0 + rob[k + 1] * s1 + rob[k + 2] * s2 + rob[k + 3] * s3 + rob[k + 4] * s4
        inertia = work[COS, j] * p + work[SIN, j] * q + rob[r.I_LINK + j]
        centrifugal = q * work[COS, j] - p * work[SIN, j]
        factor += inertia * work[BETA, j]
        rest += (
            inertia * work[ALPHA, j]
            + centrifugal * y[5 + j] * y[5 + j]
            - rob[r.GRAVITY] * rob[W + j] * work[SIN, j]
        )
    z = -rest / factor
    for j in range(5):
        work[ACC, j] = work[ALPHA, j] + work[BETA, j] * z
    return factor


@kernel
def free_motion(rob, work, y):
    """Accelerations under the joint torques in the workspace (eq. 2).

    Reads SIN, COS and TORQUE of the workspace, sets ACC (rad/s^2), by a Cholesky factorisation of
    the inertia matrix.
    """
    u0, u1, u2, u3 = work[TORQUE, 0], work[TORQUE, 1], work[TORQUE, 2], work[TORQUE, 3]
    work[_RHS, 0] = u0 - u2
    work[_RHS, 1] = u1 - u3
    work[_RHS, 2] = u2
    work[_RHS, 3] = u3
    work[_RHS, 4] = -u0 - u1
    for i in range(5):
        total = rob[r.GRAVITY] * rob[W + i] * work[SIN, i]
        for j in range(5):
            sine = work[SIN, i] * work[COS, j] - work[COS, i] * work[SIN, j]
            total -= rob[C + 5 * i + j] * sine * y[5 + j] * y[5 + j]
        work[_RHS, i] += total
        for j in range(i + 1):
            cosine = work[COS, i] * work[COS, j] + work[SIN, i] * work[SIN, j]
            work[_MATRIX + i, j] = rob[C + 5 * i + j] * cosine
        work[_MATRIX + i, i] += rob[r.I_LINK + i]
    solve_spd(work, _MATRIX, _RHS, ACC)


@kernel
def solve_spd(work, matrix, right, out):
    """Solve a 5x5 symmetric positive definite system in place, by Cholesky (L D L^T).

    The lower triangle stands in the rows ``matrix`` to ``matrix + 4``, the right-hand side in the
    row ``right``, and the solution goes into the row ``out`` of the workspace.
    """
    for j in range(5):
        for k in range(j):
            product = work[matrix + j, k] * work[matrix + k, k]
            work[matrix + j, j] -= work[matrix + j, k] * product
            for i in range(j + 1, 5):
                work[matrix + i, j] -= work[matrix + i, k] * product
        inverse = 1.0 / work[matrix + j, j]
        for i in range(j + 1, 5):
            work[matrix + i, j] *= inverse
    for i in range(5):
        total = work[right, i]
        for k in range(i):
            total -= work[matrix + i, k] * work[out, k]
        work[out, i] = total
    for i in range(4, -1, -1):
        total = work[out, i] / work[matrix + i, i]
        for k in range(i + 1, 5):
            total -= work[matrix + k, i] * work[out, k]
        work[out, i] = total


@kernel
def swing_foot(rob, y):
    """Position and velocity of the swing foot from the stance foot: x, y (m), dx, dy (m/s)."""
    femur, tibia = rob[r.FEMUR], rob[r.TIBIA]
    s0, s1, s2, s3 = math.sin(y[0]), math.sin(y[1]), math.sin(y[2]), math.sin(y[3])
    c0, c1, c2, c3 = math.cos(y[0]), math.cos(y[1]), math.cos(y[2]), math.cos(y[3])
    return (
        femur * (s0 - s1) + tibia * (s2 - s3),
        femur * (c1 - c0) + tibia * (c3 - c2),
        femur * (c0 * y[5] - c1 * y[6]) + tibia * (c2 * y[7] - c3 * y[8]),
        femur * (s0 * y[5] - s1 * y[6]) + tibia * (s2 * y[7] - s3 * y[8]),
    )


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
    work = np.zeros((WORKSPACE_ROWS, 5))
    y = to_absolute(np.asarray(state, dtype=np.float64))
    set_angles(work, y)
    work[TORQUE, :4] = torques
    free_motion(WalkerModel(robot=robot).packed(), work, y)
    return np.linalg.solve(ABSOLUTE, work[ACC])


def energy(state: np.ndarray, robot: Robot) -> tuple[float, float]:
    """Kinetic and potential energy, J, the stance foot at height zero."""
    q, dq = state[:5], state[5:]
    kinetic = 0.5 * float(dq @ inertia_matrix(q, robot) @ dq)
    height = float(robot.link_masses @ robot.link_positions @ np.cos(ABSOLUTE @ q))
    return kinetic, robot.gravity * height
