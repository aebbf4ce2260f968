"""Bad input over ROS 2 to nodes that run: every service, action, topic and parameter of theirs.

The nodes are processes of their own. Each has to answer, in words that help where it refuses, to
live on, and to keep no more than it had.
"""

from __future__ import annotations

import re
import signal
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from random import Random
from subprocess import Popen
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from biped_mfpt_msgs import msg
from biped_mfpt_msgs.action import GrowMesh, Optimise
from biped_mfpt_msgs.srv import ComputeMfpt, SimulateSteps
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.task import Future
from unique_identifier_msgs.msg import UUID

from biped_mfpt_ros.bench.nodes import Nodes, end, held
from biped_mfpt_ros.control.controller import controller, controller_names
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes import messages
from biped_mfpt_ros.nodes.answers import Answer, accepted
from biped_mfpt_ros.nodes.optimiser import goal_message
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.soak import inputs, targets
from biped_mfpt_ros.soak.result import PromiseBroken, check
from biped_mfpt_ros.walker.robot import WalkerModel
from biped_mfpt_ros.walker.terrain import slope_set

INPUTS = 5000
"""Of a whole run, over all targets."""

SHORT_INPUTS = 300

_PATIENCE = 60.0
"""s for any answer. A search for a limit cycle may take 6 s."""

_CANCEL_AFTER = 0.3
"""s, after which a goal has shown that it is taken."""

_START = 300.0  # s, for nodes that may have to compile

# What an allowed question may bring to light, which is no fault of who asked.
_FACTS = re.compile(
    r"no limit cycle of|the mesh would hold more than max_states|sigma_s\[\d+\]: (the|a) chain"
)
_REFUSAL = re.compile(
    r"(?:.*?: )??(\S[^:]*): (?:(.*) is not allowed|missing); allowed: (.+)", re.DOTALL
)
# Of rclpy, before the node is asked.
_OUT_OF_RANGE = re.compile(r"Parameter \S+ out of range\.? Min: .+, Max: .+, value: ")


def judge(success: bool, message: str) -> None:
    """Take an answer: InputError if it is a refusal, PromiseBroken if that is of no use."""
    if success or _FACTS.match(message):
        return
    found = _REFUSAL.fullmatch(message)
    if found is None:
        raise PromiseBroken(f"a refusal that does not say what is allowed: {message[:1000]!r}")
    raise InputError(found[1], found[2], found[3])


