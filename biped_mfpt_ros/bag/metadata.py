"""metadata.yaml, version 9 of rosbag2: what a whole bag holds.

The file is what tells a whole bag from one that is being recorded or whose recorder died: it is
written last, under another name, and renamed when it is complete.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from biped_mfpt_ros.bag.error import BagError
from biped_mfpt_ros.files import whole_file

FILE_NAME = "metadata.yaml"
VERSION = 9
STARTED_LATE = "started_late"
"""Key of `Metadata.custom` in a bag whose recorder was told to leave out what had been published
before: its counters may begin anywhere."""
_ROOT = "rosbag2_bagfile_information"
# rosbag2 gives an empty bag the latest time that it can express.
_NEVER = 2**63 - 1


@dataclass
class Topic:
    """A topic of a bag.

    Parameters
    ----------
    name : str
        Absolute name.
    type_name : str
        Such as ``biped_mfpt_msgs/msg/MeshInfo``.
    type_hash : str
        Type description hash, ``RIHS01_`` and 64 hexadecimal digits; empty if not known.
    qos_profiles : list of dict
        What each publisher offers, with the keys of rosbag2.
    count : int
        Number of messages.
    """

    name: str
    type_name: str
    type_hash: str = ""
    qos_profiles: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0


@dataclass
class Metadata:
    """What metadata.yaml says.

    Parameters
    ----------
    files : list of str
        Names of the bag's MCAP files, in order.
    topics : list of Topic
    start, end : int
        ns since the epoch, earliest and latest time a message was received; both 0 without one.
    custom : dict
        Free text by free key.
    """

    files: list[str]
    topics: list[Topic]
    start: int
    end: int
    custom: dict[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of messages in the bag."""
        return sum(topic.count for topic in self.topics)

    def to_yaml(self) -> str:
        """Text of the inner part, as the MCAP file itself carries it too."""
        return dump_yaml(self._to_dict())

    def write(self, directory: Path) -> None:
        """Write metadata.yaml, whole or not at all.

        Raises
        ------
        OSError
            The disk is full, or not writable.
        """
        with whole_file(directory / FILE_NAME) as file:
            file.write(dump_yaml({_ROOT: self._to_dict()}).encode())

    def _to_dict(self) -> dict[str, Any]:
        time: dict[str, Any] = {
            "duration": {"nanoseconds": self.end - self.start},
            "starting_time": {"nanoseconds_since_epoch": self.start if self.count else _NEVER},
            "message_count": self.count,
        }
        return {
            "version": VERSION,
            "storage_identifier": "mcap",
            **time,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": topic.qos_profiles,
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in self.topics
            ],
            # Of whole files; the compression of an MCAP file's chunks is the file's own matter.
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": self.files,
            "files": [{"path": name, **time} for name in self.files],
            "custom_data": self.custom or None,
            "ros_distro": os.environ.get("ROS_DISTRO", ""),
        }


def dump_yaml(data: object) -> str:
    """YAML text in rosbag2's order and block style."""

    class Dumper(yaml.SafeDumper):
        # An anchor for a part that occurs twice is correct, but rosbag2 writes it out.
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return yaml.dump(data, Dumper=Dumper, sort_keys=False, allow_unicode=True, width=10**6)


def parse_qos(text: object) -> list[dict[str, Any]]:
    """QoS profiles from the YAML text in an MCAP channel; none if it is not such text."""
    if not isinstance(text, str):
        return []
    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return []
    if isinstance(profiles, list) and all(isinstance(profile, dict) for profile in profiles):
        return profiles
    return []


def read_metadata(directory: Path) -> Metadata:
    """Read a bag's metadata.yaml.

    Parameters
    ----------
    directory : pathlib.Path
        The bag. Its metadata.yaml may be of any version of rosbag2.

    Raises
    ------
    BagError
        The file is not what rosbag2 writes, or describes a bag that is not of plain MCAP files.
    """
    path = directory / FILE_NAME
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BagError(path, f"cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagError(path, f"is not YAML: {reason}") from None
    if not isinstance(content, dict) or not isinstance(content.get(_ROOT), dict):
        raise BagError(path, f"is not of a bag: it has no {_ROOT}")
    try:
        return _from_dict(content[_ROOT], path)
    except BagError:
        raise
    except KeyError as error:
        raise BagError(path, f"has no {error.args[0]}") from None
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise BagError(path, f"is not what rosbag2 writes: {error}") from None


def _from_dict(content: dict[str, Any], path: Path) -> Metadata:
    storage = content["storage_identifier"]
    if storage != "mcap":
        raise BagError(path, f"the bag's storage is {storage!r}, not 'mcap'")
    if content.get("compression_mode"):
        raise BagError(path, "the bag's files or messages are compressed one by one")
    files = []
    for name in content["relative_file_paths"]:
        # Early versions of rosbag2 put the bag's own directory before the name.
        files.append(Path(name).name)
        if not files[-1]:
            raise ValueError(f"{name!r} is not a file name")
    topics = [
        Topic(
            name=str(entry["topic_metadata"]["name"]),
            type_name=str(entry["topic_metadata"]["type"]),
            type_hash=str(entry["topic_metadata"].get("type_description_hash", "")),
            count=_count(entry["message_count"]),
        )
        for entry in content["topics_with_message_count"]
    ]
    count = _count(content["message_count"])
    if count != sum(topic.count for topic in topics):
        raise ValueError(f"message_count {count} is not the sum over its topics")
    start = _count(content["starting_time"]["nanoseconds_since_epoch"]) if count else 0
    duration = _count(content["duration"]["nanoseconds"]) if count else 0
    custom = content.get("custom_data") or {}
    return Metadata(
        files, topics, start, start + duration, {str(k): str(v) for k, v in custom.items()}
    )


def _count(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is not a count")
    return value
