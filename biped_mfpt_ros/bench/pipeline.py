"""Meshes through the pipeline: what it costs beside the step map, and how it scales.

Costs are CPU times of the processes, as other work on the machine changes those the least. That of
the step map, and of testing and targets, is taken in this process, on the same states.
"""

from __future__ import annotations

import re
import time
from typing import Any

import numpy as np

from biped_mfpt_ros.bench.bare import Bare
from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section, row
from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds
from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.nodes.spin import keep_freed_memory
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel

IN_FLIGHT = (1, 2, 4, 8)


def settings_of(name: str, threshold: float) -> MeshSettings:
    """The mesh that is grown."""
    walking = controller(name)
    state = find_limit_cycle(walking).state
    return MeshSettings(walking, WalkerModel(), SLOPES, threshold, initial_state=state)


def grow_here(settings: MeshSettings) -> tuple[Mesh, float, float]:
    """The mesh, and the CPU time in the step map and beside it, s."""
    inside = 0.0

    def simulate(states: np.ndarray, previous: np.ndarray) -> Steps:
        nonlocal inside
        start = time.process_time()
        steps = simulate_steps(settings.controller, states, previous, SLOPES, measures=False)
        inside += time.process_time() - start
        return steps

    assert settings.initial_state is not None
    start = time.process_time()
    mesh = grow_mesh(
        simulate,
        settings.initial_state,
        SLOPES,
        settings.threshold,
        max_states=settings.max_states,
    )
    return mesh, inside, time.process_time() - start - inside


def small(nodes: Nodes, processes: dict[str, list[Any]], short: bool) -> Section:
    """Meshes of the paper's HZD setting, several at a time: what an optimiser asks for."""
    settings = settings_of("hzd/mfpt", 0.3)
    mesh, step_map, beside = min((grow_here(settings) for _ in range(5)), key=lambda m: m[1])
    section = Section()
    total = 16 if short else 60
    nodes.grow(settings, 8, 4)
    for in_flight in IN_FLIGHT:
        before = {name: sum(map(cpu_seconds, group)) for name, group in processes.items()}
        start = time.perf_counter()
        results = nodes.grow(settings, total, in_flight)
        wall = time.perf_counter() - start
        cpu = {
            name: (sum(map(cpu_seconds, group)) - before[name]) / total
            for name, group in processes.items()
        }
        section.facts[f"meshes/s, {len(mesh.states)} states, {in_flight} in flight"] = round(
            total / wall, 1
        )
        if in_flight == 4:
            section.rows.extend(
                row(f"mesh of {len(mesh.states)} states: {what}", np.array([seconds]), 1, "ms")
                for what, seconds in (
                    ("CPU, step map", step_map),
                    ("CPU, tests and targets", beside),
                    ("CPU of the mesher", cpu["mesher"]),
                    ("CPU of the simulators", cpu["simulator"]),
                    ("from goal to result", float(np.median([r.seconds for r in results]))),
                )
            )
            outside = sum(cpu.values()) - step_map
            section.ratios["small_mesh_cpu_outside_step_map_over_step_map"] = outside / step_map
    return section


def requests_of(nodes: Nodes) -> int:
    """Requests that the mesher's last mesh took, as it logged them."""
    found = re.findall(r"(\d+) requests, ", (nodes.directory / "mesher.log").read_text())
    if not found:
        raise BenchError("the mesher has logged no mesh")
    return int(found[-1])


