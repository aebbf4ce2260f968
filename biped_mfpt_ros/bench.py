"""Benchmarks, measured side by side in one run: `make bench`.

Times depend on the machine, ratios less so. Every figure is the median over repetitions, with the
smallest and the largest beside it. What is timed is checked first: a wrong result is an error.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.gait.closed_loop import closed_loop
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.report.tables import table
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

SLOPES = slope_set(0.5)


class BenchError(AssertionError):
    """What was timed came out wrong."""


def timed(work: Callable[[], object], repetitions: int) -> np.ndarray:
    """Seconds of each repetition, after one that is not counted; shape (repetitions,)."""
    work()
    out = np.empty(repetitions)
    for i in range(repetitions):
        start = time.perf_counter()
        work()
        out[i] = time.perf_counter() - start
    return out


def row(what: str, seconds: np.ndarray, per: float, unit: str) -> dict[str, Any]:
    """A line of the result: median and extremes of ``seconds / per``, in a unit of seconds."""
    scale = {"us": 1e6, "ns": 1e9, "ms": 1e3, "s": 1.0}[unit] / per
    return {
        "what": what,
        "median": float(np.median(seconds) * scale),
        "low": float(seconds.min() * scale),
        "high": float(seconds.max() * scale),
        "unit": unit,
    }


def reached(control: Controller) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The flat cycle's state, then states one step from it on every slope, and slopes behind."""
    state = find_limit_cycle(control).state
    steps = simulate_steps(control, [state], [0.0], SLOPES)
    return state, steps.next_states, SLOPES[steps.outcomes[0] == Outcome.STEP]


def step_map(name: str, repetitions: int) -> tuple[list[dict[str, Any]], np.ndarray]:
    """One swing for all 81 slopes, with a check against a tolerance of 1e-12."""
    control = controller(name)
    _, states, previous = reached(control)

    def swings(model: WalkerModel | None = None) -> Steps:
        return simulate_steps(control, states, previous, SLOPES, model)

    found, tight = swings(), swings(WalkerModel(tolerance=1e-12))
    if not np.array_equal(found.outcomes, tight.outcomes):
        raise BenchError(f"{name}: outcomes change with the tolerance")
    error = float(np.abs(found.next_states - tight.next_states).max())
    if name.startswith("hzd/") and not error <= 1e-6:
        raise BenchError(f"{name}: error {error:g} is above 1e-6")
    seconds = timed(swings, repetitions)
    rows = [
        row(f"{name}: swing, 81 slopes, error {error:.0e}", seconds, len(states), "us"),
        row(f"{name}: evaluation, of {found.evaluations}", seconds, found.evaluations, "ns"),
    ]
    return rows, seconds / len(states)


def scipy_swing(name: str, repetitions: int) -> np.ndarray:
    """Seconds of scipy's RK45 at rtol 1e-6 for the same swing, on the same compiled right side."""
    control, model = controller(name), WalkerModel()
    state, _, _ = reached(control)
    duration = simulate_steps(control, [state], [0.0], SLOPES).durations[0, 0]
    rob, par = model.packed(), control.packed(model.robot)
    work = np.zeros((dynamics.WORKSPACE_ROWS, 5))
    rate = np.empty(11)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        closed_loop(control.code, False, rob, par, work, y, rate)
        return rate.copy()

    start = np.append(dynamics.to_absolute(state), 0.0)
    return timed(
        lambda: solve_ivp(derivative, (0.0, duration), start, rtol=1e-6, atol=1e-9), repetitions
    )


def pipeline(threshold: float, repetitions: int) -> list[dict[str, Any]]:
    """Mesh, chain and walks of hzd/mfpt in this process."""
    control = controller("hzd/mfpt")
    state, _, _ = reached(control)
    inside: list[float] = []

    def simulate(states: np.ndarray, previous: np.ndarray) -> Steps:
        steps = simulate_steps(control, states, previous, SLOPES)
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


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks and print them."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--short", action="store_true", help="fewer repetitions, a smaller mesh")
    args = parser.parse_args(arguments)
    repetitions = 3 if args.short else 15
    rows: list[dict[str, Any]] = []
    try:
        medians = {}
        for name in ("hzd/base", "hzd/cot", "hzd/mfpt", "smc/mfpt"):
            more, seconds = step_map(name, repetitions)
            rows += more
            medians[name] = float(np.median(seconds))
        scipy = scipy_swing("hzd/base", repetitions)
        rows.append(row("hzd/base: swing by scipy RK45, rtol 1e-6, no events", scipy, 1, "us"))
        rows += pipeline(0.1 if args.short else 0.01, repetitions)
    except BenchError as error:
        print(f"make bench: {error}", file=sys.stderr)
        return 1
    ratios = {
        "scipy_over_step_map": float(np.median(scipy)) / medians["hzd/base"],
        "smc_over_hzd": medians["smc/mfpt"] / medians["hzd/mfpt"],
    }
    if args.json:
        print(json.dumps({"rows": rows, "ratios": ratios}, indent=2))
        return 0
    print(
        table(
            ("what", "median", "low", "high", "unit"),
            [(r["what"], r["median"], r["low"], r["high"], r["unit"]) for r in rows],
        )
    )
    print(f"\nscipy over ours, hzd/base: {ratios['scipy_over_step_map']:.0f}")
    print(f"sliding mode over HZD, the MFPT controllers: {ratios['smc_over_hzd']:.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
