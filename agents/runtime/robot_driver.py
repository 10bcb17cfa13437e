"""A ROS 2 robot that plans for itself: its messages and what it has heard of its mates in, its goal and word out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from .frames import OccupancyGrid, Pose
from .planner import Plan
from .radio_driver import RadioDriver
from .robot import RobotPlanner
from .words import Word


class RobotDriver(RadioDriver):
    """A `TeamDriver` of one robot of a team, `settings.only`, without a central planner.

    Args:
        settings: of the team.

    Raises:
        ValueError: as for `RadioDriver`.
    """

    def begin(self, episode: dict[str, Any] | None = None, now: float | None = None) -> None:
        """As `RadioDriver.begin`."""
        self.shown: tuple[float, OccupancyGrid] | None = None  # this robot's map, and since when it is so [s]
        super().begin(episode, now)

    def _make_planner(self) -> RobotPlanner:
        given = self.settings
        return RobotPlanner(self.name, given.policy, memory=given.memory, mates=self.mates, **self._options())

    def hear(self, word: Word) -> bool:
        """As `RadioDriver.hear`; the planner is told of it."""
        counts = super().hear(word)
        if counts:
            self.planner.hear(replace(word, time=self._since(word.time), hears={}))
        return counts

    def word(self, now: float) -> Word | None:
        """What to tell mates at `now` [s], for the robot's place then; None: it does not know where it is."""
        pose = self._find(self.name, now, [])
        if pose is None:
            return None
        memory = None if (said := self.planner.word()) is None else said.memory
        hears, speed = self.beats.tell(now - self.settings.memory), self.speeds.get(self.name, 0.0)
        return Word(self.name, tuple(map(float, pose)), speed, now, memory=memory, hears=hears)

    def tell_own(self, now: float) -> tuple[float, OccupancyGrid] | None:
        """As of `RadioDriver`: this robot's own map."""
        grid = super()._merge([])
        if grid is None:
            return None
        if self.shown is None or now < self.shown[0] or not _are_same(grid, self.shown[1]):
            self.shown = now, grid
        return self.shown

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """As of `RadioDriver`; nothing without a map of its own."""
        own = super()._merge(notes)
        return None if own is None else self._add_told([own], notes, self.planner.team.radar_range)

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
        more = {"speed": self.speeds.get(self.name, 0.0), "time_left": time_left, "connected": self._take_linked()}
        return self.planner.plan(*grid, poses[self.name], now=self._since(now), **more)


def _are_same(grid: OccupancyGrid, other: OccupancyGrid) -> bool:
    alike = (grid.resolution, grid.origin) == (other.resolution, other.origin)
    return alike and np.array_equal(grid.values, other.values)
