"""Energy spent in a swing: the integral of ``sum |u_i dq_i|`` (eq. 36).

The integrator sums the works of the joints, which are smooth. The magnitude of a power has a kink
wherever the power changes its sign; those are found afterwards.
"""

from __future__ import annotations

from biped_mfpt_ros.gait.integrate import STAGES, interpolate
from biped_mfpt_ros.gait.scratch import (
    ENERGY,
    ESTIMATE,
    LOBE,
    MODE,
    STAGE,
    TURNS,
    WORK,
    WORKS,
    Y_NEW,
    H,
)
from biped_mfpt_ros.jit import inner_kernel
from biped_mfpt_ros.lanes import select, splat

_N1, _N2, _N3 = 1.0 / 3.0, 0.6, 6.0 / 7.0  # when the integrator's stages 5, 9 and 10 are
_NODES = (0.0, _N1, _N2, _N3, 1.0)
_PER_1, _PER_2, _PER_3 = 1.0 / _N1, 1.0 / _N2, 1.0 / _N3
_PER_12, _PER_13, _PER_14 = 1.0 / (_N2 - _N1), 1.0 / (_N3 - _N1), 1.0 / (1.0 - _N1)
_PER_23, _PER_24, _PER_34 = 1.0 / (_N3 - _N2), 1.0 / (1.0 - _N2), 1.0 / (1.0 - _N3)


@inner_kernel
def find_lobes(w, lane):
    """Find where the power of a joint changes its sign, and the joint's work up to there.

    The energy is the integral of the power's magnitude, which has a kink there. The powers at five
    stages give a polynomial; it is needed up to the kinks only, where its error matters little.
    """
    if w[MODE, WORKS, lane] == 0.0:
        return
    h = w[MODE, H, lane]
    for i in range(4):
        row = LOBE + i
        w[row, 0, lane] = 2.0
        if w[ESTIMATE, TURNS + i, lane] < 0.0:
            column = WORK + i
            p0, p1 = w[STAGE, column, lane], w[STAGE + 5, column, lane]
            p2, p3 = w[STAGE + 9, column, lane], w[STAGE + 10, column, lane]
            p4 = w[STAGE + STAGES, column, lane]
            # Newton's divided differences on the nodes, then powers of the fraction.
            d1 = (p1 - p0) * _PER_1
            e2 = (p2 - p1) * _PER_12
            e3 = (p3 - p2) * _PER_23
            e4 = (p4 - p3) * _PER_34
            d2 = (e2 - d1) * _PER_2
            f3 = (e3 - e2) * _PER_13
            f4 = (e4 - e3) * _PER_24
            d3 = (f3 - d2) * _PER_3
            d4 = (f4 - f3) * _PER_14 - d3
            b3 = d3 - d4 * (_N1 + _N2 + _N3)
            b2 = d2 - d3 * (_N1 + _N2) + d4 * (_N1 * _N2 + _N1 * _N3 + _N2 * _N3)
            b1 = d1 - d2 * _N1 + d3 * _N1 * _N2 - d4 * _N1 * _N2 * _N3
            found = 0
            for k in range(4):
                low, before = _NODES[k], (p0, p1, p2, p3)[k]
                high, after = _NODES[k + 1], (p1, p2, p3, p4)[k]
                if before * after < 0.0:
                    at = low + (high - low) * before / (before - after)
                    # The work changes with the square of what the place is off.
                    for _ in range(2):
                        value = p0 + at * (b1 + at * (b2 + at * (b3 + at * d4)))
                        if (value > 0.0) == (before > 0.0):
                            low = at
                        else:
                            high = at
                        slope = b1 + at * (2.0 * b2 + at * (3.0 * b3 + at * 4.0 * d4))
                        at -= value / slope
                        if not low < at < high:
                            at = 0.5 * (low + high)
                    work = p0 + at * (0.5 * b1 + at * (_N1 * b2 + at * (0.25 * b3 + at * 0.2 * d4)))
                    w[row, found, lane] = at
                    w[row, 4 + found, lane] = h * at * work
                    found += 1
            if found < 4:
                w[row, found, lane] = 2.0


@inner_kernel
def energy_at(w, v, lane, at):
    """Energy spent up to fractions of the step in lanes, J (eq. 36); 0 where none is wanted."""
    total = splat(v[ENERGY, lane])
    if w[MODE, WORKS, lane] == 0.0:
        return total
    for i in range(4):
        row = LOBE + i
        last = 0.0 * at
        for k in range(4):
            if w[row, k, lane] > 1.0:
                break
            passed = w[row, k, lane] < at
            total = total + select(passed, abs(w[row, 4 + k, lane] - last), 0.0)
            last = select(passed, w[row, 4 + k, lane], last)
        total = total + abs(interpolate(w, lane, WORK + i, at) - last)
    return total


@inner_kernel
def energy_at_end(w, v, lane, end):
    """The same at the end of the step, with its works in row Y_NEW."""
    total = v[ENERGY, lane]
    if w[MODE, WORKS, lane] == 0.0:
        return total
    for i in range(4):
        last = 0.0
        for k in range(4):
            if w[LOBE + i, k, lane] >= end:
                break
            total += abs(w[LOBE + i, 4 + k, lane] - last)
            last = w[LOBE + i, 4 + k, lane]
        total += abs(w[Y_NEW, WORK + i, lane] - last)
    return total
