"""A flood of requests from one sender slows that sender, and what it may ask for is bounded."""

from __future__ import annotations

import time

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.msg import Controller as ControllerMsg
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.node import Node
from ros_graph import Client, result_of, ros_graph, wait_for
from test_nodes import request, settings

from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.messages import unpacked
from biped_mfpt_ros.nodes.qos import REQUESTS
from biped_mfpt_ros.nodes.simulator import Simulator


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


class Flooder(Node):
    """Sends without waiting for answers."""

    def __init__(self):
        super().__init__("flooder")

    def flood(self, name, asked, count):
        client = self.create_client(SimulateSteps, name, qos_profile=REQUESTS)
        wait_for(client.service_is_ready, name)
        return [client.call_async(asked) for _ in range(count)]


def crawling(states):
    """Requests of the dearest kind: swings that the integrator takes in tiny steps."""
    parameters = controller("hzd/base").parameters.copy()
    parameters[1] = 1e5
    controller_message = ControllerMsg(scheme="hzd", parameters=parameters.tolist())
    return request(states, controller=controller_message)


def test_a_flooded_simulator_answers_others_within_its_bound(graph):
    # All services of a node share one queue, which keeps 256 requests: what a request may cost
    # bounds how long others wait.
    most = 20_000  # evaluations, some 10 ms
    graph.start(Simulator, max_evaluations=most)
    flooder, tester = graph.start(Flooder), graph.start(Client)
    simulate = tester.simulator()
    (name,) = tester.simulators()
    states = np.tile(0.1, (500, 10))
    start = time.monotonic()
    assert simulate(crawling(states)).success
    alone = time.monotonic() - start
    sent = flooder.flood(name, crawling(states), 200)
    start = time.monotonic()
    mine = simulate(request(np.zeros((1, 10))))
    waited = time.monotonic() - start
    assert mine.success
    assert waited < 200 * max(alone, 0.1)
    for future in sent:
        response = result_of(future)
        assert response.success
        assert response.evaluations <= most + 500_000
        assert len(unpacked(response.outcomes, "B"))


def test_a_mesh_goes_on_beside_a_flooded_simulator(graph):
    # The mesher hands the work of a simulator that others keep busy on to those that answer.
    flooded = graph.start(lambda: Simulator("simulator_flooded"))
    graph.start(lambda: Simulator("simulator_free"))
    mesher = graph.start(Mesher, simulator_timeout=0.1, chunk_seconds=0.001)
    flooder, tester = graph.start(Flooder), graph.start(Client)
    wait_for(lambda: len(mesher.simulators.found()) == 2, "both simulators")
    name = f"/{flooded.get_name()}/simulate_steps"
    sent = flooder.flood(name, crawling(np.tile(0.1, (20, 10))), 100)
    status, result = tester.grow(settings(threshold=1.0))
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    for future in sent:
        future.cancel()


def test_goals_beyond_a_bound_are_rejected_at_once(graph):
    graph.start(Mesher, simulator_wait_seconds=30.0, meshes_at_once=1, max_queued=3)
    tester = graph.start(Client)
    handles = [tester.send_goal(settings()) for _ in range(10)]
    assert [handle.accepted for handle in handles] == [True] * 4 + [False] * 6
    start = time.monotonic()
    for handle in handles[:4]:
        result_of(handle.cancel_goal_async())
    statuses = [tester.outcome(handle)[0] for handle in handles[:4]]
    assert statuses == [GoalStatus.STATUS_CANCELED] * 4
    assert time.monotonic() - start < 20.0
