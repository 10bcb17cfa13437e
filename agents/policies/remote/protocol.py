"""Messages between a run and a policy in a process of its own: msgpack maps with their lengths in front.

A message is four bytes, its length, little end first, and so many bytes of msgpack: a map with `type`. The run speaks
first, and every message has one answer:

    {"type": "hello", "version": 1}               ->  {"type": "hello", "version": 1}
    {"type": "reset", "episode": {...}}           ->  {"type": "ready"}
    {"type": "act", "observation": {...}}         ->  {"type": "goals", "goals": [[x, y], ...]}

The policy may answer {"type": "error", "message": "..."} instead: its episode ends. Arrays are maps {dtype, shape,
data}: `int8`, `bool`, `float64`, ... and their bytes, row by row; goals may be one, or lists. The end of the input is
the end of the run. What episodes and observations hold: `maexp.agents.policies.remote.numpy_policy`.

Needs NumPy and msgpack alone.
"""

from __future__ import annotations

import struct
from typing import Any, BinaryIO

import msgpack
import numpy as np

VERSION = 1
HEAD = struct.Struct("<I")
MOST_ANSWER = 2**20  # bytes of an answer; goals of 64 robots take two thousand
MOST_NUMBERS = 2**16  # in an answer
DEPTH = 4  # of an answer: map, lists of lists of numbers
KINDS = ("int8", "int16", "int32", "int64", "uint8", "bool", "float32", "float64")


def pack(message: dict[str, Any]) -> bytes:
    """A message as it goes over the wire."""
    body = msgpack.packb(message, default=_pack_array)
    return HEAD.pack(len(body)) + body


def unpack(body: bytes) -> dict[str, Any]:
    """The message of a body, with arrays as arrays.

    Raises:
        ValueError: it is no map with a type.
    """
    try:
        message = msgpack.unpackb(
            body,
            object_hook=_unpack_array,
            max_array_len=MOST_NUMBERS,
            max_map_len=64,
            strict_map_key=True,
            max_ext_len=0,
        )
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError) as error:
        raise ValueError(f"is no msgpack ({type(error).__name__}: {' '.join(str(error).split())[:120]})") from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ValueError("is no map with a type")
    if not _is_plain(message):
        raise ValueError(f"holds more than numbers, words and lists of numbers, or nests deeper than {DEPTH}")
    return message


def _is_plain(value: Any, depth: int = DEPTH) -> bool:
    """Whether a value can be printed and made an array: of lists of words NumPy makes gigabytes."""
    if isinstance(value, dict):
        return depth > 0 and all(_is_plain(item, depth - 1) for item in value.values())
    if isinstance(value, list):
        return depth > 0 and all(not isinstance(item, str | bytes) and _is_plain(item, depth - 1) for item in value)
    return True


def read(stream: BinaryIO) -> dict[str, Any] | None:
    """The next message of a stream, for a policy; None: the run is over."""
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    (length,) = HEAD.unpack(head)
    return msgpack.unpackb(stream.read(length), object_hook=_unpack_array)


def write(stream: BinaryIO, message: dict[str, Any]) -> None:
    """An answer, for a policy."""
    stream.write(pack(message))
    stream.flush()


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.name not in KINDS:
            raise TypeError(f"an array of {value.dtype} cannot be sent: give one of {', '.join(KINDS)}")
        return {"dtype": value.dtype.name, "shape": list(value.shape), "data": np.ascontiguousarray(value).tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _unpack_array(value: dict) -> Any:
    if value.keys() != {"dtype", "shape", "data"}:
        return value
    kind, shape, data = value["dtype"], value["shape"], value["data"]
    known = isinstance(kind, str) and kind in KINDS and isinstance(data, bytes)
    if not known or not isinstance(shape, list) or not all(type(size) is int and 0 <= size < 2**31 for size in shape):
        raise ValueError(f"an array of {kind!r} and shape {str(shape)[:60]}")
    return np.frombuffer(data, np.dtype(kind).newbyteorder("<")).reshape(shape).astype(kind)
