"""Meshing, with a toy step map in ten dimensions that settles on a surface and falls at times."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biped_mfpt_ros.chain.markov import metastability, slope_probabilities
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh, MeshGrowth, MeshLimitError, grow_mesh
from biped_mfpt_ros.errors import InputError

SLOPES = np.radians(np.arange(-10, 11) * 2.0)
START = np.zeros(10)


@dataclass
class Answer:
    outcomes: np.ndarray
    next_states: np.ndarray


@dataclass
class Toy:
    """Step map of two numbers (u, v) and the slope, drawn out to ten. Products and sums only,
    so that a state's answer does not depend, to the last bit, on the states beside it."""

    slopes: np.ndarray = field(default_factory=lambda: SLOPES)
    memory: float = 0.3
    limit: float = 0.8

    def step(self, states, s):
        """Next states (..., 10), and whether they are reached, for states (n, 10), slopes (n,)."""
        u, v = states[:, 0], states[:, 1]
        a = self.memory * u + 1.8 * s - 0.6 * v * s
        b = 0.2 * v + 0.5 * u * u - 1.2 * s * s + 0.2 * s
        columns = [a, b, a * b, a * a, b * b, a + b, a - 2.0 * b, a * a * b + s, s * a, s + 0.0 * a]
        return np.stack(columns, axis=-1), np.abs(a + 0.2 * b) < self.limit

    def __call__(self, states, previous_slopes):
        n, m = len(states), len(self.slopes)
        reached, stands = self.step(np.repeat(states, m, axis=0), np.tile(self.slopes, n))
        outcomes = np.where(stands, 0, np.where(reached[:, 0] > 0.0, 3, 5)).astype(np.uint8)
        return Answer(outcomes.reshape(n, m), reached[stands])


def brute_force(candidate, states, scales):
    d = np.zeros(len(states))
    for i in range(10):
        d += ((candidate[i] - states[:, i]) * (1.0 / scales[i])) ** 2
    return d


def plain_algorithm_1(simulate, start, slopes, threshold, clustered, scale_refresh):
    """Algorithm 1 as in the paper, one state and one slope at a time, on Python lists."""

    def spread(xs):
        xs = np.array(xs).reshape(-1, 10)
        r = xs.std(axis=0) if len(xs) else np.zeros(10)
        r[r <= 1e-12 * np.abs(xs).max(axis=0, initial=1.0)] = 0.0
        return r

    def refreshed(x, candidates):
        r = spread(x)
        r = np.where(r > 0.0, r, spread(candidates))
        return np.where(r > 0.0, r, np.inf)

    x, clusters, generations, results = [start], [list(slopes).index(0.0)], [0], {}
    frontier, generation = [0], 0
    while frontier:
        generation += 1
        for i in frontier:
            answer = simulate(x[i][None], np.array([slopes[clusters[i]]]))
            states = iter(answer.next_states)
            results[i] = [next(states) if o == 0 else None for o in answer.outcomes[0]]
        candidates = [c for i in frontier for c in results[i] if c is not None]
        r = refreshed(x, candidates)
        first = len(x)
        for i in frontier:
            for s, candidate in enumerate(results[i]):
                if candidate is None:
                    continue
                if scale_refresh == "addition":
                    r = refreshed(x, candidates)
                same = [j for j in range(len(x)) if not clustered or clusters[j] == s]
                if all(brute_force(candidate, np.array(x)[same], r) > threshold):
                    x.append(candidate)
                    clusters.append(s)
                    generations.append(generation)
        frontier = range(first, len(x))
    return np.array(x), clusters, generations, r


def same_mesh(a: Mesh, b: Mesh) -> bool:
    arrays = ("slopes", "states", "preceding", "generation", "targets", "outcomes", "scales")
    return all(getattr(a, k).tobytes() == getattr(b, k).tobytes() for k in arrays)


@pytest.fixture(scope="module", params=[True, False], ids=["clustered", "among all"])
def mesh(request):
    return grow_mesh(Toy(), START, SLOPES, 0.05, clustered=request.param)


def grow_in_pieces(simulate, threshold, clustered, rng):
    """Chunks of random sizes, several in flight, answered in random order."""
    growth = MeshGrowth(START, SLOPES, threshold, clustered=clustered)
    handed_out, asked, ahead = 1, [], 0
    while not growth.complete:
        while handed_out < growth.known and len(asked) < 7:
            stop = min(growth.known, handed_out + int(rng.integers(1, 12)))
            asked.append((handed_out, stop))
            handed_out = stop
        start, stop = asked.pop(int(rng.integers(len(asked))))
        growth.take(start, simulate(*growth.states(start, stop)), stop - start)
        ahead = max(ahead, stop - growth.tested)
    assert not asked
    assert handed_out == growth.known == growth.tested
    return growth.mesh(), ahead


