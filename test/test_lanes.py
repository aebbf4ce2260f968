"""Lanes: each as exact as it says, whatever stands in the others."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES, load, load_from, negated_if_odd, store, store_into

RNG = np.random.default_rng(5)


@kernel
def _sums(w):
    x, y, z = load(w, 0, 0), load(w, 0, 1), load(w, 0, 2)
    store(w, 1, 0, x * y + z)
    store(w, 1, 1, z + x * y)
    store(w, 1, 2, x * y - z)
    store(w, 1, 3, z - x * y)
    store(w, 1, 4, 0.1 * x + y)
    store(w, 1, 5, x * y + x * z)


def _rounded_once(x, y, z):
    return float(Fraction(x) * Fraction(y) + Fraction(z))


def test_a_product_that_is_added_is_not_rounded_before():
    for _ in range(200):
        w = np.zeros((2, 6, LANES))
        w[0, :2] = RNG.normal(size=(2, LANES))
        # So near to the product that what is left of it is mostly its rounding.
        w[0, 2] = -w[0, 0] * w[0, 1] * (1.0 + RNG.choice([0.0, 1e-15, 1.0], LANES))
        _sums(w)
        for lane in range(LANES):
            x, y, z = w[0, :3, lane]
            assert w[1, 0, lane] == w[1, 1, lane] == _rounded_once(x, y, z)
            assert w[1, 2, lane] == _rounded_once(x, y, -z)
            assert w[1, 3, lane] == _rounded_once(-x, y, z)
            assert w[1, 4, lane] == _rounded_once(0.1, x, y)
            assert w[1, 5, lane] == _rounded_once(x, z, x * y)


def test_lanes_do_not_depend_on_each_other():
    w = np.zeros((2, 6, LANES))
    w[0] = RNG.normal(size=(6, LANES))
    _sums(w)
    for lane in range(LANES):
        alone = np.full((2, 6, LANES), np.nan)
        alone[0, :, lane] = w[0, :, lane]
        _sums(alone)
        assert alone[1, :, lane].tobytes() == w[1, :, lane].tobytes()


@kernel
def _negated(w):
    store(w, 1, 0, negated_if_odd(load(w, 0, 0), load(w, 0, 1)))
    return negated_if_odd(w[0, 0, 0], w[0, 1, 0])


@pytest.mark.parametrize("offset", [-3, -2, -1, 0, 1, 2])
def test_negated_if_odd(offset):
    w = np.zeros((2, 2, LANES))
    w[0, 0] = RNG.normal(size=LANES)
    w[0, 1] = 1.5 * 2.0**52 + offset
    alone = _negated(w)
    expected = -w[0, 0] if offset % 2 else w[0, 0]
    assert w[1, 0].tobytes() == expected.tobytes()
    assert alone == expected[0] == negated_if_odd(w[0, 0, 0], w[0, 1, 0])


@kernel
def _roots(table, first):
    store_into(table, 1, first, math.sqrt(load_from(table, 0, first)))


def test_lanes_from_anywhere_in_a_row():
    table = np.zeros((2, 3 * LANES))
    table[0] = RNG.uniform(0, 10, 3 * LANES)
    for first in (0, 1, LANES + 1, 2 * LANES):
        table[1] = -1.0
        _roots(table, first)
        inside = slice(first, first + LANES)
        assert np.array_equal(table[1, inside], np.sqrt(table[0, inside]))
        assert (table[1] == -1.0).sum() == 2 * LANES
