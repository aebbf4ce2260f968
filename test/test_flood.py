"""A flood of requests from one sender slows that sender, and what it may ask for is bounded."""

from __future__ import annotations

import threading
from contextlib import suppress

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.msg import Controller as ControllerMsg
from biped_mfpt_msgs.msg import MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt, SimulateSteps
from rclpy.node import Node
from ros_graph import PATIENCE, Client, cancel, result_of, ros_graph, wait_for
from test_nodes import BASE, Publisher, ask, assert_same_mesh, grown_here, request, settings

from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.nodes.analysis import Analysis
from biped_mfpt_ros.nodes.fair_service import Waiting
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.messages import unpacked
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS
from biped_mfpt_ros.nodes.simulator import MOST_WAITING, Simulator


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


class HeldSimulator(Simulator):
    """Answers nothing while its gate is closed, and remembers in which order it served clients."""

    def __init__(self):
        self.gate, self.held, self.order = threading.Event(), threading.Event(), []
        self.gate.set()
        super().__init__()

    def _simulate(self, request, response):
        self.held.set()
        self.gate.wait(PATIENCE)
        self.order.append(request.client)
        return super()._simulate(request, response)


class HeldAnalysis(Analysis):
    """The same of an analysis; with the meshes of which it published an estimate."""

    def __init__(self):
        self.gate, self.held, self.order = threading.Event(), threading.Event(), []
        self.gate.set()
        super().__init__()
        publish = self._estimates.publish

        def publish_in_order(estimate):
            self.order.append(estimate.mesh_id)
            publish(estimate)

        self._estimates.publish = publish_in_order

    def _compute(self, request, response):
        self.held.set()
        self.gate.wait(PATIENCE)
        self.order.append(request.client)
        return super()._compute(request, response)


def wait_for_refusals(sent, number):
    """Wait until so many have been answered, by one that is held: all else waits there."""
    wait_for(lambda: sum(future.done() for future in sent) == number, f"{number} refusals")


def client_of(node, name, kind, asked):
    """A client that the service knows where to answer: before, answers are lost."""
    client = node.create_client(kind, name, qos_profile=REQUESTS)
    wait_for(client.service_is_ready, name)
    answered = False
    while not answered:
        future = client.call_async(asked)
        with suppress(AssertionError):
            answered = wait_for(future.done, f"an answer of {name}", timeout=2.0)
    return client


class Flooder(Node):
    """Sends without waiting for answers, as soon as the service is held."""

    def __init__(self):
        super().__init__("flooder")

    def flood(self, held, name, asked, count, kind=SimulateSteps):
        client = client_of(self, name, kind, asked)
        held.gate.clear()
        held.held.clear()
        held.order.clear()
        first = client.call_async(asked)
        # It is served alone; the others wait, or are refused.
        wait_for(held.held.is_set, "the first request to be held")
        return [first, *(client.call_async(asked) for _ in range(count - 1))]


def mesh_of(threshold):
    return grown_here(settings(threshold=threshold), find_limit_cycle(BASE).state)


def dear():
    """A request of some 30 ms: swings that the integrator takes in small steps."""
    parameters = BASE.parameters.copy()
    parameters[1] = 1e4
    controller_message = ControllerMsg(scheme="hzd", parameters=parameters.tolist())
    states = np.tile(find_limit_cycle(BASE).state, (8, 1))
    return request(states, controller=controller_message)


def taken(waiting, seconds=0.05):
    """All that waits, in the order in which it is served, each taking so long (s)."""
    order = []
    while len(waiting):
        client, item = waiting.get()
        waiting.charge(client, seconds)
        order.append(item)
    return order


def test_clients_take_turns_and_the_greediest_is_refused():
    waiting = Waiting(6)
    assert [waiting.put("a", i) for i in range(4)] == [None] * 4
    assert [waiting.put("b", 10), waiting.put("c", 20)] == [None, None]
    assert waiting.put("a", 4) == 4  # the client with the most loses its newest
    assert waiting.put("b", 11) == 3  # whoever asks
    assert len(waiting) == 6
    assert taken(waiting) == [0, 10, 20, 1, 11, 2]
    for i in range(6):
        assert waiting.put(f"client {i}", i) is None
    assert waiting.put("one more", 6) == 6
    assert taken(waiting) == [*range(6)]


