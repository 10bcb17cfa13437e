"""Goals for one robot of a team without a central planner: each robot plans by itself, with what it has heard."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .contacts import BASE, Memory, read_names
from .frames import OccupancyGrid, merge_grids
from .planner import Plan, TeamPlanner


@dataclass(frozen=True)
class Word:
    """What a robot tells of itself.

    Attributes:
        name: its name.
        pose: x, y [m] and yaw [rad] in the frame that all robots share.
        speed: [m/s]
        time: of the pose, by a clock that all robots share [s].
        grid: what it knows, its own and heard; None: the caller merges grids.
        memory: what it knows of radios; None: its policy does not look at that.
    """

    name: Hashable
    pose: tuple[float, ...]
    speed: float
    time: float
    grid: OccupancyGrid | None = None
    memory: Memory | None = None


class RobotPlanner:
    """Chooses where one robot should go next.

    It plans for itself and for the mates that it has heard, at their last words, and follows its own row of that plan.
    So robots that hear each other and know the same choose what one `TeamPlanner` chooses for them, without a word
    about goals; who hears nobody plays alone. Where they know different things, two may go to one place.

    Args:
        name: of the robot; the robots' names must sort, for all plan for the team in the same order.
        policy, settings: of `TeamPlanner`, the same for all robots.
        memory: a mate counts so long after its last word [s]; what it told of the map stays.
        mates: names of the others; policies that look at radios count those, too, that were never heard.
    """

    def __init__(
        self,
        name: Hashable,
        policy: Any = "cost_utility",
        *,
        memory: float = 10.0,
        mates: Collection[Hashable] = (),
        **settings: Any,
    ):
        if not memory > 0.0:
            raise ValueError(f"memory={memory!r} must be a number of seconds above 0")
        mates = read_names("mates", mates)
        if BASE in (name, *mates):
            raise ValueError(f"{BASE!r} names the base station: give the robot another name")
        self.name, self.memory, self.mates = name, memory, mates
        self.team = TeamPlanner(policy, **settings)
        self.heard: dict[Hashable, Word] = {}
        self.grids: dict[Hashable, OccupancyGrid] = {}
        self._word: Word | None = None
        self._lately: set[Hashable] = set()  # heard since the last plan

    def reset(self) -> None:
        """Forget the past: mates, their maps, what was given up."""
        self.team.reset()
        self.heard, self.grids, self._word = {}, {}, None
        self._lately = set()

    def hear(self, word: Word) -> None:
        """Take in a mate's word, or the base station's, who is no robot to plan for; one that is older than its last
        changes nothing.

        Raises:
            ValueError: it comes from a robot of this one's name.
        """
        if word.name == self.name:
            raise ValueError(f"a word from {word.name!r} came to {self.name!r}: give each robot a name of its own")
        last = self.heard.get(word.name)
        if last is None or word.time >= last.time:
            self.heard[word.name] = word
            self._lately.add(word.name)
            if word.grid is not None:
                self.grids[word.name] = word.grid

    def word(self) -> Word | None:
        """What this robot tells others: of its last plan's pose and grid; None before the first."""
        return self._word

    def plan(
        self,
        grid,
        resolution: float,
        origin,
        pose,
        *,
        speed: float = 0.0,
        now: float,
        share: bool = False,
        connected: Collection[Hashable] | None = None,
        **more: Any,
    ) -> Plan:
        """A plan of one row, this robot's.

        Args:
            grid, resolution, origin: as for `TeamPlanner.plan`.
            pose: x, y and, if known, yaw of this robot, or None.
            speed: its speed [m/s].
            now: the time, by the clock of all robots [s].
            share: whether grids that were heard join this one, and its word holds what came of it; else the caller
                merges them.
            connected: names of those that it is connected with now over any number of others, "base_station" for that;
                None: those heard since the last plan. Only policies trained with ``observation.radio=true`` look at it.
            more: other arguments of `TeamPlanner.plan`.

        Raises:
            ValueError: as `TeamPlanner.plan`.
        """
        if share:
            yaw = float(origin[2]) if len(origin) > 2 else 0.0
            own = OccupancyGrid(np.asarray(grid), resolution, (float(origin[0]), float(origin[1]), yaw))
            own = merge_grids([own, *self.grids.values()])
            grid, resolution, origin = own.values, own.resolution, own.origin
        self.heard = {
            name: word for name, word in self.heard.items() if word.time - now <= self.memory
        }  # none from later
        words = {name: word for name, word in self.heard.items() if now - word.time <= self.memory and name != BASE}
        names = sorted([self.name, *words])
        poses = {name: pose if name == self.name else words[name].pose for name in names}
        speeds = [speed if name == self.name else words[name].speed for name in names]
        links = {self.name: set(self._lately if connected is None else read_names("connected", connected))}
        self._lately.clear()
        self._take_memories()
        plan = self.team.plan(grid, resolution, origin, poses, velocities=speeds, now=now, connected=links, **more)
        if pose is not None:
            knows = None if self.team.book is None else self.team.book.memories.get(self.name)
            self._word = Word(self.name, tuple(map(float, pose)), speed, now, own if share else None, knows)
        return _row(plan, names.index(self.name))

    def _take_memories(self) -> None:
        """What mates have told of radios takes the place of what was guessed of them."""
        if self.team.book is not None:
            self.team.book.crew |= {self.name, *self.mates, *self.heard} - {BASE}
            told = {name: word.memory for name, word in self.heard.items() if word.memory is not None}
            self.team.book.memories |= told


def _row(plan: Plan, row: int) -> Plan:
    """One robot's part of a plan; it is done when the team is."""
    only = slice(row, row + 1)
    return replace(
        plan,
        names=plan.names[only],
        goals=plan.goals[only],
        active=plan.active[only],
        waits=plan.waits[only],
        ways=plan.ways[only],
        tells=plan.tells[only],
    )
