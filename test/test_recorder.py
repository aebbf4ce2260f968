"""The recorder as a process of its own: what it hears is in the bag, however it ends."""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import time
from collections import Counter
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest
from biped_mfpt_msgs import msg as messages
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from ros_graph import PATIENCE, ros_graph, wait_for
from rosbags.highlevel import AnyReader

from biped_mfpt_ros.bag import Bag, BagError, inspect_bag, salvage
from biped_mfpt_ros.nodes.publishers import CountedPublisher
from biped_mfpt_ros.nodes.qos import PROGRESS, RESULTS

RESULT_TOPICS = {
    "mesh/info": messages.MeshInfo,
    "mesh/states": messages.MeshStates,
    "mesh/transitions": messages.MeshTransitions,
    "mfpt": messages.MfptEstimate,
    "optimisation/trials": messages.OptimisationTrial,
    "optimisation/best": messages.OptimisationTrial,
}


class Publisher(Node):
    """Publishes on topics of the pipeline, and remembers what."""

    def __init__(self):
        super().__init__("pipeline", namespace="/run")
        self.sent: dict[str, list[object]] = {}
        self._publishers_by_topic: dict[str, CountedPublisher] = {}

    def send(self, topic, message, qos=RESULTS):
        if topic not in self._publishers_by_topic:
            self._publishers_by_topic[topic] = CountedPublisher(self, type(message), topic, qos)
        self._publishers_by_topic[topic].publish(message)
        self.sent.setdefault(f"/run/{topic}", []).append(message)

    def skip(self, topic, number):
        """Count messages as sent that are not."""
        self._publishers_by_topic[topic]._sequence += number

    def is_recorded(self, topic):
        """Whether what is published from now on reaches the recorder."""
        return self._publishers_by_topic[topic]._publisher.get_subscription_count() > 0

    def wait_until_flushed(self, topic, bag, number=None):
        """Wait until a bag has all messages of a topic, or so many."""
        number = len(self.sent[f"/run/{topic}"]) if number is None else number
        wait_for(lambda: self.is_recorded(topic), "the recorder")
        wait_for(lambda: flushed(bag)[f"/run/{topic}"] == number, f"{number} to be flushed")

    def wait_until_received(self, topic):
        """Wait until the recorder has acknowledged all messages, which it does every 3 s."""
        publisher = self._publishers_by_topic[topic]._publisher
        assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE))


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


def record(graph, bag, *arguments):
    process = graph.launch(
        "recorder", "--ros-args", "-r", "__ns:=/run", "-p", f"bag:={bag}", *arguments
    )
    return process


@contextmanager
def small_disk(path, size):
    """A file system of its own that is soon full."""
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def stop(process, how=signal.SIGTERM):
    """Exit code and log of a recorder."""
    process.send_signal(how)
    _, log = process.communicate(timeout=PATIENCE)
    return process.returncode, log


def noise(seed, size=300):
    random_ = random.Random(seed)
    return [random_.random() for _ in range(size)]


def flushed(bag: Path) -> Counter[str]:
    """Messages by topic in a bag that is being recorded."""
    unfinished = Bag(bag, unfinished=True)
    return Counter(raw.topic for raw in unfinished.raw_messages(on_error=lambda problem: None))


def is_flushed(bag: Path, text: bytes) -> bool:
    unfinished = Bag(bag, unfinished=True)
    return any(text in raw.data for raw in unfinished.raw_messages(on_error=lambda problem: None))


def recorded_states(bag: Path) -> list[messages.MeshStates]:
    return [
        deserialize_message(raw.data, messages.MeshStates)
        for raw in Bag(bag).raw_messages()
        if raw.topic == "/run/mesh/states"
    ]


def flushed_size(bag: Path) -> int:
    return (bag / f"{bag.name}_0.mcap").stat().st_size


