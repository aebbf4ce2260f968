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

CONTROLLER = controller("hzd/mfpt")
IN_FLIGHT = (1, 2, 4, 8)


def settings_of(threshold: float) -> MeshSettings:
    """The mesh that is grown."""
    state = find_limit_cycle(CONTROLLER).state
    return MeshSettings(CONTROLLER, WalkerModel(), SLOPES, threshold, initial_state=state)


def grow_here(settings: MeshSettings) -> tuple[Mesh, float, float]:
    """The mesh, and the CPU time in the step map and beside it, s."""
    inside = 0.0

    def simulate(states: np.ndarray, previous: np.ndarray) -> Steps:
        nonlocal inside
        start = time.process_time()
        steps = simulate_steps(CONTROLLER, states, previous, SLOPES, measures=False)
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
    settings = settings_of(0.3)
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


def large(nodes: Nodes, processes: dict[str, list[Any]], short: bool) -> Section:
    """A mesh of some 1e4 states with one simulator and with two.

    What the pipeline costs is that of one simulator, without what the step map, tests and targets
    take in this process just before each mesh. The floor is what as many calls of as many bytes
    take just after it, without a mesh: see `Bare`.

    The mesher needs a core, too. So two cores cannot be twice as fast with two simulators as with
    one: at best they share all that there is to compute, and that is the bound beside the
    efficiency.
    """
    settings = settings_of(0.02 if short else 0.0005)
    repetitions = 2 if short else 9
    mesh, _, _ = grow_here(settings)
    n = len(mesh.states) - 1
    successes = np.count_nonzero(mesh.outcomes[1:] == Outcome.STEP)
    nodes.grow(settings)
    requests = requests_of(nodes)
    section = Section()
    walls = {}
    # Step map, tests and targets, mesher, simulator, floor.
    times = np.empty((repetitions, 5))
    seconds = np.empty(repetitions)
    with Nodes() as others:
        bare = Bare(others, round(n / requests), len(SLOPES), round(successes / requests))
        bare.call(requests)
        for i in range(repetitions):
            times[i, :2] = grow_here(settings)[1:]
            seconds[i], *times[i, 2:4] = one(nodes, processes, settings, n)
            times[i, 4] = bare.call(requests)
    for simulators in (1, 2):
        if simulators == 2:
            processes["simulator"].append(nodes.start("simulator", "simulator_2"))
            nodes.wait(2)
            time.sleep(1.0)  # for the mesher to find it
            seconds = np.array([one(nodes, processes, settings, n)[0] for _ in range(repetitions)])
        walls[simulators] = seconds.min()
        what = f"mesh of {n + 1} states, {simulators} simulator(s)"
        section.rows.append(row(what, seconds, 1, "s"))
    names = ("step map", "tests and targets", "mesher", "simulator", "floor of rclpy")
    for name, values in zip(names, times.T, strict=True):
        section.rows.append(row(f"CPU a state, mesh of {n + 1}: {name}", values, n, "us"))
    # Differences of times, so a little below 0 now and then.
    step_map, beside = np.median(times[:, :2], axis=0)
    mesher, simulator = np.median(times[:, 2:4] - times[:, [1, 0]], axis=0)
    floor = np.median(times[:, 4])
    section.facts.update(
        {
            f"us of CPU a state, mesh of {n + 1}: mesher, all else": round(1e6 * mesher / n, 2),
            f"us of CPU a state, mesh of {n + 1}: simulator, all else": round(
                1e6 * simulator / n, 2
            ),
            f"requests, mesh of {n + 1}": requests,
            f"bytes of answers a state, mesh of {n + 1}": round(len(SLOPES) + 80 * successes / n),
        }
    )
    all_work = step_map + beside + mesher + simulator
    section.ratios["efficiency_of_2_simulators"] = walls[1] / (2.0 * walls[2])
    section.ratios["its_bound_on_2_cores"] = min(1.0, walls[1] / all_work)
    section.ratios["pipeline_over_step_map"] = (mesher + simulator) / step_map
    section.ratios["floor_of_rclpy_over_step_map"] = floor / step_map
    section.ratios["pipeline_without_floor_over_step_map"] = (mesher + simulator - floor) / step_map
    return section


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
        parts = [large(nodes, processes, short), small(nodes, processes, short)]
    for part in parts:
        section.rows.extend(part.rows)
        section.ratios.update(part.ratios)
        section.facts.update(part.facts)
    return section
