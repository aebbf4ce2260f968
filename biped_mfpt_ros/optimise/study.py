"""Running a study: generation by generation, its trials side by side, from a store.

A searcher is a function of what it was told, and the store keeps all of that: a study that was
stopped, however, is taken up by telling a new searcher what is in the store. Several processes,
each with a searcher of its own, may work on the same study. The trials are the same, whoever and
how many they are: they depend on the settings alone.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any

from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.optimise.scoring import (
    Backend,
    BackendLost,
    Best,
    Evaluation,
    Stopped,
    evaluate,
    front_of,
    utilities,
)
from biped_mfpt_ros.optimise.searchers import Told, make_searcher
from biped_mfpt_ros.optimise.settings import StudySettings
from biped_mfpt_ros.optimise.space import SearchSpace
from biped_mfpt_ros.optimise.store import Store, Trial, this_owner

_BEAT = 5.0  # s, between two signs of life
_MOST_LOST = 5  # trials lost in a row with the backend, before the study ends
_LOOK = 0.2  # s, between two looks for what other processes have finished


class Study:
    """A study of a store, and a searcher that has been told what is known.

    Parameters
    ----------
    store : Store
        Where it is kept.
    name : str
        Of the study.
    settings : StudySettings, optional
        Of a new study, or equal to those it has; those that it has by default.
    owner : str, optional
        Under which name trials are claimed, of the form of `this_owner`; that of this process by
        default.

    Attributes
    ----------
    settings : StudySettings
        Its settings.
    space : SearchSpace
        Its space.
    """

    def __init__(
        self,
        store: Store,
        name: str,
        settings: StudySettings | None = None,
        owner: str | None = None,
    ) -> None:
        self.store, self.name = store, name
        self.settings = settings or store.open(name)[1]
        self.space = SearchSpace(
            self.settings.start, self.settings.model.robot, self.settings.fixed
        )
        self.owner = owner or this_owner()
        self._searcher = make_searcher(
            self.settings.searcher,
            self.space.bounds,
            seed=self.settings.seed,
            step=self.settings.step,
            population=self.settings.population,
            runs=self.settings.run_count,
            objectives=len(self.settings.objectives),
            candidates=self.settings.candidates,
        )
        # What is wrong with the settings has been found before anything is written.
        self._id = store.open(name)[0] if settings is None else store.create(name, settings)
        self._lock = threading.Condition()
        self._told = 0  # generations
        self._runs = [1]  # of which run each of these is, and the one that is open
        self._first = 0  # number of the first trial of the generation that is open
        self._best = Best()

    def controller(self, trial: Trial) -> Controller:
        """What a trial tries; InputError if there is no such controller."""
        return self.space.controller(trial.vector, f"{self.settings.start.scheme}/{self.name}-"
                                     f"{trial.number}")  # fmt: skip

    def trials(self) -> list[Trial]:
        """All trials by now, in order."""
        return self.store.trials(self._id)

    def run_of(self, generation: int) -> int:
        """Of which run of the search a generation is, from 1; the start is of the first."""
        with self._lock:
            if generation >= len(self._runs):
                self._catch_up()
            return self._runs[generation]

    def runs_left(self) -> list[int]:
        """Runs of the search that have not ended."""
        with self._lock:
            self._catch_up()
            return self._searcher.runs_left

    def run(
        self,
        backend: Backend,
        workers: int = 1,
        trials: int | None = None,
        seconds: float | None = None,
        on_trial: Callable[[Trial], None] | None = None,
        stop: threading.Event | None = None,
    ) -> str:
        """Work on the study.

        Parameters
        ----------
        backend : Backend
            Who grows meshes.
        workers : int, optional
            Trials at the same time, each in a thread; >= 1.
        trials : int, optional
            Until the study has so many.
        seconds : float, optional
            s, after which no further trial is begun.
        on_trial : callable, optional
            Told of each trial that was finished here, one at a time.
        stop : threading.Event, optional
            Set to stop at once; trials in flight are given back.

        Returns
        -------
        str
            Why it ended: ``trials``, ``seconds``, ``converged`` or ``stopped``.

        Raises
        ------
        InputError
            If there are no workers.
        BackendLost
            If the backend is lost again and again. The trials are given back.
        """
        if workers < 1:
            raise InputError("workers", workers, ">= 1")
        stop = stop or threading.Event()
        ended = threading.Event()
        deadline = math.inf if seconds is None else time.monotonic() + seconds
        limit = 2**62 if trials is None else trials
        errors: list[BaseException] = []
        reasons: list[str] = []
        lost = [0]

        def work() -> None:
            try:
                while not stop.is_set():
                    if time.monotonic() > deadline:
                        reasons.append("seconds")
                        return
                    trial = self._next(limit)
                    if isinstance(trial, str):
                        reasons.append(trial)
                        return
                    if trial is None:
                        with self._lock:
                            self._lock.wait(_LOOK)
                        continue
                    try:
                        self._try(trial, backend, stop, on_trial)
                        lost[0] = 0
                    except BackendLost:
                        # It is tried again, unless that goes wrong again and again.
                        self.store.release(self._id, self.owner, trial.number)
                        lost[0] += 1
                        if lost[0] >= _MOST_LOST:
                            raise
            except Stopped:
                pass
            except BaseException as error:
                errors.append(error)
                stop.set()

        def beat() -> None:
            while not ended.wait(_BEAT):
                self.store.beat(self.owner)

        beating = threading.Thread(target=beat, daemon=True)
        beating.start()
        try:
            with ThreadPoolExecutor(workers, "trial") as pool:
                try:
                    jobs = [pool.submit(work) for _ in range(workers)]
                    # A signal that comes just before a wait, or to another thread, does not end it,
                    # and its handler has to wait, too: without a timeout, for the whole study.
                    while wait(jobs, _LOOK).not_done:
                        pass
                    for job in jobs:
                        job.result()
                except BaseException:
                    stop.set()
                    raise
        finally:
            ended.set()
            beating.join()
            self.store.release(self._id, self.owner)
        if errors:
            raise errors[0]
        return "stopped" if stop.is_set() or not reasons else reasons[0]

    def close(self) -> None:
        """End the searcher."""
        self._searcher.close()

    def _next(self, limit: int) -> Trial | str | None:
        """A trial, why there is none any more, or None: wait for others."""
        with self._lock:
            while True:
                trial = self.store.claim(self._id, self.owner, limit)
                if trial is not None:
                    # It belongs to a generation that another process may have opened.
                    self._catch_up()
                    return trial
                self._catch_up()
                proposed, done = self.store.counts(self._id)
                if proposed >= limit:
                    if self._done_below(limit):
                        return "trials"
                    return None
                if proposed > done:
                    return None
                if self._searcher.done:
                    return "converged"
                self.store.propose(self._id, self._told, self._first, self._searcher.ask())

    def _done_below(self, limit: int) -> bool:
        return all(
            trial.status == "done"
            for trial in self.store.trials(self._id, self._told)
            if trial.number < limit
        )

    def _catch_up(self) -> None:
        """Tell the searcher every generation that is complete."""
        while True:
            generation = self.store.trials(self._id, self._told)
            if not generation or any(trial.found is None for trial in generation):
                return
            vectors = self._searcher.ask()
            if [t.vector.tobytes() for t in generation] != [v.tobytes() for v in vectors]:
                raise RuntimeError(
                    f"generation {self._told} of study {self.name} was proposed by another "
                    "version of the searcher; begin a new study"
                )
            found = [trial.found for trial in generation if trial.found is not None]
            self._searcher.tell(vectors, [Told(e.score, e.costs, e.violation) for e in found])
            self._best = improved(self._best, found)
            self._told += 1
            self._runs.append(self._searcher.run)
            self._first += len(generation)
            self._lock.notify_all()

    def _try(
        self,
        trial: Trial,
        backend: Backend,
        stop: threading.Event,
        on_trial: Callable[[Trial], None] | None,
    ) -> None:
        """Score a trial and keep what comes out."""
        with self._lock:
            best = self._best
        found = evaluate(lambda: self.controller(trial), self.settings, best, backend, stop.is_set)
        kept = self.store.finish(self._id, trial.number, self.owner, found, STEP_MAP)
        with self._lock:
            self._lock.notify_all()
            if kept and on_trial is not None:
                on_trial(replace(trial, status="done", found=found, finished=time.time(),
                                 step_map=STEP_MAP))  # fmt: skip


def best_trial(trials: list[Trial]) -> Trial | None:
    """The confirmed trial with the best score, the first of equals; None if there is none."""
    best: Trial | None = None
    for trial in trials:
        if trial.found is None or not trial.found.confirmed:
            continue
        if best is None or best.found is None or trial.found.score > best.found.score:
            best = trial
    return best


def confirming(study: Study, **changed: Any) -> StudySettings:
    """Settings of a study that tries the front of another one again, most steps first.

    The front: confirmed trials that no other one beats, or equals, in MFPT, cost of transport and
    every other objective.

    Parameters
    ----------
    study : Study
        Whose front, start and space; the rest of its settings too, but for what is changed.
    **changed
        Fields of `StudySettings`, such as finer ``stages``.

    Raises
    ------
    InputError
        If nothing is confirmed by a mesh.
    """
    names = dict.fromkeys(("mfpt", "cot", *study.settings.objectives))
    found: dict[tuple[float, ...], tuple[float, ...]] = {}
    for trial in study.trials():
        if trial.found is not None and trial.found.confirmed and "mfpt" in trial.found.values:
            costs = tuple(-u for u in utilities(names, trial.found.values))
            found.setdefault(costs, tuple(trial.vector.tolist()))
    if not found:
        raise InputError("study", study.name, "one with a trial that a mesh has confirmed")
    ordered = sorted(found)
    candidates = tuple(found[ordered[i]] for i in front_of(ordered))
    return replace(study.settings, searcher="given", runs=0, candidates=candidates, **changed)


def improved(best: Best, found: list[Evaluation]) -> Best:
    """The best confirmed scores, those of another generation taken in."""
    confirmed = [e for e in found if e.confirmed]
    score = max([best.score, *(e.score for e in confirmed)])
    costs = [*best.front, *(e.costs for e in confirmed)]
    return Best(score, tuple(costs[i] for i in front_of(costs)))