def test_everything_published_is_in_the_bag(graph, tmp_path):
    bag = tmp_path / "new" / "bag"
    publisher = graph.start(Publisher)
    # Before there is a recorder: latched topics are kept for it.
    for i in range(30):
        for topic, kind in RESULT_TOPICS.items():
            publisher.send(topic, kind(message="x" * i) if kind is messages.MeshInfo else kind())
    process = record(graph, bag)
    publisher.send("mesh/progress", messages.MeshProgress(), PROGRESS)
    for topic in (*RESULT_TOPICS, "mesh/progress"):
        wait_for(lambda topic=topic: publisher.is_recorded(topic), topic)
    for i in range(30):
        publisher.send("mesh/states", messages.MeshStates(mesh_id="mesh", states=noise(i)))
    publisher.send("mesh/progress", messages.MeshProgress(mesh_id="mesh"), PROGRESS)
    publisher.send("mfpt", messages.MfptEstimate(mesh_id="last"))
    sent = {topic: len(all_sent) for topic, all_sent in publisher.sent.items()}
    del sent["/run/mesh/progress"]  # not latched: there may be fewer
    wait_for(lambda: sent.items() <= flushed(bag).items(), "all to be flushed")

    def logged():  # one line might come before the recorder listens
        publisher.get_logger().info("a line of the log")
        return is_flushed(bag, b"a line of the log")

    wait_for(logged, "the log to be flushed")
    with pytest.raises(BagError, match="still being recorded"):
        Bag(bag)
    saved = salvage(bag, tmp_path / "saved").counts
    code, log = stop(process)
    assert code == 0, log

    hashes = {
        f"/run/{topic}": str(
            publisher.get_publishers_info_by_topic(f"/run/{topic}")[0].topic_type_hash
        )
        for topic in publisher._publishers_by_topic
    }
    with AnyReader([bag]) as reader:
        recorded: dict[str, list[bytes]] = {}
        for connection, _, data in reader.messages():
            recorded.setdefault(connection.topic, []).append(data)
        connections = {c.topic: c for c in reader.connections}
        for line in recorded.pop("/rosout"):
            text = reader.deserialize(line, "rcl_interfaces/msg/Log").msg
            if text == "a line of the log":
                break
        else:
            pytest.fail("the log is not in the bag")
    assert connections.pop("/rosout")
    kinds = {f"/run/{topic}": kind for topic, kind in RESULT_TOPICS.items()}
    progress = recorded.pop("/run/mesh/progress")
    last = publisher.sent.pop("/run/mesh/progress")[-1]
    assert deserialize_message(progress[-1], messages.MeshProgress) == last
    # Each once. A late joiner may get a new message before the latched ones: their counters tell
    # them apart and put them in order.
    assert publisher.sent == {
        topic: sorted(
            (deserialize_message(data, kinds[topic]) for data in all_data),
            key=lambda message: message.sequence,
        )
        for topic, all_data in recorded.items()
    }
    assert {topic: c.digest for topic, c in connections.items()} == hashes
    for topic, connection in connections.items():
        (qos,) = connection.ext.offered_qos_profiles
        latched = topic != "/run/mesh/progress"
        assert qos.durability.name == ("TRANSIENT_LOCAL" if latched else "VOLATILE")
        assert qos.reliability.name == "RELIABLE"
    for message in Bag(bag).messages():
        assert 0 <= message.log_time - message.publish_time < 1e9 * PATIENCE
        assert abs(message.log_time - time.time_ns()) < 1e9 * PATIENCE
    for topic, sent in publisher.sent.items():
        assert f"{topic}: received {len(sent)} messages of {len(sent)} published" in log
        assert saved[topic] == len(sent)  # while it was being recorded


@pytest.mark.parametrize("earlier", [True, False])
def test_recorder_may_leave_out_what_was_before(graph, tmp_path, earlier):
    bag = tmp_path / "bag"
    publisher = graph.start(Publisher)
    for _ in range(2):
        publisher.send("mesh/info", messages.MeshInfo(mesh_id="before"))
    process = record(graph, bag, "-p", f"earlier:={str(earlier).lower()}")
    wait_for(lambda: publisher.is_recorded("mesh/info"), "the recorder")
    publisher.send("mesh/info", messages.MeshInfo(mesh_id="mine"))
    publisher.wait_until_flushed("mesh/info", bag, 3 if earlier else 1)
    code, log = stop(process)
    assert code == 0, log
    recorded = [
        deserialize_message(raw.data, messages.MeshInfo).mesh_id
        for raw in Bag(bag).raw_messages()
        if raw.topic == "/run/mesh/info"
    ]
    # A late joiner may get a new message before the latched ones.
    assert sorted(recorded) == (["before", "before", "mine"] if earlier else ["mine"])
    # Whoever reads the bag can tell messages that were left out from ones that were lost.
    assert not any("missing" in problem for problem in inspect_bag(bag).problems)


