r"""Steps of a chain for many distributions of slopes at once, until each settles.

A column is one distribution of slopes: its probabilities, and a vector with a weight for each
state. Columns do not mix: each is computed in the same order of operations whatever stands beside
it, so a result has the same bits alone and among fifty. What columns share is the structure of
the chain, which costs most of the time to read.

How likely a transition is depends on its class: on the slope s that it goes over, and where slopes
are correlated also on the slope r before it, which the state that it starts from tells. Class is
`offsets[i] + s`, for state i; the offset is 0, or r times the number of slopes.

The structure lists for every state those that lead to it and the class (`incoming`), so
that a step only reads scattered memory, and writes in order. The states of a mesh are numbered as
they were found, so that neighbours are mostly siblings, reached from the same states: these are
in the cache.

The steps start from a state that is visited again and again, and every other state gets its weight
by flow from there. So a slow part of the chain shows: while it still fills, its weight changes by
1/k or more in step k; after that, what is missing of it after k steps is at most about k times
what step k changed. Hence the rule to stop: k times the largest relative change is within the
tolerance, in two steps in a row, as parts that oscillate may stand still for a moment. A weight
that shrinks and is below what could matter for the result (the floor) is left out, but one that
grows never is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from biped_mfpt_ros.chain.lanes import LANES, gather_lanes
from biped_mfpt_ros.jit import kernel

PLAIN_STEPS = 100
"""Steps before every further one is mixed with staying, which makes periodic chains settle."""

UNDERFLOW = 1e-290
"""Weights below this may have lost digits to underflow, and are not waited for."""

_CHECK_EVERY = 4  # even, so that what alternates is compared in the same phase
_SUMMED_PLAINLY = 128  # terms; longer sums are added up with compensation for rounding
_ROWS_SUMMED_PLAINLY = 16
_ROWS = 256  # whose falls are added up before they are added to those of the rows before
_CALL_SECONDS = 0.5  # about, before a long iteration says how far it is
_OPERATIONS_PER_SECOND = 2e9  # about, of _advance


@kernel
def _count(targets, offsets, possible, outward, starts):
    for i in range(1, targets.shape[0]):
        for s in range(targets.shape[1]):
            j = targets[i, s]
            if j != 0 and possible[offsets[i] + s]:
                starts[(i if outward else np.int64(j)) + 1] += 1
    for j in range(targets.shape[0]):
        starts[j + 1] += starts[j]


@kernel
def _enter(targets, offsets, possible, outward, shift, filled, entries):
    for i in range(1, targets.shape[0]):
        for s in range(targets.shape[1]):
            j = np.int64(targets[i, s])
            if j != 0 and possible[offsets[i] + s]:
                at, other = (i, j) if outward else (j, np.int64(i))
                entries[filled[at]] = (other << shift) | (offsets[i] + s)
                filled[at] += 1


@dataclass(frozen=True, eq=False)
class Structure:
    """Transitions of a chain, those to the failure state left out, sorted by state.

    Attributes
    ----------
    starts : numpy.ndarray
        int64, shape (n + 1,): those of state j are `entries[starts[j] : starts[j + 1]]`.
    entries : numpy.ndarray
        The state at the other end, shifted left, and the class in the lower bits; uint32, or
        uint64 where that is too narrow.
    shift : int
        Bits for the class.
    """

    starts: np.ndarray
    entries: np.ndarray
    shift: int


def _structure(
    targets: np.ndarray, offsets: np.ndarray, possible: np.ndarray, outward: bool
) -> Structure:
    n = len(targets)
    shift = max(1, (len(possible) - 1).bit_length())
    starts = np.zeros(n + 1, dtype=np.int64)
    _count(targets, offsets, possible, outward, starts)
    entries = np.empty(starts[n], dtype=np.uint32 if n << shift <= 2**32 else np.uint64)
    _enter(targets, offsets, possible, outward, shift, starts[:-1].copy(), entries)
    return Structure(starts, entries, shift)


def incoming(targets: np.ndarray, offsets: np.ndarray, possible: np.ndarray) -> Structure:
    """Transitions of the possible classes, bool, (classes,), by the state that they lead to."""
    return _structure(targets, offsets, possible, False)


def outgoing(targets: np.ndarray, offsets: np.ndarray, possible: np.ndarray) -> Structure:
    """Transitions of the possible classes, bool, (classes,), by the state that they start from."""
    return _structure(targets, offsets, possible, True)


@kernel
def _gather_one(entries, e, end, shift, low, p, x):
    """What `gather_lanes` does, for a single column."""
    even = 0.0
    odd = 0.0
    while e + 1 < end:
        entry = np.uint64(entries[e])
        even += x[entry >> shift, 0] * p[entry & low, 0]
        entry = np.uint64(entries[e + 1])
        odd += x[entry >> shift, 0] * p[entry & low, 0]
        e += 2
    if e < end:
        entry = np.uint64(entries[e])
        even += x[entry >> shift, 0] * p[entry & low, 0]
    return even + odd


@kernel
def _add(total, lost, part):
    """Add to a sum with what rounding has lost of it so far (Kahan)."""
    for c in range(total.shape[0]):
        term = part[c] - lost[c]
        summed = total[c] + term
        lost[c] = (summed - total[c]) - term
        total[c] = summed


@kernel
def _advance(starts, entries, bits, p, stay, x, out, total):
    """`out` = x Q + stay * x in each column, and its sums.

    Long sums are accurate to rounding, as what differs from step to step would look like change.
    """
    shift = np.uint64(bits)
    low = (np.uint64(1) << shift) - np.uint64(1)
    n, width = x.shape
    part = np.zeros(width)
    total_lost = np.zeros(width)
    row_lost = np.empty(width)
    piece = np.empty(width)
    total[:] = 0.0
    for j in range(1, n):
        row = out[j]
        begin = starts[j]
        end = min(begin + _SUMMED_PLAINLY, starts[j + 1])
        if width == 1:
            row[0] = _gather_one(entries, begin, end, shift, low, p, x)
        else:
            gather_lanes(entries, begin, end, np.int64(bits), p, x, row)
        if end < starts[j + 1]:
            row_lost[:] = 0.0
            while end < starts[j + 1]:
                begin = end
                end = min(begin + _SUMMED_PLAINLY, starts[j + 1])
                if width == 1:
                    piece[0] = _gather_one(entries, begin, end, shift, low, p, x)
                else:
                    gather_lanes(entries, begin, end, np.int64(bits), p, x, piece)
                _add(row, row_lost, piece)
        for c in range(width):
            row[c] += stay[c] * x[j, c]
            part[c] += row[c]
        if j % _ROWS_SUMMED_PLAINLY == 0 or j == n - 1:
            _add(total, total_lost, part)
            part[:] = 0.0


@kernel
def _largest_change(x, before, out, after, floor, seen, largest):
    """Largest relative change from x / before to out / after, of what matters.

    That is what is not below the floor, or was less when it was last `seen`.
    """
    n, width = x.shape
    largest[:] = 0.0
    for j in range(1, n):
        for c in range(width):
            value = out[j, c] * after[c]
            change = abs(value - x[j, c] * before[c])
            if value > UNDERFLOW and (value > floor[c] or value > seen[j, c]):
                largest[c] = max(largest[c], change / value)


@kernel
def _settle(
    starts, entries, bits, p, weights, factors, plain, tolerance, first, last,
    vectors, total, seen, stay, passed, done, changes, found,
):  # fmt: skip
    """Take the steps from `first` to `last`, or until all columns are done; returns the last one.

    Step k goes from vectors[(k - 1) % 2] to vectors[k % 2], of sums `total`. A column that is done
    has its vector in `found`, and is 0 from then on.
    """
    n, width = found.shape
    shares = np.empty_like(p)
    after = np.empty(width)
    before = np.empty(width)
    inverse = np.empty(width)
    floor = np.empty(width)
    for k in range(first, last + 1):
        x = vectors[(k - 1) % 2]
        out = vectors[k % 2]
        for c in range(width):
            before[c] = 0.0 if done[c] else 1.0 / total[c]
            if k == plain + 1:
                stay[c] = 0.5 * total[c]  # half of what a step leaves of the sum
            for s in range(p.shape[0]):
                shares[s, c] = p[s, c] * before[c]
        _advance(starts, entries, bits, shares, stay * before, x, out, after)
        for c in range(width):
            if after[c] == 0.0 and not done[c]:
                # Nothing survives: what did before is the limit.
                done[c] = True
                changes[c] = 0.0
                for j in range(n):
                    found[j, c] = x[j, c] * before[c]
            inverse[c] = 0.0 if done[c] else 1.0 / after[c]
        if k % _CHECK_EVERY == 0 or passed.any():
            floor[:] = 0.0
            for j in range(1, n):
                for c in range(width):
                    floor[c] += weights[j, c] * out[j, c]
            for c in range(width):
                floor[c] *= factors[c] * inverse[c]
            _largest_change(x, before, out, inverse, floor, seen, changes)
            for c in range(width):
                # As if alone: what another column is checked for does not count here.
                if k % _CHECK_EVERY != 0 and not passed[c]:
                    continue
                settled = k * changes[c] <= tolerance
                if settled and passed[c] and not done[c]:
                    done[c] = True
                    for j in range(n):
                        found[j, c] = out[j, c] * inverse[c]
                passed[c] = settled and not done[c]
            if k % _CHECK_EVERY == 0:
                for j in range(n):
                    for c in range(width):
                        seen[j, c] = out[j, c] * inverse[c]
        total[:] = after
        if done.all():
            return k
    return last


@dataclass(frozen=True, eq=False)
class Settled:
    """What came of an iteration, by column.

    Attributes
    ----------
    vectors : numpy.ndarray
        Vectors of sum 1, shape (n, columns); the last ones where they did not settle.
    done : numpy.ndarray
        Whether each settled, bool, shape (columns,).
    steps : int
        Steps taken.
    """

    vectors: np.ndarray
    done: np.ndarray
    steps: int


def padded(columns: int) -> int:
    """Width of the arrays of an iteration of so many columns: there is code for 1 and `LANES`."""
    if columns > LANES:
        raise ValueError(f"{columns} columns, at most {LANES} are iterated together")
    return 1 if columns == 1 else LANES


OnSteps = Callable[[int, np.ndarray], object]


def settle(
    structure: Structure,
    probabilities: np.ndarray,
    begin: np.ndarray,
    weights: np.ndarray,
    factors: np.ndarray,
    tolerance: float,
    most_steps: int,
    on_steps: OnSteps | None = None,
) -> Settled:
    """Repeat steps, each scaled to sum 1, until every column settles or there were too many.

    Parameters
    ----------
    structure : Structure
        `incoming` to step distributions forward, `outgoing` to step functions of the state back.
    probabilities : numpy.ndarray
        Of each class and column, shape (classes, width), width as `padded` says; what is beyond
        the columns is ignored.
    begin : numpy.ndarray
        State that has all the weight at first, int64, shape (columns,).
    weights, factors : numpy.ndarray
        A component of a vector x of sum 1 that shrinks and is below factor * (weights @ x) does
        not matter; shapes (n, width) and (width,).
    tolerance : float
        Most that may be missing of any component that matters, relative to itself.
    most_steps : int
        Where to give up.
    on_steps : callable, optional
        Called now and then as ``on_steps(k, missing)``: steps taken, and k times the largest
        relative change of each column, shape (columns,).

    Returns
    -------
    Settled
        A step that leaves nothing ends a column with what it started from.
    """
    n, width = weights.shape
    columns = len(begin)
    vectors = np.zeros((2, n, width))
    vectors[0, begin, np.arange(columns)] = 1.0
    found = np.zeros((n, width))
    total, stay = np.ones(width), np.zeros(width)
    passed, done = np.zeros((2, width), dtype=np.bool_)
    done[columns:] = True
    changes = np.full(width, np.inf)
    seen = np.zeros((n, width))
    at_once = int(_CALL_SECONDS * _OPERATIONS_PER_SECOND / (width * (len(structure.entries) + n)))
    k = 0
    while k < most_steps and not done.all():
        last = min(most_steps, k + max(at_once, _CHECK_EVERY))
        k = _settle(
            structure.starts, structure.entries, structure.shift, probabilities, weights, factors,
            PLAIN_STEPS, tolerance, k + 1, last,
            vectors, total, seen, stay, passed, done, changes, found,
        )  # fmt: skip
        if on_steps is not None and not done.all():
            on_steps(k, np.where(done, 0.0, k * changes))
    if not done.all():
        left = ~done
        found[:, left] = vectors[k % 2][:, left] / total[left]
    return Settled(found[:, :columns], done[:columns], k)


@kernel
def fall_probabilities(targets, offsets, p, out):
    """out[i, c] = probability to fall in the next step from state i, for column c."""
    for i in range(1, targets.shape[0]):
        for c in range(out.shape[1]):
            out[i, c] = 0.0
        for s in range(targets.shape[1]):
            if targets[i, s] == 0:
                for c in range(out.shape[1]):
                    out[i, c] += p[offsets[i] + s, c]


@kernel
def account(targets, outcomes, offsets, p, x, by_code, survives):
    """Where a step from distribution x goes: `by_code` to falls by outcome code, or it survives.

    Both are set; shapes (codes, columns) and (columns,).
    """
    n, width = x.shape
    part = np.zeros_like(by_code)
    living = np.zeros_like(survives)
    by_code[:] = 0.0
    survives[:] = 0.0
    for i in range(1, n):
        for s in range(targets.shape[1]):
            k = offsets[i] + s
            if targets[i, s] == 0:
                code = outcomes[i, s]
                for c in range(width):
                    part[code, c] += x[i, c] * p[k, c]
            else:
                for c in range(width):
                    living[c] += x[i, c] * p[k, c]
        if i % _ROWS == 0 or i == n - 1:
            by_code += part
            survives += living
            part[:] = 0.0
            living[:] = 0.0


@kernel
def step_backward(targets, offsets, probabilities, x, out):
    """`out` = T x for a function x of the state, with 0 for the failure state."""
    out[0] = 0.0
    for i in range(1, targets.shape[0]):
        total = 0.0
        for s in range(targets.shape[1]):
            if targets[i, s] != 0:
                total += probabilities[offsets[i] + s] * x[targets[i, s]]
        out[i] = total


# Who can reach whom -----------------------------------------------------------------------------


@kernel
def _reachable(targets, offsets, possible, out, queue):
    """Mark in `out` the states that can be reached from queue[0], itself included."""
    out[queue[0]] = True
    waiting = 1
    while waiting > 0:
        waiting -= 1
        i = queue[waiting]
        for s in range(targets.shape[1]):
            j = targets[i, s]
            if possible[offsets[i] + s] and not out[j]:
                out[j] = True
                queue[waiting] = j
                waiting += 1


@kernel
def can_reach(targets, offsets, possible, out):
    """Mark in `out` also the states from which one can reach those already marked."""
    changed = True
    while changed:
        changed = False
        for i in range(targets.shape[0] - 1, 0, -1):
            if not out[i]:
                for s in range(targets.shape[1]):
                    if possible[offsets[i] + s] and out[targets[i, s]]:
                        out[i] = True
                        changed = True
                        break


def reachable(
    targets: np.ndarray, offsets: np.ndarray, possible: np.ndarray, start: int
) -> np.ndarray:
    """Whether each state can be reached from `start` over possible classes, bool, (n,)."""
    out = np.zeros(len(targets), dtype=np.bool_)
    queue = np.empty(len(targets), dtype=np.int64)
    queue[0] = start
    _reachable(targets, offsets, possible, out, queue)
    return out


def can_fall(targets: np.ndarray, offsets: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """Whether a fall can be reached from each state over possible classes, bool, (n,)."""
    out = np.zeros(len(targets), dtype=np.bool_)
    out[0] = True
    can_reach(targets, offsets, possible, out)
    return out
