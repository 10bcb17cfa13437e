"""Goals for one robot of a team without a central planner: each robot plans by itself, with what it has heard."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Mapping
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.frames import OccupancyGrid, merge_grids, span
from maexp.agents.deploy.planner.grid import check_grid, is_planned_on, read_grid
from maexp.agents.deploy.planner.messages import Beats, Word, check_told, check_word, show
from maexp.agents.deploy.planner.radio_features import BASE, read_names
from maexp.agents.deploy.planner.team_planner import Plan, TeamPlanner, finite, log_new

MOST_NOTES = 20  # of odd words between two plans


class RobotPlanner:
    """Chooses where one robot should go next.

    It plans for itself and for the mates that it has heard, at their last words, and follows its own row of that plan.
    So robots that hear each other and know the same choose what one `TeamPlanner` chooses for them, without a word
    about goals; who hears nobody plays alone. Where they know different things, two may go to one place.

    Args:
        name: of the robot; the robots' names must sort, for all plan for the team in the same order.
        policy, settings: of `TeamPlanner`, the same for all robots.
        memory: a mate counts so long after its last word [s]; its map stays until a newer one of it comes.
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
        if not isinstance(memory, Real) or not memory > 0.0:
            raise ValueError(f"memory={memory!r} must be a number of seconds above 0")
        mates = read_names("mates", mates)
        if BASE in (name, *mates):
            raise ValueError(f"{BASE!r} names the base station: give the robot another name")
        self.name, self.memory, self.mates = name, memory, mates
        self.team = TeamPlanner(policy, **settings)
        self.heard: dict[Hashable, Word] = {}
        self.grids: dict[Hashable, tuple[float, OccupancyGrid]] = {}  # of each mate the newest, whoever told it
        self.beats = Beats()
        self._word: Word | None = None
        self._odd: list[str] = []  # what was left out of words since the last plan
        self._said: frozenset[str] = frozenset()

    def reset(self) -> None:
        """Forget the past: mates, their maps, what was given up."""
        self.team.reset()
        self.heard, self.grids, self.beats, self._word = {}, {}, Beats(), None
        self._odd, self._said = [], frozenset()

    def hear(self, word: Word) -> None:
        """Take in a mate's word, or the base station's, who is no robot to plan for; one that is older than its last,
        and maps that are older than what was heard of the robots that made them, change nothing.

        What is odd in a word is left out, and `Plan.notes` of the next plan says so: a pose, a map that would be
        refused as this robot's own, too, a time of `hears`, a memory. The rest of the word counts. A word that is no
        `Word`, has no time, or whose name does not sort with the others, is left out as a whole.

        Raises:
            ValueError: it comes from a robot of this one's name.
        """
        notes: list[str] = []
        word = check_word(word, (self.name, *self.heard), notes)
        if word is not None:
            self._take(word, notes)
        fresh = [note for note in dict.fromkeys(notes) if note not in self._odd]
        self._odd = [*self._odd, *fresh][:MOST_NOTES]

    def _take(self, word: Word, notes: list[str]) -> None:
        if word.name == self.name:
            raise ValueError(f"a word from {word.name!r} came to {self.name!r}: give each robot a name of its own")
        for source, told in word.grids.items():
            if source == self.name:
                continue
            try:
                last, name = self.grids.get(source), f"the map of {show(source)}"
                newer = check_told(told, last, source == word.name, notes, name)
            except ValueError as error:
                notes.append(f"the word of {show(word.name)}: the map of {show(source)} is left out: {error}")
                continue
            if newer is not None:
                self.grids[source] = newer
        before = self.heard.get(word.name)
        if before is None or word.time >= before.time:
            self.heard[word.name] = word
            self.beats.hear(word.name, word.time)
            self.beats.hear_of({name: time for name, time in word.hears.items() if name != self.name})

    def word(self) -> Word | None:
        """What this robot tells others: of its last plan's pose and grids; None before the first."""
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
            share: whether it plans on this grid and all that were heard together, and its word holds them; else the
                caller merges them.
            connected: names of those that it is connected with now over any number of others, "base_station" for that;
                None: those of whom words came since the last plan, from themselves or over others. Only policies that
                were trained with ``observation.radio=true`` look at it.
            more: other arguments of `TeamPlanner.plan`.

        Raises:
            ValueError: as `TeamPlanner.plan`.
        """
        now, reach = finite("now", now), self.team.reach(more.get("radar_range"))
        self._forget_later(now + self.memory)
        notes = list(self._odd)
        if share:
            read_grid(grid, resolution, origin, self.team.occupied, notes)  # before mates' grids hide what is wrong
            values, cell, corner = check_grid(grid, resolution, origin)
            own = OccupancyGrid(np.array(values), cell, corner)
            merged = merge_told([own], {name: heard for name, (_, heard) in self.grids.items()}, notes, reach)
            grid, resolution, origin = merged.values, merged.resolution, merged.origin
        words = {name: word for name, word in self.heard.items() if now - word.time <= self.memory and name != BASE}
        names = sorted([self.name, *words])
        poses = {name: pose if name == self.name else words[name].pose for name in names}
        speeds = [speed if name == self.name else words[name].speed for name in names]
        lately = self.beats.take_lately()
        links = {self.name: lately if connected is None else set(read_names("connected", connected))}
        self._take_memories()
        plan = self.team.plan(grid, resolution, origin, poses, velocities=speeds, now=now, connected=links, **more)
        if pose is not None:
            knows = None if self.team.book is None else self.team.book.memories.get(self.name)
            grids = {self.name: (now, own), **self.grids} if share else {}
            hears = self.beats.tell(now - self.memory)
            place = tuple(np.asarray(pose, np.float64).tolist())
            self._word = Word(self.name, place, speed, now, grids, knows, hears)
        self._odd, self._said = [], log_new(notes, self._said)
        plan = replace(plan, notes=tuple(dict.fromkeys([*notes, *plan.notes])))
        return _row(plan, names.index(self.name))

    def _forget_later(self, time: float) -> None:
        """What claims to be of later than that [s] would hide what comes next."""
        self.heard = {name: word for name, word in self.heard.items() if word.time <= time}
        self.grids = {name: told for name, told in self.grids.items() if told[0] <= time}
        self.beats.forget_later(time)

    def _take_memories(self) -> None:
        """What mates have told of radios takes the place of what was guessed of them."""
        if self.team.book is not None:
            self.team.book.crew |= {self.name, *self.mates, *self.heard} - {BASE}
            told = {name: word.memory for name, word in self.heard.items() if word.memory is not None}
            self.team.book.memories |= told


def merge_told(
    grids: list[OccupancyGrid], told: Mapping[Any, OccupancyGrid], notes: list[str], reach: float = 0.0
) -> OccupancyGrid | None:
    """These grids and those that robots have told in one; None: there are none.

    What would make it larger than is planned on is left out: as few of the told ones as possible, then those that lie
    farthest from the origin of the frame.

    Args:
        grids: that count in any case.
        told: the others, by the names that notes give them.
        notes: a sentence is added for each that is left out.
        reach: how far robots see [m].
    """
    everything = [*grids, *told.values()]
    if not everything or _is_planned_on(everything, reach):
        return merge_grids(everything) if everything else None
    fits = {name: grid for name, grid in told.items() if _is_planned_on([*grids, grid], reach)}
    order = sorted(fits, key=lambda name: math.hypot(*fits[name].origin[:2]))
    groups = [_add_fitting(grids, fits, [name, *(other for other in order if other != name)], reach) for name in order]
    taken = max(groups, key=len, default=[])
    notes += [
        f"the map of {name} is left out: it lies too far away, or has too small cells"
        for name in told
        if name not in taken
    ]
    grids = [*grids, *(grid for name, grid in told.items() if name in taken)]
    return merge_grids(grids) if grids else None


def _add_fitting(
    grids: list[OccupancyGrid], told: Mapping[Any, OccupancyGrid], order: list[Any], reach: float
) -> list[Any]:
    """Names of those that, added in this order, still make a grid that is planned on."""
    taken: list[Any] = []
    for name in order:
        if _is_planned_on([*grids, *(told[other] for other in taken), told[name]], reach):
            taken.append(name)
    return taken


def _is_planned_on(grids: list[OccupancyGrid], reach: float) -> bool:
    cell, _, size = span(grids)
    return is_planned_on(*size.astype(float), reach / cell)


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
