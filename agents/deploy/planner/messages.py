"""Messages between robots that plan for themselves: poses, goals and heartbeats, checked when they arrive."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from numbers import Real
from typing import Any

from maexp.agents.deploy.planner.frames import Maps, OccupancyGrid, check_map, is_newer
from maexp.agents.deploy.planner.radio_features import BASE, Contact, Memory
from maexp.agents.deploy.planner.team import check_pose

LONGEST = 100_000  # characters of a word that is read
FURTHEST = 1e9  # numbers beyond are none
LATEST = 1e12  # times, too [s]


@dataclass(frozen=True)
class Word:
    """What a robot tells of itself.

    Attributes:
        name: its name.
        pose: x, y [m] and yaw [rad] in the frame that all robots share.
        speed: [m/s]
        time: of the pose, by a clock that all robots share [s].
        grids: its own map and those that it has heard, by the names of the robots that made them, each with the time of
            that robot's clock at which it was so [s]; none: the caller merges grids.
        memory: what it knows of radios; None: its policy does not look at that.
        hears: whom it has heard of not long ago, from themselves or over others, and the times of their last words [s].
    """

    name: Hashable
    pose: tuple[float, ...]
    speed: float
    time: float
    grids: Maps = field(default_factory=dict)
    memory: Memory | None = None
    hears: Mapping[Any, float] = field(default_factory=dict)


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
        hears = {name: _number(time, LATEST) for name, time in found["hears"].items()}
        name, speed, time = _name(found["name"]), _number(found["speed"]), _number(found["time"], LATEST)
        return Word(name, pose, speed, time, memory=memory, hears=hears)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        raise ValueError("what came is no word of a robot") from None


def check_word(word: Any, names: Iterable[Any], notes: list[str]) -> Word | None:
    """What counts of a word that came; what is odd is left out of it, and noted. Its maps are left to `check_told`.

    Args:
        word: what came.
        names: of robots; its own must sort with them, but for `BASE`.
        notes: what is left out is added in a sentence.

    Returns:
        None: nothing counts: it is no `Word`, or its name or time is none.
    """
    if not isinstance(word, Word):
        notes.append(f"a {type(word).__name__} came, which is no Word: it is left out")
        return None
    of = f"the word of {show(word.name)}"
    try:
        sorted({word.name, *names} - {BASE})
    except TypeError:
        notes.append(f"{of} is left out: its name must be hashable, and sort with those of the other robots")
        return None
    if not _is_time(word.time):
        notes.append(f"{of} is left out: time={show(word.time)} must be a number of seconds")
        return None
    odd: dict[str, Any] = {}
    try:
        check_pose(word.name, word.pose)
    except ValueError:
        notes.append(f"{of}: pose={show(word.pose)} is left out: it must be x, y [m] and, if known, yaw [rad]")
        odd["pose"] = None
    if not isinstance(word.grids, Mapping):
        notes.append(f"{of}: grids={show(word.grids)} is left out: it must be {{name: (time, grid)}}")
        odd["grids"] = {}
    if not (isinstance(word.hears, Mapping) and all(map(_is_time, word.hears.values()))):
        notes.append(f"{of}: hears={show(word.hears)} is left out where it is not {{name: seconds}}")
        hears = word.hears.items() if isinstance(word.hears, Mapping) else ()
        odd["hears"] = {name: time for name, time in hears if _is_time(time)}
    if word.memory is not None and not _is_memory(word.memory):
        notes.append(f"{of}: memory={show(word.memory)} is left out: it must be a Memory of finite numbers")
        odd["memory"] = None
    return replace(word, **odd) if odd else word


def check_told(
    told: Any, last: tuple | None, itself: bool, notes: list[str] | None = None, name: str = "grid"
) -> tuple[float, OccupancyGrid] | None:
    """A map that came with its time; None: it is not newer than the `last` one.

    Args:
        told, last, itself: of `is_newer`.
        notes, name: of `check_map`.

    Raises:
        ValueError: it is none.
    """
    try:
        time, grid = told
    except (TypeError, ValueError):
        raise ValueError(f"{show(told)} must be (time, grid)") from None
    if not _is_time(time):
        raise ValueError(f"its time={show(time)} must be a number of seconds")
    return (time, check_map(grid, notes, name)) if is_newer((time,), last, itself) else None


def show(value: Any) -> str:
    """A value in a note, shortened to a part of a line."""
    return " ".join(reprlib.repr(value).split())


def _is_time(value: Any) -> bool:
    try:
        _number(value, math.inf)
    except (ValueError, OverflowError):
        return False
    return True


def _is_memory(memory: Any) -> bool:
    try:
        met = {name: vars(contact) for name, contact in memory.met.items()}
        _read_memory(vars(memory) | {"met": met})
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return False
    return isinstance(memory, Memory)


def _read_memory(found: Mapping[str, Any]) -> Memory:
    met = {name: _read_contact(contact) for name, contact in found["met"].items()}
    flags = found["linked"], found["tells"]
    if not all(isinstance(flag, bool) for flag in flags):
        raise ValueError
    return Memory(_numbers(found["at"], 2), _number(found["driven"]), _number(found["known"]), *flags, met)


def _read_contact(found: Mapping[str, Any]) -> Contact:
    place = _numbers(found["place"], 2)
    return Contact(_number(found["used"]), place, _number(found["known"]), _number(found["driven"]))


def _name(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError
    return value


def _number(value: Any, most: float = FURTHEST) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ValueError
    number = float(value)
    if not math.isfinite(number) or abs(number) > most:
        raise ValueError
    return number


def _numbers(values: Any, count: int) -> Any:
    if len(values) != count:
        raise ValueError
    return tuple(map(_number, values))


class Beats:
    """When radios spoke last, as far as that was heard, from themselves or over others.

    Only who speaks makes a new time. So what goes round in circles does not keep anybody connected who is silent.

    Attributes:
        times: of the last word of each radio [s].
    """

    def __init__(self):
        self.times: dict[Hashable, float] = {}
        self._lately: set[Hashable] = set()

    def hear(self, speaker: Hashable, time: float) -> None:
        """A word has come from somebody itself, of a time [s]."""
        if time >= self.times.get(speaker, time):
            self.times[speaker] = time
            self._lately.add(speaker)

    def hear_of(self, times: Mapping[Any, float]) -> None:
        """Somebody has told of others, as `tell` has it."""
        for name, time in times.items():
            if name not in self.times or time > self.times[name]:
                self.times[name] = time
                self._lately.add(name)

    def take_lately(self) -> set[Hashable]:
        """Who has spoken since the last call."""
        lately, self._lately = self._lately, set()
        return lately

    def tell(self, since: float) -> dict[Hashable, float]:
        """Who has spoken at that time [s] or later, and when."""
        return {name: time for name, time in self.times.items() if time >= since}

    def forget_later(self, time: float) -> None:
        """What claims to be of later than that [s] would hide what comes next."""
        self.times = {name: told for name, told in self.times.items() if told <= time}
        self._lately &= self.times.keys()
