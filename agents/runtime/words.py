"""What robots tell each other of themselves, as text: a `Word` without maps, in JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

from .contacts import Contact, Memory
from .robot import Word

LONGEST = 100_000  # characters of a word that is read
FURTHEST = 1e9  # numbers beyond are none
LATEST = 1e12  # times, too [s]


def write_word(word: Word) -> str:
    """In JSON; numbers are told to the last bit."""
    memory = None if word.memory is None else asdict(word.memory)
    plain = {name: getattr(word, name) for name in ("name", "pose", "speed", "time", "hears")}
    return json.dumps(plain | {"memory": memory})


def read_word(text: str) -> Word:
    """What `write_word` has written.

    Raises:
        ValueError: it is something else.
    """
    try:
        if len(text) > LONGEST:
            raise ValueError
        found = json.loads(text)
        pose = _numbers(found["pose"], 3)
        memory = None if found["memory"] is None else _read_memory(found["memory"])
        hears = {_name(name): _number(time, LATEST) for name, time in found["hears"].items()}
        name, speed, time = _name(found["name"]), _number(found["speed"]), _number(found["time"], LATEST)
        return Word(name, pose, speed, time, memory=memory, hears=hears)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        raise ValueError("what came is no word of a robot") from None


def _read_memory(found: dict[str, Any]) -> Memory:
    met = {_name(name): _read_contact(contact) for name, contact in found["met"].items()}
    flags = found["linked"], found["tells"]
    if not all(isinstance(flag, bool) for flag in flags):
        raise ValueError
    return Memory(_numbers(found["at"], 2), _number(found["driven"]), _number(found["known"]), *flags, met)


def _read_contact(found: dict[str, Any]) -> Contact:
    place = _numbers(found["place"], 2)
    return Contact(_number(found["used"]), place, _number(found["known"]), _number(found["driven"]))


def _name(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError
    return value


def _number(value: Any, most: float = FURTHEST) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > most:
        raise ValueError
    return float(value)


def _numbers(values: Any, count: int) -> Any:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError
    return tuple(map(_number, values))
