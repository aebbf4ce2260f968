"""The chain: against closed forms, a second method, and arithmetic of a hundred digits and more."""

from __future__ import annotations

import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import example, given, reject, settings
from hypothesis import strategies as st
from processors import printed_on_two
from scipy.sparse.linalg import eigs

from biped_mfpt_ros.chain import iteration, markov
from biped_mfpt_ros.chain.markov import (
    ChainError,
    Metastability,
    metastabilities,
    metastability,
    slope_probabilities,
    solve_chain,
    transition_matrix,
)
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh
from biped_mfpt_ros.errors import InputError

# Required of every MFPT; the solver aims at 1e-12 (markov.TOLERANCE).
RELATIVE = 1e-10


@pytest.fixture(params=["iteration", "aggregation"])
def method(request, monkeypatch):
    """Both ways to solve a chain; the first falls back to the second where it does not settle."""
    if request.param == "aggregation":
        monkeypatch.setattr(markov, "_STEPS", 0)
    return request.param


@pytest.fixture
def only_iteration(monkeypatch):
    """Anything but iteration is an error."""
    monkeypatch.setattr(markov, "metastable_distribution", lambda *_: None)
    monkeypatch.setattr(markov, "passage_times", lambda *_: None)


def solve(rows, probabilities, code=2) -> Metastability:
    """Chain from the targets of states 1, 2, ...; every fall has the same code."""
    targets = np.array([[0] * len(probabilities), *rows], dtype=np.uint32)
    outcomes = np.where(targets == 0, code, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    return solve_chain(targets, outcomes, probabilities)


def solve_columns(targets, outcomes, columns) -> list:
    """Many distributions, none of which depends on the slope before."""
    offsets = np.zeros(len(targets), dtype=np.int64)
    return markov._solve(targets, outcomes, offsets, np.ascontiguousarray(columns.T))


def exact_chain(rows, probabilities) -> tuple[mpmath.matrix, list]:
    """I - Q and the falls, exact sums of the given probabilities scaled to sum exactly 1."""
    exact = [mpmath.mpf(float(p)) for p in probabilities]
    total = sum(exact)
    n = len(rows)
    a = mpmath.zeros(n)
    falls = [mpmath.mpf(0)] * n
    for i, row in enumerate(rows):
        a[i, i] += 1
        for target, p in zip(row, exact, strict=True):
            if target == 0:
                falls[i] += p / total
            else:
                a[i, target - 1] -= p / total
    return a, falls


def exact_times(rows, probabilities, digits=120) -> list:
    with mpmath.workdps(digits):
        a, _ = exact_chain(rows, probabilities)
        return list(mpmath.lu_solve(a, mpmath.ones(len(rows), 1)))


def exact_failure_probability(rows, probabilities, digits=120):
    """The smallest eigenvalue of I - Q, of the states that can be reached from the first."""
    reached, waiting = {1}, [1]
    while waiting:
        for target, p in zip(rows[waiting.pop() - 1], probabilities, strict=True):
            if p > 0.0 and target not in reached | {0}:
                reached.add(target)
                waiting.append(target)
    number = {0: 0} | {old: new for new, old in enumerate(sorted(reached), start=1)}
    rows = [[number.get(t, 0) for t in rows[i - 1]] for i in sorted(reached)]
    with mpmath.workdps(digits):
        a, _ = exact_chain(rows, probabilities)
        if len(rows) == 1:  # mpmath.eig returns this one in a list too many
            return a[0, 0]
        return min(mpmath.re(value) for value in mpmath.eig(a, left=False, right=False))


def relative(value, reference) -> float:
    return float(abs(mpmath.mpf(float(value)) / reference - 1))


def birth_death(n, ends=(0, None)) -> list[list[int]]:
    """Steps down and up among 1..n; below and above are `ends`, None for staying."""
    low, high = (e if e is not None else stay for e, stay in zip(ends, (1, n), strict=True))
    return [[i - 1 if i > 1 else low, i + 1 if i < n else high] for i in range(1, n + 1)]


def walker(half, contraction) -> tuple[list[list[int]], np.ndarray]:
    """A chain like a walker's: rows and slopes, which push it, it returns, it falls when far out.

    States are offsets -half..half, the first one (x_2) in the middle.
    """
    slopes = np.radians(np.arange(-40, 41) * 0.5)
    offsets = sorted(range(-half, half + 1), key=abs)
    number = {offset: i for i, offset in enumerate(offsets, start=1)}
    rows = [
        [number.get(round(contraction * o + math.degrees(s)), 0) for s in slopes] for o in offsets
    ]
    return rows, slopes


# Closed forms -----------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [0.7, 1e-3, 1e-8, 1e-14, 1e-20, 1e-100])
def test_one_state_is_geometric(method, p):
    result = solve([[0, 1]], [p, 1.0 - p])
    assert result.mfpt == pytest.approx(1.0 / p, rel=1e-14)
    assert result.failure_probability == pytest.approx(p, rel=1e-14)
    assert result.lambda_2 == pytest.approx(1.0 - p, rel=1e-14)
    assert result.mfpt_from_state == pytest.approx([0.0, 1.0 / p], rel=1e-14)
    assert result.distribution.tolist() == [0.0, 1.0]
    assert result.failure_shares == {2: 1.0}


@pytest.mark.parametrize("e", [0.1, 1e-3, 1e-8, 1e-14, 1e-20])
def test_two_states(method, e):
    # From 1: falls e, to 2 with 0.3. From 2: never falls, to 1 with 0.2 + e.
    # lambda^2 - (a + d) lambda + (a d - b c) = 0, solved for 1 - lambda with 200 digits.
    p = [e, 0.2, 0.3, 0.5 - e]
    result = solve([[0, 1, 2, 1], [1, 1, 2, 2]], p)
    with mpmath.workdps(200):
        e, r, b, _ = (mpmath.mpf(x) / sum(map(mpmath.mpf, p)) for x in p)
        half_trace, determinant = (e + b + e + r) / 2, (e + b) * (e + r) - b * (e + r)
        escape = half_trace - mpmath.sqrt(half_trace**2 - determinant)
    assert relative(result.failure_probability, escape) < 1e-13
    assert relative(result.mfpt, 1 / escape) < 1e-13


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 10.0, 50.0])
def test_birth_death_first_passage(method, ratio):
    # m_k - m_{k-1} = h_k, the time from k to k - 1: h_n = 1/q, h_k = 1/q + (p/q) h_{k+1}.
    n, q = 12, 1.0 / (1.0 + ratio)
    p = 1.0 - q
    result = solve(birth_death(n), [q, p])
    h = [1.0 / q]
    while len(h) < n:
        h.append(1.0 / q + p / q * h[-1])
    assert result.mfpt_from_state[1:] == pytest.approx(np.cumsum(h[::-1]), rel=RELATIVE)


