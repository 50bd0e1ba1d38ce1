"""Spoiling messages and files at random: numbers, texts and lengths in messages, bytes in what is serialised.

Everything takes a `random.Random`, of which Hypothesis' `st.randoms(use_true_random=False)` gives one that it can
replay and shrink.
"""

from __future__ import annotations

import array
import copy
import dataclasses
import math
from random import Random
from typing import Any

import numpy as np

FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1.0, 0.5, 1e-300, -1e-9, 1e9, -1e9, 1.7e308, 640.0)
TEXTS = ("", " ", "a" * 5000, "camera", "plumb_bob", "rgb8", "16UC1", "32FC1", "jpeg", "ünïcödé\t\n", "x\x00y", "../..")
MOST_SPOILT = 4  # fields of one message
LENGTHS = (0, 1, 3, 4, 5, 16, 64)


def is_message(value: Any) -> bool:
    """Whether it has fields: of rclpy, or of a bag."""
    return hasattr(value, "get_fields_and_field_types") or dataclasses.is_dataclass(value)


def fields_of(message: Any) -> list[str]:
    """Names of the fields of a message."""
    if hasattr(message, "get_fields_and_field_types"):
        return list(message.get_fields_and_field_types())
    return [field.name for field in dataclasses.fields(message) if field.name != "__msgtype__"]


def leaves(message: Any) -> list[tuple[Any, str]]:
    """Every field that is no message itself, as (message, name); lists of messages count and are entered."""
    found = []
    for name in fields_of(message):
        value = getattr(message, name)
        if is_message(value):
            found += leaves(value)
            continue
        found.append((message, name))
        if isinstance(value, list):
            found += [leaf for entry in value if is_message(entry) for leaf in leaves(entry)]
    return found


def spoilt_message(message: Any, random: Random, lengths_too: bool) -> Any:
    """A copy with one to `MOST_SPOILT` fields replaced by values of the same type.

    Args:
        lengths_too: also give arrays of fixed length another one, as a definition of another version would; rclpy
            refuses that.
    """
    spoilt = copy.deepcopy(message)
    for _ in range(random.randint(1, MOST_SPOILT)):
        owner, name = random.choice(leaves(spoilt))
        value = _spoilt(getattr(owner, name), random, lengths_too)
        setattr(owner, name, value % 256 if _is_octet(owner, name) else value)
    return spoilt


def _is_octet(message: Any, name: str) -> bool:
    """Whether a field is one octet: rclpy, told to check fields, gives it nothing larger."""
    types = getattr(message, "get_fields_and_field_types", dict)()
    return types.get(name) in ("uint8", "octet")


def _spoilt(value: Any, random: Random, lengths_too: bool) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, (float, np.floating)):
        return random.choice(FLOATS)
    if isinstance(value, (int, np.integer)):
        return _integer(int(value), random)
    if isinstance(value, str):
        return random.choice(TEXTS)
    if isinstance(value, array.array):
        return array.array(value.typecode, _spoilt_array(np.array(value), random, True))
    if isinstance(value, np.ndarray):
        return _spoilt_array(value, random, lengths_too)
    if isinstance(value, list):
        return _spoilt_list(value, random)
    return value


def _integer(value: int, random: Random) -> int:
    """One that every integer field of our messages can hold, except octets."""
    return random.choice((0, 1, value + 1 if value < 100_000 else value, 2**16, 999_999_999, 2**31 - 1))


def _spoilt_array(values: np.ndarray, random: Random, lengths_too: bool) -> np.ndarray:
    if lengths_too and random.random() < 0.3:
        return np.resize(values, random.choice(LENGTHS)) if values.size else np.zeros(3, values.dtype)
    spoilt = values.copy()
    for _ in range(random.choice((1, 1, 4, 40)) if spoilt.size else 0):
        k = random.randrange(spoilt.size)
        spoilt[k] = random.choice(FLOATS) if spoilt.dtype.kind == "f" else random.randrange(256)
    return spoilt


def _spoilt_list(values: list[Any], random: Random) -> list[Any]:
    """Without an entry, with one twice, in another order, or empty."""
    if not values:
        return values
    kind, k = random.randrange(4), random.randrange(len(values))
    if kind == 0:
        return values[:k] + values[k + 1 :]
    if kind == 1:
        return [*values, copy.deepcopy(values[k])]
    if kind == 2:
        return values[::-1]
    return []


def spoilt_bytes(data: bytes, random: Random) -> bytes:
    """Cut off, with other bits, with other lengths in it, with a piece twice or left out, or noise altogether."""
    if not data:
        return random.randbytes(8)
    kind, k = random.randrange(6), random.randrange(len(data))
    spoilt = bytearray(data)
    if kind == 0:
        del spoilt[k:]
    elif kind == 1:
        for _ in range(random.choice((1, 1, 3, 20))):
            spoilt[random.randrange(len(spoilt))] ^= 1 << random.randrange(8)
    elif kind == 2:
        at = k - k % 4
        length = random.choice((2**32 - 1, 2**31, 2**31 - 1, 2**16, 0, 1, len(data)))
        spoilt[at : at + 4] = length.to_bytes(4, "little")
    elif kind == 3:
        spoilt[k:k] = data[k : k + random.choice((1, 4, 100))]
    elif kind == 4:
        del spoilt[k : k + random.choice((1, 4, 100))]
    else:
        spoilt = bytearray(random.randbytes(random.randrange(200)))
    return bytes(spoilt)
