r"""Markov chain over a mesh, and the mean first-passage time to a fall (eq. 29 to 35).

With P(s) the probability of slope s and rho the targets of the mesh, the chain steps from state i
to rho(i, s) with probability P(s); 0 is the failure state. Where slopes are correlated, P(s | r)
takes the place of P(s), with r the slope before state i, which the states of a clustered mesh
know: they are a Markov chain all the same. Q is T without the failure state, and
f_i = sum of P(s) over the slopes on which i falls. lambda_2 is the largest eigenvalue of Q over
the states that can be reached from x_2: the others belong to no walk. The metastable
(quasi-stationary) distribution phi is its left eigenvector, phi Q = lambda_2 phi with sum 1.
Summing that equation gives

    1 - lambda_2 = sum of phi_i f_i,

a sum of products that are not negative, so it is as accurate at 1e-100 as at 0.1. No failure
probability is ever found by subtraction. It asks more of phi than a small norm of its error:
falls may come from states with phi_i = 1e-20, so every component has to be right relative to
itself.

phi is the limit of the distribution after k steps, given no fall so far, and is iterated so (see
`iteration`, where the rule to stop is justified). That is made of sums of products that are not
negative, and so accurate in every component. Chains that mix too slowly for that, have a long
period, or several closed parts, are solved by aggregation (see `aggregation`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.chain import iteration
from biped_mfpt_ros.chain.aggregation import ROUNDS, metastable_distribution, passage_times
from biped_mfpt_ros.chain.lanes import LANES
from biped_mfpt_ros.chain.mesh import CHECKED_ROWS, Mesh, check_transitions, checked_array
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker.terrain import check_correlation, check_slopes, spread_given_last

TOLERANCE = 1e-12
"""Relative accuracy aimed at, in the MFPT and in every state's weight."""

_STEPS = 3000
_ASIDE_STEPS = 1000
_MOST_SURVIVAL = 1e300
# Times in a step's weight that count as visited again and again.
_OFTEN = 0.1
_WORTH_THREADS = 1_000_000  # transitions times columns
# Largest ratio of the parts of a sum to the sum itself: three of sixteen digits lost.
_CANCELLATION = 1e3
_LOWEST_EXPONENT = -708.0  # e^-708 is 3e-308
# ln 2 in two parts, the first with 33 digits of 53 in use.
_LN2_FIRST, _LN2_REST = float.fromhex("0x1.62e42feep-1"), float.fromhex("0x1.a39ef35793c76p-33")


class ChainError(RuntimeError):
    """The chain mixes too slowly to be iterated, and aggregation does not settle either."""


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
    return _normal(_check_distribution(slopes, mu_s, sigma_s), mu_s, sigma_s)


def conditional_probabilities(
    slopes: ArrayLike, mu_s: float, sigma_s: float, correlation: float
) -> np.ndarray:
    r"""Probabilities P(s | r) of the slopes s of a set after each slope r of it.

    For ground whose slopes are a first-order autoregressive process,

    .. math:: s_{k+1} = \mu_s + \rho (s_k - \mu_s) + \sigma_s \sqrt{1 - \rho^2} e_k,

    with e_k independent and standard normal: normal with the mean and standard deviation of
    `slope_probabilities` in the long run, and with correlation rho^j between slopes j steps apart.
    Given r, the next slope is normal with mean mu_s + rho (r - mu_s) and the standard deviation
    sigma_s sqrt(1 - rho^2): it is this that the spacing d_s should not be coarser than, and what
    `slope_probabilities` says of its errors holds for it. With d_s far above it the slope nearest
    to that mean gets all.

    Parameters
    ----------
    slopes : array_like
        S of eq. (24), rad, strictly ascending, shape (m,).
    mu_s : float
        Mean slope, rad, within the set.
    sigma_s : float
        Standard deviation of the slope, rad, above 0.
    correlation : float
        rho, of each slope with the one before, above -1 and below 1.

    Returns
    -------
    numpy.ndarray
        float64, shape (m, m): row r is P(. | r), with sum 1.

    Raises
    ------
    InputError
        If an argument is not allowed.
    """
    slopes = _check_distribution(slopes, mu_s, sigma_s)
    correlation = check_correlation(correlation)
    means = mu_s + correlation * (slopes - mu_s)
    # The smallest numbers become 0 when they are multiplied.
    spread = max(spread_given_last(sigma_s, correlation), math.ulp(0.0))
    return _normal(slopes, means[:, np.newaxis], spread)


