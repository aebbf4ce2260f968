"""One step of the integrator in all lanes, and its dense output.

Dormand and Prince's pair of order 8(5,3) with the dense output of order 7 that Hairer made for it
[1]_. Torque limits and ends of pieces of the control law are events, so that a step is smooth.

References
----------
.. [1] E. Hairer, S. P. Norsett and G. Wanner, "Solving Ordinary Differential Equations I", 2nd
   edition, Springer 1993, section II.5 and the code DOP853.
"""

from __future__ import annotations

import math

import numpy as np

from biped_mfpt_ros.gait.closed_loop import (
    CUT_RESOLUTION,
    angles,
    beyond_each,
    greatest,
    margin,
    mode_of_all,
    motion,
    powers,
    rates,
    torques_at,
)
from biped_mfpt_ros.gait.scratch import (
    BEYOND,
    COSINES,
    DENSE,
    END,
    ERROR,
    ERROR_ROOT,
    ESTIMATE,
    GOOD,
    LEAST,
    LEAST_NORMAL,
    MAY_CUT,
    MODE,
    MOST,
    NORMAL,
    SINES,
    SIZE,
    SPARE,
    STAGE,
    START,
    STATES,
    TANGENTIAL,
    TURNS,
    WANTED,
    WORK,
    WORKS,
    Y_NEW,
    H,
    Y,
)
from biped_mfpt_ros.jit import inlined_kernel, inner_kernel
from biped_mfpt_ros.lanes import load, select, store
from biped_mfpt_ros.walker import robot as r

STAGES = 12
"""Evaluations of a step: the last, at its end, is the next step's first."""
DENSE_STAGES = 3
"""Further evaluations for the dense output."""
_BETWEEN_STAGES = 0.02  # of the torque limit: how much more a torque may be than at any stage
POWER_STAGES = (5, 9, 10, STAGES)
"""Stages, after the first, at whose powers a step is searched for changes of their signs."""

