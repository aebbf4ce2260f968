"""Meshing of the reachable states (Algorithm 1, eq. 24 to 28).

The mesh is grown generation by generation: all unexplored states are simulated at once for every
slope, and their successors are tested one after another, in the order of their parents and then
of the slopes. What comes out depends on the answers of the step map alone, not on who computed
them, in how many pieces, or when. So a mesh is resumed by growing it again with a `simulate` that
takes what was recorded from the record and simulates only the rest.

The paper leaves open when the scales r_i of eq. (25) are refreshed. Here, by default:

- r_i is the standard deviation of dimension i over the states of X, x_1 left out, at the start of
  each generation's tests. It stays the same while one generation is tested.
- A dimension in which X has no spread beyond rounding takes the standard deviation over the
  successors that are about to be tested. The first generation, where X is x_2 alone, gets all
  its scales this way.
- A dimension in which these have no spread either gets r_i = inf: it says nothing about how far
  apart two states are, and its term of eq. (25) is 0.

With `scale_refresh="addition"`, r_i is refreshed after each state that is added, as Algorithm 1
says if taken to the letter; the rules for dimensions without spread are the same.

The last generation adds no state, so its scales are those of the final X, and they decide the
targets of eq. (27).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.chain.nearest import STATE_SIZE, StateSet
from biped_mfpt_ros.chain.refresh import additions
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.terrain import check_slopes

# As a plain number: with a member of an enumeration NumPy compares in 64 bits, ten times slower.
_STEP, _LAST_OUTCOME = int(Outcome.STEP), int(max(Outcome))

NOT_SIMULATED = 255
"""What stands for the outcomes of the failure state, from which no step is taken."""

DEFAULT_MAX_STATES = 100_000
"""Default limit on the states of a mesh."""

SCALE_REFRESHES = ("generation", "addition")
"""When r_i of eq. (25) can be computed anew: for each generation, or after each addition to X."""

# Relative to the largest value of a dimension, or to 1 rad or rad/s, as small values may come from
# the difference of large ones. Rounding in a step leaves some 1e-16 to 1e-14, and the step map is
# good to 1e-6 or so: nothing that is still to be told apart lies below.
_ROUNDING = 1e-12

CHECKED_ROWS = 4096
"""Rows of a mesh that are checked at a time: what that takes is to be little beside the mesh."""

_WORTH_THREADS = 2000  # states


class MeshLimitError(RuntimeError):
    """A mesh would hold more states than allowed.

    Parameters
    ----------
    max_states : int
        Most states allowed, the failure state counted.
    generation : int
        Generation that was being added.
    explored : int
        States that had been simulated.
    threshold : float
        d_thr of the mesh.
    """

    def __init__(self, max_states: int, generation: int, explored: int, threshold: float) -> None:
        self.max_states = max_states
        self.generation = generation
        self.explored = explored
        self.threshold = threshold
        super().__init__(
            f"the mesh would hold more than max_states = {max_states} states, in generation "
            f"{generation}, with {explored} simulated; allow more states or a threshold above "
            f"{threshold:g}"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.max_states, self.generation, self.explored, self.threshold)


class Steps(Protocol):
    """What `grow_mesh` needs of the answer to n states and m slopes."""

    @property
    def outcomes(self) -> np.ndarray:
        """`Outcome` codes, uint8, shape (n, m)."""

    @property
    def next_states(self) -> np.ndarray:
        """States after the k steps with outcome STEP, in row-major order of them, (k, 10)."""


class Answers(Protocol):
    """Where a growth keeps its answers until the targets are known.

    An answer is that of the n states from an index on: outcomes, uint8, shape (n, m), and the k
    successors, shape (k, 10).
    """

    def __contains__(self, start: object) -> bool: ...

    def __iter__(self) -> Iterator[int]:
        """The first states of all answers."""

    def rows(self, start: int) -> int:
        """Number of states of the answer that begins with state ``start``."""

    def put(self, start: int, outcomes: np.ndarray, successors: np.ndarray) -> None:
        """Keep an answer."""

    def get(self, start: int) -> tuple[np.ndarray, np.ndarray]:
        """The answer that begins with state ``start``."""


class AnswersInMemory(dict[int, tuple[np.ndarray, np.ndarray]]):
    """`Answers` of a small mesh: 6.5 kB a state where there are 81 slopes."""

    def rows(self, start: int) -> int:
        """Number of states of an answer."""
        return len(self[start][0])

    def put(self, start: int, outcomes: np.ndarray, successors: np.ndarray) -> None:
        """Keep an answer."""
        self[start] = outcomes, successors

    def get(self, start: int) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[override]
        """An answer."""
        return self[start]


Simulate = Callable[[np.ndarray, np.ndarray], Steps]
OnGeneration = Callable[[int, int, np.ndarray, np.ndarray], object]


def checked_array(
    field: str, value: ArrayLike, dtype: DTypeLike, shape: tuple[int, ...]
) -> np.ndarray:
    """Check the shape, and that the values survive the cast; return an array of that dtype.

    Raises
    ------
    InputError
        If one of these does not hold.
    """
    given = numbers(value, field, f"an array of numbers of shape {shape}")
    with np.errstate(invalid="ignore"):
        out = np.ascontiguousarray(given, dtype=dtype).reshape(given.shape)
    if given.shape != shape:
        raise InputError(field, given.shape, f"an array of shape {shape}")
    if given.dtype == out.dtype:
        return out
    # NaN is left to the caller: it survives a cast to float, and no other.
    changed = (out != given) & ~(np.isnan(out) & np.isnan(given))
    if changed.any():
        raise InputError(field, given[changed][0].item(), f"values that {out.dtype} can hold")
    return out


def _check_finite(field: str, value: np.ndarray, allowed: str = "finite numbers") -> None:
    bad = ~np.isfinite(value)
    if bad.any():
        raise InputError(field, float(value[bad][0]), allowed)


def _check_threshold(threshold: float) -> float:
    if not (isinstance(threshold, Real) and math.isfinite(threshold) and threshold > 0.0):
        raise InputError("threshold", threshold, "a finite number above 0")
    return float(threshold)


def _check_max_states(max_states: object) -> int:
    if not (isinstance(max_states, Integral) and 2 <= int(max_states) <= np.iinfo(np.uint32).max):
        raise InputError("max_states", max_states, "a whole number, 2 to 4294967295")
    return int(max_states)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Set of states X and state-transition map of a controller. Index 0 is the failure state x_1.

    The arrays are checked and made read-only. n counts the failure state.

    Parameters
    ----------
    slopes : numpy.ndarray
        S of eq. (24), rad, strictly ascending, float64, shape (m,).
    states : numpy.ndarray
        X: q1..q5 (rad), dq1..dq5 (rad/s), float64, shape (n, 10). Row 0 is all zeros and stands
        for every fallen state; index 1 is x_2.
    preceding : numpy.ndarray
        Index into `slopes` of the slope that precedes each state, uint32, shape (n,).
    generation : numpy.ndarray
        Generation that added each state, 0 for x_2, uint32, shape (n,).
    targets : numpy.ndarray
        Eq. (27): index of the state after a step from state i on slope s, 0 for a fall; uint32,
        shape (n, m). Row 0 is all zeros.
    outcomes : numpy.ndarray
        `Outcome` codes of these steps, uint8, shape (n, m). Row 0 is all `NOT_SIMULATED`.
    scales : numpy.ndarray
        r_i of eq. (25) for the final X, rad and rad/s, shape (10,); inf for a dimension that
        does not count.
    threshold : float
        d_thr of Algorithm 1.
    clustered : bool
        Whether distances were taken only to states of the same preceding slope.

    Raises
    ------
    InputError
        If an array has the wrong shape or values that cannot be.
    """

    slopes: np.ndarray
    states: np.ndarray
    preceding: np.ndarray
    generation: np.ndarray
    targets: np.ndarray
    outcomes: np.ndarray
    scales: np.ndarray
    threshold: float
    clustered: bool

    def __post_init__(self) -> None:
        slopes = check_slopes(self.slopes)
        n, m = len(np.atleast_1d(self.states)), len(slopes)
        if n < 2:
            raise InputError("states", n, "at least the failure state and x_2")
        states = checked_array("states", self.states, np.float64, (n, STATE_SIZE))
        preceding = checked_array("preceding", self.preceding, np.uint32, (n,))
        generation = checked_array("generation", self.generation, np.uint32, (n,))
        targets = checked_array("targets", self.targets, np.uint32, (n, m))
        outcomes = checked_array("outcomes", self.outcomes, np.uint8, (n, m))
        scales = checked_array("scales", self.scales, np.float64, (STATE_SIZE,))
        _check_finite("states", states)
        if preceding.max() >= m:
            raise InputError("preceding", int(preceding.max()), f"indices of slopes, below {m}")
        check_transitions(targets, outcomes)
        if not (scales > 0.0).all():
            raise InputError("scales", scales.tolist(), "numbers above 0, or inf")
        checked = {
            "slopes": slopes,
            "states": states,
            "preceding": preceding,
            "generation": generation,
            "targets": targets,
            "outcomes": outcomes,
            "scales": scales,
            "threshold": _check_threshold(self.threshold),
            "clustered": bool(self.clustered),
        }
        for field in fields(self):
            value = checked[field.name]
            if isinstance(value, np.ndarray):
                value = value.view()
                value.flags.writeable = False
            object.__setattr__(self, field.name, value)


