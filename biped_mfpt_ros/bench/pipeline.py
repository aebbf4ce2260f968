"""Meshes through the pipeline: what it costs beside the step map, and how it scales.

Costs are CPU times of the processes, as other work on the machine changes those the least. That of
the step map, and of testing and targets, is taken in this process, on the same states.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section, row
from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds
from biped_mfpt_ros.chain.mesh import Mesh, grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.nodes.messages import MeshSettings
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


def large(nodes: Nodes, processes: dict[str, list[Any]], short: bool) -> Section:
    """A mesh of some 1e4 states with one simulator and with two.

    The mesher needs a core, too. So two cores cannot be twice as fast with two simulators as with
    one: at best they share all that there is to compute, and that is the bound beside the
    efficiency.
    """
    settings = settings_of(0.02 if short else 0.0005)
    repetitions = 2 if short else 5
    here = [grow_here(settings) for _ in range(repetitions)]
    n = len(here[0][0].states) - 1
    step_map, beside = (min(times) for times in zip(*[grown[1:] for grown in here], strict=True))
    section = Section()
    walls = {}
    overhead = []
    for simulators in (1, 2):
        if simulators == 2:
            processes["simulator"].append(nodes.start("simulator", "simulator_2"))
            nodes.wait(2)
            time.sleep(1.0)  # for the mesher to find it
        seconds = []
        for _ in range(repetitions):
            before = {name: sum(map(cpu_seconds, group)) for name, group in processes.items()}
            (result,) = nodes.grow(settings)
            if (result.states, result.swings) != (n + 1, n):
                raise BenchError(f"{result.states} states, {result.swings} swings; {n + 1} is due")
            cpu = {
                name: sum(map(cpu_seconds, group)) - before[name]
                for name, group in processes.items()
            }
            seconds.append(result.seconds)
            overhead.append((cpu["mesher"] - beside, cpu["simulator"] - step_map))
        walls[simulators] = min(seconds)
        section.rows.append(
            row(f"mesh of {n + 1} states, {simulators} simulator(s)", np.array(seconds), 1, "s")
        )
    # Differences of times, so a little below 0 now and then.
    mesher, simulator = np.min(overhead, axis=0)
    section.facts.update(
        {
            f"us of CPU a state, mesh of {n + 1}: {what}": round(1e6 * value / n, 2)
            for what, value in (
                ("step map", step_map),
                ("tests and targets", beside),
                ("mesher, all else", mesher),
                ("simulator, all else", simulator),
            )
        }
    )
    section.ratios["efficiency_of_2_simulators"] = walls[1] / (2.0 * walls[2])
    all_work = step_map + beside + float(mesher + simulator)
    section.ratios["its_bound_on_2_cores"] = min(1.0, walls[1] / all_work)
    section.ratios["pipeline_over_step_map"] = float(mesher + simulator) / step_map
    return section


def run(short: bool) -> Section:
    """Grow meshes through mesher and simulators in processes of their own."""
    section = Section()
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
