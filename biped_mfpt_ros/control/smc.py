"""Sliding mode control with piecewise constant references, section 3.2 of the paper.

The outputs theta_2 = q2 + q5, q3, q4 and q5 (eq. 14) are driven to references that switch once, as
the stance femur passes the vertical (eq. 22), by ``v = -k |sigma|^(2 alpha - 1) sign(sigma)`` with
``sigma = dh + h / tau`` (eq. 18, 21).

The law near sigma = 0
----------------------
There the exponent below one makes the law infinitely steep. What an output does then is known: it
rests on the slow manifold ``sigma = S(dh / tau)`` on which the law is ``v = -dh / tau`` to first
order. So an output has two modes.

- Reaching, by eq. (21). No explicit integrator can follow it to the end, nor is it of interest how
  fast an output settles that settles at once. So the law's slope is bounded twice, far above the
  rates of the gait (some 20/s): by `STEEPEST` about sigma = 0, where the law passes smoothly into a
  linear one below the width ``(k / STEEPEST)^(1 / (2 - 2 alpha))``, some 5e-4 rad/s; and by
  `SLIDING_RATE` about the slow manifold: further off than ``|v + dh / tau| / SLIDING_RATE`` the law
  is eq. (21), closer the output comes to the manifold within ``1 / SLIDING_RATE``.
- Sliding, from where it has come within `ENTRY` of the manifold and no torque is at its limit, as
  long as none is, up to the switch of the references. The output stays on the manifold of eq. (21)
  itself, without the bounds. This also covers 2 alpha - 1 <= 0, outside of what the paper allows
  but present in its Table 3, where the law jumps at sigma = 0: the output then slides there
  (Filippov), without the chatter that a literal sign function would leave.

So the bounds matter only while an output crosses sigma = 0 without sliding there. That takes
milliseconds at most, within which they move it by some 1e-6 rad.
"""

from __future__ import annotations

import math
from decimal import Context, Decimal
from functools import lru_cache

import numpy as np

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import inlined_kernel, inner_kernel
from biped_mfpt_ros.lanes import any_lane, binary_exponent, mantissa, power_of_two, select
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

STEEPEST = 5e3
"""1/s, the steepest secant of the law about sigma = 0."""

ENTRY = 1e-5
"""rad/s: an output that comes so near to its slow manifold slides."""

DRIFT = 200.0
"""1/s, at which a sliding output loses what it was off its manifold when it began to slide."""

CLEAR = 0.02
"""Of the torque limit: how far every torque must be below it for an output to begin to slide. That
keeps the small change of the torques then from taking it out of the sliding mode at once."""

STIFF = 1000.0
"""1/s: an output slides where the law about its slow manifold is at least so steep."""

# Offsets into the packed parameters: references before and after the switch, then k, 2 alpha - 1,
# 1 / tau, and the half width about sigma = 0 where the law is linear; and what is computed of those
# once: 1 / k, 1 / (2 alpha - 1) or 0, the width's fourth power, and (alpha - 1) / 2.
_REF1, _REF2, _K, _EXPONENT, _RATE, _WIDTH = 0, 4, 8, 12, 16, 20
_PER_K, _PER_EXPONENT, _WIDTH_4, _POWER_4 = 24, 28, 32, 36
PACKED_SIZE = 40

# The C library's power differs from machine to machine. Beyond its range it is 0 or infinite.
_POWER = Context(prec=18, traps=[])

_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and subtracting it rounds to an integer
_SQRT_HALF = math.sqrt(0.5)
# Minimax polynomials on the ranges that `power` reduces to: log2((1 + t) / (1 - t)) = t P(t^2),
# good to 4e-17, and 2^f = Q(f), to 2e-16 relative (Remez's algorithm in 50 digits).
_LOG = (
    2.8853900817779305803,
    0.96179669392121699874,
    0.57707801809457476094,
    0.41219830316105156331,
    0.32062199105054992579,
    0.26129188924260948866,
    0.24450943473564299242,
)
_EXP = (
    1.0,
    0.69314718055994977516,
    0.24022650695908768121,
    0.055504108664458825898,
    0.0096181291080345035675,
    0.0013333558228562779525,
    1.5403529961215810055e-4,
    1.5252658115798372673e-5,
    1.3215662800389000572e-6,
    1.0208538046334786035e-7,
    7.0372839844919997885e-9,
)


