"""What `biped-mfpt run` asks of the nodes: grow a mesh, tell its MFPT."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import rclpy
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshProgress as MeshProgressMsg
from biped_mfpt_msgs.msg import MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt, SimulateSteps
from rclpy.action.client import ClientGoalHandle
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from unique_identifier_msgs.msg import UUID

from biped_mfpt_ros.cli import CommandError, leaving
from biped_mfpt_ros.nodes.answers import ActionClient, Answer, accepted
from biped_mfpt_ros.nodes.fair_service import client_name
from biped_mfpt_ros.nodes.messages import MeshSettings, packed, settings_message
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS
from biped_mfpt_ros.nodes.spin import security_explained

_Self = TypeVar("_Self", bound="Client")  # typing has Self from Python 3.11 on
_POLL = 0.05  # s
_PUBLISHED = 10.0  # s, for the analysis to publish an MFPT before it is asked
_GREET_AGAIN = 1.0  # s, until what costs nothing is asked for the second time
_GREETED = 120.0  # s, for an answer to it, however busy the machine is
_ON_ITS_WAY = 120.0  # s, for the last messages of a mesh to come to the analysis
# What a recorder has to hear of a run: it finds each of them by itself, some tenths of a second
# after its publisher, and a small mesh is grown and solved in less.
RECORDED = ("mesh/info", "mesh/states", "mesh/transitions", "mesh/progress", "mfpt")


@dataclass(frozen=True)
class Peers:
    """Which nodes of the pipeline are there."""

    simulators: int
    mesher: bool
    analysis: bool
    recorder: bool


class AnalysisFailed(CommandError):
    """The analysis could not tell an MFPT; the message says why."""


class WaitedInVain(CommandError):
    """What was waited for did not come in time."""


class Client:
    """Client of a pipeline in one namespace. Use it as a context manager.

    It leaves the graph at the end of the command, see `leaving`.

    Parameters
    ----------
    namespace : str
        Of the nodes, with a leading slash.
    watch : callable
        Called some twenty times a second while the client waits; it may raise to end that.
    """

    def __init__(self, namespace: str, watch: Callable[[], object]) -> None:
        self._watch = watch
        self._context = Context()
        # Signals belong to the processes' supervisor, and the log to the terminal.
        with security_explained():
            rclpy.init(
                args=["--ros-args", "--disable-external-lib-logs", "--log-level", "error"],
                context=self._context,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self._node = Node("run", namespace=namespace, context=self._context)
        self._name = client_name(self._node)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._actions: list[ActionClient] = []
        self._grow = self._action(GrowMesh, "grow_mesh")
        self._compute = self._node.create_client(ComputeMfpt, "compute_mfpt", qos_profile=REQUESTS)
        self._estimates: list[MfptEstimate] = []
        self._node.create_subscription(MfptEstimate, "mfpt", self._estimates.append, RESULTS)

    def __enter__(self: _Self) -> _Self:
        """Start."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Leave the graph, once that may take as long as it likes."""
        leaving.append(self.leave)

    def leave(self) -> None:
        """Leave the graph."""
        nodes = self._executor.get_nodes()
        self._executor.shutdown(timeout_sec=0.0)
        for action in self._actions:
            action.destroy()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _action(self, kind: Any, name: str) -> ActionClient:
        """A client of an action, to be destroyed at the end."""
        self._actions.append(ActionClient(self._node, kind, name))
        return self._actions[-1]

    def add(self, make: Callable[..., Node], name: str, **parameters: object) -> Node:
        """Make a node of this namespace, and serve it too whenever the client waits.

        Parameters
        ----------
        make : callable
            Makes it of the arguments of `rclpy.node.Node`.
        name : str
            Of the node.
        **parameters
            Its parameters; a value is text as YAML has it.
        """
        arguments = ["--ros-args", "-r", f"__ns:={self._node.get_namespace()}"]
        arguments += ["-r", f"__node:={name}", "-r", "/rosout:=rosout"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={value}"]
        node = make(context=self._context, cli_args=arguments, use_global_arguments=False)
        self._executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        """Serve a node no more, and destroy it."""
        self._executor.remove_node(node)
        node.destroy_node()

    def peers(self) -> Peers:
        """Look who is there."""
        services = self._node.get_service_names_and_types()
        kind = f"{SimulateSteps.__module__.split('.')[0]}/srv/{SimulateSteps.__name__}"
        here = self._node.get_namespace().rstrip("/") + "/"
        simulators = [name for name, types in services if kind in types and name.startswith(here)]
        return Peers(
            simulators=len(simulators),
            mesher=self._grow.server_is_ready(),
            analysis=self._compute.service_is_ready(),
            recorder=any(
                self.listens(name, RECORDED)
                for name in self._node.get_node_names()
                if name.startswith("recorder")
            ),
        )

    def reaches(self, mesher: str) -> bool:
        """Whether goals get to a mesher and their answers back, also beside one that was killed.

        Of what a mesher's action has, its status is announced last. That the node is there says
        little: an answer to who asks before the rest is there gets lost.
        """
        status = self._node.resolve_topic_name("grow_mesh/_action/status")
        announced = self._node.get_publishers_info_by_topic(status)
        return any(info.node_name == mesher for info in announced) and self._grow.server_is_ready()

    def listens(self, node: str, topics: Sequence[str]) -> bool:
        """Whether a node of the pipeline is subscribed to all of some topics."""
        return all(
            any(
                info.node_name == node
                for info in self._node.get_subscriptions_info_by_topic(
                    self._node.resolve_topic_name(topic)
                )
            )
            for topic in topics
        )

    def wait_until_found(self) -> None:
        """Wait until mesher and analysis have found this client, and answer it."""
        ready = self._grow.server_is_ready
        self.wait(lambda: ready() and self._compute.service_is_ready(), _GREETED, "the nodes")
        none = ClientGoalHandle(
            self._grow, UUID(uuid=[1] * 16), GrowMesh.Impl.SendGoalService.Response()
        )
        self._greeted(none.cancel_goal_async, "the mesher")
        self._greet_analysis()

    def wait(self, condition: Callable[[], bool], timeout: float, what: str) -> None:
        """Wait until a condition holds; WaitedInVain after ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise WaitedInVain(f"waited {timeout:g} s for {what}")
            self.spin()

    def grow_mesh(
        self, settings: MeshSettings, feedback: Callable[[MeshProgressMsg], object]
    ) -> GrowMesh.Result:
        """Have the mesher grow a mesh.

        Parameters
        ----------
        settings : MeshSettings
            Of the mesh.
        feedback : callable
            Told how far it has come.

        Raises
        ------
        CommandError
            If the mesher refuses, or the mesh fails.
        """
        goal = GrowMesh.Goal(settings=settings_message(settings))
        handle = self._accepted(self._grow, goal, lambda told: feedback(told.progress))
        if not handle.accepted:
            raise CommandError("the mesher refused the mesh; its log says why")
        result: GrowMesh.Result = self._result(Answer(handle.get_result_async)).result
        if not result.success:
            raise CommandError(f"the mesh failed: {result.message}")
        return result

    def mfpt(
        self, mesh_id: str, mu_s: float, sigma_s: Sequence[float], correlation: float = 0.0
    ) -> list[MfptEstimate]:
        """The MFPT of a mesh as published, or else by asking; AnalysisFailed if in vain.

        Nothing is published where a chain cannot be solved. Where solving takes long, the answer
        comes after what is published.
        """
        try:
            return self.published_mfpt(mesh_id, mu_s, sigma_s, _PUBLISHED, correlation)
        except WaitedInVain:
            return self.compute_mfpt(mesh_id, mu_s, sigma_s, correlation)

    def published_mfpt(
        self,
        mesh_id: str,
        mu_s: float,
        sigma_s: Sequence[float],
        timeout: float,
        correlation: float = 0.0,
    ) -> list[MfptEstimate]:
        """The MFPT of a mesh as the analysis publishes it, one for each ``sigma_s``."""

        def found() -> list[MfptEstimate]:
            mine = {
                estimate.sigma_s: estimate
                for estimate in self._estimates
                if (estimate.mesh_id, estimate.mu_s, estimate.correlation)
                == (mesh_id, mu_s, correlation)
            }
            return [mine[sigma] for sigma in sigma_s if sigma in mine]

        self.wait(lambda: len(found()) == len(sigma_s), timeout, "the analysis to publish the MFPT")
        return found()

    def compute_mfpt(
        self, mesh_id: str, mu_s: float, sigma_s: Sequence[float], correlation: float = 0.0
    ) -> list[MfptEstimate]:
        """Ask the analysis for the MFPT of a mesh at any ``sigma_s``; AnalysisFailed if in vain."""
        # A chain may cost much, so that is asked for once, when the analysis has answered what
        # costs nothing: then it has found this client.
        self._greet_analysis()
        deadline = time.monotonic() + _ON_ITS_WAY
        while True:
            try:
                return self.answer(self.ask_mfpt(mesh_id, mu_s, sigma_s, correlation))
            except AnalysisFailed as error:
                if "mesh_id" not in str(error) or time.monotonic() > deadline:
                    raise
            self.spin()

    def ask_mfpt(
        self, mesh_id: str, mu_s: float, sigma_s: Sequence[float], correlation: float = 0.0
    ) -> Future:
        """Ask as `compute_mfpt` does, without waiting for the `answer`.

        It may cost much, so it is asked once: an analysis of which an estimate or an answer has
        come has found this client, and loses no answer.
        """
        return self._compute.call_async(
            ComputeMfpt.Request(
                mesh_id=mesh_id,
                mu_s=mu_s,
                sigma_s=packed(np.array(sigma_s), "d"),
                correlation=correlation,
                client=self._name,
            )
        )

    def answer(self, asked: Future) -> list[MfptEstimate]:
        """Wait for what `ask_mfpt` asked for; AnalysisFailed if in vain."""
        response = self._result(asked)
        if not response.success:
            raise AnalysisFailed(f"the analysis failed: {response.message}")
        return list(response.estimates)

    def _greet_analysis(self) -> None:
        """Ask the analysis what costs nothing, until it answers: it has found this client then."""
        greeting = ComputeMfpt.Request(client=self._name)
        self._greeted(lambda: self._compute.call_async(greeting), "the analysis")

    def _greeted(self, ask: Callable[[], Future], who: str) -> None:
        """Wait for an answer to what costs nothing."""
        self.wait(Answer(ask, again=_GREET_AGAIN).done, _GREETED, f"an answer of {who}")

    def _accepted(self, action: ActionClient, goal: Any, feedback: Callable[[Any], object]) -> Any:
        """Handle of a goal, when it has been answered."""
        return self._result(
            accepted(
                lambda: action.send_goal_async(
                    goal, feedback_callback=lambda message: feedback(message.feedback)
                )
            )
        )

    def _result(self, answer: Answer | Future) -> Any:
        """An answer, when it has come."""
        while not answer.done():
            self.spin()
        return answer.result()

    def spin(self, seconds: float = _POLL) -> None:
        """Take what comes within a time, s, and see to the nodes."""
        self._executor.spin_once(timeout_sec=seconds)
        self._watch()
