"""`biped-mfpt reproduce`: the paper's tables and figures, each number beside the paper's."""

from __future__ import annotations

import argparse
import base64
import itertools
import math
import os
import shutil
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from biped_mfpt_ros.cli import CommandError, options
from biped_mfpt_ros.cli.kernels import compile_all
from biped_mfpt_ros.cli.node import require_ros
from biped_mfpt_ros.cli.output import json_text, plain
from biped_mfpt_ros.cli.pipeline import RESULT_TIMEOUT, START_TIMEOUT, Pipeline, quoted
from biped_mfpt_ros.cli.processes import Processes
from biped_mfpt_ros.cli.workers import workers
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.report.progress import MeshProgress, Progress, duration_text
from biped_mfpt_ros.report.style import Picture
from biped_mfpt_ros.report.tables import difference, table
from biped_mfpt_ros.study import work
from biped_mfpt_ros.study.curves import curves
from biped_mfpt_ros.study.plan import SIGMA_DEG, Job, Plan, make_plan, scheme_of
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.study.results import Results, mfpt_of
from biped_mfpt_ros.study.store import Store
from biped_mfpt_ros.study.tables import tables
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.terrain import slope_set

if TYPE_CHECKING:  # ROS need not be there
    from biped_mfpt_ros.cli.client import Client
    from biped_mfpt_ros.nodes.recorder import Recorder

_MOST_STATES = 200_000
_POLL = 0.2  # s
_PATIENCE = 10.0  # s
_MOST_TRIES = 3  # for a mesh to be in its bag
_PRIOR = 60.0  # s of work after which the pace is believed rather than the plan


def reproduce(args: argparse.Namespace) -> None:
    """Compute what is missing, then write the report."""
    start = time.monotonic()
    from biped_mfpt_ros.report.gallery import drawing

    plan = make_plan(
        args.controllers,
        quick=args.quick,
        walks=args.walks,
        drawing=drawing() if args.pictures else "",
    )
    number = len(os.sched_getaffinity(0)) if args.workers is None else args.workers
    if number < 1:
        raise InputError("--workers", number, "a whole number >= 1")
    require_ros()
    directory = Path(args.output or ("runs/reproduce-quick" if args.quick else "runs/reproduce"))
    store = Store(directory / "results")
    with Progress(quiet=args.quiet) as progress:
        study = _Study(plan, store, progress)
        study.load(directory)
        if study.missing:
            with Processes(directory / "logs") as processes:
                compile_all(progress.say)
                _compute(study, processes, directory, number)
        progress.show("writing the report")
        report = _write(study, directory, number, start)
    print(json_text(report) if args.json else _text(report, directory))


# Doing the jobs ---------------------------------------------------------------------------------


class _Study:
    """The jobs of a plan: which are done, and how far the rest has come."""

    def __init__(self, plan: Plan, store: Store, progress: Progress) -> None:
        self.plan = plan
        self.results: dict[str, dict[str, Any]] = {}
        self.seconds: dict[str, float] = {}
        self.progress = progress
        self._store = store
        self._start = time.monotonic()
        self._before = 0

    def load(self, directory: Path) -> None:
        """Take what earlier runs left."""
        for job in self.plan.jobs:
            result = self._store.get(job)
            # A mesh is done if its bag is there.
            if result is not None and (directory / result.get("bag", ".")).exists():
                self.results[job.name] = result
        self._before = len(self.results)
        if self._before:
            self.progress.say(
                f"{self._before} of {len(self.plan.jobs)} results are there from an earlier run"
            )

    @property
    def missing(self) -> list[Job]:
        """The jobs that are to be done."""
        return [job for job in self.plan.jobs if job.name not in self.results]

    def state(self, name: str) -> list[float] | None:
        """State on the limit cycle of a controller, once that is known; None without one."""
        (job,) = self.plan.of("cycle", name)
        state: list[float] | None = self.results[job.name].get("state")
        return state

    def finish(self, job: Job, result: dict[str, Any], seconds: float) -> None:
        """Keep a result."""
        result = plain(result)
        self._store.put(job, result)
        self.results[job.name] = result
        self.seconds[job.kind] = self.seconds.get(job.kind, 0.0) + seconds

    def show(self, job: Job, details: str = "") -> None:
        """Show how far all jobs have come, and what this one of them does."""
        done = len(self.results)
        missing = self.missing
        elapsed = time.monotonic() - self._start
        ended = [j for j in self.plan.jobs if j.name in self.results][self._before :]
        text = f"{done} of {len(self.plan.jobs)} jobs"
        # What has been done took so much more or less than expected; so will the rest, probably.
        expected = sum(j.seconds for j in ended)
        left = sum(j.seconds for j in missing)
        pace = (elapsed + _PRIOR) / (expected + _PRIOR)
        if ended:
            text += f", {60.0 * len(ended) / elapsed:.3g}/min"
        text += f", about {duration_text(left * pace)} left"
        self.progress.show(f"{text}; {job.title}{': ' if details else ''}{details}")


