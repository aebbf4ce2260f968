"""A mesher that is killed: the next one goes on where it was, and ends with the same mesh."""

import math
import signal
import threading
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshInfo
from rclpy.action import ActionServer
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_graph import DOMAIN, PATIENCE, Client, cancel, ros_graph, wait_for
from test_nodes import assert_same_mesh, grown_here, settings

from biped_mfpt_ros.cli import client as cli
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.messages import unpacked
from biped_mfpt_ros.nodes.simulator import Simulator

MFPT = controller("hzd/mfpt")
IN_FLIGHT = 2


class Gate:
    """Knows who asked for which states, and holds all simulators after so many of them."""

    def __init__(self):
        self.asked = defaultdict(set)
        self.largest = 0
        self._hold_above = math.inf
        self._go_on = threading.Event()
        self._lock = threading.Lock()

    @property
    def count(self):
        """States simulated; those that one client asked for again count once."""
        return sum(map(len, list(self.asked.values())))

    def hold_after(self, more):
        """Let that many more states be simulated, and no further request until released."""
        self._go_on.clear()
        self._hold_above = self.count + more

    def release(self):
        """Go on with what was held."""
        self._hold_above = math.inf
        self._go_on.set()

    def enter(self, request):
        """Wait if it is held."""
        with self._lock:
            held = self.count > self._hold_above
        if held:
            self._go_on.wait(PATIENCE)
        states = np.column_stack(
            [unpacked(request.states, "d").reshape(-1, 10), unpacked(request.previous_slopes, "d")]
        )
        with self._lock:
            self.asked[request.client].update(row.tobytes() for row in states)
            self.largest = max(self.largest, len(states))


class Gated(Simulator):
    """Simulates what a gate lets through."""

    def __init__(self, gate, name=None, **options):
        self._gate = gate
        super().__init__(name, **options)

    def _simulate(self, request, response):
        self._gate.enter(request)
        return super()._simulate(request, response)


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


@pytest.fixture
def tester(graph):
    return graph.start(Client)


@pytest.fixture(scope="module")
def goal():
    state = find_limit_cycle(MFPT).state
    return settings(controller=MFPT, threshold=0.02, initial_state=state)


@pytest.fixture(scope="module")
def mesh_here(goal):
    return grown_here(goal, goal.initial_state)


def launch(graph, name, directory):
    return graph.launch(
        "mesher", "--ros-args", "-r", f"__node:={name}", "-p", f"checkpoint_directory:={directory}",
        "-p", "chunk_seconds:=0.001", "-p", f"simulator_wait_seconds:={PATIENCE}",
        # None is late, not even one that is held: what it has is not handed on.
        "-p", "simulator_timeout:=60.0",
    )  # fmt: skip


