"""The mesher: grows meshes with all simulators on the graph, and publishes them."""

from __future__ import annotations

import re
import secrets
import time
import traceback
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshInfo, MeshProgress, MeshStates, MeshTransitions
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future

from biped_mfpt_ros.chain.mesh import Mesh, MeshLimitError, grow_mesh
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.nodes import simulator
from biped_mfpt_ros.nodes.fan_out import Answers, FanOut, FanOutSettings, NoSimulatorError
from biped_mfpt_ros.nodes.messages import (
    MeshSettings,
    controller_message,
    model_message,
    packed,
    settings_from,
    settings_message,
    states_messages,
    transitions_messages,
)
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.publishers import CountedPublisher
from biped_mfpt_ros.nodes.qos import PROGRESS, RESULTS
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
    chunk_seconds: float = parameter(0.05, "s, work in a full request", 1e-3, 10.0)
    chunks_in_flight: int = parameter(2, "requests that each simulator has at once", 1, 100)
    progress_period: float = parameter(0.25, "s, between two progress messages", 0.05, 60.0)
    max_queued: int = parameter(
        16, "goals that may wait for their turn; further ones are rejected", 0, 1000
    )


class Cancelled(Exception):
    """The goal was cancelled, or the node stops."""


def warm_up() -> None:
    """Run the kernels of a mesh once, so that they are compiled."""
    simulator.warm_up()
    step = np.array([[Outcome.STEP]], dtype=np.uint8)
    answers = [Answers(step, np.ones((1, 10))), Answers(step + 1, np.empty((0, 10)))]
    grow_mesh(lambda states, slopes: answers.pop(0), np.zeros(10), [0.0], 1e-3)


def new_mesh_id(controller: str) -> str:
    """A name that no other mesh has: the controller's, the time (UTC), and a random number."""
    label = re.sub(r"[^A-Za-z0-9.]+", "-", controller)[:64].strip("-") or "mesh"
    return f"{label}-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(3)}"


class Mesher(Node):
    """Action server of `GrowMesh`.

    It grows one mesh at a time, which keeps all simulators busy. Further goals wait in the order
    in which they came: rejected ones would have to be sent again and again. A goal with bad
    settings is accepted and aborted, since a rejection cannot say why.

    A mesh grows in a thread of its own. The executor only takes requests and answers.
    """

    def __init__(self) -> None:
        super().__init__("mesher")
        self.declared = Declared(self, MesherParameters)
        with compiled(self.get_logger().info, "step map and mesh"):
            warm_up()
        self.info = CountedPublisher(self, MeshInfo, "mesh/info", RESULTS)
        self.states = CountedPublisher(self, MeshStates, "mesh/states", RESULTS)
        self.transitions = CountedPublisher(self, MeshTransitions, "mesh/transitions", RESULTS)
        self.progress = CountedPublisher(self, MeshProgress, "mesh/progress", PROGRESS)
        self.simulators = GraphSimulators(self)
        self.stopping = False
        self._busy = False
        self._waiting: deque[ServerGoalHandle[Any, Any, Any]] = deque()
        self._thread = ThreadPoolExecutor(1, "mesh")
        self._action = ActionServer(
            self,
            GrowMesh,
            "grow_mesh",
            self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )
        # One that is cancelled while it waits need not wait for its turn.
        self._timer = self.create_timer(0.2, self._remove_cancelled)
        self.get_logger().info(f"ready, with step map {STEP_MAP}")

    def close(self) -> None:
        """Stop the mesh that grows, if one does."""
        self.stopping = True
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._action.destroy()

    def _on_goal(self, goal: GrowMesh.Goal) -> GoalResponse:
        most = self.declared.now.max_queued
        if self._busy and len(self._waiting) >= most:
            self.get_logger().warning(f"rejected a goal: {most} are waiting already (max_queued)")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, goal: ServerGoalHandle[Any, Any, Any]) -> None:
        if self._busy:
            self._waiting.append(goal)
        else:
            self._busy = True
            goal.execute()

    def _remove_cancelled(self) -> None:
        for goal in [goal for goal in self._waiting if goal.is_cancel_requested]:
            self._waiting.remove(goal)
            goal.execute(_cancel_waiting)

    async def _execute(self, goal: ServerGoalHandle[Any, Any, Any]) -> GrowMesh.Result:
        done: Future[GrowMesh.Result] = Future()

        def finish(job: Any) -> None:
            done.set_result(job.result())
            if self.executor is not None:
                self.executor.wake()

        self._thread.submit(self._serve, goal).add_done_callback(finish)
        result = await done
        if self._waiting:
            self._waiting.popleft().execute()
        else:
            self._busy = False
        return result

    def _serve(self, goal: ServerGoalHandle[Any, Any, Any]) -> GrowMesh.Result:
        """Grow the mesh of a goal, in the thread of meshes. Whatever happens, there is a result."""
        result = GrowMesh.Result()
        try:
            settings = settings_from(goal.request.settings)
            growth = _Growth(self, goal, settings, result)
        except (InputError, NoLimitCycle) as error:
            result.message = str(error)
            self.get_logger().warning(f"aborted a goal: {error}")
            goal.abort()
            return result
        except Exception as error:
            return self._failed(goal, result, error)
        try:
            growth.run()
        except Exception as error:
            return self._failed(goal, result, error)
        return result

    def _failed(
        self, goal: ServerGoalHandle[Any, Any, Any], result: GrowMesh.Result, error: Exception
    ) -> GrowMesh.Result:
        if self.context.ok():  # else it only tells that nothing can be published any more
            self.get_logger().error(f"a mesh failed\n{traceback.format_exc()}")
            result.message = f"internal error of the mesher: {error!r}"
            goal.abort()
        return result