def test_clients_get_the_same_time_whatever_their_requests_cost():
    waiting = Waiting(64)
    costs = {"usual": 0.05, "dear": 2.0}
    got = dict.fromkeys(costs, 0.0)
    for client in costs:
        waiting.put(client, None)
    while sum(got.values()) < 100.0:
        client, _ = waiting.get()
        got[client] += costs[client]
        waiting.charge(client, costs[client])
        waiting.put(client, None)
    assert got["usual"] == pytest.approx(got["dear"], abs=2.0)  # one dear request


def test_a_client_pays_also_for_what_it_had_before_it_asks_again():
    def ask_dearly():
        waiting = Waiting(64)
        waiting.put("dear", 0)
        waiting.get()
        waiting.charge("dear", 0.2)  # its turn and three more
        return waiting

    waiting = ask_dearly()
    for i in range(4):
        waiting.put("usual", i)
    waiting.put("dear", 4)
    assert taken(waiting) == [0, 1, 2, 3, 4]
    # Time that others had meanwhile counts.
    waiting = ask_dearly()
    for i in range(4):
        waiting.put("usual", i)
    assert taken(waiting) == [0, 1, 2, 3]
    waiting.put("usual", 5)
    waiting.put("dear", 6)
    waiting.put("usual", 7)
    assert taken(waiting) == [5, 6, 7]


def test_invented_names_keep_nobody_from_its_turn():
    waiting = Waiting(64)
    waiting.put("honest", 0)
    waiting.get()
    waiting.charge("honest", 0.2)
    for i in range(50):
        waiting.put(f"name {i}", 0)
    waiting.put("honest", 1)
    turns = 0
    while (got := waiting.get()) != ("honest", 1):
        waiting.charge(got[0], 0.05)
        turns += 1
        waiting.put(f"another name {turns}", 0)
    assert turns <= 4 * 51


def test_a_flood_to_a_simulator_delays_nobody_else(graph):
    # In the order of arrival mine would wait for 65.
    simulator = graph.start(HeldSimulator)
    flooder, tester = graph.start(Flooder), graph.start(Client)
    (name,) = wait_for(tester.simulators, "the simulator")
    mine = request(np.zeros((1, 10)), client="tester")
    client = client_of(tester, name, SimulateSteps, mine)
    sent = flooder.flood(simulator, name, dear(), 200)
    wait_for_refusals(sent, 199 - MOST_WAITING)
    mine = client.call_async(mine)
    wait_for_refusals(sent, 200 - MOST_WAITING)  # for which there is no room beside mine
    simulator.gate.set()
    assert result_of(mine).success
    responses = [result_of(future) for future in sent]
    assert simulator.order.index("tester") <= 2
    taken = [response for response in responses if response.success]
    assert len(taken) == MOST_WAITING
    for response in taken:
        assert len(unpacked(response.outcomes, "B"))
    for response in responses:
        assert response.success != response.busy
        assert response.success or f"at most {MOST_WAITING} requests wait" in response.message


def test_an_answer_that_cannot_be_sent_keeps_no_other_back(graph):
    class Odd(Simulator):
        def _simulate(self, request, response):
            return None if request.client == "odd" else super()._simulate(request, response)

    graph.start(Odd)
    tester = graph.start(Client)
    (name,) = wait_for(tester.simulators, "the simulator")
    client = client_of(tester, name, SimulateSteps, request(np.zeros((1, 10)), client="tester"))
    odd = client.call_async(request(np.zeros((1, 10)), client="odd"))
    assert result_of(client.call_async(request(np.zeros((1, 10)), client="tester"))).success
    assert not odd.done()


