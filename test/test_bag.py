"""Bags: what is written is what rosbag2 expects, and whatever is broken is said to be.

`rosbags` reads back what `mcap` wrote: it shares no code with the writer.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import resource
import shutil
import struct
import tempfile
from functools import cache
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory
from biped_mfpt_msgs import msg as messages
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import StreamReader
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from biped_mfpt_ros.bag.definitions import message_definition
from biped_mfpt_ros.bag.error import BagError, BagWriteError
from biped_mfpt_ros.bag.reader import Bag
from biped_mfpt_ros.bag.repair import salvage
from biped_mfpt_ros.bag.sequences import SequenceCheck, leading_sequence
from biped_mfpt_ros.bag.writer import BagWriter
from biped_mfpt_ros.errors import InputError

FOREVER = {"sec": 9223372036, "nsec": 854775807}
QOS = {
    "history": "unknown",
    "depth": 0,
    "reliability": "reliable",
    "durability": "transient_local",
    "deadline": FOREVER,
    "lifespan": FOREVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": FOREVER,
    "avoid_ros_namespace_conventions": False,
}
PUBLISHED = ("MeshInfo", "MeshStates", "MeshTransitions", "MeshProgress", "MfptEstimate",
             "OptimisationTrial")  # fmt: skip


def stated_hash(type_name: str) -> str:
    """Type hash as the generated files of the message package state it."""
    package, _, name = type_name.split("/")
    path = Path(get_package_share_directory(package), "msg", f"{name}.json")
    hashes = json.loads(path.read_text())["type_hashes"]
    return next(entry["hash_string"] for entry in hashes if entry["type_name"] == type_name)


def add_topic(writer: BagWriter, topic: str, name: str) -> None:
    type_name = f"biped_mfpt_msgs/msg/{name}"
    writer.add_topic(topic, type_name, message_definition(type_name), stated_hash(type_name), [QOS])


@cache  # rclpy leaves what it pads with to chance
def states_message(sequence: int) -> bytes:
    random_ = random.Random(sequence)
    return serialize_message(
        messages.MeshStates(
            mesh_id="mesh",
            sequence=sequence,
            generation=sequence,
            first_index=1 + 3 * sequence,
            states=[random_.uniform(-1, 1) for _ in range(30)],
            preceding=[0, 1, 2],
        )
    )


def write_states(path: Path, count: int, close: bool = True, every: int = 7) -> BagWriter:
    """A bag of `count` messages, flushed after every so many."""
    writer = BagWriter(path)
    add_topic(writer, "/mesh/states", "MeshStates")
    for i in range(count):
        writer.write("/mesh/states", states_message(i), 10**18 + 1000 * i, 10**18 + 1000 * i - 5, i)
        if (i + 1) % every == 0:
            writer.flush()
    if close:
        writer.close()
    return writer


def contents(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(path.iterdir())}


# Definitions


@pytest.mark.parametrize(
    "type_name", [*(f"biped_mfpt_msgs/msg/{name}" for name in PUBLISHED), "rcl_interfaces/msg/Log"]
)
def test_definition_is_complete_and_hashes_to_the_type_hash(type_name):
    # A hash over the whole recursive definition, computed by another library.
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(message_definition(type_name), type_name))
    assert store.hash_rihs01(type_name) == stated_hash(type_name)


def test_definition_names_each_type_once():
    text = message_definition("biped_mfpt_msgs/msg/MeshInfo")
    assert [line for line in text.splitlines() if line.startswith("MSG: ")] == [
        "MSG: biped_mfpt_msgs/MeshSettings",
        "MSG: biped_mfpt_msgs/Controller",
        "MSG: biped_mfpt_msgs/WalkerModel",
        "MSG: biped_mfpt_msgs/Robot",
        "MSG: builtin_interfaces/Time",
    ]


@pytest.mark.parametrize(
    "name",
    ["", "MeshInfo", "no_such_package/msg/A", "biped_mfpt_msgs/msg/Nothing", "a/b/c/d",
     "biped_mfpt_msgs/srv/SimulateSteps", "../msg/x"],
)  # fmt: skip
def test_unknown_message_type_is_an_input_error(name):
    with pytest.raises(InputError, match="message type"):
        message_definition(name)


# Writing


def test_bag_reads_back_with_rosbags(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        add_topic(writer, "/a/mesh/states", "MeshStates")
        add_topic(writer, "/a/mfpt", "MfptEstimate")
        add_topic(writer, "/a/mesh/progress", "MeshProgress")  # nothing comes on it
        for i in range(50):
            writer.write("/a/mesh/states", states_message(i), 2000 + i, 1000 + i, i)
        estimate = messages.MfptEstimate(mesh_id="mesh", sigma_s=0.02, mfpt=math.inf)
        estimate.failure_codes = b"\x02\x05"
        writer.write("/a/mfpt", serialize_message(estimate), 5000, 4000)
    with AnyReader([path]) as reader:  # checks definitions against hashes
        assert reader.message_count == 51
        assert (reader.start_time, reader.end_time) == (2000, 5001)
        assert {c.topic: (c.msgtype, c.msgcount, c.digest) for c in reader.connections} == {
            topic: (
                f"biped_mfpt_msgs/msg/{name}",
                count,
                stated_hash(f"biped_mfpt_msgs/msg/{name}"),
            )
            for topic, name, count in (
                ("/a/mesh/states", "MeshStates", 50),
                ("/a/mfpt", "MfptEstimate", 1),
                ("/a/mesh/progress", "MeshProgress", 0),
            )
        }
        qos = reader.connections[0].ext.offered_qos_profiles[0]
        assert (qos.reliability.name, qos.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")
        assert (qos.lifespan.sec, qos.lifespan.nsec) == (9223372036, 854775807)
        read = list(reader.messages())
        assert [time for _, time, _ in read] == [*range(2000, 2050), 5000]
        assert [bytes(data) for _, _, data in read[:50]] == [*map(states_message, range(50))]
        last = reader.deserialize(read[-1][2], read[-1][0].msgtype)
        assert (last.mfpt, last.sigma_s, [*last.failure_codes]) == (math.inf, 0.02, [2, 5])


def test_bag_reads_back_with_our_reader(tmp_path):
    write_states(tmp_path / "bag", 20)
    bag = Bag(tmp_path / "bag")
    read = list(bag.messages())
    assert [m.message.sequence for m in read] == [*range(20)]
    assert [m.log_time - m.publish_time for m in read] == [5] * 20
    assert bag.topics["/mesh/states"].count == 20
    assert bag.topics["/mesh/states"].qos_profiles == [QOS]
    assert [m.sequence for m in Bag(tmp_path / "bag" / "bag_0.mcap").raw_messages()] == [*range(20)]
    assert list(bag.messages(types=["biped_mfpt_msgs/msg/MeshInfo"])) == []


def test_metadata_has_all_that_rosbag2_reads(tmp_path):
    write_states(tmp_path / "bag", 3)
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    # What rosbag2 decodes of version 9, with the types that it decodes it to.
    info = metadata.pop("rosbag2_bagfile_information")
    assert metadata == {}
    assert info == {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": 2000},
        "starting_time": {"nanoseconds_since_epoch": 10**18},
        "message_count": 3,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": "/mesh/states",
                    "type": "biped_mfpt_msgs/msg/MeshStates",
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [QOS],
                    "type_description_hash": stated_hash("biped_mfpt_msgs/msg/MeshStates"),
                },
                "message_count": 3,
            }
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["bag_0.mcap"],
        "files": [
            {
                "path": "bag_0.mcap",
                "starting_time": {"nanoseconds_since_epoch": 10**18},
                "duration": {"nanoseconds": 2000},
                "message_count": 3,
            }
        ],
        "custom_data": None,
        "ros_distro": os.environ.get("ROS_DISTRO", ""),
    }


def test_mcap_file_has_all_that_rosbag2_reads(tmp_path):
    write_states(tmp_path / "bag", 3)
    file = tmp_path / "bag" / "bag_0.mcap"
    with file.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    with file.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    (header,) = (r for r in records if isinstance(r, Header))
    channel = next(r for r in records if isinstance(r, Channel))
    schema = next(r for r in records if isinstance(r, Schema))
    (metadata,) = (r for r in records if isinstance(r, Metadata))
    assert header.profile == "ros2"
    assert channel.message_encoding == "cdr"
    assert channel.metadata["topic_type_hash"] == stated_hash(schema.name)
    assert yaml.safe_load(channel.metadata["offered_qos_profiles"]) == [QOS]
    assert (schema.name, schema.encoding) == ("biped_mfpt_msgs/msg/MeshStates", "ros2msg")
    assert metadata.name == "rosbag2"
    info = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    assert (
        yaml.safe_load(metadata.metadata["serialized_metadata"])
        == info["rosbag2_bagfile_information"]
    )
    assert {chunk.compression for chunk in chunks} == {"zstd"}
    assert all(chunk.uncompressed_crc for chunk in chunks)


def test_empty_bag_is_whole(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        add_topic(writer, "/mfpt", "MfptEstimate")
    with AnyReader([tmp_path / "bag"]) as reader:
        assert reader.message_count == 0
    bag = Bag(tmp_path / "bag")
    assert list(bag.messages()) == []
    assert bag.topics["/mfpt"].count == 0


def test_what_is_flushed_can_be_read_before_the_bag_is_closed(tmp_path):
    writer = write_states(tmp_path / "bag", 10, close=False, every=5)
    with pytest.raises(BagError, match="still being recorded"):
        Bag(tmp_path / "bag")
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
    read = []
    with pytest.raises(BagError, match="last flush"):
        read.extend(Bag(tmp_path / "bag", unfinished=True).messages())
        # The generator raises after its last message; what came before must not be lost.
    saved = salvage(tmp_path / "bag", tmp_path / "saved")
    assert saved.counts == {"/mesh/states": 10}
    writer.close()
    assert len(list(Bag(tmp_path / "bag").messages())) == 10


def test_an_exception_leaves_the_bag_unfinished(tmp_path):
    def write_half():
        with BagWriter(tmp_path / "bag") as writer:
            add_topic(writer, "/mesh/states", "MeshStates")
            writer.write("/mesh/states", states_message(0), 0, 0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    with pytest.raises(BagError, match="has no end"):
        Bag(tmp_path / "bag")


@pytest.mark.parametrize("name", ["there", "file", "file/below", ".", ""])
def test_new_bag_needs_a_place_where_nothing_is(tmp_path, name):
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_text("kept")
    with pytest.raises(BagError, match="bag"):
        BagWriter(f"{tmp_path}/{name}")
    assert list((tmp_path / "there").iterdir()) == []
    assert (tmp_path / "file").read_text() == "kept"


def test_full_disk_is_a_clear_error_and_what_was_flushed_is_kept(tmp_path):
    # A limit on the size of files fails a write in the same way as a full disk does.
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = BagWriter(tmp_path / "bag")
    add_topic(writer, "/mesh/states", "MeshStates")
    written: list[int] = []

    def write_many():
        for i in range(1000):
            writer.write("/mesh/states", states_message(i), i, i, i)
            writer.flush()
            written.append(i)

    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(BagWriteError, match=r"bag /.*: cannot be written: .* not whole"):
            write_many()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert 0 < len(written) < 1000
    with pytest.raises(ValueError, match="closed"):
        writer.flush()
    writer.close()  # nothing more to do
    with pytest.raises(BagError, match="has no end"):
        Bag(tmp_path / "bag")
    assert salvage(tmp_path / "bag", tmp_path / "saved").counts == {"/mesh/states": len(written)}


def test_full_disk_at_the_end_leaves_no_metadata(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = write_states(tmp_path / "bag", 5, close=False, every=5)
    size = (tmp_path / "bag" / "bag_0.mcap").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, hard))
    try:
        with pytest.raises(BagWriteError):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [*contents(tmp_path / "bag")] == ["bag_0.mcap"]
    with pytest.raises(BagError, match="has no end"):
        Bag(tmp_path / "bag")


# Reading what is broken


def cut(source: Path, target: Path, length: int, metadata: bool = True) -> Path:
    shutil.copytree(source, target)
    os.truncate(target / f"{source.name}_0.mcap", length)
    if not metadata:
        (target / "metadata.yaml").unlink()
    return target


def test_cut_at_any_point_gives_the_messages_before_it(tmp_path):
    count, every = 40, 7
    write_states(tmp_path / "bag", count, every=every)
    size = (tmp_path / "bag" / "bag_0.mcap").stat().st_size
    random_ = random.Random(1)
    points = {0, 1, 7, 8, 9, size - 1, size - 8, size - 9, *random_.sample(range(size), 25)}
    saved_counts = []
    for length in sorted(points):
        broken = cut(tmp_path / "bag", tmp_path / f"cut{length}", length, length % 2 == 0)
        before = contents(broken)
        with pytest.raises(BagError, match=r"bag_0\.mcap") as raised:
            Bag(broken)
        assert str(broken) in str(raised.value)
        new = tmp_path / f"new{length}"
        try:
            saved = salvage(broken, new)
        except BagError as error:
            refusal = str(error)
            saved_counts.append(0)
        else:
            read = [m.message.sequence for m in Bag(new).messages()]
            assert read == [*range(saved.counts["/mesh/states"])]
            saved_counts.append(len(read))
            assert saved.missing or len(read) == count  # says what is gone
            with AnyReader([new]) as reader:
                assert reader.message_count == len(read)
        if not saved_counts[-1]:
            assert "no message in it can be read" in refusal
            assert not new.exists()
        assert contents(broken) == before
        shutil.rmtree(broken)
    assert saved_counts == sorted(saved_counts)
    assert saved_counts[-1] == count
    # All that was flushed: never lost in the middle of a chunk.
    assert set(saved_counts) <= {0, *range(every, count, every), count}
    assert len(set(saved_counts)) > 3


@cache
def recorded():
    """The bytes of a bag, and where each of its flushes ended."""
    bag = Path(tempfile.mkdtemp()) / "bag"
    writer = write_states(bag, 0, close=False)
    file = bag / "bag_0.mcap"
    ends = [file.stat().st_size]
    for i in range(12):
        writer.write("/mesh/states", states_message(i), 1000 + i, i, i)
        if i % 3 == 2:
            writer.flush()
            ends.append(file.stat().st_size)
    writer.close()
    data = file.read_bytes()
    shutil.rmtree(bag.parent)
    return data, ends


@settings(deadline=None, max_examples=40)  # others use the machine too
@given(
    st.floats(0.0, 1.0),
    st.sampled_from([b"", b"\0" * 7, b"\0" * 100, b"\0" * 3_000_000, b"\xff" * 50, b"\x05" * 99]),
    st.booleans(),
)
def test_whatever_a_crash_leaves_is_saved_to_the_last_flush(tmp_path_factory, at, end, own):
    # Cut at any byte; the file system may leave zeros, or what stood there before.
    data, ends = recorded()
    length = round(at * (len(data) - 1))
    path = tmp_path_factory.mktemp("crash")
    broken = path / "bag" if own else path / "bag_0.mcap"
    file = broken / "bag_0.mcap" if own else broken
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(data[:length] + end)
    before, times = file.read_bytes(), file.stat()
    flushed = 3 * max(0, sum(e <= length for e in ends) - 1)
    try:
        saved = salvage(broken, path / "new")
    except BagError as error:
        refusal = str(error)
        assert flushed == 0
    else:
        refusal = ""
        read = [m.message.sequence for m in Bag(path / "new").messages()]
        # A chunk may be whole although its index is not.
        assert read in ([*range(flushed)], [*range(flushed + 3)])
        assert saved.counts == {"/mesh/states": len(read)}
        assert saved.missing or len(read) == 12
    said = ("no message in it can be read", "not an MCAP file")
    assert not refusal or any(text in refusal for text in said)
    after = file.stat()
    assert file.read_bytes() == before
    assert (after.st_mtime_ns, after.st_ino) == (times.st_mtime_ns, times.st_ino)
    assert {p.name for p in path.rglob("*")} <= {"bag", "bag_0.mcap", "new", "new_0.mcap",
                                                 "metadata.yaml"}  # fmt: skip


def test_cut_bag_says_how_many_messages_are_missing(tmp_path):
    write_states(tmp_path / "bag", 21)
    size = (tmp_path / "bag" / "bag_0.mcap").stat().st_size
    broken = cut(tmp_path / "bag", tmp_path / "cut", size // 2)
    saved = salvage(broken, tmp_path / "new")
    count = saved.counts["/mesh/states"]
    assert 0 < count < 21
    assert any(f"{count} messages on /mesh/states, of 21" in text for text in saved.missing)
    metadata = yaml.safe_load((tmp_path / "new" / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert custom["salvaged_from"] == "cut"
    assert f"of {size // 2}" in custom["missing"]


def test_damaged_bytes_never_give_an_unclear_error(tmp_path):
    write_states(tmp_path / "bag", 40)
    whole = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    good = [
        (m.message.sequence, m.message.states.tobytes()) for m in Bag(tmp_path / "bag").messages()
    ]
    shutil.copytree(tmp_path / "bag", tmp_path / "broken")
    random_ = random.Random(2)
    refusals = []
    for i in range(100):
        data = bytearray(whole)
        # From single bits to whole stretches of noise.
        start = random_.randrange(len(data))
        length = random_.choice([1, 1, 2, 8, 64])
        data[start : start + length] = random_.randbytes(len(data[start : start + length]))
        (tmp_path / "broken" / "bag_0.mcap").write_bytes(data)
        read = []
        try:
            bag = Bag(tmp_path / "broken", unfinished=i % 2 == 0)
            for message in bag.messages():
                read.append(message)
        except BagError as error:
            refusals.append(str(error))
        # Checksums: what is read is what was written.
        assert [(m.message.sequence, m.message.states.tobytes()) for m in read] == good[: len(read)]
    assert len(refusals) > 50
    assert all("/broken" in refusal for refusal in refusals)


def sqlite_metadata(text: str) -> str:
    return text.replace("storage_identifier: mcap", "storage_identifier: sqlite3")


FOREIGN = {
    "no such bag": (lambda bag: shutil.rmtree(bag), "does not exist"),
    "empty directory": (lambda bag: [f.unlink() for f in bag.iterdir()], "is no bag"),
    "empty file": (lambda bag: os.truncate(bag / "bag_0.mcap", 0), "bag_0.mcap is empty"),
    "no file": (lambda bag: (bag / "bag_0.mcap").unlink(), "bag_0.mcap is missing"),
    "no metadata": (lambda bag: (bag / "metadata.yaml").unlink(), "has no metadata.yaml"),
    "other file": (
        lambda bag: (bag / "bag_0.mcap").write_bytes(b"SQLite format 3\0" * 50),
        "bag_0.mcap: is not an MCAP file",
    ),
    "sqlite3 storage": (
        lambda bag: rewrite(bag, sqlite_metadata),
        "metadata.yaml: the bag's storage is 'sqlite3', not 'mcap'",
    ),
    "no yaml": (lambda bag: rewrite(bag, lambda _: "a: [b"), "metadata.yaml: is not YAML"),
    "binary metadata": (
        lambda bag: (bag / "metadata.yaml").write_bytes(b"\xff\xfe\0\0" * 9),
        "metadata.yaml: is not YAML",
    ),
    "other yaml": (lambda bag: rewrite(bag, lambda _: "[1, 2]"), "is not of a bag"),
    "yaml without files": (
        lambda bag: rewrite(bag, lambda text: text.replace("relative_file_paths", "paths")),
        "has no relative_file_paths",
    ),
    "count that is no number": (
        lambda bag: rewrite(bag, lambda text: text.replace("message_count: 9", "message_count: x")),
        "'x' is not a count",
    ),
    "other count": (
        lambda bag: rewrite(bag, lambda text: text.replace("message_count: 9", "message_count: 8")),
        "holds 9 messages on /mesh/states, of 8",
    ),
    "other profile": (
        lambda bag: replace_bytes(bag, b"ros2", b"ros1", 1),
        "profile 'ros1', not 'ros2'",
    ),
}


def rewrite(bag: Path, change) -> None:
    path = bag / "metadata.yaml"
    path.write_text(change(path.read_text()))


def replace_bytes(bag: Path, old: bytes, new: bytes, count: int = -1) -> None:
    path = bag / "bag_0.mcap"
    path.write_bytes(path.read_bytes().replace(old, new, count))


@pytest.mark.parametrize("case", FOREIGN)
def test_foreign_or_broken_bag_is_a_clear_error(tmp_path, case):
    write_states(tmp_path / "bag", 9)
    change, text = FOREIGN[case]
    change(tmp_path / "bag")
    with pytest.raises(BagError) as raised:
        list(Bag(tmp_path / "bag").messages())
    assert text in str(raised.value)
    assert str(tmp_path / "bag") in str(raised.value)
    assert str(raised.value).count("allowed:") == 1
    assert raised.value.field == "bag"


@settings(deadline=None)  # others use the machine too
@given(st.recursive(
    st.none() | st.booleans() | st.integers() | st.text() | st.sampled_from(["mcap", 9]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["storage_identifier", "relative_file_paths", "message_count", "duration",
                         "starting_time", "topics_with_message_count", "topic_metadata", "name",
                         "type", "nanoseconds", "nanoseconds_since_epoch", "custom_data"]),
        inner),
    max_leaves=12,
))  # fmt: skip
def test_any_metadata_is_read_or_refused_clearly(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("bag")
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": content}))
    with pytest.raises(BagError):
        Bag(path)  # there are no files, so no content makes it a bag


def test_definition_that_does_not_fit_its_hash_is_refused(tmp_path):
    definition = message_definition("biped_mfpt_msgs/msg/MeshStates")
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic(
            "/mesh/states", "biped_mfpt_msgs/msg/MeshStates",
            definition.replace("uint32 generation", "int32 generation"),
            stated_hash("biped_mfpt_msgs/msg/MeshStates"),
        )  # fmt: skip
        writer.write("/mesh/states", states_message(0), 0, 0)
    with pytest.raises(BagError, match="not the one its hash is of"):
        list(Bag(tmp_path / "bag").messages())


def test_two_definitions_of_a_type_are_refused(tmp_path):
    definition = message_definition("biped_mfpt_msgs/msg/MeshStates")
    with BagWriter(tmp_path / "bag") as writer:
        for i, text in enumerate((definition, f"{definition}\n# again")):
            writer.add_topic(f"/states_{i}", "biped_mfpt_msgs/msg/MeshStates", text)
            writer.write(f"/states_{i}", states_message(i), i, i)
    messages = Bag(tmp_path / "bag").messages()
    assert next(messages).message.sequence == 0
    with pytest.raises(BagError, match="two different definitions of biped_mfpt_msgs"):
        next(messages)


def test_chunk_of_another_size_than_it_says_or_beyond_the_limit_is_refused(tmp_path, monkeypatch):
    write_states(tmp_path / "bag", 9, every=9)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        chunk = next(record for record in records if isinstance(record, Chunk))
    size, sizes = chunk.uncompressed_size, struct.Struct("<QI")
    monkeypatch.setattr("biped_mfpt_ros.bag.reader._CHUNK_LIMIT", size)
    assert len(list(Bag(tmp_path / "bag").raw_messages())) == 9
    monkeypatch.setattr("biped_mfpt_ros.bag.reader._CHUNK_LIMIT", size - 1)
    with pytest.raises(BagError, match=f"is damaged .*a chunk of {size} bytes"):
        list(Bag(tmp_path / "bag").raw_messages())
    monkeypatch.undo()
    says = sizes.pack(size + 1, chunk.uncompressed_crc)
    replace_bytes(tmp_path / "bag", sizes.pack(size, chunk.uncompressed_crc), says)
    with pytest.raises(BagError, match=f"is damaged .*a chunk of {size} bytes"):
        list(Bag(tmp_path / "bag").raw_messages())


def test_message_without_fields_is_read(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/tick", "test_msgs/msg/Empty", "")
        writer.write("/tick", b"\0\1\0\0\0", 0, 0)
    (read,) = Bag(tmp_path / "bag").messages()
    assert read.type_name == "test_msgs/msg/Empty"


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", states_message(3)[:-4], b"\xff" * 99])
def test_message_that_does_not_fit_its_definition_is_refused(tmp_path, data):
    with BagWriter(tmp_path / "bag") as writer:
        add_topic(writer, "/mesh/states", "MeshStates")
        writer.write("/mesh/states", data, 17, 0)
    with pytest.raises(BagError, match=r"/mesh/states, received at 17 ns, is no biped_mfpt_msgs"):
        list(Bag(tmp_path / "bag").messages())


def test_split_bag_is_read_as_one(tmp_path):
    bag = tmp_path / "bag"
    write_states(bag, 9)
    write_states(tmp_path / "second", 3)
    shutil.copy(tmp_path / "second" / "second_0.mcap", bag / "bag_1.mcap")

    def name_both(text: str) -> str:
        return text.replace("- bag_0.mcap\n", "- bag_0.mcap\n  - bag_1.mcap\n").replace(
            "message_count: 9", "message_count: 12"
        )

    rewrite(bag, name_both)
    assert [m.message.sequence for m in Bag(bag).messages()] == [*range(9), *range(3)]


def test_files_of_a_bag_without_metadata_are_in_the_order_of_their_numbers(tmp_path):
    (tmp_path / "bag").mkdir()
    for i in (10, 2, 0, 1, 9):
        write_states(tmp_path / f"b{i}", i + 1)
        (tmp_path / f"b{i}" / f"b{i}_0.mcap").rename(tmp_path / "bag" / f"bag_{i}.mcap")
    files = Bag(tmp_path / "bag", unfinished=True).files
    assert [file.name for file in files] == [f"bag_{i}.mcap" for i in (0, 1, 2, 9, 10)]


# Sequence numbers


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("label", ["", "a", "mesh-1", "0123456", "01234567", "x" * 1000, "ü"])
def test_leading_sequence_of_every_published_message(name, label):
    fields = [*getattr(messages, name).get_fields_and_field_types()]
    for sequence in (0, 1, 2**32, 2**64 - 1):
        message = getattr(messages, name)(**{fields[0]: label, "sequence": sequence})
        assert leading_sequence(serialize_message(message)) == sequence


@settings(deadline=None)  # others use the machine too
@given(st.binary(max_size=60))
def test_leading_sequence_of_anything_is_a_number_or_a_value_error(data):
    with contextlib.suppress(ValueError):
        assert 0 <= leading_sequence(data) < 2**64


def test_sequence_check_counts_what_is_missing():
    check = SequenceCheck()
    said = [check.add(number, "mesher") for number in (0, 1, 2, 5, 6, 8)]
    assert said == [
        "", "", "", "messages 3 to 4 are missing", "", "message 7 is missing"
    ]  # fmt: skip
    assert (check.received, check.published, check.missing) == (6, 9, 3)
    assert "again" in check.add(8, "mesher")
    assert (check.published, check.repeated) == (9, 1)


@pytest.mark.parametrize("publisher", [None, "mesher"])
def test_messages_before_the_first_are_missing_only_where_they_are_kept(publisher):
    latched, volatile = SequenceCheck(complete=True), SequenceCheck(complete=False)
    assert latched.add(4, publisher) == "messages 0 to 3 are missing"
    assert volatile.add(4, publisher) == ""
    assert "again" in volatile.add(4, publisher)


@settings(deadline=None)  # others use the machine too
@given(
    st.lists(st.integers(0, 2), min_size=1, max_size=60),
    st.sets(st.integers(0, 59)),
)
def test_sequence_check_of_several_known_publishers(order, lost):
    # Each publisher counts for itself; all but its last messages are known to have been sent.
    sent, received, expected = [0, 0, 0], [-1, -1, -1], 0
    check = SequenceCheck()
    for i, publisher in enumerate(order):
        if i not in lost:
            check.add(sent[publisher], publisher)
            received[publisher] = sent[publisher]
            expected += 1
        sent[publisher] += 1
    assert check.received == expected
    assert check.published == sum(last + 1 for last in received)


@settings(deadline=None)  # others use the machine too
@given(st.lists(st.integers(0, 2), max_size=60))
def test_nothing_is_missing_of_unknown_publishers_where_nothing_is(order):
    sent = [0, 0, 0]
    check = SequenceCheck()
    for publisher in order:
        assert check.add(sent[publisher]) == ""
        sent[publisher] += 1
    assert check.missing == check.repeated == 0


@settings(deadline=None)  # others use the machine too
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 29))
def test_a_loss_of_unknown_publishers_shows(first, second, gone):
    # Two publishers one after the other, as when one is restarted. If the second went on for
    # longer, its first messages could not be told from further ones of the first.
    second = min(first, second)
    numbers = [*range(first), *range(second)]
    gone %= len(numbers)
    last_of_one = gone in (first - 1, first + second - 1)
    check = SequenceCheck()
    for i, number in enumerate(numbers):
        if i != gone:
            check.add(number)
    # The last message of a publisher is the one whose loss nothing later can show.
    assert (check.missing + check.repeated > 0) == (not last_of_one)
