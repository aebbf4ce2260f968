r"""Markov chain over a mesh, and the mean first-passage time to a fall (eq. 29 to 35).

With P(s) the probability of slope s and rho the targets of the mesh, the chain steps from state i
to rho(i, s) with probability P(s); 0 is the failure state. Q is T without that state, and
f_i = sum of P(s) over the slopes on which i falls. lambda_2 is the largest eigenvalue of Q over
the states that can be reached from x_2: the others belong to no walk. The metastable
(quasi-stationary) distribution phi is its left eigenvector, phi Q = lambda_2 phi with sum 1.
Summing that equation gives

    1 - lambda_2 = sum of phi_i f_i,

a sum of products that are not negative, so it is as accurate at 1e-100 as at 0.1. No failure
probability is ever found by subtraction. It asks more of phi than a small norm of its error:
falls may come from states with phi_i = 1e-20, so every component has to be right relative to
itself.

Iteration
    phi is the limit of the distribution after k steps, given no fall so far. It is made of sums of
    products that are not negative, and so accurate in every component. The steps start from a
    likely state, and every other state gets its weight by flow from there. So a slow part of the
    chain shows: while it still fills, its weight changes by 1/k or more in step k; after that,
    what is missing of it after k steps is at most about k times what step k changed. Hence the
    rule to stop: k times the largest relative change is within the tolerance. A state that lost
    weight to below what could matter for the sum above is left out, but one that gains never is.

Squaring
    Chains that mix too slowly for that (walkers with several gaits and rare changes between
    them), that have a long period, or several closed parts, are solved if they are small: the
    matrix of 2^k steps is squared until it settles, again from what is not negative. The falls
    in 2^k steps are carried along, so that rounding in what survives passes neither for falls nor
    for gain.

The mean first-passage times from each state, (I - Q)^-1 1, are iterated in the same way, or found
by elimination without subtractions [1]_ [2]_: rows of I - Q are kept as off-diagonals and row sums
f_i, and the diagonal is the sum of these.

References
----------
.. [1] W. K. Grassmann, M. I. Taksar, D. P. Heyman, "Regenerative analysis and steady state
   distributions for Markov chains", Operations Research 33 (1985).
.. [2] A. S. Alfa, J. Xue, Q. Ye, "Accurate computation of the smallest eigenvalue of a diagonally
   dominant M-matrix", Mathematics of Computation 71 (2002).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from biped_mfpt_ros.chain.mesh import Mesh, check_transitions, checked_array
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker.terrain import check_slopes

DENSE_LIMIT = 2000
"""Most states of a chain that is not iterated; time grows with the cube, memory with the square."""

TOLERANCE = 1e-12
"""Relative accuracy aimed at, in the MFPT and in every state's weight."""

_PLAIN_STEPS = 100  # then steps with a share of staying, for periodic chains
_STEPS = 3000
_SQUARINGS = 1100  # 2^1100 is more than any MFPT
# Weights below this may have lost digits to underflow, and are not waited for.
_UNDERFLOW = 1e-290
# Largest ratio of the parts of a sum to the sum itself: three of sixteen digits lost.
_CANCELLATION = 1e3


class ChainError(RuntimeError):
    """The chain mixes too slowly to be iterated and is too large to be solved otherwise."""


# Probabilities, transitions ---------------------------------------------------------------------


