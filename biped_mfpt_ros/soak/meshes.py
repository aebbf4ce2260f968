"""Many meshes in a row through the same nodes: memory stays flat, nothing is left open or slows."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.bench.nodes import held
from biped_mfpt_ros.cli.client import Client
from biped_mfpt_ros.cli.processes import Child, Processes
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.nodes.spin import prepare_environment
from biped_mfpt_ros.report.progress import Progress
from biped_mfpt_ros.soak.result import Row, check
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

MESHES = 1000
SHORT_MESHES = 30

WARM_UP = 0.4
"""Share of the meshes after which memory is compared with that at the end. Until the publishers'
histories of 512 messages are full (`qos.RESULTS`; `mesh/info` has two messages a mesh, and
`mesh/states` one a generation) memory grows on purpose."""

MOST_GROWTH = 0.05
MOST_SLOWDOWN = 1.25
"""Median time of the last fifth of the meshes over that of the fifth after the warm-up: other work
on the machine moves such medians by some 10 %."""


def run(short: bool, seed: int, progress: Progress) -> list[Row]:
    """Grow the meshes, each of other settings, and look at the nodes meanwhile."""
    meshes = SHORT_MESHES if short else MESHES
    random = np.random.default_rng(seed)
    prepare_environment()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as directory, Processes(Path(directory, "logs")) as nodes:
        namespace = f"/soak_{os.getpid()}"
        bag = Path(directory, "bag")
        children = [
            _node(nodes, namespace, "recorder", "-p", f"bag:='{bag}'", last=True),
            _node(nodes, namespace, "mesher"),
            _node(nodes, namespace, "analysis"),
            _node(nodes, namespace, "simulator"),
        ]

        def watch() -> None:
            for child in nodes.newly_ended():
                check(False, f"{child.name} {child.ending()}:\n{child.log_tail()}")

        looks: list[dict[str, dict[str, int]]] = []
        seconds = np.empty(meshes)
        estimates = set()
        with Client(namespace, watch) as client:
            client.wait(lambda: all(vars(client.peers()).values()), 300.0, "the nodes to come up")
            for i in range(meshes):
                progress.count("meshes", i, meshes, "meshes")
                # Two settings in turn, so that equal ones can be compared; the others vary.
                threshold = 1.0 if i % 2 == 0 else float(random.uniform(0.8, 3.0))
                before = time.monotonic()
                grown = client.grow_mesh(_settings(threshold), lambda message: None)
                found = client.published_mfpt(grown.mesh_id, 0.0, [np.radians(1.0)], 60.0)
                seconds[i] = time.monotonic() - before
                if i % 2 == 0:
                    estimates.add(found[0].mfpt)
                looks.append({child.name: held(child.process.pid) for child in children})
        shared = {path for child in children for path in _shared_memory(child.process.pid)}
        shared -= _shared_memory(os.getpid())  # the client leaves at the very end
        nodes.stop()
        whole = (bag / "metadata.yaml").exists()
        left = {path for path in shared if Path(path).exists()}
    return [_judged(meshes, seconds, looks, estimates, whole, left, time.monotonic() - start)]


def _settings(threshold: float) -> MeshSettings:
    return MeshSettings(controller("hzd/base"), WalkerModel(), slope_set(2.0), threshold)


def _node(
    processes: Processes, namespace: str, name: str, *parameters: str, last: bool = False
) -> Child:
    command = [sys.executable, "-m", "biped_mfpt_ros.cli", "node", "--end-with", str(os.getpid())]
    command += [name, "--ros-args", "-r", f"__ns:={namespace}", "-r", "/rosout:=rosout"]
    return processes.start(name, [*command, *parameters], last=last)


def _shared_memory(pid: int) -> set[str]:
    """Segments of Fast DDS that a process has mapped, without those that belong to ports."""
    maps = Path("/proc", str(pid), "maps").read_text()
    return {word for word in maps.split() if re.fullmatch(r"/dev/shm/fastdds_[0-9a-f]+", word)}


def _judged(
    meshes: int,
    seconds: np.ndarray,
    looks: list[dict[str, dict[str, int]]],
    estimates: set[float],
    whole: bool,
    left: set[str],
    total: float,
) -> Row:
    warm, fifth = int(WARM_UP * meshes), max(1, meshes // 5)
    problems = []
    facts: dict[str, Any] = {}
    for name in looks[0]:
        then, now = looks[warm][name], looks[-1][name]
        growth = now["kilobytes"] / then["kilobytes"] - 1.0
        facts[f"{name}_megabytes"] = [then["kilobytes"] // 1000, now["kilobytes"] // 1000]
        if growth > MOST_GROWTH:
            problems.append(f"{name} grew by {100 * growth:.1f} % after the warm-up")
        for what in ("files", "threads"):
            facts[f"{name}_{what}"] = [then[what], now[what]]
            if now[what] > then[what]:
                problems.append(f"{name}: {then[what]} {what} became {now[what]}")
    early, late = np.median(seconds[warm : warm + fifth]), np.median(seconds[-fifth:])
    facts["milliseconds"] = [round(1e3 * float(early), 1), round(1e3 * float(late), 1)]
    if late > MOST_SLOWDOWN * early:
        problems.append(f"a mesh took {1e3 * early:.0f} ms, and {1e3 * late:.0f} ms at the end")
    if len(estimates) != 1:
        problems.append(f"meshes of the same settings have {len(estimates)} different MFPT")
    if not whole:
        problems.append("the bag is not whole")
    facts["bag_whole"] = whole
    facts["shared_memory_files_left"] = sorted(Path(path).name for path in left)
    if left:
        problems.append(f"{len(left)} files were left in /dev/shm")
    return Row("meshes", "meshes in a row", meshes, len(problems), total, facts, problems)
