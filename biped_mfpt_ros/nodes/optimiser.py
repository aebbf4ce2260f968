"""The optimiser: proposes controllers, has the pipeline score them, and publishes each trial."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from biped_mfpt_msgs.action import Optimise
from biped_mfpt_msgs.msg import Controller as ControllerMsg
from biped_mfpt_msgs.msg import OptimisationTrial
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future

from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes import simulator
from biped_mfpt_ros.nodes.messages import (
    controller_from,
    controller_message,
    model_from,
    model_message,
    packed,
    unpacked,
    unpacked_rows,
)
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.pipeline_backend import PipelineBackend
from biped_mfpt_ros.nodes.publishers import CountedPublisher
from biped_mfpt_ros.nodes.qos import LATEST, RESULTS
from biped_mfpt_ros.nodes.spin import run_node
from biped_mfpt_ros.nodes.warm_up import compiled
from biped_mfpt_ros.optimise.scoring import BackendLost
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.optimise.space import SearchSpace
from biped_mfpt_ros.optimise.store import Store, StoreBusy, Trial
from biped_mfpt_ros.optimise.study import Study, best_trial
from biped_mfpt_ros.report.tables import plural

MOST_REFUSED = 64
"""Goals that are told within 10 s that another study runs; more are rejected without a word."""
_WITHIN = 10.0  # s, for which rclpy keeps the result of a goal


@dataclass(frozen=True)
class OptimiserParameters(NodeParameters):
    """Parameters of the optimiser."""

    store: str = parameter("runs/studies.sqlite", "SQLite file of the studies; made if missing")
    trials_at_once: int = parameter(3, "trials that are scored at the same time", 1, 1000)
    patience: float = parameter(
        30.0, "s, for how long a mesher or analysis that is gone is waited for", 0.1, 1e6
    )


class Optimiser(Node):
    """Action server of `Optimise`: one study at a time.

    A study runs in threads of its own: they look for limit cycles themselves, and have meshes
    grown by the mesher and solved by the analysis. The executor only takes messages and answers.
    A goal that is not allowed, or comes while another study runs, is accepted and aborted, since a
    rejection cannot say why; a flood of them is rejected.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__("optimiser", **settings)
        self._declared = Declared(self, OptimiserParameters)
        with compiled(self.get_logger().info, "the step map"):
            simulator.warm_up()
        self._trials = CountedPublisher(self, OptimisationTrial, "optimisation/trials", RESULTS)
        self._best = CountedPublisher(self, OptimisationTrial, "optimisation/best", LATEST)
        self._backend = PipelineBackend(self, lambda: self._declared.now.patience)
        self._stop = threading.Event()
        self._running: ServerGoalHandle[Any, Any, Any] | None = None
        self._refused: deque[float] = deque()  # when goals were, while a study ran
        self._thread = ThreadPoolExecutor(1, "study")
        self._action = ActionServer(
            self,
            Optimise,
            "optimise",
            self._execute,
            goal_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )
        self.get_logger().info("ready")

    def close(self) -> None:
        """Stop the study that runs; its trials in flight are given back."""
        self._stop.set()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._action.destroy()
        self._backend.close()

    def _on_goal(self, goal: Optimise.Goal) -> GoalResponse:
        if self._running is None:
            return GoalResponse.ACCEPT
        now = time.monotonic()
        while self._refused and self._refused[0] < now - _WITHIN:
            self._refused.popleft()
        if len(self._refused) >= MOST_REFUSED:
            self.get_logger().warning(
                f"rejected a goal: {MOST_REFUSED} were told within {_WITHIN:g} s that a study runs",
                throttle_duration_sec=_WITHIN,
            )
            return GoalResponse.REJECT
        self._refused.append(now)
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: ServerGoalHandle[Any, Any, Any]) -> CancelResponse:
        if goal is self._running:
            self._stop.set()
        return CancelResponse.ACCEPT

    async def _execute(self, goal: ServerGoalHandle[Any, Any, Any]) -> Optimise.Result:
        if self._running is not None:
            goal.abort()
            return Optimise.Result(message="another study is running; cancel it or wait")
        self._running = goal
        self._stop.clear()
        done: Future[Optimise.Result] = Future()

        def finish(job: Any) -> None:
            done.set_result(job.result())
            if self.executor is not None:
                self.executor.wake()

        self._thread.submit(self._serve, goal).add_done_callback(finish)
        result = await done
        self._running = None
        return result

    def _serve(self, goal: ServerGoalHandle[Any, Any, Any]) -> Optimise.Result:
        """Run a study; in its own thread. Whatever happens, there is a result."""
        result = Optimise.Result()
        try:
            ended = self._run(goal, result)
        except (InputError, BackendLost, StoreBusy) as error:
            result.message = str(error)
            self.get_logger().warning(f"a study ended: {error}")
            goal.abort()
        except Exception as error:
            if self.context.ok():  # else it only tells that nothing can be published any more
                self.get_logger().error(f"a study failed\n{traceback.format_exc()}")
                result.message = f"internal error of the optimiser: {error!r}"
                goal.abort()
        else:
            result.success, result.message = True, ended
            if not self.context.ok():
                pass
            elif goal.is_cancel_requested:
                goal.canceled()
            elif ended == "stopped":  # the node stops
                goal.abort()
            else:
                goal.succeed()
        return result

    def _run(self, goal: ServerGoalHandle[Any, Any, Any], result: Optimise.Result) -> str:
        request = goal.request
        now = self._declared.now
        settings = settings_from(request)
        if not request.study:
            raise InputError("study", request.study, "a name")
        store = Store(Path(now.store))
        study: Study | None = None
        try:
            study = Study(store, request.study, settings)
            done = [t for t in study.trials() if t.found is not None]
            best = best_trial(done)
            count = len(done)
            if best is not None:
                self._best.publish(trial_message(study, best, best=True))

            def on_trial(trial: Trial) -> None:
                nonlocal best, count
                assert study is not None
                count += 1
                better = best_trial([trial] if best is None else [best, trial])
                new = better is trial
                best = better
                message = trial_message(study, trial, best=new)
                self._trials.publish(message)
                if new:
                    self._best.publish(trial_message(study, trial, best=True))
                goal.publish_feedback(Optimise.Feedback(trial=message, trials=count))

            self.get_logger().info(f"study {study.name}: {plural(count, 'trial')} so far")
            ended = study.run(
                self._backend,
                now.trials_at_once,
                request.max_trials or None,
                request.max_seconds or None,
                on_trial,
                self._stop,
            )
            self.get_logger().info(f"study {study.name}: {plural(count, 'trial')}, ended: {ended}")
            result.trials = count
            if best is not None:
                result.best = trial_message(study, best, best=True)
            return ended
        finally:
            if study is not None:
                study.close()
            store.close()


