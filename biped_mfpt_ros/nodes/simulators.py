"""The simulators on the ROS graph, found by the type of their service."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import Any

from biped_mfpt_msgs.srv import SimulateSteps
from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from biped_mfpt_ros.nodes.fair_service import client_name
from biped_mfpt_ros.nodes.qos import REQUESTS

SERVICE_TYPE = "biped_mfpt_msgs/srv/SimulateSteps"

_LOOK_PERIOD = 0.2  # s, between two looks at the graph


class Aside(CallbackGroup):
    """What is in here is left alone by the executor."""

    def can_execute(self, entity: Any) -> bool:
        """Never."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Never."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing to do."""


class GraphSimulators:
    """Clients of all simulators on the graph, made and removed as they come and go.

    Only simulators in the node's namespace, or below it, count. In the root namespace, that is all.

    Clients are made and destroyed on the node's executor. Answers are taken by the thread that
    waits for them: the way through the executor costs more than all else about a small request,
    since it looks at everything that the node has each time (`docs/scale.md`). So this waits as
    an executor does, on the clients alone.

    Parameters
    ----------
    node : rclpy.node.Node
        On which the clients are.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._name = client_name(node)
        self._group = Aside()
        self._woken = GuardCondition(None, None, context=node.context)
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

    def ask(self, name: str, request: SimulateSteps.Request) -> int:
        """Send a request; see `fan_out.Simulators`."""
        client = self._clients[name]
        request.client = self._name
        with client.handle:
            return int(client.handle.send_request(request))

    def answers(self, timeout: float) -> list[tuple[str, int, SimulateSteps.Response]]:
        """Wait for answers; see `fan_out.Simulators`."""
        answers = []
        with ExitStack() as stack:
            clients = []
            for name, client in list(self._clients.items()):
                with suppress(InvalidHandle):  # destroyed meanwhile
                    stack.enter_context(client.handle)
                    clients.append((name, client.handle))
            stack.enter_context(self._woken.handle)
            stack.enter_context(self._node.context.handle)
            wait_set = rclpy_implementation.WaitSet(
                0, 1, 0, len(clients), 0, 0, self._node.context.handle
            )
            wait_set.clear_entities()
            wait_set.add_guard_condition(self._woken.handle)
            for _, handle in clients:
                wait_set.add_client(handle)
            wait_set.wait(round(1e9 * timeout))
            ready = set(wait_set.get_ready_entities("client"))
            for name, handle in clients:
                if handle.pointer in ready:
                    header, response = handle.take_response(SimulateSteps.Response)
                    if header is not None:
                        answers.append((name, header.request_id.sequence_number, response))
        return answers

    def wake(self) -> None:
        """End the wait for answers; from any thread."""
        self._woken.trigger()

    def _look(self) -> None:
        here = self._node.get_namespace().rstrip("/") + "/"
        on_graph = {
            name
            for name, types in self._node.get_service_names_and_types()
            if SERVICE_TYPE in types and name.startswith(here)
        }
        before = self._ready
        for name in on_graph - self._clients.keys():
            self._clients[name] = self._node.create_client(
                SimulateSteps, name, qos_profile=REQUESTS, callback_group=self._group
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
        if self._ready != before:
            self.wake()