def slope_probabilities(slopes: ArrayLike, mu_s: float, sigma_s: float) -> np.ndarray:
    r"""Probabilities P_S of the slopes of a set (eq. 30, 31).

    They are proportional to the normal density at the slopes and sum to 1. For equally spaced
    slopes this is the trapezoidal rule for the expectation over s, which converges faster than any
    power of the spacing d_s for a smooth integrand: the density's own error is about
    :math:`2 \exp(-2 \pi^2 \sigma_s^2 / d_s^2)`, some 1e-34 for the paper's rule of thumb
    d_s = sigma_s / 2, 5e-9 for d_s = sigma_s, and 1 % for d_s = 2 sigma_s. Where the integrand
    jumps, at the slopes on which a state begins to fall, the rule cannot see closer than d_s. A
    set that is too coarse for sigma_s is not rejected; with sigma_s far below d_s the nearest
    slope gets all.

    Slopes outside the set do not occur in the model. With a set to 20 degrees and sigma_s = 5
    degrees they would have 6e-5 of the probability.

    Parameters
    ----------
    slopes : array_like
        S of eq. (24), rad, strictly ascending, shape (m,).
    mu_s : float
        Mean slope, rad, within the set.
    sigma_s : float
        Standard deviation of the slope, rad, above 0.

    Returns
    -------
    numpy.ndarray
        float64, shape (m,), sum 1. Each is right to about 1e-13 relative; those below 1e-308
        become 0.

    Raises
    ------
    InputError
        If an argument is not allowed.
    """
    slopes = check_slopes(slopes)
    if not (isinstance(mu_s, Real) and slopes[0] <= mu_s <= slopes[-1]):
        raise InputError("mu_s", mu_s, f"{slopes[0]:.6g} to {slopes[-1]:.6g} rad, the slope set")
    if not (isinstance(sigma_s, Real) and math.isfinite(sigma_s) and sigma_s > 0.0):
        raise InputError("sigma_s", sigma_s, "a finite number above 0, rad")
    # Relative to the likeliest slope, so that a narrow density between slopes does not vanish.
    distances = np.abs(slopes - mu_s)
    least = distances.min()
    with np.errstate(over="ignore"):
        exponents = 0.5 * ((distances - least) * (distances + least)) / sigma_s / sigma_s
    weights = np.exp(-exponents)
    return weights / weights.sum()


