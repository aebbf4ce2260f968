"""Algorithm 1's test of new states to the letter: r_i of eq. (25) anew after each addition to X.

The scales change with every state that is added, so no index over the states outlasts an addition:
each candidate is compared with all states of its cluster. That is fast enough for what the paper
calls a mesh, some thousand states; `chain.nearest` is what larger ones are grown with.
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.jit import kernel


@kernel
def _additions(
    candidates, clusters, threshold, rounding, fallback, most, states, earlier, newest, count,
    mean, squares, largest, added,
):  # fmt: skip
    """Find the candidates to add; `states[:count]` are those of X, chained by cluster.

    Returns how many were added, and whether `most` states were enough.
    """
    size = candidates.shape[1]
    weights = np.empty(size)
    n = 0
    stale = True
    for position in range(candidates.shape[0]):
        if stale:
            for d in range(size):
                spread = np.sqrt(squares[d] / count)
                if not spread > rounding * max(largest[d], 1.0):
                    spread = fallback[d]
                weights[d] = 1.0 / spread if spread > 0.0 else 0.0
            stale = False
        cluster = clusters[position]
        index = newest[cluster]
        while index >= 0:
            distance = 0.0
            for d in range(size):
                standardised = (candidates[position, d] - states[index, d]) * weights[d]
                distance += standardised * standardised
            if distance <= threshold:
                break
            index = earlier[index]
        if index >= 0:
            continue
        if count == most:
            return n, False
        for d in range(size):
            # Welford's update: no difference of large sums.
            value = candidates[position, d]
            states[count, d] = value
            before = value - mean[d]
            mean[d] += before / (count + 1)
            squares[d] += before * (value - mean[d])
            largest[d] = max(largest[d], abs(value))
        earlier[count] = newest[cluster]
        newest[cluster] = count
        count += 1
        added[n] = position
        n += 1
        stale = True
    return n, True


def additions(
    states: np.ndarray,
    state_clusters: np.ndarray,
    candidates: np.ndarray,
    candidate_clusters: np.ndarray,
    fallback: np.ndarray,
    threshold: float,
    rounding: float,
    most: int,
) -> tuple[np.ndarray, bool]:
    """Find the candidates that Algorithm 1 adds, in order, with r_i of all states so far.

    Parameters
    ----------
    states, state_clusters : numpy.ndarray
        X without x_1, float64, shape (n, d), and the cluster of each, shape (n,).
    candidates, candidate_clusters : numpy.ndarray
        What is tested, float64, shape (k, d), and shape (k,).
    fallback : numpy.ndarray
        r_i of a dimension in which X has no spread yet, shape (d,); 0 leaves it out.
    threshold : float
        d_thr.
    rounding : float
        A standard deviation of no more than this, relative to the largest value of the dimension
        or 1, is no spread.
    most : int
        Most states that X without x_1 may have.

    Returns
    -------
    added : numpy.ndarray
        int64, positions of the candidates that are added, ascending.
    complete : bool
        False if there would be more than `most` states.
    """
    n, k = len(states), len(candidates)
    room = min(n + k, most)
    everything = np.empty((room, states.shape[1]))
    everything[:n] = states
    clusters = 1 + int(max(state_clusters.max(), candidate_clusters.max(initial=0)))
    earlier = np.full(room, -1, dtype=np.int64)
    newest = np.full(clusters, -1, dtype=np.int64)
    for index, cluster in enumerate(state_clusters):
        earlier[index] = newest[cluster]
        newest[cluster] = index
    added = np.empty(k, dtype=np.int64)
    count, complete = _additions(
        candidates, candidate_clusters, threshold, rounding, fallback, most, everything,
        earlier, newest, n, states.mean(axis=0), n * states.var(axis=0),
        np.abs(states).max(axis=0), added,
    )  # fmt: skip
    return added[:count], complete
