"""Reading of a bag from the bag alone: no ROS has to be there, not even the message packages.

Messages come in the order in which they were recorded. They are decoded by the definitions that
the bag carries, into objects with the fields of the message as attributes, arrays as numpy arrays.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.bag.metadata import FILE_NAME, Metadata, Topic, parse_qos, read_metadata

MAGIC = b"\x89MCAP0\r\n"
_CHUNK_LIMIT = 1 << 30
"""Bytes that a chunk may decompress to. What claims more is taken for damage."""

_CHUNK = 1 << 20
_MOST_ZEROS = 1 << 21
"""Bytes, more than any whole record ends with."""

_WHOLE = (
    "a whole rosbag2 bag in MCAP files; `biped-mfpt inspect --repair` makes one of what is left"
)

# What the libraries raise on bytes that are not what they should be.
_UNREADABLE = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    OverflowError,
    MemoryError,
    RuntimeError,  # lz4
)


@dataclass(frozen=True)
class RawMessage:
    """A message as it was recorded.

    Parameters
    ----------
    topic, type_name : str
    data : bytes
        CDR.
    log_time, publish_time : int
        ns since the epoch, when it was received and when it was sent.
    sequence : int
        The publisher's count of its messages modulo 2**32, if the recorder kept it.
    channel : mcap.records.Channel
    schema : mcap.records.Schema or None
        The definition of its type.
    """

    topic: str
    type_name: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int
    channel: Channel
    schema: Schema | None


@dataclass(frozen=True)
class BagMessage:
    """A decoded message.

    Parameters
    ----------
    topic, type_name : str
    message : object
        With the fields of the message as attributes.
    log_time, publish_time : int
        ns since the epoch, when it was received and when it was sent.
    """

    topic: str
    type_name: str
    message: Any
    log_time: int
    publish_time: int


class Bag:
    """A recorded bag. Reading leaves it as it is.

    Parameters
    ----------
    path : path-like
        Directory of a rosbag2 bag of MCAP files, or one MCAP file.
    unfinished : bool
        Whether to take a bag that is not whole, such as that of a recorder that was killed.

    Raises
    ------
    BagError
        It is missing, empty, of another format, or not whole.
    """

    def __init__(self, path: str | os.PathLike[str], unfinished: bool = False) -> None:
        self.path = Path(path)
        self.metadata: Metadata | None = None
        """What metadata.yaml says; None where there is none."""
        self.files: list[Path] = self._find_files()
        self.fault: str = self._find_fault()
        """Why the bag is not whole; empty if it looks whole. Damage inside shows on reading."""
        self.topics: dict[str, Topic] = {}
        """Topics by name, with the messages read so far; all of them after the last message."""
        self._types: dict[str, str] = {}
        self._store = get_typestore(Stores.EMPTY)
        if self.fault and not unfinished:
            raise BagError(self.path, self.fault, _WHOLE)

    @property
    def size(self) -> int:
        """Bytes in the bag's files."""
        return sum(file.stat().st_size for file in self.files)

    def messages(self, types: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Decode the messages, in the order in which they were recorded.

        Parameters
        ----------
        types : collection of str, optional
            Types wanted, such as ``biped_mfpt_msgs/msg/MeshInfo``; all without it.

        Yields
        ------
        BagMessage

        Raises
        ------
        BagError
            The bag is damaged, or a message does not fit its definition.
        """
        for raw in self.raw_messages():
            if types is None or raw.type_name in types:
                yield BagMessage(
                    raw.topic, raw.type_name, self.decode(raw), raw.log_time, raw.publish_time
                )

    def raw_messages(self, on_error: Callable[[str], object] | None = None) -> Iterator[RawMessage]:
        """Read the messages without decoding them.

        Parameters
        ----------
        on_error : callable, optional
            Called with what is wrong, in place of raising. Reading goes on with the next file.

        Yields
        ------
        RawMessage

        Raises
        ------
        BagError
            At the first byte that cannot be read, after all messages before it; and after the
            last message if the bag does not hold what its metadata.yaml says.
        """

        def fail(error: BagError) -> None:
            if on_error is None:
                raise error
            on_error(f"{Path(str(error.value)).name} {error.problem}")

        self.topics.clear()
        for file in self.files:
            try:
                yield from self._file_messages(file)
            except BagError as error:
                fail(error)
        for topic in self.metadata.topics if self.metadata else []:
            read = self.topics[topic.name].count if topic.name in self.topics else 0
            if read != topic.count:
                fail(
                    BagError(
                        self.path,
                        f"holds {read} messages on {topic.name}, of {topic.count} that "
                        f"{FILE_NAME} names",
                    )
                )

    def _find_files(self) -> list[Path]:
        if not os.path.exists(self.path):
            raise BagError(self.path, "does not exist, or may not be read")
        if self.path.is_file():
            if self.path.suffix != ".mcap":
                raise BagError(self.path, "is neither a directory nor an .mcap file")
            return [self.path]
        if (self.path / FILE_NAME).exists():
            self.metadata = read_metadata(self.path)
            files = [self.path / name for name in self.metadata.files]
            for file in files:
                if not file.is_file():
                    raise BagError(self.path, f"{file.name} is missing, which {FILE_NAME} names")
        else:
            # rosbag2 numbers the files of a bag, without leading zeros.
            files = sorted(self.path.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
        if not files:
            raise BagError(self.path, f"is no bag: it has neither {FILE_NAME} nor an .mcap file")
        return files

    def _find_fault(self) -> str:
        for file in self.files:
            with _opened(file) as stream:
                start = stream.read(len(MAGIC))
                if start != MAGIC[: len(start)]:
                    raise BagError(file, "is not an MCAP file")
                if not start:
                    return f"{file.name} is empty: its recorder was killed, or has just started"
                stream.seek(max(len(MAGIC), stream.seek(0, os.SEEK_END) - len(MAGIC)))
                whole = stream.read() == MAGIC
            if not whole and self.metadata is None:
                return (
                    f"{file.name} has no end: it is still being recorded, or its recorder was "
                    "killed, or it was cut off"
                )
            if not whole:
                return f"{file.name} has no end: it was cut off"
        if self.metadata is None and self.path.is_dir():
            return f"has no {FILE_NAME}: its recorder was killed before it had finished"
        return ""

    def _file_messages(self, path: Path) -> Iterator[RawMessage]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with _opened(path) as stream:
            bounded = _Bounded(stream)
            records = _records(path, bounded)
            try:
                for record in records:
                    if isinstance(record, Header) and record.profile != "ros2":
                        raise BagError(
                            path, f"is an MCAP file of profile {record.profile!r}, not 'ros2'"
                        )
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                        self._add_topic(record, schemas.get(record.schema_id))
                    elif isinstance(record, Message):
                        channel = channels.get(record.channel_id)
                        if channel is None:
                            raise BagError(path, f"has a message of no topic, {record.channel_id}")
                        self.topics[channel.topic].count += 1
                        schema = schemas.get(channel.schema_id)
                        yield RawMessage(
                            channel.topic,
                            schema.name if schema else "",
                            record.data,
                            record.log_time,
                            record.publish_time,
                            record.sequence,
                            channel,
                            schema,
                        )
            except _UNREADABLE as error:
                if isinstance(error, BagError):
                    raise
                raise BagError(path, _damage(error, bounded), _WHOLE) from error

    def _add_topic(self, channel: Channel, schema: Schema | None) -> None:
        if channel.topic not in self.topics:
            self.topics[channel.topic] = Topic(
                channel.topic,
                schema.name if schema else "",
                channel.metadata.get("topic_type_hash", ""),
                parse_qos(channel.metadata.get("offered_qos_profiles")),
            )

    def decode(self, raw: RawMessage) -> Any:
        """Decode a message; raises BagError if it does not fit its definition."""
        if raw.schema is None:
            raise BagError(self.path, f"has no definition of the messages on {raw.topic}")
        self._learn(raw.schema, raw.channel)
        try:
            return self._store.deserialize_cdr(raw.data, raw.type_name)
        except Exception as error:  # whatever the decoder trips over: the data is not ours
            raise BagError(
                self.path,
                f"a message on {raw.topic}, received at {raw.log_time} ns, is no "
                f"{raw.type_name}: {error or type(error).__name__}",
            ) from error

    def _learn(self, schema: Schema, channel: Channel) -> None:
        """Learn the types of a schema, once."""
        text = schema.data.decode(errors="replace")
        known = self._types.get(schema.name)
        if known == text:
            return
        if known is not None:
            raise BagError(self.path, f"has two different definitions of {schema.name}")
        if schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            raise BagError(
                self.path,
                f"{schema.name} is defined as {schema.encoding!r} and encoded as "
                f"{channel.message_encoding!r}",
                "definitions as 'ros2msg', messages as 'cdr'",
            )
        try:
            self._store.register(get_types_from_msg(text, schema.name))
            computed = self._store.hash_rihs01(schema.name)
        except Exception as error:  # whatever the parser trips over: the text is not ours
            raise BagError(
                self.path,
                f"the definition of {schema.name} cannot be read: "
                f"{str(error).splitlines()[0] if str(error) else type(error).__name__}",
            ) from error
        stated = channel.metadata.get("topic_type_hash", "")
        if stated.startswith("RIHS01_") and stated != computed:
            raise BagError(
                self.path, f"the definition of {schema.name} is not the one its hash is of"
            )
        self._types[schema.name] = text


class _Bounded:
    """A file that never allocates more than it holds, whatever length a damaged record claims."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size
        # What a crash of the machine leaves: blocks that were allotted and never written. As
        # records of length 0 they would be read nine bytes at a time.
        self._end = min(self.size, _end_of_data(stream, self.size) + _MOST_ZEROS)
        self.position = 0
        self.whole = 0
        """Where the last record that could be read ends."""

    def read(self, length: int) -> bytes:
        data = self._stream.read(max(0, min(length, self._end - self.position)))
        self.position += len(data)
        return data

    @property
    def exhausted(self) -> bool:
        """Whether all of it has been read, but for zeros at the end."""
        return self.position == self._end


def _end_of_data(stream: BinaryIO, size: int) -> int:
    """Where the zeros begin that a file ends with."""
    end = size
    while end > 0:
        start = max(0, end - _CHUNK)
        stream.seek(start)
        kept = stream.read(end - start).rstrip(b"\0")
        if kept:
            end = start + len(kept)
            break
        end = start
    stream.seek(0)
    return end


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise BagError(path, f"cannot be read: {error.strerror}") from None


def _records(path: Path, stream: _Bounded) -> Iterator[McapRecord]:
    """Records of a file, those of each chunk in its place, up to the end or the first error."""
    reader = StreamReader(
        stream,  # type: ignore[arg-type]  # it only reads
        emit_chunks=True,
        record_size_limit=stream.size,
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            _check_chunk(record)
            yield from breakup_chunk(record, validate_crc=True)
        else:
            yield record
        stream.whole = stream.position
        if isinstance(record, Footer):
            return


def _check_chunk(chunk: Chunk) -> None:
    """Refuse a chunk that would decompress to something else than it says, before it does."""
    size = chunk.uncompressed_size
    if chunk.compression == "":
        size = len(chunk.data)
    elif chunk.compression == "zstd":
        stated = zstandard.get_frame_parameters(chunk.data).content_size
        if stated != zstandard.CONTENTSIZE_UNKNOWN:
            size = stated
    if size != chunk.uncompressed_size or size > _CHUNK_LIMIT:
        raise ValueError(f"a chunk of {size} bytes")


def _damage(error: Exception, stream: _Bounded) -> str:
    if stream.whole == stream.size:
        return "has no end: what came after its last flush is lost"
    where = f"at byte {stream.whole} of {stream.size}"
    # The limit is the size of the file.
    short = (EndOfFile, RecordLengthLimitExceeded, struct.error)
    if isinstance(error, short) or stream.exhausted:
        return f"is cut off {where}"
    return f"is damaged {where}: {error or type(error).__name__}"
