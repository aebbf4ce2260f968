"""`biped-mfpt run`: the whole pipeline over ROS 2, and its result beside the paper's."""

from __future__ import annotations

import argparse
import math
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any

import numpy as np

from biped_mfpt_ros.cli import CommandError, options
from biped_mfpt_ros.cli.kernels import compile_all
from biped_mfpt_ros.cli.node import require_ros
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.cli.processes import Child, Processes
from biped_mfpt_ros.cli.results import (
    beside_paper,
    estimate_row,
    mfpt_table,
    monte_carlo_result,
    slope_set_notes,
)
from biped_mfpt_ros.cli.shared_memory import remove_left_segments
from biped_mfpt_ros.control.controller import Controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.files import whole_file
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.report import paper
from biped_mfpt_ros.report.progress import MeshProgress, Progress, duration_text
from biped_mfpt_ros.report.tables import (
    correlation_text,
    difference,
    ground_text,
    number,
    plural,
    table,
)
from biped_mfpt_ros.walker.robot import WalkerModel

if TYPE_CHECKING:  # ROS need not be there
    from biped_mfpt_ros.cli.client import Client
    from biped_mfpt_ros.nodes.messages import MeshSettings

START_TIMEOUT = 300.0
"""s, for nodes that import much on a busy machine. One that ends meanwhile is noticed at once."""
RESULT_TIMEOUT = 120.0  # s, for what the analysis has published to come
_MOST_SWINGS = 100_000  # of a Monte Carlo: half a minute or so
_MOST_MESHERS = 4  # started in a run: where one after the other is killed, there is a reason
_MATCHED_WITHIN = 15.0
"""s from when all nodes are there. A publisher may learn later than we do that the recorder hears
it, seconds on a busy machine; what it published before it sends then, if it still runs: a mesh of
some states was grown and solved, and the nodes stopped, before that."""
_LOOK = 0.1  # s, between two looks into a bag that is being recorded
CLOSING = 60.0
"""s, for the recorder to close its bag when all went well: however busy the machine is."""
_CURVE_POINTS = 40
_PICTURE_STEPS = 6


def run(args: argparse.Namespace) -> None:
    """Run the pipeline, compare with the paper, keep everything in a directory."""
    # All that may be wrong is found before anything is started or written.
    controller, model = options.walker_of(args)
    slopes = options.slopes_of(args)
    mean = options.mean_of(args)
    sigmas = [options.spread("--sigma", sigma) for sigma in args.sigma]
    correlation = options.correlation_of(args)
    workers = len(os.sched_getaffinity(0)) if args.workers is None else args.workers
    for option, value, least in (
        ("--workers", workers, 1),
        ("--walks", args.walks, 0),
        ("--seed", args.seed, 0),
    ):
        if value < least:
            raise InputError(option, value, f"a whole number >= {least}")
    label = re.sub(r"\W", "-", controller.name, flags=re.ASCII)
    name = f"{time.strftime('%Y%m%d-%H%M%S')}-{label}"
    namespace = _namespace(args.namespace or f"run_{name}_{os.getpid()}")
    require_ros()
    from biped_mfpt_ros.nodes.analysis import AnalysisParameters
    from biped_mfpt_ros.nodes.messages import MeshSettings
    from biped_mfpt_ros.nodes.spin import prepare_environment

    AnalysisParameters(  # checks their range
        sigma_s_deg=tuple(args.sigma), mu_s_deg=args.mean, correlation=correlation
    )
    settings = MeshSettings(
        controller, model, slopes, args.threshold, **options.mesh_settings(args)
    )
    prepare_environment()
    directory = _new_directory(args.output, name)

    result: dict[str, Any] = options.described(controller, model) | {
        "namespace": namespace,
        "workers": workers,
        "slope_step_deg": args.slope_step,
        "slope_limit_deg": args.slope_limit,
        "slopes": len(slopes),
        "mu_s": mean,
        "correlation": correlation,
    }
    picture = directory / "mfpt.png"
    with (
        # Not beside the bag: a disk that the bag fills up must not end the mesh.
        _removed(Path(gettempdir(), f"biped-mfpt-run-{os.getpid()}")) as checkpoint,
        Progress(quiet=args.quiet) as progress,
        Processes(directory / "logs") as processes,
    ):
        remove_left_segments()
        compile_all(progress.say)
        progress.say(f"running in {directory}, ROS namespace {namespace}")
        pipeline = Pipeline(processes, progress, namespace)
        recorder = pipeline.record(directory / "bag", on_error=args.on_record_error)
        pipeline.start(workers, args.mean, args.sigma, correlation, checkpoint=checkpoint)
        result |= pipeline.mesh(
            settings, mean, dict(zip(sigmas, args.sigma, strict=True)), correlation
        )
        result["notes"] = slope_set_notes(
            result["estimates"], args.slope_step, args.slope_limit, args.mean, correlation
        )
        # The walks can have all cores, and the bag is closed whatever happens to them.
        progress.show("stopping the nodes")
        processes.stop(CLOSING)
        result["bag_whole"] = (directory / "bag" / "metadata.yaml").exists()
        if not result["bag_whole"]:
            if args.on_record_error == "stop":
                raise CommandError(_last_words(recorder))
            progress.say(
                f"{directory / 'bag'} is not whole; {directory}/logs/recorder.log says why"
            )
        result["monte_carlo"] = _walks(controller, model, mean, args, result["estimates"], progress)
        progress.show("drawing")
        disk: OSError | None = None
        try:
            _draw(controller, model, args, result, picture)
        except OSError as error:
            disk = error
    result["files"] = {
        "bag": str(directory / "bag"),
        "picture": str(picture),
        "logs": str(directory / "logs"),
        "result": str(directory / "result.json"),
    }
    text = json_text(result)
    # Whatever becomes of the files, the result is there to be read.
    print(text if args.json else _report(result), flush=True)
    if disk is not None:
        raise disk
    with whole_file(directory / "result.json") as file:
        file.write(f"{text}\n".encode())