def _compute(study: _Study, processes: Processes, directory: Path, number: int) -> None:
    """Do the jobs that are missing: limit cycles, meshes by the pipeline's nodes, all the rest."""
    with workers(number) as pool:
        cycles = [job for job in study.missing if job.kind == "cycle"]
        meshes = [job for job in study.missing if job.kind == "mesh"]
        started = _start_nodes(study, processes, number) if meshes else None
        _do(study, pool, [(job, work.cycle, (job,)) for job in cycles])
        # Without a gait on flat ground there is nothing to start from; the tables say so.
        walking = {job.controller for job in study.plan.jobs if study.state(job.controller)}
        if started is not None:
            _meshes(study, [m for m in meshes if m.controller in walking], started, directory)
            # The rest can have all cores.
            study.progress.show("stopping the nodes")
            processes.stop()
        rest = [job for job in study.missing if job.controller in walking and job.kind in _DO]
        # What takes longest comes first, so that all processes end at about the same time.
        rest.sort(key=lambda job: -job.seconds)
        _do(study, pool, [(job, *_call(study, job, directory)) for job in rest])


_DO: dict[str, Callable[..., dict[str, Any]]] = {
    "counted": work.counted,
    "walks": work.walks,
    "tolerance": work.tolerance,
    "slopes": work.slopes,
    "pictures": work.pictures,
}


def _call(
    study: _Study, job: Job, directory: Path
) -> tuple[Callable[..., dict[str, Any]], tuple[Any, ...]]:
    """What does a job in a worker, and its arguments."""
    arguments: tuple[Any, ...] = (job, study.state(job.controller))
    if job.kind == "pictures":
        arguments += _mesh_of_pictures(study, job, directory)
    elif job.kind == "counted":
        (mesh,) = (
            study.results[grown.name]
            for grown in study.plan.of("mesh", job.controller)
            if all(grown.settings[k] == job.settings[k] for k in ("slope_step_deg", "threshold"))
        )
        arguments += (directory / mesh["bag"], mesh["mesh_id"])
    return _DO[job.kind], arguments


def _mesh_of_pictures(study: _Study, job: Job, directory: Path) -> tuple[Path | None, str]:
    """Bag and name of the finest mesh whose chain could be solved."""
    for grown in reversed(study.plan.of("mesh", job.controller)):
        result = study.results.get(grown.name)
        if result and mfpt_of(grown.settings | result, job.settings["sigma_deg"]) is not None:
            return directory / result["bag"], result["mesh_id"]
    return None, ""


def _do(
    study: _Study,
    pool: Executor,
    calls: Sequence[tuple[Job, Callable[..., dict[str, Any]], tuple[Any, ...]]],
) -> None:
    """Have the workers do jobs, and keep each result when it comes."""
    given = {pool.submit(_timed, do, arguments): job for job, do, arguments in calls}
    while given:
        done, _ = wait(given, _POLL, FIRST_COMPLETED)
        for future in done:
            job = given.pop(future)
            study.finish(job, *future.result())
        if given:
            study.show(next(iter(given.values())))


def _timed(
    do: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]
) -> tuple[dict[str, Any], float]:
    """Result of a job, in a worker, and the time that this took."""
    start = time.monotonic()
    result = do(*arguments)
    return result, time.monotonic() - start


def _start_nodes(study: _Study, processes: Processes, number: int) -> Pipeline:
    """Start the nodes of the pipeline but the recorders, which come with the meshes."""
    from biped_mfpt_ros.nodes.spin import prepare_environment

    prepare_environment()
    namespace = f"/reproduce_{os.getpid()}_{time.time_ns() % 10**9}"
    pipeline = Pipeline(processes, study.progress, namespace)
    pipeline.start(number, 0.0, _published_deg(study))
    return pipeline


@dataclass
class _Grown:
    """A mesh that is done but for its MFPT, which the analysis computes meanwhile."""

    job: Job
    result: dict[str, Any]
    asked: Any
    seconds: float


