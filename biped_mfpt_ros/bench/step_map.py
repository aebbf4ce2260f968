"""One swing for all slopes of the set, beside other integrators of the same motion, and the floor.

All that is timed is checked first: against a tolerance of 1e-12, against scipy and against MuJoCo.
Times are of the processor.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from biped_mfpt_ros.bench import measure, rigid_body
from biped_mfpt_ros.bench.flops import counted_flops
from biped_mfpt_ros.bench.measure import SLOPES, BenchError, Section, row
from biped_mfpt_ros.control.controller import Controller, controller, paper_controller_names
from biped_mfpt_ros.gait.closed_loop import closed_loop, piece_of
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.integrate import STAGES, trial_step
from biped_mfpt_ros.gait.scratch import MODE, SIZE, H, Y, empty_scratch
from biped_mfpt_ros.gait.step import Steps, simulate_steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.jit import kernel
from biped_mfpt_ros.lanes import LANES, load, store
from biped_mfpt_ros.study.readings import readings
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel

_SWINGS = 1024  # of a batch that is timed
_RIGID_STEP = 1e-3  # s


def timed(work: Callable[[], object], repetitions: int) -> np.ndarray:
    """Processor seconds of each repetition in this thread, after one that is not counted.

    All that is timed here works on one core and waits for nothing, so what else the machine does
    matters little, nor do the threads of a linear algebra library that wait in a loop.
    """
    return measure.timed(work, repetitions, time.thread_time)


def reached(
    control: Controller, model: WalkerModel | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The flat cycle's state, then states one step from it on every slope, and slopes behind."""
    state = find_limit_cycle(control, 0.0, model).state
    steps = simulate_steps(control, [state], [0.0], SLOPES, model)
    return state, steps.next_states, SLOPES[steps.outcomes[0] == Outcome.STEP]


def starts_of(name: str, flat: bool) -> tuple[Controller, WalkerModel, np.ndarray, np.ndarray]:
    """Controller, model, and the states that are timed with the slopes behind them.

    All that a step from the flat cycle leads to, or with ``flat`` the flat cycle's alone: of the
    others some fall at once, which costs more for each second of motion.
    """
    control, model = controller(name), readings()[name].model
    state, states, previous = reached(control, model)
    if flat:
        return control, model, state[None], np.zeros(1)
    return control, model, states, previous


def labelled(name: str, flat: bool) -> str:
    """How the figures of such swings are called."""
    return f"{name}, flat cycle" if flat else name


def _padded(steps: Steps) -> np.ndarray:
    """States after impact with a place for every slope, shape (n, m, 10)."""
    out = np.zeros((*steps.outcomes.shape, 10))
    out[steps.outcomes == Outcome.STEP] = steps.next_states
    return out


def step_map(
    name: str, repetitions: int, flat: bool
) -> tuple[list[dict[str, Any]], dict[str, Any], dict[bool, float]]:
    """One swing for all 81 slopes, with a check against a tolerance of 1e-12.

    Returns rows, facts, and the median seconds of a swing, without and with measures.
    """
    control, model, states, previous = starts_of(name, flat)
    # About as many as in a request of a large mesh: lanes are idle only as a batch ends.
    copies = 1 + _SWINGS // len(states)
    states, previous = np.tile(states, (copies, 1)), np.tile(previous, copies)

    def swings(model: WalkerModel, measures: bool = False) -> Steps:
        return simulate_steps(control, states, previous, SLOPES, model, measures=measures)

    found, tight = swings(model), swings(replace(model, tolerance=1e-12))
    # The sliding mode is no smooth law: a step that is a fall by a hair may be none.
    other = float((found.outcomes != tight.outcomes).mean())
    if not other <= (0.0 if control.scheme == "hzd" else 1e-3):
        raise BenchError(f"{name}: {other:.1%} of the outcomes change with the tolerance")
    steps = (found.outcomes == Outcome.STEP) & (tight.outcomes == Outcome.STEP)
    error = float(np.abs(_padded(found)[steps] - _padded(tight)[steps]).max())
    if control.scheme == "hzd" and not error <= 1e-6:
        raise BenchError(f"{name}: error {error:g} is above 1e-6")
    seconds = timed(lambda: swings(model), repetitions)
    measured = timed(lambda: swings(model, True), repetitions)
    n = len(states)
    name = labelled(name, flat)
    rows = [
        row(f"{name}: swing, 81 slopes", seconds, n, "us"),
        row(f"{name}: with durations, step lengths, energies", measured, n, "us"),
        row(f"{name}: evaluation, all else included", seconds, found.evaluations, "ns"),
    ]
    facts = {
        f"{name}: error": error,
        f"{name}: outcomes that change with the tolerance": other,
        f"{name}: evaluations a swing": found.evaluations / n,
        f"{name}: steps of the integrator a swing": found.integrator_steps / n,
        f"{name}: impacts a swing": float((found.outcomes == Outcome.STEP).sum() / n),
    }
    medians = {False: float(np.median(seconds)) / n, True: float(np.median(measured)) / n}
    return rows, facts, medians


