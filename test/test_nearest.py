"""The search for the nearest state: always what going through all states gives, bit for bit."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biped_mfpt_ros.chain.nearest import STATE_SIZE, StateSet


def distances(candidate, states, scales) -> np.ndarray:
    """Eq. (25) to each state, with the terms added up in the same order; shape (n,)."""
    total = np.zeros(len(states))
    with np.errstate(over="ignore"):
        for d in range(STATE_SIZE):
            standardised = (candidate[d] - states[:, d]) * (1.0 / scales[d])
            total += standardised * standardised
    return total


class Reference:
    """A `StateSet` that goes through all states, one by one."""

    def __init__(self):
        self.states = np.zeros((1, STATE_SIZE))
        self.clusters = np.array([-1])

    def nearest(self, candidate, cluster, scales):
        own = np.flatnonzero(self.clusters == cluster)
        if len(own) == 0:
            return 0, np.inf
        d = distances(candidate, self.states[own], scales)
        return own[np.argmin(d)], d.min()

    def extend(self, candidates, clusters, scales, threshold):
        added = []
        for position, (candidate, cluster) in enumerate(zip(candidates, clusters, strict=True)):
            if self.nearest(candidate, cluster, scales)[1] > threshold:
                self.states = np.vstack([self.states, candidate])
                self.clusters = np.append(self.clusters, cluster)
                added.append(position)
        return added


def near_a_surface(rng, n, decimals):
    """States on a curved surface; few decimals make equal states and equal distances likely."""
    u, v = rng.uniform(-1.0, 1.0, (2, n))
    columns = [u, v, u * v, u + v, u - 2 * v, u * u, v * v, 0 * u, u**3, 1.0 + v**2 - u]
    return np.round(np.stack(columns, axis=1), decimals)


def some_far_out(rng, states):
    """The states, some of them where no grid over the others reaches, or squares overflow."""
    states[rng.random(len(states)) < 0.02] *= 1e3
    states[rng.random(len(states)) < 0.005] *= rng.choice([1e9, 1e160, 1e300])
    return states


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 300),
    clusters=st.integers(1, 5),
    decimals=st.integers(0, 3),
    threshold=st.sampled_from([1e-6, 0.01, 0.25, 1.0, 4.0]),
    unscaled=st.integers(0, STATE_SIZE),
)
@settings(deadline=None, max_examples=150)
def test_set_is_that_of_going_through_all(seed, n, clusters, decimals, threshold, unscaled):
    rng = np.random.default_rng(seed)
    found, reference = StateSet(clusters, 10_000), Reference()
    for _ in range(3):  # the scales change from one to the next
        scales = rng.choice([0.5, 1.0, 2.0, 3.7], STATE_SIZE)
        scales[rng.permutation(STATE_SIZE)[:unscaled]] = np.inf
        candidates = some_far_out(rng, near_a_surface(rng, n, decimals))
        own = rng.integers(0, clusters, n).astype(np.uint32)
        added, complete = found.extend(candidates, own, scales, threshold)
        assert complete
        assert added.tolist() == reference.extend(candidates, own, scales, threshold)
        assert np.array_equal(found.states, reference.states)
        queries = some_far_out(rng, near_a_surface(rng, 20, decimals))
        own = rng.integers(0, clusters, 20).astype(np.uint32)
        expected = [reference.nearest(q, c, scales)[0] for q, c in zip(queries, own, strict=True)]
        assert found.nearest(queries, own, scales).tolist() == expected


@pytest.mark.parametrize("clusters", [1, 7])
def test_large_set_is_that_of_going_through_all(clusters):
    # Enough to be laid out and enlarged several times within one call.
    rng = np.random.default_rng(clusters)
    candidates = near_a_surface(rng, 6000, 12)
    scales = candidates.std(axis=0)
    candidates = some_far_out(rng, candidates)
    own = rng.integers(0, clusters, len(candidates)).astype(np.uint32)
    scales[7] = np.inf  # constant
    found, reference = StateSet(clusters, 100_000), Reference()
    added, complete = found.extend(candidates, own, scales, 0.002)
    assert complete
    assert len(added) > 2000
    assert added.tolist() == reference.extend(candidates, own, scales, 0.002)
    queries = some_far_out(rng, near_a_surface(rng, 500, 12))
    own = rng.integers(0, clusters, 500).astype(np.uint32)
    expected = [reference.nearest(q, c, scales)[0] for q, c in zip(queries, own, strict=True)]
    assert found.nearest(queries, own, scales).tolist() == expected


def test_the_grid_outlasts_scales_that_change_a_little():
    # In a plane, where distances are those within the grid: they are less than it was laid out for.
    rng = np.random.default_rng(1)
    flat = np.zeros((3000, STATE_SIZE))
    flat[:, :2] = rng.uniform(-1.0, 1.0, (3000, 2))
    scales = np.full(STATE_SIZE, np.inf)
    scales[:2] = 1.0
    found, reference = StateSet(1, 100_000), Reference()
    own = np.zeros(1000, dtype=np.uint32)
    found.extend(flat[:1000], own, scales, 1e-9)
    reference.extend(flat[:1000], own, scales, 1e-9)
    for factor in (1.0, 1.2, 0.9, 1.5):
        changed = scales * factor
        expected = [reference.nearest(query, 0, changed)[0] for query in flat[1000:]]
        assert found.nearest(flat[1000:], np.tile(own, 2), changed).tolist() == expected


def test_lowest_index_wins_a_tie():
    found = StateSet(1, 100)
    states = np.zeros((4, STATE_SIZE))
    states[:, 0] = [1.0, -1.0, 3.0, -3.0]
    one = np.ones(STATE_SIZE)
    found.extend(states, np.zeros(4, np.uint32), one, 0.1)
    queries = np.zeros((3, STATE_SIZE))
    queries[:, 0] = [0.0, 2.0, -2.0]
    assert found.nearest(queries, np.zeros(3, np.uint32), one).tolist() == [1, 1, 2]


def test_distance_equal_to_the_threshold_is_not_new():
    found = StateSet(1, 100)
    states = np.zeros((3, STATE_SIZE))
    states[:, 3] = [0.0, 2.0, np.nextafter(-2.0, -3.0)]
    added, _ = found.extend(states, np.zeros(3, np.uint32), np.ones(STATE_SIZE), 4.0)
    assert added.tolist() == [0, 2]


def test_distances_beyond_any_number_are_distances():
    found = StateSet(2, 100)
    states = np.zeros((4, STATE_SIZE))
    states[:, 0] = [-1e200, 1e200, 3e200, 0.0]
    own = np.array([1, 1, 1, 0], np.uint32)
    added, _ = found.extend(states, own, np.ones(STATE_SIZE), 1e300)
    assert added.tolist() == [0, 1, 2, 3]
    assert found.nearest(states, own, np.ones(STATE_SIZE)).tolist() == [1, 2, 3, 4]


def test_cluster_without_a_state_makes_any_candidate_new_and_has_no_nearest():
    found = StateSet(3, 100)
    one = np.ones(STATE_SIZE)
    same = np.zeros((3, STATE_SIZE))
    assert found.nearest(same, np.array([0, 1, 2], np.uint32), one).tolist() == [0, 0, 0]
    added, _ = found.extend(same, np.array([0, 2, 0], np.uint32), one, 1e9)
    assert added.tolist() == [0, 1]
    assert found.nearest(same, np.array([0, 1, 2], np.uint32), one).tolist() == [1, 0, 2]


@pytest.mark.parametrize("limit", [2, 5, 256, 257, 300, 1000])
def test_limit(limit):
    states = np.zeros((1000, STATE_SIZE))
    states[:, 1] = np.arange(1000)
    own = np.zeros(1000, np.uint32)
    found = StateSet(1, limit)
    added, complete = found.extend(states, own, np.ones(STATE_SIZE), 0.5)
    assert not complete
    assert len(found) == limit
    assert added.tolist() == list(range(limit - 1))
    # What is not new still fits.
    again, complete = found.extend(states[: limit - 1], own[: limit - 1], np.ones(STATE_SIZE), 0.5)
    assert complete
    assert len(again) == 0


def test_memory_of_a_state():
    # 80 bytes are the state itself.
    rng = np.random.default_rng(3)
    candidates = near_a_surface(rng, 100_000, 15)
    own = np.zeros(len(candidates), np.uint32)
    scales = candidates.std(axis=0) + 0.1
    tracemalloc.start()
    try:
        found = StateSet(1, 1_000_000)
        for first in range(0, len(candidates), 10_000):
            piece = slice(first, first + 10_000)
            found.extend(candidates[piece], own[piece], scales, 0.0)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(found) > 99_000
    assert peak / len(found) < 400