# What a mesh must be ----------------------------------------------------------------------------


@pytest.mark.parametrize("clustered", [True, False])
@pytest.mark.parametrize("threshold", [0.3, 1.0, 30.0])
@pytest.mark.parametrize("scale_refresh", ["generation", "addition"])
def test_mesh_is_that_of_the_plain_algorithm(clustered, threshold, scale_refresh):
    mesh = grow_mesh(
        Toy(), START, SLOPES, threshold, clustered=clustered, scale_refresh=scale_refresh
    )
    x, clusters, generations, r = plain_algorithm_1(
        Toy(), START, SLOPES, threshold, clustered, scale_refresh
    )
    assert np.array_equal(mesh.states[1:], x)
    assert mesh.preceding[1:].tolist() == clusters
    assert mesh.generation[1:].tolist() == generations
    # Sums of the same numbers, in another order.
    assert mesh.scales == pytest.approx(r, rel=1e-12)


@pytest.mark.parametrize("clustered", [True, False])
@pytest.mark.parametrize("threshold", [0.02, 0.3])
def test_mesh_is_the_same_whatever_the_pieces_and_the_order_of_answers(clustered, threshold):
    whole = grow_mesh(Toy(), START, SLOPES, threshold, clustered=clustered)
    for seed in range(20):
        mesh, ahead = grow_in_pieces(Toy(), threshold, clustered, np.random.default_rng(seed))
        assert same_mesh(mesh, whole)
        assert ahead > 0  # answers did overtake one another


def test_the_next_generation_is_known_before_this_one_is_answered():
    growth = MeshGrowth(START, SLOPES, 0.02)
    toy = Toy()
    while growth.generations < 4:
        start, stop = growth.tested, growth.known
        growth.take(start, toy(*growth.states(start, stop)), stop - start)
    start, known = growth.tested, growth.known
    assert known - start > 4
    growth.take(start, toy(*growth.states(start, start + 2)), 2)
    assert (growth.generations, growth.tested) == (4, start + 2)
    assert growth.known > known
    # Its own answers wait for the scales, and so for the rest of this one.
    growth.take(known, toy(*growth.states(known, growth.known)), growth.known - known)
    assert growth.tested == start + 2


def test_failure_state_comes_first(mesh):
    assert not mesh.states[0].any()
    assert (mesh.preceding[0], mesh.generation[0]) == (0, 0)
    assert not mesh.targets[0].any()
    assert (mesh.outcomes[0] == NOT_SIMULATED).all()


def test_arrays_have_compact_types_and_are_read_only(mesh):
    n, m = len(mesh.states), len(SLOPES)
    expected = {
        "slopes": (np.float64, (m,)),
        "states": (np.float64, (n, 10)),
        "preceding": (np.uint32, (n,)),
        "generation": (np.uint32, (n,)),
        "targets": (np.uint32, (n, m)),
        "outcomes": (np.uint8, (n, m)),
        "scales": (np.float64, (10,)),
    }
    for name, (dtype, shape) in expected.items():
        array = getattr(mesh, name)
        assert (array.dtype, array.shape) == (dtype, shape), name
        assert not array.flags.writeable, name


def test_every_target_is_the_nearest_state(mesh):
    answer = Toy()(mesh.states[1:], SLOPES[mesh.preceding[1:]])
    assert np.array_equal(answer.outcomes, mesh.outcomes[1:])
    assert (mesh.targets[1:][answer.outcomes != 0] == 0).all()
    successors = iter(answer.next_states)
    everyone = np.arange(1, len(mesh.states))
    for row, outcomes in zip(mesh.targets[1:], answer.outcomes, strict=True):
        for s in np.flatnonzero(outcomes == 0):
            own = everyone[mesh.preceding[1:] == s] if mesh.clustered else everyone
            d = brute_force(next(successors), mesh.states[own], mesh.scales)
            assert row[s] == own[np.argmin(d)]