def test_lost_messages_are_errors_in_the_log(graph, tmp_path):
    publisher = graph.start(Publisher)
    publisher.send("mesh/info", messages.MeshInfo())
    publisher.skip("mesh/info", 3)
    publisher.send("mesh/info", messages.MeshInfo())
    process = record(graph, tmp_path / "bag")
    publisher.wait_until_flushed("mesh/info", tmp_path / "bag")
    publisher.skip("mesh/info", 1)
    publisher.send("mesh/info", messages.MeshInfo())
    publisher.wait_until_flushed("mesh/info", tmp_path / "bag")
    code, log = stop(process, signal.SIGINT)
    assert code == 0
    assert "[ERROR]" in log
    assert "/run/mesh/info: messages 1 to 3 are missing" in log
    assert "/run/mesh/info: message 5 is missing" in log
    assert "received 3 messages of 7 published: 4 missing, 0 repeated" in log
    assert Bag(tmp_path / "bag").metadata.count >= 3


def assert_cut_off(bag, publisher, due):
    """What is left of a killed recorder's bag: at least so many messages, in order."""
    assert [path.name for path in bag.iterdir()] == ["bag_0.mcap"]
    with pytest.raises(BagError, match="has no end"):
        Bag(bag)
    saved = salvage(bag, bag.parent / "saved")
    assert saved.counts["/run/mesh/states"] >= due
    assert any("has no end" in text for text in saved.missing)
    read = recorded_states(bag.parent / "saved")
    assert read == publisher.sent["/run/mesh/states"][: len(read)]