# Written out, and compared with scipy's in the tests: importing scipy.integrate for them would cost
# every process half a second. Stage by stage: of which earlier stages it takes how much.
_STAGES = (
    ((0, 0.05260015195876773),),
    (
        (0, 0.0197250569845379),
        (1, 0.0591751709536137),
    ),
    (
        (0, 0.02958758547680685),
        (2, 0.08876275643042054),
    ),
    (
        (0, 0.2413651341592667),
        (2, -0.8845494793282861),
        (3, 0.924834003261792),
    ),
    (
        (0, 0.037037037037037035),
        (3, 0.17082860872947386),
        (4, 0.12546768756682242),
    ),
    (
        (0, 0.037109375),
        (3, 0.17025221101954405),
        (4, 0.06021653898045596),
        (5, -0.017578125),
    ),
    (
        (0, 0.03709200011850479),
        (3, 0.17038392571223998),
        (4, 0.10726203044637328),
        (5, -0.015319437748624402),
        (6, 0.008273789163814023),
    ),
    (
        (0, 0.6241109587160757),
        (3, -3.3608926294469414),
        (4, -0.868219346841726),
        (5, 27.59209969944671),
        (6, 20.154067550477894),
        (7, -43.48988418106996),
    ),
    (
        (0, 0.47766253643826434),
        (3, -2.4881146199716677),
        (4, -0.590290826836843),
        (5, 21.230051448181193),
        (6, 15.279233632882423),
        (7, -33.28821096898486),
        (8, -0.020331201708508627),
    ),
    (
        (0, -0.9371424300859873),
        (3, 5.186372428844064),
        (4, 1.0914373489967295),
        (5, -8.149787010746927),
        (6, -18.52006565999696),
        (7, 22.739487099350505),
        (8, 2.4936055526796523),
        (9, -3.0467644718982196),
    ),
    (
        (0, 2.273310147516538),
        (3, -10.53449546673725),
        (4, -2.0008720582248625),
        (5, -17.9589318631188),
        (6, 27.94888452941996),
        (7, -2.8589982771350235),
        (8, -8.87285693353063),
        (9, 12.360567175794303),
        (10, 0.6433927460157636),
    ),
    (
        (0, 0.054293734116568765),
        (5, 4.450312892752409),
        (6, 1.8915178993145003),
        (7, -5.801203960010585),
        (8, 0.3111643669578199),
        (9, -0.1521609496625161),
        (10, 0.20136540080403034),
        (11, 0.04471061572777259),
    ),
    (
        (0, 0.056167502283047954),
        (6, 0.25350021021662483),
        (7, -0.2462390374708025),
        (8, -0.12419142326381637),
        (9, 0.15329179827876568),
        (10, 0.00820105229563469),
        (11, 0.007567897660545699),
        (12, -0.008298),
    ),
    (
        (0, 0.03183464816350214),
        (5, 0.028300909672366776),
        (6, 0.053541988307438566),
        (7, -0.05492374857139099),
        (10, -0.00010834732869724932),
        (11, 0.0003825710908356584),
        (12, -0.00034046500868740456),
        (13, 0.1413124436746325),
    ),
    (
        (0, -0.42889630158379194),
        (5, -4.697621415361164),
        (6, 7.683421196062599),
        (7, 4.06898981839711),
        (8, 0.3567271874552811),
        (12, -0.0013990241651590145),
        (13, 2.9475147891527724),
        (14, -9.15095847217987),
    ),
)
_ERROR_5 = np.array(
    [
        0.01312004499419488,
        0.0,
        0.0,
        0.0,
        0.0,
        -1.2251564463762044,
        -0.4957589496572502,
        1.6643771824549864,
        -0.35032884874997366,
        0.3341791187130175,
        0.08192320648511571,
        -0.022355307863886294,
    ]
)
_ERROR_3 = np.array(
    [
        -0.18980075407240762,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        -0.4226823213237919,
        -0.1521609496625161,
        0.20136540080403034,
        0.02265179219836082,
    ]
)
_DENSE = np.array(
    [
        [
            -8.428938276109013,
            0.0,
            0.0,
            0.0,
            0.0,
            0.5667149535193777,
            -3.0689499459498917,
            2.38466765651207,
            2.117034582445028,
            -0.871391583777973,
            2.2404374302607883,
            0.6315787787694688,
            -0.08899033645133331,
            18.148505520854727,
            -9.194632392478356,
            -4.436036387594894,
        ],
        [
            10.427508642579134,
            0.0,
            0.0,
            0.0,
            0.0,
            242.28349177525817,
            165.20045171727028,
            -374.5467547226902,
            -22.113666853125306,
            7.733432668472264,
            -30.674084731089398,
            -9.332130526430229,
            15.697238121770845,
            -31.139403219565178,
            -9.35292435884448,
            35.81684148639408,
        ],
        [
            19.985053242002433,
            0.0,
            0.0,
            0.0,
            0.0,
            -387.0373087493518,
            -189.17813819516758,
            527.8081592054236,
            -11.57390253995963,
            6.8812326946963,
            -1.0006050966910838,
            0.7777137798053443,
            -2.778205752353508,
            -60.19669523126412,
            84.32040550667716,
            11.99229113618279,
        ],
        [
            -25.69393346270375,
            0.0,
            0.0,
            0.0,
            0.0,
            -154.18974869023643,
            -231.5293791760455,
            357.6391179106141,
            93.40532418362432,
            -37.45832313645163,
            104.0996495089623,
            29.8402934266605,
            -43.53345659001114,
            96.32455395918828,
            -39.17726167561544,
            -149.72683625798564,
        ],
    ]
)

_START = np.cumsum([0, 0] + [len(stage) for stage in _STAGES])
_FROM = np.array([j for stage in _STAGES for j, _ in stage])
_WEIGHT = np.array([weight for stage in _STAGES for _, weight in stage])


@inner_kernel
def _scaled(w, row, weight):
    """Ten columns of a row, times a weight: angles and rates."""
    x, y = angles(w, row), rates(w, row)
    return (
        (weight * x[0], weight * x[1], weight * x[2], weight * x[3], weight * x[4]),
        (weight * y[0], weight * y[1], weight * y[2], weight * y[3], weight * y[4]),
    )


@inner_kernel
def _plus(w, row, weight, a, b):
    """The same, added to ``a`` and ``b``."""
    x, y = angles(w, row), rates(w, row)
    return (
        (
            a[0] + weight * x[0],
            a[1] + weight * x[1],
            a[2] + weight * x[2],
            a[3] + weight * x[3],
            a[4] + weight * x[4],
        ),
        (
            b[0] + weight * y[0],
            b[1] + weight * y[1],
            b[2] + weight * y[2],
            b[3] + weight * y[3],
            b[4] + weight * y[4],
        ),
    )


