"""`biped-mfpt reproduce`: the paper's tables and figures, each number beside the paper's."""

from __future__ import annotations

import argparse
import base64
import itertools
import os
import shutil
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.cli import CommandError, options
from biped_mfpt_ros.cli.kernels import compile_all
from biped_mfpt_ros.cli.node import require_ros
from biped_mfpt_ros.cli.output import json_text, plain
from biped_mfpt_ros.cli.pipeline import RESULT_TIMEOUT, START_TIMEOUT, Pipeline
from biped_mfpt_ros.cli.processes import Child, Processes
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.report.progress import MeshProgress, Progress, duration_text
from biped_mfpt_ros.report.style import Picture
from biped_mfpt_ros.report.tables import difference, table
from biped_mfpt_ros.study import work
from biped_mfpt_ros.study.comparison import Results, curves, mfpt_of, tables
from biped_mfpt_ros.study.plan import SIGMA_DEG, Job, Plan, make_plan, scheme_of
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.study.store import Store
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.terrain import slope_set

_MOST_STATES = 200_000
_RETRY = 0.05  # s
_SETTLE = 0.2  # s
_MOST_TRIES = 3  # for a mesh to be in its bag
_PRIOR = 60.0  # s of work after which the pace is believed rather than the plan
_RECORDED = ("mesh/info", "mesh/states", "mesh/transitions", "mesh/progress", "mfpt")


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
    workers = len(os.sched_getaffinity(0)) if args.workers is None else args.workers
    if workers < 1:
        raise InputError("--workers", workers, "a whole number >= 1")
    require_ros()
    directory = Path(args.output or ("runs/reproduce-quick" if args.quick else "runs/reproduce"))
    store = Store(directory / "results")
    with Progress(quiet=args.quiet) as progress:
        study = _Study(plan, store, progress)
        study.load(directory)
        if study.missing:
            with Processes(directory / "logs") as processes:
                compile_all(progress.say)
                _compute(study, processes, directory, workers)
        progress.show("writing the report")
        report = _write(study, directory, workers, start)
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

    def show(self, job: Job, details: str = "", share: float = 0.0) -> None:
        """Show how far all jobs have come, and what this one of them does."""
        done = len(self.results)
        missing = self.missing
        elapsed = time.monotonic() - self._start
        ended = [j for j in self.plan.jobs if j.name in self.results][self._before :]
        text = f"{done} of {len(self.plan.jobs)} jobs"
        # What has been done took so much more or less than expected; so will the rest, probably.
        expected = sum(j.seconds for j in ended) + share * job.seconds
        left = sum(j.seconds for j in missing) - share * job.seconds
        pace = (elapsed + _PRIOR) / (expected + _PRIOR)
        if ended:
            text += f", {60.0 * len(ended) / elapsed:.3g}/min"
        text += f", about {duration_text(left * pace)} left"
        self.progress.show(f"{text}; {job.title}{': ' if details else ''}{details}")

    def count(self, job: Job) -> Callable[[int, int], None]:
        """What tells how many of a job's parts are done."""
        return lambda done, total: self.show(job, f"{100.0 * done / total:.0f} %", done / total)


def _compute(study: _Study, processes: Processes, directory: Path, workers: int) -> None:
    """Do the jobs that are missing: cycles, then meshes by the pipeline, then what walks here."""
    for job in study.missing:
        if job.kind == "cycle":
            study.show(job)
            _timed(study, job, lambda job=job: work.cycle(job))
    # Without a gait on flat ground there is nothing to start from; the tables say so.
    jobs = [job for job in study.missing if study.state(job.controller) is not None]
    meshes = [job for job in jobs if job.kind == "mesh"]
    if meshes:
        _meshes(study, meshes, processes, directory, workers)
    for job in jobs:
        state = study.state(job.controller)
        assert state is not None
        study.show(job)
        if job.kind == "walks":
            _timed(study, job, partial(work.walks, job, state, workers, study.count(job)))
        elif job.kind == "tolerance":
            _timed(study, job, partial(work.tolerance, job, state, workers, study.count(job)))
        elif job.kind == "slopes":
            _timed(study, job, partial(work.slopes, job, state))
        elif job.kind == "pictures":
            _timed(study, job, partial(_pictures, study, job, state, directory))


def _timed(study: _Study, job: Job, do: Callable[[], dict[str, Any]]) -> None:
    start = time.monotonic()
    result = do()
    study.finish(job, result, time.monotonic() - start)


def _pictures(study: _Study, job: Job, state: list[float], directory: Path) -> dict[str, Any]:
    """Draw a controller's gait, and its mesh as the bag has it."""
    from biped_mfpt_ros.bag import read_meshes
    from biped_mfpt_ros.report.gallery import gallery

    mesh = None
    for grown in reversed(study.plan.of("mesh", job.controller)):
        result = study.results.get(grown.name)
        # The finest one whose chain could be solved.
        if result and mfpt_of(grown.settings | result, job.settings["sigma_deg"]) is not None:
            mesh = read_meshes(directory / result["bag"])[result["mesh_id"]].mesh
            break
    pictures = gallery(
        controller(job.controller),
        readings()[job.controller].model,
        state,
        job.settings["sigma_deg"],
        mesh,
        animated=job.settings["animated"],
    )
    return {
        "pictures": [
            {
                "title": picture.title,
                "caption": picture.caption,
                "mime": picture.mime,
                "data": base64.b64encode(picture.data).decode(),
            }
            for picture in pictures
        ]
    }