def _check_chain(targets: ArrayLike, probabilities: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    shape = np.shape(targets)
    if len(shape) != 2 or shape[0] < 2 or shape[1] < 1:
        raise InputError("targets", shape, "an array of shape (n, m), n at least 2, m at least 1")
    targets = checked_array("targets", targets, np.uint32, shape)
    if targets.max() >= shape[0]:
        raise InputError("targets", int(targets.max()), f"indices of states, below {shape[0]}")
    probabilities = checked_array("probabilities", probabilities, np.float64, shape[1:])
    if not ((probabilities >= 0.0).all() and abs(probabilities.sum() - 1.0) <= 1e-12):
        raise InputError("probabilities", probabilities.tolist(), "not negative, with sum 1")
    return targets, probabilities


def transition_matrix(targets: ArrayLike, probabilities: ArrayLike) -> csr_array:
    """Stochastic state-transition matrix T (eq. 32), the failure state included as index 0.

    Parameters
    ----------
    targets : array_like
        Eq. (27) as in `Mesh`, shape (n, m).
    probabilities : array_like
        P_S, shape (m,).

    Returns
    -------
    scipy.sparse.csr_array
        Shape (n, n), rows sum to 1 within rounding. Transitions of probability 0 are left out.

    Raises
    ------
    InputError
        If an argument is not allowed.
    """
    targets, probabilities = _check_chain(targets, probabilities)
    n = len(targets)
    columns = np.flatnonzero(probabilities)
    indices = targets[1:, columns].ravel()
    # The failure state is absorbing: one entry.
    matrix = csr_array(
        (
            np.concatenate([[1.0], np.tile(probabilities[columns], n - 1)]),
            np.concatenate([[0], indices]).astype(np.int64),
            np.concatenate([[0], 1 + len(columns) * np.arange(n, dtype=np.int64)]),
        ),
        shape=(n, n),
    )
    matrix.sum_duplicates()
    return matrix


# One step of the chain, without a matrix --------------------------------------------------------


@kernel
def _step_forward(targets, probabilities, x, out):
    """`out` = x T for a distribution x; what falls goes to out[0]. x[0] does not count."""
    out[:] = 0.0
    for i in range(1, targets.shape[0]):
        weight = x[i]
        if weight > 0.0:
            for s in range(targets.shape[1]):
                out[targets[i, s]] += weight * probabilities[s]


@kernel
def _step_backward(targets, probabilities, x, out):
    """`out` = T x for a function x of the state, with 0 for the failure state."""
    out[0] = 0.0
    for i in range(1, targets.shape[0]):
        total = 0.0
        for s in range(targets.shape[1]):
            if targets[i, s] != 0:
                total += probabilities[s] * x[targets[i, s]]
        out[i] = total


@kernel
def _settle(x, out, total, stay, floor):
    """Replace x, of sum 1, by out + stay * x, scaled to sum 1; return the largest relative change.

    `total` is the sum of `out`; index 0 does not count in either, nor do components that shrink
    and are below `floor`.
    """
    largest = 0.0
    for i in range(1, x.shape[0]):
        value = (out[i] + stay * x[i]) / (total + stay)
        change = value - x[i]
        if value > _UNDERFLOW and (change > 0.0 or value > floor):
            largest = max(largest, abs(change) / value)
        x[i] = value
    return largest


@kernel
def _weight_by_outcome(targets, outcomes, probabilities, x, out):
    """out[code] = probability that a step from distribution x falls with that outcome code."""
    for i in range(1, targets.shape[0]):
        if x[i] > 0.0:
            for s in range(targets.shape[1]):
                if targets[i, s] == 0:
                    out[outcomes[i, s]] += x[i] * probabilities[s]


# Who can reach whom -----------------------------------------------------------------------------


@kernel
def _reachable(targets, start, out, queue):
    """Mark in `out` the states that can be reached from `start`, itself included."""
    out[start] = True
    queue[0] = start
    waiting = 1
    while waiting > 0:
        waiting -= 1
        i = queue[waiting]
        for s in range(targets.shape[1]):
            j = targets[i, s]
            if not out[j]:
                out[j] = True
                queue[waiting] = j
                waiting += 1


@kernel
def _can_reach(targets, out):
    """Mark in `out` also the states from which one can reach those already marked."""
    changed = True
    while changed:
        changed = False
        for i in range(targets.shape[0] - 1, 0, -1):
            if not out[i]:
                for s in range(targets.shape[1]):
                    if out[targets[i, s]]:
                        out[i] = True
                        changed = True
                        break


# Small chains -----------------------------------------------------------------------------------


def _check_size(states: int) -> None:
    if states > DENSE_LIMIT:
        raise ChainError(
            f"the chain does not settle in {_STEPS} steps, and with {states} states it is too "
            f"large to be solved otherwise (limit {DENSE_LIMIT})"
        )


def _squared(q: np.ndarray, falls: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Limit of the distribution after 2^k steps from any of the states `among`, given no fall.

    `falls` is what leaves Q, shape (n,). The limit has to be the same from each of `among`, which
    are the states of a class, so that the first steps do not decide between slow parts.
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
        if not sums.all():
            raise ChainError("probabilities of the chain are too small to be told from zero")
        rows = power[among] / sums
        previous, x = x, rows[0]
        floor = TOLERANCE / n * float(x @ falls)
        # A slow part that still fills doubles its weight, what is missing of it is squared.
        counts = (x > _UNDERFLOW) & ((x > previous) | (x > floor))
        if (np.abs(previous - x)[counts] <= TOLERANCE * x[counts]).all():
            counts = (x > _UNDERFLOW) & (x > floor)
            if (np.abs(rows - x)[:, counts] <= TOLERANCE * x[counts]).all():
                return x
    raise ChainError(f"a chain of {n} states does not settle in 2^{_SQUARINGS} steps")


def _dense_distribution(targets: np.ndarray, probabilities: np.ndarray, start: int) -> np.ndarray:
    """Metastable distribution of a small chain, from its classes of states that reach each other.

    lambda_2 is the largest of the classes' eigenvalues, and phi the limit of the distribution
    from a state of that class.
    """
    reached = _mark_reachable(targets, start)
    reached[0] = False
    members = np.flatnonzero(reached)
    _check_size(len(members))
    rows = transition_matrix(targets, probabilities)[members]
    matrix, falls = rows[:, members].toarray(), rows[:, [0]].toarray().ravel()
    graph = csr_array(matrix)
    count, labels = connected_components(graph, connection="strong")
    classes = [np.flatnonzero(labels == label) for label in range(count)]
    keys, vectors = [], []
    for states in classes:
        leaves = falls[states] + matrix[states][:, labels != labels[states[0]]].sum(axis=1)
        q = matrix[np.ix_(states, states)]
        x = _squared(q, leaves, np.arange(len(states))) if q.any() else np.ones(1)
        # Near 1 the rates no longer tell small eigenvalues apart; what stays does.
        keys.append((float(x @ leaves), -float((x @ q).sum())))
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
        x = _squared(matrix[np.ix_(below, below)], falls[below], among)
    out = np.zeros(len(targets))
    out[members[below]] = x
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


def _eliminated_times(
    targets: np.ndarray, probabilities: np.ndarray, among: np.ndarray
) -> np.ndarray:
    """Mean first-passage times of the states `among`, which lead only to each other and to 0."""
    members = np.flatnonzero(among)
    _check_size(len(members))
    rows = transition_matrix(targets, probabilities)[members]
    times = np.ones(len(members))
    _eliminate(rows[:, members].toarray(), rows[:, [0]].toarray().ravel(), times)
    out = np.zeros(len(targets))
    out[members] = times
    return out


# Iteration --------------------------------------------------------------------------------------


def _mark_reachable(targets: np.ndarray, start: int) -> np.ndarray:
    out = np.zeros(len(targets), dtype=np.bool_)
    _reachable(targets, start, out, np.empty(len(targets), dtype=np.int64))
    return out


Step = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]
Floor = Callable[[np.ndarray, float], float]


def _iterate(
    step: Step,
    targets: np.ndarray,
    probabilities: np.ndarray,
    start: int,
    floor: Floor,
    tolerance: float = TOLERANCE,
) -> np.ndarray | None:
    """Repeat a step from `start`, scaled to sum 1, until it settles; None if it does not.

    ``floor(out, total)`` is the size below which a component that shrinks does not matter, from
    what a step gave and its sum without out[0]. Returns the last non-zero vector where a step
    leaves nothing (lambda_2 = 0).
    """
    x, out = np.zeros(len(targets)), np.empty(len(targets))
    x[start] = 1.0
    previous = math.inf
    for k in range(1, _STEPS + 1):
        step(targets, probabilities, x, out)
        # Summed in pairs by NumPy: rounding that differs from step to step would look like change.
        total = float(out[1:].sum())
        if total == 0.0:
            return x
        stay = 0.0 if k <= _PLAIN_STEPS else 0.5 * total
        change = _settle(x, out, total, stay, floor(out, total))
        # Two in a row, as parts that oscillate may stand still for a moment.
        if k * max(change, previous) <= tolerance:
            return x
        previous = change
    return None


def _iterated_distribution(
    targets: np.ndarray, probabilities: np.ndarray, start: int, endless: bool
) -> np.ndarray | None:
    """Metastable distribution by iteration, None if it does not settle.

    The state `start` may never be visited again, and its first steps may share weight out
    between parts of the chain in a way that later steps are too slow to put right. So it only
    finds the likeliest state, and phi is iterated from there: whatever part is not in balance
    with a state that is always visited is seen to fill.
    """
    n = len(targets)

    def floor(out: np.ndarray, total: float) -> float:
        return TOLERANCE / n * (1.0 if endless else float(out[0]) / (float(out[0]) + total))

    rough = _iterate(_step_forward, targets, probabilities, start, floor, tolerance=1e-3)
    if rough is None:
        return None
    likeliest = int(np.argmax(rough))
    phi = _iterate(_step_forward, targets, probabilities, likeliest, floor)
    if phi is None or n * phi[likeliest] < 0.1:
        return None
    # No part that is reached from the start, but not from there, may have a larger eigenvalue.
    aside = _mark_reachable(targets, start) & ~_mark_reachable(targets, likeliest)
    if not aside.any() or endless:
        return phi
    out = np.empty(n)
    _step_forward(targets, probabilities, phi, out)
    lambda_2 = float(out[1:].sum())
    survives = aside.astype(np.float64)
    bound = 1.0 - 1e-9  # well above what rounding adds to a survival of 1
    for _ in range(_PLAIN_STEPS if lambda_2 > 0.01 else 0):  # 0.01^100 does not underflow
        _step_backward(targets, probabilities, survives, out)
        survives = np.where(aside, out, 0.0)
        bound *= lambda_2
        # The largest of the survivals of k steps is at least the eigenvalue to the power of k.
        if survives.max() <= bound:
            return phi
    return None


def _iterated_times(
    targets: np.ndarray,
    probabilities: np.ndarray,
    among: np.ndarray,
    phi: np.ndarray,
    escape: float,
) -> np.ndarray | None:
    """Mean first-passage times m of the states `among`; None if iteration does not settle.

    m = (I - Q)^-1 1 is split with the right eigenvector psi of lambda_2, phi psi = 1: what starts
    in state i is worth psi_i of the metastable distribution, hence

        m = psi / (1 - lambda_2) + sum over k of Q^k (1 - psi),

    where phi (1 - psi) = 0, so the series forgets as fast as the chain does and is of the size
    of that time, however large the first term. psi comes from the likeliest state just as phi
    does. With `escape` 0 all is in the series, which then has no negative term. It is
    also taken where the two parts nearly cancel: states that outlive the metastable ones by far
    but only for a few steps, which needs a small lambda_2.
    """
    n = len(targets)
    psi = np.zeros(n)
    if escape > 0.0:
        likeliest = int(np.argmax(phi))

        def floor(out: np.ndarray, total: float) -> float:
            # Below this, psi / escape is within the tolerance of the first step alone.
            return TOLERANCE * escape * float(phi @ out) / total

        found = _iterate(_step_backward, targets, probabilities, likeliest, floor)
        if found is None:
            return None
        # 0 where nothing settles at all, and tiny where psi is that of states out of x_2's reach.
        overlap = float(phi @ found)
        if overlap < _UNDERFLOW:
            return _iterated_times(targets, probabilities, among, phi, 0.0)
        psi = found / overlap
    rest = np.where(among, 1.0 - psi, 0.0)
    first = np.zeros(n)
    with np.errstate(over="ignore"):
        np.divide(psi, escape, out=first, where=psi > 0.0)
    series = np.zeros(n)
    out = np.empty(n)
    for k in range(1, _STEPS + 1):
        largest = float(np.max(np.abs(rest) / np.maximum(first + series, 1.0)))
        if k * largest <= TOLERANCE:
            times = first + series
            if (first > _CANCELLATION * times).any():
                return _iterated_times(targets, probabilities, among, phi, 0.0)
            return times
        _step_backward(targets, probabilities, rest, out)
        if k <= _PLAIN_STEPS:
            series += rest
            rest, out = out, rest
        else:
            # (I - Q)^-1 = (I - (I + Q) / 2)^-1 / 2
            series += 0.5 * rest
            rest = 0.5 * (rest + out)
        # phi rest = 0 but for rounding, which would stay for ever.
        rest -= psi * (phi @ rest)
    return None


# Results ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Metastability:
    """What a chain over a mesh says about falls. n states, the failure state counted as index 0.

    Parameters
    ----------
    lambda_2 : float
        Second largest eigenvalue of T: probability of surviving a step, once metastable. Summed
        up from what survives, so accurate near 0; near 1 use `failure_probability`.
    failure_probability : float
        1 - lambda_2, summed up from what falls, accurate relative to itself.
    mfpt : float
        Mean first-passage time, steps, eq. (35): 1 / (1 - lambda_2); inf where a state can be
        reached from x_2 from which no fall can be reached. Above 1e280 digits are lost to
        underflow.
    distribution : numpy.ndarray
        Metastable distribution phi, shape (n,), sum 1, index 0 is 0. It has no weight on states
        that are not visited again and again. Where lambda_2 is 0 it is one from which every
        step falls; where no fall can be reached from some states, it is stationary on those.
        Weights below about 1e-12 (1 - lambda_2) / n may be off: they do not matter for falls.
    failure_shares : dict of int to float
        Share of each outcome code in the falls from the metastable distribution, ascending code,
        codes without share left out; sums to 1. Empty if there are no falls.
    """

    lambda_2: float
    failure_probability: float
    mfpt: float
    distribution: np.ndarray
    failure_shares: dict[int, float]
    _targets: np.ndarray = field(repr=False)
    _probabilities: np.ndarray = field(repr=False)

    @cached_property
    def mfpt_from_state(self) -> np.ndarray:
        """Mean number of steps to a fall from each state, the falling one counted; shape (n,).

        Computed when first asked for, at about twice the cost of the rest. 0 for the failure
        state, inf for states from which one can reach some that never fall. Accurate relative
        to itself at any size.

        Raises
        ------
        ChainError
            If the chain mixes too slowly to be iterated and is too large to be solved otherwise.
        """
        targets, probabilities = self._targets, self._probabilities
        endless = ~_mark_can_fall(targets)
        _can_reach(targets, endless)
        among = ~endless
        among[0] = False
        escape = 0.0 if endless.any() else self.failure_probability
        times = _iterated_times(targets, probabilities, among, self.distribution, escape)
        if times is None:
            times = _eliminated_times(targets, probabilities, among)
        times[endless] = math.inf
        times.flags.writeable = False
        return times


def _mark_can_fall(targets: np.ndarray) -> np.ndarray:
    out = np.zeros(len(targets), dtype=np.bool_)
    out[0] = True
    _can_reach(targets, out)
    return out


def _solve(targets: np.ndarray, outcomes: np.ndarray, probabilities: np.ndarray) -> Metastability:
    possible = probabilities > 0.0
    if not possible.all():
        targets, outcomes = targets[:, possible], outcomes[:, possible]
        probabilities = probabilities[possible]
    targets, outcomes = np.ascontiguousarray(targets), np.ascontiguousarray(outcomes)
    n = len(targets)

    start = 1
    can_fall = _mark_can_fall(targets)
    endless = False
    if not can_fall.all():
        safe = _mark_reachable(targets, 1) & ~can_fall
        if safe.any():
            start = int(np.argmax(safe))
            endless = True

    phi = _iterated_distribution(targets, probabilities, start, endless)
    if phi is None:
        phi = _dense_distribution(targets, probabilities, start)
    phi.flags.writeable = False

    out = np.empty(n)
    _step_forward(targets, probabilities, phi, out)
    by_code = np.zeros(256)
    _weight_by_outcome(targets, outcomes, probabilities, phi, by_code)
    survives, falls = float(out[1:].sum()), float(by_code.sum())
    escape = falls / (survives + falls)
    return Metastability(
        lambda_2=survives / (survives + falls),
        failure_probability=escape,
        mfpt=1.0 / escape if escape > 0.0 else math.inf,
        distribution=phi,
        failure_shares={int(code): float(by_code[code] / falls) for code in by_code.nonzero()[0]},
        _targets=targets,
        _probabilities=probabilities,
    )


def metastability(mesh: Mesh, mu_s: float, sigma_s: float) -> Metastability:
    """Metastability of the chain over a mesh for normally distributed slopes (eq. 30 to 35).

    Parameters
    ----------
    mesh : Mesh
        The mesh; one serves any number of distributions.
    mu_s : float
        Mean slope, rad, within the slope set.
    sigma_s : float
        Standard deviation of the slope, rad, above 0. The slope set should not be much coarser,
        see `slope_probabilities`.

    Returns
    -------
    Metastability

    Raises
    ------
    InputError
        If mu_s or sigma_s is not allowed.
    ChainError
        If the chain mixes too slowly to be iterated and is too large to be solved otherwise.
    """
    return _solve(mesh.targets, mesh.outcomes, slope_probabilities(mesh.slopes, mu_s, sigma_s))


def solve_chain(targets: ArrayLike, outcomes: ArrayLike, probabilities: ArrayLike) -> Metastability:
    """Metastability of a chain given by its arrays, for any distribution of slopes.

    Parameters
    ----------
    targets, outcomes : array_like
        As in `Mesh`, shape (n, m). The walk starts in state 1.
    probabilities : array_like
        P_S, not negative, sum 1, shape (m,).

    Returns
    -------
    Metastability

    Raises
    ------
    InputError
        If an argument is not allowed.
    ChainError
        If the chain mixes too slowly to be iterated and is too large to be solved otherwise.
    """
    targets, probabilities = _check_chain(targets, probabilities)
    outcomes = checked_array("outcomes", outcomes, np.uint8, targets.shape)
    check_transitions(targets, outcomes)
    return _solve(targets, outcomes, probabilities)