def degrees_of(radians: float) -> float:
    """A slope in degrees as it was typed: 0.5, not 0.49999999999999994."""
    return float(f"{math.degrees(radians):.12g}")


def _named(names: Sequence[str], values: Any, field: str) -> dict[str, float]:
    numbers = unpacked(values, "d").tolist()
    if len(numbers) != len(names):
        raise InputError(field, f"{len(numbers)} numbers", f"as many as names, {len(names)}")
    return dict(zip(names, numbers, strict=True))


def settings_from(request: Optimise.Goal) -> StudySettings:
    """Settings of a goal; raises InputError."""
    columns = [
        unpacked(getattr(request, field), code).tolist()
        for field, code in (
            ("slope_steps", "d"), ("thresholds", "d"), ("margins", "d"), ("max_states", "I"),
        )
    ]  # fmt: skip
    if len({len(column) for column in columns}) != 1:
        raise InputError(
            "slope_steps, thresholds, margins, max_states", [len(c) for c in columns],
            "as many of each",
        )  # fmt: skip
    given: dict[str, Any] = {}
    if columns[0]:
        given["stages"] = tuple(
            Stage(degrees_of(step), *more) for step, *more in zip(*columns, strict=True)
        )
    if request.objectives:
        weights = request.weights or [1.0] * len(request.objectives)
        given["objectives"] = _named(request.objectives, weights, "weights")
    for name in ("step", "check_steps", "check_walks", "trial_seconds", "searcher"):
        if getattr(request, name):
            given[name] = getattr(request, name)
    model = model_from(request.model)
    start = controller_from(request.start, model.robot, "start")
    if request.candidates:
        n = len(SearchSpace(start, model.robot, request.fixed))
        rows = unpacked_rows(request.candidates, "d", n, "candidates")
        given["candidates"] = tuple(map(tuple, rows.tolist()))
    return StudySettings(
        start=start,
        seed=request.seed,
        population=request.population,
        runs=request.runs,
        fixed=tuple(request.fixed),
        limits=_named(request.limits, request.limit_values, "limit_values"),
        model=model,
        mu_s=request.mu_s,
        sigma_s=request.sigma_s,
        correlation=request.correlation,
        slope_limit_deg=degrees_of(request.slope_limit),
        check_sigmas=tuple(unpacked(request.check_sigmas, "d").tolist()),
        **given,
    )


