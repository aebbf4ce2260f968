r"""Chains that mix slowly, of any size: aggregation and disaggregation.

Steps alone would take 1e10 of them where two gaits change into each other once in so many. But a
few even out each gait, and how the gaits share the weight follows from a chain of two states. So
rounds of steps alternate with the exact solution of a small chain, as Takahashi and Koury,
McAllister and Stewart do [1]_: states are put together in groups, the weights x within a group are
taken as they are,

    C_IJ = sum over i in I, j in J of x_i Q_ij / sum over i in I of x_i,

and each group gets the weight that it has in the chain C (see `elimination`). The result of the
chain itself is a fixed point of this for any groups, and falls are sums of products here as well,
so nothing is lost to subtraction.

Groups are found in three ways, and intersected as long as there are not too many.

Nearly closed parts
    States are joined with where they mostly lead to, and so are the groups that come of it, until
    each leads to any other once in a hundred steps at most. This sees parts that hardly ever
    change into each other, when no number of steps would show.
How weights change
    Where steps still move weight slowly, these steps tell from where to where: states whose
    weights change by the same factor are in balance with each other, and form a group.
Pieces
    States that lead to each other, so many to a piece: for walks in many small steps.

Chains of up to `GROUPS` states have one state to a group, and need no steps.

References
----------
.. [1] W. J. Stewart, "Introduction to the Numerical Solution of Markov Chains", Princeton
   University Press (1994), chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from biped_mfpt_ros.chain.elimination import limit_distribution, visits
from biped_mfpt_ros.chain.iteration import UNDERFLOW
from biped_mfpt_ros.jit import kernel

GROUPS = 400
"""Most groups; time to solve for them grows with the cube."""

ROUNDS = 150
"""Rounds of steps and solutions after which to give up."""

# Half the steps of a round: the mean of the second half is taken, in which periods even out.
_STEPS = 50
_ROUNDS_ALIKE = 10  # after which the steps are doubled
_WORK = 1_000_000_000  # most transitions to follow in a round for which steps are doubled
_ROUNDS_IN_VAIN = 20  # without coming closer, when rounding decides
_RARE = 1e-2  # probability below which a group hardly leads to another
_PIECES = GROUPS // 4
_LEVELS = 8  # of the change of weights in a round
_ROUNDS_KEPT = 3  # whose levels tell groups apart
_SMALLEST = 1e-300


@kernel
def _couple(starts, ends, data, falls, x, groups, c, c_falls, weights):
    """The chain of the groups, all of it 0 at first."""
    for i in range(x.shape[0]):
        weights[groups[i]] += x[i]
    for i in range(x.shape[0]):
        g = groups[i]
        share = x[i] / weights[g]
        c_falls[g] += share * falls[i]
        for e in range(starts[i], starts[i + 1]):
            c[g, groups[ends[e]]] += share * data[e]


def _nearly_closed(q: csr_array, falls: np.ndarray, x: np.ndarray) -> np.ndarray | None:
    """Number each state's nearly closed part; 0 for all that are soon left, whose weights follow.

    None if there are more than `GROUPS` that do not lead to each other.
    """
    count, groups, rare = len(x), np.arange(len(x)), _RARE
    entries = q.tocoo()
    start, end, data = entries.row, entries.col, entries.data
    while True:
        start, end, data = start[start != end], end[start != end], data[start != end]
        most = np.zeros(count)
        np.maximum.at(most, start, data)
        leads = np.flatnonzero((data == most[start]) & (data >= rare))[::-1]
        to = np.arange(count)
        to[start[leads]] = end[leads]
        graph = csr_array((np.ones(count), to, np.arange(count + 1)), shape=(count, count))
        joined, union = connected_components(graph, directed=False)
        if joined == count:
            closed = falls + np.bincount(start, data, count) < rare
            parts = np.count_nonzero(closed)
            if parts < GROUPS:
                return np.where(closed, np.cumsum(closed), 0)[groups]
            if not most.any():
                return None
            rare = min(0.1 * rare, most.max())
            continue
        groups = union[groups]
        weights = np.bincount(union, x)
        share = x / weights[union]
        falls, x, count = np.bincount(union, falls * share), weights, joined
        matrix = csr_array((data * share[start], (union[start], union[end])), shape=(count, count))
        matrix.sum_duplicates()
        entries = matrix.tocoo()
        start, end, data = entries.row, entries.col, entries.data


@kernel
def _join(order, start, end, most, root, sizes):
    """Join the ends of transitions, in this order, where no more than `most` come together."""
    for e in order:
        i = start[e]
        j = end[e]
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        while root[j] != j:
            root[j] = root[root[j]]
            j = root[j]
        if i != j and sizes[i] + sizes[j] <= most:
            root[j] = i
            sizes[i] += sizes[j]


def _pieces(q: csr_array) -> np.ndarray:
    """Number each state's piece of states joined by likely transitions; 0 for scattered ones."""
    n = q.shape[0]
    entries = q.tocoo()
    root, sizes = np.arange(n), np.ones(n, dtype=np.int64)
    most = -(-n // _PIECES)
    order = np.argsort(-entries.data, kind="stable")
    _join(order, entries.row, entries.col, most, root, sizes)
    while (root != root[root]).any():
        root = root[root]
    kept = (root == np.arange(n)) & (2 * sizes >= most)
    return np.where(kept, np.cumsum(kept), 0)[root]


def _logarithm(x: np.ndarray) -> np.ndarray:
    """The binary logarithm at powers of 2, and straight in between: numpy's depends on the machine.

    What it is for are levels, which it leaves in order.
    """
    mantissa, exponent = np.frexp(x)
    return 2.0 * mantissa + exponent


def _levels(change: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Number the levels of a change, from the least to the greatest of those that count."""
    least, greatest = change[counts].min(), change[counts].max()
    if least == greatest:
        return np.zeros(len(change), dtype=np.int64)
    return np.clip((change - least) / (greatest - least) * _LEVELS, 0, _LEVELS - 1).astype(np.int64)


def _step(backward: csr_array, x: np.ndarray, source: np.ndarray | None, steps: int) -> np.ndarray:
    """Mean of x after `steps` steps, one more, and so on, so many; `backward` is Q transposed."""
    mean = np.zeros(len(x))
    for k in range(2 * steps):
        x = backward @ x
        x = x / x.sum() if source is None else x + source
        if k >= steps:
            mean += x
    return np.maximum(mean / steps, _SMALLEST)


def _intersected(groupings: Sequence[np.ndarray]) -> np.ndarray:
    """Number the groups that come of the first grouping and of what further ones can split."""
    n = len(groupings[0])
    groups = np.unique(groupings[0], return_inverse=True)[1]
    for grouping in groupings[1:]:
        finer = np.unique(groups * n + grouping, return_inverse=True)[1]
        if finer.max() < GROUPS:
            groups = finer
    return groups


def _share_out(
    q: csr_array,
    falls: np.ndarray,
    x: np.ndarray,
    groups: np.ndarray,
    tolerance: float,
    among: np.ndarray | None,
    source: np.ndarray | None,
) -> np.ndarray | None:
    """Give each group the weight that it has in the chain of the groups; see `_balanced`."""
    count = int(groups.max()) + 1
    c, c_falls, weights = np.zeros((count, count)), np.zeros(count), np.zeros(count)
    _couple(q.indptr, q.indices, q.data, falls, x, groups, c, c_falls, weights)
    y: np.ndarray | None
    if source is None:
        start = np.unique(groups[among])
        y = limit_distribution(c, c_falls, start, tolerance)
        if y is not None and y[start].max() < UNDERFLOW:
            # Another class seems to outlive that of `among`, as long as its shape is not known.
            return x
    else:
        # Not by BLAS, whose order of operations depends on the machine.
        y = (np.bincount(groups, source)[:, np.newaxis] * visits(c, c_falls)).sum(axis=0)
    return None if y is None else x * (y / weights)[groups]


def _in_vain(changes: list[float], escapes: list[float], tolerance: float) -> bool:
    """Whether rounds come no closer, but for what falls.

    Parts may fall alike but for rounding, and change into each other even less often. How they
    share the weight is then not known, and does not matter.
    """
    late = escapes[-_ROUNDS_IN_VAIN:]
    return (
        len(changes) > 2 * _ROUNDS_IN_VAIN
        and min(changes[-_ROUNDS_IN_VAIN:]) >= min(changes[:-_ROUNDS_IN_VAIN])
        and max(late) - min(late) <= tolerance * min(late)
    )


def _balanced(
    q: csr_array,
    falls: np.ndarray,
    tolerance: float,
    *,
    among: np.ndarray | None = None,
    source: np.ndarray | None = None,
    begin: np.ndarray | None = None,
) -> np.ndarray | None:
    """Solve x = `source` + x Q, or without a source x Q = lambda_2 x, of sum 1.

    Parameters
    ----------
    q : scipy.sparse.csr_array
        Q, shape (n, n). A fall can be reached from all states if there is a source.
    falls : numpy.ndarray
        Probability to fall from each state, shape (n,).
    tolerance : float
        Relative accuracy aimed at.
    among : numpy.ndarray, optional
        Without a source: states of a class with the largest eigenvalue, from which all can be
        reached, int64.
    source : numpy.ndarray, optional
        Above 0, shape (n,).
    begin : numpy.ndarray, optional
        Guess of x, above 0, shape (n,). `among` has to be in balance in it if `among` is not all.

    Returns
    -------
    numpy.ndarray or None
        Shape (n,); None if it does not settle.
    """
    n = len(falls)
    if n <= GROUPS:
        if among is not None:
            # What seems to outlive `among` here lasts as long, but for rounding.
            return limit_distribution(q.toarray(), falls, among, tolerance)
        return _share_out(q, falls, np.ones(n), np.arange(n), tolerance, among, source)
    backward, pieces = csr_array(q.T), _pieces(q)
    x = _step(backward, np.full(n, 1.0 / n) if begin is None else begin, source, _STEPS)
    parts = _nearly_closed(q, falls, x)
    if parts is None:
        return None
    levels: list[np.ndarray] = []
    changes: list[float] = []
    escapes: list[float] = []
    solved = _share_out(q, falls, x, _intersected([parts, pieces]), tolerance, among, source)
    for k in range(ROUNDS):
        if solved is None:
            return None
        last = np.maximum(solved, _SMALLEST)
        steps = min(_STEPS << k // _ROUNDS_ALIKE, max(_STEPS, _WORK // (2 * q.nnz)))
        x = _step(backward, last, source, steps)
        levels = [_levels(_logarithm(x / last), x > UNDERFLOW), *levels[: _ROUNDS_KEPT - 1]]
        groups = _intersected([parts, levels[0], pieces, *levels[1:]])
        solved = _share_out(q, falls, x, groups, tolerance, among, source)
        if solved is None:
            return None
        # All weights are waited for, as a part may seem to matter little until its shape is known.
        known = solved > UNDERFLOW
        changes.append(float((np.abs(solved - last)[known] / solved[known]).max()))
        escapes.append(float((solved * falls).sum()))
        # What all further rounds would change is about a geometric series.
        rate = min(changes[k] / changes[k - 1], 0.9) if k > 0 and changes[k - 1] > 0.0 else 0.9
        if changes[k] <= (1.0 - rate) * tolerance:
            return solved
        if source is None and _in_vain(changes, escapes, tolerance):
            return solved
    return None


def metastable_distribution(q: csr_array, falls: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Metastable distribution of a chain, from its classes of states that reach each other.

    lambda_2 is the largest of the classes' eigenvalues, and phi the limit of the distribution
    from a state of that class.

    Parameters
    ----------
    q : scipy.sparse.csr_array
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
    count, labels = connected_components(q, connection="strong")
    entries = q.tocoo()
    leaves = labels[entries.row] != labels[entries.col]
    leaving = falls + np.bincount(entries.row[leaves], entries.data[leaves], len(falls))
    sizes = np.bincount(labels)
    # Near 1 the rates no longer tell small eigenvalues apart; what stays does.
    rates, stays = np.zeros(count), np.zeros(count)
    alone = sizes[labels] == 1
    rates[labels[alone]], stays[labels[alone]] = leaving[alone], q.diagonal()[alone]
    rates[stays == 0.0] = 1.0
    vectors = np.ones(len(falls))
    for c in np.flatnonzero(sizes > 1):
        states = np.flatnonzero(labels == c)
        own = csr_array(q[states][:, states])
        x = _balanced(own, leaving[states], tolerance, among=np.arange(len(states)))
        if x is None:
            return None
        vectors[states] = x
        rates[c], stays[c] = (x * leaving[states]).sum(), (x @ own).sum()
    best = int(np.lexsort((-stays, rates))[0])
    while True:
        order = breadth_first_order(q, np.argmax(labels == best), return_predecessors=False)
        # Of equal classes one behind the other, the last one keeps all the weight.
        equal = (rates == rates[best]) & (stays == stays[best]) & (np.arange(count) != best)
        behind = order[equal[labels[order]]]
        if not len(behind):
            break
        best = int(labels[behind[-1]])
    below = np.sort(order)
    among = np.flatnonzero(labels[below] == best)
    x = vectors[below]
    if len(among) < len(below):
        follows = csr_array(q[below][:, below])
        x = _balanced(follows, falls[below], tolerance, among=among, begin=x / x.sum())
        if x is None:
            return None
    out = np.zeros(len(falls))
    out[below] = x / x.sum()
    return out


def passage_times(q: csr_array, falls: np.ndarray, tolerance: float) -> np.ndarray | None:
    r"""Mean first-passage times m = (I - Q)^-1 1, where a fall can be reached from all states.

    They are found from distributions, too, of the chain in reverse. With w = 1 + w Q, which is
    above 0, u_i = w_i m_i are

        u = w + u R,    R_ji = w_i Q_ij / w_j,

    and R is a chain that falls with probability 1 / w_j.

    Parameters
    ----------
    q, falls, tolerance
        As for `metastable_distribution`.

    Returns
    -------
    numpy.ndarray or None
        Steps, shape (n,), inf beyond the largest number; None if they do not settle.
    """
    n = len(falls)
    with np.errstate(over="ignore", invalid="ignore"):
        w = _balanced(q, falls, tolerance, source=np.ones(n))
        if w is None:
            return None
        entries = q.tocoo()
        flows = w[entries.row] * entries.data / w[entries.col]
        reverse = csr_array((flows, (entries.col, entries.row)), shape=(n, n))
        # u is of the size of times squared: what is scaled, by a power of 2, does not overflow.
        source = np.ldexp(w, -np.frexp(w.max())[1])
        u = _balanced(reverse, 1.0 / w, tolerance, source=source)
        # No number is what infinite ones give.
        return None if u is None else np.nan_to_num(u / source, nan=np.inf, posinf=np.inf)