@pytest.mark.parametrize("n", [1, 2, 9, 40, 300])
def test_symmetric_walk_between_two_falls(method, n):
    # Eigenvalue cos(pi / (n + 1)), eigenvector sin(k pi / (n + 1)), m_k = k (n + 1 - k). It has
    # period 2, and 300 states mix too slowly to be iterated.
    result = solve(birth_death(n, ends=(0, 0)), [0.5, 0.5])
    k = np.arange(1, n + 1)
    angle = math.pi / (n + 1)
    assert result.failure_probability == pytest.approx(2.0 * math.sin(angle / 2) ** 2, rel=RELATIVE)
    assert result.lambda_2 == pytest.approx(math.cos(angle), rel=RELATIVE, abs=1e-15)
    wave = np.sin(k * angle)
    if n > 1:  # for n = 1 lambda_2 = 0, from the first step on
        assert result.distribution[1:] == pytest.approx(wave / wave.sum(), rel=1e-9)
    assert result.mfpt_from_state[1:] == pytest.approx(k * (n + 1.0 - k), rel=RELATIVE)


@pytest.mark.parametrize("n", [2, 3, 7, 250])
@pytest.mark.parametrize("p", [0.5, 1e-12])
def test_ring_with_one_place_to_fall(method, n, p):
    # Survives a round with 1 - p: lambda_2^n = 1 - p. Period n.
    rows = [[i % n + 1] * 2 for i in range(1, n)] + [[0, 1]]
    result = solve(rows, [p, 1.0 - p])
    assert result.failure_probability == pytest.approx(
        -math.expm1(math.log1p(-p) / n), rel=RELATIVE
    )
    rounds = 1.0 / p
    expected = [n * (rounds - 1.0) + n - i for i in range(n)]
    assert result.mfpt_from_state[1:] == pytest.approx(expected, rel=RELATIVE)


@pytest.mark.parametrize("n", [1, 2, 5, 150])
def test_certain_fall_has_lambda_2_zero(method, n):
    result = solve([[i + 1, i + 1] for i in range(1, n)] + [[0, 0]], [0.5, 0.5])
    # Exact if the chain ends while it is iterated plainly, within the tolerance after that.
    assert result.lambda_2 == pytest.approx(0.0, abs=markov.TOLERANCE if n > 100 else 0.0)
    assert result.failure_probability == pytest.approx(1.0, rel=markov.TOLERANCE)
    assert result.mfpt == pytest.approx(1.0, rel=markov.TOLERANCE)
    assert result.distribution[-1] == pytest.approx(1.0, rel=markov.TOLERANCE)
    assert result.mfpt_from_state[1:] == pytest.approx(np.arange(n, 0, -1), rel=RELATIVE)


def test_what_is_lost_to_underflow_is_no_distribution():
    # A round from 1 over 3 and 4 is survived with 6e-243.
    rows = [[3, 2], [4, 3], [0, 4], [1, 4]]
    with pytest.raises(ChainError, match="4 states"):
        solve(rows, [1.0, 6e-243])