def _cancel_waiting(goal: ServerGoalHandle[Any, Any, Any]) -> GrowMesh.Result:
    goal.canceled()
    return GrowMesh.Result(message="cancelled before it began")


class _Growth:
    """The growth of one mesh: publishes it and reports to its goal.

    Raises
    ------
    NoLimitCycle
        If no initial state is given and there is none.
    """

    def __init__(
        self,
        node: Mesher,
        goal: ServerGoalHandle[Any, Any, Any],
        settings: MeshSettings,
        result: GrowMesh.Result,
    ) -> None:
        self._node = node
        self._goal = goal
        self._settings = settings
        self._result = result
        self._initial = settings.initial_state
        if self._initial is None:
            self._initial = find_limit_cycle(settings.controller, model=settings.model).state
        now = node.declared.now
        self._period = now.progress_period
        self._fan_out = FanOut(
            node.simulators,
            SimulateSteps.Request(
                step_map=STEP_MAP,
                controller=controller_message(settings.controller),
                model=model_message(settings.model),
                slopes=packed(settings.slopes, "d"),
            ),
            FanOutSettings(
                chunk_seconds=now.chunk_seconds,
                in_flight=now.chunks_in_flight,
                timeout=now.simulator_timeout,
                wait_seconds=now.simulator_wait_seconds,
            ),
            log=node.get_logger().warning,
            tick=self._tick,
        )
        self._mesh_id = new_mesh_id(settings.controller.name)
        self._start = time.monotonic()
        self._last_progress = self._start
        self._generation = 0
        self._states = 1

    def run(self) -> None:
        """Grow the mesh, publish it, and end the goal."""
        node, settings = self._node, self._settings
        self._publish_info(MeshInfo.GROWING)
        try:
            mesh = grow_mesh(
                self._fan_out,
                self._initial,
                settings.slopes,
                settings.threshold,
                initial_slope=settings.initial_slope,
                clustered=settings.clustered,
                scale_refresh=settings.scale_refresh,
                max_states=settings.max_states,
                on_generation=self._on_generation,
            )
            for message in transitions_messages(self._mesh_id, mesh.targets, mesh.outcomes):
                node.transitions.publish(message)
        except Cancelled:
            if node.context.ok():
                self._end(MeshInfo.CANCELLED, "cancelled")
            return
        except (InputError, MeshLimitError, NoSimulatorError) as error:
            self._end(MeshInfo.FAILED, str(error))
            return
        except Exception as error:
            if node.context.ok():
                self._publish_info(MeshInfo.FAILED, f"internal error of the mesher: {error!r}")
            raise
        finally:
            self._fan_out.close()
        self._end(MeshInfo.COMPLETE, mesh=mesh)

    def _end(self, status: int, message: str = "", mesh: Mesh | None = None) -> None:
        goal, result, tally = self._goal, self._result, self._fan_out.tally
        self._publish_progress()
        self._publish_info(status, message, mesh)
        result.success = status == MeshInfo.COMPLETE
        result.message = message
        result.mesh_id = self._mesh_id
        result.states = self._states
        result.generations = self._generation + 1
        result.swings = tally.swings
        result.chunks_repeated = tally.chunks_repeated
        result.seconds = time.monotonic() - self._start
        result.step_map_seconds = tally.step_map_seconds
        log = self._node.get_logger()
        if status == MeshInfo.COMPLETE:
            log.info(
                f"{self._mesh_id}: {self._states} states, {result.generations} generations, "
                f"{result.seconds:.3f} s, {tally.step_map_seconds:.3f} s in the step map, "
                f"{tally.chunks} requests, {tally.chunks_repeated} repeated"
            )
            goal.succeed()
        elif status == MeshInfo.CANCELLED and goal.is_cancel_requested:
            log.info(f"{self._mesh_id}: cancelled")
            goal.canceled()
        else:
            log.warning(f"{self._mesh_id}: {message}")
            goal.abort()

    def _on_generation(
        self, generation: int, first_index: int, states: np.ndarray, preceding: np.ndarray
    ) -> None:
        self._generation = generation
        self._states = first_index + len(states)
        for message in states_messages(self._mesh_id, generation, first_index, states, preceding):
            self._node.states.publish(message)

    def _tick(self) -> None:
        if self._node.stopping or not self._node.context.ok() or self._goal.is_cancel_requested:
            raise Cancelled
        if time.monotonic() - self._last_progress >= self._period:
            self._publish_progress()

    def _publish_progress(self) -> None:
        self._last_progress = time.monotonic()
        seconds = self._last_progress - self._start
        tally = self._fan_out.tally
        message = MeshProgress(
            mesh_id=self._mesh_id,
            generation=self._generation,
            states=self._states,
            frontier=tally.frontier,
            swings=tally.swings,
            simulators=self._fan_out.simulators,
            chunks_in_flight=self._fan_out.in_flight,
            chunks_repeated=tally.chunks_repeated,
            swings_per_second=tally.swings / seconds if seconds > 0.0 else 0.0,
            seconds=seconds,
        )
        self._node.progress.publish(message)
        self._goal.publish_feedback(GrowMesh.Feedback(progress=message))

    def _publish_info(self, status: int, message: str = "", mesh: Mesh | None = None) -> None:
        self._node.info.publish(
            MeshInfo(
                mesh_id=self._mesh_id,
                status=status,
                message=message,
                settings=settings_message(self._settings),
                step_map=STEP_MAP,
                states=self._states,
                generations=self._generation + 1,
                scales=packed(np.empty(0) if mesh is None else mesh.scales, "d"),
                seconds=time.monotonic() - self._start,
            )
        )


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_node(Mesher, args)
