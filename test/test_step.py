"""One step: against other integrators, the paper's remarks, and anything that comes in."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import DOP853, solve_ivp

from biped_mfpt_ros.control.controller import (
    Controller,
    controller,
    controller_names,
    paper_controller_names,
)
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait import energy, integrate
from biped_mfpt_ros.gait.closed_loop import closed_loop
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.scratch import empty_scratch
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.walker import dynamics
from biped_mfpt_ros.walker.impact import impact_map
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import ABSOLUTE, WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import slope_set

HZD_NAMES = [n for n in paper_controller_names() if n.startswith("hzd/")]
SLOPES = slope_set(0.5)
ROBOT = rabbit()


def with_torque_off(name, phase):
    """The controller, without torque beyond a phase tau (section 6.3)."""
    base = controller(name)
    return Controller(f"{name}-off", "hzd", np.append(base.parameters, phase))


@cache
def cycle_state(name):
    """State of the flat limit cycle."""
    return find_limit_cycle(controller(name)).state


def reachable(name, generations=2):
    """States within some steps of the flat cycle on all slopes, and the slopes behind them."""
    control = controller(name)
    states, previous = find_limit_cycle(control).state[None], np.zeros(1)
    for _ in range(generations):
        steps = simulate_steps(control, states, previous, SLOPES)
        states = steps.next_states
        previous = SLOPES[np.nonzero(steps.outcomes == Outcome.STEP)[1]]
    return control, states, previous


def walk(control, state, slope, steps, model):
    """Steps taken down a constant slope before a fall, from a state after a flat step."""
    previous = 0.0
    for taken in range(steps):
        result = simulate_steps(control, [state], [previous], [slope], model)
        if result.outcomes[0, 0] != Outcome.STEP:
            return taken
        state, previous = result.next_states[0], slope
    return steps


def test_coefficients_of_the_integrator():
    """To rounding: scipy tabulates the same pair."""
    weights = np.zeros((16, 16))
    for stage, row in enumerate(integrate._STAGES, 1):
        for j, weight in row:
            weights[stage, j] = weight
    assert np.allclose(weights[:12, :12], DOP853.A, rtol=1e-15, atol=0)
    assert np.allclose(weights[12, :12], DOP853.B, rtol=1e-15, atol=0)
    assert np.allclose(weights[13:], DOP853.A_EXTRA, rtol=1e-15, atol=0)
    assert np.allclose(integrate._ERROR_5, DOP853.E5[:12], rtol=1e-14, atol=0)
    assert np.allclose(integrate._ERROR_3, DOP853.E3[:12], rtol=1e-14, atol=0)
    assert np.allclose(integrate._DENSE, DOP853.D, rtol=1e-14, atol=0)
    nodes = [0.0, DOP853.C[5], DOP853.C[9], DOP853.C[10], 1.0]
    assert np.allclose(energy._NODES, nodes, rtol=1e-14, atol=0)


def test_a_swing_agrees_with_scipy():
    """Base gait on the flat: other integrator, event location and impact time."""
    control, model = controller("hzd/base"), WalkerModel()
    state = find_limit_cycle(control).state
    rob, par = model.packed(), control.packed(ROBOT)
    work, torques = empty_scratch(), np.empty(4)

    def derivative(t, y):
        out = np.empty(11)
        closed_loop(control.code, 0.0, rob, par, work, np.asarray(y), out, torques)
        return out

    def height(t, y):
        return dynamics.swing_foot(rob, y)[1] if t > 0.1 else 1.0

    height.terminal, height.direction = True, -1
    y0 = np.append(dynamics.to_absolute(state), 0.0)
    solution = solve_ivp(
        derivative, (0, 1), y0, method="DOP853", rtol=1e-12, atol=1e-12, events=height
    )
    before = dynamics.to_joint(solution.y_events[0][0][:10])
    expected, _ = impact_map(before, ROBOT)
    found = simulate_steps(control, [state], [0.0], [0.0], model)
    # 1e-6 is what the default tolerance promises.
    assert found.durations[0, 0] == pytest.approx(solution.t_events[0][0], abs=1e-7)
    assert np.abs(found.next_states[0] - expected).max() <= 1e-6
    assert found.energies[0, 0] == pytest.approx(solution.y_events[0][0][10], rel=1e-4)


@pytest.mark.parametrize("name", [n for n in controller_names() if not n.startswith("smc/")])
def test_default_error_is_at_most_1e_6(name):
    """Every component of every state after impact, over states reached on rough ground."""
    control, states, previous = reachable(name)
    found = simulate_steps(control, states, previous, SLOPES)
    tight = simulate_steps(control, states, previous, SLOPES, WalkerModel(tolerance=1e-12))
    assert np.array_equal(found.outcomes, tight.outcomes)
    assert np.abs(found.next_states - tight.next_states).max() <= 1e-6


@pytest.mark.parametrize(
    ("name", "q", "dq"),
    [
        # For 2 ms of a step of 33 ms; left out, it would move the next state by 4e-6.
        (
            "hzd/base",
            [3.610864, 3.036726, -0.411109, -0.321248, -0.014467],
            [0.459041, -1.847721, -3.682364, 0.926897, 0.103176],
        ),
        # For 7 ms, before another torque leaves its limit in the same step: 9e-5.
        (
            "spline/robust",
            [3.4612, 3.3712, -0.4637, -0.6784, 0.0205],
            [1.672, 2.0511, -3.396, -4.2131, -0.3118],
        ),
    ],
)
def test_a_torque_beyond_its_limit_between_two_stages_is_cut_off(name, q, dq):
    states, control = [q + dq], controller(name)
    found = simulate_steps(control, states, [0.0], SLOPES)
    tight = simulate_steps(control, states, [0.0], SLOPES, WalkerModel(tolerance=1e-12))
    assert (found.outcomes == tight.outcomes).all()
    assert np.abs(found.next_states - tight.next_states).max() <= 1e-6


def test_error_falls_with_the_tolerance_as_the_order_says():
    """Eighth order: error ~ h^8 ~ 1 / steps^8, and in proportion to the tolerance.

    On a smooth swing: no torque saturates. The proportion holds on average; within a factor of
    ten for a step that ends where it falls.
    """
    control, model = controller("hzd/base"), WalkerModel(torque_limit=math.inf, friction=1e6)
    state = find_limit_cycle(control).state
    tight = simulate_steps(control, [state], [0.0], [0.0], replace(model, tolerance=1e-13))
    tolerances = 1e-6 * 0.5 ** np.arange(20)
    errors, steps = [], []
    for tolerance in tolerances:
        found = simulate_steps(control, [state], [0.0], [0.0], replace(model, tolerance=tolerance))
        errors.append(np.abs(found.next_states - tight.next_states).max())
        steps.append(found.integrator_steps)
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 0.8 <= slope <= 1.2
    assert 7.0 <= order <= 9.5


@pytest.mark.parametrize("name", ["hzd/mfpt", "smc/mfpt"])
def test_one_swing_for_all_slopes_is_the_swings_for_each(name):
    """Bit for bit: what lies further down does not change what came before."""
    control, states, previous = reachable(name, 1)
    states, previous = states[::9], previous[::9]
    together = simulate_steps(control, states, previous, SLOPES)
    apart = [simulate_steps(control, states, previous, [slope]) for slope in SLOPES]
    assert np.array_equal(together.outcomes, np.hstack([s.outcomes for s in apart]))
    # A fall of the body or of the whole is timed alike, and every step lands alike.
    assert np.array_equal(together.durations, np.hstack([s.durations for s in apart]))
    assert np.array_equal(together.energies, np.hstack([s.energies for s in apart]))
    for i in range(len(SLOPES)):
        chosen = np.nonzero(together.outcomes == Outcome.STEP)[1] == i
        assert np.array_equal(together.next_states[chosen], apart[i].next_states)


@pytest.mark.parametrize("name", ["hzd/mfpt", "smc/mfpt"])
def test_steps_are_the_same_without_their_measures(name):
    control, states, previous = reachable(name, 1)
    with_all = simulate_steps(control, states, previous, SLOPES)
    without = simulate_steps(control, states, previous, SLOPES, measures=False)
    assert without.outcomes.tobytes() == with_all.outcomes.tobytes()
    assert without.next_states.tobytes() == with_all.next_states.tobytes()
    assert without.evaluations == with_all.evaluations
    for measured in (without.durations, without.step_lengths, without.energies):
        assert measured.shape == (0, SLOPES.size)


def test_impact_is_where_the_foot_meets_the_slope():
    """To 1e-9 s: the foot, faster than 0.1 m/s, is within 1e-10 m of the slope."""
    control, states, previous = reachable("hzd/mfpt")
    steps = simulate_steps(control, states, previous, SLOPES)
    slopes = SLOPES[np.nonzero(steps.outcomes == Outcome.STEP)[1]]
    a = steps.next_states[:, :5] @ ABSOLUTE.T
    foot = np.stack([-np.sin(a), np.cos(a)], axis=-1).transpose(0, 2, 1) @ ROBOT.swing_foot_position
    # The new swing foot stands behind, on the slope just walked.
    assert (foot[:, 0] < 0).all()
    assert np.abs(foot[:, 1] * np.cos(slopes) - foot[:, 0] * np.sin(slopes)).max() < 1e-10
    assert np.hypot(*foot.T) == pytest.approx(steps.step_lengths[steps.outcomes == 0], abs=1e-12)


def test_energy_is_conserved_without_torques():
    """To 1e-8 relative over a whole swing, with the torques off from the start."""
    control = with_torque_off("hzd/base", -math.inf)
    base = controller("hzd/base")
    trace = trace_swing(base, find_limit_cycle(base).state, 0.0, 0.0)
    # From within the swing, the foot still behind, and faster.
    state = trace.states[np.searchsorted(trace.times, 0.15)] * np.repeat([1.0, 1.5], 5)
    model = WalkerModel(friction=math.inf, tolerance=1e-9)
    trace = trace_swing(control, state, 0.0, math.radians(-20), model)
    energy = np.array([sum(dynamics.energy(x, ROBOT)) for x in trace.states])
    assert trace.times[-1] > 0.3
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-8
    assert np.array_equal(trace.torques, np.zeros_like(trace.torques))


def test_base_cannot_walk_down_one_degree():
    """Section 6.3: "cannot take more than several steps", here under 50 N m."""
    control = controller("hzd/base")
    state = find_limit_cycle(control).state
    assert walk(control, state, math.radians(-1.0), 10, WalkerModel()) < 10
    assert walk(control, state, 0.0, 50, WalkerModel()) == 50


def test_without_torque_late_in_the_step_base_walks_down_nine_degrees():
    """Section 6.3: no torque for tau > 0.95, no limit; it walks on the flat too."""
    control, model = with_torque_off("hzd/base", 0.95), WalkerModel(torque_limit=math.inf)
    flat = find_limit_cycle(control, 0.0, model)
    assert walk(control, flat.state, 0.0, 100, model) == 100
    down = math.radians(-9.0)
    cycle = find_limit_cycle(control, down, model)
    assert cycle.stable
    state = cycle.state
    for _ in range(100):
        result = simulate_steps(control, [state], [down], [down], model)
        assert result.outcomes[0, 0] == Outcome.STEP
        state = result.next_states[0]


def test_a_foot_that_comes_down_behind_stands_on_the_ground():
    """To 1e-9 m beyond what it may be below: impacts are found to 1e-12 s."""
    control, states, previous = reachable("hzd/cot", 1)
    rng = np.random.default_rng(2)
    states = np.tile(states, (20, 1)) * (1.0 + 0.05 * rng.standard_normal((20 * len(states), 10)))
    previous = np.tile(previous, 20)
    steps = simulate_steps(control, states, previous, [0.0])
    seen = 0
    for k in np.nonzero(steps.outcomes[:, 0] == Outcome.SWING_SCUFFS)[0]:
        trace = trace_swing(control, states[k], previous[k], 0.0)
        if steps.durations[k, 0] == 0.0:
            continue
        start, end = (
            dynamics.swing_foot(WalkerModel().packed(), dynamics.to_absolute(state))
            for state in (trace.states[0], trace.states[-1])
        )
        along = np.array([-math.sin(previous[k]), math.cos(previous[k])])
        lowest = min(0.0, float(along @ start[:2]))
        assert trace.times[-1] == pytest.approx(steps.durations[k, 0], abs=1e-12)
        assert float(along @ end[:2]) == pytest.approx(lowest - 1e-9, abs=1e-9)
        seen += 1
    assert seen > 20


def test_every_outcome_occurs():
    """Thrown about in the middle of a swing, the robot falls in every way there is."""
    rng = np.random.default_rng(5)
    control = controller("hzd/base")
    samples = trace_swing(control, find_limit_cycle(control).state, 0.0, 0.0).states
    states = samples[rng.integers(0, len(samples), 4000)]
    states += rng.normal(0, 1, states.shape) * rng.choice([0.1, 0.3, 1.0, 3.0], (4000, 1))
    states[-1, 5:] *= 1e200
    seen = set()
    for model in (
        WalkerModel(tolerance=1e-6),
        WalkerModel(friction=math.inf, tolerance=1e-6),
        WalkerModel(time_limit=0.1, tolerance=1e-6),
    ):
        steps = simulate_steps(control, states, np.zeros(len(states)), SLOPES, model)
        falls = steps.outcomes != Outcome.STEP
        assert len(steps.next_states) == (~falls).sum()
        assert (steps.step_lengths[falls] == 0.0).all()
        assert (steps.step_lengths[~falls] > 0.0).all()
        codes = {Outcome(int(code)) for code in np.unique(steps.outcomes)}
        if model.friction == math.inf:
            assert codes.isdisjoint({Outcome.STANCE_SLIPS, Outcome.IMPACT_SLIPS})
        seen |= codes
    assert seen == set(Outcome)


def test_a_short_slip_counts_only_if_it_lasts():
    """smc/base slips for some 4 ms as its references switch, on the flat cycle too."""
    control = controller("smc/base")
    cycle = find_limit_cycle(control, 0.0, WalkerModel(friction=0.8))
    assert cycle.speed == pytest.approx(0.749, abs=1e-3)  # an independent prototype's

    def outcome(slip_duration):
        model = WalkerModel(friction=0.6, slip_duration=slip_duration)
        return simulate_steps(control, [cycle.state], [0.0], [0.0], model).outcomes[0, 0]

    trace = trace_swing(control, cycle.state, 0.0, 0.0, WalkerModel(friction=0.8))
    ratio = np.abs(trace.forces[:, 0]) / trace.forces[:, 1]
    assert ratio.max() == pytest.approx(0.72, abs=0.01)
    assert outcome(0.0) == outcome(0.003) == Outcome.STANCE_SLIPS
    assert outcome(0.0045) == Outcome.STEP


def test_friction_at_impact_is_judged_in_the_chosen_frame():
    """The impulse that the ground gives is leaned by the slope from one frame to the other."""
    control, state = controller("hzd/base"), cycle_state("hzd/base")
    for slope in np.radians([-2.0, 1.0, 3.0]):
        free = WalkerModel(friction=math.inf, torque_limit=math.inf)
        swing = trace_swing(control, state, 0.0, slope, free)
        _, impulse = impact_map(swing.states[-1], ROBOT)
        normal = np.array([-math.sin(slope), math.cos(slope)])
        along = np.array([math.cos(slope), math.sin(slope)])
        needed = {
            "slope": abs(impulse @ along) / (impulse @ normal),
            "vertical": abs(impulse[0]) / impulse[1],
        }
        assert abs(needed["slope"] - needed["vertical"]) > 0.01
        for frame, ratio in needed.items():
            for factor, sticks in ((0.999, False), (1.001, True)):
                model = replace(free, friction=factor * ratio, friction_frame=frame)
                # The swing itself may slip at so little friction: it is not what is tested.
                model = replace(model, slip_duration=1.0)
                outcome = simulate_steps(control, [state], [0.0], [slope], model).outcomes[0, 0]
                assert (outcome == Outcome.STEP) == sticks, (slope, frame, factor)
                if not sticks:
                    assert outcome == Outcome.IMPACT_SLIPS


FINITE = st.floats(-1e6, 1e6) | st.floats(-4, 4)


@settings(max_examples=400, deadline=None)
@given(
    state=st.lists(FINITE, min_size=10, max_size=10),
    previous=st.floats(-0.7, 0.7),
    slope=st.floats(-0.7, 0.7),
    name=st.sampled_from(controller_names()),
    limit=st.sampled_from([50.0, math.inf, 1e-3]),
    friction=st.sampled_from([0.6, 1e-6, math.inf]),
    slip=st.sampled_from([0.0, 0.004]),
)
def test_any_state_and_any_slope_end_in_an_outcome(
    state, previous, slope, name, limit, friction, slip
):
    model = WalkerModel(torque_limit=limit, friction=friction, slip_duration=slip, tolerance=1e-6)
    steps = simulate_steps(controller(name), [state], [previous], [slope], model)
    assert steps.outcomes[0, 0] in list(Outcome)
    for values in (steps.next_states, steps.durations, steps.step_lengths):
        assert np.isfinite(values).all()


@settings(max_examples=120, deadline=None)
@given(seed=st.integers(0, 2**32), name=st.sampled_from(controller_names()))
def test_states_near_a_gait_end_in_an_outcome_on_every_slope(seed, name):
    rng = np.random.default_rng(seed)
    state = cycle_state("hzd/mfpt")
    state = state + rng.normal(0, 1, 10) * rng.choice([1e-3, 1e-2, 0.1, 1.0])
    steps = simulate_steps(controller(name), [state], [0.0], SLOPES, WalkerModel(tolerance=1e-6))
    assert (steps.outcomes <= max(Outcome)).all()
    for values in (steps.next_states, steps.durations, steps.step_lengths, steps.energies):
        assert np.isfinite(values).all()
    # The steepest slope uphill is met first.
    times = steps.durations[0][steps.outcomes[0] == Outcome.STEP]
    assert (np.diff(times) <= 0).all()


def crawling():
    """The base controller with so much damping that the integrator takes tiny steps."""
    parameters = controller("hzd/base").parameters.copy()
    parameters[1] = 1e6
    return Controller("crawling", "hzd", parameters)


def test_a_crawling_swing_is_given_up():
    model = WalkerModel(friction=math.inf)
    crawl = simulate_steps(crawling(), [cycle_state("hzd/base")], [0.0], [-0.3], model)
    assert crawl.outcomes == Outcome.TIME_LIMIT
    assert crawl.integrator_steps == 20_000
    assert crawl.evaluations < 500_000


@pytest.mark.parametrize("most", [1, 1000, 10**9])
def test_no_swing_is_begun_beyond_a_bound_on_evaluations(most):
    control, states, previous = reachable("hzd/base", 1)
    whole = simulate_steps(control, states, previous, SLOPES)
    steps = simulate_steps(control, states, previous, SLOPES, None, most)
    n = len(steps.outcomes)
    assert n == {1: 1, 10**9: len(states)}.get(most, n)
    assert 1 <= n <= len(states)
    for name in ("outcomes", "durations", "step_lengths", "energies"):
        assert getattr(steps, name).tobytes() == getattr(whole, name)[:n].tobytes()
    k = np.count_nonzero(whole.outcomes[:n] == Outcome.STEP)
    assert steps.next_states.tobytes() == whole.next_states[:k].tobytes()
    before = simulate_steps(control, states[: n - 1], previous[: n - 1], SLOPES)
    assert n == 1 or before.evaluations < most
    assert n == len(states) or steps.evaluations >= most


def test_bits_do_not_depend_on_the_processor():
    """Code for one without AVX-512 finds the same steps as code for this one."""
    code = """