def goal_message(study: str, settings: StudySettings) -> Optimise.Goal:
    """Settings as a goal, without an end."""
    stages = settings.stages
    return Optimise.Goal(
        study=study,
        start=controller_message(settings.start),
        searcher=settings.searcher,
        seed=settings.seed,
        step=float(settings.step),
        population=settings.population,
        runs=settings.runs,
        fixed=list(settings.fixed),
        candidates=packed(np.array(settings.candidates), "d"),
        objectives=list(settings.objectives),
        weights=packed(np.array(list(settings.objectives.values())), "d"),
        limits=list(settings.limits),
        limit_values=packed(np.array(list(settings.limits.values())), "d"),
        model=model_message(settings.model),
        mu_s=settings.mu_s,
        sigma_s=settings.sigma_s,
        correlation=settings.correlation,
        slope_limit=math.radians(settings.slope_limit_deg),
        slope_steps=packed(np.radians([s.slope_step_deg for s in stages]), "d"),
        thresholds=packed(np.array([s.threshold for s in stages]), "d"),
        margins=packed(np.array([s.margin for s in stages]), "d"),
        max_states=packed(np.array([s.max_states for s in stages]), "I"),
        check_sigmas=packed(np.array(settings.check_sigmas), "d"),
        check_steps=float(settings.check_steps),
        check_walks=settings.check_walks,
        trial_seconds=float(settings.trial_seconds),
    )


def trial_message(study: Study, trial: Trial, best: bool) -> OptimisationTrial:
    """A finished trial as a message; ``best``: whether it is the best of its study by now."""
    found = trial.found
    assert found is not None
    try:
        tried = controller_message(study.controller(trial))
    except InputError:
        tried = ControllerMsg(name=f"{study.name}-{trial.number}")
    objectives = list(study.settings.objectives)
    measures = [name for name, value in found.values.items() if value is not None]
    return OptimisationTrial(
        study=study.name,
        trial=trial.number,
        generation=trial.generation,
        controller=tried,
        stage=found.stage,
        score=found.score,
        objectives=objectives,
        values=packed(np.array([found.values.get(name, math.nan) for name in objectives]), "d"),
        measures=measures,
        measured=packed(np.array([found.values[name] for name in measures]), "d"),
        feasible=found.violation == 0.0,
        confirmed=found.confirmed,
        best=best,
        mesh_id=found.mesh_id,
        states=found.states,
        seconds=found.seconds,
        step_map_seconds=found.step_map_seconds,
        note=found.note,
    )


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_node(Optimiser, args)
