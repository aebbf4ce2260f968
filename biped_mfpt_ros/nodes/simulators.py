"""The simulators on the ROS graph, found by the type of their service."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from biped_mfpt_ros.nodes.qos import REQUESTS

SERVICE_TYPE = "biped_mfpt_msgs/srv/SimulateSteps"

_LOOK_PERIOD = 0.2  # s, between two looks at the graph


class GraphSimulators:
    """Clients of all simulators on the graph, made and removed as they come and go.

    Only simulators in the node's namespace, or below it, count. In the root namespace, that is all.

    Clients are made and destroyed on the node's executor; everything else may be called from any
    thread.

    Parameters
    ----------
    node : rclpy.node.Node
        On whose executor answers come.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[str, Client[Any, Any]] = {}
        self._ready: frozenset[str] = frozenset()
        self._dropped: dict[str, str] = {}
        # The graph has no event that rclpy would pass on.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_LOOK_PERIOD, self._look, clock=steady)

    def found(self) -> frozenset[str]:
        """Names of the services that can be asked now, without the dropped ones."""
        return self._ready

    @property
    def dropped(self) -> Mapping[str, str]:
        """Reasons, by the names of the simulators that were dropped."""
        return self._dropped

    def drop(self, name: str, reason: str) -> None:
        """Leave a simulator out until it has gone from the graph."""
        self._dropped[name] = reason
        self._ready -= {name}

    def ask(
        self,
        name: str,
        request: SimulateSteps.Request,
        answer: Callable[[SimulateSteps.Response], None],
    ) -> Callable[[], None]:
        """Send a request; see `fan_out.Simulators`."""
        client = self._clients[name]
        future = client.call_async(request)
        future.add_done_callback(lambda done: answer(done.result()))
        return lambda: client.remove_pending_request(future)

    def _look(self) -> None:
        here = self._node.get_namespace().rstrip("/") + "/"
        on_graph = {
            name
            for name, types in self._node.get_service_names_and_types()
            if SERVICE_TYPE in types and name.startswith(here)
        }
        for name in on_graph - self._clients.keys():
            self._clients[name] = self._node.create_client(
                SimulateSteps, name, qos_profile=REQUESTS
            )
        for name in self._clients.keys() - on_graph:
            self._dropped.pop(name, None)
            self._node.destroy_client(self._clients.pop(name))
        # A service may be on the graph before its endpoints are matched: then answers get lost.
        self._ready = frozenset(
            name
            for name, client in self._clients.items()
            if name not in self._dropped and client.service_is_ready()
        )
