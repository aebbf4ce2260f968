"""`biped-mfpt optimise`: search for better controllers."""

from __future__ import annotations

import argparse
import math
import os
import re
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from biped_mfpt_ros.cli import options
from biped_mfpt_ros.cli.kernels import compile_all, work
from biped_mfpt_ros.cli.node import require_ros
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.cli.study import add_to_run, run_rows, score_text, summary_text, trial_row
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.optimise.local import LocalBackend
from biped_mfpt_ros.optimise.settings import DEFAULT_STAGES, Stage, StudySettings
from biped_mfpt_ros.optimise.store import Store, Trial
from biped_mfpt_ros.optimise.study import Study, best_trial, confirming
from biped_mfpt_ros.report.progress import Progress, duration_text, rate_text
from biped_mfpt_ros.report.tables import number, plural


def optimise(args: argparse.Namespace) -> None:
    """Run a study, or go on with one."""
    store: Store | None = None
    if args.confirm is None:
        settings = _settings(args)
        name = args.study or "-".join(
            [re.sub(r"\W", "-", settings.start.name, flags=re.ASCII), settings.searcher,
             f"{args.sigma:g}", str(settings.seed)]
        )  # fmt: skip
    else:
        store = Store(Path(args.store))
        try:
            other = Study(store, args.confirm)
        except InputError as error:
            raise InputError("--confirm", error.value, error.allowed) from None
        model = replace(other.settings.model, tolerance=options.model_of(args).tolerance)
        settings = confirming(other, model=model, **_scoring(args))
        name = args.study or f"{args.confirm}-confirmed"
    workers = len(os.sched_getaffinity(0)) if args.workers is None else args.workers
    for option, value, least in (("--workers", workers, 1), ("--trials", args.trials, 1)):
        if value is not None and value < least:
            raise InputError(option, value, f"a whole number >= {least}")
    if not args.local:
        require_ros()
    store = store or Store(Path(args.store))
    study = Study(store, name, settings)
    with work(args.quiet) as progress:
        tally = _Tally(study, progress, workers, args.trials, args.seconds)
        progress.say(
            f"study {name} in {args.store}: {plural(len(study.space), 'free parameter')}, "
            f"{plural(len(tally.before), 'trial')} so far"
        )
        try:
            if args.local:
                ended = _locally(study, workers, args, tally)
            else:
                compile_all(progress.say)
                ended = _over_ros(study, workers, args, tally, progress)
        except KeyboardInterrupt:
            progress.say(f"stopped; the same command goes on with study {name}")
            raise
    study.close()
    trials = study.trials()
    result = {
        "study": name,
        "store": args.store,
        "settings": settings.as_json(),
        "ended": ended,
        "trials": sum(t.found is not None for t in trials),
        "runs": run_rows(study, trials),
        **tally.throughput(),
    }
    best = best_trial(trials)
    result["best"] = None if best is None else trial_row(study, best)
    text = summary_text(study, trials)
    store.close()
    if args.json:
        print(json_text(result))
        return
    print(text)
    print(
        f"\n{plural(tally.done, 'trial')} in {duration_text(tally.seconds)}, "
        f"{rate_text(result['trials_per_second'])} a second; "
        f"{100.0 * result['outside_step_map']:.0f} % of the time of "
        f"{plural(workers, 'worker')} was spent outside of the step map"
    )


def _locally(study: Study, workers: int, args: argparse.Namespace, tally: _Tally) -> str:
    def on_trial(trial: Trial) -> None:
        assert trial.found is not None
        found = trial.found
        tally.add(
            trial.number, trial.generation, found.score, found.confirmed, found.values,
            found.step_map_seconds,
        )  # fmt: skip

    return study.run(LocalBackend(), workers, args.trials, args.seconds, on_trial)


def _over_ros(
    study: Study, workers: int, args: argparse.Namespace, tally: _Tally, progress: Progress
) -> str:
    if study.settings.searcher == "cma-es":
        import cmaes  # noqa: F401 - later it would take a second, in which feedback got lost

    from biped_mfpt_ros.cli.optimise_pipeline import run_study

    def on_trial(trial: Any) -> None:
        values = dict(zip(trial.measures, trial.measured, strict=True))
        tally.add(
            trial.trial, trial.generation, trial.score, trial.confirmed, values,
            trial.step_map_seconds,
        )  # fmt: skip

    return run_study(
        study.name, study.settings, Path(args.store), workers, args.trials, args.seconds,
        args.record, progress, tally.begin, on_trial,
    )  # fmt: skip