def _meshes(study: _Study, jobs: Sequence[Job], pipeline: Pipeline, directory: Path) -> None:
    """Grow meshes with the pipeline's nodes, and record each in a bag of its own."""
    from biped_mfpt_ros.cli.client import RECORDED, Client
    from biped_mfpt_ros.nodes.recorder import Recorder

    start = time.monotonic()
    bags = directory / "bags"
    bags.mkdir(exist_ok=True)
    recorder: Recorder | None = None

    def watch() -> None:
        pipeline.watch()
        if recorder is not None and recorder.failed:
            raise CommandError(f"{bag} cannot be written any more")

    queue, tries = deque(jobs), Counter[str]()
    unsolved: deque[_Grown] = deque()
    with Client(pipeline.namespace, watch) as client:
        while queue or unsolved:
            if unsolved and (unsolved[0].asked.done() or not queue):
                _solve(study, client, unsolved.popleft())
                continue
            job = queue.popleft()
            tries[job.name] += 1
            bag = bags / job.name
            if bag.exists():
                shutil.rmtree(bag)  # of a mesh that was stopped, or not heard to its end
            # In this process: it would take a second to start one for each mesh.
            name = f"recorder_{tries.total()}"
            recorder = client.add(Recorder, name, bag=quoted(str(bag.absolute())), earlier="false")
            if tries.total() == 1:
                client.wait(partial(pipeline.up, client), START_TIMEOUT, "the nodes to come up")
                study.seconds["starting nodes"] = time.monotonic() - start
            began = time.monotonic()
            study.show(job, "starting its recorder")
            client.wait(
                partial(client.listens, name, RECORDED), START_TIMEOUT, f"{name} to come up"
            )
            if tries.total() == 1:
                client.wait_until_found()
            result = _grow(study, job, client)
            heard = _wait_for_estimates(study, job, client, result["mesh_id"], recorder)
            recorder.close()
            client.remove(recorder)
            recorder = None
            problem = _missing_in_bag(bag, result["mesh_id"]) if heard else "without its MFPT"
            if not problem:
                result["bag"] = str(bag.relative_to(directory))
                asked = client.ask_mfpt(result["mesh_id"], 0.0, _sigmas(job))
                unsolved.append(_Grown(job, result, asked, time.monotonic() - began))
            elif tries[job.name] < _MOST_TRIES:
                queue.append(job)
            else:
                raise CommandError(f"{bag}: the mesh cannot be read back ({problem})")


def _missing_in_bag(bag: Path, mesh_id: str) -> str:
    """What keeps a mesh from being read out of its bag; empty if nothing does."""
    from biped_mfpt_ros.bag import read_meshes

    found = read_meshes(bag).get(mesh_id)
    if found is None:
        return "it is not there"
    return "" if found.mesh is not None else found.problem


def _sigmas(job: Job) -> list[float]:
    return [options.spread("sigma", degrees) for degrees in job.settings["sigma_deg"]]


def _grow(study: _Study, job: Job, client: Client) -> dict[str, Any]:
    """Grow a mesh."""
    from biped_mfpt_ros.nodes.messages import MeshSettings

    settings = MeshSettings(
        controller(job.controller),
        readings()[job.controller].model,
        slope_set(job.settings["slope_step_deg"]),
        job.settings["threshold"],
        initial_state=np.array(study.state(job.controller)),
        max_states=_MOST_STATES,
    )
    text = MeshProgress()

    def feedback(message: Any) -> None:
        line = text.text(
            generation=message.generation,
            states=message.states,
            frontier=message.frontier,
            swings_per_second=message.swings_per_second,
        )
        study.show(job, line.removeprefix("mesh: "))

    study.show(job)
    grown = client.grow_mesh(settings, feedback)
    return {
        "mesh_id": grown.mesh_id,
        "states": grown.states,
        "generations": grown.generations,
        "swings": grown.swings,
        "swings_per_second": grown.swings / grown.seconds,
        "seconds": grown.seconds,
        "step_map_seconds": grown.step_map_seconds,
    }


def _published_deg(study: _Study) -> list[float]:
    """Sigmas, degrees, for which the analysis publishes the MFPT of every mesh."""
    return sorted({s for n in study.plan.controllers for s in SIGMA_DEG[scheme_of(n)]})


def _wait_for_estimates(
    study: _Study, job: Job, client: Client, mesh_id: str, recorder: Recorder
) -> bool:
    """Wait until a recorder has what the analysis publishes of a mesh.

    Returns whether it has: it gets nothing from an analysis that has not found it yet, which may
    take longer on a busy machine than a small mesh.
    """
    from biped_mfpt_ros.cli.client import WaitedInVain

    sigmas = [options.spread("sigma", degrees) for degrees in _published_deg(study)]
    study.show(job, "waiting for the analysis")
    try:
        client.published_mfpt(mesh_id, 0.0, sigmas, _PATIENCE)
    except WaitedInVain:
        # It ends at the first that it cannot compute.
        solved = itertools.takewhile(
            lambda sigma_s: _estimate(study, job, client, mesh_id, sigma_s), sigmas
        )
        sigmas = list(solved)
        client.published_mfpt(mesh_id, 0.0, sigmas, RESULT_TIMEOUT)
    try:
        client.wait(
            lambda: recorder.counts.get("mfpt", 0) >= len(sigmas), _PATIENCE, "the recorder"
        )
    except WaitedInVain:
        return False
    return True


