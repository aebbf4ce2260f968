"""Searchers behind one interface: ask for candidates, tell their scores.

A searcher is a deterministic function of its settings, its seed and what it was told: told the
same history, another process asks for the same candidates, bit for bit. A generation is asked for
as a whole and told as a whole. The first one is the start alone, but for `Given`.

Scores are to be maximised. Only their order matters, but for `Nsga2`, which sees objectives and
violations instead.
"""

from __future__ import annotations

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from biped_mfpt_ros.arrays import numbers
from biped_mfpt_ros.errors import InputError


@dataclass(frozen=True)
class Told:
    """What a searcher is told of a candidate.

    Attributes
    ----------
    score : float
        To be maximised, finite.
    costs : tuple of float
        One for each objective, to be minimised; only where ``violation`` is 0.
    violation : float
        0 if it walks and holds every constraint, above 0 the further it is from that.
    """

    score: float
    costs: tuple[float, ...]
    violation: float


class Searcher(ABC):
    """A search method.

    Parameters
    ----------
    bounds : numpy.ndarray
        Of the coordinates, shape (n, 2); the start is 0, and 1 a sensible step.
    seed : int
        Of all that is random.
    step : float
        First step, in scaled coordinates.
    population : int
        Candidates in a generation, if the method has a choice; 0: its default.
    runs : int
        How many runs `CmaEs` begins with.
    objectives : int
        How many costs are told.
    candidates : sequence of sequence of float
        What `Given` has tried, shape (k, n).

    Attributes
    ----------
    runs_left : list of int
        Runs that have not ended.
    """

    done = False
    """Whether the search has converged: there is nothing more to ask."""
    run = 1
    """Of which run the next generation is, from 1."""

    def __init__(
        self,
        bounds: np.ndarray,
        seed: int = 0,
        step: float = 1.0,
        population: int = 0,
        runs: int = 1,
        objectives: int = 1,
        candidates: Sequence[Sequence[float]] = (),
    ) -> None:
        self.bounds = np.asarray(bounds, dtype=np.float64)
        self.n = len(self.bounds)
        self.seed, self.step, self.population, self.runs = seed, step, population, runs
        self.runs_left = list(range(1, runs + 1))
        self.objectives = objectives
        self.candidates = candidates
        self._started = False
        self._asked_for: np.ndarray | None = None

    def ask(self) -> np.ndarray:
        """The next generation, shape (k, n); the same until it is told."""
        if self._asked_for is None:
            self._asked_for = self._ask() if self._started else self._first()
        return self._asked_for

    def tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        """What became of a generation, in the order in which it was asked for."""
        self._asked_for = None
        if self._started:
            self._tell(vectors, told)
        else:
            self._started = True
            self._begin(told[0])

    def close(self) -> None:  # noqa: B027 - most searchers have nothing to end
        """End what runs in the background."""

    def _first(self) -> np.ndarray:
        return np.zeros((1, self.n))

    @abstractmethod
    def _begin(self, start: Told) -> None: ...

    @abstractmethod
    def _ask(self) -> np.ndarray: ...

    @abstractmethod
    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None: ...

    def _inside(self, vectors: np.ndarray) -> np.ndarray:
        return np.clip(vectors, self.bounds[:, 0], self.bounds[:, 1])