class Large:
    """A mesh of some 1e4 states with one simulator, and later with two.

    What the pipeline costs is that of one simulator, without what the step map, tests and targets
    take in this process just before each mesh. The floor is what as many calls of as many bytes
    take just after it, without a mesh: see `Bare`.

    The mesher needs a core, too. So two cores cannot be twice as fast with two simulators as with
    one: at best they share all that there is to compute, and that is the bound beside the
    efficiency.
    """

    def __init__(self, name: str, threshold: float, repetitions: int) -> None:
        self._name = name
        self._settings = settings_of(name, threshold)
        self._repetitions = repetitions
        mesh, _, _ = grow_here(self._settings)
        self._n = len(mesh.states) - 1
        self._successes = int(np.count_nonzero(mesh.outcomes[1:] == Outcome.STEP))
        self.section = Section()

    def _row(self, simulators: int, seconds: np.ndarray) -> None:
        what = f"{self._name}, mesh of {self._n + 1} states, {simulators} simulator(s)"
        self.section.rows.append(row(what, seconds, 1, "s"))

    def with_one(self, nodes: Nodes, processes: dict[str, list[Any]]) -> None:
        """Grow it with the one simulator that there is."""
        n, settings = self._n, self._settings
        nodes.grow(settings)
        requests = requests_of(nodes)
        # Step map, tests and targets, mesher, simulator, floor.
        times = np.empty((self._repetitions, 5))
        seconds = np.empty(self._repetitions)
        with Nodes() as others:
            bare = Bare(others, round(n / requests), len(SLOPES), round(self._successes / requests))
            bare.call(requests)
            for i in range(self._repetitions):
                times[i, :2] = grow_here(settings)[1:]
                seconds[i], *times[i, 2:4] = one(nodes, processes, settings, n)
                times[i, 4] = bare.call(requests)
        self._row(1, seconds)
        self._alone = seconds.min()
        what = f"{self._name}, mesh of {n + 1}"
        names = ("step map", "tests and targets", "mesher", "simulator", "floor of rclpy")
        for name, values in zip(names, times.T, strict=True):
            self.section.rows.append(row(f"CPU a state, {what}: {name}", values, n, "us"))
        # Differences of times, so a little below 0 now and then.
        step_map, beside = np.median(times[:, :2], axis=0)
        mesher, simulator = np.median(times[:, 2:4] - times[:, [1, 0]], axis=0)
        floor = np.median(times[:, 4])
        us = f"us of CPU a state, {what}"
        self.section.facts.update(
            {
                f"{us}: mesher, all else": round(1e6 * mesher / n, 2),
                f"{us}: simulator, all else": round(1e6 * simulator / n, 2),
                f"requests, {what}": requests,
                f"bytes of answers a state, {what}": round(len(SLOPES) + 80 * self._successes / n),
            }
        )
        bound = self._alone / (step_map + beside + mesher + simulator)
        ratios = {
            "bound_on_efficiency_on_2_cores": min(1.0, bound),
            "pipeline_over_step_map": (mesher + simulator) / step_map,
            "floor_of_rclpy_over_step_map": floor / step_map,
            "pipeline_without_floor_over_step_map": (mesher + simulator - floor) / step_map,
        }
        self.section.ratios.update({f"{k}: {self._name}": v for k, v in ratios.items()})

    def with_two(self, nodes: Nodes, processes: dict[str, list[Any]]) -> None:
        """Grow it again, with two."""
        tries = range(self._repetitions)
        seconds = np.array([one(nodes, processes, self._settings, self._n)[0] for _ in tries])
        self._row(2, seconds)
        efficiency = self._alone / (2.0 * seconds.min())
        self.section.ratios[f"efficiency_of_2_simulators: {self._name}"] = efficiency


def one(
    nodes: Nodes, processes: dict[str, list[Any]], settings: MeshSettings, n: int
) -> tuple[float, float, float]:
    """Grow a mesh of n states and x_1: its time, and the mesher's and simulators' CPU times, s."""
    before = {name: sum(map(cpu_seconds, group)) for name, group in processes.items()}
    (result,) = nodes.grow(settings)
    if (result.states, result.swings) != (n + 1, n):
        raise BenchError(f"{result.states} states, {result.swings} swings; {n + 1} is due")
    cpu = {name: sum(map(cpu_seconds, group)) - before[name] for name, group in processes.items()}
    return result.seconds, cpu["mesher"], cpu["simulator"]


def run(short: bool) -> Section:
    """Grow meshes through mesher and simulators in processes of their own."""
    section = Section()
    keep_freed_memory()  # as the nodes do
    with Nodes() as nodes:
        processes = {
            "mesher": [nodes.start("mesher", "mesher", meshes_at_once=max(IN_FLIGHT))],
            "simulator": [nodes.start("simulator", "simulator_1")],
        }
        nodes.wait(1)
        time.sleep(1.0)
        meshes = [Large("hzd/mfpt", 0.02, 2)] if short else [
            Large("hzd/mfpt", 0.0005, 9),
            Large("smc/mfpt", 0.07, 3),
        ]  # fmt: skip
        for mesh in meshes:
            mesh.with_one(nodes, processes)
        processes["simulator"].append(nodes.start("simulator", "simulator_2"))
        nodes.wait(2)
        time.sleep(1.0)  # for the mesher to find it
        for mesh in meshes:
            mesh.with_two(nodes, processes)
        parts = [*(mesh.section for mesh in meshes), small(nodes, processes, short)]
    for part in parts:
        section.rows.extend(part.rows)
        section.ratios.update(part.ratios)
        section.facts.update(part.facts)
    return section