@contextmanager
def _removed(path: Path) -> Iterator[Path]:
    """Remove a directory at the end, if it has been made."""
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _namespace(name: str) -> str:
    """A namespace with a leading slash, of characters that ROS allows."""
    name = "/" + re.sub(r"[-.]", "_", name.strip("/"))
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name):
        raise InputError("--namespace", name, "letters, digits and _, not starting with a digit")
    return name


def _new_directory(output: str | None, name: str) -> Path:
    """Make the directory of the run."""
    if output is not None:
        directory = Path(output)
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            raise InputError("--output", output, "a directory that does not exist yet") from None
        return directory
    for count in range(1, 1000):
        directory = Path("runs", name if count == 1 else f"{name}-{count}")
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        return directory
    raise CommandError(f"there are too many directories runs/{name}")


def quoted(text: str) -> str:
    """Text as YAML takes it for text, whatever is in it."""
    return "'" + text.replace("'", "''") + "'"


class _MesherKilled(Exception):
    """The mesher was killed, and another one may go on with its mesh."""


class Pipeline:
    """The nodes of a run, as processes of their own, and what is asked of them.

    Parameters
    ----------
    processes : Processes
        Where they are started.
    progress : Progress
        Where it is told what they do.
    namespace : str
        Theirs, with a leading slash.
    """

    def __init__(self, processes: Processes, progress: Progress, namespace: str) -> None:
        self._processes = processes
        self._progress = progress
        self.namespace = namespace
        self._simulators: set[str] = set()
        self._meshers = 0
        self._mesher_parameters: dict[str, Any] = {}
        self._survives = False
        self._bag = Path()

    def record(self, bag: Path, *, on_error: str = "stop") -> Child:
        """Start a recorder.

        ``on_error``: whether it is to stop, and so end the run, or to go_on when the bag cannot be
        written.
        """
        # It is stopped last, so that it hears what the others say to the end.
        self._bag = bag
        text = quoted(str(bag.absolute()))
        return self._node("recorder", "recorder", last=True, bag=text, on_error=on_error)

    def start(
        self,
        workers: int,
        mean_deg: float,
        sigma_deg: Sequence[float],
        correlation: float = 0.0,
        meshes_at_once: int = 4,
        checkpoint: Path | None = None,
    ) -> None:
        """Start all other nodes. With ``checkpoint``, the mesh survives the mesher."""
        self._mesher_parameters["meshes_at_once"] = meshes_at_once
        if checkpoint is not None:
            self._survives = True
            path = quoted(str(checkpoint.absolute()))
            self._mesher_parameters["checkpoint_directory"] = path
        self._start_mesher()
        # A mesh may be asked for while the next ones come in.
        self._node(
            "analysis",
            "analysis",
            mu_s_deg=mean_deg,
            sigma_s_deg=list(sigma_deg),
            correlation=correlation,
            keep_meshes=4 * meshes_at_once,
        )
        self._simulators = {f"simulator_{i}" for i in range(1, workers + 1)}
        for name in sorted(self._simulators):
            self._node(name, "simulator")

    def _start_mesher(self) -> str:
        """Start a mesher, and return the name of its node."""
        self._meshers += 1
        name = "mesher" if self._meshers == 1 else f"mesher_{self._meshers}"
        self._node(name, "mesher", **self._mesher_parameters)
        return name

    def _node(self, name: str, executable: str, last: bool = False, **parameters: object) -> Child:
        command = [sys.executable, "-m", "biped_mfpt_ros.cli", "node", executable]
        command[-1:-1] = ["--end-with", str(os.getpid())]
        # The log's topic is the same for all nodes on the graph, if it is not brought in here.
        command += ["--ros-args", "-r", f"__ns:={self.namespace}", "-r", "/rosout:=rosout"]
        command += ["--disable-external-lib-logs"]
        if executable == "mesher":  # there may be another one after it
            command += ["-r", f"__node:={name}"]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
        environment = os.environ | {"RCUTILS_COLORIZED_OUTPUT": "0", "PYTHONUNBUFFERED": "1"}
        return self._processes.start(name, command, environment=environment, last=last)

    def mesh(
        self,
        settings: MeshSettings,
        mean: float,
        sigmas: dict[float, float],
        correlation: float = 0.0,
    ) -> dict[str, Any]:
        """Grow the mesh and get its MFPT for each sigma (rad to degrees)."""
        from biped_mfpt_ros.cli.client import Client

        with Client(self.namespace, self.watch) as client:
            client.wait(partial(self.up, client), START_TIMEOUT, "the nodes to come up")
            all_there = time.monotonic() + _MATCHED_WITHIN
            # A goal that got lost would be sent again, and a mesh may be begun twice.
            client.wait_until_found()
            text = MeshProgress()

            def feedback(message: Any) -> None:
                self._progress.show(
                    text.text(
                        generation=message.generation,
                        states=message.states,
                        frontier=message.frontier,
                        swings_per_second=message.swings_per_second,
                        simulators=message.simulators,
                    )
                )

            while True:
                try:
                    grown = client.grow_mesh(settings, feedback)
                    break
                except _MesherKilled:
                    name = self._start_mesher()
                    client.wait(partial(client.reaches, name), START_TIMEOUT, name)
                    client.wait_until_found()
            self._progress.show("waiting for the analysis")
            estimates = client.mfpt(grown.mesh_id, mean, list(sigmas), correlation)
            low, high = 0.5 * min(sigmas), 1.5 * max(sigmas)
            curve = client.compute_mfpt(
                grown.mesh_id, mean, list(np.linspace(low, high, _CURVE_POINTS)), correlation
            )
            self._progress.show("waiting for the recorder")
            while time.monotonic() < all_there and not self._recorded(grown.mesh_id, len(sigmas)):
                client.spin(_LOOK)
            return {
                "mesh_id": grown.mesh_id,
                "threshold": settings.threshold,
                "clustered": settings.clustered,
                "states": grown.states,
                "generations": grown.generations,
                "swings": grown.swings,
                "swings_resumed": grown.swings_resumed,
                "chunks_repeated": grown.chunks_repeated,
                "seconds": grown.seconds,
                "step_map_seconds": grown.step_map_seconds,
                "estimates": [
                    _estimate(estimate, sigma_deg, settings.controller.name, mean)
                    for estimate, sigma_deg in zip(estimates, sigmas.values(), strict=True)
                ],
                "curve": [{"sigma_s": e.sigma_s, "mfpt": e.mfpt} for e in curve],
            }

    def _recorded(self, mesh_id: str, estimates: int) -> bool:
        """Whether the recorder has heard all of a mesh, and so many estimates of its MFPT."""
        from biped_mfpt_ros.bag import Bag, BagError
        from biped_mfpt_ros.bag.meshes import recorded_meshes

        complete: set[str] = set()
        counts: dict[str, int] = {}
        with suppress(BagError):  # it has no end yet
            bag = Bag(self._bag, unfinished=True)
            try:
                complete.update(found.mesh_id for found in recorded_meshes(bag) if found.mesh)
            finally:
                counts = {name: topic.count for name, topic in bag.topics.items()}
        return mesh_id in complete and counts.get(f"{self.namespace}/mfpt", 0) >= estimates

    def up(self, client: Client) -> bool:
        """Whether all nodes are there."""
        peers = client.peers()
        missing = [what for what, there in asdict(peers).items() if not there]
        self._progress.show(f"starting; waiting for {', '.join(missing)}")
        return not missing

    def watch(self) -> None:
        """End the run when a node that it cannot do without has ended."""
        for child in self._processes.newly_ended():
            self._simulators.discard(child.name)
            message = _last_words(child)
            killed = (child.process.returncode or 0) < 0
            again = self._survives and self._meshers < _MOST_MESHERS
            if child.name.startswith("mesher") and killed and again:
                self._progress.say(f"{message}\nstarting another one, which goes on where it was")
                raise _MesherKilled
            if not child.name.startswith("simulator") or not self._simulators:
                raise CommandError(message)
            self._progress.say(f"{message}\ngoing on with {len(self._simulators)} simulator(s)")


