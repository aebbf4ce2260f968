"""B-spline references over the phase, with PD control: the paper's own conclusion (section 7).

The outputs of the sliding-mode scheme, the absolute angle of the swing femur theta_2 = q2 + q5, the
knees q3 and q4 and the torso q5 (eq. 14), follow cubic B-splines of the phase variable of hybrid
zero dynamics, ``theta = c q = -(a_1 + a_3) / 2``, with computed torques that leave
``ddh_i = -kp_i h_i - kd_i dh_i``.

A reference is ``sum_k c_k B((theta - theta_k) / spacing)`` with one bump B of the uniform cubic
B-spline on each of `COEFFICIENTS` equally spaced phases, from theta_first to theta_last. Beyond
both ends the first and the last coefficient go on for ever. So a reference

- is defined for every phase, and constant from one spacing beyond either end on,
- never leaves the range of its coefficients, as the bumps are positive and sum to one,
- has two continuous derivatives everywhere,

where a Bezier polynomial, made for 0 <= tau <= 1, runs away outside of it. As references and phase
are absolute, no hybrid invariance is asked for: after each impact the outputs converge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import select
from biped_mfpt_ros.walker.impact import impact_map
from biped_mfpt_ros.walker.robot import Robot, weighted_sum

COEFFICIENTS = 8
"""Of each output's reference."""

PARAMETERS = (
    *(f"kp_{i}" for i in range(1, 5)),
    *(f"kd_{i}" for i in range(1, 5)),
    "theta_first",
    "theta_last",
    *(f"c_{k}^{i}" for i in range(1, 5) for k in range(COEFFICIENTS)),
)
"""Names of the parameters, in order: gains (1/s^2, 1/s), phases of the first and the last
coefficient (rad), then the coefficients (rad) of theta_2, q3, q4 and q5."""

_GAINS, _FIRST, _LAST, _TABLE = 8, 8, 9, 10  # offsets into the parameters

# The references are kept piece by piece, as polynomials of the fraction of the spacing, from one
# spacing before theta_first to one after theta_last, and a constant piece before and after that.
_PIECES = COEFFICIENTS + 3
# Offsets into the packed parameters: gains, phase where the pieces begin, 1 / spacing, polynomials.
_KP, _KD, _START, _INVERSE, _PIECE = 0, 4, 8, 9, 10
PACKED_SIZE = _PIECE + _PIECES * 16

# Rows: four successive coefficients; columns: powers of the fraction of the spacing.
_BASIS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


@inner_kernel
def _output(par, i, piece, at, rate, value, value_rate):
    """Acceleration ``alpha + first z`` of one output."""
    k = _PIECE + 16 * piece + 4 * i
    a1, a2, a3 = par[k + 1], par[k + 2], par[k + 3]
    reference = par[k] + at * (a1 + at * (a2 + at * a3))
    first = (a1 + at * (2.0 * a2 + 3.0 * at * a3)) * par[_INVERSE]
    second = (2.0 * a2 + 6.0 * at * a3) * par[_INVERSE] * par[_INVERSE]
    alpha = (
        second * rate * rate
        - par[_KP + i] * (value - reference)
        - par[_KD + i] * (value_rate - first * rate)
    )
    return alpha, first


@inner_kernel
def _place(par, a):
    """Place of the phase among the pieces: from k to k + 1 in piece k."""
    return (-0.5 * (a[0] + a[2]) - par[_START]) * par[_INVERSE]


@inner_kernel
def piece_of(par, a):
    """The piece that the phase is in."""
    at = _place(par, a)
    if not at > 0.0:  # also where it is not a number
        return 0.0
    return float(int(min(at, _PIECES - 1.0)))


@inner_kernel
def within(par, a, piece):
    """How far the phase is inside of a piece, in spacings; negative outside of it."""
    at = _place(par, a)
    before, after = at - piece, piece + 1.0 - at
    if piece == 0.0:
        return after
    if piece == _PIECES - 1.0:
        return before
    return select(before < after, before, after)


@inner_kernel
def next_piece(par, a, piece):
    """The piece that follows where the phase leaves one."""
    return piece + (1.0 if _place(par, a) > piece + 0.5 else -1.0)


@inner_kernel
def command(par, a, da, piece):
    """Accelerations ``alpha + beta z`` of the five links with ``z = ddtheta``.

    From the polynomials of one piece, also where the phase has left it.
    """
    rate = -0.5 * (da[0] + da[2])
    at = _place(par, a) - piece
    piece = int(piece)
    v2, b2 = _output(par, 0, piece, at, rate, a[1], da[1])
    v3, b3 = _output(par, 1, piece, at, rate, a[2] - a[0], da[2] - da[0])
    v4, b4 = _output(par, 2, piece, at, rate, a[3] - a[1], da[3] - da[1])
    v5, b5 = _output(par, 3, piece, at, rate, a[4], da[4])
    # a_1 = -theta - q3 / 2 and a_3 = -theta + q3 / 2.
    return (
        (-0.5 * v3, v2, 0.5 * v3, v2 + v4, v5),
        (-1.0 - 0.5 * b3, b2, -1.0 + 0.5 * b3, b2 + b4, b5),
    )


