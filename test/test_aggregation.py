"""Slow chains by aggregation, with far fewer groups than states, against arithmetic of many digits.

GROUPS is set so low that every chain here takes rounds of steps. One state to a group, as in small
chains, is what `test_markov` compares.
"""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from scipy.sparse import csr_array, diags
from test_markov import (
    RELATIVE,
    assert_same_bits,
    exact_failure_probability,
    lifted,
    mesh_of,
    relative,
    walker,
)

from biped_mfpt_ros.chain import aggregation, markov
from biped_mfpt_ros.chain.aggregation import metastable_distribution, passage_times
from biped_mfpt_ros.chain.markov import metastabilities, slope_probabilities

TOLERANCE = markov.TOLERANCE
PART = 12  # states


@pytest.fixture
def few_groups(monkeypatch):
    """Fewer groups than states of a part, and no pieces."""
    monkeypatch.setattr(aggregation, "GROUPS", 8)
    monkeypatch.setattr(aggregation, "_PIECES", 1)


def dense_part(rng) -> np.ndarray:
    return rng.random((PART, PART)) ** 3


def ring_part(rng) -> np.ndarray:
    """Nearly periodic: one state out of three leads elsewhere now and then."""
    part = np.roll(np.eye(PART), 1, axis=1)
    for i in range(0, PART, 3):
        part[i, rng.integers(PART)] += 1e-3
    return part


def drifting_part(rng) -> np.ndarray:
    """Away from the first state, so that the weights span 1e-7."""
    part = 0.8 * np.eye(PART, k=1) + 0.2 * np.eye(PART, k=-1)
    part[0, 0], part[-1, -1] = 0.2, 0.8
    return part


PARTS = {"dense": dense_part, "ring": ring_part, "drifting": drifting_part}


def chain(kind, coupling, falls, one_way=False) -> tuple[np.ndarray, np.ndarray]:
    """Q and falls of parts that change into each other; each falls from its first state."""
    rng = np.random.default_rng(1)
    n = PART * len(falls)
    q, f = np.zeros((n, n)), np.zeros(n)
    for g, fall in enumerate(falls):
        part = slice(PART * g, PART * (g + 1))
        q[part, part] = PARTS[kind](rng)
        q[part, part] /= q[part, part].sum(axis=1)[:, np.newaxis]
        f[PART * g] = fall
    for g in range(len(falls)):
        for h in range(g + 1 if one_way else 0, len(falls)):
            if g != h:
                q[PART * g + rng.integers(PART), PART * h + rng.integers(PART)] = coupling * (1 + h)
    total = q.sum(axis=1) + f
    return q / total[:, np.newaxis], f / total


def exactly(q, falls, start) -> tuple[mpmath.mpf, list]:
    """1 - lambda_2 of what is reached from a state, and mean first-passage times.

    Both from (I - Q)^-1, where the diagonal of I - Q is the sum of the rest, as it is of the
    stochastic matrix that Q is part of. Its powers have the eigenvector in their rows.
    """
    n = len(falls)
    with mpmath.workdps(150):
        a = mpmath.matrix(n)
        for i in range(n):
            for j in range(n):
                if i != j:
                    a[i, j] = -mpmath.mpf(float(q[i, j]))
            a[i, i] = mpmath.mpf(float(falls[i])) - sum(a[i, j] for j in range(n) if j != i)
        visits = a**-1
        times = [sum(visits[i, j] for j in range(n)) for i in range(n)]
        power = visits
        for _ in range(18):
            power = power * power
            power /= max(power)
        x = power[start, :] / sum(power[start, :])
        return sum(x[i] * mpmath.mpf(float(falls[i])) for i in range(n)), times


@pytest.mark.parametrize("kind", PARTS)
@pytest.mark.parametrize("coupling", [1e-4, 1e-9, 1e-14])
@pytest.mark.parametrize("falls", [(1e-1, 1e-40), (1e-20, 3e-20), (1e-3, 1e-1, 1e-5), (1e-12, 0.0)])
def test_parts_that_hardly_change(few_groups, kind, coupling, falls):
    q, f = chain(kind, coupling, falls)
    escape, times = exactly(q, f, 0)
    phi = metastable_distribution(csr_array(q), f, TOLERANCE)
    assert relative(phi @ f, escape) < RELATIVE
    for value, reference in zip(passage_times(csr_array(q), f, TOLERANCE), times, strict=True):
        assert relative(value, reference) < RELATIVE


