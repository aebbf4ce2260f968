"""Checking that no message is missing, from the counters that the messages carry."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

_LENGTH = {0: struct.Struct(">I"), 1: struct.Struct("<I")}
_COUNTER = {0: struct.Struct(">Q"), 1: struct.Struct("<Q")}


def leading_sequence(data: bytes) -> int:
    """The ``sequence`` of a message that starts with a string and ``uint64 sequence``.

    All messages of biped_mfpt_msgs that are published on topics do. Reading it here saves
    decoding megabytes of arrays for the sake of one number.

    Parameters
    ----------
    data : bytes
        The message in CDR (XCDR1), with the four bytes that say so.

    Raises
    ------
    ValueError
        It is too short, or in another encoding.
    """
    if len(data) < 8 or data[0] != 0 or data[1] not in _LENGTH:
        raise ValueError("not a message in CDR")
    (length,) = _LENGTH[data[1]].unpack_from(data, 4)
    # Alignment counts from after the four bytes of encapsulation.
    offset = 4 + (4 + length + 7) // 8 * 8
    if len(data) < offset + 8:
        raise ValueError("message too short")
    return _COUNTER[data[1]].unpack_from(data, offset)[0]


@dataclass
class SequenceCheck:
    """Which messages of one topic are missing.

    Every publisher counts its messages on the topic from 0. Where a message's publisher is not
    known, as in a bag, it is taken to be the one whose next message it is; a 0 is the first of
    another publisher.

    Parameters
    ----------
    complete : bool
        Whether messages from before the first one received count as missing. They do where the
        topic is latched.
    """

    complete: bool = True
    received: int = 0
    missing: int = 0
    repeated: int = 0
    _next: dict[object, int] = field(default_factory=dict)

    @property
    def published(self) -> int:
        """Messages that must have been published, going by their counters."""
        return self.received - self.repeated + self.missing

    def add(self, sequence: int, publisher: object = None) -> str:
        """Count one message.

        Parameters
        ----------
        sequence : int
            Its counter.
        publisher : hashable, optional
            Who sent it.

        Returns
        -------
        str
            What is wrong with it, empty if nothing is.
        """
        self.received += 1
        key = self._guess(sequence) if publisher is None else publisher
        expected = self._next.get(key)
        if expected is None:
            expected = 0 if self.complete else sequence
        if sequence < expected:
            self.repeated += 1
            return f"message {sequence} came again, or out of order"
        self._next[key] = sequence + 1
        if sequence == expected:
            return ""
        self.missing += sequence - expected
        last = sequence - 1
        gone = f"message {last} is" if last == expected else f"messages {expected} to {last} are"
        return f"{gone} missing"

    def _guess(self, sequence: int) -> object:
        """Key of the stream that the message belongs to most likely."""
        expecting = {key: next_ for key, next_ in self._next.items() if next_ <= sequence}
        if sequence == 0 or not expecting:
            # Nobody's next message: a publisher not seen before, or the repetition of a message
            # where there is but one publisher.
            known = len(self._next)
            return 0 if sequence and known == 1 else known
        return max(expecting, key=lambda key: expecting[key])
