"""The meshes that the mesher grows: from goals to messages."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import secrets
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshInfo, MeshProgress, MeshStates, MeshTransitions
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from biped_mfpt_ros.chain.journal import Journal, JournalInUse
from biped_mfpt_ros.chain.mesh import DEFAULT_MAX_STATES, Mesh, MeshGrowth, MeshLimitError
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import NoLimitCycle, find_limit_cycle
from biped_mfpt_ros.jit import KERNELS, STEP_MAP
from biped_mfpt_ros.nodes.fan_out import FanOut, FanOutSettings, Job, NoSimulatorError, Simulators
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
from biped_mfpt_ros.nodes.publishers import CountedPublisher
from biped_mfpt_ros.nodes.qos import PROGRESS, RESULTS

if TYPE_CHECKING:
    from biped_mfpt_ros.nodes.mesher import MesherParameters

_POLL = 0.05  # s, between two looks for goals that are cancelled, and at what simulators do


class Cancelled(Exception):
    """The goal was cancelled, or the node stops."""


def new_mesh_id(controller: str) -> str:
    """A name that no other mesh has: the controller's, the time (UTC), and a random number."""
    label = re.sub(r"[^A-Za-z0-9.]+", "-", controller)[:64].strip("-") or "mesh"
    return f"{label}-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(3)}"


def open_journal(settings: MeshSettings, directory: str) -> Journal:
    """Journal of a mesh, with what is there of it if it was begun before.

    Parameters
    ----------
    settings : MeshSettings
        Of the mesh, with the initial state.
    directory : str
        Where named journals are; made if missing. Empty: the journal gets no name.

    Raises
    ------
    OSError
        If it cannot be made, read or written.
    """
    m = len(settings.slopes)
    if not directory:
        return Journal(m)
    # Neither the label of the controller nor the limit changes an answer or a state.
    message = settings_message(dataclasses.replace(settings, max_states=DEFAULT_MAX_STATES))
    message.controller.name = ""
    # Not the bytes of the serialised message: what lies between its fields is random.
    identity = f"{STEP_MAP} {KERNELS} {message!r}".encode()
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return Journal(m, identity, folder / f"{hashlib.sha256(identity).hexdigest()[:32]}.journal")
    except JournalInUse:  # by an equal goal, which grows now
        return Journal(m)


class Meshes:
    """Grows the meshes of goals, all with the same simulators, and publishes them.

    One thread tests answers and hands out work for all meshes. What would keep the others waiting
    is done beside it: the search for a limit cycle before a mesh, and its targets at the end.

    Parameters
    ----------
    node : rclpy.node.Node
        Who publishes, and logs.
    simulators : Simulators
        Who can be asked.
    parameters : callable
        Tells the parameters as they are now.
    """

    def __init__(
        self, node: Node, simulators: Simulators, parameters: Callable[[], MesherParameters]
    ) -> None:
        self.node = node
        self.parameters = parameters
        self.info = CountedPublisher(node, MeshInfo, "mesh/info", RESULTS)
        self.states = CountedPublisher(node, MeshStates, "mesh/states", RESULTS)
        self.transitions = CountedPublisher(node, MeshTransitions, "mesh/transitions", RESULTS)
        self.progress = CountedPublisher(node, MeshProgress, "mesh/progress", PROGRESS)
        self._simulators = simulators
        self.fan_out = FanOut(simulators, self._settings(), node.get_logger().warning)
        self._stopping = False
        self._new: SimpleQueue[_Growing] = SimpleQueue()
        self._growing: list[_Growing] = []
        self._beside = ThreadPoolExecutor(2, "beside meshes")
        self._thread = threading.Thread(target=self._run, name="meshes")
        self._thread.start()

    def grow(
        self, goal: ServerGoalHandle[Any, Any, Any], done: Callable[[GrowMesh.Result], object]
    ) -> None:
        """Grow the mesh of a goal and end the goal; ``done`` is told the result, in any thread."""
        growing = _Growing(self, goal, done)
        self._beside.submit(growing.guarded, self._prepare, growing)

    def close(self) -> None:
        """Stop all meshes."""
        self._stopping = True
        self._simulators.wake()
        self._thread.join()
        self._beside.shutdown(wait=True, cancel_futures=True)

    def _settings(self) -> FanOutSettings:
        now = self.parameters()
        return FanOutSettings(
            chunk_seconds=now.chunk_seconds,
            in_flight=now.chunks_in_flight,
            timeout=now.simulator_timeout,
            wait_seconds=now.simulator_wait_seconds,
        )

    def _prepare(self, growing: _Growing) -> None:
        growing.prepare()
        self._new.put(growing)
        self._simulators.wake()

    def _run(self) -> None:
        looked = time.monotonic()
        while not self._stopping and self.node.context.ok():
            self._begin_new()
            try:
                self.fan_out.step(_POLL)
            except Exception as error:
                for growing in self._growing:
                    growing.job.error = growing.job.error or error
            now = time.monotonic()
            look = now - looked >= _POLL
            if look:
                looked = now
                self.fan_out.settings = self._settings()
            for growing in list(self._growing):
                if growing.guarded(growing.go_on, look):
                    continue
                self._growing.remove(growing)
                self.fan_out.remove(growing.job)
                if growing.growth.complete and not growing.ended:
                    self._beside.submit(growing.guarded, growing.finish)
        self._begin_new()
        for growing in self._growing:
            growing.guarded(growing.cancel)

    def _begin_new(self) -> None:
        while True:
            try:
                growing = self._new.get_nowait()
            except Empty:
                return
            self._growing.append(growing)
            self.fan_out.add(growing.job)