def test_killed_recorder_leaves_what_was_flushed(graph, tmp_path):
    bag = tmp_path / "bag"
    publisher = graph.start(Publisher)
    publisher.send("mesh/states", messages.MeshStates(states=noise(0)))
    process = record(graph, bag)
    publisher.wait_until_flushed("mesh/states", bag)
    for i in range(1, 60):
        publisher.send("mesh/states", messages.MeshStates(states=noise(i)))
    publisher.wait_until_flushed("mesh/states", bag)
    for i in range(60, 80):
        publisher.send("mesh/states", messages.MeshStates(states=noise(i)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert_cut_off(bag, publisher, 60)


@pytest.mark.slow  # and a promise about time, which a busy machine may break
def test_killed_recorder_loses_at_most_a_second(graph, tmp_path):
    bag = tmp_path / "bag"
    publisher = graph.start(Publisher)
    publisher.send("mesh/states", messages.MeshStates(states=noise(0)))
    process = record(graph, bag)
    wait_for(lambda: publisher.is_recorded("mesh/states"), "mesh/states")
    times = []
    end = time.monotonic() + 2.0
    for i in count(1):
        if time.monotonic() > end:
            break
        times.append(time.monotonic())
        publisher.send("mesh/states", messages.MeshStates(states=noise(i)))
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    killed = time.monotonic()
    process.wait()
    # Half a second until it is flushed, and half for the way there.
    due = 1 + sum(killed - sent > 1.0 for sent in times)
    assert due > 50
    assert_cut_off(bag, publisher, due)


def test_stopped_in_full_swing_the_bag_is_whole(graph, tmp_path):
    bag = tmp_path / "bag"
    publisher = graph.start(Publisher)
    publisher.send("mesh/states", messages.MeshStates())
    process = record(graph, bag, "-p", "flush_period:=0.01")
    publisher.wait_until_flushed("mesh/states", bag)
    for i in range(300):
        publisher.send("mesh/states", messages.MeshStates(states=noise(i, 20)))
    publisher.wait_until_flushed("mesh/states", bag)
    for i in range(100):
        publisher.send("mesh/states", messages.MeshStates(states=noise(i, 20)))
        if i == 50:
            process.send_signal(signal.SIGINT)
    code, log = stop(process, signal.SIGTERM)  # a second signal changes nothing
    assert code == 0, log
    read = recorded_states(bag)
    # All that had arrived, whether the node had taken it or not.
    assert len(read) >= 301
    assert read == publisher.sent["/run/mesh/states"][: len(read)]


def test_full_disk_ends_the_recorder_with_a_clear_error(graph, tmp_path):
    bag = tmp_path / "bag"
    publisher = graph.start(Publisher)
    publisher.send("mesh/states", messages.MeshStates())
    process = record(graph, bag, "-p", "flush_period:=0.05")
    publisher.wait_until_flushed("mesh/states", bag)
    # A limit on the size of its files fails a write in the same way as a full disk does.
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
    for i in range(60):
        publisher.send("mesh/states", messages.MeshStates(states=noise(i)))
    _, log = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "[FATAL]" in log
    assert "Traceback" not in log
    assert f"cannot be written: {os.strerror(27)}; it is not whole" in log
    assert str(bag) in log
    assert flushed_size(bag) <= 100_000
    with pytest.raises(BagError, match="has no end"):
        Bag(bag)
    assert salvage(bag, tmp_path / "saved").counts["/run/mesh/states"] > 0


@pytest.mark.parametrize("on_error", ["stop", "go_on"])
def test_on_a_full_disk_it_stops_or_goes_on_as_told(graph, tmp_path, on_error):
    with small_disk(tmp_path / "disk", 200_000) as disk:
        bag = disk / "bag"
        publisher = graph.start(Publisher)
        publisher.send("mesh/states", messages.MeshStates())
        process = record(graph, bag, "-p", "flush_period:=0.05", "-p", f"on_error:={on_error}")
        publisher.wait_until_flushed("mesh/states", bag)
        fit, number = 20, 150
        for i in range(1, number + 1):
            publisher.send("mesh/states", messages.MeshStates(states=noise(i)))
            if i == fit:
                wait_for(lambda: flushed(bag)["/run/mesh/states"] > fit, "those to be flushed")
        if on_error == "stop":
            _, log = process.communicate(timeout=PATIENCE)
            assert "[FATAL]" in log
        else:
            # It lives on, and hears the others to the end.
            assert process.poll() is None
            publisher.wait_until_received("mesh/states")
            _, log = stop(process)
            assert f"received {number + 1} messages of {number + 1} published" in log
        assert process.returncode == 1
        assert "Traceback" not in log
        assert f"cannot be written: {os.strerror(28)}; it is not whole" in log
        assert f"{bag} is not whole: recording was given up" in log
        # What could not be kept whole has given its space back, and passes for nothing else.
        assert [path.name for path in bag.iterdir()] == ["bag_0.mcap"]
        with pytest.raises(BagError, match="has no end"):
            Bag(bag)
        count = salvage(bag, tmp_path / "saved").counts["/run/mesh/states"]
        assert fit < count < number
        states = recorded_states(tmp_path / "saved")
        assert states == publisher.sent["/run/mesh/states"][:count]


@pytest.mark.parametrize("when", ["early", "late"])
def test_a_restarted_recorder_catches_up(graph, tmp_path, when):
    publisher = graph.start(Publisher)
    first = record(graph, tmp_path / "first")
    for i in range(100):
        if i == 50:
            publisher.wait_until_flushed("mesh/states", tmp_path / "first")
            first.send_signal(signal.SIGKILL)
            first.wait()
            if when == "early":
                second = record(graph, tmp_path / "second")
        publisher.send("mesh/states", messages.MeshStates(first_index=i, states=noise(i, 30)))
    if when == "late":
        second = record(graph, tmp_path / "second")
    wait_for((tmp_path / "second" / "second_0.mcap").exists, "the second recorder")
    wait_for(lambda: flushed(tmp_path / "second")["/run/mesh/states"] == 100, "all messages")
    code, log = stop(second)
    assert code == 0
    assert "/run/mesh/states: received 100 messages of 100 published" in log
    read = sorted(recorded_states(tmp_path / "second"), key=lambda message: message.sequence)
    assert read == publisher.sent["/run/mesh/states"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "exists already"),
        (("-p", "bag:=/proc/bag"), "cannot be made"),
        (("-p", "flush_period:=2.0"), "flush_period: 2.0 is not allowed; allowed: a number from"),
        (("-p", "further_topics:=a//b"), "further_topics: 'a//b' is not allowed"),
        (("-p", "on_error:=panic"), "on_error: 'panic' is not allowed; allowed: stop or go_on"),
    ],
)
def test_bad_parameter_is_a_clear_error(graph, tmp_path, arguments, text):
    (tmp_path / "bag").mkdir()
    bag = tmp_path / ("bag" if not arguments else "new")
    process = record(graph, bag, *arguments)
    _, log = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert text in log
    assert "Traceback" not in log
    assert not list(tmp_path.glob("*/*"))
