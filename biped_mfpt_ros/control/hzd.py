"""Hybrid zero dynamics with PD control, section 3.1 of the paper.

The four relative angles q1 to q4 follow Bezier polynomials of the phase variable
``theta = c q = -(a_1 + a_3) / 2`` (eq. 11 to 13), with computed torques that leave
``ddh = -K_P h - K_D dh`` (eq. 8 to 10).
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import inlined_kernel, inner_kernel
from biped_mfpt_ros.walker.dynamics import direction, plain_sine_cosine
from biped_mfpt_ros.walker.impact import impact_map
from biped_mfpt_ros.walker.robot import ABSOLUTE, Robot, rabbit, weighted_sum

DEGREE = 6
"""M of eq. (12)."""

PARAMETERS = (
    "kp",
    "kd",
    *(f"alpha_{k}^{i}" for i in range(1, 5) for k in range(DEGREE + 1)),
)
"""Names of the parameters, in order: gains (1/s^2, 1/s), then coefficients (rad) joint by joint."""

# Offsets into the packed parameters.
_KP, _KD, _THETA_START, _SLOPE, _OFF, _MONOMIAL = 0, 1, 2, 3, 4, 5
PACKED_SIZE = _MONOMIAL + 4 * (DEGREE + 1)


@inlined_kernel
def _reference(par, k, tau):
    """A polynomial of degree 6 with its first and second derivative, by Horner's rule."""
    top = par[k + DEGREE]
    value = top * tau + par[k + 5]
    first = top * tau + value
    value = value * tau + par[k + 4]
    half = top * tau + first
    first = first * tau + value
    value = value * tau + par[k + 3]
    for n in range(2, -1, -1):
        half = half * tau + first
        first = first * tau + value
        value = value * tau + par[k + n]
    return value, first, 2.0 * half


@inlined_kernel
def _output(par, i, tau, tau_rate, angle, rate):
    """Acceleration ``A + B z`` of one output (eq. 8 to 10)."""
    value, first, second = _reference(par, _MONOMIAL + i * (DEGREE + 1), tau)
    error = angle - value
    error_rate = rate - first * tau_rate
    return (
        second * tau_rate * tau_rate - par[_KP] * error - par[_KD] * error_rate,
        first * par[_SLOPE],
    )


@inlined_kernel
def _tau(par, a):
    """Phase of the step (eq. 11): 0 at its start and 1 at its end on flat ground."""
    return (-0.5 * (a[0] + a[2]) - par[_THETA_START]) * par[_SLOPE]


@inlined_kernel
def command(par, a, da):
    """Accelerations ``alpha + beta z`` of the five links with ``z = ddtheta`` (eq. 8 to 13)."""
    tau = _tau(par, a)
    rate = -0.5 * (da[0] + da[2]) * par[_SLOPE]
    a1, b1 = _output(par, 0, tau, rate, a[0] - a[4], da[0] - da[4])
    a2, b2 = _output(par, 1, tau, rate, a[1] - a[4], da[1] - da[4])
    a3, b3 = _output(par, 2, tau, rate, a[2] - a[0], da[2] - da[0])
    a4, b4 = _output(par, 3, tau, rate, a[3] - a[1], da[3] - da[1])
    # z = -ddq_1 - ddq_3 / 2 - ddq_5 gives the torso, then the other links.
    a5 = -a1 - 0.5 * a3
    b5 = -1.0 - b1 - 0.5 * b3
    a1, b1, a2, b2 = a1 + a5, b1 + b5, a2 + a5, b2 + b5
    return (a1, a2, a3 + a1, a4 + a2, a5), (b1, b2, b3 + b1, b4 + b2, b5)


@inner_kernel
def switch(par, a):
    """Positive as long as torques are applied: ``tau_off - tau``."""
    return par[_OFF] - _tau(par, a)


def double_support(joints: np.ndarray, robot: Robot) -> np.ndarray:
    """Angles with both feet on flat ground.

    Parameters
    ----------
    joints : numpy.ndarray
        q1 to q4, rad, shape (4,).
    robot : Robot
        The links.

    Returns
    -------
    numpy.ndarray
        q1 to q5, rad, shape (5,): the torso angle for which the swing foot is level with and ahead
        of the stance foot.
    """
    q = np.append(joints, 0.0)
    s, c = np.array([plain_sine_cosine(a) for a in weighted_sum(q, ABSOLUTE.T).tolist()]).T
    foot = robot.swing_foot_position
    # Turning the whole robot by -phi brings a foot that stands at angle phi to angle zero.
    q[4] = -direction(-float(weighted_sum(foot, s)), float(weighted_sum(foot, c)))
    return q