class Live:
    """Nodes that run, and what is asked of them.

    Parameters
    ----------
    nodes : Nodes
        Where they run.
    """

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        store = nodes.directory / "studies.sqlite"
        self.processes: dict[str, Popen[bytes]] = {
            name: nodes.start(name, name, **parameters)
            for name, parameters in (
                ("simulator", {"max_evaluations": targets.MOST_EVALUATIONS}),
                ("mesher", {}),
                ("analysis", {}),
                ("optimiser", {"store": store, "trials_at_once": 1}),
                ("recorder", {"bag": nodes.directory / "bag"}),
            )
        }
        self._hangs = ""
        self._studies = 0
        node = nodes.node
        self.listen()
        self.optimise = ActionClient(node, Optimise, "optimise")
        nodes.wait(1, _START)
        self._wait(self.optimise.server_is_ready, "the optimiser", _START)
        self.simulate = self.service(SimulateSteps, "simulator/simulate_steps")
        self.compute = self.service(ComputeMfpt, "compute_mfpt")
        self.published = targets.Published()
        self.publishers = {
            topic: (kind, node.create_publisher(kind, topic, RESULTS)) for topic, kind in _TOPICS
        }
        self.pings = {
            name: self.service(ListParameters, f"{name}/list_parameters") for name in self.processes
        }
        self.mesh_id = ""
        self.check_well()

    def listen(self) -> None:
        """Make the client of the mesher's action."""
        self.grow = ActionClient(self._nodes.node, GrowMesh, "grow_mesh")
        self._wait(self.grow.server_is_ready, "the mesher", _START)

    def service(self, kind: Any, name: str, greet: bool = True) -> Callable[[Any], Any]:
        """Function that calls a service of a node.

        Answers are lost until the node has found the client. With ``greet`` an empty request is
        sent before, again and again until it is answered. A node finds clients in the order in
        which they are made, so that the last of several is enough.
        """
        client = self._nodes.node.create_client(kind, name, qos_profile=REQUESTS)
        self._wait(client.service_is_ready, name, _START)
        if greet:
            self.result(Answer(lambda: client.call_async(kind.Request())), name)
        return lambda request: self.result(client.call_async(request), name)

    def result(self, future: Future[Any] | Answer, what: str) -> Any:
        """What a future brings."""
        self._wait(future.done, f"an answer of {what}", _PATIENCE)
        return future.result()

    def _wait(self, condition: Callable[[], object], what: str, timeout: float) -> None:
        check(not self._hangs, self._hangs)

        def holds() -> object:
            self.check_alive()
            return condition()

        try:
            self._nodes.spin(holds, timeout, what)
        except TimeoutError as error:
            self._hangs = str(error)  # then nothing more is to be waited for
            raise PromiseBroken(str(error)) from error

    def check_alive(self) -> None:
        """Raise PromiseBroken if a node has ended."""
        for name, process in self.processes.items():
            if process.poll() is not None:
                log = (self._nodes.directory / f"{name}.log").read_text(errors="replace")
                raise PromiseBroken(f"{name} ended with code {process.returncode}:\n{log[-3000:]}")

    def check_well(self) -> None:
        """Raise PromiseBroken unless the nodes do what is rightly asked of them."""
        for ping in self.pings.values():
            ping(ListParameters.Request())
        grown = self.goal(self.grow, GrowMesh.Goal(settings=_settings(Random(1), "hzd/base")), 60.0)
        check(grown.success, f"no mesh any more: {grown.message}")
        self.mesh_id = grown.mesh_id
        asked = ComputeMfpt.Request(mesh_id=grown.mesh_id, sigma_s=[0.02])
        deadline = time.monotonic() + _PATIENCE
        while not (answer := self.compute(asked)).success:
            check(time.monotonic() < deadline, f"no MFPT any more: {answer.message}")
        found = self.goal(self.optimise, self.study(), _PATIENCE)
        check(found.success, f"no study any more: {found.message}")

    def study(self) -> Optimise.Goal:
        """A goal of the optimiser, for a study of one trial."""
        self._studies += 1
        settings = StudySettings(
            controller("hzd/base"), stages=(Stage(5.0, 3.0, max_states=200),), check_sigmas=()
        )
        goal = goal_message(f"study {self._studies}", settings)
        goal.max_trials = 1
        return goal

    def goal(self, client: ActionClient[Any, Any, Any], goal: Any, seconds: float) -> Any:
        """Result of a goal, which is cancelled after some seconds."""
        handle = self.result(accepted(lambda: client.send_goal_async(goal)), "an action")
        check(handle.accepted, "a goal was rejected, which does not say why")
        ended = Answer(handle.get_result_async)
        deadline = time.monotonic() + seconds
        while not ended.done() and time.monotonic() < deadline:
            self.check_alive()
            self._nodes.spin_once(0.02)
        cancelled = not ended.done()
        if cancelled:
            self.result(Answer(handle.cancel_goal_async), "a cancel")
        answer = self.result(ended, "an action")
        if cancelled and answer.status == GoalStatus.STATUS_CANCELED:
            answer.result.success = True
        return answer.result

    def memory(self) -> dict[str, float]:
        """Bytes that each node has now."""
        return {name: 1e3 * found["kilobytes"] for name, found in self.held().items()}

    def held(self) -> dict[str, dict[str, int]]:
        """What each node has now, see `bench.nodes.held`."""
        return {name: held(process.pid) for name, process in self.processes.items()}

    def end(self) -> None:
        """Have the nodes end, and raise PromiseBroken if one does not do so cleanly."""
        self.check_alive()
        for name, process in self.processes.items():
            end(process, signal.SIGTERM)
            check(process.returncode == 0, f"{name} ended with code {process.returncode}")


@contextmanager
def live() -> Iterator[Live]:
    """The nodes, for as long as the block takes."""
    with Nodes() as nodes:
        found = Live(nodes)
        try:
            yield found
        finally:
            found.grow.destroy()
            found.optimise.destroy()


# Services and actions ------------------------------------------------------------------------