def _scoring(args: argparse.Namespace) -> dict[str, Any]:
    """How trials are scored: all that a study that confirms another one has of its own."""
    stages: tuple[Stage, ...] = DEFAULT_STAGES
    if args.mesh is not None:
        stages = tuple(_stage(i, parts) for i, parts in enumerate(args.mesh))
    if args.check_walks < 0:
        raise InputError("--check-walks", args.check_walks, "a whole number >= 0")
    return {
        "seed": args.seed,
        "stages": stages,
        "slope_limit_deg": args.slope_limit,
        "check_sigmas": StudySettings.check_sigmas if args.check_walks else (),
        "check_walks": args.check_walks or 1,
        "trial_seconds": args.trial_seconds,
    }


def _settings(args: argparse.Namespace) -> StudySettings:
    start, model = options.walker_of(args)
    if args.as_spline:
        from biped_mfpt_ros.optimise.fit import as_spline

        start = as_spline(start, model.robot)
    return StudySettings(
        start=start,
        searcher=args.searcher,
        step=args.step,
        population=args.population,
        runs=args.runs,
        fixed=tuple(args.fix),
        objectives=dict(args.objective),
        limits=dict(args.limit),
        model=model,
        mu_s=options.mean_of(args),
        sigma_s=options.spread("--sigma", args.sigma),
        correlation=options.correlation_of(args),
        **_scoring(args),
    )


def _stage(number: int, parts: tuple[float, ...]) -> Stage:
    margin = math.inf if number == 0 else -0.02
    more: dict[str, Any] = {"margin": parts[2] if len(parts) > 2 else margin}
    if len(parts) > 3:
        more["max_states"] = int(parts[3])
    return Stage(parts[0], parts[1], **more)


class _Tally:
    """The live line: best so far, rate, time left, and what part of the time was overhead."""

    def __init__(
        self,
        study: Study,
        progress: Progress,
        workers: int,
        limit: int | None,
        seconds: float | None,
    ) -> None:
        self.before = [t for t in study.trials() if t.found is not None]
        self._study, self._runs = study, run_rows(study, self.before)
        self.done = 0
        self._progress, self._workers = progress, workers
        self._limit, self._most_seconds = limit, seconds
        best = best_trial(self.before)
        self._best_text, self._best_score = "nothing", -math.inf
        if best is not None and best.found is not None:
            self._best_text, self._best_score = _found_text(best.found.values), best.found.score
        self._step_map_seconds = 0.0
        self._start = time.monotonic()

    def begin(self) -> None:
        """Begin to count the time: what has to be started is there."""
        self._start = time.monotonic()

    @property
    def seconds(self) -> float:
        """Wall time, s."""
        return time.monotonic() - self._start

    def add(
        self,
        number: int,
        generation: int,
        score: float,
        confirmed: bool,
        values: Mapping[str, float],
        step_map_seconds: float,
    ) -> None:
        """Take a trial in and show the line."""
        self.done += 1
        self._step_map_seconds += step_map_seconds
        of_run = ""
        if self._runs:
            run = self._study.run_of(generation)
            add_to_run(self._runs[run - 1], score)
            of_run = f" of run {run}"
        if confirmed and score > self._best_score:
            self._best_score, self._best_text = score, _found_text(values)
            self._progress.say(f"trial {number}{of_run}: {self._best_text}")
        throughput = self.throughput()
        rate = throughput["trials_per_second"]
        total = len(self.before) + self.done
        limit = self._limit
        parts = [plural(total, "trial") if limit is None else f"{total} of {limit} trials"]
        parts.append(f"best {self._best_text}")
        if self._runs:
            scores = ", ".join(score_text(row) for row in self._runs)
            parts.append(f"run {run} of best scores {scores}")
        parts.append(f"{rate_text(rate)} trials/s")
        parts.append(f"{100.0 * throughput['outside_step_map']:.0f} % outside the step map")
        left = []
        if self._limit is not None and rate > 0.0:
            left.append((self._limit - total) / rate)
        if self._most_seconds is not None:
            left.append(max(0.0, self._most_seconds - self.seconds))
        if left:
            parts.append(f"{duration_text(min(left))} left")
        self._progress.show(", ".join(parts))

    def throughput(self) -> dict[str, float]:
        """Rate, and the share of the workers' time that was not spent in the step map."""
        seconds = max(self.seconds, 1e-9)
        return {
            "seconds": seconds,
            "trials_per_second": self.done / seconds,
            "outside_step_map": 1.0 - self._step_map_seconds / (self._workers * seconds),
        }


def _found_text(values: Mapping[str, float]) -> str:
    labels = {"mfpt": "MFPT", "cot": "COT", "speed": "speed"}
    return ", ".join(f"{labels[k]} {number(values[k])}" for k in labels if k in values)