def _check_distribution(slopes: ArrayLike, mu_s: float, sigma_s: float) -> np.ndarray:
    slopes = check_slopes(slopes)
    if not (isinstance(mu_s, Real) and slopes[0] <= mu_s <= slopes[-1]):
        raise InputError("mu_s", mu_s, f"{slopes[0]:.6g} to {slopes[-1]:.6g} rad, the slope set")
    if not (isinstance(sigma_s, Real) and math.isfinite(sigma_s) and sigma_s > 0.0):
        raise InputError("sigma_s", sigma_s, "a finite number above 0, rad")
    return slopes


@kernel
def _exponentials(x, out):
    """`out` = e^x for x <= 0, 0 below the smallest number with all its digits.

    The same bits on every processor, unlike numpy's and the C library's.
    """
    for i in range(x.shape[0]):
        if x[i] < _LOWEST_EXPONENT:
            out[i] = 0.0
            continue
        doublings = np.floor(x[i] / math.log(2.0) + 0.5)
        # The product with the first part is exact.
        r = (x[i] - doublings * _LN2_FIRST) - doublings * _LN2_REST
        series = 1.0
        # Of 0.35^14 / 14! less than 1e-17 is left.
        for k in range(13, 0, -1):
            series = 1.0 + series * r / k
        out[i] = math.ldexp(series, int(doublings))


def _normal(slopes: np.ndarray, mean: float | np.ndarray, sigma: float) -> np.ndarray:
    """The normal density on the slopes, scaled to sum 1 along the last axis."""
    # Relative to the likeliest slope, so that a narrow density between slopes does not vanish.
    distances = np.abs(slopes - mean)
    least = distances.min(axis=-1, keepdims=True)
    with np.errstate(over="ignore"):
        exponents = 0.5 * ((distances - least) * (distances + least)) / sigma / sigma
    weights = np.empty(exponents.shape)
    _exponentials(-exponents.reshape(-1), weights.reshape(-1))
    return weights / weights.sum(axis=-1, keepdims=True)


