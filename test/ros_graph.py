"""A ROS graph for tests: isolated from all others, and gone afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress

import rclpy
from biped_mfpt_msgs.action import GrowMesh
from biped_mfpt_msgs.msg import MeshInfo, MeshStates, MeshTransitions
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from biped_mfpt_ros.nodes.answers import ActionClient, Answer, accepted
from biped_mfpt_ros.nodes.assembly import MeshAssembly
from biped_mfpt_ros.nodes.messages import settings_message
from biped_mfpt_ros.nodes.qos import REQUESTS, RESULTS

# Test runs side by side do not see each other. Above 101 ports may be taken by others.
DOMAIN = 1 + os.getpid() % 100


PATIENCE = 600.0
"""s, for what has to happen: nodes may have to compile first, several of them on a busy machine."""


def wait_for(condition, what, timeout=PATIENCE):
    """Wait until a condition is true, and return what it says."""
    deadline = time.monotonic() + timeout
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited {timeout} s for {what}"
        time.sleep(0.005)
    return found


class Graph:
    """Nodes in this process, each spun by a thread of its own, and nodes in processes."""

    def __init__(self):
        self.processes = []
        self._nodes = []

    def start(self, make, **parameters):
        """Make a node and spin it."""
        node = make()
        results = node.set_parameters([Parameter(k, value=v) for k, v in parameters.items()])
        assert all(result.successful for result in results), results
        executor = SingleThreadedExecutor()
        executor.add_node(node)

        def spin():
            with suppress(ExternalShutdownException):
                executor.spin()

        thread = threading.Thread(target=spin)
        thread.start()
        self._nodes.append((node, executor, thread))
        return node

    def stop(self, node):
        """Stop one of the nodes in this process."""
        entry = next(entry for entry in self._nodes if entry[0] is node)
        self._nodes.remove(entry)
        _, executor, thread = entry
        executor.shutdown()
        thread.join()
        if hasattr(node, "close"):
            node.close()
        node.destroy_node()

    def launch(self, name, *arguments, **environment):
        """Start a node in a process of its own."""
        code = f"import sys; from biped_mfpt_ros.nodes.{name} import main; sys.exit(main())"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), **environment},
            stderr=subprocess.PIPE,
            text=True,
        )
        self.processes.append(process)
        return process

    def close(self):
        for node, _, _ in reversed(list(self._nodes)):
            self.stop(node)
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.communicate()


@contextmanager
def ros_graph():
    before = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    rclpy.init(domain_id=DOMAIN, signal_handler_options=SignalHandlerOptions.NO)
    graph = Graph()
    try:
        yield graph
    finally:
        graph.close()
        rclpy.shutdown()
        if before is None:
            del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]


def result_of(answer, timeout=PATIENCE):
    """What a future, or an `Answer`, brings."""
    wait_for(answer.done, "an answer", timeout)
    return answer.result()


def asked(client, request):
    """What a service answers. Asked again: answers are lost until it has found its client."""
    futures = []
    while len(futures) < PATIENCE / 10.0:
        futures.append(client.call_async(request))
        with suppress(AssertionError):
            return wait_for(
                lambda: next((f for f in futures if f.done()), None), "an answer", 10.0
            ).result()
    raise AssertionError(f"no answer to {len(futures)} requests")


def goal_handle(send):
    """Handle of a goal that is sent; ``ended`` of an accepted one brings its result.

    That is asked for at once, since rclpy keeps it for 10 s only.
    """
    handle = result_of(accepted(send))
    handle.ended = Answer(handle.get_result_async) if handle.accepted else None
    return handle


def cancel(handle):
    """Have a goal cancelled."""
    return result_of(Answer(handle.cancel_goal_async))


class Client(Node):
    """Client of everything, and listener to the topics of the mesh."""

    def __init__(self):
        super().__init__("tester")
        self.meshes = {}
        self.infos = []
        self._grow = ActionClient(self, GrowMesh, "grow_mesh")
        for kind, topic, add in (
            (MeshInfo, "mesh/info", MeshAssembly.add_info),
            (MeshStates, "mesh/states", MeshAssembly.add_states),
            (MeshTransitions, "mesh/transitions", MeshAssembly.add_transitions),
        ):
            self.create_subscription(kind, topic, self._adder(add), RESULTS)

    def _adder(self, add):
        def receive(message):
            if add is MeshAssembly.add_info:
                self.infos.append(message)
            mesh_id = message.mesh_id
            add(self.meshes.setdefault(mesh_id, MeshAssembly(mesh_id)), message)

        return receive

    def close(self):
        self._grow.destroy()

    def simulators(self):
        return {
            name
            for name, types in self.get_service_names_and_types()
            if "biped_mfpt_msgs/srv/SimulateSteps" in types
        }

    def service(self, kind, name):
        """Function that calls a service."""
        client = self.create_client(kind, name, qos_profile=REQUESTS)
        wait_for(client.service_is_ready, name)
        return lambda request: asked(client, request)

    def simulator(self):
        """Function that asks the only simulator."""
        (name,) = wait_for(self.simulators, "a simulator")
        return self.service(SimulateSteps, name)

    def wait_for_mesher(self):
        wait_for(self._grow.server_is_ready, "grow_mesh")

    def send_goal(self, settings, feedback=None):
        """Handle of a goal; `settings` may be a message that is wrong."""
        if not hasattr(settings, "get_fields_and_field_types"):
            settings = settings_message(settings)
        self.wait_for_mesher()
        goal = GrowMesh.Goal(settings=settings)
        callback = None if feedback is None else lambda m: feedback(m.feedback.progress)
        return goal_handle(lambda: self._grow.send_goal_async(goal, feedback_callback=callback))

    def send_goal_to(self, mesher, settings):
        """Handle of a goal for a mesher by the name of its node.

        One that was killed before is on the graph for some time, so that being ready means little.
        """

        def reached():
            announced = self.get_publishers_info_by_topic("/grow_mesh/_action/status")
            return any(i.node_name == mesher for i in announced) and self._grow.server_is_ready()

        wait_for(reached, mesher)
        return self.send_goal(settings)

    def grow(self, settings, feedback=None):
        """Status and result of a goal."""
        handle = self.send_goal(settings, feedback)
        assert handle.accepted
        return self.outcome(handle)

    def outcome(self, handle, timeout=PATIENCE):
        answer = result_of(handle.ended, timeout)
        return answer.status, answer.result

    def mesh(self, mesh_id):
        """Mesh as it was published."""
        wait_for(lambda: mesh_id in self.meshes and self.meshes[mesh_id].complete, mesh_id)
        return self.meshes[mesh_id].mesh()
