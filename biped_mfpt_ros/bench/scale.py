"""What one mesher can hand out, with up to 256 simulators that answer without computing.

A mesh is grown in this process and its answers are kept; simulators that look them up (`replay`)
give each after the time that the step map would take. Mesher and simulators share the cores, so
it is the mesher's own CPU time that tells how far it is from its limit.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section
from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds
from biped_mfpt_ros.bench.pipeline import settings_of
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.nodes.messages import MeshSettings

_PROCESSES = 4  # that the simulators are spread over


def recorded(settings: MeshSettings, path: Path) -> tuple[int, float]:
    """Keep all answers of a mesh; returns its states and the CPU seconds of a swing."""
    kept: list[tuple[np.ndarray, Steps]] = []
    inside = 0.0

    def simulate(states: np.ndarray, previous: np.ndarray) -> Steps:
        nonlocal inside
        start = time.thread_time()
        steps = simulate_steps(settings.controller, states, previous, SLOPES, measures=False)
        inside += time.thread_time() - start
        kept.append((states, steps))
        return steps

    assert settings.initial_state is not None
    mesh = grow_mesh(simulate, settings.initial_state, SLOPES, settings.threshold)
    np.savez(
        path,
        states=np.concatenate([states for states, _ in kept]),
        outcomes=np.concatenate([steps.outcomes for _, steps in kept]),
        successors=np.concatenate([steps.next_states for _, steps in kept]),
    )
    return len(mesh.states), inside / (len(mesh.states) - 1)


def with_simulators(
    count: int, swing_seconds: float, settings: MeshSettings, path: Path, states: int
) -> dict[str, Any]:
    """Grow the mesh with that many simulators; figures of the mesher."""
    with Nodes() as nodes:
        mesher = nodes.start("mesher", "mesher")
        processes = min(_PROCESSES, count)
        for i in range(processes):
            share = count // processes + (i < count % processes)
            command = [
                sys.executable, "-m", "biped_mfpt_ros.bench.replay",
                str(path), str(share), str(swing_seconds),
            ]  # fmt: skip
            nodes.start("replay", f"replay_{i}", command)
        nodes.wait(count)
        time.sleep(2.0)  # for the mesher to find them
        nodes.grow(settings)
        before, start = cpu_seconds(mesher), time.perf_counter()
        results = nodes.grow(settings, 2)
        wall = (time.perf_counter() - start) / 2
        cpu = (cpu_seconds(mesher) - before) / 2
        for result in results:
            if result.states != states:
                raise BenchError(f"{result.states} states where {states} were due")
        return {
            "states/s": round(states / wall),
            "us of the mesher's CPU a state": round(1e6 * cpu / states, 1),
            "share of a core that the mesher uses": round(cpu / wall, 2),
        }


def run(short: bool) -> Section:
    """Grow one mesh with more and more simulators."""
    section = Section()
    settings = settings_of("hzd/mfpt", 0.02 if short else 0.002)
    with Nodes() as nodes:
        path = nodes.directory / "answers.npz"
        states, swing = recorded(settings, path)
        for count in (2, 8) if short else (1, 4, 16, 64, 256):
            found = with_simulators(count, swing, settings, path, states)
            section.facts.update(
                {
                    f"{count} simulators of {1e6 * swing:.0f} us a swing: {what}": value
                    for what, value in found.items()
                }
            )
            cost = 1e-6 * found["us of the mesher's CPU a state"]
            section.ratios[f"simulators_that_saturate_a_mesher_of_{count}"] = swing / cost
    return section