def cycle_of(name: str) -> tuple[Controller, WalkerModel, np.ndarray]:
    """Controller, model and the flat cycle's state just after impact."""
    control = controller(name)
    return control, WalkerModel(), find_limit_cycle(control, 0.0).state


def swings_of(
    name: str, flat: bool = False
) -> tuple[Controller, WalkerModel, np.ndarray, np.ndarray, np.ndarray]:
    """The swings that `step_map` times, each down to its last impact, or to its fall.

    Without those that fall at once.

    Returns
    -------
    tuple
        Controller, model, states just after impact and at the end, in absolute angles (rad,
        rad/s), shape (n, 10) each, and durations (s), shape (n,).
    """
    control, model, states, previous = starts_of(name, flat)
    durations = simulate_steps(control, states, previous, SLOPES, model).durations
    begun = durations.max(axis=1) > 0.0
    states, previous, durations = states[begun], previous[begun], durations[begun]
    last = durations.argmax(axis=1)
    ends = np.empty_like(states)
    for k, (state, behind, i) in enumerate(zip(states, previous, last, strict=True)):
        trace = trace_swing(control, state, float(behind), float(SLOPES[i]), model)
        if not abs(trace.times[-1] - durations[k, i]) <= 1e-9:
            raise BenchError(f"{name}: swing {k} ends at {trace.times[-1]} s, not as timed")
        ends[k] = dynamics.to_absolute(trace.states[-1])
    starts = np.array([dynamics.to_absolute(state) for state in states])
    return control, model, starts, ends, durations.max(axis=1)


@kernel
def _derivative(scheme, rob, par, w, y, rate, torques):
    """`closed_loop`, of the piece that the state is in."""
    piece = piece_of(scheme, par, (y[0], y[1], y[2], y[3], y[4]))
    closed_loop(scheme, piece, rob, par, w, y, rate, torques)


def _right_side(
    control: Controller, model: WalkerModel, columns: int
) -> Callable[[float, np.ndarray], np.ndarray]:
    """The compiled right-hand side as scipy calls it: 10 columns, or 11 with the energy (J)."""
    rob, par = model.packed(), control.packed(model.robot)
    work, rate, torques = empty_scratch(), np.empty(11), np.empty(4)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        _derivative(control.code, rob, par, work, y, rate, torques)
        return rate[:columns].copy()

    return derivative


def scipy_swings(
    name: str, repetitions: int, energy: bool, flat: bool = False
) -> tuple[np.ndarray, int, float]:
    """Seconds of scipy's RK45 at rtol 1e-6 for the swings timed, on the same compiled right side.

    Also how many swings these are, and the greatest error at their ends, rad or rad/s. With the
    energy it has kinks to step over, wherever a joint's power changes its sign.
    """
    control, model, starts, ends, durations = swings_of(name, flat)
    columns = 11 if energy else 10
    derivative = _right_side(control, model, columns)
    starts = np.column_stack([starts, np.zeros(len(starts))])[:, :columns]  # none spent yet

    def integrate() -> list[np.ndarray]:
        return [
            solve_ivp(derivative, (0.0, duration), start, rtol=1e-6, atol=1e-9).y[:10, -1]
            for start, duration in zip(starts, durations, strict=True)
        ]

    # The swings themselves, to what RK45 is good for: 3e-4 at most was seen.
    error = float(np.abs(np.array(integrate()) - ends).max())
    if not error <= 1e-3:
        raise BenchError(f"{name}: scipy ends {error:g} away")
    return timed(integrate, repetitions), len(starts), error


