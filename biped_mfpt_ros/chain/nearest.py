"""The states of a mesh, and the search for the nearest of them.

Everything that depends on how states are searched is in `StateSet`; the mesh knows its two
methods, `extend` and `nearest`. The reachable states lie on a quasi-2D manifold, and those of one
preceding slope near a line. So the states of a cluster are kept sorted along their widest
dimension, and the search goes outwards from the candidate's place until that dimension alone is
farther than the nearest state found. This leaves out no state that could be the answer: it is
always the one that going through all states would give.
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.jit import kernel

STATE_SIZE = 10
"""Length of a state: q1..q5 (rad), dq1..dq5 (rad/s)."""

_FIRST_CAPACITY = 256
# The newest states wait unsorted until they are more than this, and more than this share of all:
# few enough to go through one by one, and so that sorting anew stays a small part of the work.
_UNSORTED_STATES = 256
_UNSORTED_SHARE = 1.0 / 32.0


@kernel
def _distance(candidates, position, states, index, weights):
    """Eq. (25) between two rows. Ending the sum early would cost more in branches than it saves."""
    distance = 0.0
    for d in range(STATE_SIZE):
        standardised = (candidates[position, d] - states[index, d]) * weights[d]
        distance += standardised * standardised
    return distance


@kernel
def _nearest_within(
    candidates, position, cluster, weights, limit, any_will_do,
    states, order, rows, starts, axes, earlier, newest,
):  # fmt: skip
    """Index of the nearest state of the cluster within `limit`, the lowest of several; 0: none.

    With `any_will_do` the search ends at the first state within the limit.

    `rows[starts[c] : starts[c + 1]]` are the sorted states of cluster c, ascending along
    dimension `axes[c]`, and `order` holds their indices. The unsorted ones form a chain: from
    `newest[c]` to ever earlier ones, to 0.
    """
    best = limit
    found = 0
    index = newest[cluster]
    while index != 0:
        distance = _distance(candidates, position, states, index, weights)
        # From high indices to low ones: "not above" lets the lowest index win a tie.
        if distance <= best:
            best = distance
            found = index
            if any_will_do:
                return found
        index = earlier[index]

    axis = axes[cluster]
    value = candidates[position, axis]
    weight = weights[axis]
    begin = starts[cluster]
    end = starts[cluster + 1]
    low = begin
    high = end
    while low < high:
        middle = (low + high) // 2
        if rows[middle, axis] < value:
            low = middle + 1
        else:
            high = middle
    down = low - 1
    up = low
    while True:
        gap_down = np.inf
        gap_up = np.inf
        if down >= begin:
            gap_down = ((value - rows[down, axis]) * weight) ** 2
        if up < end:
            gap_up = ((value - rows[up, axis]) * weight) ** 2
        # One term of the sum of squares is never above the sum, in floating point too.
        if min(gap_down, gap_up) > best or (down < begin and up >= end):
            break
        if up >= end or (down >= begin and gap_down <= gap_up):
            row = down
            down -= 1
        else:
            row = up
            up += 1
        distance = _distance(candidates, position, rows, row, weights)
        if distance < best or (distance == best and (found == 0 or order[row] < found)):
            best = distance
            found = order[row]
            if any_will_do:
                return found
    return found


@kernel
def _extend(
    candidates, clusters, weights, threshold, start, states, of_cluster, count, added,
    order, rows, starts, axes, earlier, newest,
):  # fmt: skip
    """Add the candidates from `start` on that are new, until all are tested or `added` is full.

    Returns the position of the first candidate not dealt with, and how many were added.
    """
    n = 0
    for position in range(start, candidates.shape[0]):
        cluster = clusters[position]
        if _nearest_within(
            candidates, position, cluster, weights, threshold, True,
            states, order, rows, starts, axes, earlier, newest,
        ) != 0:  # fmt: skip
            continue
        if n == added.shape[0]:
            return position, n
        index = count + n
        for d in range(STATE_SIZE):
            states[index, d] = candidates[position, d]
        of_cluster[index] = cluster
        earlier[index] = newest[cluster]
        newest[cluster] = index
        added[n] = position
        n += 1
    return candidates.shape[0], n


@kernel
def _nearest(
    candidates, clusters, weights, states, order, rows, starts, axes, earlier, newest, out
):
    for position in range(candidates.shape[0]):
        out[position] = _nearest_within(
            candidates, position, clusters[position], weights, np.inf, False,
            states, order, rows, starts, axes, earlier, newest,
        )  # fmt: skip


@kernel
def _widest_axes(states, of_cluster, weights, lowest, highest, axes):
    """For each cluster the dimension in which its states are spread widest by eq. (25)."""
    for index in range(1, states.shape[0]):
        cluster = of_cluster[index]
        for d in range(STATE_SIZE):
            lowest[cluster, d] = min(lowest[cluster, d], states[index, d])
            highest[cluster, d] = max(highest[cluster, d], states[index, d])
    for cluster in range(axes.shape[0]):
        axes[cluster] = np.argmax((highest[cluster] - lowest[cluster]) * weights)


class StateSet:
    """The states of a growing mesh, each in a cluster. Index 0 is the failure state.

    Distances are those of eq. (25), the sum over the dimensions of ((a_i - b_i) / r_i)^2, to
    states of the same cluster. The scales r_i come with each call, because they change as the
    mesh grows. An infinite r_i leaves its dimension out.

    Parameters
    ----------
    clusters : int
        Number of clusters.
    limit : int
        Most states that the set may hold, the failure state counted.
    """

    def __init__(self, clusters: int, limit: int) -> None:
        self._clusters = clusters
        self._limit = limit
        self._count = 1
        capacity = min(_FIRST_CAPACITY, limit)
        self._states = np.zeros((capacity, STATE_SIZE))
        self._of_cluster = np.zeros(capacity, dtype=np.uint32)
        self._earlier = np.zeros(capacity, dtype=np.uint32)
        self._sort(np.ones(STATE_SIZE))

    def __len__(self) -> int:
        return self._count

    @property
    def states(self) -> np.ndarray:
        """The states, shape (n, 10), row 0 all zeros; a view that the next `extend` outdates."""
        return self._states[: self._count]

    def _sort(self, weights: np.ndarray) -> None:
        """Sort all states by cluster and, in each, along its widest dimension."""
        count, clusters = self._count, self._clusters
        self._sorted = count
        self._axes = np.zeros(clusters, dtype=np.int64)
        _widest_axes(
            self.states,
            self._of_cluster,
            weights,
            np.full((clusters, STATE_SIZE), np.inf),
            np.full((clusters, STATE_SIZE), -np.inf),
            self._axes,
        )
        of_cluster = self._of_cluster[1:count]
        along = self._states[np.arange(1, count), self._axes[of_cluster]]
        sequence = np.lexsort((along, of_cluster))
        self._order = (sequence + 1).astype(np.uint32)
        self._rows = self._states[self._order]
        self._starts = np.searchsorted(of_cluster[sequence], np.arange(clusters + 1))
        self._newest = np.zeros(clusters, dtype=np.uint32)

    def _index(self) -> tuple[np.ndarray, ...]:
        return self._order, self._rows, self._starts, self._axes, self._earlier, self._newest

    def _reserve(self, room: int) -> None:
        """Make room for that many more states, or up to the limit, growing by doubling."""
        wanted = min(self._limit, self._count + room)
        if wanted > len(self._states):
            more = min(self._limit, max(wanted, 2 * len(self._states))) - len(self._states)
            self._states = np.concatenate([self._states, np.zeros((more, STATE_SIZE))])
            self._of_cluster = np.concatenate([self._of_cluster, np.zeros(more, np.uint32)])
            self._earlier = np.concatenate([self._earlier, np.zeros(more, np.uint32)])

    def extend(
        self, candidates: np.ndarray, clusters: np.ndarray, scales: np.ndarray, threshold: float
    ) -> tuple[np.ndarray, bool]:
        """Add, in order, every candidate farther than the threshold from all states so far.

        States that this call has already added count. A candidate in a cluster without any
        state is always added.

        Parameters
        ----------
        candidates : numpy.ndarray
            float64, shape (k, 10).
        clusters : numpy.ndarray
            uint32, shape (k,).
        scales : numpy.ndarray
            r_i of eq. (25), float64, shape (10,), above 0; inf leaves a dimension out.
        threshold : float
            d_thr.

        Returns
        -------
        added : numpy.ndarray
            int64, positions of the candidates that were added, ascending.
        complete : bool
            False if the limit was reached and a further candidate had to be added.
        """
        weights = 1.0 / scales
        pieces = []
        position = 0
        while True:
            # Whatever the order, the answer is the same: it is the search that gets longer.
            room = self._sorted - self._count
            room += int(max(_UNSORTED_STATES, _UNSORTED_SHARE * self._sorted))
            if room <= 0:
                self._sort(weights)
                continue
            self._reserve(room)
            added = np.empty(min(room, self._limit - self._count), dtype=np.int64)
            position, n = _extend(
                candidates, clusters, weights, threshold, position,
                self._states, self._of_cluster, self._count, added, *self._index(),
            )  # fmt: skip
            self._count += n
            pieces.append(added[:n])
            complete = position == len(candidates)
            if complete or self._count == self._limit:
                return np.concatenate(pieces), complete

    def nearest(
        self, candidates: np.ndarray, clusters: np.ndarray, scales: np.ndarray
    ) -> np.ndarray:
        """Index of the nearest state, c(x, X) of eq. (26); the lowest one of several.

        Parameters
        ----------
        candidates, clusters, scales : numpy.ndarray
            As for `extend`.

        Returns
        -------
        numpy.ndarray
            uint32, shape (k,); 0 where the cluster has no state.
        """
        weights = 1.0 / scales
        if self._sorted < self._count:
            self._sort(weights)
        out = np.empty(len(candidates), dtype=np.uint32)
        _nearest(candidates, clusters, weights, self._states, *self._index(), out)
        return out