def _settings(random: Random, name: str = "") -> msg.MeshSettings:
    made = messages.MeshSettings(
        controller(name or random.choice(controller_names())),
        WalkerModel(),
        slope_set(5.0),
        random.choice((1.0, 3.0)),
        max_states=200,
        initial_state=np.array(targets.STATE) if random.random() < 0.7 else None,
    )
    return messages.settings_message(made)


def ask_simulator(live: Live, random: Random) -> None:
    """A request to the simulator."""
    answer = live.simulate(inputs.spoil(random, targets.request(random)))
    judge(answer.success, answer.message)


def ask_analysis(live: Live, random: Random) -> None:
    """A request to the analysis."""
    asked = ComputeMfpt.Request(
        mesh_id=live.mesh_id, mu_s=0.0, sigma_s=[0.02, 0.05], correlation=0.5
    )
    answer = live.compute(inputs.spoil(random, asked))
    judge(answer.success, answer.message)


def grow_mesh(live: Live, random: Random) -> None:
    """A goal of the mesher."""
    goal = inputs.spoil(random, GrowMesh.Goal(settings=_settings(random)))
    result = live.goal(live.grow, goal, _CANCEL_AFTER)
    judge(result.success, result.message)


def optimise(live: Live, random: Random) -> None:
    """A goal of the optimiser."""
    result = live.goal(live.optimise, inputs.spoil(random, live.study()), _CANCEL_AFTER)
    judge(result.success, result.message)


@contextmanager
def ask_for_goals(live: Live) -> Iterator[Callable[[Random], None]]:
    """Cancels and questions for goals that are not there, and goals of a name that is taken."""
    services = [
        (
            goal,
            live.service(kind.Impl.SendGoalService, f"{name}/_action/send_goal", greet=False),
            live.service(CancelGoal, f"{name}/_action/cancel_goal"),
            live.service(kind.Impl.GetResultService, f"{name}/_action/get_result"),
            kind.Impl,
        )
        for name, kind, goal in (
            ("grow_mesh", GrowMesh, GrowMesh.Goal()),
            ("optimise", Optimise, Optimise.Goal()),
        )
    ]

    def give(random: Random) -> None:
        goal, send, cancel, get_result, kind = random.choice(services)
        goal_id = UUID(uuid=array("B", random.choice((random.randbytes(16), bytes(16)))))
        what = random.random()
        if what < 0.5:
            asked = CancelGoal.Request()
            asked.goal_info.goal_id = goal_id
            asked.goal_info.stamp.sec = random.choice((0, 1, 2**31 - 1, -(2**31)))
            answer = cancel(asked)
            # With neither name nor time it is for all goals, of which none is left.
            check(not answer.goals_canceling, "a goal is cancelled that is not there")
        elif what < 0.8:
            answer = get_result(kind.GetResultService.Request(goal_id=goal_id))
            check(answer.status == GoalStatus.STATUS_UNKNOWN, "a goal has a result that is none")
        else:
            goal_id = UUID(uuid=array("B", random.randbytes(16)))
            asked = kind.SendGoalService.Request(goal_id=goal_id, goal=goal)
            check(send(asked).accepted, "a goal was rejected, which does not say why")
            check(not send(asked).accepted, "a goal of a name that is taken was accepted")
            ended = get_result(kind.GetResultService.Request(goal_id=goal_id))
            judge(ended.result.success, ended.result.message)

    yield give


# Topics --------------------------------------------------------------------------------------

_TOPICS: tuple[tuple[str, Any], ...] = (
    ("mesh/info", msg.MeshInfo),
    ("mesh/states", msg.MeshStates),
    ("mesh/transitions", msg.MeshTransitions),
    ("mesh/progress", msg.MeshProgress),
    ("mfpt", msg.MfptEstimate),
    ("optimisation/trials", msg.OptimisationTrial),
    ("optimisation/best", msg.OptimisationTrial),
    # What the optimiser hears of the mesher.
    ("grow_mesh/_action/feedback", GrowMesh.Impl.FeedbackMessage),
    ("grow_mesh/_action/status", GoalStatusArray),
)
_OF_KIND = {kind: topic for topic, kind in reversed(_TOPICS)}