@inlined_kernel
def _stage(scheme, rob, par, w, h, stage, into, columns, mode):
    """One stage, in all lanes: its state into a row, its derivative into one of its own."""
    n = _START[stage]
    a, b = _scaled(w, STAGE + _FROM[n], _WEIGHT[n])
    for n in range(_START[stage] + 1, _START[stage + 1]):
        a, b = _plus(w, STAGE + _FROM[n], _WEIGHT[n], a, b)
    for i in range(5):
        store(w, into, i, load(w, Y, i) + h * a[i])
        store(w, into, 5 + i, load(w, Y, 5 + i) + h * b[i])
    if columns > STATES:
        for i in range(WORK, SIZE):
            total = _WEIGHT[_START[stage]] * load(w, STAGE + _FROM[_START[stage]], i)
            for n in range(_START[stage] + 1, _START[stage + 1]):
                total = total + _WEIGHT[n] * load(w, STAGE + _FROM[n], i)
            store(w, into, i, load(w, Y, i) + h * total)
    da = rates(w, into)
    dda, wanted, applied, force, s, c = motion(scheme, rob, par, w, into, mode)
    power = powers(applied, da)
    row = STAGE + stage
    for i in range(5):
        store(w, row, i, da[i])
        store(w, row, 5 + i, dda[i])
    for i in range(4):
        store(w, row, WORK + i, power[i])
    return wanted, force, s, c


@inner_kernel
def columns_of(w):
    """Columns that are integrated: the works, too, or the states alone."""
    return SIZE if w[MODE, WORKS, 0] != 0.0 else STATES


@inner_kernel
def _may_cut(rob, start, most, end):
    """Whether a torque may reach or leave its limit in the step.

    From how far it is beyond it at the start, at the stages at most, and at the end. One that is
    nearest to it within the step may get there between two stages.
    """
    limit = rob[r.TORQUE_LIMIT]
    between = most > select(start > end, start, end)
    return most > select(between, -_BETWEEN_STAGES * limit, CUT_RESOLUTION * limit)


@inner_kernel
def trial_step(scheme, rob, par, w):
    """Try a step in all lanes, from row Y, whose derivative stands in row STAGE, to row Y_NEW.

    Sets the rows ESTIMATE and END. The step is good if the estimated error is at most 1.
    """
    mode = mode_of_all(w)
    h = load(w, MODE, H)
    columns = columns_of(w)
    least = h * 0.0 + math.inf
    most = -least
    normal = least
    start = beyond_each(rob, mode[0], torques_at(w, START, 0))
    u = start
    m0, m1, m2, m3 = most, most, most, most
    for stage in range(1, STAGES + 1):
        taken = columns if stage == STAGES else STATES
        wanted, force, s, c = _stage(scheme, rob, par, w, h, stage, Y_NEW, taken, mode)
        m = margin(rob, force)
        least = select(m < least, m, least)
        most = select(m > most, m, most)
        normal = select(force[1] < normal, force[1], normal)
        u = beyond_each(rob, mode[0], wanted)
        m0, m1 = select(u[0] > m0, u[0], m0), select(u[1] > m1, u[1], m1)
        m2, m3 = select(u[2] > m2, u[2], m2), select(u[3] > m3, u[3], m3)
        if stage == STAGES:
            for i in range(5):
                store(w, END, SINES + i, s[i])
                store(w, END, COSINES + i, c[i])
            for i in range(4):
                store(w, END, WANTED + i, wanted[i])
            store(w, ESTIMATE, TANGENTIAL, force[0])
            store(w, ESTIMATE, NORMAL, force[1])
    store(w, ESTIMATE, LEAST, least)
    store(w, ESTIMATE, MOST, most)
    store(w, ESTIMATE, LEAST_NORMAL, normal)
    may = _may_cut(rob, start[0], m0, u[0]) | _may_cut(rob, start[1], m1, u[1])
    may = may | _may_cut(rob, start[2], m2, u[2]) | _may_cut(rob, start[3], m3, u[3])
    store(w, ESTIMATE, MAY_CUT, select(may, 1.0, h * 0.0))
    store(w, ESTIMATE, BEYOND, greatest(u))
    for i in range(WORK, columns):
        power = load(w, STAGE, i)
        low, high = power, power
        for stage in POWER_STAGES:
            power = load(w, STAGE + stage, i)
            low = select(power < low, power, low)
            high = select(power > high, power, high)
        store(w, ESTIMATE, TURNS + i - WORK, low * high)
    order_5 = h * 0.0
    order_3 = h * 0.0
    for i in range(STATES):
        five = _ERROR_5[0] * load(w, STAGE, i)
        three = _ERROR_3[0] * load(w, STAGE, i)
        for k in range(5, STAGES):
            value = load(w, STAGE + k, i)
            five = five + _ERROR_5[k] * value
            three = three + _ERROR_3[k] * value
        before, after = abs(load(w, Y, i)), abs(load(w, Y_NEW, i))
        weight = 1.0 / (rob[r.TOLERANCE] * (1.0 + select(before > after, before, after)))
        five, three = five * weight, three * weight
        order_5 = order_5 + five * five
        order_3 = order_3 + three * three
    size = (order_5 + 0.01 * order_3) * STATES
    error = select(size == 0.0, 0.0, h * order_5 / math.sqrt(size))
    store(w, ESTIMATE, ERROR, error)
    store(w, ESTIMATE, ERROR_ROOT, eighth_root(error))


