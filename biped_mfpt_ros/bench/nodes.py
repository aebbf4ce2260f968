"""Nodes in processes of their own, and a client of the mesher, for benchmarks and soak runs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshInfo, MeshStates, MeshTransitions
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from unique_identifier_msgs.msg import UUID

from biped_mfpt_ros.chain.mesh import Mesh
from biped_mfpt_ros.nodes.answers import Answer
from biped_mfpt_ros.nodes.assembly import MeshAssembly
from biped_mfpt_ros.nodes.messages import MeshSettings, settings_message
from biped_mfpt_ros.nodes.qos import RESULTS
from biped_mfpt_ros.nodes.simulators import SERVICE_TYPE
from biped_mfpt_ros.nodes.spin import prepare_environment


class Nodes:
    """Nodes in a namespace of their own, and a client; use it as a context manager.

    Parameters
    ----------
    listen : bool, optional
        Whether the client puts the meshes together that are published.
    """

    def __init__(self, listen: bool = False) -> None:
        prepare_environment()
        self.namespace = f"/bench_{os.getpid()}_{time.monotonic_ns() % 1_000_000}"
        self._directory = tempfile.TemporaryDirectory(prefix="biped_mfpt_bench_")
        self.directory = Path(self._directory.name)
        self._processes: list[subprocess.Popen[bytes]] = []
        self._context = Context()
        # The level is the whole process's, which may go on to other things.
        self._log_level = get_logger_level("")
        rclpy.init(
            args=["--ros-args", "--disable-external-lib-logs", "--log-level", "error"],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node("client", namespace=self.namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._grow = ActionClient(self.node, GrowMesh, "grow_mesh")
        self._meshes: dict[str, MeshAssembly] = {}
        if listen:
            for kind, topic, add in (
                (MeshInfo, "mesh/info", MeshAssembly.add_info),
                (MeshStates, "mesh/states", MeshAssembly.add_states),
                (MeshTransitions, "mesh/transitions", MeshAssembly.add_transitions),
            ):
                self.node.create_subscription(kind, topic, self._adder(add), RESULTS)

    def _adder(self, add: Callable[[MeshAssembly, Any], None]) -> Callable[[Any], None]:
        def receive(message: Any) -> None:
            mesh_id = message.mesh_id
            add(self._meshes.setdefault(mesh_id, MeshAssembly(mesh_id)), message)

        return receive

    def __enter__(self) -> Nodes:
        """Nothing to do."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Kill all nodes and leave the graph."""
        for process in self._processes:
            end(process, signal.SIGKILL)
        self._executor.shutdown(timeout_sec=0.0)
        self._grow.destroy()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        set_logger_level("", self._log_level)
        self._directory.cleanup()

    def start(
        self, executable: str, name: str, command: Sequence[str] | None = None, **parameters: object
    ) -> subprocess.Popen[bytes]:
        """Start a node under a name; its output goes to ``directory/NAME.log``."""
        if command is None:
            command = [
                sys.executable, "-m", "biped_mfpt_ros.cli", "node",
                "--end-with", str(os.getpid()), executable,
            ]  # fmt: skip
        arguments = ["--ros-args", "-r", f"__ns:={self.namespace}", "-r", f"__node:={name}"]
        arguments += ["--disable-external-lib-logs"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={value}"]
        with (self.directory / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [*command, *arguments], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self._processes.append(process)
        return process

    def simulators(self) -> set[str]:
        """Names of the services of simulators on the graph."""
        return {
            name
            for name, types in self.node.get_service_names_and_types()
            if SERVICE_TYPE in types and name.startswith(self.namespace)
        }

    def names(self) -> list[str]:
        """Names of the nodes on the graph."""
        return self.node.get_node_names()

    def spin(self, until: Callable[[], object], timeout: float, what: str) -> None:
        """Take messages until something holds; TimeoutError after ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        while not until():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {timeout:g} s for {what}")
            self._executor.spin_once(timeout_sec=0.05)

    def wait(self, simulators: int, timeout: float = 300.0) -> None:
        """Wait for the mesher and at least that many simulators."""
        self.spin(
            lambda: self._grow.server_is_ready() and len(self.simulators()) >= simulators,
            timeout,
            "the nodes to come up",
        )
        # A goal may be lost until the mesher has found this client, and then it answers: here, that
        # it has no such goal. The client of results is the last that an action client makes.
        none = ClientGoalHandle(
            self._grow, UUID(uuid=[1] * 16), GrowMesh.Impl.SendGoalService.Response()
        )
        self.spin(Answer(none.get_result_async).done, timeout, "an answer of the mesher")

    def spin_once(self, timeout: float) -> None:
        """Take what comes within a time, s."""
        self._executor.spin_once(timeout_sec=timeout)

    def send(
        self,
        settings: MeshSettings,
        done: Callable[[GrowMesh.Result], object],
        begun: Callable[[], object] = lambda: None,
    ) -> None:
        """Send a goal; ``begun`` is called when it is accepted, ``done`` is told its result."""
        goal = GrowMesh.Goal(settings=settings_message(settings))

        def accepted(future: Any) -> None:
            if future.result().accepted:
                begun()
                future.result().get_result_async().add_done_callback(
                    lambda ended: done(ended.result().result)
                )

        self._grow.send_goal_async(goal).add_done_callback(accepted)

    def grow(
        self, settings: MeshSettings, total: int = 1, in_flight: int = 1, timeout: float = 600.0
    ) -> list[GrowMesh.Result]:
        """Results of ``total`` equal goals, some at a time; RuntimeError if one fails."""
        results: list[GrowMesh.Result] = []
        sent = 0

        def done(result: GrowMesh.Result) -> None:
            results.append(result)
            more()

        def more() -> None:
            nonlocal sent
            if sent < total:
                sent += 1
                self.send(settings, done)

        for _ in range(in_flight):
            more()
        self.spin(lambda: len(results) == total, timeout, f"{total} meshes")
        for result in results:
            if not result.success:
                raise RuntimeError(f"a mesh failed: {result.message}")
        return results

    def mesh(self, mesh_id: str) -> Mesh:
        """A mesh as it was published; forgotten then."""
        self.spin(lambda: mesh_id in self._meshes and self._meshes[mesh_id].complete, 60.0, mesh_id)
        return self._meshes.pop(mesh_id).mesh()


def end(process: subprocess.Popen[bytes], how: int) -> None:
    """Send a signal that ends a process, and wait for the end."""
    with suppress(ProcessLookupError):
        process.send_signal(how)
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def cpu_seconds(process: subprocess.Popen[bytes]) -> float:
    """CPU time that a process has used, s."""
    # The clock of a process, as clock_getcpuclockid(3) makes it on Linux: to the nanosecond.
    return time.clock_gettime((~process.pid << 3) | 2)


def held(pid: int) -> dict[str, int]:
    """What a process has now: ``kilobytes`` of memory, open ``files``, ``threads``."""
    process = Path("/proc", str(pid))
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    return {
        "kilobytes": int(status["VmRSS"].split()[0]),
        "files": len(list((process / "fd").iterdir())),
        "threads": int(status["Threads"]),
    }


def peak_bytes(process: subprocess.Popen[bytes]) -> int:
    """Largest memory that a process has had at once (VmHWM), bytes."""
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return 0