@inner_kernel
def power(x, p):
    """``x^p`` for x >= 0, to some 1e-14 relative for results of ordinary size.

    The C library's differs in its last bit from machine to machine, and is not for lanes.
    """
    m = mantissa(x)
    e = binary_exponent(x)
    low = m < _SQRT_HALF
    m = select(low, 2.0 * m, m)
    e = select(low, e - 1.0, e)
    t = (m - 1.0) / (m + 1.0)
    z = t * t
    zz = z * z
    series = (_LOG[0] + _LOG[1] * z) + zz * (
        (_LOG[2] + _LOG[3] * z) + zz * ((_LOG[4] + _LOG[5] * z) + zz * _LOG[6])
    )
    y = p * (e + t * series)
    y = select(y < -1000.0, -1000.0, y)
    y = select(y > 1000.0, 1000.0, y)
    n = (y + _ROUND) - _ROUND
    f = y - n
    ff = f * f
    f4 = ff * ff
    low = (_EXP[0] + _EXP[1] * f) + ff * (_EXP[2] + _EXP[3] * f)
    high = (_EXP[4] + _EXP[5] * f) + ff * (_EXP[6] + _EXP[7] * f)
    series = low + f4 * (high + f4 * ((_EXP[8] + _EXP[9] * f) + ff * _EXP[10]))
    return series * power_of_two(n)


@inner_kernel
def _with_sign(size, x):
    return select(x < 0.0, -size, size)


@inlined_kernel
def _sigma(par, i, switched, value, rate):
    """The variable sigma of one output (eq. 18), and dh / tau; ``switched`` is 0 or 1."""
    reference = par[_REF1 + i] + switched * (par[_REF2 + i] - par[_REF1 + i])
    return rate + (value - reference) * par[_RATE + i], rate * par[_RATE + i]


@inlined_kernel
def _slow(par, i, rate):
    """``sigma`` on the slow manifold of eq. (21) to first order, where the law is ``rate``."""
    if par[_EXPONENT + i] > 0.0:
        return _with_sign(power(abs(rate) * par[_PER_K + i], par[_PER_EXPONENT + i]), rate)
    return rate * (1.0 / STEEPEST)


@inlined_kernel
def _slides(par, i, rate):
    """Whether there is such a sigma."""
    if par[_EXPONENT + i] > 0.0:
        return rate == rate
    # Faster than the law ever is, it does not slide: sigma = 0 is only crossed.
    return abs(rate) <= STEEPEST * par[_WIDTH + i]


@inlined_kernel
def _slope(par, i, rate, slow):
    """Slope of the slow manifold over ``rate``, s."""
    if par[_EXPONENT + i] > 0.0:
        return select(abs(rate) > 1e-12, par[_PER_EXPONENT + i] * slow / rate, 0.0)
    return 0.0 * rate


@inlined_kernel
def _law(par, i, sigma, rate, slow):
    """-v of eq. (21) for one output; ``rate`` is dh / tau, ``slow`` as of `_slow`.

    ``|sigma|`` is smoothed to ``(sigma^4 + width^4)^(1/4)``, so that the law is linear far below
    the width, and eq. (21) to a few parts of 1e9 at a hundred widths.
    """
    square = sigma * sigma
    size = square * square + par[_WIDTH_4 + i]
    law = par[_K + i] * sigma * power(size, par[_POWER_4 + i])
    excess = law - rate
    bound = SLIDING_RATE * abs(sigma - slow)
    bounded = (abs(excess) > bound) & _slides(par, i, rate)
    return select(bounded, rate + _with_sign(bound, excess), law)