def check_transitions(targets: np.ndarray, outcomes: np.ndarray) -> None:
    """Check that targets and outcomes, of equal shape (n, m), go together.

    Raises
    ------
    InputError
        If a target is not a state, an outcome is not one of a step, a step that succeeded has
        target 0 or one that did not has another, or row 0 is not that of the failure state.
    """
    n = len(targets)
    if targets.max(initial=0) >= n:
        raise InputError("targets", int(targets.max()), f"indices of states, below {n}")
    if targets[0].any() or (outcomes[0] != NOT_SIMULATED).any():
        raise InputError(
            "targets[0], outcomes[0]",
            (targets[0].tolist(), outcomes[0].tolist()),
            f"all 0 and all {NOT_SIMULATED}: the failure state takes no step",
        )
    for first in range(1, n, CHECKED_ROWS):
        block = slice(first, first + CHECKED_ROWS)
        unknown = outcomes[block] > _LAST_OUTCOME
        if unknown.any():
            i, s = np.argwhere(unknown)[0]
            i += first
            raise InputError(
                f"outcomes[{i}, {s}]",
                int(outcomes[i, s]),
                f"a code of a step, 0 to {_LAST_OUTCOME}",
            )
        wrong = (targets[block] == 0) == (outcomes[block] == _STEP)
        if wrong.any():
            i, s = np.argwhere(wrong)[0]
            i += first
            raise InputError(
                f"targets[{i}, {s}], outcomes[{i}, {s}]",
                (int(targets[i, s]), int(outcomes[i, s])),
                "target 0 for a fall, outcome 0 (STEP) with any other target",
            )


