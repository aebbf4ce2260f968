"""The nodes in one process: what they serve and publish, and what they do with bad input."""

import math
import time
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.msg import Controller as ControllerMsg
from biped_mfpt_msgs.msg import MeshInfo, MeshProgress, MeshStates, MeshTransitions, MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt, SimulateSteps
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from ros_graph import PATIENCE, Client, cancel, ros_graph, wait_for

from biped_mfpt_ros.chain.markov import metastability
from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.nodes import messages
from biped_mfpt_ros.nodes.analysis import Analysis
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.meshes import new_mesh_id
from biped_mfpt_ros.nodes.messages import MeshSettings, packed
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.qos import RESULTS
from biped_mfpt_ros.nodes.simulator import Simulator
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import slope_set

BASE = controller("hzd/base")
SLOPES = slope_set(0.5)


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


@pytest.fixture
def tester(graph):
    return graph.start(Client)


@pytest.fixture(scope="module")
def cycle_state():
    return find_limit_cycle(BASE).state


def settings(**changes):
    values = {"controller": BASE, "model": WalkerModel(), "slopes": SLOPES, "threshold": 0.3}
    return MeshSettings(**{**values, **changes})


def grown_here(settings, initial_state):
    return grow_mesh(
        lambda states, previous: simulate_steps(
            settings.controller, states, previous, settings.slopes, settings.model
        ),
        initial_state,
        settings.slopes,
        settings.threshold,
        clustered=settings.clustered,
    )


@pytest.fixture(scope="module")
def mesh_here(cycle_state):
    return grown_here(settings(), cycle_state)


def assert_same_mesh(a, b):
    for name in (
        "slopes", "states", "preceding", "generation", "targets", "outcomes", "scales"
    ):  # fmt: skip
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    assert (a.threshold, a.clustered) == (b.threshold, b.clustered)


# Simulator ---------------------------------------------------------------------------------------


def request(states, /, **changes):
    n = len(states)
    values = {
        "controller": ControllerMsg(name="hzd/base"),
        "model": messages.model_message(WalkerModel()),
        "states": packed(states, "d"),
        "previous_slopes": packed(np.zeros(n), "d"),
        "slopes": packed(SLOPES, "d"),
    }
    return SimulateSteps.Request(**{**values, **changes})


def test_simulator_serves_the_step_map(graph, tester, cycle_state):
    graph.start(Simulator)
    simulate = tester.simulator()
    states = np.array([cycle_state, cycle_state * 1.001, np.zeros(10)])
    expected = simulate_steps(BASE, states, np.zeros(3), SLOPES)
    for measures in (False, True):
        response = simulate(request(states, measures=measures, step_map=STEP_MAP))
        assert response.success
        assert response.step_map == STEP_MAP
        got = messages.steps_from(response, 3, len(SLOPES))
        assert got.outcomes.tobytes() == expected.outcomes.tobytes()
        assert got.next_states.tobytes() == expected.next_states.tobytes()
        for name in ("durations", "step_lengths", "energies"):
            wanted = getattr(expected, name).tobytes() if measures else b""
            assert getattr(got, name).tobytes() == wanted
    single = simulate(request(states[:1]))
    assert messages.steps_from(single, 1, len(SLOPES)).outcomes.tobytes() == (
        expected.outcomes[:1].tobytes()
    )


def test_a_request_that_costs_too_much_is_answered_in_part(graph, tester, cycle_state):
    graph.start(Simulator, max_evaluations=500_000)
    simulate = tester.simulator()
    crawling = BASE.parameters.copy()
    crawling[1] = 1e5  # damping that makes the integrator take tiny steps: 240000 evaluations
    states = np.tile(cycle_state, (100, 1))
    asked = request(states, controller=ControllerMsg(scheme="hzd", parameters=crawling.tolist()))
    response = simulate(asked)
    assert response.success
    assert 500_000 <= response.evaluations < 1_000_000
    done = len(response.outcomes) // len(SLOPES)
    assert 1 <= done < 10
    got = messages.steps_from(response, done, len(SLOPES))
    expected = simulate_steps(
        messages.controller_from(asked.controller, rabbit()), states[:done], np.zeros(done), SLOPES
    )
    assert got.outcomes.tobytes() == expected.outcomes.tobytes()
    assert got.next_states.tobytes() == expected.next_states.tobytes()