@inlined_kernel
def _sliding(par, i, sigma, rate, slow):
    """-v of an output that slides.

    On the slow manifold ``sigma = S(rate)``, where ``-v = rate - dS/dt`` and
    ``d(rate)/dt = v / tau``. To second order in ``g = S' / tau``, of which S itself differs by a
    factor from where the law is ``rate``.
    """
    g = _slope(par, i, rate, slow) * par[_RATE + i]
    if par[_EXPONENT + i] > 0.0:
        per_exponent = par[_PER_EXPONENT + i]
        slow = slow * (1.0 + g * per_exponent)
        g = g * (1.0 + (2.0 * per_exponent - 1.0) * g)
    else:
        slow = 0.0 * rate
    return rate / (1.0 - g) + DRIFT * (sigma - slow)


@inlined_kernel
def _output(par, i, switched, slides, value, rate):
    """Acceleration of one output (eq. 18, 21); ``switched`` and ``slides`` are 0 or 1."""
    sigma, slow_rate = _sigma(par, i, switched, value, rate)
    slow = _slow(par, i, slow_rate)
    law = _law(par, i, sigma, slow_rate, slow)
    if any_lane(slides > 0.5):
        law = select(slides > 0.5, _sliding(par, i, sigma, slow_rate, slow), law)
    return -law


@inlined_kernel
def command(par, a, da, switched, slides):
    """Accelerations ``alpha + beta z`` of the five links, ``z`` that of the stance femur.

    ``switched`` is 0 or 1, and so are the four ``slides``: which outputs are in sliding mode.
    """
    v2 = _output(par, 0, switched, slides[0], a[1], da[1])
    v3 = _output(par, 1, switched, slides[1], a[2] - a[0], da[2] - da[0])
    v4 = _output(par, 2, switched, slides[2], a[3] - a[1], da[3] - da[1])
    v5 = _output(par, 3, switched, slides[3], a[4], da[4])
    zero = 0.0 * v2
    one = zero + 1.0
    return (zero, v2, v3, v2 + v4, v5), (one, zero, one, zero, zero)


@inner_kernel
def off_slide(par, i, a, da, switched):
    """How far an output is from where it begins to slide; it does at zero and below.

    If its acceleration is as commanded: no torque is at its limit. ``switched`` is 0 or 1.
    """
    value, rate = a[1], da[1]
    if i == 1:
        value, rate = a[2] - a[0], da[2] - da[0]
    elif i == 2:
        value, rate = a[3] - a[1], da[3] - da[1]
    elif i == 3:
        value, rate = a[4], da[4]
    sigma, slow_rate = _sigma(par, i, switched, value, rate)
    slow = _slow(par, i, slow_rate)
    slope = _slope(par, i, slow_rate, slow)
    g = slope * par[_RATE + i] * par[_PER_EXPONENT + i]
    law = _law(par, i, sigma, slow_rate, slow)
    off = abs(law - slow_rate) / (SLIDING_RATE * ENTRY + 2.0 * g * abs(slow_rate))
    stiff = slope * STIFF
    return select(_slides(par, i, slow_rate), select(stiff > off, stiff, off) - 1.0, math.inf)


@inner_kernel
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


@lru_cache(maxsize=256)
def _width(k: float, exponent: float) -> float:
    """Half width, where ``k w^exponent = STEEPEST w``; a PD law (exponent 1) needs none."""
    if exponent >= 1.0:
        return 0.0
    return float(_POWER.power(Decimal(k / STEEPEST), Decimal(1.0 / (1.0 - exponent))))


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
        If a k_i or tau_i is not positive, or an alpha_i is not from 0.25 to 1.
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
    for i in range(4):
        k, exponent = float(parameters[6 + i]), 2.0 * float(parameters[10 + i]) - 1.0
        width = _width(k, exponent)
        out[_K + i], out[_EXPONENT + i], out[_WIDTH + i] = k, exponent, width
        out[_RATE + i] = 1.0 / parameters[14 + i]
        out[_PER_K + i] = 1.0 / k
        out[_PER_EXPONENT + i] = 1.0 / exponent if exponent > 0.0 else 0.0
        out[_WIDTH_4 + i] = (width * width) * (width * width)
        out[_POWER_4 + i] = 0.25 * (exponent - 1.0)
    return out
