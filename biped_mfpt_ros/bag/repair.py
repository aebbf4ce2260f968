"""Making a whole bag of what is left of a cut-off one."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.bag.metadata import parse_qos
from biped_mfpt_ros.bag.reader import Bag
from biped_mfpt_ros.bag.writer import BagWriter


@dataclass(frozen=True)
class Salvage:
    """What could be saved of a bag.

    Parameters
    ----------
    source, path : pathlib.Path
        The bag that was not whole, untouched, and the new one.
    counts : dict of str to int
        Messages saved, by topic.
    missing : list of str
        What could not be saved, in sentences; empty if everything could.
    """

    source: Path
    path: Path
    counts: dict[str, int]
    missing: list[str] = field(default_factory=list)


def salvage(bag: str | os.PathLike[str], new_bag: str | os.PathLike[str]) -> Salvage:
    """Copy the readable messages of a bag that is not whole into a new bag that is.

    Each of its files is read up to the first byte that makes no sense. Reading leaves the bag as
    it is. Also takes a whole bag, and then copies all of it.

    Parameters
    ----------
    bag : path-like
        The bag, or an MCAP file of it.
    new_bag : path-like
        Directory of the new bag; must not exist.

    Returns
    -------
    Salvage

    Raises
    ------
    BagError
        There is no bag, no message in it can be read, or `new_bag` exists.
    BagWriteError
        The new bag cannot be written.
    """
    source = Bag(bag, unfinished=True)
    missing: list[str] = []
    messages = source.raw_messages(on_error=missing.append)
    first = next(messages, None)
    if first is None:
        raise BagError(
            source.path, "; ".join(["no message in it can be read", *(missing or [source.fault])])
        )
    with BagWriter(new_bag) as writer:
        for message in chain([first], messages):
            schema, channel = message.schema, message.channel
            writer.add_topic(
                message.topic,
                message.type_name,
                schema.data.decode(errors="replace") if schema else "",
                channel.metadata.get("topic_type_hash", ""),
                parse_qos(channel.metadata.get("offered_qos_profiles")),
                schema.encoding if schema else "",
            )
            writer.write(
                message.topic,
                message.data,
                message.log_time,
                message.publish_time,
                message.sequence,
            )
        writer.custom["salvaged_from"] = source.path.name
        if missing:
            writer.custom["missing"] = "; ".join(missing)
    return Salvage(
        source.path, writer.path, {topic.name: topic.count for topic in writer.topics}, missing
    )