def _solve(study: _Study, client: Client, grown: _Grown) -> None:
    """Take the MFPT of a mesh at all its sigmas, and keep the result."""
    from biped_mfpt_ros.cli.client import AnalysisFailed

    job, result = grown.job, grown.result
    study.show(job, "waiting for the analysis")
    try:
        estimates = client.answer(grown.asked)
    except AnalysisFailed:  # one of them cannot be computed
        estimates = [
            _estimate(study, job, client, result["mesh_id"], sigma_s) for sigma_s in _sigmas(job)
        ]
    result |= {
        "mfpt": [e and e.mfpt for e in estimates],
        "failure_probability": [e and e.failure_probability for e in estimates],
        "failure_shares": [
            e
            and {
                Outcome(code).name.lower(): share
                for code, share in zip(e.failure_codes, e.failure_shares, strict=True)
                if share > 0.0
            }
            for e in estimates
        ],
    }
    study.finish(job, result, grown.seconds)


def _estimate(study: _Study, job: Job, client: Client, mesh_id: str, sigma_s: float) -> Any:
    """MFPT of a mesh at one sigma; None where the chain cannot be solved."""
    from biped_mfpt_ros.cli.client import AnalysisFailed

    try:
        return client.compute_mfpt(mesh_id, 0.0, [sigma_s])[0]
    except AnalysisFailed as error:
        degrees = math.degrees(sigma_s)
        study.progress.say(f"{job.title}: no MFPT at {degrees:g} degrees: {error}")
        return None


# The report -------------------------------------------------------------------------------------


def _write(study: _Study, directory: Path, workers: int, start: float) -> dict[str, Any]:
    """Write HTML, JSON and CSV; return what is in the JSON."""
    from biped_mfpt_ros.report import html

    began = time.monotonic()
    results = Results(study.plan, study.results)
    found, lines = tables(results), curves(results)
    files = {f"{t.name}.csv": t.csv() for t in found}
    for number, scheme in ((2, "hzd"), (3, "smc")):
        rows = [
            f"{curve.controller},{at!r},{mfpt!r}"
            for curve in lines
            if scheme_of(curve.controller) == scheme
            for at, mfpt in zip(curve.sigma_deg, curve.mfpt, strict=True)
        ]
        if rows:
            files[f"figure{number}.csv"] = "\n".join(["controller,sigma_s_deg,mfpt", *rows, ""])
    pictures = {
        job.controller: [
            Picture(p["title"], p["caption"], base64.b64decode(p["data"]), p["mime"])
            for p in study.results[job.name]["pictures"]
        ]
        for job in study.plan.of("pictures")
        if job.name in study.results
    }
    files["report.html"] = html.page(results, found, lines, pictures, study.seconds)
    study.seconds["report"] = time.monotonic() - began
    study.seconds["all"] = time.monotonic() - start
    report = {
        "controllers": study.plan.controllers,
        "quick": study.plan.quick,
        "walks": study.plan.walks,
        "workers": workers,
        "step_map": STEP_MAP,
        "tables": {t.name: t.to_dict() for t in found},
        "curves": [vars(curve) for curve in lines],
        "results": [
            job.inputs | {"result": study.results[job.name]}
            for job in study.plan.jobs
            if job.name in study.results and job.kind != "pictures"
        ],
        "seconds": study.seconds,
    }
    files["report.json"] = json_text(report) + "\n"
    for name, text in files.items():
        beside = directory / f".{name}.tmp"
        beside.write_text(text)
        beside.replace(directory / name)
    return report


def _text(report: dict[str, Any], directory: Path) -> str:
    """What a reader wants to know at once."""
    parts = []
    if "holds" in report["tables"]:
        rows = [
            (
                row["number"], row["paper"], row["here"], row["by"],
                "" if row["difference"] is None else difference(row["here"], row["paper"]),
                row["verdict"],
            )
            for row in report["tables"]["holds"]["rows"]
        ]  # fmt: skip
        parts.append(
            table(("the paper's number", "paper", "here", "by", "difference", "verdict"), rows)
        )
    times = [f"{name} {duration_text(value)}" for name, value in report["seconds"].items()]
    parts.append("times: " + ", ".join(times))
    parts.append(
        f"report   {directory / 'report.html'}\n"
        f"data     {directory / 'report.json'} and {directory}/*.csv\n"
        f"bags     {directory / 'bags'}"
    )
    return "\n\n".join(parts)
