"""Publishing with what every message on our topics carries."""

from __future__ import annotations

import threading
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from biped_mfpt_ros.nodes.messages import stamp


class CountedPublisher:
    """Publisher that numbers its messages from 0 and stamps them; for any thread.

    Parameters
    ----------
    node : rclpy.node.Node
        Who publishes.
    kind : type
        Message with the fields ``sequence`` and ``stamp``.
    topic : str
        Relative name.
    qos : rclpy.qos.QoSProfile
        Quality of service.
    """

    def __init__(self, node: Node, kind: type[Any], topic: str, qos: QoSProfile) -> None:
        self._publisher = node.create_publisher(kind, topic, qos)
        self._sequence = 0
        self._lock = threading.Lock()

    def publish(self, message: Any) -> None:
        """Number, stamp and publish a message."""
        with self._lock:
            message.sequence = self._sequence
            message.stamp = stamp()
            self._sequence += 1
            self._publisher.publish(message)
