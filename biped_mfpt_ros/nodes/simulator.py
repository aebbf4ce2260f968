"""The simulator: serves batches of single steps. Run as many of them as there are cores."""

from __future__ import annotations

import os
import re
import socket
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.node import Node

from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.jit import STEP_MAP
from biped_mfpt_ros.nodes.fair_service import FairService
from biped_mfpt_ros.nodes.messages import fill_response, steps_request_from
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.spin import run_node
from biped_mfpt_ros.nodes.warm_up import compiled

MOST_WAITING = 64
"""Requests that wait. A mesher has two at once; a request may have some 0.4 MB, and take 0.4 s."""


@dataclass(frozen=True)
class SimulatorParameters(NodeParameters):
    """Parameters of the simulator."""

    max_states: int = parameter(4096, "most states in one request", 1, 1_000_000)
    max_outcomes: int = parameter(
        1_000_000, "most outcomes (states times slopes) in one request", 1, 100_000_000
    )
    # 4096 swings of the paper's HZD gaits take up to 1.7 million, of its sliding-mode ones 4 to 15
    # million, and a swing that crawls half a million.
    max_evaluations: int = parameter(
        4_000_000,
        "evaluations of the closed loop (0.1 us each), after which a request is answered for the "
        "states simulated until then, at least one",
        1,
        1_000_000_000_000,
    )


def default_name() -> str:
    """A node name that no other simulator has, on this host or another."""
    return re.sub(r"\W", "_", f"simulator_{socket.gethostname()}_{os.getpid()}", flags=re.ASCII)


def warm_up() -> None:
    """Run the step map once, so that it is compiled."""
    simulate_steps(controller("hzd/base"), np.zeros((1, 10)), [0.0], [0.0])


class Simulator(Node):
    """Serves `SimulateSteps`: a pure function of the request, one request at a time.

    Clients are served in turn, so that none has to wait for all that another asks; see
    `FairService`.
    """

    def __init__(self, name: str | None = None, **options: Any) -> None:
        super().__init__(name or default_name(), **options)
        self._declared = Declared(self, SimulatorParameters)
        # Only then is the service there to be found: who sees a simulator can use it.
        with compiled(self.get_logger().info, "the step map"):
            warm_up()
        self._thread = ThreadPoolExecutor(1, "step map")
        FairService(
            self, SimulateSteps, "~/simulate_steps", MOST_WAITING, self._thread, self._simulate
        )
        self.get_logger().info(f"ready, with step map {STEP_MAP}")

    def close(self) -> None:
        """Stop simulating, after the request that is computed."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _simulate(
        self, request: SimulateSteps.Request, response: SimulateSteps.Response
    ) -> SimulateSteps.Response:
        response.step_map = STEP_MAP
        try:
            if request.step_map not in ("", STEP_MAP):
                raise InputError(
                    "step_map", request.step_map, f"{STEP_MAP}, this simulator's, or empty"
                )
            limits = self._declared.now
            asked = steps_request_from(request, limits.max_states, limits.max_outcomes)
            steps = simulate_steps(
                asked.controller,
                asked.states,
                asked.previous_slopes,
                asked.slopes,
                asked.model,
                limits.max_evaluations,
                request.measures,
            )
            fill_response(response, steps)
        except InputError as error:
            response.message = str(error)
            self.get_logger().warning(f"refused a request: {error}", throttle_duration_sec=1.0)
        except Exception as error:
            # Whatever a request brings to light must not end the node.
            response = SimulateSteps.Response(step_map=STEP_MAP)
            response.message = f"internal error of the simulator: {error!r}"
            self.get_logger().error(f"a request failed\n{traceback.format_exc()}")
        return response


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_node(Simulator, args)