import hashlib, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_step import SLOPES, crawling, cycle_state, reachable
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.walker.robot import WalkerModel
digest = hashlib.sha256()
for name, most in (
    ("hzd/base", None), ("hzd/mfpt", 5000), ("smc/mfpt", 100_000), ("spline/base", None)
):
    steps = simulate_steps(*reachable(name, 1), SLOPES, WalkerModel(slip_duration=0.008), most)
    for part in (steps.outcomes, steps.next_states, steps.durations, steps.energies):
        digest.update(part.tobytes())
    digest.update(f"{steps.integrator_steps} {steps.evaluations}".encode())
print(digest.hexdigest())
"""
    found = set()
    for processor in ({}, {"NUMBA_CPU_NAME": "haswell"}):
        run = subprocess.run(
            [sys.executable, "-c", code, str(Path(__file__).parent)],
            env=os.environ | processor,
            capture_output=True,
            text=True,
            check=True,
        )
        found.add(run.stdout)
    assert len(run.stdout.strip()) == 64
    assert len(found) == 1


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"states": np.zeros((1, 9))}, "states"),
        ({"states": np.zeros(10)}, "states"),
        ({"states": np.full((1, 10), np.nan)}, r"states\[0\]\[0\]"),
        ({"previous_slopes": [0.0, 0.0]}, "previous_slopes"),
        ({"previous_slopes": [np.nan]}, r"previous_slopes\[0\]"),
        ({"previous_slopes": [1.5]}, r"previous_slopes\[0\]"),
        ({"slopes": [0.1, 0.0]}, r"slopes\[1\]"),
        ({"slopes": []}, "slopes"),
    ],
)
def test_arrays_that_are_not_allowed_are_named(change, field):
    arguments = {"states": np.zeros((1, 10)), "previous_slopes": [0.0], "slopes": [0.0]} | change
    with pytest.raises(InputError, match=rf"^{field}: "):
        simulate_steps(controller("hzd/base"), **arguments)