NOBODY = np.zeros((1, 10))


@pytest.fixture(scope="class")
def simulate():
    """One simulator for all bad requests: it has to survive every one of them."""
    with ros_graph() as graph:
        tester = graph.start(Client)
        graph.start(Simulator, max_states=100, max_outcomes=5000)
        yield tester.simulator()


class TestBadRequests:
    @pytest.mark.parametrize(
        ("changes", "names"),
        [
            ({"states": [0.0] * 11}, ("states", "11", "multiple of 10")),
            ({"states": [0.0] * 9 + [math.nan]}, ("states[0][9]", "nan", "finite")),
            ({"states": [math.inf] + [0.0] * 9}, ("states[0][0]", "inf", "finite")),
            ({"previous_slopes": [0.0, 0.0]}, ("previous_slopes", "(2,)", "(1,)")),
            ({"previous_slopes": []}, ("previous_slopes", "(0,)", "(1,)")),
            ({"previous_slopes": [math.nan]}, ("previous_slopes[0]", "nan")),
            ({"slopes": []}, ("slopes", "at least one slope")),
            ({"slopes": [0.1, 0.0]}, ("slopes[1]", "0.0", "ascending")),
            ({"slopes": [0.0, 1.0]}, ("slopes[1]", "1.0", "45 degrees")),
            ({"slopes": [math.nan]}, ("slopes[0]", "nan")),
            ({"controller": ControllerMsg(name="hzd/none")}, ("controller.name", "hzd/base")),
            (
                {"controller": ControllerMsg(scheme="x", parameters=[1.0])},
                ("controller.scheme", "hzd"),
            ),
            ({"states": [0.0] * 1010}, ("states", "101 states", "at most 100")),
            ({"states": [0.0] * 1000}, ("states", "100 states times 81", "at most 5000")),
            ({"step_map": "0.0.0+another"}, ("step_map", "0.0.0+another", STEP_MAP)),
        ],
    )
    def test_simulator_refuses_bad_requests_and_lives_on(self, simulate, changes, names):
        response = simulate(request(NOBODY, **changes))
        assert not response.success
        for name in names:
            assert name in response.message
        assert len(response.outcomes) == len(response.next_states) == 0
        assert simulate(request(NOBODY)).success

    def test_simulator_answers_an_empty_batch(self, simulate):
        response = simulate(request(np.empty((0, 10))))
        assert response.success
        assert len(response.outcomes) == 0


# Parameters --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Some(NodeParameters):
    on: bool = parameter(True, "a switch")
    count: int = parameter(3, "a number", 1, 5)
    rate: float = parameter(0.5, "1/s, a rate", 0.0, 2.0)
    label: str = parameter("x", "a label")
    angles: tuple[float, ...] = parameter((1.0, 2.0), "degrees, some angles", 0.0, 9.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("on", 1),
        ("count", 0),
        ("count", 6),
        ("count", 2.0),
        ("count", True),
        ("rate", 2.1),
        ("rate", math.nan),
        ("rate", "fast"),
        ("label", 7),
        ("angles", [1.0, 10.0]),
        ("angles", [math.nan]),
        ("angles", "12"),
        ("angles", 1.0),
    ],
)
def test_bad_parameters_are_vetoed_with_the_reason(graph, name, value):
    node = graph.start(lambda: Node("some"))
    declared = Declared(node, Some)
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert name in result.reason
    assert declared.now == Some()
    with pytest.raises(InputError, match=name):
        Some(**{name: value})