def _check_chain(
    targets: ArrayLike, probabilities: ArrayLike, preceding: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Targets, offsets (see `iteration`) and the probability of each class."""
    allowed = "an array of numbers of shape (n, m), n at least 2, m at least 1"
    shape = numbers(targets, "targets", allowed).shape
    if len(shape) != 2 or shape[0] < 2 or shape[1] < 1:
        raise InputError("targets", shape, allowed)
    targets = checked_array("targets", targets, np.uint32, shape)
    if targets.max() >= shape[0]:
        raise InputError("targets", int(targets.max()), f"indices of states, below {shape[0]}")
    n, m = shape
    wanted = (m,) if preceding is None else (m, m)
    probabilities = checked_array("probabilities", probabilities, np.float64, wanted)
    if not (
        (probabilities >= 0.0).all() and (abs(probabilities.sum(axis=-1) - 1.0) <= 1e-12).all()
    ):
        allowed = "not negative, with sum 1" if preceding is None else "not negative, rows of sum 1"
        raise InputError("probabilities", probabilities.tolist(), allowed)
    if preceding is None:
        return targets, np.zeros(n, dtype=np.int64), probabilities
    preceding = checked_array("preceding", preceding, np.uint32, (n,))
    return targets, _offsets(targets, preceding), probabilities.ravel()


def _offsets(targets: np.ndarray, preceding: np.ndarray) -> np.ndarray:
    """Offsets (see `iteration`) of the states of a chain with correlated slopes.

    Raises
    ------
    InputError
        If a state does not know the slope before it.
    """
    n, m = targets.shape
    if preceding.max() >= m:
        raise InputError("preceding", int(preceding.max()), f"indices of slopes, below {m}")
    for first in range(1, n, CHECKED_ROWS):
        block = targets[first : first + CHECKED_ROWS]
        wrong = (block != 0) & (preceding[block] != np.arange(m))
        if wrong.any():
            i, s = np.argwhere(wrong)[0]
            j = int(block[i, s])
            allowed = f"{s}, the slope over which state {first + i} leads to it"
            raise InputError(f"preceding[{j}]", int(preceding[j]), allowed)
    return preceding.astype(np.int64) * m


def transition_matrix(
    targets: ArrayLike, probabilities: ArrayLike, preceding: ArrayLike | None = None
) -> csr_array:
    """Stochastic state-transition matrix T (eq. 32), the failure state included as index 0.

    Parameters
    ----------
    targets : array_like
        Eq. (27) as in `Mesh`, shape (n, m).
    probabilities : array_like
        P_S, shape (m,); with `preceding` P(s | r), shape (m, m), a row for each r.
    preceding : array_like, optional
        As in `Mesh`, shape (n,): index of the slope before each state, where the next slope
        depends on that.

    Returns
    -------
    scipy.sparse.csr_array
        Shape (n, n), rows sum to 1 within rounding. Transitions of probability 0 are left out.

    Raises
    ------
    InputError
        If an argument is not allowed.
    """
    return _matrix(*_check_chain(targets, probabilities, preceding))


def _matrix(targets: np.ndarray, offsets: np.ndarray, probabilities: np.ndarray) -> csr_array:
    n, m = targets.shape
    shares = probabilities.reshape(-1, m)[offsets[1:] // m]
    kept = shares > 0.0
    # The failure state is absorbing: one entry.
    matrix = csr_array(
        (
            np.concatenate([[1.0], shares[kept]]),
            np.concatenate([[0], targets[1:][kept]]).astype(np.int64),
            np.concatenate([[0, 1], 1 + np.cumsum(kept.sum(axis=1))]),
        ),
        shape=(n, n),
    )
    matrix.sum_duplicates()
    return matrix


# Results ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Metastability:
    """What a chain over a mesh says about falls. n states, the failure state counted as index 0.

    Parameters
    ----------
    lambda_2 : float
        Second largest eigenvalue of T: probability of surviving a step, once metastable. Summed
        up from what survives, so accurate near 0, but for 1e-16 where aggregation had to find the
        distribution; near 1 use `failure_probability`.
    failure_probability : float
        1 - lambda_2, summed up from what falls, accurate relative to itself.
    mfpt : float
        Mean first-passage time, steps, eq. (35): 1 / (1 - lambda_2); inf where a state can be
        reached from x_2 from which no fall can be reached. Above 1e280 digits are lost to
        underflow, and above the largest number, 1.8e308, it is inf, too.
    distribution : numpy.ndarray
        Metastable distribution phi, shape (n,), sum 1, index 0 is 0. It has no weight on states
        that are not visited again and again. Where lambda_2 is 0 it is one from which every
        step falls; where no fall can be reached from some states, it is stationary on those.
        Weights below about 1e-12 (1 - lambda_2) / n may be off: they do not matter for falls. So
        may the shares of parts that fall alike to 1e-12 and hardly ever change into each other.
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
    _offsets: np.ndarray = field(repr=False)
    _probabilities: np.ndarray = field(repr=False)

    @cached_property
    def mfpt_from_state(self) -> np.ndarray:
        """Mean number of steps to a fall from each state, the falling one counted; shape (n,).

        Computed when first asked for, at about twice the cost of the rest. 0 for the failure
        state, inf for states from which one can reach some that never fall, and above the largest
        number. Accurate relative to itself up to 1e150; beyond, a state from which others that last
        as long are reached too rarely for a number may lack what these add.

        Raises
        ------
        ChainError
            If the chain mixes too slowly to be iterated, and aggregation does not settle either.
        """
        targets, offsets, probabilities = self._targets, self._offsets, self._probabilities
        possible = probabilities > 0.0
        endless = ~iteration.can_fall(targets, offsets, possible)
        iteration.can_reach(targets, offsets, possible, endless)
        among = ~endless
        among[0] = False
        escape = 0.0 if endless.any() else self.failure_probability
        members = np.flatnonzero(among)
        times: np.ndarray | None = np.zeros(len(targets))
        if len(members):
            times = _iterated_times(
                targets, offsets, probabilities, among, self.distribution, escape
            )
        if times is None:
            rows = _restricted(targets, offsets, probabilities, members)
            found = passage_times(*rows, TOLERANCE)
            if found is None:
                raise ChainError(_unsettled(len(members)))
            times = np.zeros(len(targets))
            times[members] = found
        times[endless] = math.inf
        times.flags.writeable = False
        return times


def _iterated_times(
    targets: np.ndarray,
    offsets: np.ndarray,
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
        settled = iteration.settle(
            iteration.outgoing(targets, offsets, probabilities > 0.0),
            probabilities[:, np.newaxis],
            np.array([np.argmax(phi)]),
            # Below this, psi / escape is within the tolerance of the first step alone.
            phi[:, np.newaxis],
            np.array([TOLERANCE * escape]),
            TOLERANCE,
            _STEPS,
        )
        if not settled.done[0]:
            return None
        found = settled.vectors[:, 0]
        # 0 where nothing settles at all, and tiny where psi is that of states out of x_2's reach.
        # Not by BLAS here and below, whose order of operations depends on the machine.
        overlap = float((phi * found).sum())
        if overlap < iteration.UNDERFLOW:
            return _iterated_times(targets, offsets, probabilities, among, phi, 0.0)
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
            if (first / _CANCELLATION > times).any():
                return _iterated_times(targets, offsets, probabilities, among, phi, 0.0)
            return times
        iteration.step_backward(targets, offsets, probabilities, rest, out)
        if k <= iteration.PLAIN_STEPS:
            series += rest
            rest, out = out, rest
        else:
            # (I - Q)^-1 = (I - (I + Q) / 2)^-1 / 2
            series += 0.5 * rest
            rest = 0.5 * (rest + out)
        # phi rest = 0 but for rounding, which would stay for ever.
        rest -= psi * (phi * rest).sum()
    return None


# Metastable distribution ------------------------------------------------------------------------

OnProgress = Callable[[int, int, float], object]


@kernel
def _survive(targets, offsets, probabilities, rows, x, out):
    """out[rows] = probability to get in one step where x counts, for a function x of the state."""
    for k in range(rows.shape[0]):
        total = 0.0
        for s in range(targets.shape[1]):
            total += probabilities[offsets[rows[k]] + s] * x[targets[rows[k], s]]
        out[rows[k]] = total


def _restricted(
    targets: np.ndarray, offsets: np.ndarray, probabilities: np.ndarray, members: np.ndarray
) -> tuple[csr_array, np.ndarray]:
    """Q among some states, which lead only to each other and to 0, and what falls from them."""
    rows = _matrix(targets, offsets, probabilities)[members]
    return csr_array(rows[:, members]), rows[:, [0]].toarray().ravel()


def _unsettled(states: int) -> str:
    return (
        f"the chain of {states} states settles neither in {_STEPS} steps nor in {ROUNDS} rounds of "
        "aggregation"
    )


class _Solver:
    """Chains over one mesh that differ in the probabilities of the classes, by column."""

    def __init__(
        self,
        targets: np.ndarray,
        outcomes: np.ndarray,
        offsets: np.ndarray,
        probabilities: np.ndarray,
    ) -> None:
        self.targets = targets
        self.outcomes = outcomes
        self.offsets = offsets
        self.probabilities = probabilities
        # All classes, also those without probability, so that sums are in the same order whatever
        # the columns.
        every = np.ones(len(probabilities), dtype=np.bool_)
        self.structure = iteration.incoming(targets, offsets, every)
        # Where a class has no probability at all, others can be reached, or no fall.
        self.possible = np.ascontiguousarray(probabilities.T > 0.0)
        known: dict[bytes, int] = {}
        for possible in self.possible:
            if possible.tobytes() not in known:
                known[possible.tobytes()] = self._safe(possible)
        self.safe = np.array([known[possible.tobytes()] for possible in self.possible])

    def _reachable(self, possible: np.ndarray, start: int) -> np.ndarray:
        return iteration.reachable(self.targets, self.offsets, possible, start)

    def _safe(self, possible: np.ndarray) -> int:
        """A state that can be reached from x_2 and from which no fall can; 0: there is none."""
        can_fall = iteration.can_fall(self.targets, self.offsets, possible)
        if can_fall.all():
            return 0
        return int(np.argmax(self._reachable(possible, 1) & ~can_fall))

    def iterate(
        self, columns: np.ndarray, begin: np.ndarray, on_steps: iteration.OnSteps | None
    ) -> iteration.Settled:
        """Iterate the distributions of some columns from some states."""
        n, width = len(self.targets), iteration.padded(len(columns))
        p = np.zeros((len(self.probabilities), width))
        p[:, : len(columns)] = self.probabilities[:, columns]
        weights = np.zeros((n, width))
        iteration.fall_probabilities(self.targets, self.offsets, p, weights)
        weights[:, np.flatnonzero(self.safe[columns])] = 1.0
        factors = np.full(width, TOLERANCE / n)
        return iteration.settle(
            self.structure, p, begin, weights, factors, TOLERANCE, _STEPS, on_steps
        )

    def distributions(
        self, columns: np.ndarray, on_steps: iteration.OnSteps | None
    ) -> tuple[np.ndarray, dict[int, ChainError]]:
        """Metastable distributions of some columns, shape (n, columns), and why some are 0.

        A state that is hardly ever visited again would not do to begin with: its first steps may
        share weight out between parts of the chain in a way that later steps are too slow to put
        right. So a result counts if the state that it began with is likely in it: whatever part is
        not in balance with a state that is always visited is seen to fill. Mostly x_2 is such a
        state; else the likeliest one is tried, and then the likeliest of those aside of it.
        """
        n = len(self.targets)
        out = np.empty((n, len(columns)))
        begin = np.maximum(self.safe[columns], 1)
        left, unsettled = np.arange(len(columns)), []
        rough = None
        for _ in range(3):
            found = self.iterate(columns[left], begin[left], on_steps)
            if rough is None:
                rough = found.vectors
            again = []
            for phi, done, c in zip(found.vectors.T, found.done, left, strict=True):
                candidates = rough[:, c]
                if done and n * phi[begin[c]] >= _OFTEN:
                    aside = self._aside(columns[c], begin[c], phi)
                    if aside is None:
                        out[:, c] = phi
                        continue
                    candidates = np.where(aside, candidates, 0.0)
                likeliest = int(np.argmax(candidates))
                if likeliest in (0, begin[c]):
                    unsettled.append(c)
                else:
                    begin[c] = likeliest
                    again.append(c)
            left = np.array(again, dtype=np.int64)
            if not len(left):
                break
        errors = {}
        for c in [*unsettled, *left]:
            try:
                out[:, c] = self._aggregated(columns[c])
            except ChainError as error:
                out[:, c] = 0.0
                errors[int(c)] = error
        return out, errors

    def _aside(self, column: int, begin: int, phi: np.ndarray) -> np.ndarray | None:
        """States reached from x_2 but not from `begin`, if they may have a larger eigenvalue.

        `phi` is the metastable distribution of those that are reached from `begin`.
        """
        if begin == 1 or self.safe[column]:
            return None
        possible, p = self.possible[column], self.probabilities[:, column]
        aside = self._reachable(possible, 1) & ~self._reachable(possible, begin)
        rows = np.flatnonzero(aside)
        if not len(rows):
            return None
        _, survives = self._account(np.array([column]), phi[:, np.newaxis])
        lambda_2 = survives[0]
        x, out = aside.astype(np.float64), np.zeros(len(phi))
        for _ in range(_ASIDE_STEPS if lambda_2 > 0.0 else 0):
            _survive(self.targets, self.offsets, p, rows, x, out)
            # Beyond 1 a bound does not hide an eigenvector, of which x is never less than a copy.
            with np.errstate(over="ignore"):
                np.minimum(out / lambda_2, _MOST_SURVIVAL, out=out)
            x, out = out, x
            # The largest survival of k steps is at least the eigenvalue to the power of k. By more
            # than rounding adds to a survival of 1:
            if x.max() <= 1.0 - 1e-9:
                return None
        return aside

    def _aggregated(self, column: int) -> np.ndarray:
        """Metastable distribution of one column, however slowly it mixes."""
        members = self._reachable(self.possible[column], max(1, self.safe[column]))
        members[0] = False
        p = self.probabilities[:, column]
        rows = _restricted(self.targets, self.offsets, p, np.flatnonzero(members))
        phi = metastable_distribution(*rows, TOLERANCE)
        if phi is None:
            raise ChainError(_unsettled(len(rows[1])))
        out = np.zeros(len(self.targets))
        out[members] = phi
        return out

    def _account(self, columns: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Falls by outcome code, (codes, columns), and survival, (columns,), of a step from phi."""
        by_code = np.zeros((int(self.outcomes[1:].max()) + 1, len(columns)))
        survives = np.zeros(len(columns))
        p = np.ascontiguousarray(self.probabilities[:, columns])
        iteration.account(self.targets, self.outcomes, self.offsets, p, phi, by_code, survives)
        return by_code, survives

    def solve(
        self, columns: np.ndarray, on_steps: iteration.OnSteps | None
    ) -> list[Metastability | ChainError]:
        """Metastability of some columns, or why it is not known."""
        phi, errors = self.distributions(columns, on_steps)
        by_code, survives = self._account(columns, phi)
        out: list[Metastability | ChainError] = []
        for c, column in enumerate(columns):
            if c in errors:
                out.append(errors[c])
                continue
            falls = math.fsum(by_code[:, c])
            total = float(survives[c]) + falls
            distribution = phi[:, c].copy()
            distribution.flags.writeable = False
            out.append(
                Metastability(
                    lambda_2=float(survives[c]) / total,
                    failure_probability=falls / total,
                    mfpt=total / falls if falls > 0.0 else math.inf,
                    distribution=distribution,
                    failure_shares={
                        int(code): float(by_code[code, c] / falls)
                        for code in by_code[:, c].nonzero()[0]
                    },
                    _targets=self.targets,
                    _offsets=self.offsets,
                    _probabilities=self.probabilities[:, column].copy(),
                )
            )
        return out


def _solve(
    targets: np.ndarray,
    outcomes: np.ndarray,
    offsets: np.ndarray,
    probabilities: np.ndarray,
    threads: int | None = None,
    on_progress: OnProgress | None = None,
) -> list[Metastability | ChainError]:
    """Metastability for each column of `probabilities`, shape (classes, columns)."""
    solver = _Solver(targets, outcomes, offsets, probabilities)
    count = probabilities.shape[1]
    work = count * len(solver.structure.entries)
    threads = (threads or os.cpu_count() or 1) if work >= _WORTH_THREADS else 1
    # A few are faster one to a thread.
    blocks = np.array_split(np.arange(count), count if count <= threads else -(-count // LANES))
    solved, stopped = 0, False

    def on_steps(steps: int, missing: np.ndarray) -> None:
        if stopped:
            raise InterruptedError("another thread ended with an error")
        if on_progress is not None:
            on_progress(solved, steps, float(missing.max()))

    def solve(columns: np.ndarray) -> list[Metastability | ChainError]:
        nonlocal solved
        found = solver.solve(columns, on_steps)
        solved += len(columns)
        return found

    if threads == 1 or len(blocks) == 1:
        return list(chain.from_iterable(map(solve, blocks)))
    pool = ThreadPoolExecutor(threads)
    try:
        return list(chain.from_iterable(pool.map(solve, blocks)))
    except BaseException:
        stopped = True
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _the_one(found: list[Metastability | ChainError]) -> Metastability:
    (one,) = found
    if isinstance(one, ChainError):
        raise one
    return one


def metastabilities(
    mesh: Mesh,
    mu_s: float,
    sigma_s: Sequence[float] | np.ndarray,
    *,
    correlation: float = 0.0,
    threads: int | None = None,
    on_progress: OnProgress | None = None,
) -> list[Metastability | ChainError]:
    """Metastability of the chain over a mesh for many spreads of the slope (eq. 30 to 35).

    That takes far less time than one after another. Each result has the same bits as alone, and
    whatever the number of threads.

    Parameters
    ----------
    mesh : Mesh
        The mesh; one serves any number of distributions.
    mu_s : float
        Mean slope, rad, within the slope set.
    sigma_s : sequence of float
        Standard deviations of the slope, rad, above 0. The slope set should not be much coarser,
        see `slope_probabilities`.
    correlation : float, optional
        Of each slope with the one before, above -1 and below 1; see `conditional_probabilities`.
        Other than 0 the mesh has to be clustered: else its states do not tell the slope before.
    threads : int, optional
        Most threads; default one for each core. A small chain takes one.
    on_progress : callable, optional
        Called every second or so, maybe from several threads, as ``on_progress(solved, steps,
        missing)``: how many results are there, and of one block that is being iterated the steps
        taken, and about how much is missing relative to the result: it ends below `TOLERANCE`.
        An exception from it ends the work and is passed on.

    Returns
    -------
    list of Metastability or ChainError
        One for each of `sigma_s`, in the same order. A `ChainError`, which is not raised, stands
        where a chain mixes too slowly to be iterated, and aggregation does not settle either.

    Raises
    ------
    InputError
        If mu_s, one of sigma_s, or correlation is not allowed.
    """
    offsets = np.zeros(len(mesh.targets), dtype=np.int64)
    if check_correlation(correlation) != 0.0:
        if not mesh.clustered:
            raise InputError(
                "correlation", correlation, "0 on this mesh, as it was grown with clustered = "
                "False: its states do not tell the slope before them"
            )  # fmt: skip
        offsets = _offsets(mesh.targets, mesh.preceding)
    columns = []
    for i, sigma in enumerate(sigma_s):
        try:
            if correlation == 0.0:
                columns.append(slope_probabilities(mesh.slopes, mu_s, sigma))
            else:
                rows = conditional_probabilities(mesh.slopes, mu_s, sigma, correlation)
                columns.append(rows.ravel())
        except InputError as error:
            field = f"sigma_s[{i}]" if error.field == "sigma_s" else error.field
            raise InputError(field, error.value, error.allowed) from None
    if not columns:
        return []
    probabilities = np.ascontiguousarray(np.array(columns).T)
    return _solve(mesh.targets, mesh.outcomes, offsets, probabilities, threads, on_progress)


def metastability(
    mesh: Mesh, mu_s: float, sigma_s: float, correlation: float = 0.0
) -> Metastability:
    """Metastability of the chain over a mesh for normally distributed slopes (eq. 30 to 35).

    Parameters
    ----------
    mesh : Mesh
        The mesh.
    mu_s : float
        Mean slope, rad, within the slope set.
    sigma_s : float
        Standard deviation of the slope, rad, above 0. The slope set should not be much coarser,
        see `slope_probabilities`.
    correlation : float, optional
        As for `metastabilities`.

    Returns
    -------
    Metastability

    Raises
    ------
    InputError
        If mu_s, sigma_s or correlation is not allowed.
    ChainError
        If the chain mixes too slowly to be iterated, and aggregation does not settle either.
    """
    try:
        return _the_one(metastabilities(mesh, mu_s, [sigma_s], correlation=correlation))
    except InputError as error:
        raise InputError(error.field.removesuffix("[0]"), error.value, error.allowed) from None


def solve_chain(
    targets: ArrayLike,
    outcomes: ArrayLike,
    probabilities: ArrayLike,
    preceding: ArrayLike | None = None,
) -> Metastability:
    """Metastability of a chain given by its arrays, for any distribution of slopes.

    Parameters
    ----------
    targets, outcomes : array_like
        As in `Mesh`, shape (n, m). The walk starts in state 1.
    probabilities : array_like
        P_S, not negative, sum 1, shape (m,); with `preceding` P(s | r), a row of this kind for
        each r, shape (m, m).
    preceding : array_like, optional
        As in `Mesh`, shape (n,): index of the slope before each state, where the next slope
        depends on that. A state that is reached over two slopes does not know it.

    Returns
    -------
    Metastability

    Raises
    ------
    InputError
        If an argument is not allowed.
    ChainError
        If the chain mixes too slowly to be iterated, and aggregation does not settle either.
    """
    targets, offsets, probabilities = _check_chain(targets, probabilities, preceding)
    outcomes = checked_array("outcomes", outcomes, np.uint8, targets.shape)
    check_transitions(targets, outcomes)
    return _the_one(_solve(targets, outcomes, offsets, probabilities[:, np.newaxis].copy()))
