"""One step of the integrator, and its dense output.

Dormand and Prince's pair of order 5(4) with Shampine's quartic dense output [1]_. A pair of order 8
was tried: on smooth swings it takes half the evaluations, but where torques saturate the right-hand
side has kinks, and there it takes more.

References
----------
.. [1] L. F. Shampine, "Some Practical Runge-Kutta Formulas", Mathematics of Computation 46 (1986).
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.gait.closed_loop import closed_loop, margin
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker import robot as r
from biped_mfpt_ros.walker.dynamics import TORQUE
from biped_mfpt_ros.walker.robot import STATE_SIZE

STAGES = 6
"""Evaluations of a step; one more row holds the derivative at its end, the next step's first."""
ORDER = 5

# Written out, and compared with scipy's in the tests: importing scipy.integrate for them would cost
# every process half a second.
_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_E = np.array([-71 / 57600, 0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40])
_P = np.array(
    [
        [1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0, 0, 0, 0],
        [0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [
            0,
            127303824393 / 49829197408,
            -318862633887 / 49829197408,
            701980252875 / 199316789632,
        ],
        [0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)

_KINK = 100.0  # by which the error is taken for more in a step with a kink

# Rows of the scratch array of a swing, each of SIZE numbers: angles, rates, energy.
SIZE = STATE_SIZE + 1
Y, Y_NEW, Y_AT, SPARE, STAGE = 0, 1, 2, 3, 4
_DENSE = STAGE + STAGES + 1
ROWS = _DENSE + 4


@kernel
def trial_step(scheme, switched, rob, par, work, s, h, saturated):
    """Try a step of h seconds from row Y, whose derivative stands in row STAGE, to row Y_NEW.

    ``saturated`` tells which torques are cut off at the start. Where that changes within the step,
    the right-hand side has a kink and the estimate of the error is too low at times, so that it is
    taken for more.

    Returns
    -------
    tuple of float
        Estimated local error over the tolerance (accepted if at most 1), least and largest margin
        against slipping and least normal force of the stance foot over the stages, N, and
        tangential and normal force at the end of the step, N, and which torques are cut off there.
    """
    least, most, least_normal = math.inf, -math.inf, math.inf
    ft, fn = 0.0, 0.0
    kink = False
    for stage in range(1, STAGES + 1):
        for i in range(SIZE):
            total = 0.0
            for k in range(stage):
                total += _A[stage, k] * s[STAGE + k, i]
            s[Y_NEW, i] = s[Y, i] + h * total
        ft, fn = closed_loop(scheme, switched, rob, par, work, s[Y_NEW], s[STAGE + stage])
        kink = kink or work[TORQUE, 4] != saturated
        m = margin(rob, ft, fn)
        least = min(least, m)
        most = max(most, m)
        least_normal = min(least_normal, fn)
    error = 0.0
    for i in range(STATE_SIZE):
        total = 0.0
        for k in range(STAGES + 1):
            total += _E[k] * s[STAGE + k, i]
        scale = rob[r.TOLERANCE] * (1.0 + max(abs(s[Y, i]), abs(s[Y_NEW, i])))
        ratio = abs(h * total) / scale
        if not ratio <= error:  # also where it is not a number
            error = ratio
    if kink:
        error *= _KINK
    return error, least, most, least_normal, ft, fn, work[TORQUE, 4]


@kernel
def prepare_dense(s, h):
    """Compute the dense output of the step of h seconds just accepted, from Y to Y_NEW."""
    for i in range(SIZE):
        for power in range(4):
            total = 0.0
            for k in range(STAGES + 1):
                total += _P[k, power] * s[STAGE + k, i]
            s[_DENSE + power, i] = h * total


@kernel
def interpolate(s, at):
    """Dense output at the fraction ``at`` of the step, into row Y_AT."""
    for i in range(SIZE):
        s[Y_AT, i] = s[Y, i] + at * (
            s[_DENSE, i]
            + at * (s[_DENSE + 1, i] + at * (s[_DENSE + 2, i] + at * s[_DENSE + 3, i]))
        )
