"""The backend of a study over ROS: meshes by the mesher, their MFPT by the analysis."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MfptEstimate
from biped_mfpt_msgs.srv import ComputeMfpt
from rclpy.node import Node

from biped_mfpt_ros.gait.cycle import LimitCycle
from biped_mfpt_ros.nodes.answers import ActionClient, Answer, accepted
from biped_mfpt_ros.nodes.fair_service import client_name
from biped_mfpt_ros.nodes.messages import MeshSettings, packed, settings_message
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS
from biped_mfpt_ros.optimise.scoring import BackendLost, MeshFailed
from biped_mfpt_ros.optimise.settings import Stage, StudySettings

_LOOK = 0.05  # s, between two looks whether a trial is to end
_ALIVE = 0.5  # s, between two looks whether the mesher is still there
_PUBLISHED = 1.0  # s, for the analysis to publish an estimate before it is asked
_ASK_AGAIN = 0.1  # s, between two questions for a mesh that the analysis does not have yet
_ATTEMPTS = 3  # of a mesh whose growth failed for no reason in the candidate
_MOST_ESTIMATES = 1024  # kept, of meshes that nobody here waits for
_TOO_LARGE = "the mesh would hold more than max_states"

Check = Callable[[], None]


class PipelineBackend:
    """Grows meshes with the nodes on the graph; for any number of threads.

    Meshes and MFPT are equal, bit for bit, to those of `LocalBackend`.

    Parameters
    ----------
    node : rclpy.node.Node
        Whose clients are used; another thread has to spin it.
    patience : callable
        s, for how long a mesher or analysis that is gone is waited for.
    """

    def __init__(self, node: Node, patience: Callable[[], float]) -> None:
        self._node = node
        self._patience = patience
        self._name = client_name(node)
        self._grow = ActionClient(node, GrowMesh, "grow_mesh")
        # What a node publishes tells it from another one of the same name: the one that died from
        # the one that took its place, which knows nothing of what was asked.
        self._of_mesher = node.resolve_topic_name("grow_mesh/_action/status")
        self._of_analysis = node.resolve_topic_name("mfpt")
        self._compute = node.create_client(ComputeMfpt, "compute_mfpt", qos_profile=REQUESTS)
        self._estimates: OrderedDict[str, list[MfptEstimate]] = OrderedDict()
        self._arrived = threading.Condition()
        node.create_subscription(MfptEstimate, "mfpt", self._on_estimate, RESULTS)

    def close(self) -> None:
        """Destroy the action client."""
        self._grow.destroy()

    def grow(
        self,
        cycle: LimitCycle,
        settings: StudySettings,
        stage: Stage,
        slopes: np.ndarray,
        check: Check,
    ) -> PipelineMesh:
        """Grow a mesh; see `Backend`. A mesher that dies meanwhile is waited for and asked again.

        Raises
        ------
        MeshFailed
            If the candidate does not allow it.
        BackendLost
            If nobody grows meshes, or nobody computes steps.
        """
        goal = GrowMesh.Goal(
            settings=settings_message(
                MeshSettings(
                    cycle.controller,
                    settings.model,
                    slopes,
                    stage.threshold,
                    max_states=stage.max_states,
                    initial_state=cycle.state,
                )
            )
        )
        start = time.monotonic()
        message = ""
        for _ in range(_ATTEMPTS):
            result = self._grown(goal, check)
            if result is None:
                continue
            if result.success:
                return PipelineMesh(
                    self, result.mesh_id, result.states, time.monotonic() - start,
                    result.step_map_seconds, check,
                )  # fmt: skip
            message = result.message
            if message.startswith(_TOO_LARGE):
                raise MeshFailed(
                    f"more than {stage.max_states} states at d_s = {stage.slope_step_deg:g} "
                    f"degrees, d_thr = {stage.threshold:g}",
                    stage.max_states,
                )
        raise BackendLost(f"no mesh in {_ATTEMPTS} attempts: {message or 'the mesher died'}")

    def _grown(self, goal: GrowMesh.Goal, check: Check) -> GrowMesh.Result | None:
        """One attempt; None if the mesher was lost."""
        handle: Any = None
        deadline = time.monotonic() + self._patience()
        while handle is None or not handle.accepted:
            check()
            if time.monotonic() > deadline:
                raise BackendLost(f"no mesher took a mesh within {self._patience():g} s")
            if not self._grow.server_is_ready():
                time.sleep(_LOOK)
                continue
            mesher = self._publishers(self._of_mesher)
            sent = accepted(lambda: self._grow.send_goal_async(goal))
            handle = self._result(sent, mesher, check)
            if handle is not None and not handle.accepted:  # too many are waiting
                time.sleep(_LOOK)
        try:
            response = self._result(Answer(handle.get_result_async), mesher, check)
        except BaseException:
            handle.cancel_goal_async()
            raise
        return None if response is None else response.result

    def _publishers(self, topic: str) -> set[bytes]:
        """What tells those that publish on a topic now from later ones."""
        found = self._node.get_publishers_info_by_topic(topic)
        return {bytes(info.endpoint_gid) for info in found}

    def _result(self, answer: Answer, asked: set[bytes], check: Check, topic: str = "") -> Any:
        """An answer, or None if who was asked, the mesher by default, is gone."""
        look = time.monotonic() + _ALIVE
        while not answer.come.wait(_LOOK) and not answer.done():
            check()
            if time.monotonic() > look:
                look = time.monotonic() + _ALIVE
                if not self._publishers(topic or self._of_mesher) & asked:
                    return None
        return answer.result()

    def _on_estimate(self, estimate: MfptEstimate) -> None:
        with self._arrived:
            self._estimates.setdefault(estimate.mesh_id, []).append(estimate)
            while len(self._estimates) > _MOST_ESTIMATES:
                self._estimates.popitem(last=False)
            self._arrived.notify_all()

    def mfpt(
        self, mesh_id: str, mu_s: float, sigma_s: float, correlation: float, check: Check
    ) -> float:
        """MFPT of a mesh: as published if it is, else by asking.

        Raises
        ------
        MeshFailed
            If its chain cannot be solved.
        BackendLost
            If the analysis is gone, or has not got the mesh.
        """
        published = time.monotonic() + _PUBLISHED
        with self._arrived:
            while mesh_id not in self._estimates and time.monotonic() < published:
                self._arrived.wait(_LOOK)
                check()
            # Of one mesh the estimates are published one after another; the rest can be asked for.
            for estimate in self._estimates.get(mesh_id, []):
                ground = (estimate.mu_s, estimate.sigma_s, estimate.correlation)
                if ground == (mu_s, sigma_s, correlation):
                    return float(estimate.mfpt)
        request = ComputeMfpt.Request(
            mesh_id=mesh_id,
            mu_s=mu_s,
            sigma_s=packed(np.array([sigma_s]), "d"),
            correlation=correlation,
            client=self._name,
        )
        deadline = time.monotonic() + self._patience()
        message = "it is not there"
        while time.monotonic() < deadline:
            check()
            if self._compute.service_is_ready():
                analysis = self._publishers(self._of_analysis)
                # A chain may cost much, so that is asked for once, when the analysis has answered
                # what costs nothing: then it has found this client.
                for asked, again in (
                    (ComputeMfpt.Request(client=self._name), None),
                    (request, math.inf),
                ):
                    answer = Answer(partial(self._compute.call_async, asked), again=again)
                    response = self._result(answer, analysis, check, self._of_analysis)
                    if response is None:
                        break
                if response is not None and response.success:
                    return float(response.estimates[0].mfpt)
                if response is not None:
                    message = response.message
                    if not (response.busy or message.startswith("mesh_id")):
                        raise MeshFailed(message)
            time.sleep(_ASK_AGAIN)
        raise BackendLost(f"no MFPT of mesh {mesh_id} from the analysis: {message}")


@dataclass(frozen=True)
class PipelineMesh:
    """A mesh of the pipeline; see `GrownMesh`."""

    backend: PipelineBackend
    mesh_id: str
    states: int
    seconds: float
    step_map_seconds: float
    check: Check

    def mfpt(self, mu_s: float, sigma_s: float, correlation: float) -> float:
        """MFPT in steps."""
        return self.backend.mfpt(self.mesh_id, mu_s, sigma_s, correlation, self.check)