def test_states_are_apart_and_the_mesh_is_closed():
    # Under the scales at the time: each state from the earlier ones, and at the end every
    # successor of the last generation from no state.
    generations = []
    simulate = Toy()
    mesh = grow_mesh(
        simulate, START, SLOPES, 0.05, on_generation=lambda *args: generations.append(args)
    )
    assert [g for g, *_ in generations] == list(range(mesh.generation.max() + 1))
    for (g, first, states, preceding), (_, before, *_) in zip(
        generations[1:], generations, strict=False
    ):
        earlier = mesh.states[1:first]
        r = earlier.std(axis=0)
        if g == 1:
            r = simulate(START[None], np.zeros(1)).next_states.std(axis=0)
        assert before < first
        for k, (state, cluster) in enumerate(zip(states, preceding, strict=True)):
            index = first + k
            own = np.flatnonzero(mesh.preceding[1:index] == cluster) + 1
            assert (brute_force(state, mesh.states[own], r) > 0.05 * (1.0 - 1e-9)).all()
    last = simulate(mesh.states[generations[-1][1] :], np.zeros(len(generations[-1][2])))
    targets = mesh.targets[generations[-1][1] :][last.outcomes == 0]
    for successor, target in zip(last.next_states, targets, strict=True):
        d = brute_force(successor, mesh.states[[target]], mesh.scales)
        assert d[0] <= 0.05


def test_every_state_is_the_target_of_the_step_that_found_it(mesh):
    # So x_2 leads to every state, and the chain over the mesh is about all of it.
    assert set(range(2, len(mesh.states))) <= set(mesh.targets.ravel().tolist())


def test_mesh_and_chain_agree_with_monte_carlo():
    toy = Toy(limit=0.45)
    mesh = grow_mesh(toy, START, SLOPES, 0.003)
    sigma = np.radians(6.0)
    expected = metastability(mesh, 0.0, sigma).mfpt_from_state[1]
    rng = np.random.default_rng(7)
    walks = 20_000
    states, steps = np.zeros((walks, 10)), 0
    p = slope_probabilities(SLOPES, 0.0, sigma)
    while len(states):
        steps += len(states)
        states, stands = toy.step(states, rng.choice(SLOPES, len(states), p=p))
        states = states[stands]
    # Steps to a fall are nearly geometric: the mean of 20000 is good to 0.7 %, here four times.
    assert steps / walks == pytest.approx(expected, rel=0.028)
    assert 3.0 < expected < 300.0


# The same whoever simulates ---------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_chunks_in_any_order_give_the_same_mesh(seed):
    rng = np.random.default_rng(seed)
    toy = Toy()

    def in_chunks(states, previous_slopes):
        cuts = np.sort(rng.integers(0, len(states) + 1, rng.integers(0, 6)))
        chunks = [c for c in np.split(np.arange(len(states)), cuts) if len(c)]
        answers = {}
        for k in rng.permutation(len(chunks)):
            answers[k] = toy(states[chunks[k]], previous_slopes[chunks[k]])
        ordered = [answers[k] for k in range(len(chunks))]
        return Answer(
            np.concatenate([a.outcomes for a in ordered]),
            np.concatenate([a.next_states for a in ordered]),
        )

    assert same_mesh(grow_mesh(in_chunks, START, SLOPES, 0.3), grow_mesh(toy, START, SLOPES, 0.3))


