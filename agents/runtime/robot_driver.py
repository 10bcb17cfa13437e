"""A ROS 2 robot that plans for itself: its messages and what it has heard of its mates in, its goal and word out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .driver import Decision, DriverSettings, TeamDriver
from .frames import OccupancyGrid, Pose, is_newer, merge_grids, read_map, read_time, span
from .grid import MAX_CELLS
from .planner import Plan
from .robot import RobotPlanner, Word
from .words import FURTHEST, read_word

FINEST = 1e-3  # edge of a cell of a map that is read [m]


@dataclass(frozen=True)
class Told:
    """A mate's own map in the team's frame, and the message that it came by, to be passed on."""

    grid: OccupancyGrid
    message: Any


def map_topic(speaker: str, source: str) -> str:
    """Where a robot tells the own map of a robot, itself or another."""
    return f"/{speaker}/maexp/{'' if speaker == source else f'heard/{source}/'}map"


class RobotDriver(TeamDriver):
    """A `TeamDriver` of one robot of a team, `settings.only`, without a central planner.

    Words carry times of ROS, by the clock that all robots share, and places in the team's frame.

    Args:
        settings: of the team.

    Raises:
        ValueError: as for `TeamDriver`; no robot is named.
    """

    def __init__(self, settings: DriverSettings):
        if not settings.only:
            raise ValueError("only= must name the robot that is driven")
        self.name = settings.only
        self.mates = tuple(name for name in settings.robots if name != settings.only)
        self.words: dict[str, Word] = {}  # the last of each mate
        self.told: dict[str, tuple[float, Told]] = {}  # of each mate the newest map, and since when it is so [s]
        super().__init__(settings)

    def begin(self, episode: dict[str, Any] | None = None, now: float | None = None) -> None:
        """As `TeamDriver.begin`: what mates have told before an arena's episode is forgotten; who was faster may have
        told of it already."""
        super().begin(episode, now)
        self.shown: tuple[float, OccupancyGrid] | None = None  # this robot's map, and since when it is so [s]
        self.passed: dict[str, float] = {}  # times of the maps that were passed on
        for word in self.words.values():
            self.hear(word)

    def _make_planner(self) -> RobotPlanner:
        given = self.settings
        return RobotPlanner(self.name, given.policy, memory=given.memory, mates=self.mates, **self._options())

    def hear(self, word: Word) -> bool:
        """Take in a mate's word; whether it is one, and of this episode."""
        if word.name not in self.mates:
            return False
        self.words[word.name] = word
        self.begun = word.time if self.begun is None else self.begun
        if not self._counts(word.time):
            return False
        self.planner.hear(replace(word, time=self._since(word.time)))
        return True

    def take_word(self, name: str, text: str) -> bool:
        """What came on a mate's /NAME/maexp/word, as `write_word` writes it; whether it counts.

        Raises:
            ValueError: it is none, or not its.
        """
        word = read_word(text)
        if word.name != name:
            raise ValueError(f"a word of {word.name!r} came")
        return self.hear(word)

    def map_topics(self) -> dict[str, str]:
        """Where mates tell maps, their own and those that they have heard; the names of the robots that made these."""
        return {map_topic(speaker, source): source for speaker in self.mates for source in self.mates}

    def take_known(self, source: str, message) -> None:
        """What came on one of `map_topics`, a nav_msgs/OccupancyGrid in the team's frame.

        One that is not newer than the last of that robot changes nothing.

        Raises:
            ValueError: it is of no mate, in another frame, none, or larger than is planned on.
        """
        if source not in self.mates:
            raise ValueError(f"a map of {source} came, who is no mate")
        time = read_time(message.header.stamp)
        if not is_newer((time,), self.told.get(source), False):
            return
        frame = message.header.frame_id.lstrip("/")
        if frame != self._root:
            raise ValueError(f"a map in the frame {frame} is not known")
        grid = read_map(message)
        numbers = (grid.resolution, *grid.origin)
        if not all(map(math.isfinite, numbers)) or grid.resolution < FINEST or max(map(abs, numbers)) > FURTHEST:
            raise ValueError(f"a map with cells of {grid.resolution:g} m at {grid.origin} is none")
        if grid.values.size == 0 or grid.values.size > MAX_CELLS:
            raise ValueError(
                f"a map of {grid.values.size:,} cells: more than none, and at most {MAX_CELLS:,}, are read"
            )
        self.told[source] = time, Told(grid, message)

    def has_heard(self, name: str, now: float) -> bool:
        """Whether a mate has spoken at `now` [s] or since."""
        return name in self.words and self.words[name].time >= now

    def _counts(self, time: float) -> bool:
        """What was told before an episode of an arena, of another place, does not."""
        return self.episode is None or self.begun is None or time >= self.begun

    def word(self, now: float) -> Word | None:
        """What to tell mates at `now` [s], for the robot's place then; None: it does not know where it is."""
        pose = self._find(self.name, now, [])
        if pose is None:
            return None
        memory = None if (said := self.planner.word()) is None else said.memory
        return Word(self.name, tuple(map(float, pose)), self.speeds.get(self.name, 0.0), now, memory=memory)

    def tell_own(self, now: float) -> tuple[float, OccupancyGrid] | None:
        """This robot's own map in the team's frame, to be told at `now` [s], and since when it is so; None: not known.

        Raises:
            ValueError: where it lies in the team's frame is not known.
        """
        grid = super()._merge([])
        if grid is None:
            return None
        if self.shown is None or now < self.shown[0] or not _are_same(grid, self.shown[1]):
            self.shown = now, grid
        return self.shown

    def pass_on(self, now: float) -> dict[str, Any]:
        """The messages with maps of mates that are newer than those that were passed on before, by the mates' names."""
        found = {}
        for source, (time, told) in self.told.items():
            if self._counts(time) and time <= now + self.settings.memory and time != self.passed.get(source):
                found[source], self.passed[source] = told.message, time
        return found

    def decide(self, now: float) -> Decision:
        """As `TeamDriver.decide`. A map that claims to be of later would hide what comes next: it is forgotten."""
        latest = now + self.settings.memory
        later = [source for source, (time, _) in self.told.items() if time > latest]
        self.told = {source: told for source, told in self.told.items() if source not in later}
        decision = super().decide(now)
        decision.notes.extend(f"the map of {source} is left out: its time has not come yet" for source in later)
        return decision

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """What this robot knows, in the team's frame: its own map, and those that it has heard; None: nothing yet.

        Raises:
            ValueError: where its map lies in the team's frame is not known.
        """
        own = super()._merge(notes)
        if own is None:
            return None
        grids = [own]
        for name, (time, told) in self.told.items():
            if not self._counts(time):
                continue
            if span([*grids, told.grid])[2].astype(float).prod() > MAX_CELLS:
                notes.append(f"the map of {name} is left out: it lies too far away, or has too small cells")
                continue
            grids.append(told.grid)
        return merge_grids(grids)

    _merge = known

    def _check_frames(self) -> None:
        """A robot's own map called `map` begins where that robot began, and mates' maps elsewhere."""
        for topic, message in self.maps.items():
            alone = len(self.topics) > 1 and not self.settings.offsets
            if alone and message.header.frame_id.lstrip("/") == self._root:
                raise ValueError(
                    f"{topic} is in a frame called {self._root}, as those of its mates may be, and where they lie to "
                    "each other is not known: give offsets=x,y,yaw,x,y,yaw,... of each (zeros if they are aligned)"
                )

    def _plan(self, grid: tuple, poses: dict[str, Pose | None], time_left: float, now: float) -> Plan:
        speed = self.speeds.get(self.name, 0.0)
        return self.planner.plan(*grid, poses[self.name], speed=speed, time_left=time_left, now=self._since(now))


def _are_same(grid: OccupancyGrid, other: OccupancyGrid) -> bool:
    alike = (grid.resolution, grid.origin) == (other.resolution, other.origin)
    return alike and np.array_equal(grid.values, other.values)
