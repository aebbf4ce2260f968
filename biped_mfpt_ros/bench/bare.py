"""What rclpy alone costs: requests and answers as many and as large as a mesh's, and no mesh.

Run as a program it is a service that gives the same answer to every request. `Bare` asks it.
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress

import numpy as np
import rclpy
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from biped_mfpt_ros.bench.nodes import Nodes, cpu_seconds
from biped_mfpt_ros.nodes.messages import packed
from biped_mfpt_ros.nodes.qos import REQUESTS
from biped_mfpt_ros.nodes.simulators import GraphSimulators
from biped_mfpt_ros.nodes.spin import keep_freed_memory, prepare_environment
from biped_mfpt_ros.walker.robot import STATE_SIZE

_IN_FLIGHT = 2  # as the mesher has by default


class Bare:
    """A service of canned answers in a process of its own, and a client in this one.

    The client takes answers as the mesher does, which is the cheapest way that is known. Have
    `keep_freed_memory` called before, as in the nodes.

    Parameters
    ----------
    nodes : Nodes
        Where the service and the client are; without a mesher, which would take it for a simulator.
    states : int
        In a request.
    slopes : int
        In a request.
    successes : int
        Successful steps in an answer.
    """

    def __init__(self, nodes: Nodes, states: int, slopes: int, successes: int) -> None:
        command = [sys.executable, "-m", __name__, *map(str, (states, slopes, successes))]
        self._service = nodes.start("bare", "bare", command)
        self._client = GraphSimulators(nodes.node)
        self._request = SimulateSteps.Request(
            slopes=packed(np.zeros(slopes), "d"),
            states=packed(np.zeros(states * STATE_SIZE), "d"),
            previous_slopes=packed(np.zeros(states), "d"),
        )
        nodes.spin(self._client.found, 60.0, "a bare service")

    def call(self, calls: int) -> float:
        """CPU time of that many calls, both sides together, s."""
        (name,) = self._client.found()
        before = time.process_time() + cpu_seconds(self._service)
        asked = answered = 0
        while answered < calls:
            while asked < min(calls, answered + _IN_FLIGHT):
                self._client.ask(name, self._request)
                asked += 1
            answered += len(self._client.answers(1.0))
        return time.process_time() + cpu_seconds(self._service) - before


def main() -> None:
    """Run with: states and slopes of a request, successful steps, and ROS arguments."""
    states, slopes, successes = map(int, sys.argv[1:4])
    answer = SimulateSteps.Response(
        success=True,
        outcomes=packed(np.zeros(states * slopes), "B"),
        next_states=packed(np.zeros(successes * STATE_SIZE), "d"),
    )
    prepare_environment()
    keep_freed_memory()
    rclpy.init(args=sys.argv[4:])
    node = Node("bare")
    node.create_service(
        SimulateSteps,
        "~/simulate_steps",
        lambda request, response: answer,
        qos_profile=REQUESTS,
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    main()