def _slope_index(slopes: np.ndarray, slope: float, field: str) -> int:
    if not (isinstance(slope, Real) and math.isfinite(slope)):
        raise InputError(field, slope, "a slope of the set, rad")
    nearest = int(np.argmin(np.abs(slopes - slope)))
    # Degrees converted in another way may differ in the last digits.
    if abs(slopes[nearest] - slope) > 1e-12:
        raise InputError(
            field, slope, f"a slope of the set; the nearest is {slopes[nearest]:.6g} rad"
        )
    return nearest


@kernel
def _moments(states, deviation, largest):
    """Standard deviation, and largest magnitude, of each dimension."""
    n, size = states.shape
    mean = np.zeros(size)
    largest[:] = 0.0
    deviation[:] = 0.0
    # Taken from the first state, a constant dimension is exactly 0 and a narrow one loses nothing.
    for i in range(n):
        for d in range(size):
            mean[d] += states[i, d] - states[0, d]
            largest[d] = max(largest[d], abs(states[i, d]))
    for d in range(size):
        mean[d] /= n
    for i in range(n):
        for d in range(size):
            difference = states[i, d] - states[0, d] - mean[d]
            deviation[d] += difference * difference
    for d in range(size):
        deviation[d] = np.sqrt(deviation[d] / n)


def _spread(states: np.ndarray) -> np.ndarray:
    """Standard deviation of each dimension, exactly 0 where it is rounding only; shape (10,)."""
    if len(states) == 0:
        return np.zeros(STATE_SIZE)
    deviation, largest = np.empty((2, STATE_SIZE))
    _moments(states, deviation, largest)
    return np.where(deviation > _ROUNDING * np.maximum(largest, 1.0), deviation, 0.0)


