"""A study over ROS: the nodes as processes, and what is asked of the optimiser."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biped_mfpt_msgs.action import Optimise

from biped_mfpt_ros.cli import CommandError
from biped_mfpt_ros.cli.client import Client
from biped_mfpt_ros.cli.pipeline import CLOSING, START_TIMEOUT, Pipeline, quoted
from biped_mfpt_ros.cli.processes import Child, Processes
from biped_mfpt_ros.nodes.answers import Answer
from biped_mfpt_ros.nodes.optimiser import degrees_of, goal_message
from biped_mfpt_ros.nodes.spin import prepare_environment
from biped_mfpt_ros.optimise.settings import StudySettings
from biped_mfpt_ros.report.progress import Progress

_WAITING = 1.5  # trials in flight for each simulator, so that none waits for a limit cycle


class _StudyPipeline(Pipeline):
    """Nodes of a study. One that dies is started again: it costs the trials that it was at."""

    _MOST_RESTARTS = 100

    def __init__(self, processes: Processes, progress: Progress, namespace: str) -> None:
        super().__init__(processes, progress, namespace)
        self._commands: dict[str, tuple[str, dict[str, Any]]] = {}
        self._restarts = 0

    def _node(self, name: str, executable: str, last: bool = False, **parameters: object) -> Child:
        self._commands[name] = executable, parameters
        return super()._node(name, executable, last, **parameters)

    def optimiser(self, store: Path, trials_at_once: int) -> None:
        """Start the optimiser."""
        self._node(
            "optimiser",
            "optimiser",
            store=quoted(str(store.absolute())),
            trials_at_once=trials_at_once,
        )

    def watch(self) -> None:
        """Start nodes again that have ended, but those that know what nobody else does."""
        for child in self._processes.newly_ended():
            message = f"{child.name} {child.ending()}; the end of {child.log}:\n{child.log_tail()}"
            self._restarts += 1
            if child.name in ("optimiser", "recorder") or self._restarts > self._MOST_RESTARTS:
                raise CommandError(message)
            self._progress.say(f"{message}\nstarting it again")
            executable, parameters = self._commands[child.name]
            self._processes.forget(child)
            self._node(child.name, executable, **parameters)


class StudyClient(Client):
    """Client of the optimiser."""

    def __init__(self, namespace: str, watch: Callable[[], object]) -> None:
        super().__init__(namespace, watch)
        self._optimise = self._action(Optimise, "optimise")

    def optimiser_is_there(self) -> bool:
        """Whether the optimiser answers."""
        return self._optimise.server_is_ready()

    def optimise(self, goal: Optimise.Goal, feedback: Callable[[Any], object]) -> str:
        """Have a study run, telling of each trial (a message); why it ended."""
        handle = self._accepted(self._optimise, goal, lambda told: feedback(told.trial))
        if not handle.accepted:
            raise CommandError("the optimiser refused the study; its log says why")
        result = self._result(Answer(handle.get_result_async)).result
        if not result.success:
            raise CommandError(result.message)
        return str(result.message)


def run_study(
    name: str,
    settings: StudySettings,
    store: Path,
    workers: int,
    trials: int | None,
    seconds: float | None,
    record: bool,
    progress: Progress,
    on_start: Callable[[], object],
    on_trial: Callable[[Any], object],
) -> str:
    """Start the nodes, have the optimiser run a study, and end them again.

    Parameters
    ----------
    name, settings, trials, seconds
        As for `Study`.
    store : pathlib.Path
        Of the study.
    workers : int
        Simulator processes.
    record : bool
        Whether all that is published is recorded.
    progress : Progress
        Where it is told what happens.
    on_start, on_trial : callable
        Told when all nodes are there, and of each trial, as a message.

    Returns
    -------
    str
        Why it ended.
    """
    prepare_environment()
    label = re.sub(r"\W", "_", f"study_{name}_{time.strftime('%Y%m%d_%H%M%S')}_{os.getpid()}")
    directory = Path("runs", label)
    directory.mkdir(parents=True)
    at_once = max(2, round(_WAITING * workers))
    with Processes(directory / "logs") as processes:
        pipeline = _StudyPipeline(processes, progress, f"/{label}")
        if record:
            pipeline.record(directory / "bag")
        # The analysis publishes what every trial needs, and nothing else.
        mean_deg, sigma_deg = (degrees_of(r) for r in (settings.mu_s, settings.sigma_s))
        pipeline.start(workers, mean_deg, [sigma_deg], settings.correlation, at_once)
        pipeline.optimiser(store, at_once)
        progress.say(f"running in {directory}, ROS namespace /{label}")
        with StudyClient(f"/{label}", pipeline.watch) as client:

            def up() -> bool:
                there = client.peers()
                missing = [
                    what
                    for what, here in (
                        ("simulators", there.simulators >= workers),
                        ("mesher", there.mesher),
                        ("analysis", there.analysis),
                        ("optimiser", client.optimiser_is_there()),
                        ("recorder", there.recorder or not record),
                    )
                    if not here
                ]
                progress.show(f"starting; waiting for {', '.join(missing)}")
                return not missing

            client.wait(up, START_TIMEOUT, "the nodes to come up")
            client.wait_until_found()
            on_start()
            goal = goal_message(name, settings)
            goal.max_trials = trials or 0
            goal.max_seconds = seconds or 0.0
            ended = client.optimise(goal, on_trial)
        processes.stop(CLOSING)
    return ended
