"""One swing for all slopes of the set, beside scipy's integrator on the same right-hand side."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section, row, timed
from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.gait.closed_loop import closed_loop
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel


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
    rate, torques = np.empty(11), np.empty(4)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        closed_loop(control.code, False, rob, par, y, rate, torques)
        return rate.copy()

    start = np.append(dynamics.to_absolute(state), 0.0)
    return timed(
        lambda: solve_ivp(derivative, (0.0, duration), start, rtol=1e-6, atol=1e-9), repetitions
    )


def run(short: bool) -> Section:
    """Time the step map, after checking it."""
    repetitions = 3 if short else 15
    section = Section()
    medians = {}
    for name in ("hzd/base", "hzd/cot", "hzd/mfpt", "smc/mfpt"):
        rows, seconds = step_map(name, repetitions)
        section.rows.extend(rows)
        medians[name] = float(np.median(seconds))
    scipy = scipy_swing("hzd/base", repetitions)
    section.rows.append(row("hzd/base: swing by scipy RK45, rtol 1e-6, no events", scipy, 1, "us"))
    section.ratios["scipy_over_step_map"] = float(np.median(scipy)) / medians["hzd/base"]
    section.ratios["smc_over_hzd"] = medians["smc/mfpt"] / medians["hzd/mfpt"]
    return section