@pytest.mark.parametrize("e", [1e-60, 1e-85, 1e-100, 1e-102, 1e-120])
def test_times_up_to_the_largest_number_and_beyond(method, e):
    # Three states in a row, of which each leads to the one before with e: h_3 = 1 / e, and
    # h_k = 1 / e + (1 - e) / e h_(k + 1).
    result = solve([[0, 2], [1, 3], [2, 3]], [e, 1.0])
    with mpmath.workdps(400):
        up = 1 / mpmath.mpf(e)
        h = [up, up + (up - 1) * up, up + (up - 1) * (up + (up - 1) * up)]
    times = [h[2], h[2] + h[1], h[2] + h[1] + h[0]]
    if e == 1e-120:  # 1e360
        assert result.mfpt == math.inf
        assert result.distribution == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-100)
        assert result.mfpt_from_state.tolist() == [0.0, math.inf, math.inf, math.inf]
        return
    for value, reference in zip(result.mfpt_from_state[1:], times, strict=True):
        assert relative(value, reference) < RELATIVE
    assert relative(result.mfpt, h[2]) < RELATIVE


def test_small_lambda_2_is_accurate(method):
    # Only the middle one of three slopes is survived.
    result = solve([[0, 1, 0]], [0.5, 1e-30, 0.5])
    assert result.lambda_2 == pytest.approx(1e-30, rel=1e-13)
    assert result.mfpt == 1.0


def test_equal_classes_one_behind_the_other(method):
    # Both states keep 0.3 of their weight, and 1 leads to 2: one eigenvalue, one eigenvector.
    result = solve([[1, 2, 0], [2, 0, 0]], [0.3, 0.2, 0.5])
    assert result.lambda_2 == pytest.approx(0.3, rel=1e-14)
    assert result.distribution == pytest.approx([0.0, 0.0, 1.0], abs=1e-14)


def test_state_that_outlives_the_metastable_ones(method):
    # One of three slopes leads from 1 to 2, and from there only 1e-9 survives: psi_1 is 3e8.
    p = [0.4, 0.6 - 1e-9, 1e-9]
    result = solve([[2, 0, 0], [0, 0, 2]], p)
    assert result.mfpt == pytest.approx(1.0 + 1e-9, rel=1e-13)
    assert result.mfpt_from_state[1] == pytest.approx(1.0 + 0.4 * (1.0 + 1e-9), rel=1e-13)


# Falls that cannot happen, states that cannot be reached -----------------------------------------


def test_no_fall_can_be_reached(method):
    result = solve([[1, 2], [2, 1]], [0.25, 0.75])
    assert result.mfpt == math.inf
    assert (result.lambda_2, result.failure_probability) == (1.0, 0.0)
    assert result.failure_shares == {}
    assert result.distribution == pytest.approx([0.0, 0.5, 0.5], rel=1e-11)
    assert result.mfpt_from_state.tolist() == [0.0, math.inf, math.inf]


def test_part_of_the_chain_never_falls(method):
    # 1 falls or comes to 2, 3; 4 falls in one step, 5 with 0.5 in each.
    result = solve([[0, 2], [3, 2], [2, 3], [0, 0], [0, 5]], [0.5, 0.5])
    assert result.mfpt == math.inf
    assert result.distribution == pytest.approx([0, 0, 0.5, 0.5, 0, 0], rel=1e-11)
    assert result.mfpt_from_state == pytest.approx([0, math.inf, math.inf, math.inf, 1, 2])


def test_a_slope_without_probability_does_not_happen(method):
    assert solve([[1, 0], [1, 0]], [1.0, 0.0]).mfpt == math.inf


def test_states_out_of_reach_do_not_matter(method):
    # 2 never falls and 3 hardly ever; x_2 is 1 and leads to neither.
    result = solve([[0, 1], [2, 2], [1, 3]], [0.25, 0.75])
    assert result.mfpt == pytest.approx(4.0, rel=1e-13)
    assert result.distribution == pytest.approx([0, 1, 0, 0])
    assert result.mfpt_from_state == pytest.approx([0, 4, math.inf, 8])


# High precision ---------------------------------------------------------------------------------


def check_exactly(result, rows, probabilities) -> None:
    escape = exact_failure_probability(rows, probabilities)
    assert relative(result.failure_probability, escape) < RELATIVE
    assert relative(result.mfpt, 1 / escape) < RELATIVE
    references = exact_times(rows, probabilities)
    for value, reference in zip(result.mfpt_from_state[1:], references, strict=True):
        assert relative(value, reference) < RELATIVE


@pytest.mark.parametrize(
    ("half", "mfpt", "sigma_deg"),
    [
        *[(4, 1e3, 1.25), (4, 1e8, 0.715), (4, 1e14, 0.526), (4, 1e20, 0.432)],
        *[(5, 1e3, 1.38), (5, 1e8, 0.782), (5, 1e14, 0.581), (5, 1e20, 0.474)],
    ],
)
def test_walker_chain_in_high_precision(method, half, mfpt, sigma_deg):
    rows, slopes = walker(half, 0.5)
    p = slope_probabilities(slopes, 0.0, math.radians(sigma_deg))
    result = solve(rows, p)
    assert 0.3 < result.mfpt / mfpt < 3.0  # the case is what it says
    check_exactly(result, rows, p)