def _last_words(child: Child) -> str:
    return f"{child.name} {child.ending()}; the end of {child.log}:\n{child.log_tail()}"


def _estimate(message: Any, sigma_deg: float, controller: str, mean: float) -> dict[str, Any]:
    codes = zip(message.failure_codes, message.failure_shares, strict=True)
    return estimate_row(controller, mean, sigma_deg, message.correlation, message, dict(codes))


def _walks(
    controller: Controller,
    model: WalkerModel,
    mean: float,
    args: argparse.Namespace,
    estimates: list[dict[str, Any]],
    progress: Progress,
) -> list[dict[str, Any]]:
    """Monte Carlo where the robot falls soon enough."""
    out = []
    for row in estimates:
        if args.walks == 0 or not args.walks * row["mfpt"] <= _MOST_SWINGS:
            continue
        found = monte_carlo(
            controller,
            row["sigma_s"],
            args.walks,
            args.seed,
            mu_s=mean,
            correlation=args.correlation,
            model=model,
            progress=_counting(progress, f"Monte Carlo at sigma {row['sigma_s_deg']:g} deg"),
        )
        out.append(
            {"sigma_s": row["sigma_s"], "sigma_s_deg": row["sigma_s_deg"]}
            | {"walks": args.walks, "seed": args.seed}
            | monte_carlo_result(found)
            | {
                "paper": paper.monte_carlo(
                    controller.name, args.mean, row["sigma_s_deg"], args.correlation
                )
            }
        )
    return out


