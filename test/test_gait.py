"""Limit cycles and Monte Carlo walks against the paper and an independent prototype."""

from __future__ import annotations

import json
import math
from importlib.resources import files

import numpy as np
import pytest

from biped_mfpt_ros.control.controller import Controller, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import MonteCarlo, monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel

PAPER = json.loads(files("biped_mfpt_ros").joinpath("data/paper.json").read_text())
SIGMA = math.radians(2.0)

# name: period s, step m, speed m/s, cost of transport, of an independent prototype, to the digits
# printed; the base gait's speed and cost to the 0.0002 that its rounded coefficients allow.
CYCLES = {
    "hzd/base": (0.5168, 0.4135, 0.8001, 0.1864),
    "hzd/cot": (0.8335, 0.4301, 0.5160, 0.0686),
    "hzd/mfpt": (0.6164, 0.4000, 0.6490, 0.1423),
}


@pytest.mark.parametrize("name", list(CYCLES))
def test_flat_cycles(name):
    period, length, speed, cost = CYCLES[name]
    cycle = find_limit_cycle(controller(name))
    assert cycle.stable
    assert cycle.period == pytest.approx(period, abs=1.01e-4)
    assert cycle.step_length == pytest.approx(length, abs=1.01e-4)
    assert cycle.speed == pytest.approx(speed, abs=1.01e-4)
    assert cycle.cost_of_transport == pytest.approx(cost, abs=1.01e-4)


def test_base_gait_is_the_papers():
    cycle = find_limit_cycle(controller("hzd/base"))
    assert cycle.speed == pytest.approx(0.8, abs=2e-4)
    assert cycle.cost_of_transport == pytest.approx(0.1864, abs=2e-4)


def test_sliding_mode_cycle_under_the_default_limits():
    cycle = find_limit_cycle(controller("smc/mfpt"))
    assert (cycle.period, cycle.speed) == pytest.approx((0.4846, 0.9196), abs=1.01e-4)
    assert cycle.cost_of_transport == pytest.approx(0.925, abs=1e-3)


def test_sliding_mode_cycle_of_least_cost_without_limits():
    """Period and speed as an independent prototype's, to three digits.

    Its cost of transport, 0.363, is that of a chattering torque: alpha_4 = 0.4873 makes the law
    jump at sigma = 0. In fixed steps of 1e-4, 1e-5, 1e-6 s the literal law costs 0.365, 0.371 and
    0.378; with the sliding mode that it approximates, 0.305.
    """
    model = WalkerModel(torque_limit=math.inf, friction=1.0)
    cycle = find_limit_cycle(controller("smc/cot"), model=model)
    assert cycle.period == pytest.approx(0.652, abs=5e-4)
    assert cycle.speed == pytest.approx(0.581, abs=5e-4)
    assert cycle.cost_of_transport == pytest.approx(0.305, abs=5e-4)


def test_a_cycle_comes_back_to_itself_and_its_eigenvalues_tell_how():
    """A deviation shrinks by the largest eigenvalue from step to step."""
    control = controller("hzd/base")
    cycle = find_limit_cycle(control)
    model = WalkerModel(tolerance=1e-11)
    state = cycle.state + 1e-4 * np.array([0, 0, 0, 0, 0, 1.0, 0.5, 0, 0, -1.0])
    distances = []
    for _ in range(12):
        steps = simulate_steps(control, [state], [0.0], [0.0], model)
        state = steps.next_states[0]
        distances.append(np.linalg.norm(state - cycle.state))
    rate = (distances[-1] / distances[5]) ** (1 / 6)
    assert rate == pytest.approx(abs(cycle.eigenvalues[0]), rel=1e-3)
    # A state after impact stands on the ground: one direction is gone after a step.
    assert abs(cycle.eigenvalues[-1]) < 1e-5


def test_a_stable_cycle_is_preferred_to_an_unstable_one():
    """This gait has a fast unstable cycle besides the one it settles in; Newton finds both."""
    control = controller("smc/base")
    model = WalkerModel(torque_limit=46.0, slip_duration=0.005)
    cycle = find_limit_cycle(control, model=model)
    assert cycle.stable
    assert cycle.speed == pytest.approx(0.73, abs=0.03)