def stiff_evaluations(name: str) -> tuple[float, float]:
    """Evaluations a swing of scipy's LSODA at rtol 1e-6, the same right side, and its error.

    LSODA turns to an implicit method where the motion is stiff, as near sigma = 0. What it needs
    tells how much harder one control law is than another, whoever integrates it.
    """
    control, model, starts, ends, durations = swings_of(name)
    derivative = _right_side(control, model, 10)
    runs = [
        solve_ivp(derivative, (0.0, duration), start, "LSODA", rtol=1e-6, atol=1e-9)
        for start, duration in zip(starts, durations, strict=True)
    ]
    error = max(float(np.abs(run.y[:, -1] - e).max()) for run, e in zip(runs, ends, strict=True))
    # The bounds about sigma = 0, which it has and the sliding mode has not, move rates by 2e-4.
    if not error <= 1e-3:
        raise BenchError(f"{name}: LSODA ends {error:g} away")
    return sum(run.nfev for run in runs) / len(runs), error


def rigid_body_error(name: str) -> list[float]:
    """How far MuJoCo is from the flat cycle's swing at steps of 1, 1/2 and 1/4 ms, rad and rad/s.

    Checks that in the limit it is the same motion.
    """
    control, model, state = cycle_of(name)
    rob, par = model.packed(), control.packed(model.robot)
    work, rate, applied = empty_scratch(), np.empty(11), np.empty(4)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        closed_loop(control.code, 0.0, rob, par, work, y, rate, applied)
        return rate.copy()

    def torques(y: np.ndarray) -> np.ndarray:
        derivative(0.0, np.append(y, 0.0))
        return applied

    start = np.append(dynamics.to_absolute(state), 0.0)
    landing = float(simulate_steps(control, [state], [0.0], [0.0]).durations[0, 0])
    short = _RIGID_STEP * int(landing / _RIGID_STEP)
    expected = solve_ivp(derivative, (0.0, short), start, "DOP853", rtol=1e-10, atol=1e-10).y[:, -1]
    ends = np.array(
        [
            rigid_body.RigidBody(model.robot, _RIGID_STEP / part).run(start[:10], short, torques)[0]
            for part in (1, 2, 4)
        ]
    )
    errors = np.abs(ends - expected[:10]).max(axis=1).tolist()
    # The engine's method is of order 1: half the step leaves half the error, and what the three
    # runs tend to, by extrapolation, is the same motion.
    halved = 2.0 * ends[1:] - ends[:-1]
    limit = (4.0 * halved[1] - halved[0]) / 3.0
    left = float(np.abs(limit - expected[:10]).max())
    if not (left < 0.03 * errors[0] and all(1.8 < errors[i] / errors[i + 1] < 2.2 for i in (0, 1))):
        raise BenchError(f"{name}: MuJoCo simulates another motion: {errors}, in the limit {left}")
    return errors


def rigid_body_swings(name: str, repetitions: int, flat: bool) -> tuple[np.ndarray, int]:
    """Seconds of MuJoCo for the swings timed at steps of 1 ms, their torques already computed.

    Durations are rounded up to whole steps. Also how many swings these are.
    """
    control, model, starts, _, durations = swings_of(name, flat)
    rob, par = model.packed(), control.packed(model.robot)
    work, rate, applied = empty_scratch(), np.empty(11), np.empty(4)

    def torques(y: np.ndarray) -> np.ndarray:
        _derivative(control.code, rob, par, work, y, rate, applied)
        return applied

    body = rigid_body.RigidBody(model.robot, _RIGID_STEP)
    swings = []
    for start, duration in zip(starts, durations, strict=True):
        _, controls = body.run(start, math.ceil(duration / _RIGID_STEP) * _RIGID_STEP, torques)
        swings.append(body.repetition(start, controls))
    return timed(lambda: [swing() for swing in swings], repetitions), len(swings)


@kernel
def _chains(w, n):
    """Multiply and add in eight independent chains of lanes; 16 n flops a lane."""
    a = load(w, 0, 0)
    b = load(w, 0, 1)
    x0, x1, x2, x3 = load(w, 1, 0), load(w, 1, 1), load(w, 1, 2), load(w, 1, 3)
    x4, x5, x6, x7 = load(w, 1, 4), load(w, 1, 5), load(w, 1, 6), load(w, 1, 7)
    for _ in range(n):
        x0, x1, x2, x3 = x0 * a + b, x1 * a + b, x2 * a + b, x3 * a + b
        x4, x5, x6, x7 = x4 * a + b, x5 * a + b, x6 * a + b, x7 * a + b
    store(w, 2, 0, ((x0 + x1) + (x2 + x3)) + ((x4 + x5) + (x6 + x7)))