def test_growing_again_from_recorded_answers_simulates_nothing():
    record = {}
    simulated = []

    def simulate(states, previous_slopes):
        for state, slope in zip(states, previous_slopes, strict=True):
            if state.tobytes() not in record:
                simulated.append(slope)
                record[state.tobytes()] = Toy()(state[None], np.array([slope]))
        answers = [record[state.tobytes()] for state in states]
        return Answer(
            np.concatenate([a.outcomes for a in answers]),
            np.concatenate([a.next_states for a in answers]),
        )

    whole = grow_mesh(simulate, START, SLOPES, 0.3)
    assert len(simulated) == len(whole.states) - 1
    assert np.array_equal(simulated, SLOPES[whole.preceding[1:]])
    for key in list(record)[len(record) // 3 :]:
        del record[key]  # as if stopped after a third
    simulated.clear()
    again = grow_mesh(simulate, START, SLOPES, 0.3)
    assert same_mesh(again, whole)
    assert len(simulated) == len(whole.states) - 1 - (len(whole.states) - 1) // 3


def test_generations_are_reported_as_they_are_added():
    seen = []
    mesh = grow_mesh(Toy(), START, SLOPES, 0.3, on_generation=lambda *args: seen.append(args))
    assert [first for _, first, *_ in seen] == [
        np.flatnonzero((mesh.generation == g) & (np.arange(len(mesh.states)) > 0))[0]
        for g in range(mesh.generation.max() + 1)
    ]
    assert np.array_equal(np.concatenate([states for *_, states, _ in seen]), mesh.states[1:])
    assert np.array_equal(np.concatenate([p for *_, p in seen]), mesh.preceding[1:])


@pytest.mark.parametrize("where", ["simulate", "on_generation"])
def test_an_exception_ends_the_growth(where):
    def stop(*_):
        raise InterruptedError

    with pytest.raises(InterruptedError):
        grow_mesh(
            stop if where == "simulate" else Toy(),
            START,
            SLOPES,
            0.3,
            on_generation=stop if where == "on_generation" else None,
        )


# Edges ------------------------------------------------------------------------------------------


def test_walker_that_always_falls():
    mesh = grow_mesh(Toy(limit=0.0), START, SLOPES, 0.1)
    assert len(mesh.states) == 2
    assert not mesh.targets.any()
    assert (mesh.outcomes[1] != 0).all()
    assert np.isinf(mesh.scales).all()
    assert metastability(mesh, 0.0, 0.1).mfpt == 1.0


def test_huge_threshold_leaves_one_state_a_cluster():
    toy = Toy(limit=0.5)
    among_all = grow_mesh(toy, START, SLOPES, 1e9, clustered=False)
    assert len(among_all.states) == 2
    assert set(among_all.targets[1].tolist()) == {0, 1}
    clustered = grow_mesh(toy, START, SLOPES, 1e9)
    reached = np.unique(np.nonzero(clustered.outcomes[1:] == 0)[1])
    assert len(clustered.states) == 1 + len(reached)
    assert set(clustered.preceding[1:]) == set(reached)


def test_one_slope():
    mesh = grow_mesh(Toy(slopes=np.zeros(1)), START, np.zeros(1), 0.1)
    assert len(mesh.states) == 2
    assert mesh.targets.tolist() == [[0], [1]]
    assert metastability(mesh, 0.0, 0.1).mfpt == np.inf


def test_initial_slope_is_the_cluster_of_the_initial_state():
    # Degrees converted in another way differ in the last digit.
    mesh = grow_mesh(Toy(), START, SLOPES, 1.0, initial_slope=4.0 * (np.pi / 180.0))
    assert SLOPES[mesh.preceding[1]] == pytest.approx(np.radians(4.0))


@pytest.mark.parametrize("constant", [2.5, 0.0])
@pytest.mark.parametrize("noise", [0.0, 1e-15])
def test_dimension_without_spread_does_not_count(constant, noise):
    plain = grow_mesh(Toy(), START, SLOPES, 0.3)

    def simulate(states, previous_slopes):
        answer = Toy()(states, previous_slopes)
        # Dimension 9 goes to a constant, from the first step on, but for rounding.
        answer.next_states[:, 9] = constant + noise * np.sign(answer.next_states[:, 0])
        return answer

    start = START.copy()
    start[9] = constant
    mesh = grow_mesh(simulate, start, SLOPES, 0.3)
    assert np.isinf(mesh.scales[9])
    assert np.isfinite(mesh.scales[:9]).all()
    assert len(mesh.states) > 100
    # It is not of the size of the mesh with that dimension, which is the slope.
    assert len(mesh.states) <= len(plain.states)


def test_dimension_that_spreads_late_counts_from_then_on():
    # Dimension 9 is constant for the first step, then it is not.
    def simulate(states, previous_slopes):
        answer = Toy()(states, previous_slopes)
        first = not states.any()
        answer.next_states[:, 9] = 0.0 if first else answer.next_states[:, 0]
        return answer

    scales = []

    def watch(generation, first_index, states, preceding):
        scales.append(states[:, 9].std())

    mesh = grow_mesh(simulate, START, SLOPES, 0.3, on_generation=watch)
    assert scales[:2] == [0.0, 0.0]
    assert scales[2] > 0.0
    assert mesh.scales[9] == pytest.approx(mesh.states[1:, 9].std(), rel=1e-9)


def test_limit_is_an_error_with_the_numbers_in_it():
    n = len(grow_mesh(Toy(), START, SLOPES, 0.3).states)
    assert len(grow_mesh(Toy(), START, SLOPES, 0.3, max_states=n).states) == n
    n = len(grow_mesh(Toy(), START, SLOPES, 0.3, scale_refresh="addition").states)
    assert n == len(
        grow_mesh(Toy(), START, SLOPES, 0.3, scale_refresh="addition", max_states=n).states
    )
    with pytest.raises(MeshLimitError):
        grow_mesh(Toy(), START, SLOPES, 0.3, scale_refresh="addition", max_states=n - 1)
    with pytest.raises(MeshLimitError) as caught:
        grow_mesh(Toy(), START, SLOPES, 0.3, max_states=50)
    error = caught.value
    assert (error.max_states, error.threshold) == (50, 0.3)
    assert error.generation >= 2
    assert 1 <= error.explored < 49
    for number in (
        "max_states = 50",
        f"generation {error.generation}",
        f"with {error.explored} simulated",
    ):
        assert number in str(error)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


# Bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("initial_state", {"initial_state": np.zeros(9)}),
        ("initial_state", {"initial_state": np.zeros((1, 10))}),
        ("initial_state", {"initial_state": np.full(10, np.nan)}),
        ("initial_state", {"initial_state": ["a"] * 10}),
        ("initial_state", {"initial_state": [[1.0], [1.0, 2.0]]}),
        ("slopes", {"slopes": []}),
        ("slopes", {"slopes": [0.0, 0.0]}),
        ("slopes", {"slopes": [0.1, 0.0]}),
        ("slopes", {"slopes": [0.0, np.inf]}),
        ("threshold", {"threshold": 0.0}),
        ("threshold", {"threshold": -1.0}),
        ("threshold", {"threshold": np.nan}),
        ("threshold", {"threshold": np.inf}),
        ("threshold", {"threshold": "0.3"}),
        ("initial_slope", {"initial_slope": 0.01}),
        ("initial_slope", {"initial_slope": np.nan}),
        ("scale_refresh", {"scale_refresh": "state"}),
        ("max_states", {"max_states": 1}),
        ("max_states", {"max_states": 2**32}),
        ("max_states", {"max_states": 100.5}),
    ],
)
def test_arguments_are_checked(field, change):
    good = {"initial_state": START, "slopes": SLOPES, "threshold": 0.3}

    def simulate(*_):
        raise AssertionError("checked before anything is simulated")

    with pytest.raises(InputError, match=rf"^{field}"):
        grow_mesh(simulate, **{**good, **change})


