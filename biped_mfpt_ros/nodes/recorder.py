"""The recorder: everything that the pipeline publishes, into a rosbag2 bag."""

from __future__ import annotations

import importlib
import signal
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from biped_mfpt_ros.bag.definitions import message_definition
from biped_mfpt_ros.bag.error import BagWriteError
from biped_mfpt_ros.bag.metadata import STARTED_LATE
from biped_mfpt_ros.bag.sequences import SequenceCheck, leading_sequence
from biped_mfpt_ros.bag.writer import BagWriter
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.nodes.parameters import Declared, NodeParameters, parameter
from biped_mfpt_ros.nodes.spin import run_node

TOPICS = (
    "mesh/info",
    "mesh/states",
    "mesh/transitions",
    "mesh/progress",
    "mfpt",
    "optimisation/trials",
    "optimisation/best",
)
"""What is always recorded."""

_LOOK_PERIOD = 0.1
"""s, between two looks for topics that have appeared."""


@dataclass(frozen=True)
class RecorderParameters(NodeParameters):
    """Parameters of the recorder. They hold for its whole life."""

    bag: str = parameter(
        "", "directory of the bag, which must not exist; empty: named after the time"
    )
    # The log tells what happened when. Parameter events are left out: a node's parameters at its
    # start are not among them, and all that decides a result is in the mesh's settings.
    further_topics: str = parameter(
        "/rosout", "topics to record beside the pipeline's, separated by spaces"
    )
    earlier: bool = parameter(
        True, "also record what is kept on latched topics from before the recorder started"
    )
    flush_period: float = parameter(
        0.5, "s, after which a message survives the recorder's death at the latest", 0.01, 1.0
    )
    on_error: str = parameter(
        "stop",
        "what to do when the bag cannot be written any more, as on a full disk: stop, or go_on "
        "without it, so that the others need not end",
    )

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        if self.on_error not in ("stop", "go_on"):
            raise InputError("on_error", self.on_error, "stop or go_on")


@dataclass
class _Recording:
    """A topic being recorded."""

    topic: str
    subscription: Subscription[Any] | None
    check: SequenceCheck | None
    """None where the messages carry no sequence number."""


