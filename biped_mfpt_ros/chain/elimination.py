r"""Chains of some hundred states, solved without iterating, and without subtracting.

They may mix as slowly as they like: several gaits with rare changes between them, long periods,
several closed parts.

The mean numbers of visits N = (I - Q)^-1, from row i to column j, come from elimination [1]_ [2]_:
rows of I - Q are kept as off-diagonals and row sums f_i, and the diagonal is the sum of these. So
every entry of N is accurate relative to itself. Q and N have the same eigenvectors, and that of
the largest eigenvalue 1 / (1 - lambda_2) is what the rows of N, N^2, N^4, ... become. The products
are of numbers that are not negative, and how close lambda_2 is to 1 does not matter.

References
----------
.. [1] W. K. Grassmann, M. I. Taksar, D. P. Heyman, "Regenerative analysis and steady state
   distributions for Markov chains", Operations Research 33 (1985).
.. [2] A. S. Alfa, J. Xue, Q. Ye, "Accurate computation of the smallest eigenvalue of a diagonally
   dominant M-matrix", Mathematics of Computation 71 (2002).
"""

from __future__ import annotations

import numpy as np

from biped_mfpt_ros.chain.iteration import UNDERFLOW
from biped_mfpt_ros.jit import kernel

_SQUARINGS = 1100  # 2^1100 is more than any ratio of two numbers of visits
_NO_FALLS = 1e-100


@kernel
def _eliminate(q, falls, out):
    """Turn `out`, the identity, into (I - Q)^-1; `q` and `falls` are used up.

    The diagonal of `q` is not read. States are eliminated from the last to the first: a visit to
    one is followed on to where it leads among those that are left, or to the fall.
    """
    n = q.shape[0]
    for p in range(n - 1, -1, -1):
        leaves = falls[p]
        for j in range(p):
            leaves += q[p, j]
        for j in range(p):
            q[p, j] /= leaves
        falls[p] /= leaves
        for j in range(p, n):
            out[p, j] /= leaves
        for i in range(p):
            share = q[i, p]
            if share != 0.0:
                falls[i] += share * falls[p]
                for j in range(p):
                    q[i, j] += share * q[p, j]
                for j in range(p, n):
                    out[i, j] += share * out[p, j]
    for p in range(1, n):
        for j in range(p):
            share = q[p, j]
            if share != 0.0:
                for k in range(n):
                    out[p, k] += share * out[j, k]


@kernel
def _square(a, out):
    """`out` = a a, in the same order of operations on any machine, unlike BLAS."""
    n = a.shape[0]
    for i in range(n):
        out[i] = 0.0
        for j in range(n):
            share = a[i, j]
            if share != 0.0:
                for k in range(n):
                    out[i, k] += share * a[j, k]


def visits(q: np.ndarray, falls: np.ndarray) -> np.ndarray:
    """Mean numbers of visits (I - Q)^-1, shape (n, n), where a fall can be reached from all.

    Parameters
    ----------
    q : numpy.ndarray
        Q, shape (n, n). The diagonal follows from the rest and is not read.
    falls : numpy.ndarray
        Probability to fall from each state, shape (n,).
    """
    out = np.eye(len(q))
    _eliminate(q.copy(), falls.copy(), out)
    return out


def limit_distribution(
    q: np.ndarray, falls: np.ndarray, among: np.ndarray, tolerance: float
) -> np.ndarray | None:
    """Limit of the distribution after k steps from any of the states `among`, given no fall.

    Parameters
    ----------
    q, falls : numpy.ndarray
        As for `visits`, but there may be no falls at all.
    among : numpy.ndarray
        States of a class with the largest eigenvalue, int64. The limit has to be the same from
        each, so that the first steps do not decide between slow parts.
    tolerance : float
        Relative accuracy aimed at, for weights that may have lost no digits to underflow.

    Returns
    -------
    numpy.ndarray or None
        Sum 1, shape (n,); None if it does not settle.
    """
    n = len(q)
    power = visits(q, falls)
    if not np.isfinite(power).all():
        # Without falls, or nearly so; those from all states alike leave eigenvectors as they are.
        power = visits(q, falls + _NO_FALLS)
    x, out = np.zeros(n), np.empty((n, n))
    for _ in range(_SQUARINGS):
        largest = power.max()
        if not largest > 0.0:
            return None  # all of it lost to underflow
        power /= largest
        rows = power[among]
        sums = rows.sum(axis=1)
        previous, x = x, rows[sums.argmax()] / sums.max()
        known = x > UNDERFLOW
        # A slow part that still fills doubles its weight, what is missing of it is squared.
        if (np.abs(previous - x)[known] <= tolerance * x[known]).all():
            known = rows > UNDERFLOW
            missing = np.abs(rows - sums[:, np.newaxis] * x)
            if (missing[known] <= tolerance * rows[known]).all():
                return x
        _square(power, out)
        power, out = out, power
    return None