def test_parameters_are_set_described_and_kept_together(graph):
    node = graph.start(lambda: Node("some"))
    declared = Declared(node, Some)
    changes = [Parameter("rate", value=1), Parameter("angles", value=[3, 4])]
    assert all(result.successful for result in node.set_parameters(changes))
    assert declared.now == Some(rate=1.0, angles=(3.0, 4.0))
    assert isinstance(declared.now.rate, float)
    # One bad one among several leaves all as they were.
    together = [Parameter("rate", value=0.1), Parameter("count", value=9)]
    assert not node.set_parameters_atomically(together).successful
    assert declared.now.rate == 1.0
    descriptor = node.describe_parameter("count")
    assert descriptor.description == "a number"
    assert (descriptor.integer_range[0].from_value, descriptor.integer_range[0].to_value) == (1, 5)


def test_bad_parameters_at_the_start_are_an_input_error(graph):
    node = graph.start(lambda: Node("some", parameter_overrides=[Parameter("count", value=9)]))
    with pytest.raises(InputError, match="count: 9 is not allowed; allowed: a whole number from 1"):
        Declared(node, Some)


# Mesher ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clustered", [True, False])
def test_mesh_from_the_limit_cycle_is_the_one_grown_here(graph, tester, cycle_state, clustered):
    graph.start(Simulator)
    graph.start(Mesher, progress_period=0.05)
    feedback, topic = [], []
    # Deep enough to miss nothing, however slow this process is.
    tester.create_subscription(
        MeshProgress, "mesh/progress", topic.append, QoSProfile(depth=10_000)
    )
    wanted = settings(clustered=clustered)
    status, result = tester.grow(wanted, feedback.append)
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.success, result.message
    mesh = tester.mesh(result.mesh_id)
    here = grown_here(wanted, cycle_state)
    assert_same_mesh(mesh, here)
    assert result.states == len(mesh.states)
    assert result.generations == mesh.generation.max() + 1
    assert result.swings == len(mesh.states) - 1
    assert 0.0 < result.step_map_seconds < result.seconds
    assert tester.meshes[result.mesh_id].step_map == STEP_MAP

    def last_of(progress):
        # The result may come before the last of it.
        done = (result.swings, 0)
        wait_for(
            lambda: progress and (progress[-1].swings, progress[-1].chunks_in_flight) == done,
            "the last progress",
        )
        return progress[-1]

    for last in (last_of(feedback), last_of(topic)):
        assert (last.mesh_id, last.states) == (result.mesh_id, result.states)
        assert (last.swings, last.frontier, last.chunks_in_flight) == (result.swings, 0, 0)
        assert last.simulators == 1
    assert [message.sequence for message in topic] == list(range(len(topic)))


def changed(**changes):
    message = messages.settings_message(settings())
    for path, value in changes.items():
        *inside, last = path.split("__")
        at = message
        for name in inside:
            at = getattr(at, name)
        setattr(at, last, value)
    return message


@pytest.fixture(scope="class")
def mesher_alone():
    with ros_graph() as graph:
        tester = graph.start(Client)
        graph.start(Mesher, simulator_wait_seconds=0.3)
        yield tester