@pytest.mark.parametrize(
    ("field", "spoil"),
    [
        ("outcomes", lambda a: Answer(a.outcomes[:, :-1], a.next_states)),
        ("outcomes", lambda a: Answer(a.outcomes.ravel(), a.next_states)),
        ("outcomes", lambda a: Answer(a.outcomes.astype(int) + 300, a.next_states)),
        ("outcomes", lambda a: Answer(np.where(a.outcomes, 255, 0), a.next_states)),
        ("next_states", lambda a: Answer(a.outcomes, a.next_states[1:])),
        ("next_states", lambda a: Answer(a.outcomes, a.next_states[:, 1:])),
        ("next_states", lambda a: Answer(a.outcomes, a.next_states * np.nan)),
        ("next_states", lambda a: Answer(a.outcomes, a.next_states / 0.0)),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # from the division by zero
def test_answers_are_checked(field, spoil):
    with pytest.raises(InputError, match=rf"^{field}"):
        grow_mesh(lambda *args: spoil(Toy()(*args)), START, SLOPES, 0.3)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("states", lambda m: {"states": m.states[:1]}),
        ("states", lambda m: {"states": m.states[:, :9]}),
        ("states", lambda m: {"states": np.where(m.states == m.states[5], np.nan, m.states)}),
        ("states", lambda m: {"states": 3.0}),
        ("preceding", lambda m: {"preceding": m.preceding[1:]}),
        ("preceding", lambda m: {"preceding": m.preceding + np.uint32(len(SLOPES))}),
        ("generation", lambda m: {"generation": m.generation - 1.5}),
        ("targets", lambda m: {"targets": m.targets + np.uint32(1)}),
        ("targets", lambda m: {"targets": m.targets[:-1]}),
        ("targets", lambda m: {"targets": np.zeros_like(m.targets)}),
        ("targets", lambda m: {"targets": m.targets.astype(np.int64) * 2**40}),
        ("targets", lambda m: {"outcomes": np.zeros_like(m.outcomes)}),
        ("outcomes", lambda m: {"outcomes": m.outcomes[:, :-1]}),
        ("scales", lambda m: {"scales": np.zeros(10)}),
        ("scales", lambda m: {"scales": np.full(10, np.nan)}),
        ("threshold", lambda m: {"threshold": 0.0}),
        ("slopes", lambda m: {"slopes": m.slopes[::-1]}),
    ],
)
def test_meshes_from_elsewhere_are_checked(mesh, field, change):
    # Such as one put together from a recording.
    assert same_mesh(replace(mesh), mesh)
    with pytest.raises(InputError, match=rf"^{field}"):
        replace(mesh, **change(mesh))