def phase(q: np.ndarray) -> float:
    """Phase variable theta = c q, rad, for joint angles of shape (5,)."""
    return float(-q[0] - 0.5 * q[2] - q[4])


def swapped(q: np.ndarray) -> np.ndarray:
    """Joint angles or rates, shape (5,), with the legs' roles exchanged."""
    return q[[1, 0, 3, 2, 4]]


def phase_range(bezier: np.ndarray, robot: Robot) -> tuple[float, float]:
    """theta+ and theta- of eq. (11), rad: the phase at start and end of a step on flat ground."""
    end = double_support(bezier[:, DEGREE], robot)
    return phase(swapped(end)), phase(end)


def hybrid_invariant_start(
    alpha5: np.ndarray, alpha6: np.ndarray, robot: Robot | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients alpha_0 and alpha_1 that hybrid invariance demands (section 3.1, [12]).

    Without tracking error just before an impact on flat ground there shall be none just after it.

    Parameters
    ----------
    alpha5, alpha6 : numpy.ndarray
        Last two coefficients of q1 to q4, rad, shape (4,).
    robot : Robot, optional
        The links; RABBIT by default.

    Returns
    -------
    alpha0, alpha1 : numpy.ndarray
        First two coefficients of q1 to q4, rad, shape (4,).
    """
    robot = robot or rabbit()
    before, span = _before_impact(alpha5, alpha6, 1.0, robot)
    after, _ = impact_map(before, robot)
    alpha0 = after[:4]
    alpha1 = alpha0 + after[5:9] / phase(after[5:]) * span / DEGREE
    return alpha0, alpha1


def reference_state(parameters: np.ndarray, rate: float, robot: Robot) -> np.ndarray:
    """State just after an impact on flat ground, without tracking error.

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
    bezier = parameters[2 : 2 + 4 * (DEGREE + 1)].reshape(4, DEGREE + 1)
    before, _ = _before_impact(bezier[:, DEGREE - 1], bezier[:, DEGREE], rate, robot)
    return impact_map(before, robot)[0]


def _before_impact(
    alpha5: np.ndarray, alpha6: np.ndarray, rate: float, robot: Robot
) -> tuple[np.ndarray, float]:
    """State at the end of a step on flat ground without tracking error, and theta- - theta+."""
    q = double_support(alpha6, robot)
    span = phase(q) - phase(swapped(q))
    rates = np.empty(5)
    rates[:4] = DEGREE * (alpha6 - alpha5) / span * rate
    rates[4] = -rate - rates[0] - 0.5 * rates[2]
    return np.concatenate([q, rates]), span


def packed(parameters: np.ndarray, robot: Robot) -> np.ndarray:
    """Parameters as the kernels read them.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`, shape (30,), or with one more: the phase tau above which no torque is
        applied (section 6.3 of the paper), shape (31,).
    robot : Robot
        The links; they fix theta+ and theta-.

    Returns
    -------
    numpy.ndarray
        float64, shape (PACKED_SIZE,).

    Raises
    ------
    InputError
        If a gain is not positive or the phase does not advance over the step.
    """
    for name, value in zip(PARAMETERS[:2], parameters[:2], strict=True):
        if value <= 0.0:
            raise InputError(f"parameters[{name}]", float(value), "> 0")
    bezier = parameters[2 : 2 + 4 * (DEGREE + 1)].reshape(4, DEGREE + 1)
    start, end = phase_range(bezier, robot)
    if not abs(end - start) > 1e-6:
        raise InputError("parameters[alpha_6]", bezier[:, DEGREE].tolist(), "legs that are apart")
    out = np.empty(PACKED_SIZE)
    out[[_KP, _KD]] = parameters[:2]
    out[_THETA_START] = start
    out[_SLOPE] = 1.0 / (end - start)
    out[_OFF] = parameters[-1] if parameters.size > len(PARAMETERS) else math.inf
    with np.errstate(over="ignore", invalid="ignore"):
        monomials = weighted_sum(bezier.T[:, :, None], _bernstein_to_monomial())
    if not np.isfinite(monomials).all():
        raise InputError("parameters[alpha]", bezier.tolist(), "numbers whose sums are finite")
    out[_MONOMIAL:] = monomials.ravel()
    return out


def _bernstein_to_monomial() -> np.ndarray:
    """Matrix from Bernstein to monomial coefficients, shape (DEGREE + 1, DEGREE + 1)."""
    matrix = np.zeros((DEGREE + 1, DEGREE + 1))
    for k in range(DEGREE + 1):
        for n in range(k, DEGREE + 1):
            matrix[k, n] = (-1.0) ** (n - k) * math.comb(DEGREE, n) * math.comb(n, k)
    return matrix
