"""The mesher: grows meshes with all simulators on the graph, and publishes them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from biped_mfpt_msgs.action import GrowMesh
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future

from biped_mfpt_ros.chain.mesh import grow_mesh
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.nodes import simulator
from biped_mfpt_ros.nodes.meshes import Meshes
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.simulators import GraphSimulators
from biped_mfpt_ros.nodes.spin import run_node
from biped_mfpt_ros.nodes.warm_up import compiled
from biped_mfpt_ros.walker.outcome import Outcome


@dataclass(frozen=True)
class MesherParameters(NodeParameters):
    """Parameters of the mesher."""

    simulator_wait_seconds: float = parameter(
        10.0, "s, for how long a mesh waits when no simulator answers", 0.0, 1e9
    )
    simulator_timeout: float = parameter(
        1.0, "s, after which a simulator that also takes 10 times too long is late", 0.01, 1e6
    )
    chunk_seconds: float = parameter(0.1, "s, work in a full request", 1e-3, 10.0)
    chunks_in_flight: int = parameter(2, "requests that each simulator has at once", 1, 100)
    progress_period: float = parameter(0.25, "s, between two progress messages", 0.05, 60.0)
    meshes_at_once: int = parameter(4, "meshes that grow at the same time", 1, 64)
    checkpoint_directory: str = parameter(
        "",
        "where meshes that grow are kept on disk; a goal like one that was not finished resumes "
        "it. Empty: not kept",
    )
    max_queued: int = parameter(
        64, "goals that may wait for their turn; further ones are rejected", 0, 1000
    )


def warm_up() -> None:
    """Run the kernels of a mesh once, so that they are compiled."""
    simulator.warm_up()
    step = np.array([[Outcome.STEP]], dtype=np.uint8)
    answers = [
        SimpleNamespace(outcomes=step, next_states=np.ones((1, 10))),
        SimpleNamespace(outcomes=step + 1, next_states=np.empty((0, 10))),
    ]
    grow_mesh(lambda states, slopes: answers.pop(0), np.zeros(10), [0.0], 1e-3)


class Mesher(Node):
    """Action server of `GrowMesh`.

    It grows a few meshes at once. Further goals wait in the order in which they came: rejected
    ones would have to be sent again and again. A goal with bad settings is accepted and aborted,
    since a rejection cannot say why.

    Meshes grow in a thread of their own. The executor only takes requests and answers.
    """

    def __init__(self) -> None:
        super().__init__("mesher")
        self.declared = Declared(self, MesherParameters)
        with compiled(self.get_logger().info, "step map and mesh"):
            warm_up()
        self.simulators = GraphSimulators(self)
        self._meshes = Meshes(self, self.simulators, lambda: self.declared.now)
        self._growing = 0
        self._waiting: deque[ServerGoalHandle[Any, Any, Any]] = deque()
        self._action = ActionServer(
            self,
            GrowMesh,
            "grow_mesh",
            self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )
        self.get_logger().info(f"ready, with step map {STEP_MAP}")

    def close(self) -> None:
        """Stop the meshes that grow."""
        self._meshes.close()
        self._action.destroy()

    def _on_goal(self, goal: GrowMesh.Goal) -> GoalResponse:
        now = self.declared.now
        if self._growing >= now.meshes_at_once and len(self._waiting) >= now.max_queued:
            self.get_logger().warning(
                f"rejected a goal: {now.max_queued} are waiting already (max_queued)"
            )
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, goal: ServerGoalHandle[Any, Any, Any]) -> None:
        self._waiting.append(goal)
        self._begin_waiting()

    def _begin_waiting(self) -> None:
        while self._waiting and self._growing < self.declared.now.meshes_at_once:
            self._growing += 1
            self._waiting.popleft().execute()

    def _on_cancel(self, goal: ServerGoalHandle[Any, Any, Any]) -> CancelResponse:
        # One that waits need not wait for its turn; but only after this does it count as cancelled.
        if self.executor is not None:
            self.executor.create_task(self._remove_cancelled)
        return CancelResponse.ACCEPT

    def _remove_cancelled(self) -> None:
        for goal in [goal for goal in self._waiting if goal.is_cancel_requested]:
            self._waiting.remove(goal)
            goal.execute(_cancel_waiting)

    async def _execute(self, goal: ServerGoalHandle[Any, Any, Any]) -> GrowMesh.Result:
        done: Future[GrowMesh.Result] = Future()

        def finish(result: GrowMesh.Result) -> None:
            done.set_result(result)
            if self.executor is not None:
                self.executor.wake()

        self._meshes.grow(goal, finish)
        result = await done
        self._growing -= 1
        self._begin_waiting()
        return result


def _cancel_waiting(goal: ServerGoalHandle[Any, Any, Any]) -> GrowMesh.Result:
    goal.canceled()
    return GrowMesh.Result(message="cancelled before it began")


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_node(Mesher, args)