class CmaEs(Searcher):
    """CMA-ES (Hansen), of the package `cmaes`: runs from the same start, of which the best go on.

    The runs take turns, a generation each. After `HEAT` generations of each the worse half of them
    ends, until one is left, which goes on without end: where a run leads is a matter of luck, and
    what it is worth shows long before it has got there. A run that has converged is restarted from
    its best with twice the population.
    """

    HEAT = 18

    def _begin(self, start: Told) -> None:
        self._left = [_CmaRun(self, 1 + i, start.score) for i in range(self.runs)]
        self._turn = 0  # generations of this heat

    def _ask(self) -> np.ndarray:
        return self._left[self._turn % len(self._left)].ask()

    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        self._left[self._turn % len(self._left)].tell(vectors, told)
        self._turn += 1
        if self._turn == self.HEAT * len(self._left):
            self._turn = 0
            best = sorted(self._left, key=lambda run: -run.best_score)
            best = best[: (len(best) + 1) // 2]
            self._left = [run for run in self._left if run in best]
            self.runs_left = [run.number for run in self._left]
        self.run = self._left[self._turn % len(self._left)].number


class _CmaRun:
    """One run of `CmaEs`."""

    def __init__(self, of: CmaEs, number: int, start_score: float) -> None:
        self._of, self.number = of, number
        self._best, self.best_score = np.zeros(of.n), start_score
        self._restarts = 0
        self._restart()

    def _restart(self) -> None:
        from cmaes import CMA

        of = self._of
        size = of.population or 2 * ((4 + int(3 * np.log(of.n)) + 1) // 2)
        words = [of.seed, self._restarts, self.number - 1]
        self._cma = CMA(
            mean=self._best.copy(),
            sigma=of.step,
            bounds=of.bounds,
            seed=int(np.random.SeedSequence(words).generate_state(1)[0]),
            population_size=size * 2**self._restarts,  # IPOP
        )

    def ask(self) -> np.ndarray:
        return np.array([self._cma.ask() for _ in range(self._cma.population_size)])

    def tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        self._cma.tell([(x, -one.score) for x, one in zip(vectors, told, strict=True)])
        best = max(range(len(told)), key=lambda i: told[i].score)
        if told[best].score > self.best_score:
            self._best, self.best_score = vectors[best].copy(), told[best].score
        if self._cma.should_stop():
            self._restarts += 1
            self._restart()


class PatternSearch(Searcher):
    """Pattern search as MATLAB's default: polls 2 n points, the mesh doubles or is halved.

    Generalised pattern search with the positive basis +-e_i and complete polls, so that all points
    of a poll can be tried side by side. Written here, since it is ten lines: pymoo's is another
    one (Hooke and Jeeves), tries one point at a time, and draws from the system's entropy.
    """

    _SMALLEST = 1e-4

    def _begin(self, start: Told) -> None:
        self._centre, self._score, self._size = np.zeros(self.n), start.score, self.step

    def _ask(self) -> np.ndarray:
        basis = np.concatenate([np.eye(self.n), -np.eye(self.n)])
        return self._inside(self._centre + self._size * basis)

    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        best = max(range(len(told)), key=lambda i: told[i].score)
        if told[best].score > self._score:
            self._centre, self._score = vectors[best].copy(), told[best].score
            self._size *= 2.0
        else:
            self._size *= 0.5
        self.done = self._size < self._SMALLEST * self.step


class NelderMead(Searcher):
    """Nelder and Mead's simplex as in scipy, whose rules are those of MATLAB's fminsearch.

    The simplex starts with one step along each coordinate: that generation can be tried side by
    side, the following ones are single candidates. scipy's function asks, so it runs in a thread
    that waits for each value.
    """

    def _begin(self, start: Told) -> None:
        self._values = {np.zeros(self.n).tobytes(): -start.score}
        self._simplex: np.ndarray | None = self._inside(
            np.concatenate([np.zeros((1, self.n)), self.step * np.eye(self.n)])
        )
        self._asked: queue.Queue[np.ndarray | None] = queue.Queue()
        self._answers: queue.Queue[float | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._next_point: np.ndarray | None = None

    def _ask(self) -> np.ndarray:
        if self._thread is None:
            assert self._simplex is not None
            return self._simplex[1:]
        assert self._next_point is not None
        return self._next_point[np.newaxis]

    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        if self._thread is None:
            for x, one in zip(vectors, told, strict=True):
                self._values[x.tobytes()] = -one.score
            self._thread = threading.Thread(target=self._minimise, daemon=True)
            self._thread.start()
        else:
            self._answers.put(-told[0].score)
        self._next_point = self._asked.get()
        self.done = self._next_point is None

    def _minimise(self) -> None:
        from scipy.optimize import minimize

        class Closed(Exception):
            pass

        def value(x: np.ndarray) -> float:
            known = self._values.pop(x.tobytes(), None)
            if known is not None:
                return known
            self._asked.put(x.copy())
            answer = self._answers.get()
            if answer is None:
                raise Closed
            return answer

        try:
            assert self._simplex is not None
            minimize(
                value,
                self._simplex[0],
                method="Nelder-Mead",
                bounds=self.bounds,
                options={
                    "initial_simplex": self._simplex,
                    "xatol": 1e-4 * self.step,
                    "fatol": 1e-6,
                    "maxfev": 10**9,
                    "maxiter": 10**9,
                },
            )
        except Closed:
            pass
        self._asked.put(None)

    def close(self) -> None:
        """End the thread."""
        if self._started and self._thread is not None and not self.done:
            self._answers.put(None)
            self._thread.join()


class Nsga2(Searcher):
    """NSGA-II (Deb) of pymoo: a Pareto front of several objectives under constraints."""

    def _begin(self, start: Told) -> None:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        size = self.population or 4 * ((self.n + 3) // 4)
        rng = np.random.default_rng([self.seed, 0])
        first = self._inside(self.step * rng.standard_normal((size, self.n)))
        first[0] = 0.0  # the start takes part
        self._algorithm = NSGA2(pop_size=size, sampling=first)
        problem = Problem(
            n_var=self.n,
            n_obj=self.objectives,
            n_ieq_constr=1,
            # pymoo's operators take the bounds for the scale of the problem.
            xl=np.maximum(self.bounds[:, 0], -20.0 * self.step),
            xu=np.minimum(self.bounds[:, 1], 20.0 * self.step),
        )
        self._algorithm.setup(problem, termination=NoTermination(), seed=self.seed, verbose=False)
        self._population: Any = None

    def _ask(self) -> np.ndarray:
        self._population = self._algorithm.ask()
        return np.array(self._population.get("X"), dtype=np.float64)

    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        for individual, one in zip(self._population, told, strict=True):
            individual.F = np.array(one.costs if one.violation == 0.0 else [0.0] * self.objectives)
            individual.G = np.array([one.violation])
            individual.H = np.zeros(0)
            individual.evaluated.update("FGH")
        self._algorithm.tell(infills=self._population)


class Given(Searcher):
    """No search: the candidates of another study, all in one generation, and nothing after it."""

    def __init__(self, bounds: np.ndarray, **settings: Any) -> None:
        super().__init__(bounds, **settings)
        vectors, allowed = [], f"{self.n} finite numbers"
        for i, candidate in enumerate(self.candidates):
            vector = numbers(candidate, f"candidates[{i}]", allowed)
            if vector.shape != (self.n,) or not np.isfinite(vector).all():
                raise InputError(f"candidates[{i}]", vector.tolist(), allowed)
            vectors.append(vector)
        self._vectors = np.array(vectors, dtype=np.float64)

    def _first(self) -> np.ndarray:
        return self._vectors

    def _begin(self, start: Told) -> None:
        self.done = True

    def _ask(self) -> np.ndarray:
        raise AssertionError("it is done")

    def _tell(self, vectors: np.ndarray, told: list[Told]) -> None:
        raise AssertionError("it is done")


SEARCHERS: dict[str, type[Searcher]] = {
    "cma-es": CmaEs,
    "nelder-mead": NelderMead,
    "pattern": PatternSearch,
    "nsga2": Nsga2,
    "given": Given,
}
"""Every searcher by its name."""


def make_searcher(name: str, bounds: np.ndarray, **settings: Any) -> Searcher:
    """Searcher of a name; raises InputError if there is none."""
    if name not in SEARCHERS:
        raise InputError("searcher", name, "one of " + ", ".join(SEARCHERS))
    return SEARCHERS[name](bounds, **settings)
