"""Goals and questions whose answers get lost: they are asked again, and nobody waits for ever."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from biped_mfpt_msgs.action import GrowMesh, Optimise
from biped_mfpt_msgs.msg import MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt
from rclpy.action import ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from ros_graph import DOMAIN, PATIENCE, result_of, ros_graph, wait_for

from biped_mfpt_ros.cli.optimise_pipeline import StudyClient
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.nodes import answers
from biped_mfpt_ros.nodes.answers import ActionClient, Answer, accepted
from biped_mfpt_ros.nodes.messages import MeshSettings
from biped_mfpt_ros.nodes.optimiser import goal_message
from biped_mfpt_ros.nodes.pipeline_backend import PipelineBackend
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

BASE = controller("hzd/base")


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


@pytest.fixture
def later(monkeypatch):
    """Call it to have whoever waits for an answer ask again, whatever time has passed."""
    jumps = []
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + sum(jumps))
    monkeypatch.setattr(answers, "time", clock)
    monkeypatch.setattr(answers, "AGAIN", PATIENCE)
    return lambda: jumps.append(1e3 * PATIENCE)


class Forgetful(Node):
    """Loses some of what it is asked first: goals, requests for results, and questions.

    Calls ``on_loss`` whenever it has.
    """

    def __init__(self, kind, name, result, lost, on_loss=lambda: None):
        super().__init__("forgetful")
        self._on_loss = on_loss
        self.executed = 0
        self.questions = []
        self.early = 0
        """Questions that come before the last message of their mesh."""

        def execute(goal):
            self.executed += 1
            goal.succeed()
            return result

        self._action = ActionServer(self, kind, name, execute)
        for what in ("_goal_request", "_get_result_request", "_cancel_request"):
            self._lose_first(f"_execute{what}", lost)
        self._lost_questions = lost
        # What the analysis is known by.
        self.create_publisher(MfptEstimate, "mfpt", RESULTS)
        self.create_service(
            ComputeMfpt, "compute_mfpt", self._compute, qos_profile=REQUESTS,
            callback_group=ReentrantCallbackGroup(),
        )  # fmt: skip

    def _lose_first(self, what, number):
        serve, left = getattr(self._action, what), [number]

        async def forget(request):
            if left[0]:
                left[0] -= 1
                self._on_loss()
            else:
                await serve(request)

        setattr(self._action, what, forget)

    async def _compute(self, request, response):
        self.questions.append(len(request.sigma_s))
        if self._lost_questions:
            self._lost_questions -= 1
            self._on_loss()
            await Future()
        if request.sigma_s and self.early:
            self.early -= 1
            response.message = "mesh_id: 'm' is not allowed; allowed: a complete mesh"
        elif request.sigma_s:
            response.success = True
            response.estimates = [MfptEstimate(mfpt=7.0)]
        return response

    def close(self):
        self._action.destroy()


def test_a_goal_that_is_answered_at_once_is_answered_in_any_thread(graph):
    """Between sending a goal and having its future."""
    node = graph.start(lambda: Forgetful(GrowMesh, "grow_mesh", GrowMesh.Result(), 0))
    client = ActionClient(node, GrowMesh, "grow_mesh")
    wait_for(client.server_is_ready, "the server")

    class Slow(dict):
        def __setitem__(self, key, value):
            taken.wait(0.5)  # ample for the answer, if that can be taken
            super().__setitem__(key, value)

    taken = threading.Event()
    client._feedback_callbacks = Slow()
    take = client.take_data

    def take_data():
        data = take()
        if "goal" in data:
            taken.set()
        return data

    client.take_data = take_data
    handle = result_of(client.send_goal_async(GrowMesh.Goal(), lambda feedback: None))
    assert handle.accepted
    client.destroy()


def test_an_answer_is_asked_for_again_and_the_first_one_counts(later):
    futures = []
    left = []

    def ask():
        futures.append(Future())
        return futures[-1]

    answer = Answer(ask, left.append)
    for asked in (1, 2, 3):
        assert not answer.done()
        assert len(futures) == asked
        later()
    futures[1].set_result("second")
    assert answer.come.is_set()
    assert answer.done()
    assert answer.result() == "second"
    futures[0].set_result("first")
    assert left == ["first"]
    assert len(futures) == 3


def test_a_goal_that_was_accepted_twice_is_cancelled_once(later):
    class Handle:
        accepted = True
        cancelled = False

        def cancel_goal_async(self):
            self.cancelled = True

    handles, futures = [Handle(), Handle()], [Future(), Future()]
    sent = []

    def send():
        sent.append(futures[len(sent)])
        return sent[-1]

    answer = accepted(send)
    later()
    assert not answer.done()
    assert len(sent) == 2
    for future, handle in zip(futures, handles, strict=True):
        future.set_result(handle)
    assert answer.result() is handles[0]
    assert [handle.cancelled for handle in handles] == [False, True]


class Deadline:
    """Ends a wait that would never end."""

    def __init__(self):
        self._over = time.monotonic() + PATIENCE

    def __call__(self):
        assert time.monotonic() < self._over


@pytest.fixture
def run_client():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
        client = StudyClient("/", Deadline())
    yield client
    client.leave()


def test_a_run_survives_lost_answers(graph, run_client, later):
    result = GrowMesh.Result(success=True, mesh_id="grown")
    node = graph.start(lambda: Forgetful(GrowMesh, "grow_mesh", result, 2, later))
    wait_for(run_client._grow.server_is_ready, "the mesher")
    settings = MeshSettings(BASE, WalkerModel(), slope_set(1.0), 1.0)
    assert run_client.grow_mesh(settings, lambda progress: None).mesh_id == "grown"
    assert node.executed == 1


def test_a_client_is_not_found_before_it_is_answered(graph, run_client, later):
    node = graph.start(lambda: Forgetful(GrowMesh, "grow_mesh", GrowMesh.Result(), 2, later))
    lost = []
    node._on_loss = lambda: (lost.append(None), later())
    run_client.wait_until_found()
    assert len(node.questions) >= 3
    assert set(node.questions) == {0}
    assert len(lost) == 4


def test_a_run_asks_for_an_mfpt_that_is_not_published(graph, run_client, later, monkeypatch):
    """As where the chain takes long; the last of the mesh, or the answer, may come late, too."""
    monkeypatch.setattr("biped_mfpt_ros.cli.client._PUBLISHED", 0.1)
    node = graph.start(lambda: Forgetful(GrowMesh, "grow_mesh", GrowMesh.Result(), 2, later))
    node.early = 1
    wait_for(run_client._compute.service_is_ready, "the analysis")
    (estimate,) = run_client.mfpt("m", 0.0, [0.02])
    assert estimate.mfpt == 7.0
    assert node.questions.count(1) == 2


def test_a_study_survives_lost_answers(graph, run_client, later):
    result = Optimise.Result(success=True, message="trials")
    node = graph.start(lambda: Forgetful(Optimise, "optimise", result, 2, later))
    wait_for(run_client.optimiser_is_there, "the optimiser")
    goal = goal_message("study", StudySettings(BASE))
    assert run_client.optimise(goal, lambda trial: None) == "trials"
    assert node.executed == 1


def test_the_optimiser_survives_lost_answers(graph, later):
    result = GrowMesh.Result(success=True, mesh_id="grown")
    node = graph.start(lambda: Forgetful(GrowMesh, "grow_mesh", result, 2, later))
    asking = graph.start(lambda: Node("asking"))
    backend = PipelineBackend(asking, lambda: PATIENCE)
    settings = StudySettings(BASE)
    cycle = find_limit_cycle(BASE)
    stage = Stage(1.0, 1.0)
    mesh = backend.grow(cycle, settings, stage, np.array([0.0]), Deadline())
    assert mesh.mesh_id == "grown"
    assert node.executed == 1
    assert mesh.mfpt(0.0, 0.02, 0.0) == 7.0
    # What may cost much is asked once.
    assert node.questions.count(1) == 1
    assert node.questions.count(0) >= 3
    backend.close()