def _scales(spread: np.ndarray, successors: np.ndarray) -> np.ndarray:
    """Scales r_i of eq. (25) by the rules at the top of this file; shape (10,)."""
    if not spread.all():
        spread = np.where(spread > 0.0, spread, _spread(successors))
    return np.where(spread > 0.0, spread, np.inf)


def _check_steps(steps: Steps, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    outcomes = checked_array("outcomes", steps.outcomes, np.uint8, (n, m))
    succeeded = int(np.count_nonzero(outcomes == _STEP))
    successors = checked_array(
        "next_states", steps.next_states, np.float64, (succeeded, STATE_SIZE)
    )
    _check_finite("next_states", successors, "finite states after every step that succeeded")
    if (outcomes == NOT_SIMULATED).any():
        raise InputError("outcomes", NOT_SIMULATED, "outcome codes of steps")
    return outcomes, successors


class MeshGrowth:
    """A mesh that grows as answers come, in any order and in pieces of any size.

    States have indices in the order in which they were found: 0 is the failure state, 1 is x_2.
    Those up to `known` can be simulated at any time. Each answer is tested as soon as all states
    before it have been, and what it adds is known at once: so the states of the next generation
    can be simulated before the tests of this one are through. Only their own tests have to wait,
    for the scales r_i. (The tests of a generation wait for all its answers where a dimension has
    no spread yet, and with ``scale_refresh="addition"``.)

    Parameters
    ----------
    initial_state, slopes, threshold, initial_slope, clustered, scale_refresh, max_states
        As for `grow_mesh`.
    answers : Answers, optional
        Where to keep the answers, and maybe those of an equal mesh that was not finished; in
        memory by default.

    Raises
    ------
    InputError
        If an argument is not allowed.
    MeshLimitError
        If the answers that are there lead to more than ``max_states`` states.
    """

    def __init__(
        self,
        initial_state: ArrayLike,
        slopes: ArrayLike,
        threshold: float,
        *,
        initial_slope: float = 0.0,
        clustered: bool = True,
        scale_refresh: str = "generation",
        max_states: int = DEFAULT_MAX_STATES,
        answers: Answers | None = None,
    ) -> None:
        self._slopes = check_slopes(slopes)
        first = checked_array("initial_state", initial_state, np.float64, (STATE_SIZE,))
        _check_finite("initial_state", first)
        self._threshold = _check_threshold(threshold)
        if scale_refresh not in SCALE_REFRESHES:
            raise InputError("scale_refresh", scale_refresh, " or ".join(SCALE_REFRESHES))
        self._each_addition = scale_refresh == "addition"
        self._max_states = _check_max_states(max_states)
        self._clustered = clustered
        m = len(self._slopes)
        slope_index = np.array([_slope_index(self._slopes, initial_slope, "initial_slope")])
        self._preceding = np.concatenate([[0], slope_index]).astype(np.uint32)
        self._found = StateSet(m if clustered else 1, self._max_states)
        self._found.extend(
            first[np.newaxis], self._clusters(self._preceding[1:]), np.ones(STATE_SIZE), threshold
        )
        self._answers: Answers = AnswersInMemory() if answers is None else answers
        self._answered = sum(self._answers.rows(start) for start in self._answers)
        self._resumed = self._answered
        self._tested = 1
        self._starts = [1, 2]
        self._scales: np.ndarray | None = None
        self._advance()

    @property
    def resumed(self) -> int:
        """Number of states whose answers were there from the beginning."""
        return self._resumed

    @property
    def known(self) -> int:
        """Number of states so far, the failure state counted."""
        return len(self._found)

    @property
    def tested(self) -> int:
        """Number of states of which all successors have been tested, the failure state counted."""
        return self._tested

    @property
    def generations(self) -> int:
        """Number of generations of which all states are known; x_2 is the first."""
        return len(self._starts) - 1

    @property
    def complete(self) -> bool:
        """Whether all states have been tested."""
        return self._tested == self.known

    def generation(self, number: int) -> tuple[int, np.ndarray, np.ndarray]:
        """A generation of which all states are known: index of the first, and as `states`."""
        start, stop = self._starts[number : number + 2]
        return start, self._found.states[start:stop].copy(), self._preceding[start:stop].copy()

    def unanswered(self, start: int, most: int) -> tuple[int, int]:
        """The first range of at most that many states from ``start`` on that have no answer.

        Only answers that were there from the beginning are skipped: who calls this knows of the
        others.
        """
        stop = min(start + most, self.known)
        if self._resumed:
            while start in self._answers:
                start += self._answers.rows(start)
            stop = min(start + most, self.known)
            stop = next((i for i in range(start + 1, stop) if i in self._answers), stop)
        return start, max(start, stop)

    def states(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """States to simulate, shape (n, 10), and the slopes behind them in rad, shape (n,)."""
        return (
            self._found.states[start:stop].copy(),
            self._slopes[self._preceding[start:stop]],
        )

    def take(self, start: int, steps: Steps, n: int) -> None:
        """Take the answer for n states from index ``start`` on, none of which had one before.

        Raises
        ------
        InputError
            If the answer is not allowed.
        MeshLimitError
            If the mesh would hold more than ``max_states`` states.
        """
        outcomes, successors = _check_steps(steps, n, len(self._slopes))
        # A piece belongs to one generation, as far as that is known.
        end = self._starts[-1]
        if start < end < start + n:
            reached = int(np.count_nonzero(outcomes[: end - start] == _STEP))
            self._answers.put(start, outcomes[: end - start], successors[:reached])
            start, outcomes, successors = end, outcomes[end - start :], successors[reached:]
        self._answers.put(start, outcomes, successors)
        self._answered += n
        self._advance()

    def _clusters(self, slope_indices: np.ndarray) -> np.ndarray:
        return slope_indices if self._clustered else np.zeros_like(slope_indices)

    def _advance(self) -> None:
        """Test all answers that can be tested."""
        while True:
            end = self._starts[-1]
            if self._tested == end:
                if self.known == end:
                    return
                self._starts.append(self.known)
                self._scales = None
                continue
            if self._scales is None and not self._refresh(end):
                return
            if self._each_addition:
                tried, reached = zip(*self._pieces(self._tested, end), strict=True)
                self._test(np.concatenate(tried), np.concatenate(reached))
            elif self._tested in self._answers:
                self._test(*self._answers.get(self._tested))
            else:
                return

    def _refresh(self, end: int) -> bool:
        """Refresh the scales at the start of a generation; False if answers are missing for it."""
        spread = _spread(self._found.states[1:end])
        reached = np.empty((0, STATE_SIZE))
        if self._each_addition or not spread.all():
            if self._answered < end - 1:
                return False
            reached = np.concatenate([piece[1] for piece in self._pieces(self._tested, end)])
        self._scales = _scales(spread, reached)
        return True

    def _pieces(self, start: int, stop: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Answers for a range of states, in the order of the states."""
        while start < stop:
            yield self._answers.get(start)
            start += self._answers.rows(start)

    def _test(self, outcomes: np.ndarray, successors: np.ndarray) -> None:
        """Test the successors of the next states."""
        assert self._scales is not None
        slope_indices = _slope_indices(np.flatnonzero(outcomes == _STEP), outcomes.shape[1])
        clusters = self._clusters(slope_indices)
        self._tested += len(outcomes)
        before = self.known
        if self._each_addition:
            added, complete = additions(
                self._found.states[1:], self._clusters(self._preceding[1:before]),
                successors, clusters,
                _spread(successors), self._threshold, _ROUNDING, self._max_states - 1,
            )  # fmt: skip
            # Known to be new, whatever the scales: none of them lies at a distance of 0.
            self._found.extend(successors[added], clusters[added], self._scales, 0.0)
        else:
            added, complete = self._found.extend(
                successors, clusters, self._scales, self._threshold
            )
        if not complete:
            raise MeshLimitError(
                self._max_states, self.generations, self._tested - 1, self._threshold
            )
        if self.known > len(self._preceding):
            room = np.zeros(max(256, self.known), dtype=np.uint32)
            self._preceding = np.concatenate([self._preceding, room])
        self._preceding[before : self.known] = slope_indices[added]

    def mesh(self) -> Mesh:
        """The mesh, once it is complete."""
        n, m, scales = self.known, len(self._slopes), self._scales
        assert self.complete
        assert scales is not None
        targets = np.zeros((n, m), dtype=np.uint32)
        outcomes = np.full((n, m), NOT_SIMULATED, np.uint8)

        def fill(start: int) -> None:
            tried, reached = self._answers.get(start)
            outcomes[start : start + len(tried)] = tried
            steps = np.flatnonzero(tried == _STEP)
            targets.reshape(-1)[start * m + steps] = self._found.nearest(
                reached, self._clusters(_slope_indices(steps, m)), scales
            )

        # The targets of one piece are independent of all others. The last test has left the grids
        # for these scales, so that threads only read them.
        starts = [1]
        while (end := starts[-1] + self._answers.rows(starts[-1])) < n:
            starts.append(end)
        with ThreadPoolExecutor((os.cpu_count() or 1) if n >= _WORTH_THREADS else 1) as pool:
            for _ in pool.map(fill, starts):
                pass
        generation = np.repeat(
            np.arange(self.generations, dtype=np.uint32), np.diff([0, *self._starts[1:]])
        )
        return Mesh(
            slopes=self._slopes,
            states=self._found.states.copy(),
            preceding=self._preceding[:n].copy(),
            generation=generation,
            targets=targets,
            outcomes=outcomes,
            scales=scales,
            threshold=self._threshold,
            clustered=self._clustered,
        )


def grow_mesh(
    simulate: Simulate,
    initial_state: ArrayLike,
    slopes: ArrayLike,
    threshold: float,
    *,
    initial_slope: float = 0.0,
    clustered: bool = True,
    scale_refresh: str = "generation",
    max_states: int = DEFAULT_MAX_STATES,
    on_generation: OnGeneration | None = None,
) -> Mesh:
    """Mesh the states that a controller can reach (Algorithm 1).

    Parameters
    ----------
    simulate : callable
        ``simulate(states, previous_slopes)`` takes one generation, float64 of shape (n, 10) and
        rad of shape (n,), and returns an object with ``outcomes`` and ``next_states`` as in
        `Steps`. The answer for a state must not depend on the states beside it.
    initial_state : array_like
        x_2, a state in the basin of attraction: q1..q5 (rad), dq1..dq5 (rad/s), shape (10,).
    slopes : array_like
        S of eq. (24), rad, strictly ascending, shape (m,).
    threshold : float
        d_thr, dimensionless, above 0: a state is new if eq. (25) gives more than this.
    initial_slope : float, optional
        Slope that precedes x_2, rad, one of `slopes`.
    clustered : bool, optional
        Take distances only to states of the same preceding slope (default), or to all states. A
        successor without any state in its cluster is always new.
    scale_refresh : str, optional
        "generation" (default): r_i of eq. (25) stays the same while a generation is tested.
        "addition": it is that of all states so far, for each state tested; for meshes of up to
        some thousand states.
    max_states : int, optional
        Most states, the failure state counted.
    on_generation : callable, optional
        Called as ``on_generation(generation, first_index, states, preceding)`` whenever states
        have been added: x_2 as generation 0 with index 1, then those that each generation added,
        shapes (k, 10) and (k,), indices ascending from `first_index`. An exception from here or
        from `simulate` ends the growth and is passed on.

    Returns
    -------
    Mesh
        The same, bit for bit, whenever `simulate` gives the same answers.

    Raises
    ------
    InputError
        If an argument, or an answer of `simulate`, is not allowed.
    MeshLimitError
        If the mesh would hold more than `max_states` states.
    """
    growth = MeshGrowth(
        initial_state,
        slopes,
        threshold,
        initial_slope=initial_slope,
        clustered=clustered,
        scale_refresh=scale_refresh,
        max_states=max_states,
    )
    generation = 0
    while not growth.complete:
        if on_generation is not None and growth.generations > generation:
            on_generation(generation, *growth.generation(generation))
            generation += 1
        start, stop = growth.tested, growth.known
        growth.take(start, simulate(*growth.states(start, stop)), stop - start)
    return growth.mesh()


def _slope_indices(steps: np.ndarray, m: int) -> np.ndarray:
    """Index of the slope of each step, given its position among those of rows of m; uint32."""
    return (steps % m).astype(np.uint32)
