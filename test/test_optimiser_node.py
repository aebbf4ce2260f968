"""The optimiser node: studies scored by the pipeline, as in this process, whoever dies."""

import math
import signal
from dataclasses import replace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from biped_mfpt_msgs.action import Optimise
from biped_mfpt_msgs.msg import OptimisationTrial
from rclpy.node import Node
from ros_graph import PATIENCE, cancel, goal_handle, result_of, ros_graph, wait_for

from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.nodes.analysis import Analysis
from biped_mfpt_ros.nodes.answers import ActionClient
from biped_mfpt_ros.nodes.mesher import Mesher
from biped_mfpt_ros.nodes.messages import controller_message
from biped_mfpt_ros.nodes.optimiser import (
    MOST_REFUSED,
    Optimiser,
    goal_message,
    settings_from,
)
from biped_mfpt_ros.nodes.qos import LATEST, RESULTS
from biped_mfpt_ros.nodes.simulator import Simulator
from biped_mfpt_ros.optimise.local import LocalBackend
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.optimise.store import Store
from biped_mfpt_ros.optimise.study import Study
from biped_mfpt_ros.walker.robot import WalkerModel

# Few slopes and a coarse mesh: some milliseconds for a trial. The second mesh and the check are
# there so that they are gone through.
SETTINGS = StudySettings(
    controller("hzd/mfpt"), seed=2, step=0.5,
    stages=(Stage(1.0, 1.0), Stage(1.0, 0.3, -0.01, 2000)), check_steps=20.0, check_walks=20,
)  # fmt: skip


@pytest.fixture(scope="module")
def graph():
    with ros_graph() as graph:
        yield graph


class Client(Node):
    def __init__(self, namespace=""):
        super().__init__("client", namespace=namespace)
        self.trials, self.best, self.feedback = [], [], []
        self.action = ActionClient(self, Optimise, "optimise")
        self.create_subscription(
            OptimisationTrial, "optimisation/trials", self.trials.append, RESULTS
        )
        self.create_subscription(OptimisationTrial, "optimisation/best", self.best.append, LATEST)

    def close(self):
        self.action.destroy()

    def send(self, goal):
        wait_for(self.action.server_is_ready, "the optimiser")
        handle = goal_handle(
            lambda: self.action.send_goal_async(
                goal, feedback_callback=lambda m: self.feedback.append(m.feedback)
            )
        )
        assert handle.accepted
        return handle

    def run(self, goal):
        return result_of(self.send(goal).ended)


@pytest.fixture(scope="module")
def store_path(tmp_path_factory):
    return tmp_path_factory.mktemp("store") / "studies.sqlite"


@pytest.fixture(scope="module")
def client(graph, store_path):
    graph.start(Simulator)
    graph.start(Mesher)
    graph.start(Analysis)
    graph.start(Optimiser, store=str(store_path), trials_at_once=3, patience=60.0)
    return graph.start(Client)


def outline(trials):
    return [
        (t.number, t.vector.tobytes(), t.found.stage, t.found.score, t.found.values, t.found.states)
        for t in trials
        if t.found is not None
    ]


def locally(path, trials, settings=SETTINGS):
    store = Store(path)
    study = Study(store, "local", settings)
    study.run(LocalBackend(), 2, trials)
    found = outline(study.trials())
    study.close()
    store.close()
    return found


def kept(path, name):
    store = Store(path)
    found = Study(store, name).trials()
    store.close()
    return found


def test_a_study_over_ros_is_that_of_this_process(client, store_path, tmp_path):
    goal = goal_message("one", SETTINGS)
    goal.max_trials = 20
    answer = client.run(goal)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.success
    assert answer.result.message == "trials"
    assert answer.result.trials == 20
    trials = [t for t in kept(store_path, "one") if t.found is not None]
    assert outline(trials) == locally(tmp_path / "l.sqlite", 20)
    # It went through everything.
    assert {"confirmed", "mesh 1"} <= {t.found.stage for t in trials}
    assert any("check_steps" in t.found.values for t in trials)
    # Each trial was published once, as it stands in the store.
    wait_for(lambda: len(client.trials) == 20, "all trials")
    for message, trial in zip(sorted(client.trials, key=lambda m: m.trial), trials, strict=True):
        found = trial.found
        assert (message.study, message.trial) == ("one", trial.number)
        assert (message.stage, message.score) == (found.stage, found.score)
        assert message.states == found.states
        assert message.mesh_id == found.mesh_id
        assert dict(zip(message.measures, message.measured, strict=True)) == found.values
        if "mfpt" in found.values:
            assert message.values[0] == found.values["mfpt"]
        else:
            assert math.isnan(message.values[0])
    best = max((t for t in trials if t.found.confirmed), key=lambda t: t.found.score)
    assert answer.result.best.trial == best.number
    wait_for(lambda: client.best and client.best[-1].trial == best.number, "the best")
    # Of feedback only the latest counts: a slow reader may miss some.
    wait_for(lambda: client.feedback and client.feedback[-1].trials == 20, "the last feedback")
    assert len(client.feedback) <= 20