def test_no_cycle_is_an_error_that_says_how_it_ended():
    with pytest.raises(NoLimitCycle, match=r"hzd/base .* slope of -5 degrees .* most falls: "):
        find_limit_cycle(controller("hzd/base"), math.radians(-5.0))


def test_a_cycle_on_a_slope_beyond_the_limit_is_refused():
    with pytest.raises(InputError, match=r"^slope: 0\.8 is not allowed"):
        find_limit_cycle(controller("hzd/base"), 0.8)


def test_a_search_that_crawls_is_given_up(monkeypatch):
    monkeypatch.setattr("biped_mfpt_ros.gait.cycle._MOST_EVALUATIONS", 500_000)
    parameters = controller("hzd/base").parameters.copy()
    parameters[1] = 1e4  # damping that makes the integrator take tiny steps
    crawling = Controller("crawling", "hzd", parameters)
    with pytest.raises(NoLimitCycle, match="crawling found: the search was given up after"):
        find_limit_cycle(crawling, model=WalkerModel(friction=math.inf))


def test_walks_depend_on_their_seed_alone():
    """Not on threads, nor on how many other walks there are."""
    control = controller("hzd/base")
    one = monte_carlo(control, SIGMA, 150, 7, threads=1)
    two = monte_carlo(control, SIGMA, 100, 7, threads=2)
    other = monte_carlo(control, SIGMA, 100, 8)
    assert np.array_equal(one.steps[:100], two.steps)
    assert np.array_equal(one.outcomes[:100], two.outcomes)
    assert not np.array_equal(two.steps, other.steps)


def walked(control, state, slopes):
    """Steps to the fall, that one counted, and how it falls, from flat ground on some slopes."""
    previous = 0.0
    for taken, slope in enumerate(slopes, start=1):
        steps = simulate_steps(control, [state], [previous], [slope])
        if steps.outcomes[0, 0] != Outcome.STEP:
            return taken, steps.outcomes[0, 0]
        state, previous = steps.next_states[0], slope
    return None


def test_a_walk_is_the_step_map_again_and_again():
    control = controller("hzd/mfpt")
    result = monte_carlo(control, SIGMA, 5, 3)
    start = find_limit_cycle(control).state
    for n in range(5):
        slopes = SIGMA * np.random.Generator(np.random.PCG64([3, n])).standard_normal(500)
        assert (result.steps[n], result.outcomes[n]) == walked(control, start, slopes)


def test_first_step_is_dropped_as_in_table_2():
    walks = MonteCarlo(np.array([1, 2, 4]), np.array([2, 2, 3], dtype=np.uint8))
    assert walks.mean_steps == 2.0
    assert walks.failure_shares == {Outcome.STANCE_SLIPS: 0.5, Outcome.SWING_SCUFFS: 0.5}


def test_walks_that_do_not_fall_are_stopped_and_counted_as_such():
    result = monte_carlo(controller("hzd/mfpt"), math.radians(0.01), 4, 1, max_steps=20)
    assert (result.steps == 20).all()
    assert result.falls == 0
    assert result.mean_steps == math.inf


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"sigma_s": 0.0}, "sigma_s"),
        ({"sigma_s": math.nan}, "sigma_s"),
        ({"walks": 0}, "walks"),
        ({"seed": -1}, "seed"),
        ({"max_steps": 0}, "max_steps"),
        ({"threads": 0}, "threads"),
        ({"mu_s": 2.0}, "mu_s"),
        ({"state": np.zeros(9)}, "state"),
    ],
)
def test_arguments_that_are_not_allowed_are_named(change, field):
    with pytest.raises(InputError, match=rf"^{field}: "):
        monte_carlo(controller("hzd/base"), **({"sigma_s": SIGMA, "walks": 5, "seed": 1} | change))


@pytest.mark.slow
@pytest.mark.parametrize("label", ["base", "cot", "mfpt"])
def test_monte_carlo_of_table_2(label):
    """10000 walks at sigma_s = 2 degrees, within 5 % of the paper's."""
    result = monte_carlo(controller(f"hzd/{label}"), SIGMA, 10_000, 1)
    assert result.mean_steps == pytest.approx(
        PAPER["table2_hzd_sigma2"]["monte_carlo"][label], rel=0.05
    )
