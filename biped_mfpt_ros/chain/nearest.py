"""The states of a mesh, and the search for the nearest of them.

Everything that depends on how states are searched is in `StateSet`; the mesh knows its two
methods, `extend` and `nearest`. The reachable states of one preceding slope lie on a quasi-2D
manifold. So each cluster has a grid of cells over its two widest principal directions, in the
standardised coordinates of eq. (25), and a search goes outwards from the candidate's cell, ring by
ring, until the distance within the grid alone is more than that to the nearest state found. This
leaves out no state that could be the answer: it is always the one that going through all states
would give.

The grid is laid out anew when the number of states has doubled, and when the scales have changed
much since. In between, a new state goes to its cell at once. Scales that changed little, as they do
from generation to generation, leave the grid as it is: with w_i = 1 / r_i, a distance is at least
that of the grid's own scales times the square of the smallest ratio of new to old w_i.
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.jit import inner_kernel, kernel

STATE_SIZE = 10
"""Length of a state: q1..q5 (rad), dq1..dq5 (rad/s)."""

_FIRST_CAPACITY = 256
_WORTH_A_GRID = 32  # states of a cluster; fewer are gone through one by one
_STATES_PER_CELL = 0.5  # of the whole grid when it is laid out, and up to twice that later
_LIKE_ENOUGH = 0.8  # ratio of weights, or of what was, for which a grid is still good
# Rounding of a place in the grid, relative to the width of the grid and to a distance: with
# sums of ten terms it is below 1e-14.
_MARGIN = 1e-12

# Columns of what describes the grid of a cluster.
_CENTRE = slice(0, STATE_SIZE)  # a state in the middle
_FIRST = slice(STATE_SIZE, 2 * STATE_SIZE)  # cells along the first direction per unit of a state
_SECOND = slice(2 * STATE_SIZE, 3 * STATE_SIZE)
_LOW = 3 * STATE_SIZE  # where cells begin, in cells from the centre, in both directions
_WIDTH = _LOW + 2  # width of a cell, in the unit of the distance
_GRID_SIZE = _WIDTH + 1


@inner_kernel
def _distance(candidates, position, states, index, weights):
    """Eq. (25) between two rows. Ending the sum early would cost more in branches than it saves."""
    distance = 0.0
    for d in range(STATE_SIZE):
        standardised = (candidates[position, d] - states[index, d]) * weights[d]
        distance += standardised * standardised
    return distance


@inner_kernel
def _place(rows, position, grid, columns):
    """Place of a state in a grid, in cells; moved to the edge if outside. NaN if it has none."""
    u = -grid[_LOW]
    v = -grid[_LOW + 1]
    for d in range(STATE_SIZE):
        difference = rows[position, d] - grid[d]
        u += difference * grid[STATE_SIZE + d]
        v += difference * grid[2 * STATE_SIZE + d]
    if np.isnan(u) or np.isnan(v):
        return np.nan, np.nan
    return min(max(u, 0.0), float(columns[0])), min(max(v, 0.0), float(columns[1]))


@inner_kernel
def _cell(place, columns):
    """Index of the cell of a place along one direction."""
    return min(np.int64(place), columns - 1)


@inner_kernel
def _insert(states, index, cluster, grids, columns, first_cells, heads, earlier):
    """Put a state into the chain of its cell, which goes from high indices to low ones."""
    u, v = _place(states, index, grids[cluster], columns[cluster])
    # What has no place is found by those that look everywhere, and by nobody else.
    if np.isnan(u):
        u, v = 0.0, 0.0
    cell = first_cells[cluster] + _cell(u, columns[cluster, 0]) * columns[cluster, 1]
    cell += _cell(v, columns[cluster, 1])
    earlier[index] = heads[cell]
    heads[cell] = index


@inner_kernel
def _nearest_within(
    candidates, position, cluster, weights, limit, any_will_do,
    states, grids, columns, first_cells, heads, earlier,
):  # fmt: skip
    """Index of the nearest state of the cluster within `limit`, the lowest of several; 0: none.

    With `any_will_do` the search ends at the first state within the limit.
    """
    best = limit
    found = 0
    grid = grids[cluster]
    rows = columns[cluster, 0]
    width = columns[cluster, 1]
    unit = grid[_WIDTH]
    u, v = _place(candidates, position, grid, columns[cluster])
    everywhere = np.isnan(u)
    if everywhere:
        u, v = 0.0, 0.0
    own_row = _cell(u, rows)
    own_column = _cell(v, width)
    margin = _MARGIN * (rows + width)
    # How far one may go, in cells, before nothing within `best` can come any more.
    reach = np.inf if everywhere else np.sqrt(best) / unit * (1.0 + _MARGIN) + margin
    ring = 0
    while True:
        top = own_row - ring
        bottom = own_row + ring
        left = own_column - ring
        right = own_column + ring
        for row in range(max(top, 0), min(bottom, rows - 1) + 1):
            gap_u = max(row - u, u - (row + 1), 0.0)
            if gap_u > reach:
                continue
            # Of rows in between only the two ends belong to the ring.
            step = 1 if row in (top, bottom) else max(2 * ring, 1)
            for column in range(left, right + 1, step):
                if column < 0 or column >= width:
                    continue
                gap_v = max(column - v, v - (column + 1), 0.0)
                if gap_u * gap_u + gap_v * gap_v > reach * reach:
                    continue
                index = heads[first_cells[cluster] + row * width + column]
                while index != 0:
                    distance = _distance(candidates, position, states, index, weights)
                    if distance < best or (distance == best and (found == 0 or index < found)):
                        best = distance
                        found = index
                        if any_will_do:
                            return found
                        if not everywhere:
                            reach = np.sqrt(best) / unit * (1.0 + _MARGIN) + margin
                    index = earlier[index]
        # The next ring is at least this far away where there is one.
        gap = np.inf
        if top > 0:
            gap = min(gap, u - top)
        if bottom < rows - 1:
            gap = min(gap, bottom + 1 - u)
        if left > 0:
            gap = min(gap, v - left)
        if right < width - 1:
            gap = min(gap, right + 1 - v)
        if gap > reach or gap == np.inf:
            return found
        ring += 1


@inner_kernel
def _extend(
    candidates, clusters, weights, threshold, start, states, of_cluster, count, added,
    grids, columns, first_cells, heads, earlier,
):  # fmt: skip
    """Add the candidates from `start` on that are new, until all are tested or `added` is full.

    Returns the position of the first candidate not dealt with, and how many were added.
    """
    n = 0
    for position in range(start, candidates.shape[0]):
        cluster = clusters[position]
        if _nearest_within(
            candidates, position, cluster, weights, threshold, True,
            states, grids, columns, first_cells, heads, earlier,
        ) != 0:  # fmt: skip
            continue
        if n == added.shape[0]:
            return position, n
        index = count + n
        for d in range(STATE_SIZE):
            states[index, d] = candidates[position, d]
        of_cluster[index] = cluster
        _insert(states, index, cluster, grids, columns, first_cells, heads, earlier)
        added[n] = position
        n += 1
    return candidates.shape[0], n


@inner_kernel
def _nearest(
    candidates, clusters, weights, states, grids, columns, first_cells, heads, earlier, out
):
    for position in range(candidates.shape[0]):
        out[position] = _nearest_within(
            candidates, position, clusters[position], weights, np.inf, False,
            states, grids, columns, first_cells, heads, earlier,
        )  # fmt: skip


@kernel
def _moments(states, of_cluster, weights, counts, centres, products):
    """Mean, and covariance times number of the standardised states of each cluster."""
    for index in range(1, states.shape[0]):
        for d in range(STATE_SIZE):
            centres[of_cluster[index], d] += states[index, d]
    for cluster in range(counts.shape[0]):
        for d in range(STATE_SIZE):
            centres[cluster, d] /= max(counts[cluster], 1)
    difference = np.empty(STATE_SIZE)
    for index in range(1, states.shape[0]):
        cluster = of_cluster[index]
        for d in range(STATE_SIZE):
            difference[d] = (states[index, d] - centres[cluster, d]) * weights[d]
        for d in range(STATE_SIZE):
            for e in range(STATE_SIZE):
                products[cluster, d, e] += difference[d] * difference[e]


@inner_kernel
def _extents(states, of_cluster, grids, low, high):
    """Smallest and largest place of each cluster's states along both directions of its grid."""
    for index in range(1, states.shape[0]):
        cluster = of_cluster[index]
        grid = grids[cluster]
        u = 0.0
        v = 0.0
        for d in range(STATE_SIZE):
            difference = states[index, d] - grid[d]
            u += difference * grid[STATE_SIZE + d]
            v += difference * grid[2 * STATE_SIZE + d]
        low[cluster, 0] = min(low[cluster, 0], u)
        low[cluster, 1] = min(low[cluster, 1], v)
        high[cluster, 0] = max(high[cluster, 0], u)
        high[cluster, 1] = max(high[cluster, 1], v)


