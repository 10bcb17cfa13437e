"""A ROS 2 robot that plans for itself: its messages and what it has heard of its mates in, its goal and word out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from .driver import DriverSettings, TeamDriver
from .frames import OccupancyGrid, Pose, merge_grids, read_map, read_time, span
from .grid import MAX_CELLS
from .planner import Plan
from .robot import RobotPlanner, Word
from .words import FURTHEST, read_word

FINEST = 1e-3  # edge of a cell of a map that is read [m]


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
        self.told: dict[str, tuple[float, OccupancyGrid]] = {}  # what it knows, in the team's frame, and since when [s]
        super().__init__(settings)

    def begin(self, episode: dict[str, Any] | None = None, now: float | None = None) -> None:
        """As `TeamDriver.begin`: what mates have told before an arena's episode is forgotten; who was faster may have
        told of it already."""
        super().begin(episode, now)
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

    def take_known(self, name: str, message) -> None:
        """What came on a mate's /NAME/maexp/map, a nav_msgs/OccupancyGrid in the team's frame.

        Raises:
            ValueError: it is in another frame, none, or larger than is planned on.
        """
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
        self.told[name] = read_time(message.header.stamp), grid

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
        return Word(self.name, tuple(map(float, pose)), self.speeds.get(self.name, 0.0), now, None, memory)

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """What this robot knows, in the team's frame: its own map, and those that it has heard; None: nothing yet.

        Raises:
            ValueError: where its map lies in the team's frame is not known.
        """
        own = super()._merge(notes)
        if own is None:
            return None
        grids = [own]
        for name, (time, grid) in self.told.items():
            if not self._counts(time):
                continue
            if span([*grids, grid])[2].astype(float).prod() > MAX_CELLS:
                notes.append(f"the map of {name} is left out: it lies too far away, or has too small cells")
                continue
            grids.append(grid)
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