def test_who_comes_late_gets_the_best(graph, client):
    late = graph.start(Client)
    wait_for(lambda: late.best, "the best")
    assert late.best[-1].trial == client.best[-1].trial
    graph.stop(late)


def test_a_cancelled_study_goes_on_later(client, store_path, tmp_path):
    goal = goal_message("two", SETTINGS)
    client.trials.clear()
    handle = client.send(goal)
    wait_for(lambda: len(client.trials) > 4, "some trials")
    # Meanwhile there is no room for another one.
    answer = client.run(goal_message("three", SETTINGS))
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "another study is running" in answer.result.message
    cancel(handle)
    answer = result_of(handle.ended)
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert answer.result.message == "stopped"
    assert {t.status for t in kept(store_path, "two")} <= {"done", "pending"}
    goal.max_trials = max(20, answer.result.trials)
    assert client.run(goal).result.success
    assert outline(kept(store_path, "two")) == locally(tmp_path / "l.sqlite", goal.max_trials)


def test_a_flood_of_goals_and_cancels_leaves_a_study_alone(
    client, store_path, tmp_path, monkeypatch
):
    # However slow the machine is, the flood is over by then.
    monkeypatch.setattr("biped_mfpt_ros.nodes.optimiser._WITHIN", 1e6)
    client.trials.clear()
    running = client.send(goal_message("flooded", SETTINGS))
    wait_for(lambda: client.trials, "a trial")
    # In bursts that the queues of an action hold, ten each: the middleware drops the rest.
    told = []
    for _ in range(30):
        burst = [client.action.send_goal_async(goal_message("more", SETTINGS)) for _ in range(8)]
        taken = [handle for handle in map(result_of, burst) if handle.accepted]
        # At once, since rclpy keeps results for 10 s only.
        told += [(handle, handle.get_result_async()) for handle in taken]
    # Goals of other tests count too.
    assert MOST_REFUSED // 2 < len(told) <= MOST_REFUSED
    for handle, _ in told:
        result_of(handle.cancel_goal_async())
    for _, result in told:
        answer = result_of(result)
        assert answer.status in (GoalStatus.STATUS_ABORTED, GoalStatus.STATUS_CANCELED)
        assert "another study is running" in answer.result.message
    before = len(client.trials)
    # Three generations, so that the first 20 trials are done.
    wait_for(lambda: len(client.trials) > max(before + 5, 40), "more trials of the study")
    cancel(running)
    answer = result_of(running.ended)
    assert (answer.status, answer.result.message) == (GoalStatus.STATUS_CANCELED, "stopped")
    found = outline(kept(store_path, "flooded"))
    expected = locally(tmp_path / "l.sqlite", 20)
    assert len(expected) == 20
    assert found[:20] == expected  # it scored more than those


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"study": ""}, "study: '' is not allowed"),
        ({"searcher": "luck"}, "searcher: 'luck' is not allowed; allowed: cma-es"),
        ({"runs": 1001}, "runs: 1001 is not allowed; allowed: 0 to 1000"),
        ({"sigma_s": math.nan}, "sigma_s: nan is not allowed"),
        ({"objectives": ["mfpt", "cot"], "weights": [1.0]}, "weights: '1 numbers'"),
        ({"thresholds": [1.0]}, "as many of each"),
        ({"fixed": ["x*"]}, "fixed: 'x*' is not allowed"),
        ({"candidates": [0.0] * 23}, "candidates: 'length 23'"),
        ({"candidates": [0.0] * 22}, "candidates"),
        ({"seed": 3, "study": "one"}, "now different: seed"),
    ],
)
def test_a_goal_that_is_not_allowed_says_why(client, change, problem):
    goal = goal_message("bad", SETTINGS)
    for field, value in change.items():
        setattr(goal, field, value)
    answer = client.run(goal)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert problem in answer.result.message


def test_settings_survive_the_message():
    settings = replace(
        SETTINGS, searcher="nsga2", objectives={"mfpt": 1.0, "cot": 20.0}, fixed=("k?",),
        limits={"speed_min": 0.3}, model=WalkerModel(torque_limit=math.inf), check_sigmas=(2.0,),
        stages=(Stage(0.1, 0.3), Stage(0.25, 0.03, -0.02)),
    )  # fmt: skip
    assert settings_from(goal_message("x", settings)).as_json() == settings.as_json()
    several = replace(settings, searcher="cma-es", runs=7)
    assert settings_from(goal_message("x", several)).as_json() == several.as_json()
    rolling = replace(settings, correlation=0.5)
    assert settings_from(goal_message("x", rolling)).as_json() == rolling.as_json()
    given = replace(settings, searcher="given", candidates=((0.1,) * 20, (1.0 / 3.0,) * 20))
    assert settings_from(goal_message("x", given)).as_json() == given.as_json()


