"""Sliding mode control with piecewise constant references, section 3.2 of the paper.

The outputs theta_2 = q2 + q5, q3, q4 and q5 (eq. 14) are driven to references that switch once, as
the stance femur passes the vertical (eq. 22), by ``v = -k |sigma|^(2 alpha - 1) sign(sigma)`` with
``sigma = dh + h / tau`` (eq. 18, 21).

The law near sigma = 0
----------------------
There the exponent below one makes the law infinitely steep, and no explicit integrator can follow
it, nor is it of interest how fast an output settles that settles at once. So its slope is bounded
twice, far above the rates of the gait (some 20/s):

- By `STEEPEST` about sigma = 0: below ``(k / STEEPEST)^(1 / (2 - 2 alpha))``, some 1e-5 rad/s, the
  law is linear. That moves an output by some 1e-6 rad. It also covers 2 alpha - 1 <= 0, outside of
  what the paper allows but present in its Table 3, where the law jumps at sigma = 0: the output
  then slides there (Filippov), without the chatter that a literal sign function would leave.
- By `SLIDING_RATE` about the slow manifold, where an output in sliding mode rests with
  ``v = -dh / tau``: further off than ``|v + dh / tau| / SLIDING_RATE`` the law is eq. (21) to the
  letter, closer the output comes to the same manifold within ``1 / SLIDING_RATE``.
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker.impact import impact_map
from biped_mfpt_ros.walker.robot import Robot

PARAMETERS = (
    "theta2_ref1",
    "theta2_ref2",
    "q3_ref",
    "q4_ref1",
    "q4_ref2",
    "theta5_ref",
    "k1",
    "k2",
    "k3",
    "k4",
    "alpha1",
    "alpha2",
    "alpha3",
    "alpha4",
    "tau1",
    "tau2",
    "tau3",
    "tau4",
)
"""Names of the parameters, in order: references (rad), k_i, alpha_i, tau_i (s)."""

SLIDING_RATE = 2000.0
"""1/s, the steepest secant of the law about its slow manifold."""

STEEPEST = 5e4
"""1/s, the steepest secant of the law about sigma = 0."""

# Offsets into the packed parameters: references before and after the switch, then k, 2 alpha - 1,
# 1 / tau, and the half width about sigma = 0 where the law is linear.
_REF1, _REF2, _K, _EXPONENT, _RATE, _WIDTH = 0, 4, 8, 12, 16, 20
PACKED_SIZE = 24


@kernel
def _law(sigma, rate, k, exponent, width):
    """-v of eq. (21) for one output; ``rate`` is dh / tau, ``width`` where the law is linear."""
    size = abs(sigma)
    law = sigma * STEEPEST if size < width else math.copysign(k * size**exponent, sigma)
    if abs(rate) <= STEEPEST * width:
        slow = rate / STEEPEST
    elif exponent > 0.0:
        slow = math.copysign((abs(rate) / k) ** (1.0 / exponent), rate)
    else:
        return law  # too fast to slide: sigma = 0 is only crossed
    excess = law - rate
    bound = SLIDING_RATE * abs(sigma - slow)
    if abs(excess) > bound:
        return rate + math.copysign(bound, excess)
    return law


@kernel
def _output(par, i, after_switch, value, rate):
    """Acceleration of one output (eq. 18, 21)."""
    ref = _REF2 if after_switch else _REF1
    inverse_tau = par[_RATE + i]
    sigma = rate + (value - par[ref + i]) * inverse_tau
    return -_law(sigma, rate * inverse_tau, par[_K + i], par[_EXPONENT + i], par[_WIDTH + i])


@kernel
def command(par, a, da, after_switch):
    """Accelerations ``alpha + beta z`` of the five links, ``z`` that of the stance femur."""
    v2 = _output(par, 0, after_switch, a[1], da[1])
    v3 = _output(par, 1, after_switch, a[2] - a[0], da[2] - da[0])
    v4 = _output(par, 2, after_switch, a[3] - a[1], da[3] - da[1])
    v5 = _output(par, 3, after_switch, a[4], da[4])
    return (0.0, v2, v3, v2 + v4, v5), (1.0, 0.0, 1.0, 0.0, 0.0)


@kernel
def switch(par, a):
    """Positive before the switch of the references: theta_1 - pi (eq. 22)."""
    return a[0] - math.pi


def reference_state(parameters: np.ndarray, rate: float, robot: Robot) -> np.ndarray:
    """State just after an impact on flat ground, every output at rest on its reference.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`.
    rate : float
        How fast the stance femur turns forward just before the impact, rad/s.
    robot : Robot
        The links.

    Returns
    -------
    numpy.ndarray
        ``[q, dq]``, rad and rad/s, shape (10,).
    """
    _, theta2, q3, _, q4, q5 = parameters[:6]
    femur, tibia = robot.femur_length, robot.tibia_length
    # Height of the hip above the swing foot, and the stance femur that gives it with q3.
    height = -femur * math.cos(theta2) - tibia * math.cos(theta2 + q4)
    reach = math.sqrt(femur**2 + tibia**2 + 2.0 * femur * tibia * math.cos(q3))
    bend = math.atan2(tibia * math.sin(q3), femur + tibia * math.cos(q3))
    theta1 = math.pi - math.acos(max(-1.0, min(1.0, height / reach))) - bend
    state = np.array([theta1 - q5, theta2 - q5, q3, q4, q5, -rate, 0.0, 0.0, 0.0, 0.0])
    return impact_map(state, robot)[0]


def packed(parameters: np.ndarray, robot: Robot) -> np.ndarray:
    """Parameters as the kernels read them.

    Parameters
    ----------
    parameters : numpy.ndarray
        As `PARAMETERS`, shape (18,).
    robot : Robot
        Not needed; every scheme is packed alike.

    Returns
    -------
    numpy.ndarray
        float64, shape (PACKED_SIZE,).

    Raises
    ------
    InputError
        If a k_i or tau_i is not positive, or an alpha_i is not between 0 and 1.
    """
    named = dict(zip(PARAMETERS, parameters.tolist(), strict=True))
    for name, value in named.items():
        if name[0] == "k" or name.startswith("tau"):
            if value <= 0.0:
                raise InputError(f"parameters[{name}]", value, "> 0")
        elif name.startswith("alpha") and not 0.25 <= value <= 1.0:
            raise InputError(f"parameters[{name}]", value, "0.25 to 1 (above 0.5 in the paper)")
    out = np.empty(PACKED_SIZE)
    ref1, ref2, q3, q4_1, q4_2, torso = parameters[:6]
    out[_REF1 : _REF1 + 4] = ref1, q3, q4_1, torso
    out[_REF2 : _REF2 + 4] = ref2, q3, q4_2, torso
    out[_K : _K + 4] = parameters[6:10]
    exponent = 2.0 * parameters[10:14] - 1.0
    out[_EXPONENT : _EXPONENT + 4] = exponent
    # Where k w^exponent = STEEPEST w; a plain PD law (exponent 1) needs no such range.
    out[_WIDTH : _WIDTH + 4] = 0.0
    bent = exponent < 1.0
    with np.errstate(over="ignore"):  # an infinite range is one where the law is linear throughout
        out[_WIDTH : _WIDTH + 4][bent] = (parameters[6:10] / STEEPEST)[bent] ** (
            1.0 / (1.0 - exponent[bent])
        )
    out[_RATE : _RATE + 4] = 1.0 / parameters[14:18]
    return out