@pytest.mark.parametrize(("n", "mfpt"), [(4, 1e3), (9, 1e8), (16, 1e14), (23, 1e20)])
def test_falls_from_rare_states_in_high_precision(method, n, mfpt):
    # Drifts away from the only state that falls: all falls come from a weight of 1 / MFPT.
    result = solve(birth_death(n), [0.125, 0.875])
    assert 0.1 < result.mfpt / mfpt < 10.0
    check_exactly(result, birth_death(n), [0.125, 0.875])


@pytest.mark.parametrize("coupling", [1e-2, 1e-6, 1e-10, 1e-15, 1e-22])
@pytest.mark.parametrize("falls", [(1e-3, 1e-5), (1e-8, 1e-3), (1e-14, 1e-20), (1e-20, 1e-19)])
def test_two_gaits_with_rare_changes_in_high_precision(method, coupling, falls):
    # Slopes: even; one on which gait 1 falls; one on which gait 2 falls; one that changes it.
    a, b = falls
    p = [1.0 - a - b - coupling, a, b, coupling]
    rows = [[2, 0, 2, 3], [1, 0, 1, 1], [4, 4, 0, 2], [3, 3, 0, 4]]
    check_exactly(solve(rows, p), rows, p)


def test_slow_gait_change_is_not_taken_for_settled(monkeypatch, only_iteration):
    # Gait 1 is given up for gait 2 once in 1e15 steps: no step changes much.
    monkeypatch.setattr(markov, "_STEPS", 500)
    rows = [[1, 0, 1, 2], [2, 2, 0, 2]]
    with pytest.raises(ChainError):
        solve(rows, [1.0 - 3e-9, 1e-9, 1e-12, 2e-9])


@st.composite
def chains(draw):
    """Rows and probabilities of a small chain, some probabilities down to 1e-25."""
    n, m = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    state = st.integers(0, n)
    rows = draw(st.lists(st.lists(state, min_size=m, max_size=m), min_size=n, max_size=n))
    logs = draw(st.lists(st.floats(-25.0, 0.0), min_size=m, max_size=m))
    p = 10.0 ** np.array(logs)
    return rows, p / p.sum()


@given(chains())
@example(([[0, 2, 1], [0, 0, 0]], np.array([0.5, 0.5, 5e-17])))  # lambda_2 of 1: 5e-17, of 2: 0
@settings(deadline=None, max_examples=100)
def test_random_chain_in_high_precision(chain):
    rows, p = chain
    result = solve(rows, p)
    # A multiple eigenvalue is found with a fifth of the digits. None is between 0 and 1e-130.
    try:
        escape = exact_failure_probability(rows, p, digits=1000)
    except RuntimeError:  # mpmath's QR iteration gives up now and then
        reject()
    if escape < mpmath.mpf(10) ** -150:
        assert result.mfpt == math.inf
    else:
        assert relative(result.failure_probability, escape) < RELATIVE
        assert relative(result.mfpt, 1 / escape) < RELATIVE
    times = result.mfpt_from_state[1:]
    if np.isfinite(times).all():
        for value, reference in zip(times, exact_times(rows, p), strict=True):
            assert relative(value, reference) < RELATIVE


# A second method --------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma_deg", [1.4, 2.0, 4.0])
def test_sparse_eigenvalue_solver_agrees(sigma_deg):
    # Where 1 - lambda_2 is not small, an ordinary solver is accurate too.
    rows, slopes = walker(5, 0.5)
    p = slope_probabilities(slopes, 0.0, math.radians(sigma_deg))
    result = solve(rows, p)
    t = transition_matrix([[0] * len(p), *rows], p)
    q = t[1:, 1:]
    value, vector = eigs(q.T, k=1, which="LR")
    vector = np.abs(vector.ravel())
    assert result.lambda_2 == pytest.approx(value.real[0], rel=1e-12)
    assert result.distribution[1:] == pytest.approx(vector / vector.sum(), abs=1e-12)
    times = np.linalg.solve(np.eye(len(rows)) - q.toarray(), np.ones(len(rows)))
    assert result.mfpt_from_state[1:] == pytest.approx(times, rel=1e-10)


def test_both_methods_agree_on_a_larger_chain(monkeypatch):
    rows, slopes = walker(60, 0.9)
    p = slope_probabilities(slopes, math.radians(1.0), math.radians(2.0))
    iterated = solve(rows, p)
    times = iterated.mfpt_from_state
    monkeypatch.setattr(markov, "_STEPS", 0)
    aggregated = solve(rows, p)
    assert iterated.mfpt == pytest.approx(aggregated.mfpt, rel=1e-11)
    assert times == pytest.approx(aggregated.mfpt_from_state, rel=1e-11)
    matters = aggregated.distribution > 1e-11 * aggregated.failure_probability
    assert iterated.distribution[matters] == pytest.approx(
        aggregated.distribution[matters], rel=1e-11
    )