class TestBadGoals:
    @pytest.mark.parametrize(
        ("message", "names"),
        [
            (changed(threshold=0.0), ("settings.threshold", "0.0", "> 0")),
            (changed(threshold=math.nan), ("settings.threshold", "nan")),
            (changed(slopes=[0.1, 0.0]), ("settings.slopes[1]", "ascending")),
            (changed(slopes=[0.0, 2.0]), ("settings.slopes[1]", "45 degrees")),
            (
                changed(initial_state=[0.0] * 3),
                ("settings.initial_state", "length 3", "10 numbers"),
            ),
            (changed(initial_state=[math.nan] * 10), ("settings.initial_state", "nan", "finite")),
            (changed(initial_slope=0.5), ("settings.initial_slope", "one of slopes")),
            (changed(max_states=0), ("settings.max_states", "0", "2 to")),
            (changed(controller=ControllerMsg(name="?")), ("settings.controller.name", "smc/mfpt")),
            (changed(model__friction=-1.0), ("settings.model.friction", "-1.0", "> 0")),
            (changed(model__torque_limit=1e-3), ("no limit cycle", "hzd/base")),
        ],
    )
    def test_bad_goals_are_aborted_with_the_reason(self, mesher_alone, message, names):
        tester = mesher_alone
        before = len(tester.infos)
        status, result = tester.grow(message)
        assert status == GoalStatus.STATUS_ABORTED
        assert not result.success
        for name in names:
            assert name in result.message
        assert len(tester.infos) == before

    def test_mesh_without_simulator_aborts_with_the_reason(self, mesher_alone):
        tester = mesher_alone
        status, result = tester.grow(settings())
        assert status == GoalStatus.STATUS_ABORTED
        assert "no simulator answered for 0.3 s: there is none on the graph" in result.message
        wait_for(
            lambda: result.mesh_id in tester.meshes and tester.meshes[result.mesh_id].problem, ""
        )
        assert result.message in tester.meshes[result.mesh_id].problem


def test_mesh_over_its_limit_fails_with_the_reason(graph, tester):
    graph.start(Simulator)
    graph.start(Mesher)
    status, result = tester.grow(settings(max_states=20))
    assert status == GoalStatus.STATUS_ABORTED
    assert "max_states = 20" in result.message
    # It lives on.
    assert tester.grow(settings(threshold=3.0))[0] == GoalStatus.STATUS_SUCCEEDED


def refuse(request, response):
    response.message = "out of order"
    return response


def fake_simulator(answer):
    """Node that serves `SimulateSteps` in its own way."""

    def make():
        node = Node("fake")
        node.create_service(SimulateSteps, "~/simulate_steps", answer)
        return node

    return make


def garbage(request, response):
    response.success = True
    response.step_map = request.step_map
    response.outcomes = [0] * (len(request.previous_slopes) * len(request.slopes))
    response.next_states = [math.nan] * (10 * len(response.outcomes))
    return response


