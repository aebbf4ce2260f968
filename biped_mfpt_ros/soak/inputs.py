"""Input that is mostly right: numbers, texts, bytes and messages with something wrong in them."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np

_NUMBERS = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, -1.0, 5e-324, -5e-324, 1e-300, 1e-12, 1e12,
    1e154, -1e300, 1.7976931348623157e308, 2.0**53, 2.0**63, -(2.0**63), 0.1, math.pi,
)  # fmt: skip

_TEXTS = (
    "", " ", "x", "hzd", "hzd/base", "smc/mfpt", "hzd/none", "nan", "-1", "../../etc/passwd", "\0",
    "%s%n", "{}", "é", "\u202e", "\U0001f9bf", "a" * 1000, "x" * 100_000, "\n\n", "'\"`$(id)",
)  # fmt: skip

_BITS = {"int8": 8, "int16": 16, "int32": 32, "int64": 64}
_CODES = {"double": "d", "float": "f", "uint8": "B", "uint32": "I", "uint64": "Q"}
MOST_ITEMS = 3000
"""Longest that a field of a message is made: enough to be beyond every bound of a small node."""


def number(random: Random, usual: float = 1.0) -> float:
    """A number: often the usual one, or near it, else one that hurts."""
    kind = random.random()
    if kind < 0.2:
        return usual
    if kind < 0.4:
        return usual * (1.0 + random.gauss(0.0, 0.1))
    if kind < 0.6:
        return usual * 10.0 ** random.uniform(-9.0, 9.0)
    if kind < 0.7:
        return random.uniform(-100.0, 100.0)
    return random.choice(_NUMBERS)


def whole(random: Random, bits: int = 32, signed: bool = False) -> int:
    """A whole number of so many bits."""
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    value = random.choice((low, high, 0, 1, 2, 255, 65535, random.randrange(low, high + 1)))
    return min(max(value, low), high)


def text(random: Random, usual: str = "x") -> str:
    """A text: the usual one, one that hurts, or the usual one with a character changed."""
    kind = random.random()
    if kind < 0.3 or not usual:
        return random.choice(_TEXTS)
    if kind < 0.6:
        return usual
    at = random.randrange(len(usual))
    return usual[:at] + random.choice("\0 x-/é9.") + usual[at + 1 :]


def spoilt(random: Random, data: bytes) -> bytes:
    """Bytes with some of them changed, cut away, repeated or put in."""
    out = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 5))):
        at = random.randrange(len(out) + 1)
        length = random.choice((1, 1, 2, 4, 8, 64))
        kind = random.randrange(7)
        if kind == 0:
            out[at : at + length] = random.randbytes(len(out[at : at + length]))
        elif kind == 1 and at < len(out):
            out[at] ^= 1 << random.randrange(8)
        elif kind == 2:
            del out[at:]
        elif kind == 3:
            del out[at : at + length]
        elif kind == 4:
            out[at:at] = random.randbytes(length)
        elif kind == 5:
            out[at : at + length] = random.choice((b"\0", b"\xff")) * len(out[at : at + length])
        else:
            out[at:at] = out[at : at + 64]
    return bytes(out)


def spoil(random: Random, message: Any, changes: int | None = None) -> Any:
    """Change some fields of a ROS message, at any depth, to others of their type.

    Parameters
    ----------
    random : random.Random
        Decides which, and to what.
    message : object
        The message; changed in place.
    changes : int, optional
        How many fields; by default 0 to 3.

    Returns
    -------
    object
        The message.
    """
    for _ in range(random.choice((0, 1, 1, 1, 2, 3)) if changes is None else changes):
        _spoil_one(random, message)
    return message


def _spoil_one(random: Random, message: Any) -> None:
    name, kind = random.choice([*message.get_fields_and_field_types().items()])
    value = getattr(message, name)
    if kind.startswith("sequence<"):
        inner = kind[len("sequence<") : -1]
        if "/" in inner:
            if value:
                _spoil_one(random, random.choice(value))
        elif inner == "string":
            setattr(message, name, items(random, value, lambda usual: text(random, usual or "x")))
        else:
            changed = items(random, value, lambda usual: _scalar(random, inner, usual))
            code = _CODES.get(inner)
            setattr(message, name, changed if code is None else array(code, changed))
    elif "/" in kind:
        _spoil_one(random, value)
    elif kind.endswith("]"):  # an array of fixed length: a name of a goal
        setattr(message, name, np.frombuffer(random.randbytes(value.nbytes), value.dtype))
    else:
        setattr(message, name, _scalar(random, kind, value))


def items(random: Random, values: Sequence[Any], make: Any) -> list[Any]:
    """A list with something wrong in it; ``make`` gives an item in place of another, or of None."""
    out = list(values)
    kind = random.random()
    if kind < 0.5 and out:
        for _ in range(random.choice((1, 1, 2, 5))):
            at = random.randrange(len(out))
            out[at] = make(out[at])
    elif kind < 0.6:
        out = []
    elif kind < 0.7 and out:
        del out[random.randrange(len(out))]
    elif kind < 0.8:
        out.insert(random.randrange(len(out) + 1), make(None))
    elif kind < 0.85 and out:
        out = (out * MOST_ITEMS)[: random.randrange(MOST_ITEMS)]
    elif kind < 0.9:
        random.shuffle(out)
    else:
        out = [make(out[i] if i < len(out) else None) for i in range(random.randrange(40))]
    return out


def _scalar(random: Random, kind: str, usual: Any) -> Any:
    if kind in ("double", "float"):
        value = number(random, 1.0 if usual is None else usual)
        # A float is refused by the message itself when it is too large.
        return value if kind == "double" or not 3.4e38 < abs(value) < math.inf else 0.0
    if kind == "boolean":
        return random.random() < 0.5
    if kind == "string":
        return text(random, usual or "x")
    if kind in ("octet", "byte", "char"):
        return usual
    unsigned = kind.startswith("u")
    bits = _BITS[kind.removeprefix("u")]
    if usual is not None and random.random() < 0.5:
        low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return min(max(int(usual) + random.choice((-1, 1)), low), high)
    return whole(random, bits, not unsigned)