@pytest.mark.parametrize("kind", PARTS)
@pytest.mark.parametrize("falls", [(1e-3, 1e-20), (1e-20, 1e-3), (1e-10, 1e-30, 1e-12)])
def test_parts_that_are_left_but_never_entered(few_groups, kind, falls):
    q, f = chain(kind, 1e-14, falls, one_way=True)
    escape, times = exactly(q, f, 0)
    phi = metastable_distribution(csr_array(q), f, TOLERANCE)
    assert relative(phi @ f, escape) < RELATIVE
    for value, reference in zip(passage_times(csr_array(q), f, TOLERANCE), times, strict=True):
        assert relative(value, reference) < RELATIVE


def test_several_parts_that_never_fall(few_groups):
    # The first leads to the others, which keep all weight: one of them is stationary.
    q, f = chain("dense", 1e-9, (1e-3, 0.0, 0.0), one_way=True)
    q[PART : 2 * PART, 2 * PART :] = 0.0
    q /= (q.sum(axis=1) + f)[:, np.newaxis]
    phi = metastable_distribution(csr_array(q), f, TOLERANCE)
    assert phi @ f == 0.0
    assert phi[:PART].sum() == 0.0
    assert phi @ q == pytest.approx(phi, rel=1e-11, abs=1e-290)


def test_equal_parts_that_change_less_often_than_rounding_tells(few_groups):
    # How they share the weight is lost in rounding. 1 - lambda_2 is not.
    q, f = chain("dense", 0.0, (1e-10,))
    q, f = np.kron(np.eye(2), q), np.tile(f, 2)
    q[0, PART] = q[PART, 0] = 1e-25
    escape, _ = exactly(q, f, 0)
    phi = metastable_distribution(csr_array(q), f, TOLERANCE)
    assert relative(phi @ f, escape) < RELATIVE


def test_a_class_is_not_given_up_for_one_that_seems_to_last_longer():
    # Weights taken from another shape may say so for some rounds.
    q, f = csr_array([[0.5, 1e-3], [0.0, 1.0]]), np.array([0.499, 1e-9])
    x, each = np.array([0.25, 0.75]), np.arange(2)
    found = aggregation._share_out(q, f, x, each, TOLERANCE, np.array([0]), None)
    assert found.tolist() == x.tolist()


def test_long_walk_in_small_steps():
    # Without any closed part; see test_symmetric_walk_between_two_falls.
    n = 2 * aggregation.GROUPS
    q = csr_array(diags([np.full(n - 1, 0.5)] * 2, offsets=[-1, 1]))
    f = np.zeros(n)
    f[[0, -1]] = 0.5
    phi = metastable_distribution(q, f, TOLERANCE)
    assert phi @ f == pytest.approx(2.0 * math.sin(math.pi / (n + 1) / 2) ** 2, rel=RELATIVE)
    k = np.arange(1, n + 1)
    assert passage_times(q, f, TOLERANCE) == pytest.approx(k * (n + 1.0 - k), rel=RELATIVE)


def test_large_chain_of_two_gaits(monkeypatch):
    # Two walkers, of which the second falls more often; on the steepest slope up the gait changes
    # instead of the fall, once in 1e34 and 1e56 steps.
    monkeypatch.setattr(markov, "_STEPS", 200)
    calls = []

    def counted(*args):
        calls.append(len(args[1]))
        return metastable_distribution(*args)

    monkeypatch.setattr(markov, "metastable_distribution", counted)
    rows, slopes = walker(4, 0.5)
    n = len(rows)
    other = [[t + n if t else 0 for t in row] for row in walker(4, 0.6)[0]]
    rows = [[*row[:-1], n + 1] for row in rows] + [[*row[:-1], 1] for row in other]
    mesh = mesh_of(*lifted(rows, len(slopes), 1301), slopes)
    assert len(mesh.states) > 20000
    sigmas = np.radians([1.25, 1.6])
    found = metastabilities(mesh, 0.0, sigmas, threads=2)
    assert calls == [len(mesh.states) - 1] * 2
    for sigma, result in zip(sigmas, found, strict=True):
        p = slope_probabilities(slopes, 0.0, sigma)
        assert relative(result.mfpt, 1 / exact_failure_probability(rows, p)) < RELATIVE
        assert_same_bits(result, markov.metastability(mesh, 0.0, sigma))
