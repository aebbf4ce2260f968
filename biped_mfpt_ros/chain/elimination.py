r"""Chains of some hundred states, solved without iterating: by squaring, and by elimination.

They may mix as slowly as they like: several gaits with rare changes between them, long periods,
several closed parts. Nothing here is found by subtraction either.

Squaring
    The matrix of 2^k steps is squared until it settles, from what is not negative. The falls in
    2^k steps are carried along, so that rounding in what survives passes neither for falls nor
    for gain.

Elimination
    The mean first-passage times (I - Q)^-1 1 come from elimination without subtractions [1]_
    [2]_: rows of I - Q are kept as off-diagonals and row sums f_i, and the diagonal is the sum of
    these.

References
----------
.. [1] W. K. Grassmann, M. I. Taksar, D. P. Heyman, "Regenerative analysis and steady state
   distributions for Markov chains", Operations Research 33 (1985).
.. [2] A. S. Alfa, J. Xue, Q. Ye, "Accurate computation of the smallest eigenvalue of a diagonally
   dominant M-matrix", Mathematics of Computation 71 (2002).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from biped_mfpt_ros.chain.iteration import UNDERFLOW
from biped_mfpt_ros.jit import kernel

_SQUARINGS = 1100  # 2^1100 is more than any MFPT


def _squared(
    q: np.ndarray, falls: np.ndarray, among: np.ndarray, tolerance: float
) -> np.ndarray | None:
    """Limit of the distribution after 2^k steps from any of the states `among`, given no fall.

    `falls` is what leaves Q, shape (n,). The limit has to be the same from each of `among`, which
    are the states of a class, so that the first steps do not decide between slow parts. None if
    it does not settle.
    """
    n = len(q)
    # With every other step one of staying there are no periods.
    power, left = 0.5 * (q + np.eye(n)), 0.5 * falls
    x = np.full(n, 1.0 / n)
    for _ in range(_SQUARINGS):
        power, left = power @ power, left + power @ left
        survives = power.sum(axis=1)
        rare = left < 0.5
        power[rare] *= ((1.0 - left[rare]) / survives[rare])[:, np.newaxis]
        if survives.max() < 1e-100:
            power /= survives.max()
        sums = power[among].sum(axis=1)[:, np.newaxis]
        if not sums.all():  # too small to be told from 0
            return None
        rows = power[among] / sums
        previous, x = x, rows[0]
        floor = tolerance / n * float(x @ falls)
        # A slow part that still fills doubles its weight, what is missing of it is squared.
        counts = (x > UNDERFLOW) & ((x > previous) | (x > floor))
        if (np.abs(previous - x)[counts] <= tolerance * x[counts]).all():
            counts = (x > UNDERFLOW) & (x > floor)
            if (np.abs(rows - x)[:, counts] <= tolerance * x[counts]).all():
                return x
    return None


def squared_distribution(q: np.ndarray, falls: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Metastable distribution of a small chain, from its classes of states that reach each other.

    lambda_2 is the largest of the classes' eigenvalues, and phi the limit of the distribution
    from a state of that class.

    Parameters
    ----------
    q : numpy.ndarray
        Q, shape (n, n).
    falls : numpy.ndarray
        Probability to fall from each state, shape (n,).
    tolerance : float
        Relative accuracy aimed at.

    Returns
    -------
    numpy.ndarray or None
        Sum 1, shape (n,); None if it does not settle.
    """
    graph = csr_array(q)
    count, labels = connected_components(graph, connection="strong")
    classes = [np.flatnonzero(labels == label) for label in range(count)]
    keys, vectors = [], []
    for states in classes:
        leaves = falls[states] + q[states][:, labels != labels[states[0]]].sum(axis=1)
        own = q[np.ix_(states, states)]
        among = np.arange(len(states))
        x = _squared(own, leaves, among, tolerance) if own.any() else np.ones(1)
        if x is None:
            return None
        # Near 1 the rates no longer tell small eigenvalues apart; what stays does.
        keys.append((float(x @ leaves), -float((x @ own).sum())))
        vectors.append(x)
    best = min(range(count), key=keys.__getitem__)
    while True:
        below = np.sort(breadth_first_order(graph, classes[best][0], return_predecessors=False))
        # Of equal classes one behind the other, the last one keeps all the weight.
        behind = [c for c in set(labels[below]) if c != best and keys[c] == keys[best]]
        if not behind:
            break
        best = behind[0]
    x = vectors[best]
    if len(below) > len(x):
        among = np.searchsorted(below, classes[best])
        x = _squared(q[np.ix_(below, below)], falls[below], among, tolerance)
        if x is None:
            return None
    out = np.zeros(len(q))
    out[below] = x
    return out


@kernel
def _eliminate(q, falls, x):
    """Replace x by (I - Q)^-1 x without subtracting; `q` and `falls` are used up.

    The diagonal of `q` is not read. States are eliminated from the last to the first: a visit to
    one is followed on to where it leads among those that are left, or to the fall.
    """
    for p in range(q.shape[0] - 1, -1, -1):
        leaves = falls[p]
        for j in range(p):
            leaves += q[p, j]
        for j in range(p):
            q[p, j] /= leaves
        falls[p] /= leaves
        x[p] /= leaves
        for i in range(p):
            share = q[i, p]
            if share != 0.0:
                falls[i] += share * falls[p]
                x[i] += share * x[p]
                for j in range(p):
                    q[i, j] += share * q[p, j]
    for p in range(1, q.shape[0]):
        for j in range(p):
            x[p] += q[p, j] * x[j]


def eliminated_times(q: np.ndarray, falls: np.ndarray) -> np.ndarray:
    """Mean first-passage times (I - Q)^-1 1, shape (n,), where a fall can be reached from all.

    `q`, shape (n, n), and `falls`, shape (n,), are used up.
    """
    times = np.ones(len(q))
    _eliminate(q, falls, times)
    return times