@inner_kernel
def _insert_all(states, of_cluster, grids, columns, first_cells, heads, earlier):
    for index in range(1, states.shape[0]):
        _insert(states, index, of_cluster[index], grids, columns, first_cells, heads, earlier)


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
        self._lay_out(np.ones(STATE_SIZE))

    def __len__(self) -> int:
        return self._count

    @property
    def states(self) -> np.ndarray:
        """The states, shape (n, 10), row 0 all zeros; a view that the next `extend` outdates."""
        return self._states[: self._count]

    def _lay_out(self, weights: np.ndarray) -> None:
        """Lay out the grids for these weights, and put all states into their cells."""
        clusters, states, of_cluster = self._clusters, self.states, self._of_cluster
        self._weights = self._laid_out_for = weights
        self._laid_out = self._count
        counts = np.bincount(of_cluster[1:], minlength=clusters)
        self._grids = np.zeros((clusters, _GRID_SIZE))
        self._grids[:, _WIDTH] = 1.0
        self._columns = np.ones((clusters, 2), dtype=np.int64)
        large = np.flatnonzero(counts >= _WORTH_A_GRID)
        if len(large):
            with np.errstate(all="ignore"):
                self._lay_out_grids(large, counts)
        self._widths = self._grids[:, _WIDTH].copy()
        self._first_cells = np.concatenate([[0], np.cumsum(self._columns.prod(axis=1))])
        self._heads = np.zeros(self._first_cells[-1], dtype=np.uint32)
        _insert_all(states, of_cluster, *self._index())

    def _lay_out_grids(self, large: np.ndarray, counts: np.ndarray) -> None:
        """Lay out the grids of some clusters; what is beyond any number leaves one of one cell."""
        states, of_cluster, weights = self.states, self._of_cluster, self._weights
        centres = np.zeros((self._clusters, STATE_SIZE))
        products = np.zeros((self._clusters, STATE_SIZE, STATE_SIZE))
        _moments(states, of_cluster, weights, counts, centres, products)
        large = large[np.isfinite(products[large]).all(axis=(1, 2))]
        _, vectors = np.linalg.eigh(products[large])
        grids = np.zeros((self._clusters, _GRID_SIZE))
        grids[large, _CENTRE] = centres[large]
        grids[large, _FIRST] = vectors[:, :, -1] * weights
        grids[large, _SECOND] = vectors[:, :, -2] * weights
        low = np.full((self._clusters, 2), np.inf)
        high = np.full((self._clusters, 2), -np.inf)
        _extents(states, of_cluster, grids, low, high)
        extent = (high - low)[large]
        cells = counts[large] / _STATES_PER_CELL
        width = np.maximum(np.sqrt(extent.prod(axis=1) / cells), extent.max(axis=1) / cells)
        usable = np.isfinite(width) & (width > 1e-100)
        large, extent, width = large[usable], extent[usable], width[usable, np.newaxis]
        grids[large, _FIRST] /= width
        grids[large, _SECOND] /= width
        grids[large, _LOW:_WIDTH] = low[large] / width
        grids[large, _WIDTH:] = width
        self._grids[large] = grids[large]
        self._columns[large] += (extent / width).astype(np.int64)

    def _set_weights(self, weights: np.ndarray) -> None:
        """Have the grids be good for these weights, laid out anew if need be."""
        if np.array_equal(weights, self._weights):
            return
        old = self._laid_out_for
        with np.errstate(all="ignore"):
            ratios = np.where(weights == old, 1.0, weights / old)
        if ratios.min() >= _LIKE_ENOUGH and ratios.max() <= 1.0 / _LIKE_ENOUGH:
            self._weights = weights
            self._grids[:, _WIDTH] = ratios.min() * self._widths
        else:
            self._lay_out(weights)

    def _index(self) -> tuple[np.ndarray, ...]:
        return self._grids, self._columns, self._first_cells, self._heads, self._earlier

    def _reserve(self, room: int) -> None:
        """Make room for that many more states, or up to the limit."""
        wanted = min(self._limit, self._count + room)
        if wanted > len(self._states):
            # By half, one array after the other: memory is never twice that of all states.
            capacity = min(self._limit, max(wanted, len(self._states) * 3 // 2))
            for name in ("_states", "_of_cluster", "_earlier"):
                old = getattr(self, name)
                new = np.zeros((capacity, *old.shape[1:]), dtype=old.dtype)
                new[: self._count] = old[: self._count]
                setattr(self, name, new)

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
        self._set_weights(weights)
        pieces = []
        position = 0
        while True:
            # Whatever the grid, the answer is the same: it is the search that gets longer.
            room = 2 * self._laid_out + 64 - self._count
            if room <= 0:
                self._lay_out(weights)
                continue
            room = min(room, _FIRST_CAPACITY + self._count // 8)
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
        self._set_weights(weights)
        out = np.empty(len(candidates), dtype=np.uint32)
        _nearest(candidates, clusters, weights, self._states, *self._index(), out)
        return out