def test_a_mesher_is_reached_when_all_of_its_action_is_there(graph):
    """Not when its node is, which has to compile before it takes goals."""

    class Other(Node):
        action = None

        def close(self):
            self.action.destroy()

    graph.start(Mesher)
    other = graph.start(lambda: Other("mesher_2"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
        client = cli.Client("/", lambda: None)
    try:
        wait_for(lambda: client.reaches("mesher"), "the mesher")
        wait_for(lambda: "mesher_2" in client._node.get_node_names(), "the other node")
        assert not client.reaches("mesher_2")
        other.action = ActionServer(other, GrowMesh, "grow_mesh", lambda goal: None)
        wait_for(lambda: client.reaches("mesher_2"), "the other mesher")
    finally:
        client.leave()


def journals(directory):
    return sorted(path.name for path in directory.glob("*"))


@pytest.mark.parametrize(("sent", "kills"), [(signal.SIGKILL, 3), (signal.SIGTERM, 1)])
def test_mesher_killed_again_and_again_ends_with_the_same_mesh(
    graph, tester, goal, mesh_here, tmp_path, sent, kills
):
    gate = Gate()
    simulators = [graph.start(lambda name=name: Gated(gate, name)) for name in ("one", "two")]
    n = len(mesh_here.states) - 1
    rng = np.random.default_rng(1)
    for kill in range(kills):
        mesher = launch(graph, f"mesher_{kill}", tmp_path)
        more = int(rng.integers(n // 8, n // 6))
        enough = gate.count + more
        # However slow the mesher is to die, its mesh is not complete by then.
        gate.hold_after(more)
        assert tester.send_goal_to(f"mesher_{kill}", goal).accepted
        wait_for(lambda enough=enough: gate.count > enough, "work")
        mesher.send_signal(sent)
        mesher.wait(PATIENCE)
        gate.release()
        assert len(journals(tmp_path)) == 1, kill
    launch(graph, "mesher", tmp_path)
    handle = tester.send_goal_to("mesher", goal)
    status, result = tester.outcome(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert_same_mesh(tester.mesh(result.mesh_id), mesh_here)
    assert result.swings + result.swings_resumed == n
    # At most the chunks in flight were simulated again, for each kill: all else was resumed.
    in_flight = kills * IN_FLIGHT * len(simulators) * gate.largest
    assert n <= gate.count <= n + in_flight
    assert result.swings_resumed > max(0, kills * (n // 8) - in_flight)
    assert journals(tmp_path) == []


def test_journal_is_kept_for_a_mesh_that_lost_its_simulators_and_removed_with_a_cancelled_one(
    graph, tester, goal, mesh_here, tmp_path
):
    # Nobody completes it before it is told to end.
    endless = replace(goal, threshold=1e-6, max_states=10**8)
    gate, again = Gate(), Gate()
    simulator = graph.start(lambda: Gated(gate))
    mesher = graph.start(
        Mesher, checkpoint_directory=str(tmp_path), simulator_wait_seconds=1e6,
        simulator_timeout=0.1, chunk_seconds=0.001,
    )  # fmt: skip

    def wait_seconds(value):
        (result,) = mesher.set_parameters([Parameter("simulator_wait_seconds", value=value)])
        assert result.successful

    handle = tester.send_goal(endless)
    wait_for(lambda: gate.count > 100, "work")
    graph.stop(simulator)
    wait_seconds(0.3)
    status, result = tester.outcome(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert "no simulator answered" in result.message
    assert len(journals(tmp_path)) == 1
    wait_seconds(1e6)
    graph.start(lambda: Gated(again, "again"))
    handle = tester.send_goal(endless)
    wait_for(lambda: again.count > 20, "work")
    assert len(journals(tmp_path)) == 1
    cancel(handle)
    assert tester.outcome(handle)[0] == GoalStatus.STATUS_CANCELED
    assert journals(tmp_path) == []
    # Equal goals side by side do not share a journal, and a directory that cannot be is said.
    one, two = tester.send_goal(goal), tester.send_goal(goal)
    for handle in (one, two):
        status, result = tester.outcome(handle)
        assert status == GoalStatus.STATUS_SUCCEEDED, result.message
        assert result.swings_resumed == 0
        assert_same_mesh(tester.mesh(result.mesh_id), mesh_here)
    assert journals(tmp_path) == []


@pytest.mark.parametrize("topic", ["states", "transitions", "info", "info of its end"])
def test_a_mesh_that_cannot_be_published_is_kept(graph, tester, goal, mesh_here, tmp_path, topic):
    """As when the node is told to stop between two messages."""
    graph.start(Simulator)
    mesher = graph.start(Mesher, checkpoint_directory=str(tmp_path))
    publisher = getattr(mesher._meshes, topic.split()[0])
    publish = publisher.publish

    def fail_later(message):
        early = {
            "states": lambda: message.generation < 2,
            "transitions": lambda: False,
            "info": lambda: message.status != MeshInfo.COMPLETE,
            "info of its end": lambda: message.status == MeshInfo.GROWING,
        }
        if not early[topic]():
            raise RuntimeError("the publisher is invalid")
        publish(message)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publisher, "publish", fail_later)
        status, result = tester.grow(goal)
    assert status == GoalStatus.STATUS_ABORTED
    assert "the publisher is invalid" in result.message
    assert len(journals(tmp_path)) == 1
    status, result = tester.grow(goal)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.swings_resumed > 0
    assert_same_mesh(tester.mesh(result.mesh_id), mesh_here)
    assert journals(tmp_path) == []


def test_a_directory_that_cannot_be_written_is_an_error_that_says_so(graph, tester, goal, tmp_path):
    (tmp_path / "file").touch()
    graph.start(Simulator)
    graph.start(Mesher, checkpoint_directory=str(tmp_path / "file"))
    status, result = tester.grow(goal)
    assert status == GoalStatus.STATUS_ABORTED
    assert "could not be kept" in result.message
    assert str(tmp_path / "file") in result.message
    assert [info.status for info in tester.infos] in ([], [MeshInfo.FAILED])