def test_usual_chains_are_iterated(only_iteration):
    rows, slopes = walker(60, 0.9)
    result = solve(rows, slope_probabilities(slopes, 0.0, math.radians(1.0)))
    assert result.mfpt_from_state[1] == pytest.approx(result.mfpt, rel=1e-3)


# Many distributions, large chains ---------------------------------------------------------------


def lifted(rows, m, copies) -> tuple[np.ndarray, np.ndarray]:
    """Targets and outcomes of a chain whose states are (state of a small chain, copy).

    Copy k goes to copy (m k + s) mod copies on slope s: it tells the slopes of the last steps
    apart, as the states of a mesh do. Falls depend on the small chain's state alone, so lambda_2
    is that of the small chain, exactly.
    """
    states, k, s = np.ix_(range(len(rows)), range(copies), range(m))
    to = np.array(rows)[states, s]
    targets = np.where(to > 0, 1 + (to - 1) * copies + (m * k + s) % copies, 0).reshape(-1, m)
    targets = np.concatenate([np.zeros((1, m)), targets]).astype(np.uint32)
    outcomes = np.where(targets == 0, 5, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    return targets, outcomes


def mesh_of(targets, outcomes, slopes) -> Mesh:
    n = len(targets)
    return Mesh(
        slopes=slopes,
        states=np.zeros((n, 10)),
        preceding=np.zeros(n),
        generation=np.zeros(n),
        targets=targets,
        outcomes=outcomes,
        scales=np.ones(10),
        threshold=0.1,
        clustered=True,
    )


def assert_same_bits(one: Metastability, other: Metastability) -> None:
    assert one.mfpt == other.mfpt
    assert one.failure_probability == other.failure_probability
    assert one.lambda_2 == other.lambda_2
    assert one.failure_shares == other.failure_shares
    assert np.array_equal(one.distribution, other.distribution)


SIGMAS = np.radians([1.25, 0.715, 0.526, 0.432, 3.0])  # MFPT 1e3, 1e8, 1e14, 1e20, and a few


def test_large_chain_in_high_precision():
    rows, slopes = walker(4, 0.5)
    mesh = mesh_of(*lifted(rows, len(slopes), 6561), slopes)
    found = metastabilities(mesh, 0.0, SIGMAS)
    for sigma, result in zip(SIGMAS, found, strict=True):
        p = slope_probabilities(slopes, 0.0, sigma)
        assert relative(result.mfpt, 1 / exact_failure_probability(rows, p)) < RELATIVE
    times = found[2].mfpt_from_state[1:].reshape(len(rows), -1)
    exact = exact_times(rows, slope_probabilities(slopes, 0.0, SIGMAS[2]))
    for copies, reference in zip(times, exact, strict=True):
        assert relative(copies.min(), reference) < RELATIVE
        assert relative(copies.max(), reference) < RELATIVE


@pytest.mark.parametrize("e", [1e-3, 1e-14, 1e-60])
def test_large_tree_with_a_rare_fall_from_a_rare_leaf(e):
    # From the root over m branches to m^2 leaves and back, where one leaf falls on the first
    # slope. It has probability q^2, so lambda_2^3 = 1 - q^2 e. Period 3.
    m = 100
    branches, leaves = 2 + np.arange(m), 2 + m + np.arange(m * m)
    targets = np.ones((leaves[-1] + 1, m), dtype=np.uint32)
    targets[0] = 0
    targets[1] = branches
    targets[branches] = leaves.reshape(m, m)
    targets[leaves[-1], 0] = 0
    outcomes = np.where(targets == 0, 1, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    q = (1.0 - e) / (m - 1)
    result = solve_chain(targets, outcomes, [e, *[q] * (m - 1)])
    escape = -math.expm1(math.log1p(-q * q * e) / 3.0)
    assert result.failure_probability == pytest.approx(escape, rel=RELATIVE)


def test_one_result_has_the_same_bits_as_many_with_any_number_of_threads():
    rows, slopes = walker(12, 0.8)
    mesh = mesh_of(*lifted(rows, len(slopes), 243), slopes)
    sigmas = np.radians(np.linspace(1.0, 5.0, 7))
    assert len(mesh.states) * len(slopes) * len(sigmas) > markov._WORTH_THREADS
    alone = [metastability(mesh, 0.01, sigma) for sigma in sigmas]
    for threads in (1, 2, 3, None):
        found = metastabilities(mesh, 0.01, sigmas, threads=threads)
        for one, other in zip(alone, found, strict=True):
            assert_same_bits(one, other)


_DIGITS = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_markov import lifted, walker
from biped_mfpt_ros.chain import aggregation, markov
rows, slopes = walker(12, 0.8)
aggregation.GROUPS = 200  # of 225 and 25 states
for steps in (markov._STEPS, 0):
    markov._STEPS = steps
    for copies in (1, 9):
        for sigma in np.radians([0.7, 1.3, 2.1, 3.0]):
            for rho in (0.0, 0.6):
                p = markov.conditional_probabilities(slopes, 0.001, sigma, rho)
                targets, outcomes = lifted(rows, len(slopes), copies)
                found = markov.solve_chain(targets, outcomes, p[40])  # flat
                print(p.tobytes().hex(), found.mfpt, found.failure_shares)
                print(found.distribution.tobytes().hex(), found.mfpt_from_state.tobytes().hex())
"""


def test_bits_do_not_depend_on_the_processor():
    # What a bag says is computed again anywhere.
    here, older = printed_on_two(_DIGITS, str(Path(__file__).parent))
    assert len(here.splitlines()) == 64
    assert here == older


def test_columns_that_settle_at_different_times_do_not_mix():
    # One survives no step, one no second; one never falls; the others are done at their own time.
    rows = [[2, 0, 0, 1], [3, 0, 1, 1], [0, 0, 1, 2]]
    targets = np.array([[0] * 4, *rows], dtype=np.uint32)
    outcomes = np.where(targets == 0, 9, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    columns = np.array(
        [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0.5, 0.5], [0.1, 0.2, 0.3, 0.4]]
    )
    found = solve_columns(targets, outcomes, columns)
    assert [found[0].mfpt, found[1].mfpt, found[2].mfpt] == [1.0, 1.0, math.inf]
    for p, result in zip(columns, found, strict=True):
        assert_same_bits(result, solve_chain(targets, outcomes, p))

    rows, slopes = walker(12, 0.8)
    mesh = mesh_of(*lifted(rows, len(slopes), 1), slopes)
    sigmas = np.radians(np.linspace(0.5, 5.0, 30))
    for sigma, result in zip(sigmas, metastabilities(mesh, 0.0, sigmas), strict=True):
        assert_same_bits(result, metastability(mesh, 0.0, sigma))


def test_fall_back_of_one_column_leaves_the_others(monkeypatch):
    # At the second distribution the two gaits hardly ever change: not iterated.
    rows = [[1, 0, 1, 2], [2, 2, 0, 2]]
    targets = np.array([[0] * 4, *rows], dtype=np.uint32)
    outcomes = np.where(targets == 0, 9, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    columns = np.array([[0.4, 0.1, 0.2, 0.3], [1.0 - 3e-9, 1e-9, 1e-12, 2e-9]])
    found = solve_columns(targets, outcomes, columns)
    for p, result in zip(columns, found, strict=True):
        assert relative(result.mfpt, 1 / exact_failure_probability(rows, p)) < RELATIVE


def test_progress_is_reported(monkeypatch):
    monkeypatch.setattr(iteration, "_CALL_SECONDS", 0.0)
    rows, slopes = walker(12, 0.8)
    mesh = mesh_of(*lifted(rows, len(slopes), 81), slopes)
    calls = []
    found = metastabilities(
        mesh,
        0.0,
        np.radians(np.linspace(1.0, 4.0, 40)),
        threads=1,
        on_progress=lambda *a: calls.append(a),
    )
    solved, steps, missing = zip(*calls, strict=True)
    assert list(solved) == sorted(solved)
    assert solved[0] == 0
    assert solved[-1] == 32
    assert steps[:3] == (4, 8, 12)
    assert missing[0] > 1e-3
    assert_same_bits(found[0], metastability(mesh, 0.0, math.radians(1.0)))


@pytest.mark.parametrize(
    ("sigmas", "field"), [([0.1, 0.0], r"sigma_s\[1\]"), ([math.nan], r"sigma_s\[0\]")]
)
def test_a_wrong_sigma_among_many_is_named(sigmas, field):
    mesh = mesh_of([[0, 0], [1, 0]], [[NOT_SIMULATED] * 2, [0, 1]], np.array([0.0, 0.1]))
    assert metastabilities(mesh, 0.0, []) == []
    with pytest.raises(InputError, match=f"^{field}"):
        metastabilities(mesh, 0.0, sigmas)
    with pytest.raises(InputError, match=r"^mu_s"):
        metastabilities(mesh, 1.0, [0.1])


# Properties -------------------------------------------------------------------------------------


@given(chains())
@settings(deadline=None)
def test_transition_matrix_is_stochastic(chain):
    rows, p = chain
    targets = np.array([[0] * len(p), *rows])
    t = transition_matrix(targets, p)
    # Each row is the same m probabilities, summed in some order.
    assert t.sum(axis=1) == pytest.approx(np.ones(len(targets)), abs=len(p) * 2.3e-16)
    for i, j in np.ndindex(t.shape):
        expected = float(i == j) if i == 0 else p[targets[i] == j].sum()
        assert t[i, j] == pytest.approx(expected, rel=1e-15)


@given(chains(), st.randoms(use_true_random=False))
@settings(deadline=None)
def test_results_are_probabilities_and_do_not_depend_on_names(chain, random):
    rows, p = chain
    n = len(rows)
    result = solve(rows, p)
    assert result.distribution.sum() == pytest.approx(1.0, abs=1e-14)
    assert result.distribution[0] == 0.0
    assert (result.distribution >= 0.0).all()
    assert result.lambda_2 + result.failure_probability == pytest.approx(1.0, abs=1e-15)
    assert sum(result.failure_shares.values()) == pytest.approx(float(result.mfpt < math.inf))

    others = list(range(2, n + 1))
    random.shuffle(others)
    name = [0, 1, *others]
    renamed = [[]] * n
    for i, row in enumerate(rows, start=1):
        renamed[name[i] - 1] = [name[target] for target in row]
    other = solve(renamed, p)
    assert other.mfpt == pytest.approx(result.mfpt, rel=1e-11)
    assert other.mfpt_from_state[name] == pytest.approx(result.mfpt_from_state, rel=1e-11)


@given(chains())
@settings(deadline=None)
def test_metastable_distribution_is_an_eigenvector(chain):
    rows, p = chain
    result = solve(rows, p)
    q = transition_matrix([[0] * len(p), *rows], p)[1:, 1:].toarray()
    phi = result.distribution[1:]
    assert phi @ q == pytest.approx(result.lambda_2 * phi, abs=1e-11)


@given(chains(), st.data())
@settings(deadline=None)
def test_surviving_one_more_fall_never_lowers_the_mfpt(chain, data):
    # Q grows in one entry, and so does its largest eigenvalue, or it stays.
    rows, p = chain
    falls = [(i, s) for i, row in enumerate(rows) for s, target in enumerate(row) if target == 0]
    if not falls:
        return
    i, s = data.draw(st.sampled_from(falls))
    better = [list(row) for row in rows]
    better[i][s] = data.draw(st.integers(1, len(rows)))
    assert solve(better, p).mfpt >= solve(rows, p).mfpt * (1.0 - 1e-11)


def test_failure_shares_are_weighted_by_state_and_slope(method):
    # Stationary 2:1 between the states but for falls; they fall with codes 1, 7 and 9.
    targets = [[0] * 4, [0, 1, 2, 0], [0, 1, 1, 2]]
    outcomes = [[NOT_SIMULATED] * 4, [7, 0, 0, 1], [9, 0, 0, 0]]
    p = np.array([1e-14, 0.5, 0.5 - 3e-14, 2e-14])
    result = solve_chain(targets, outcomes, p)
    phi = result.distribution
    total = phi[1] * (p[0] + p[3]) + phi[2] * p[0]
    assert result.failure_probability == pytest.approx(total, rel=1e-13)
    assert list(result.failure_shares) == [1, 7, 9]
    assert result.failure_shares[1] == pytest.approx(phi[1] * p[3] / total, rel=1e-13)
    assert result.failure_shares[7] == pytest.approx(phi[1] * p[0] / total, rel=1e-13)
    assert result.failure_shares[9] == pytest.approx(phi[2] * p[0] / total, rel=1e-13)


# Slopes -----------------------------------------------------------------------------------------


def test_slope_probabilities_are_the_normal_density():
    slopes = np.radians(np.arange(-40, 41) * 0.5)
    mu, sigma = math.radians(0.3), math.radians(1.0)
    p = slope_probabilities(slopes, mu, sigma)
    with mpmath.workdps(50):
        density = [
            mpmath.npdf(mpmath.mpf(float(s)), mpmath.mpf(mu), mpmath.mpf(sigma)) for s in slopes
        ]
        total = sum(density)
        for value, reference in zip(p, density, strict=True):
            # Down to 1e-92: the exponent is right to some 1e-16 of itself.
            assert relative(value, reference / total) < 1e-13


@pytest.mark.parametrize(("ratio", "error"), [(0.5, 1e-14), (1.0, 3e-7), (2.0, 0.3)])
def test_slope_probabilities_have_the_moments_of_the_distribution(ratio, error):
    # What the docstring says of the trapezoidal rule: d_s = ratio sigma_s. The second moment's
    # error is about 4 pi^2 / ratio^2 times that of the sum, 2 exp(-2 pi^2 / ratio^2).
    slopes = np.arange(-200, 201) * 0.001
    mu, sigma = 0.0123, 0.001 / ratio
    p = slope_probabilities(slopes, mu, sigma)
    assert p.sum() == pytest.approx(1.0, abs=1e-15)
    assert p @ slopes == pytest.approx(mu, abs=error * sigma)
    assert p @ (slopes - mu) ** 2 == pytest.approx(sigma**2, rel=error)


def test_slope_probabilities_below_any_number_are_zero():
    # e^-702 is 1e-305, e^-720 is 1e-313, where digits are missing.
    slopes = [0.0, *(0.01 * math.sqrt(2.0 * exponent) for exponent in (702.0, 720.0)), 0.7]
    p = slope_probabilities(slopes, 0.0, 0.01)
    ratio = mpmath.mpf(slopes[1]) / mpmath.mpf(0.01)
    assert relative(p[1], mpmath.exp(-(ratio**2) / 2)) < 1e-12
    assert p.tolist() == [1.0, p[1], 0.0, 0.0]


def test_narrow_density_falls_on_the_nearest_slope():
    assert slope_probabilities([-0.1, 0.0, 0.1], 0.04, 1e-9).tolist() == [0.0, 1.0, 0.0]
    assert slope_probabilities([-0.1, 0.1], 0.0, 1e-200).tolist() == [0.5, 0.5]


# Bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, -1.0, math.nan, math.inf, "1"])
def test_sigma_must_be_positive(sigma):
    with pytest.raises(InputError, match=r"^sigma_s"):
        slope_probabilities([0.0, 0.1], 0.0, sigma)


@pytest.mark.parametrize("mu", [-0.01, 0.11, math.nan, math.inf, None])
def test_mu_must_be_within_the_slopes(mu):
    with pytest.raises(InputError, match=r"^mu_s"):
        slope_probabilities([0.0, 0.1], mu, 0.1)


@pytest.mark.parametrize("slopes", [[], [0.1, 0.0], [0.0, 0.0], [0.0, math.nan], [[0.0]]])
def test_slopes_must_ascend(slopes):
    with pytest.raises(InputError, match=r"^slopes"):
        slope_probabilities(slopes, 0.0, 0.1)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("targets", {"targets": [0, 0]}),
        ("targets", {"targets": [[0, 0]]}),
        ("targets", {"targets": [[0, 0], [2, 0]]}),
        ("targets", {"targets": [[0, 0], [-1, 0]]}),
        ("targets", {"targets": [[0, 0], [math.nan, 0]]}),
        ("targets", {"targets": [[0, 0], [0, 0]]}),
        ("targets", {"targets": [[1, 0], [1, 0]]}),
        ("outcomes", {"outcomes": [[255, 255]]}),
        ("outcomes", {"outcomes": [[255, 255], [0, 256]]}),
        ("targets", {"outcomes": [[255, 255], [0, 0]]}),
        ("targets", {"outcomes": [[0, 0], [0, 1]]}),
        ("probabilities", {"probabilities": [1.0]}),
        ("probabilities", {"probabilities": [0.5, 0.4]}),
        ("probabilities", {"probabilities": [1.5, -0.5]}),
        (r"outcomes\[1, 1\]", {"outcomes": [[255, 255], [0, 255]]}),
        (r"outcomes\[1, 1\]", {"outcomes": [[255, 255], [0, 11]]}),
        ("probabilities", {"probabilities": [math.nan, 1.0]}),
    ],
)
def test_chain_arrays_are_checked(field, change):
    good = {
        "targets": [[0, 0], [1, 0]],
        "outcomes": [[255, 255], [0, 1]],
        "probabilities": [0.5, 0.5],
    }
    assert solve_chain(**good).mfpt == 2.0
    with pytest.raises(InputError, match=f"^{field}"):
        solve_chain(**{**good, **change})


def test_rows_of_a_large_chain_are_checked_to_the_last():
    targets, outcomes = np.ones((9001, 2), dtype=int), np.zeros((9001, 2), dtype=int)
    targets[0], outcomes[0], outcomes[9000, 1] = 0, NOT_SIMULATED, 3
    with pytest.raises(InputError, match=r"^targets\[9000, 1\], outcomes\[9000, 1\]: \(1, 3\)"):
        solve_chain(targets, outcomes, [0.5, 0.5])
    outcomes[9000, 1] = 0
    targets[:, 1], targets[9000, 1] = 2, 1
    targets[0] = 0
    preceding = np.zeros(9001, dtype=int)
    preceding[2] = 1
    with pytest.raises(InputError, match=r"^preceding\[1\]: 0 .* state 9000 leads"):
        solve_chain(targets, outcomes, [[0.5, 0.5]] * 2, preceding)


def test_too_slow_is_a_clear_error(only_iteration):
    with pytest.raises(ChainError, match="300 states"):
        solve(birth_death(300, ends=(0, 0)), [0.5, 0.5])


def test_an_unsolved_distribution_leaves_the_others(monkeypatch, only_iteration):
    monkeypatch.setattr(markov, "_STEPS", 500)
    targets = np.array([[0] * 4, [1, 0, 1, 2], [2, 2, 0, 2]], dtype=np.uint32)
    outcomes = np.where(targets == 0, 9, 0).astype(np.uint8)
    outcomes[0] = NOT_SIMULATED
    columns = np.array([[1.0 - 3e-9, 1e-9, 1e-12, 2e-9], [0.4, 0.1, 0.2, 0.3]])
    slow, found = solve_columns(targets, outcomes, columns)
    assert isinstance(slow, ChainError)
    assert_same_bits(found, solve_chain(targets, outcomes, columns[1]))


def test_one_mesh_serves_any_distribution():
    rows, slopes = walker(4, 0.5)
    targets = np.array([[0] * len(slopes), *rows])
    outcomes = np.where(targets == 0, 6, 0)
    outcomes[0] = NOT_SIMULATED
    mesh = mesh_of(targets, outcomes, slopes)
    before = math.inf
    for sigma_deg in (0.5, 1.0, 2.0, 4.0):
        p = slope_probabilities(slopes, 0.0, math.radians(sigma_deg))
        result = metastability(mesh, 0.0, math.radians(sigma_deg))
        assert result.mfpt == solve(rows, p).mfpt
        assert result.failure_shares == {6: 1.0}
        assert result.mfpt < before  # rougher ground
        before = result.mfpt