def references(parameters: np.ndarray, theta: ArrayLike) -> np.ndarray:
    """References of the outputs and their derivatives with respect to the phase.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`.
    theta : array_like
        Phases, rad, of any shape.

    Returns
    -------
    numpy.ndarray
        Value (rad), first (1) and second derivative (1/rad) of theta_2, q3, q4, q5; shape (3, 4),
        and then that of the phases.
    """
    first, last = parameters[[_FIRST, _LAST]]
    spacing = (last - first) / (COEFFICIENTS - 1)
    at = np.clip((np.asarray(theta) - first) / spacing + 2.0, 0.0, _PIECES - 1.0)
    piece = at.astype(np.intp)
    x = at - piece
    a0, a1, a2, a3 = np.moveaxis(_polynomials(parameters)[piece], (-1, -2), (0, 1))
    return np.stack(
        [
            a0 + x * (a1 + x * (a2 + x * a3)),
            (a1 + x * (2.0 * a2 + 3.0 * x * a3)) / spacing,
            (2.0 * a2 + 6.0 * x * a3) / spacing**2,
        ]
    )


def reference_state(parameters: np.ndarray, rate: float, robot: Robot) -> np.ndarray:
    """State just after an impact on flat ground, without tracking error just before it.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`.
    rate : float
        dtheta just before the impact, rad/s.
    robot : Robot
        The links.

    Returns
    -------
    numpy.ndarray
        ``[q, dq]``, rad and rad/s, shape (10,).
    """
    # The last phase at which the swing foot comes down, else the one where it is lowest.
    first, last = parameters[[_FIRST, _LAST]]
    phases = np.linspace(0.5 * (first + last), 2.0 * last - first, 100)
    for _ in range(6):
        heights = robot.swing_foot_position @ np.cos(_angles(parameters, phases))
        down = np.flatnonzero((heights[:-1] > 0.0) & (heights[1:] <= 0.0))
        if down.size == 0:
            break
        phases = np.linspace(phases[down[-1]], phases[down[-1] + 1], 100)
    theta = float(phases[0] if down.size else phases[np.argmin(heights)])
    a = _angles(parameters, theta)
    d2, d3, d4, d5 = references(parameters, theta)[1] * rate
    d1 = -rate - 0.5 * d3
    q = np.array([a[0] - a[4], a[1] - a[4], a[2] - a[0], a[3] - a[1], a[4]])
    return impact_map(np.concatenate([q, [d1 - d5, d2 - d5, d3, d4, d5]]), robot)[0]


def _angles(parameters: np.ndarray, theta: ArrayLike) -> np.ndarray:
    """Absolute angles of the links without tracking error, shape (5,) and that of the phases."""
    theta2, q3, q4, q5 = references(parameters, theta)[0]
    theta1 = -np.asarray(theta) - 0.5 * q3
    return np.stack([theta1, theta2, theta1 + q3, theta2 + q4, q5])


def packed(parameters: np.ndarray, robot: Robot) -> np.ndarray:
    """Parameters as the kernels read them.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`.
    robot : Robot
        Not needed; every scheme is packed alike.

    Returns
    -------
    numpy.ndarray
        float64, shape (PACKED_SIZE,).

    Raises
    ------
    InputError
        If a gain is not positive or the phases do not ascend.
    """
    for name, value in zip(PARAMETERS[:_GAINS], parameters[:_GAINS], strict=True):
        if value <= 0.0:
            raise InputError(f"parameters[{name}]", float(value), "> 0")
    first, last = parameters[[_FIRST, _LAST]]
    if not last - first > 1e-3:
        raise InputError("parameters[theta_last]", float(last), f"above theta_first, {first:g} rad")
    spacing = (last - first) / (COEFFICIENTS - 1)
    out = np.empty(PACKED_SIZE)
    out[_KP : _KP + 4] = parameters[:4]
    out[_KD : _KD + 4] = parameters[4:8]
    out[_START] = first - 2.0 * spacing
    out[_INVERSE] = 1.0 / spacing
    out[_PIECE:] = _polynomials(parameters).ravel()
    return out


def _polynomials(parameters: np.ndarray) -> np.ndarray:
    """Polynomials of the references, piece by piece, shape (_PIECES, 4, 4): output, power."""
    table = parameters[_TABLE:].reshape(4, COEFFICIENTS)
    window = np.arange(_PIECES)[:, None] + np.arange(-3, 1)
    coefficients = table.T[np.clip(window.T, 0, COEFFICIENTS - 1)]
    return weighted_sum(coefficients[:, :, :, None], _BASIS)
