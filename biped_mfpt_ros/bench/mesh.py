"""Mesh, chain and walks, in this process."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from biped_mfpt_ros.bench.measure import SLOPES, Section, row, timed
from biped_mfpt_ros.bench.step_map import reached
from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import Steps, simulate_steps


def whole(threshold: float, repetitions: int) -> list[dict[str, Any]]:
    """Mesh, chain and walks of hzd/mfpt in this process."""
    control = controller("hzd/mfpt")
    state, _, _ = reached(control)
    inside: list[float] = []

    def simulate(states: np.ndarray, previous: np.ndarray) -> Steps:
        steps = simulate_steps(control, states, previous, SLOPES, measures=False)
        inside.append(steps.seconds)
        return steps

    mesh = grow_mesh(simulate, state, SLOPES, threshold)
    n = len(mesh.states)
    seconds = timed(lambda: grow_mesh(simulate, state, SLOPES, threshold), repetitions)
    inside.clear()
    start = time.perf_counter()
    grow_mesh(simulate, state, SLOPES, threshold)
    share = sum(inside) / (time.perf_counter() - start)
    solved = timed(lambda: metastability(mesh, 0.0, math.radians(1.0)), repetitions)
    walks = timed(
        lambda: monte_carlo(control, math.radians(2.0), 200, 1, state=state, threads=1), repetitions
    )
    taken = monte_carlo(control, math.radians(2.0), 200, 1, state=state).steps.sum()
    return [
        row(f"mesh of {n} states, {share:.0%} in the step map, a state", seconds, n, "us"),
        row(f"chain of {n} states x 81 slopes", solved, 1, "ms"),
        row("Monte Carlo on one core, a step", walks, taken, "us"),
    ]


def run(short: bool) -> Section:
    """Time a mesh and what comes after it."""
    return Section(rows=whole(0.1 if short else 0.01, 3 if short else 15))