def other_step_map(request, response):
    response.step_map = "0.0.0+another"
    return response


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (garbage, "next_states: 'not finite'"),
        (other_step_map, "runs step map 0.0.0+another, not"),
        (refuse, "runs step map , not"),
    ],
)
def test_mesh_beside_a_bad_simulator(graph, tester, mesh_here, answer, said):
    graph.start(fake_simulator(answer))
    mesher = graph.start(Mesher, simulator_wait_seconds=PATIENCE)
    handle = tester.send_goal(settings())
    wait_for(lambda: mesher.simulators.dropped, "the mesher to drop the fake simulator")
    mesher.set_parameters([Parameter("simulator_wait_seconds", value=0.0)])
    status, result = tester.outcome(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert said in result.message
    mesher.set_parameters([Parameter("simulator_wait_seconds", value=PATIENCE)])
    graph.start(Simulator)
    wait_for(lambda: mesher.simulators.found(), "the mesher to find the good simulator")
    status, result = tester.grow(settings())
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert_same_mesh(tester.mesh(result.mesh_id), mesh_here)


def test_cancel_is_prompt_and_goals_wait_their_turn(graph, tester):
    mesher = graph.start(Mesher, simulator_wait_seconds=1e6, max_queued=2, meshes_at_once=1)
    first = tester.send_goal(settings())
    second = tester.send_goal(settings(threshold=3.0))
    third = tester.send_goal(settings())
    assert first.accepted
    assert second.accepted
    assert third.accepted
    assert not tester.send_goal(settings()).accepted
    for handle in (third, first):
        cancel(handle)
        status, result = tester.outcome(handle)
        assert status == GoalStatus.STATUS_CANCELED
        assert "cancelled" in result.message
    graph.start(Simulator)
    status, result = tester.outcome(second)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    wait_for(lambda: len(tester.infos) == 4, "all infos")
    assert [info.status for info in tester.infos] == [
        MeshInfo.GROWING, MeshInfo.CANCELLED, MeshInfo.GROWING, MeshInfo.COMPLETE
    ]  # fmt: skip
    assert [info.sequence for info in tester.infos] == [0, 1, 2, 3]
    assert mesher.get_parameter("max_queued").value == 2


def test_several_meshes_grow_at_once_and_each_is_the_one_grown_here(graph, tester, cycle_state):
    """Of several controllers; an endless one, a bad one and a cancelled one harm no other."""
    graph.start(Simulator)
    graph.start(Simulator)
    graph.start(Mesher, meshes_at_once=4, progress_period=0.05)
    other = controller("hzd/mfpt")
    wanted = [
        settings(),
        settings(controller=other, clustered=False),
        settings(threshold=0.1),
        settings(controller=other, threshold=1.0),
        settings(threshold=3.0, initial_state=cycle_state),
        settings(threshold=0.5, slopes=slope_set(1.0)),
    ]
    # No machine reaches that many states while the others, of a hundred, grow.
    long = tester.send_goal(settings(threshold=1e-6, max_states=10**8))
    bad = tester.send_goal(settings(max_states=20))
    handles = [tester.send_goal(one) for one in wanted]
    status, result = tester.outcome(bad)
    assert status == GoalStatus.STATUS_ABORTED
    assert "max_states = 20" in result.message
    for one, handle in zip(wanted, handles, strict=True):
        status, result = tester.outcome(handle)
        assert status == GoalStatus.STATUS_SUCCEEDED, result.message
        mesh = tester.mesh(result.mesh_id)
        assert_same_mesh(mesh, grown_here(one, find_limit_cycle(one.controller).state))
        assert result.swings == result.states - 1
    assert long.status in (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING)
    cancel(long)
    assert tester.outcome(long)[0] == GoalStatus.STATUS_CANCELED


def test_closing_a_mesher_that_grows_a_mesh(graph, tester):
    mesher = graph.start(Mesher, simulator_wait_seconds=PATIENCE)
    tester.send_goal(settings())
    wait_for(lambda: tester.infos, "the mesh to begin")
    start = time.monotonic()
    graph.stop(mesher)
    assert time.monotonic() - start < PATIENCE / 2.0


def test_mesh_ids_are_unique_and_plain():
    ids = {new_mesh_id("my/own controller\n") for _ in range(100)}
    assert len(ids) == 100
    assert all(name.replace("-", "").isalnum() for name in ids)
    assert new_mesh_id("?").startswith("mesh-")


# Analysis ----------------------------------------------------------------------------------------


def same_estimate(estimate, mesh, mu_s, sigma_s, correlation=0.0):
    here = metastability(mesh, mu_s, sigma_s, correlation)
    assert estimate.mfpt == here.mfpt
    assert estimate.lambda_2 == here.lambda_2
    assert estimate.failure_probability == here.failure_probability
    assert dict(zip(estimate.failure_codes, estimate.failure_shares, strict=True)) == (
        here.failure_shares
    )
    assert estimate.states == len(mesh.states)
    assert estimate.controller == "hzd/base"
    assert (estimate.mu_s, estimate.sigma_s) == (mu_s, sigma_s)
    assert estimate.correlation == correlation


def test_analysis_publishes_also_when_it_starts_late(graph, tester, mesh_here):
    graph.start(Simulator)
    graph.start(Mesher)
    early = graph.start(Analysis, sigma_s_deg=[1.0, 1.5])
    estimates = []
    subscribe = (MfptEstimate, "mfpt", estimates.append, RESULTS)
    tester.create_subscription(*subscribe)
    _, result = tester.grow(settings())
    wait_for(lambda: len(estimates) == 2, "estimates")
    graph.stop(early)
    late = graph.start(Analysis, mu_s_deg=-1.0, correlation=0.5)
    wait_for(lambda: len(estimates) == 4, "estimates of the late one")
    grounds = [(0.0, 1.0, 0.0), (0.0, 1.5, 0.0), (-1.0, 1.0, 0.5), (-1.0, 2.0, 0.5)]
    for estimate, (mu_deg, sigma_deg, rho) in zip(estimates, grounds, strict=True):
        assert estimate.mesh_id == result.mesh_id
        same_estimate(estimate, mesh_here, math.radians(mu_deg), math.radians(sigma_deg), rho)
    assert [estimate.sequence for estimate in estimates] == [0, 1, 0, 1]
    # Estimates are latched, too.
    again = []
    tester.create_subscription(MfptEstimate, "mfpt", again.append, RESULTS)
    wait_for(lambda: len(again) == 2, "latched estimates")
    assert late.get_parameter("mu_s_deg").value == -1.0


class Publisher(Node):
    """Publishes meshes as a mesher would, and leaves messages out."""

    def __init__(self):
        super().__init__("publisher")
        self._topics = [
            self.create_publisher(kind, f"mesh/{name}", RESULTS)
            for kind, name in (
                (MeshInfo, "info"),
                (MeshStates, "states"),
                (MeshTransitions, "transitions"),
            )
        ]

    def publish(self, mesh, mesh_id, lost=(), status=MeshInfo.COMPLETE, backwards=False):
        growing = MeshInfo(
            mesh_id=mesh_id, settings=messages.settings_message(settings()), states=1
        )
        closing = MeshInfo(
            mesh_id=mesh_id,
            status=status,
            settings=growing.settings,
            states=len(mesh.states),
            scales=packed(mesh.scales, "d"),
            message="" if status == MeshInfo.COMPLETE else "because",
        )
        states = messages.all_states_messages(mesh_id, mesh)
        rows = [*messages.transitions_messages(mesh_id, mesh.targets, mesh.outcomes)]
        for kind, topic in enumerate(([growing, closing], states, rows)):
            for sequence, message in enumerate(topic):
                message.sequence = sequence
            for message in topic[:: -1 if backwards else 1]:
                if (kind, message.sequence) not in lost:
                    self._topics[kind].publish(message)


def ask(mesh_id="", mu_s=0.0, sigma_s=(0.02,), correlation=0.0):
    return ComputeMfpt.Request(
        mesh_id=mesh_id,
        mu_s=mu_s,
        sigma_s=packed(np.array(sigma_s), "d"),
        correlation=correlation,
    )


def test_compute_mfpt(graph, tester, mesh_here):
    graph.start(Analysis, keep_meshes=2)
    publisher = graph.start(Publisher)
    compute = tester.service(ComputeMfpt, "compute_mfpt")
    early = compute(ask())
    assert not early.success
    assert "none is complete yet" in early.message
    for mesh_id in ("a", "b", "c"):
        publisher.publish(mesh_here, mesh_id)
    wait_for(lambda: compute(ask("c")).success, "the mesh")
    sigmas = (0.01, 0.02, 0.05)
    for mesh_id, rho in (("b", 0.0), ("c", -0.5), ("", 0.8)):
        response = compute(ask(mesh_id, 0.01, sigmas, rho))
        assert response.success, response.message
        for estimate, sigma_s in zip(response.estimates, sigmas, strict=True):
            assert estimate.mesh_id == (mesh_id or "c")
            same_estimate(estimate, mesh_here, 0.01, sigma_s, rho)
    forgotten = compute(ask("a"))
    assert not forgotten.success
    assert "only the last 2 meshes are kept" in forgotten.message


def test_meshes_are_kept_by_number_of_states_too(graph, tester, mesh_here):
    graph.start(Analysis, keep_states=2 * len(mesh_here.states))
    publisher = graph.start(Publisher)
    compute = tester.service(ComputeMfpt, "compute_mfpt")
    for mesh_id in ("a", "b", "c"):
        publisher.publish(mesh_here, mesh_id)
    wait_for(lambda: compute(ask("c")).success, "the mesh")
    assert compute(ask("b")).success
    assert f"of at most {2 * len(mesh_here.states)} states" in compute(ask("a")).message


def test_mesh_is_taken_in_whichever_order_its_messages_come(graph, tester, mesh_here):
    # A late subscriber may get new messages before those that were kept for it.
    graph.start(Analysis)
    graph.start(Publisher).publish(mesh_here, "backwards", backwards=True)
    compute = tester.service(ComputeMfpt, "compute_mfpt")
    wait_for(lambda: compute(ask("backwards")).success, "the mesh")
    (estimate,) = compute(ask("backwards")).estimates
    same_estimate(estimate, mesh_here, 0.0, 0.02)


@pytest.fixture(scope="class")
def compute(mesh_here):
    with ros_graph() as graph, pytest.MonkeyPatch.context() as patch:
        tester = graph.start(Client)
        graph.start(Analysis)
        publisher = graph.start(Publisher)
        publisher.publish(mesh_here, "good")
        compute = tester.service(ComputeMfpt, "compute_mfpt")
        wait_for(lambda: compute(ask("good")).success, "the mesh")
        jumps = []
        clock = SimpleNamespace(
            monotonic=lambda: time.monotonic() + sum(jumps), perf_counter=time.perf_counter
        )
        patch.setattr("biped_mfpt_ros.nodes.analysis.time", clock)
        patch.setattr("biped_mfpt_ros.nodes.analysis._PATIENCE", PATIENCE)
        publisher.publish(mesh_here, "gap", lost=[(1, 1)])
        publisher.publish(mesh_here, "failed", status=MeshInfo.FAILED)
        publisher.publish(mesh_here, "open", lost=[(0, 1)])
        publisher.publish(mesh_here, "unended", lost=[(2, 0)])
        # The topics arrive in any order; what has not come when all the rest has was lost.
        n = len(mesh_here.states)

        def wait_until_told(mesh_id, *said):
            wait_for(lambda: all(s in compute(ask(mesh_id)).message for s in said), mesh_id)

        wait_until_told("gap", f"the transitions of {n} ", "from index 2 to before ")
        wait_until_told("failed", "it failed")
        wait_until_told("open", f"it is not finished: {n} states")
        wait_until_told("unended", f"of {n} states {n} have come")
        jumps.append(2.0 * PATIENCE)
        wait_until_told("gap", "messages were lost")
        wait_until_told("unended", "messages were lost")
        yield compute


class TestBadQuestions:
    @pytest.mark.parametrize(
        ("bad", "names"),
        [
            (ask("none"), ("mesh_id", "'none'", "a complete mesh: good")),
            (
                ask("gap"),
                ("mesh_id", "'gap'", "mesh/states: from index 2 to before "),
            ),
            (ask("failed"), ("mesh_id", "'failed'", "it failed: because")),
            (ask("open"), ("mesh_id", "'open'", "it is not finished")),
            (ask("unended"), ("mesh_id", "the transitions of 1 (x_1 counted); messages were lost")),
            (ask(sigma_s=()), ("sigma_s", "0 numbers", "1 to")),
            (ask(sigma_s=(0.02, 0.0)), ("sigma_s[1]", "0.0", "above 0")),
            (ask(sigma_s=(-0.02,)), ("sigma_s[0]", "-0.02", "above 0")),
            (ask(sigma_s=(math.nan,)), ("sigma_s[0]", "nan", "finite")),
            (ask(mu_s=1.0), ("mu_s", "1.0", "slope set")),
            (ask(mu_s=math.nan), ("mu_s", "nan", "slope set")),
            (ask(correlation=1.0), ("correlation", "1.0", "above -1 and below 1")),
            (ask(correlation=math.nan), ("correlation", "nan", "above -1 and below 1")),
        ],
    )
    def test_compute_mfpt_refuses_bad_requests_and_lives_on(self, compute, bad, names):
        response = compute(bad)
        assert not response.success
        for name in names:
            assert name in response.message
        assert len(response.estimates) == 0
        assert compute(ask("good")).success