def _counting(progress: Progress, label: str) -> Callable[[int, int], None]:
    return lambda done, total: progress.count(label, done, total, "walks")


def _draw(
    controller: Controller,
    model: WalkerModel,
    args: argparse.Namespace,
    result: dict[str, Any],
    path: Path,
) -> None:
    """Draw MFPT over sigma beside a walk on slopes of the largest sigma that was asked for."""
    from biped_mfpt_ros.report import pictures

    sigma_deg = max(args.sigma)
    state = find_limit_cycle(controller, 0.0, model).state
    walking = pictures.example_walk(
        controller,
        state,
        math.radians(args.mean),
        math.radians(sigma_deg),
        _PICTURE_STEPS,
        model,
        args.correlation,
    )
    points = [
        (row["sigma_s_deg"], row["paper"], kind)
        for kind, rows in (("mesh", result["estimates"]), ("Monte Carlo", result["monte_carlo"]))
        for row in rows
        if row["paper"] is not None
    ]
    with whole_file(path) as file:
        pictures.save_run(
            file,
            f"{controller.name} on rough ground",
            walking,
            f"a walk on slopes with a standard deviation of {sigma_deg:g}°"
            f"{correlation_text(args.correlation)}",
            np.degrees([point["sigma_s"] for point in result["curve"]]),
            np.array([point["mfpt"] for point in result["curve"]]),
            points,
            [
                (row["sigma_s_deg"], row["mean_steps"], *row["confidence_interval"])
                for row in result["monte_carlo"]
            ],
        )


def _report(result: dict[str, Any]) -> str:
    """What a reader wants to know."""
    parts = [
        f"{result['controller']}: {plural(result['states'], 'state')} in "
        f"{plural(result['generations'], 'generation')}, "
        f"{duration_text(result['seconds'])}"
        f"{ground_text(math.degrees(result['mu_s']), result['correlation'])}",
        mfpt_table(result["estimates"]),
    ]
    if result["monte_carlo"]:
        rows = []
        for row in result["monte_carlo"]:
            low, high = row["confidence_interval"]
            reference = row["paper"]
            rows.append(
                (
                    f"{row['sigma_s_deg']:g} deg",
                    row["mean_steps"],
                    f"{number(low)} to {number(high)}",
                    reference,
                    "" if reference is None else difference(row["mean_steps"], reference),
                )
            )
        headers = ("sigma", "Monte Carlo", "95 % confidence", "paper", "difference")
        parts.append(table(*beside_paper(headers, rows)))
    if result["notes"]:
        parts.append("\n".join(result["notes"]))
    parts.append(
        "A coarse mesh errs, ours and the paper's. Its MFPT settles as --threshold shrinks;\n"
        "where the robot falls soon enough, `biped-mfpt monte-carlo` is the judge."
    )
    parts.append(
        "\n".join(f"{name:<8} {path}" for name, path in result["files"].items() if name != "result")
    )
    return "\n\n".join(parts)
