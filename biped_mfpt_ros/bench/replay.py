"""Many simulators in one process that compute nothing: they look answers up, after a set time.

Started by `biped_mfpt_ros.bench.scale`, to see what a mesher can do with more simulators than
there are cores. Each takes its requests one after the other, as a simulator does.
"""

from __future__ import annotations

import heapq
import sys
import time
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
import rclpy
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from biped_mfpt_ros.nodes.messages import packed, unpacked_rows
from biped_mfpt_ros.nodes.qos import REQUESTS
from biped_mfpt_ros.nodes.simulators import Aside
from biped_mfpt_ros.nodes.spin import keep_freed_memory, prepare_environment
from biped_mfpt_ros.walker.robot import STATE_SIZE


class Answers:
    """Answers by state.

    Parameters
    ----------
    path : str
        An .npz file: ``states`` (n, 10), ``outcomes`` (n, m), ``successors`` (k, 10).
    """

    def __init__(self, path: str) -> None:
        with np.load(path) as data:
            self._outcomes, self._successors = data["outcomes"], data["successors"]
            self._rows = {state.tobytes(): i for i, state in enumerate(data["states"])}
        self._ends = np.cumsum(np.count_nonzero(self._outcomes == 0, axis=1))

    def response(self, request: SimulateSteps.Request, seconds: float) -> SimulateSteps.Response:
        """The answer that a simulator would give, said to have taken so many seconds."""
        states = unpacked_rows(request.states, "d", STATE_SIZE, "states")
        rows = [self._rows[state.tobytes()] for state in states]
        successors = [self._successors[self._ends[i - 1] if i else 0 : self._ends[i]] for i in rows]
        return SimulateSteps.Response(
            success=True,
            step_map=request.step_map,
            outcomes=packed(self._outcomes[rows], "B"),
            next_states=packed(np.concatenate(successors), "d"),
            seconds=seconds,
        )


def serve(node: Node, services: int, swing_seconds: float, answers: Answers) -> None:
    """Serve until the context ends."""
    group = Aside()
    handles = [
        node.create_service(
            SimulateSteps,
            f"~/simulator_{i}/simulate_steps",
            lambda request, response: response,
            qos_profile=REQUESTS,
            callback_group=group,
        ).handle
        for i in range(services)
    ]
    free = [0.0] * services
    due: list[tuple[float, int, int, Any, SimulateSteps.Response]] = []
    count = 0
    with ExitStack() as stack:
        for handle in handles:
            stack.enter_context(handle)
        while node.context.ok():
            wait_set = rclpy_implementation.WaitSet(0, 0, 0, 0, services, 0, node.context.handle)
            wait_set.clear_entities()
            for handle in handles:
                wait_set.add_service(handle)
            left = due[0][0] - time.monotonic() if due else 0.1
            wait_set.wait(max(0, round(1e9 * left)))
            ready = set(wait_set.get_ready_entities("service"))
            for i, handle in enumerate(handles):
                if handle.pointer in ready:
                    request, header = handle.service_take_request(SimulateSteps.Request)
                    if request is None:
                        continue
                    seconds = swing_seconds * len(request.previous_slopes)
                    free[i] = max(free[i], time.monotonic()) + seconds
                    count += 1
                    entry = (free[i], count, i, header, answers.response(request, seconds))
                    heapq.heappush(due, entry)
            while due and due[0][0] <= time.monotonic():
                _, _, i, header, response = heapq.heappop(due)
                handles[i].service_send_response(response, header.request_id)


def main() -> None:
    """Run with: file of answers, number of services, seconds a swing, and ROS arguments."""
    path, services, swing_seconds = sys.argv[1:4]
    answers = Answers(path)
    prepare_environment()
    keep_freed_memory()
    rclpy.init(args=sys.argv[4:])
    with suppress(KeyboardInterrupt):
        serve(Node("replay"), int(services), float(swing_seconds), answers)


if __name__ == "__main__":
    main()