@inner_kernel
def eighth_root(error):
    """By which a step of order 8 changes the error; the same on every machine."""
    return math.sqrt(math.sqrt(math.sqrt(error)))


@inner_kernel
def take_step(w):
    """Go on to the end of the step just tried, in the lanes where it is good."""
    good = load(w, MODE, GOOD) != 0.0
    for i in range(STATES):
        store(w, Y, i, select(good, load(w, Y_NEW, i), load(w, Y, i)))
    for i in range(columns_of(w)):
        store(w, STAGE, i, select(good, load(w, STAGE + STAGES, i), load(w, STAGE, i)))
    for i in range(4):
        store(w, START, i, select(good, load(w, END, WANTED + i), load(w, START, i)))


@inner_kernel
def prepare_dense(scheme, rob, par, w):
    """Compute the dense output of the step just tried, in all lanes."""
    mode = mode_of_all(w)
    h = load(w, MODE, H)
    columns = columns_of(w)
    for i in range(columns):
        end = load(w, Y_NEW, i)
        first = end - load(w, Y, i)
        second = h * load(w, STAGE, i) - first
        store(w, DENSE, i, first)
        store(w, DENSE + 1, i, second)
        store(w, DENSE + 2, i, 2.0 * first - h * (load(w, STAGE, i) + load(w, STAGE + STAGES, i)))
    for stage in range(STAGES + 1, STAGES + 1 + DENSE_STAGES):
        _stage(scheme, rob, par, w, h, stage, SPARE, STATES, mode)
    for i in range(columns):
        rate = load(w, STAGE, i)
        t3, t4 = _DENSE[0, 0] * rate, _DENSE[1, 0] * rate
        t5, t6 = _DENSE[2, 0] * rate, _DENSE[3, 0] * rate
        for k in range(5, STAGES + 1 + DENSE_STAGES):
            rate = load(w, STAGE + k, i)
            t3, t4 = t3 + _DENSE[0, k] * rate, t4 + _DENSE[1, k] * rate
            t5, t6 = t5 + _DENSE[2, k] * rate, t6 + _DENSE[3, k] * rate
        store(w, DENSE + 3, i, h * t3)
        store(w, DENSE + 4, i, h * t4)
        store(w, DENSE + 5, i, h * t5)
        store(w, DENSE + 6, i, h * t6)


@inlined_kernel
def interpolate(w, lane, i, at):
    """Dense output of a column at the fraction ``at`` of the step."""
    rest = 1.0 - at
    return w[Y, i, lane] + at * (
        w[DENSE, i, lane]
        + rest
        * (
            w[DENSE + 1, i, lane]
            + at
            * (
                w[DENSE + 2, i, lane]
                + rest
                * (
                    w[DENSE + 3, i, lane]
                    + at
                    * (
                        w[DENSE + 4, i, lane]
                        + rest * (w[DENSE + 5, i, lane] + at * w[DENSE + 6, i, lane])
                    )
                )
            )
        )
    )


@inlined_kernel
def interpolated_slope(w, lane, i, at):
    """Its derivative over ``at``."""
    rest = 1.0 - at
    value = w[DENSE + 5, i, lane] + at * w[DENSE + 6, i, lane]
    slope = rest * w[DENSE + 6, i, lane] - value
    value = w[DENSE + 4, i, lane] + rest * value
    slope = at * slope + value
    value = w[DENSE + 3, i, lane] + at * value
    slope = rest * slope - value
    value = w[DENSE + 2, i, lane] + rest * value
    slope = at * slope + value
    value = w[DENSE + 1, i, lane] + at * value
    slope = rest * slope - value
    return at * slope + (w[DENSE, i, lane] + rest * value)


@inlined_kernel
def state_at(w, lane, at):
    """Angles and rates at the fraction ``at`` of the step."""
    a = (
        interpolate(w, lane, 0, at),
        interpolate(w, lane, 1, at),
        interpolate(w, lane, 2, at),
        interpolate(w, lane, 3, at),
        interpolate(w, lane, 4, at),
    )
    da = (
        interpolate(w, lane, 5, at),
        interpolate(w, lane, 6, at),
        interpolate(w, lane, 7, at),
        interpolate(w, lane, 8, at),
        interpolate(w, lane, 9, at),
    )
    return a, da