@dataclass
class _Recording:
    """A mesh that is done but for its bag."""

    job: Job
    result: dict[str, Any]
    recorder: Child
    bag: Path
    seconds: float


def _meshes(
    study: _Study, jobs: list[Job], processes: Processes, directory: Path, workers: int
) -> None:
    """Grow meshes with the pipeline's nodes, which are started once, and a recorder for each."""
    from biped_mfpt_ros.cli.client import Client
    from biped_mfpt_ros.nodes.spin import prepare_environment

    prepare_environment()
    bags = directory / "bags"
    bags.mkdir(exist_ok=True)
    namespace = f"/reproduce_{os.getpid()}_{time.time_ns() % 10**9}"
    pipeline = Pipeline(processes, study.progress, namespace)
    started = time.monotonic()
    published = sorted({s for job in jobs for s in SIGMA_DEG[scheme_of(job.controller)]})
    pipeline.start(workers, 0.0, published)
    last: _Recording | None = None
    queue, tries = deque(jobs), Counter[str]()
    with Client(namespace, pipeline.watch) as client:
        while queue or last is not None:
            job = queue.popleft() if queue else None
            if job is not None:
                start = time.monotonic()
                tries[job.name] += 1
                name = f"recorder_{tries.total()}"
                bag = bags / job.name
                if bag.exists():
                    shutil.rmtree(bag)  # of a mesh that was stopped, or not heard to its end
                recorder = pipeline.record(name, bag, earlier=False)
            # The bag of the mesh before is closed and checked while this recorder starts.
            if last is not None:
                problem = _close(study, last)
                if problem and tries[last.job.name] == _MOST_TRIES:
                    raise CommandError(f"{last.bag}: the mesh cannot be read back ({problem})")
                if problem:
                    queue.append(last.job)
                last = None
            if job is None:
                continue
            if tries.total() == 1:
                client.wait(partial(pipeline.up, client), START_TIMEOUT, "the nodes to come up")
                study.seconds["starting nodes"] = time.monotonic() - started
            study.show(job, "starting its recorder")
            client.wait(
                partial(client.listens, name, _RECORDED), START_TIMEOUT, f"{name} to come up"
            )
            result = _grow(study, job, client, published)
            processes.end(recorder)
            last = _Recording(
                job,
                result | {"bag": str(bag.relative_to(directory))},
                recorder,
                bag,
                time.monotonic() - start,
            )
    # The walks can have all cores.
    study.show(jobs[-1], "stopping the nodes")
    processes.stop()


def _grow(study: _Study, job: Job, client: Any, published: list[float]) -> dict[str, Any]:
    """Grow a mesh, and have the analysis compute its MFPT."""
    from biped_mfpt_ros.nodes.messages import MeshSettings

    state = study.state(job.controller)
    settings = MeshSettings(
        controller(job.controller),
        readings()[job.controller].model,
        slope_set(job.settings["slope_step_deg"]),
        job.settings["threshold"],
        initial_state=np.array(state),
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
    estimates = _estimates(study, job, client, grown.mesh_id)
    # What the analysis publishes comes last: when it is here, the recorder will have it soon.
    solved = [s for s, e in zip(job.settings["sigma_deg"], estimates, strict=True) if e is not None]
    first = itertools.takewhile(lambda sigma: sigma in solved, published)
    client.published_mfpt(
        grown.mesh_id, 0.0, [options.spread("sigma", deg) for deg in first], RESULT_TIMEOUT
    )
    time.sleep(_SETTLE)
    return {
        "mesh_id": grown.mesh_id,
        "states": grown.states,
        "generations": grown.generations,
        "swings": grown.swings,
        "swings_per_second": grown.swings / grown.seconds,
        "seconds": grown.seconds,
        "step_map_seconds": grown.step_map_seconds,
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


def _estimates(study: _Study, job: Job, client: Any, mesh_id: str) -> list[Any]:
    """MFPT at every sigma of a mesh; None where the chain could not be solved."""
    from biped_mfpt_ros.cli.client import AnalysisFailed

    deadline = time.monotonic() + RESULT_TIMEOUT
    out = []
    for done, sigma_deg in enumerate(job.settings["sigma_deg"]):
        study.show(job, f"MFPT at {done} of {len(job.settings['sigma_deg'])} sigmas")
        while True:
            try:
                sigma = options.spread("sigma", sigma_deg)
                out.append(client.compute_mfpt(mesh_id, 0.0, [sigma])[0])
                break
            except AnalysisFailed as error:
                # The last messages of the mesh may still be on their way to the analysis.
                if "mesh_id" in str(error) and time.monotonic() < deadline:
                    time.sleep(_RETRY)
                    continue
                study.progress.say(f"{job.title}: no MFPT at {sigma_deg:g} degrees: {error}")
                out.append(None)
                break
    return out


def _close(study: _Study, recording: _Recording) -> str:
    """Wait for a recorder to end and keep the result; says what is missing in the bag, if so."""
    from biped_mfpt_ros.bag import read_meshes

    start = time.monotonic()
    if recording.recorder.process.wait(RESULT_TIMEOUT) != 0:
        raise CommandError(
            f"{recording.recorder.name} {recording.recorder.ending()}:\n"
            f"{recording.recorder.log_tail()}"
        )
    found = read_meshes(recording.bag).get(recording.result["mesh_id"])
    if found is None or found.mesh is None:
        return "it is not there" if found is None else found.problem
    study.finish(recording.job, recording.result, recording.seconds + time.monotonic() - start)
    return ""


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