class _Growing:
    """The mesh of a goal."""

    growth: MeshGrowth
    job: Job
    _settings: MeshSettings
    _journal: Journal | None = None

    def __init__(
        self,
        meshes: Meshes,
        goal: ServerGoalHandle[Any, Any, Any],
        done: Callable[[GrowMesh.Result], object],
    ) -> None:
        self._meshes = meshes
        self._goal = goal
        self._done = done
        self._mesh_id = ""
        self._published = 0
        self.ended = False

    def guarded(self, do: Callable[..., Any], *args: Any) -> Any:
        """Do something; whatever it raises ends the goal, and None comes back then."""
        try:
            try:
                return do(*args)
            except Cancelled:
                self._end(
                    MeshInfo.CANCELLED, "cancelled", resumable=not self._goal.is_cancel_requested
                )
            except NoSimulatorError as error:
                self._end(MeshInfo.FAILED, str(error), resumable=True)
            except OSError as error:
                self._end(MeshInfo.FAILED, f"the mesh could not be kept: {error}", resumable=True)
            except (InputError, NoLimitCycle, MeshLimitError) as error:
                self._end(MeshInfo.FAILED, str(error))
            except Exception as error:
                # It need not be the mesh's fault: nothing can be published once the node stops.
                self._log_error("a mesh failed", error)
                message = f"internal error of the mesher: {error!r}"
                self._end(MeshInfo.FAILED, message, resumable=True)
        except Exception as error:
            # The other meshes go on.
            self.ended = True
            if self._journal is not None:
                self._journal.close()
            self._log_error("the end of a mesh could not be told", error)
            if self._meshes.node.context.ok():
                # Who waits for the goal is told at least that.
                with suppress(Exception):  # it may have ended
                    self._goal.abort()
                self._done(GrowMesh.Result(message=f"internal error of the mesher: {error!r}"))
        return None

    def _log_error(self, what: str, error: Exception) -> None:
        # When the context has ended, it only tells that nothing can be published any more.
        if self._meshes.node.context.ok():
            trace = "".join(traceback.format_exception(error))
            self._meshes.node.get_logger().error(f"{what}\n{trace}")

    def prepare(self) -> None:
        """Check the settings, find the initial state, and open the mesh."""
        self._start = self._last_progress = time.monotonic()
        settings = self._settings = settings_from(self._goal.request.settings)
        initial = settings.initial_state
        if initial is None:
            initial = find_limit_cycle(settings.controller, model=settings.model).state
        settings = dataclasses.replace(settings, initial_state=initial)
        directory = self._meshes.parameters().checkpoint_directory
        self._journal = open_journal(settings, directory)
        growth = self.growth = MeshGrowth(
            initial,
            settings.slopes,
            settings.threshold,
            initial_slope=settings.initial_slope,
            clustered=settings.clustered,
            scale_refresh=settings.scale_refresh,
            max_states=settings.max_states,
            answers=self._journal,
        )
        if growth.resumed:
            self._meshes.node.get_logger().info(
                f"resuming a mesh of {settings.controller.name}: {growth.resumed} states are there"
            )
        self.job = Job(
            growth,
            SimulateSteps.Request(
                step_map=STEP_MAP,
                controller=controller_message(settings.controller),
                model=model_message(settings.model),
                slopes=packed(settings.slopes, "d"),
            ),
        )
        self._mesh_id = new_mesh_id(settings.controller.name)
        self._publish_info(MeshInfo.GROWING)

    def go_on(self, look: bool) -> bool:
        """Publish what is new. Returns whether the mesh still grows."""
        job = self.job
        if job.error is not None:
            raise job.error
        while self._published < self.growth.generations:
            first, states, preceding = self.growth.generation(self._published)
            for message in states_messages(
                self._mesh_id, self._published, first, states, preceding
            ):
                self._meshes.states.publish(message)
            self._published += 1
        if look:
            if self._goal.is_cancel_requested:
                raise Cancelled
            if time.monotonic() - self._last_progress >= self._meshes.parameters().progress_period:
                self._publish_progress()
        return not self.growth.complete

    def cancel(self) -> None:
        """End the growth."""
        raise Cancelled

    def finish(self) -> None:
        """Compute the targets, publish them, and close the mesh."""
        mesh = self.growth.mesh()
        for message in transitions_messages(self._mesh_id, mesh.targets, mesh.outcomes):
            self._meshes.transitions.publish(message)
        self._end(MeshInfo.COMPLETE, mesh=mesh)

    def _end(
        self, status: int, message: str = "", mesh: Mesh | None = None, *, resumable: bool = False
    ) -> None:
        self.ended = True
        if not self._meshes.node.context.ok():
            if self._journal is not None:
                self._journal.close()
            return
        result = GrowMesh.Result(success=status == MeshInfo.COMPLETE, message=message)
        if self._mesh_id:
            self._publish_progress()
            self._publish_info(status, message, mesh)
            growth, tally = self.growth, self.job.tally
            result.mesh_id = self._mesh_id
            result.states = growth.known
            result.generations = growth.generations
            result.swings = tally.swings
            result.swings_resumed = growth.resumed
            result.chunks_repeated = tally.chunks_repeated
            result.seconds = time.monotonic() - self._start
            result.step_map_seconds = tally.step_map_seconds
        # Only now, since a mesh that nobody was told of would have to be grown again.
        if self._journal is not None:
            self._journal.close(remove=not resumable)
        log = self._meshes.node.get_logger()
        if status == MeshInfo.COMPLETE:
            log.info(
                f"{self._mesh_id}: {result.states} states, {result.generations} generations, "
                f"{result.seconds:.3f} s, {result.step_map_seconds:.3f} s in the step map, "
                f"{tally.chunks} requests, {tally.chunks_repeated} repeated"
            )
            self._goal.succeed()
        elif status == MeshInfo.CANCELLED and self._goal.is_cancel_requested:
            log.info(f"{self._mesh_id}: cancelled")
            self._goal.canceled()
        else:
            log.warning(f"{self._mesh_id or 'a goal'}: {message}")
            self._goal.abort()
        self._done(result)

    def _publish_progress(self) -> None:
        self._last_progress = time.monotonic()
        seconds = self._last_progress - self._start
        job, fan_out = self.job, self._meshes.fan_out
        message = MeshProgress(
            mesh_id=self._mesh_id,
            generation=max(0, self._published - 1),  # a mesh may fail before its first is out
            states=self.growth.known,
            frontier=job.frontier,
            swings=job.tally.swings,
            swings_resumed=self.growth.resumed,
            simulators=fan_out.simulators,
            chunks_in_flight=fan_out.in_flight(job),
            chunks_repeated=job.tally.chunks_repeated,
            swings_per_second=job.tally.swings / seconds if seconds > 0.0 else 0.0,
            seconds=seconds,
        )
        self._meshes.progress.publish(message)
        self._goal.publish_feedback(GrowMesh.Feedback(progress=message))

    def _publish_info(self, status: int, message: str = "", mesh: Mesh | None = None) -> None:
        self._meshes.info.publish(
            MeshInfo(
                mesh_id=self._mesh_id,
                status=status,
                message=message,
                settings=settings_message(self._settings),
                step_map=STEP_MAP,
                states=self.growth.known,
                generations=self.growth.generations,
                scales=packed(np.empty(0) if mesh is None else mesh.scales, "d"),
                seconds=time.monotonic() - self._start,
            )
        )
