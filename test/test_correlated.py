"""Correlated ground: the chain against dense matrices and closed forms, and walks against it."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_aggregation import exactly
from test_gait import walked
from test_markov import RELATIVE, assert_same_bits, method, relative

from biped_mfpt_ros.chain.markov import (
    conditional_probabilities,
    metastabilities,
    metastability,
    slope_probabilities,
    solve_chain,
    transition_matrix,
)
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh, grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.walker.terrain import deviations, slope_set

both_methods = pytest.mark.usefixtures(method.__name__)
SLOPES = np.radians([-2.0, -1.0, 0.0, 1.0, 2.0])
FLAT = 2


def outcomes_of(targets) -> np.ndarray:
    out = np.where(np.asarray(targets) == 0, 5, 0).astype(np.uint8)
    out[0] = NOT_SIMULATED
    return out


def mesh_of(targets, preceding, slopes, clustered=True) -> Mesh:
    n = len(targets)
    return Mesh(
        slopes=slopes, states=np.zeros((n, 10)), preceding=preceding, generation=np.zeros(n),
        targets=targets, outcomes=outcomes_of(targets), scales=np.ones(10), threshold=0.1,
        clustered=clustered,
    )  # fmt: skip


def walker(half=3, contraction=0.5) -> Mesh:
    """An offset in whole degrees, which a slope pushes and a step contracts; beyond, a fall.

    A state is an offset and the slope before it. The first one stands on flat ground.
    """
    number, waiting, rows, preceding = {(0, FLAT): 1}, [(0, FLAT)], [[0] * 5], [0]
    while waiting:
        offset, before = waiting.pop(0)
        preceding.append(before)
        row = []
        for s, push in enumerate((-2, -1, 0, 1, 2)):
            to = (round(contraction * offset + push), s)
            if abs(to[0]) <= half and to not in number:
                number[to] = len(number) + 1
                waiting.append(to)
            row.append(number.get(to, 0))
        rows.append(row)
    return mesh_of(np.array(rows, dtype=np.uint32), np.array(preceding), SLOPES)


def normal_weights(slopes, mean, sigma) -> list:
    """Normal density on the slopes, sum 1, in arithmetic of 50 digits."""
    with mpmath.workdps(50):
        density = [mpmath.npdf(mpmath.mpf(float(s)), mean, sigma) for s in slopes]
        return [value / sum(density) for value in density]


def dense(mesh, mu, sigma, rho) -> tuple[np.ndarray, np.ndarray]:
    """Q without the failure state, and falls, written down state by state."""
    n = len(mesh.targets)
    q, falls = np.zeros((n - 1, n - 1)), np.zeros(n - 1)
    for i in range(1, n):
        with mpmath.workdps(50):
            mu_, rho_, sigma_ = mpmath.mpf(mu), mpmath.mpf(rho), mpmath.mpf(sigma)
            mean = mu_ + rho_ * (mpmath.mpf(float(mesh.slopes[mesh.preceding[i]])) - mu_)
            weights = normal_weights(mesh.slopes, mean, sigma_ * mpmath.sqrt(1 - rho_**2))
        for to, p in zip(mesh.targets[i], weights, strict=True):
            if to == 0:
                falls[i - 1] += float(p)
            else:
                q[i - 1, to - 1] += float(p)
    return q, falls


# The chain --------------------------------------------------------------------------------------


@both_methods
@pytest.mark.parametrize("rho", [-0.9, -0.5, 0.3, 0.8])
@pytest.mark.parametrize("mu_deg", [0.0, 0.4])
def test_chain_is_that_of_a_dense_matrix(rho, mu_deg):
    mesh, mu, sigma = walker(), math.radians(mu_deg), math.radians(4.0)
    q, falls = dense(mesh, mu, sigma, rho)
    result = metastability(mesh, mu, sigma, rho)
    values, vectors = np.linalg.eig(q.T)
    largest = np.argmax(values.real)
    phi = np.abs(vectors[:, largest].real)
    assert result.lambda_2 == pytest.approx(values[largest].real, rel=1e-12)
    assert result.distribution[1:] == pytest.approx(phi / phi.sum(), abs=1e-12)
    times = np.linalg.solve(np.eye(len(q)) - q, np.ones(len(q)))
    assert result.mfpt_from_state[1:] == pytest.approx(times, rel=1e-11)
    t = transition_matrix(
        mesh.targets, conditional_probabilities(SLOPES, mu, sigma, rho), mesh.preceding
    ).toarray()
    assert t[1:, 1:] == pytest.approx(q, rel=1e-12)
    assert t[1:, 0] == pytest.approx(falls, rel=1e-12)


@both_methods
@pytest.mark.parametrize(
    ("rho", "sigma_deg", "mfpt"),
    [(-0.7, 1.3, 1e7), (-0.7, 0.7, 1e20), (0.6, 0.5, 1e4), (0.6, 0.3, 1e12)],
)
def test_long_times_in_high_precision(rho, sigma_deg, mfpt):
    mesh, sigma = walker(), math.radians(sigma_deg)
    escape, times = exactly(*dense(mesh, 0.0, sigma, rho), 0)
    result = metastability(mesh, 0.0, sigma, rho)
    assert 0.1 < result.mfpt / mfpt < 10.0  # the case is what it says
    assert relative(result.failure_probability, escape) < RELATIVE
    assert relative(result.mfpt, 1 / escape) < RELATIVE
    for value, reference in zip(result.mfpt_from_state[1:], times, strict=True):
        assert relative(value, reference) < RELATIVE


@both_methods
@pytest.mark.parametrize("rho", [-0.95, -0.5, 0.5, 0.95])
@pytest.mark.parametrize("falls_on", ["the same", "the other"])
def test_fall_that_depends_on_the_last_two_slopes_is_geometric(rho, falls_on):
    # Slopes -a and a: the exponents of "same" and "other" differ by 2 rho a^2 / sigma_given^2.
    a, sigma = 0.02, 0.01
    odds = math.exp(2.0 * rho * a**2 / (sigma**2 * (1.0 - rho**2)))  # of the same to the other
    targets = [[0, 0], [0, 2], [1, 0]] if falls_on == "the same" else [[0, 0], [1, 0], [0, 2]]
    mesh = mesh_of(np.array(targets), np.array([0, 0, 1]), np.array([-a, a]))
    chance = odds / (1.0 + odds) if falls_on == "the same" else 1.0 / (1.0 + odds)
    result = metastability(mesh, 0.0, sigma, rho)
    assert result.failure_probability == pytest.approx(chance, rel=1e-13)
    assert result.mfpt_from_state[1:] == pytest.approx(1.0 / chance, rel=1e-13)


@both_methods
@pytest.mark.parametrize("limit", [2, 5, 9])
def test_fall_that_depends_on_the_last_slope_alone(limit):
    # Any further slope is a fall, so what survives is P among the others, and nothing else.
    slopes = np.arange(-10, 11) * 0.01
    rho, sigma = 0.6, 0.03
    safe = np.flatnonzero(np.abs(np.arange(-10, 11)) <= limit)
    number = np.zeros(21, dtype=int)
    number[safe] = 1 + np.argsort(np.argsort(np.abs(safe - 10), kind="stable"), kind="stable")
    preceding = np.zeros(len(safe) + 1, dtype=int)
    preceding[number[safe]] = safe
    targets = np.tile(number, (len(safe) + 1, 1))
    targets[0] = 0
    result = metastability(mesh_of(targets, preceding, slopes), 0.0, sigma, rho)
    given_last = sigma * math.sqrt(1.0 - rho**2)
    density = np.exp(-0.5 * ((slopes - rho * slopes[:, np.newaxis]) / given_last) ** 2)
    p = (density / density.sum(axis=1)[:, np.newaxis])[np.ix_(safe, safe)]
    assert result.lambda_2 == pytest.approx(np.linalg.eigvals(p).real.max(), rel=1e-12)


@both_methods
def test_slopes_that_never_follow_are_not_met():
    # After slope 0 comes slope 0, always; after slope 1 half of the steps fall.
    targets = [[0, 0], [1, 2], [0, 2]]
    found = solve_chain(targets, outcomes_of(targets), [[1.0, 0.0], [0.5, 0.5]], [0, 0, 1])
    assert found.mfpt == math.inf
    assert found.mfpt_from_state.tolist() == pytest.approx([0.0, math.inf, 2.0])
    found = solve_chain(targets, outcomes_of(targets), [[0.75, 0.25], [0.5, 0.5]], [0, 0, 1])
    assert found.failure_probability == pytest.approx(0.25, rel=1e-12)
    assert found.mfpt_from_state.tolist() == pytest.approx([0.0, 6.0, 2.0], rel=1e-12)


def test_rows_that_are_alike_are_independent_slopes():
    mesh, sigma = walker(), math.radians(1.0)
    p = slope_probabilities(SLOPES, 0.001, sigma)
    alike = solve_chain(mesh.targets, mesh.outcomes, np.tile(p, (5, 1)), mesh.preceding)
    independent = solve_chain(mesh.targets, mesh.outcomes, p)
    assert alike.mfpt == pytest.approx(independent.mfpt, rel=1e-12)
    assert alike.mfpt_from_state == pytest.approx(independent.mfpt_from_state, rel=1e-11)


def test_no_correlation_is_the_chain_of_independent_slopes():
    mesh, sigma = walker(), math.radians(1.0)
    p = slope_probabilities(SLOPES, 0.001, sigma)
    for found in (metastability(mesh, 0.001, sigma), metastability(mesh, 0.001, sigma, 0.0)):
        assert_same_bits(found, solve_chain(mesh.targets, mesh.outcomes, p))


def test_one_result_has_the_same_bits_as_many():
    mesh, sigmas = walker(), np.radians(np.linspace(0.5, 2.0, 11))
    found = metastabilities(mesh, 0.0, sigmas, correlation=-0.4)
    for sigma, one in zip(sigmas, found, strict=True):
        assert_same_bits(one, metastability(mesh, 0.0, sigma, -0.4))


# Probabilities ----------------------------------------------------------------------------------


@given(
    rho=st.floats(-0.95, 0.95),
    ratio=st.floats(0.3, 1.5),
    mu=st.floats(-0.02, 0.02),
)
@settings(deadline=None)
def test_conditional_probabilities_are_those_of_the_process(rho, ratio, mu):
    spacing, given_last = 0.002, 0.002 / ratio
    sigma = given_last / math.sqrt(1.0 - rho**2)
    # To nine standard deviations, beyond which there are 2e-19; of these rows that start within
    # six of the mean all of P(. | r) is in the set.
    half = math.ceil((abs(mu) + 9.0 * sigma + 9.0 * given_last) / spacing)
    slopes = np.arange(-half, half + 1) * spacing
    if slopes[-1] > 0.75:
        return
    p = conditional_probabilities(slopes, mu, sigma, rho)
    assert p.sum(axis=1) == pytest.approx(1.0, abs=1e-14)
    within = np.abs(slopes - mu) < 6.0 * sigma
    # The trapezoidal rule: 2 exp(-2 pi^2 / ratio^2) of a sum, 4 pi^2 / ratio^2 times that of the
    # second moment, and its root of 1 / ratio of the first; and rounding.
    error = 2.0 * math.exp(-2.0 * math.pi**2 / ratio**2)
    second = 4.0 * math.pi**2 / ratio**2 * error
    means = mu + rho * (slopes - mu)
    first = (p * (slopes - means[:, np.newaxis])).sum(axis=1)
    assert np.abs(first[within]).max() <= given_last * (2.0 * math.sqrt(second * error) + 1e-12)
    variance = (p * (slopes - means[:, np.newaxis]) ** 2).sum(axis=1)
    assert variance[within] == pytest.approx(given_last**2, rel=2.0 * second + 1e-12)
    # The marginal stays what it is: a sum over r and a norm of rows, each with that error.
    marginal = slope_probabilities(slopes, mu, sigma)
    assert np.abs(marginal @ p - marginal).max() <= 4.0 * error * marginal.max() + 1e-15


def test_conditional_probabilities_in_high_precision():
    mu, sigma, rho = 0.003, 0.01, -0.6
    p = conditional_probabilities(slope_set(0.5, 5.0), mu, sigma, rho)
    for r, row in zip(slope_set(0.5, 5.0), p, strict=True):
        with mpmath.workdps(50):
            mean = mpmath.mpf(mu) + mpmath.mpf(rho) * (mpmath.mpf(float(r)) - mpmath.mpf(mu))
            spread = mpmath.mpf(sigma) * mpmath.sqrt(1 - mpmath.mpf(rho) ** 2)
        for value, reference in zip(row, normal_weights(slope_set(0.5, 5.0), mean, spread),
                                    strict=True):  # fmt: skip
            # Down to 1e-30: the distance from the mean loses a digit or two, the exponent another.
            assert relative(value, reference) < 1e-12


def test_a_coarse_set_gives_all_to_the_nearest_slope():
    p = conditional_probabilities([-0.1, 0.0, 0.1], 0.0, 0.05, 0.9999999)
    assert p == pytest.approx(np.eye(3), abs=1e-300)
    p = conditional_probabilities([-0.1, 0.0, 0.1], 0.0, 5e-324, 0.9)
    assert p.tolist() == np.eye(3).tolist()


# Walks ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [-0.8, -0.5, 0.0, 0.5, 0.8])
def test_drawn_slopes_have_spread_and_correlation(rho):
    n, sigma = 400_000, 0.03
    draws = np.random.default_rng(3).standard_normal(n)
    off = deviations(draws, 0.0, sigma, rho)
    # Five standard errors: those of an autoregressive process of n steps, and a start at 0 that
    # is forgotten in a few.
    more = math.sqrt((1.0 + rho) / (1.0 - rho))
    assert abs(off.mean()) < 5.0 * sigma * more / math.sqrt(n)
    wide = math.sqrt((1.0 + rho**2) / (1.0 - rho**2) / (2.0 * n))
    assert off.std() == pytest.approx(sigma, rel=5.0 * wide)
    for lag in (1, 2):
        # Bartlett's variance of a correlation at a lag is below (1 + 2 lag) / n.
        found = np.corrcoef(off[:-lag], off[lag:])[0, 1]
        assert found == pytest.approx(rho**lag, abs=5.0 * math.sqrt((1.0 + 2.0 * lag) / n))


def test_pieces_of_a_process_are_the_process():
    draws = np.random.default_rng(4).standard_normal((3, 20))
    whole = deviations(draws, np.full(3, 0.1), 0.02, 0.7)
    first = deviations(draws[:, :9], np.full(3, 0.1), 0.02, 0.7)
    assert np.array_equal(whole[:, :9], first)
    assert np.array_equal(whole[:, 9:], deviations(draws[:, 9:], first[:, -1], 0.02, 0.7))
    assert np.array_equal(deviations(draws, 0.1, 0.02, 0.0), 0.02 * draws)


@pytest.mark.parametrize("rho", [-0.5, 0.7])
def test_a_walk_begins_after_flat_ground_and_follows_the_process(rho):
    control, sigma, mu = controller("hzd/mfpt"), math.radians(1.0), math.radians(-0.2)
    start = find_limit_cycle(control).state
    result = monte_carlo(control, sigma, 5, 3, mu_s=mu, correlation=rho, state=start)
    assert result.steps.max() > 8  # beyond the slopes that are drawn first
    for n in range(5):
        slopes, slope = [], 0.0
        for e in np.random.Generator(np.random.PCG64([3, n])).standard_normal(500):
            slope = mu + rho * (slope - mu) + sigma * math.sqrt(1.0 - rho**2) * e
            slopes.append(slope)
        assert (result.steps[n], result.outcomes[n]) == walked(control, start, slopes)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """Of hzd/mfpt, which rolling ground helps most."""
    control, slopes = controller("hzd/mfpt"), slope_set(0.25)
    return grow_mesh(
        lambda states, previous: simulate_steps(control, states, previous, slopes),
        find_limit_cycle(control).state, slopes, 0.03,
    )  # fmt: skip


@pytest.mark.parametrize("rho", [-0.5, 0.0, 0.5])
def test_chain_agrees_with_walks(mesh, rho):
    """Counted alike: from flat ground, the first step dropped, walks that fall in it left out."""
    sigma = math.radians(2.0)
    times = metastability(mesh, 0.0, sigma, rho).mfpt_from_state
    p = conditional_probabilities(mesh.slopes, 0.0, sigma, rho)[mesh.preceding[1]]
    second = mesh.targets[1]
    expected = float(p @ times[second] / p[second > 0].sum())
    walked = monte_carlo(controller("hzd/mfpt"), sigma, 8000, 5, correlation=rho)
    # Four standard errors of the walks, and 3 % for the mesh: those of half the spacing and a
    # third and a tenth of the threshold have up to 3 % less. Independent slopes make 6.0 steps,
    # and would not do for the others, of 7.4 and 6.8.
    error = 4.0 * walked.standard_error + 0.03 * expected
    assert walked.mean_steps == pytest.approx(expected, abs=error)


# Bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [-1.0, 1.0, 1.5, math.nan, math.inf, "0", None])
def test_correlation_must_be_within_its_range(correlation):
    with pytest.raises(InputError, match=r"^correlation: .*above -1 and below 1"):
        metastability(walker(), 0.0, 0.02, correlation)
    with pytest.raises(InputError, match=r"^correlation: .*above -1 and below 1"):
        conditional_probabilities(SLOPES, 0.0, 0.02, correlation)
    with pytest.raises(InputError, match=r"^correlation: .*above -1 and below 1"):
        monte_carlo(controller("hzd/base"), 0.03, 5, 1, correlation=correlation)


def test_an_unclustered_mesh_takes_no_correlation():
    known = walker()
    mesh = mesh_of(known.targets, known.preceding, SLOPES, clustered=False)
    with pytest.raises(InputError, match=r"^correlation: 0\.5 is not allowed; .*clustered = False"):
        metastability(mesh, 0.0, 0.02, 0.5)
    assert metastability(mesh, 0.0, 0.02).mfpt == metastability(known, 0.0, 0.02).mfpt


def test_states_have_to_know_the_slope_before_them():
    known = walker()
    wrong = known.preceding.copy()
    wrong[3] = (wrong[3] + 1) % 5
    with pytest.raises(InputError, match=r"^preceding\[3\]: "):
        metastability(mesh_of(known.targets, wrong, SLOPES), 0.0, 0.02, 0.5)
    rows = np.full((5, 5), 0.2)
    for preceding, field in ((wrong, r"preceding\[3\]"), (wrong[1:], "preceding"),
                             (known.preceding + 5, "preceding")):  # fmt: skip
        with pytest.raises(InputError, match=f"^{field}: "):
            solve_chain(known.targets, known.outcomes, rows, preceding)
    for probabilities in (rows[0], rows[1:], 2.0 * rows, rows - np.eye(5)):
        with pytest.raises(InputError, match=r"^probabilities: "):
            transition_matrix(known.targets, probabilities, known.preceding)
