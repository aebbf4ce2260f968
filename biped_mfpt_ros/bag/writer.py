"""Writing of a bag that stays readable whatever happens to its writer."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from mcap.writer import LIBRARY_IDENTIFIER, CompressionType, Writer

from biped_mfpt_ros import __version__
from biped_mfpt_ros.bag.error import BagError, BagWriteError
from biped_mfpt_ros.bag.metadata import Metadata, Topic, dump_yaml

_CHUNK_SIZE = 1 << 20
"""Bytes. Larger ones compress hardly better, and a chunk is held in memory until it is full."""


class BagWriter:
    """A rosbag2 bag, ``NAME/NAME_0.mcap`` and ``NAME/metadata.yaml``, while it is written.

    Messages gather in a chunk, which is written when it is full or at `flush`. All that is
    flushed survives the writer's sudden death. Only `close` writes metadata.yaml: a bag without
    it is not whole, and `biped_mfpt_ros.bag.salvage` makes a whole one of what it holds.

    Chunks are compressed with zstd, which every rosbag2 reads: it takes transition rows to a
    fraction of their size at a rate far above what they are produced at, and a cut-off chunk
    does not decompress, so that nothing of it passes for a message.

    As a context manager it closes the bag, unless there was an exception: the bag is left not
    whole then.

    Parameters
    ----------
    path : path-like
        Directory of the new bag. Its parents are made where needed.

    Raises
    ------
    BagError
        There is something at `path` already, or it cannot be made.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        allowed = "a new directory, of which nothing exists yet"
        if not self.path.name or self.path.name == "..":
            raise BagError(path, "is not the name of a new directory", allowed)
        try:
            self.path.mkdir(parents=True)
            file = self.path / f"{self.path.name}_0.mcap"
            self._stream = file.open("xb")
        except FileExistsError:
            raise BagError(path, "exists already", allowed) from None
        except OSError as error:
            raise BagError(path, f"cannot be made: {error.strerror}", allowed) from None
        self._metadata = Metadata([file.name], [], 0, 0)
        self._topics: dict[str, Topic] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._closed = False
        self._whole = 0  # bytes, up to the last flush that succeeded
        self._pending = 0  # bytes of messages since then
        self._writer = Writer(
            self._stream, chunk_size=_CHUNK_SIZE, compression=CompressionType.ZSTD
        )
        try:
            self._writer.start("ros2", f"biped_mfpt_ros {__version__}; {LIBRARY_IDENTIFIER}")
            self.flush()
        except OSError as error:
            self._fail(error)

    @property
    def custom(self) -> dict[str, str]:
        """Free text for metadata.yaml, to be added to until `close`."""
        return self._metadata.custom

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics so far, with what has been written of each."""
        return tuple(self._topics.values())

    def add_topic(
        self,
        name: str,
        type_name: str,
        definition: str,
        type_hash: str = "",
        qos_profiles: Sequence[dict[str, Any]] = (),
        encoding: str = "ros2msg",
    ) -> None:
        """Open a topic; one that is open already stays as it is.

        Parameters
        ----------
        name, type_name, type_hash, qos_profiles
            As in `biped_mfpt_ros.bag.metadata.Topic`.
        definition : str
            See `biped_mfpt_ros.bag.definitions.message_definition`.
        encoding : str
            Of the definition.
        """
        if name in self._topics:
            return
        topic = Topic(name, type_name, type_hash, list(qos_profiles))
        schema = (type_name, definition)
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(
                type_name, encoding, definition.encode()
            )
        self._channels[name] = self._writer.register_channel(
            name,
            "cdr",
            self._schemas[schema],
            {
                "offered_qos_profiles": dump_yaml(topic.qos_profiles),
                "topic_type_hash": type_hash,
            },
        )
        self._topics[name] = topic
        self._metadata.topics.append(topic)

    def write(
        self, topic: str, data: bytes, log_time: int, publish_time: int, sequence: int = 0
    ) -> None:
        """Write one message.

        Parameters
        ----------
        topic : str
            One that `add_topic` opened.
        data : bytes
            The message in CDR, with the four bytes that say so.
        log_time, publish_time : int
            ns since the epoch, when it was received and when it was sent.
        sequence : int
            The publisher's count of its messages, 0 where it has none.

        Raises
        ------
        BagWriteError
            The disk is full, or not writable. The bag is closed, and not whole.
        """
        self._check_open()
        try:
            self._writer.add_message(
                self._channels[topic], log_time, data, publish_time, sequence % 2**32
            )
        except OSError as error:
            self._fail(error)
        self._pending += len(data)
        if self._pending >= _CHUNK_SIZE:
            self.flush()
        metadata = self._metadata
        if metadata.count == 0:
            metadata.start = metadata.end = log_time
        metadata.start = min(metadata.start, log_time)
        metadata.end = max(metadata.end, log_time)
        self._topics[topic].count += 1

    def flush(self) -> None:
        """Hand everything written so far to the operating system.

        Raises
        ------
        BagWriteError
            As for `write`.
        """
        self._check_open()
        try:
            self._writer.flush()
            self._stream.flush()
            self._whole, self._pending = self._stream.tell(), 0
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Make it a whole bag. Nothing happens if it is closed already.

        Raises
        ------
        BagWriteError
            As for `write`.
        """
        if self._closed:
            return
        try:
            # rosbag2 keeps its metadata in the file too, for when metadata.yaml is lost.
            self._writer.flush()
            self._writer.add_metadata("rosbag2", {"serialized_metadata": self._metadata.to_yaml()})
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._metadata.write(self.path)
        except OSError as error:
            self._fail(error)
        self._closed = True

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        elif not self._closed:
            # Half of what was to be written must not pass for all of it.
            self._closed = True
            self._stream.close()

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError(f"bag {self.path} is closed")

    def _fail(self, error: OSError) -> NoReturn:
        self._closed = True
        with suppress(OSError):
            self._stream.close()
        # What was written of the rest is of no use, and the others need the space: to say why they
        # stop, at least.
        with suppress(OSError):
            os.truncate(self.path / self._metadata.files[0], self._whole)
        raise BagWriteError(
            error.errno,
            f"cannot be written: {error.strerror}; it is not whole, "
            f"{self._metadata.count} messages had been received",
            str(self.path),
        ) from error