def test_a_mesh_goes_on_at_a_flooded_simulator(graph):
    # There is no other one.
    flooded = graph.start(HeldSimulator)
    graph.start(Mesher, simulator_wait_seconds=PATIENCE)
    flooder, tester = graph.start(Flooder), graph.start(Client)
    name = f"/{flooded.get_name()}/simulate_steps"
    tester.wait_for_mesher()
    sent = flooder.flood(flooded, name, dear(), 200)
    wait_for_refusals(sent, 199 - MOST_WAITING)
    handle = tester.send_goal(settings(threshold=1.0))
    wait_for(
        lambda: sum(future.done() for future in sent) > 199 - MOST_WAITING, "the mesher to ask"
    )
    flooded.gate.set()
    status, result = tester.outcome(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert_same_mesh(tester.mesh(result.mesh_id), mesh_of(1.0))
    for future in sent:
        result_of(future)
    # The flood went on after the last request of the mesh.
    assert flooded.order[-1] == ""
    assert any(client.startswith("/mesher") for client in flooded.order)


def test_a_flood_of_questions_to_the_analysis_delays_neither_meshes_nor_others(graph):
    mesh = mesh_of(0.3)
    analysis = graph.start(HeldAnalysis)
    publisher = graph.start(Publisher)
    flooder, tester = graph.start(Flooder), graph.start(Client)
    compute = tester.service(ComputeMfpt, "compute_mfpt")
    client = client_of(tester, "compute_mfpt", ComputeMfpt, ask("a"))
    publisher.publish(mesh, "a")
    wait_for(lambda: compute(ask("a")).success, "the mesh")
    sigmas = np.linspace(0.02, 0.1, 500)
    sent = flooder.flood(analysis, "compute_mfpt", ask("a", 0.0, sigmas), 200, ComputeMfpt)
    wait_for_refusals(sent, 200 - 64 - 1)
    estimates = []
    tester.create_subscription(MfptEstimate, "mfpt", estimates.append, RESULTS)
    publisher.publish(mesh, "b")
    wait_for(lambda: "b" in analysis._finishing, "the second mesh")
    asked = ask("a")
    asked.client = "tester"
    mine = client.call_async(asked)
    wait_for_refusals(sent, 200 - 64)
    analysis.gate.set()
    assert result_of(mine).success
    wait_for(lambda: any(estimate.mesh_id == "b" for estimate in estimates), "the MFPT")
    responses = [result_of(future) for future in sent]
    assert analysis.order.index("tester") <= 3
    assert analysis.order.index("b") <= 3
    assert sum(response.success for response in responses) == 64
    for response in responses:
        assert response.success or response.message.startswith("busy: at most 64 requests wait")


def test_a_mesh_goes_on_beside_a_flooded_simulator(graph):
    # The mesher hands the work of a simulator that others keep busy on to those that answer.
    flooded = graph.start(lambda: Simulator("simulator_flooded"))
    graph.start(lambda: Simulator("simulator_free"))
    mesher = graph.start(
        Mesher, simulator_timeout=0.1, chunk_seconds=0.001, simulator_wait_seconds=PATIENCE
    )
    flooder, tester = graph.start(Flooder), graph.start(Client)
    wait_for(lambda: len(mesher.simulators.found()) == 2, "both simulators")
    name = f"/{flooded.get_name()}/simulate_steps"
    client = client_of(flooder, name, SimulateSteps, dear())
    sent = [client.call_async(dear()) for _ in range(100)]
    status, result = tester.grow(settings(threshold=1.0))
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    for future in sent:
        future.cancel()


def test_goals_beyond_a_bound_are_rejected_at_once(graph):
    graph.start(Mesher, simulator_wait_seconds=1e6, meshes_at_once=1, max_queued=3)
    tester = graph.start(Client)
    handles = [tester.send_goal(settings()) for _ in range(10)]
    assert [handle.accepted for handle in handles] == [True] * 4 + [False] * 6
    for handle in handles[:4]:
        cancel(handle)
    statuses = [tester.outcome(handle)[0] for handle in handles[:4]]
    assert statuses == [GoalStatus.STATUS_CANCELED] * 4