@kernel
def _trials(scheme, rob, par, w, n):
    """Try the same step n times, nothing else."""
    for _ in range(n):
        trial_step(scheme, rob, par, w)


def floor(repetitions: int) -> tuple[list[dict[str, Any]], dict[str, Any], float]:
    """What an evaluation costs if the machine only multiplies and adds, and what it does cost."""
    control, model, state = cycle_of("hzd/mfpt")
    flops = counted_flops()
    w = np.full((3, SIZE, LANES), 0.5)
    n = 100_000
    chains = timed(lambda: _chains(w, n), repetitions)
    rate = 16.0 * n * LANES / chains
    w = empty_scratch()
    w[Y, :10] = dynamics.to_absolute(state)[:, None]
    w[MODE, H] = 0.01
    rob, par = model.packed(), control.packed(model.robot)
    tried = timed(lambda: _trials(control.code, rob, par, w, 500), repetitions)
    each = tried / (500 * STAGES * LANES)
    best = sum(flops.values()) / rate
    rows = [
        row("evaluation and its share of a step, nothing else", each, 1, "ns"),
        row("the same if it only multiplied and added", best, 1, "ns"),
    ]
    facts: dict[str, Any] = {f"flops: {what}": count for what, count in flops.items()}
    facts["multiplications and additions a second, in lanes"] = float(np.median(rate))
    return rows, facts, float(np.median(each) / np.median(best))


def run(short: bool) -> Section:
    """Time the step map, after checking it."""
    repetitions = 3 if short else 15
    section = Section()
    medians = {}
    for name in paper_controller_names():
        for flat in (False, True) if name.startswith("hzd/") else (False,):
            rows, facts, medians[name, flat] = step_map(name, repetitions, flat)
            section.rows.extend(rows)
            section.facts.update(facts)
    rows, facts, section.ratios["evaluation_over_floor"] = floor(repetitions)
    section.rows.extend(rows)
    section.facts.update(facts)
    for label in ("base", "cot", "mfpt"):
        hzd, smc = f"hzd/{label}", f"smc/{label}"
        for flat in (False, True):
            _compare(section, hzd, flat, medians[hzd, flat], repetitions)
        if rigid_body.mujoco is None:
            section.facts["MuJoCo"] = "not installed: pip install -r requirements/bench.txt"
        else:
            section.facts[f"{hzd}: error of MuJoCo at 1, 1/2, 1/4 ms"] = rigid_body_error(hzd)
        ratio = medians[smc, False][False] / medians[hzd, False][False]
        section.ratios[f"smc_over_hzd: {label}"] = ratio
        stiff = {}
        for one in (hzd, smc):
            stiff[one], error = stiff_evaluations(one)
            section.facts[f"{one}: evaluations a swing of scipy LSODA, rtol 1e-6"] = stiff[one]
            section.facts[f"{one}: error of scipy LSODA"] = error
        section.ratios[f"lsoda_evaluations_smc_over_hzd: {label}"] = stiff[smc] / stiff[hzd]
    return section


def _compare(
    section: Section, name: str, flat: bool, medians: dict[bool, float], repetitions: int
) -> None:
    """Others beside the step map, which takes ``medians`` (s) without and with measures."""
    label = labelled(name, flat)
    for energy, what in ((False, label), (True, f"{label}, energies")):
        seconds, n, error = scipy_swings(name, repetitions, energy, flat)
        section.rows.append(row(f"{what}: swing by scipy RK45, rtol 1e-6", seconds, n, "us"))
        section.facts[f"{what}: error of scipy RK45"] = error
        ratio = float(np.median(seconds)) / n / medians[energy]
        section.ratios[f"scipy_over_step_map: {what}"] = ratio
    if rigid_body.mujoco is not None:
        seconds, n = rigid_body_swings(name, repetitions, flat)
        section.rows.append(row(f"{label}: swing by MuJoCo, 1 ms", seconds, n, "us"))
        ratio = float(np.median(seconds)) / n / medians[False]
        section.ratios[f"rigid_body_engine_over_step_map: {label}"] = ratio