def test_a_goal_that_says_little_has_the_settings_of_the_library():
    goal = Optimise.Goal(study="x", start=controller_message(controller("hzd/mfpt")))
    assert settings_from(goal).as_json() == StudySettings(controller("hzd/mfpt")).as_json()


def test_given_candidates_are_tried_once_each(client, store_path, tmp_path):
    vectors = tuple(tuple(v) for v in 0.1 * np.random.default_rng(3).normal(size=(3, 22)))
    settings = replace(SETTINGS, searcher="given", candidates=vectors)
    answer = client.run(goal_message("given", settings))
    assert (answer.result.message, answer.result.trials) == ("converged", 3)
    found = kept(store_path, "given")
    assert [tuple(t.vector) for t in found] == list(vectors)
    assert outline(found) == locally(tmp_path / "l.sqlite", None, settings)


def test_a_mesh_that_is_too_large_is_a_fact_about_the_candidate(client, store_path, tmp_path):
    settings = replace(SETTINGS, stages=(Stage(1.0, 1.0, max_states=4),))
    goal = goal_message("small", settings)
    goal.max_trials = 3
    assert client.run(goal).result.success
    found = kept(store_path, "small")
    assert found[0].found.stage == "unmeshed"
    assert outline(found) == locally(tmp_path / "l.sqlite", 3, settings)


def test_without_a_pipeline_a_study_ends_and_says_why(graph, tmp_path):
    path = tmp_path / "studies.sqlite"
    node = graph.start(
        lambda: Optimiser(namespace="alone"), store=str(path), patience=0.3, trials_at_once=1
    )

    class Alone(Node):
        def __init__(self):
            super().__init__("alone_client", namespace="alone")
            self.action = ActionClient(self, Optimise, "optimise")

        def close(self):
            self.action.destroy()

    alone = graph.start(Alone)
    wait_for(alone.action.server_is_ready, "the optimiser")
    handle = goal_handle(lambda: alone.action.send_goal_async(goal_message("none", SETTINGS)))
    answer = result_of(handle.ended)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "no mesher took a mesh" in answer.result.message
    assert [t.status for t in kept(path, "none")] == ["pending"]
    graph.stop(alone)
    graph.stop(node)


@pytest.mark.parametrize("kind", [Simulator, Mesher, Analysis])
def test_a_node_that_is_replaced_costs_nothing(graph, client, store_path, tmp_path, kind):
    goal = goal_message(f"without_{kind.__name__}", SETTINGS)
    goal.max_trials = 30
    client.trials.clear()
    result = client.send(goal).ended
    wait_for(lambda: len(client.trials) > 5, "some trials")
    node = next(node for node, _, _ in graph._nodes if isinstance(node, kind))
    graph.stop(node)
    graph.start(kind)
    assert result_of(result).result.success
    assert outline(kept(store_path, goal.study)) == locally(tmp_path / "l.sqlite", 30)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["simulator", "mesher", "analysis", "optimiser"])
def test_a_node_that_dies_costs_no_study(graph, victim, tmp_path):
    """One of the processes is killed and started again; the trials are as if it had not been."""
    path, namespace = tmp_path / "studies.sqlite", f"without_{victim}"
    parameters = {
        "mesher": ("-p", f"simulator_wait_seconds:={PATIENCE}"),
        "optimiser": ("-p", f"store:={path}", "-p", f"patience:={PATIENCE}"),
    }

    def launch(name):
        more = parameters.get(name, ())
        return graph.launch(name, "--ros-args", "-r", f"__ns:=/{namespace}", *more)

    processes = {n: launch(n) for n in ("simulator", "mesher", "analysis", "optimiser")}
    client = graph.start(lambda: Client(namespace))
    goal = goal_message("killed", SETTINGS)
    goal.max_trials = 40
    result = client.send(goal).ended
    wait_for(lambda: len(client.trials) > 5, "some trials")
    processes[victim].send_signal(signal.SIGKILL)
    processes[victim].wait()
    if victim == "optimiser":  # the graph takes a while to notice
        wait_for(lambda: not client.action.server_is_ready(), "its end")
    launch(victim)
    if victim == "optimiser":  # the study goes on when it is asked for again
        result = client.send(goal).ended
    assert result_of(result).result.success
    graph.stop(client)
    assert outline(kept(path, "killed")) == locally(tmp_path / "l.sqlite", 40)