class Recorder(Node):
    """Writes the pipeline's topics to a bag, and checks that no message is missing.

    A topic is subscribed to when its first publisher appears. What the publisher keeps for
    latecomers arrives then, so that nothing on a latched topic is lost to a recorder that starts
    late or again.

    Parameters
    ----------
    **options
        Further arguments of `rclpy.node.Node`, where it shares a process with others.

    Raises
    ------
    InputError
        A parameter is not allowed, or the bag exists already.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("recorder", **options)
        parameters = Declared(self, RecorderParameters).now
        self.add_on_set_parameters_callback(_veto)
        self._awaited = [*map(self.resolve_topic_name, TOPICS)]
        for topic in parameters.further_topics.split():
            try:
                self._awaited.append(self.resolve_topic_name(topic))
            except _rclpy.RCLError:
                raise InputError("further_topics", topic, "names of topics") from None
        self._earlier = parameters.earlier
        self._goes_on = parameters.on_error == "go_on"
        self._recordings: list[_Recording] = []
        self._bag = BagWriter(parameters.bag or time.strftime("pipeline_%Y_%m_%d-%H_%M_%S"))
        if not self._earlier:
            self._bag.custom[STARTED_LATE] = "messages from before it began were not recorded"
        self.failed = False
        """Whether recording had to be given up."""
        self._stopped = False
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_LOOK_PERIOD, self._look, clock=steady)
        self.create_timer(parameters.flush_period, self._flush, clock=steady)
        self.get_logger().info(f"recording to {self._bag.path}")

    @property
    def counts(self) -> dict[str, int]:
        """How many messages of each topic, by its relative name, are in the bag so far."""
        inside = self.get_namespace().rstrip("/") + "/"
        return {topic.name.removeprefix(inside): topic.count for topic in self._bag.topics}

    def close(self) -> None:
        """Take what has arrived, close the bag, and report."""
        if not self._stopped:
            for recording in self._recordings:
                self._drain(recording)
        if not self.failed:
            try:
                self._bag.close()
            except BagWriteError as error:
                self._give_up(error)
        self._report()

    def _log(self) -> RcutilsLogger:
        # The node's own logger publishes too, which is over when the context has been shut down.
        logger = self.get_logger()
        return logger if self.context.ok() else get_logger(f"{logger.name}.bag")

    def _look(self) -> None:
        for topic in tuple(self._awaited):
            publishers = self.get_publishers_info_by_topic(topic)
            if publishers:
                self._awaited.remove(topic)
                self._record_topic(topic, publishers)

    def _record_topic(self, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        type_name = publishers[0].topic_type
        try:
            definition = message_definition(type_name)
            package, _, name = type_name.split("/")
            message_class = getattr(importlib.import_module(f"{package}.msg"), name)
        except (InputError, ImportError, AttributeError) as error:
            self._log().error(f"cannot record {topic}: {error}")
            return
        type_hash = str(publishers[0].topic_type_hash)
        self._bag.add_topic(
            topic,
            type_name,
            definition,
            type_hash if type_hash.startswith("RIHS") else "",
            [_profile(publisher.qos_profile) for publisher in publishers],
        )
        qos = _compatible(publishers)
        if not self._earlier:
            qos.durability = QoSDurabilityPolicy.VOLATILE
        latched = qos.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
        check = SequenceCheck(complete=latched) if _is_counted(message_class) else None
        recording = _Recording(topic, None, check)
        recording.subscription = self.create_subscription(
            message_class, topic, partial(self._record, recording), qos, raw=True
        )
        self._recordings.append(recording)

    def _record(self, recording: _Recording, data: bytes, info: dict[str, Any]) -> None:
        sequence = 0
        if recording.check is not None:
            try:
                sequence = leading_sequence(data)
            except ValueError as error:
                self._log().error(f"{recording.topic}: {error}")
            else:
                gid = info.get("publisher_gid")
                problem = recording.check.add(sequence, gid and bytes(gid["data"]))
                if problem:
                    self._log().error(f"{recording.topic}: {problem}")
        if self.failed:
            return
        received = info["received_timestamp"] or time.time_ns()
        try:
            self._bag.write(
                recording.topic, data, received, info["source_timestamp"] or received, sequence
            )
        except BagWriteError as error:
            self._give_up(error)

    def _drain(self, recording: _Recording) -> None:
        """Record what has arrived and not been taken: nothing is taken after a signal."""
        subscription = recording.subscription
        while subscription is not None:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, True)
            if taken is None:
                return
            self._record(recording, *taken)

    def _flush(self) -> None:
        if self.failed:
            return
        try:
            self._bag.flush()
        except BagWriteError as error:
            self._give_up(error)

    def _give_up(self, error: BagWriteError) -> None:
        self.failed = True
        if self._goes_on:
            self._log().error(f"{error}; going on without recording (on_error)")
        else:
            self._log().fatal(str(error))
            self._stopped = True  # the subscriptions end with the context
            self.context.try_shutdown()

    def _report(self) -> None:
        logger = self._log()
        counts = {topic.name: topic.count for topic in self._bag.topics}
        for recording in self._recordings:
            check = recording.check
            if check is None:
                logger.info(f"{recording.topic}: {counts[recording.topic]} messages")
            elif check.missing or check.repeated:
                logger.error(
                    f"{recording.topic}: received {check.received} messages of {check.published} "
                    f"published: {check.missing} missing, {check.repeated} repeated"
                )
            else:
                logger.info(
                    f"{recording.topic}: received {check.received} messages of {check.published} "
                    "published"
                )
        if self.failed:
            logger.error(f"{self._bag.path} is not whole: recording was given up")
        else:
            logger.info(f"{sum(counts.values())} messages in {self._bag.path}")


def _veto(changes: list[Parameter[Any]]) -> SetParametersResult:
    names = RecorderParameters.__dataclass_fields__
    for change in changes:
        if change.name in names:
            error = InputError(change.name, change.value, "what it is, while it records")
            return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _is_counted(message_class: Any) -> bool:
    """Whether messages of the type start with a string and a sequence number."""
    first = [*message_class.get_fields_and_field_types().items()][:2]
    return len(first) == 2 and first[0][1] == "string" and first[1] == ("sequence", "uint64")


def _compatible(publishers: list[TopicEndpointInfo]) -> QoSProfile:
    """The strictest profile that receives from every publisher.

    History and depth say nothing about compatibility, and of a remote publisher they are not
    known. Keeping all makes a reliable publisher wait rather than lose messages.
    """
    offered = [publisher.qos_profile for publisher in publishers]
    reliable = all(qos.reliability == QoSReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_ALL,
        reliability=(
            QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT
        ),
        durability=(
            QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE
        ),
    )


def _profile(qos: QoSProfile) -> dict[str, Any]:
    """An offered profile in rosbag2's terms."""

    def duration(value: Any) -> dict[str, int]:
        seconds, nanoseconds = divmod(value.nanoseconds, 10**9)
        return {"sec": seconds, "nsec": nanoseconds}

    return {
        "history": qos.history.name.lower(),
        "depth": qos.depth,
        "reliability": qos.reliability.name.lower(),
        "durability": qos.durability.name.lower(),
        "deadline": duration(qos.deadline),
        "lifespan": duration(qos.lifespan),
        "liveliness": qos.liveliness.name.lower(),
        "liveliness_lease_duration": duration(qos.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": qos.avoid_ros_namespace_conventions,
    }


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    made: list[Recorder] = []

    def make() -> Recorder:
        made.append(Recorder())
        # From here on a signal ends the spinning through rclpy alone: an exception in the middle
        # of a write would spoil the bag.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        return made[0]

    code = run_node(make, args)
    return code or int(any(recorder.failed for recorder in made))