@contextmanager
def publish(live: Live) -> Iterator[Callable[[Random], None]]:
    """Messages on topics that nodes hear, or bytes that are none."""
    # This process hears of the mesher too, unless it stops to.
    live.grow.destroy()
    try:
        yield partial(_publish, live)
    finally:
        live.listen()


def _publish(live: Live, random: Random) -> None:
    if random.random() < 0.3:
        spread = live.published.make(random)
    else:
        _, kind = random.choice(_TOPICS)
        spread = [inputs.spoil(random, kind())]
        if "sequence" in kind.get_fields_and_field_types():
            spread[0].sequence = inputs.whole(random, 64)
    for message in spread:
        raw = random.random() < 0.3
        _, publisher = live.publishers[_OF_KIND[type(message)]]
        publisher.publish(inputs.spoilt(random, serialize_message(message)) if raw else message)
    # Each takes what came before.
    for name in random.sample([*live.pings], 1):
        live.pings[name](ListParameters.Request())


# Parameters ----------------------------------------------------------------------------------


@contextmanager
def set_parameters(live: Live) -> Iterator[Callable[[Random], None]]:
    """Values for parameters, of any type, and questions for parameters that are not there."""
    services = {
        name: [
            live.service(kind, f"{name}/{service}")
            for kind, service in (
                (SetParameters, "set_parameters"),
                (SetParametersAtomically, "set_parameters_atomically"),
                (GetParameters, "get_parameters"),
                (DescribeParameters, "describe_parameters"),
            )
        ]
        for name in targets.PARAMETERS
    }
    names = {
        name: [field.name for field in fields(kind)] for name, kind in targets.PARAMETERS.items()
    }
    usual = {
        name: [
            ParameterMessage(name=key, value=value)
            for key, value in zip(
                names[name],
                services[name][2](GetParameters.Request(names=names[name])).values,
                strict=True,
            )
        ]
        for name in targets.PARAMETERS
    }

    def give(random: Random) -> None:
        name = random.choice([*targets.PARAMETERS])
        set_each, set_all, get, describe = services[name]
        keys = [
            random.choice(names[name]) if random.random() < 0.8 else _name(random)
            for _ in range(random.randint(1, 2))
        ]
        if random.random() < 0.1:
            kind, ask = random.choice(((GetParameters, get), (DescribeParameters, describe)))
            ask(kind.Request(names=keys))
            return
        given = [Parameter(key, value=_value(random)).to_parameter_msg() for key in keys]
        if random.random() < 0.5:
            results = set_each(SetParameters.Request(parameters=given)).results
        else:
            results = [set_all(SetParametersAtomically.Request(parameters=given)).result]
        if any(result.successful for result in results):
            put_back = set_each(SetParameters.Request(parameters=usual[name])).results
            check(name == "recorder" or all(r.successful for r in put_back), "no way back")
        # What is no parameter of the pipeline's, rclpy refuses in its own words.
        own = set(keys) <= set(names[name])
        for result in results:
            if own and not _OUT_OF_RANGE.match(result.reason):
                judge(result.successful, result.reason)
            check(result.successful or bool(result.reason), "a refusal without a reason")

    yield give


def _name(random: Random) -> str:
    return random.choice(("use_sim_time", inputs.text(random, "max_states")))


def _value(random: Random) -> Any:
    """Anything that a parameter can be, but a yes for the time of a simulation, which stops."""
    value = targets.value(random)
    return [b"x"] if isinstance(value, bytes) else 0 if value is True else value


# ---------------------------------------------------------------------------------------------


def _each(give: Callable[[Live, Random], None]) -> Callable[[Live], Any]:
    @contextmanager
    def make(live: Live) -> Iterator[Callable[[Random], None]]:
        yield partial(give, live)

    return make


TARGETS: tuple[tuple[str, float, Callable[[Live], Any]], ...] = (
    ("requests to a simulator", 4, _each(ask_simulator)),
    ("questions to an analysis", 4, _each(ask_analysis)),
    ("goals of a mesher", 2, _each(grow_mesh)),
    ("goals of an optimiser", 1, _each(optimise)),
    ("goals that are not there", 4, ask_for_goals),
    ("messages on topics", 4, publish),
    ("parameters of nodes", 6, set_parameters),
)
"""Name, share of the inputs, and context manager that gives the function that takes a generator."""
