"""Drivers of a decentralised ROS 2 team: a radio's messages in and out, for a robot and for the base station."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.frames import OccupancyGrid, Pose, check_map, is_newer, read_map, read_time
from maexp.agents.deploy.planner.messages import Beats, Word, read_word
from maexp.agents.deploy.planner.radio_features import BASE, read_comm
from maexp.agents.deploy.planner.robot_planner import RobotPlanner, merge_told
from maexp.agents.deploy.planner.team_driver import Decision, DriverSettings, TeamDriver
from maexp.agents.deploy.planner.team_planner import Plan

FINEST = 1e-3  # edge of a cell of a map that is read [m]


@dataclass(frozen=True)
class Told:
    """A mate's own map in the team's frame, and the message that it came by, to be passed on."""

    grid: OccupancyGrid
    message: Any


def map_topic(speaker: str, source: str) -> str:
    """Where a radio tells the own map of a robot, itself or another."""
    return f"/{speaker}/maexp/{'' if speaker == source else f'heard/{source}/'}map"


class RadioDriver(TeamDriver):
    """Hears the robots of a team, keeps the newest map of each, and tells what is new.

    Words carry times of ROS, by the clock that all share, and places in the team's frame.

    Args:
        settings: of the team; `only` names this radio.

    Attributes:
        mates: names of the robots that are heard.
        speakers: names of all that are heard.

    Raises:
        ValueError: as for `TeamDriver`; nobody is named, or a robot as the base station is.
    """

    def __init__(self, settings: DriverSettings):
        if not settings.only:
            raise ValueError("only= must name the robot that is driven")
        if BASE in settings.robots:
            raise ValueError(f"robots={','.join(settings.robots)}: {BASE!r} names the base station, and no robot")
        self.name = settings.only
        self.mates = tuple(name for name in settings.robots if name != settings.only)
        self.speakers = tuple(name for name in (*self.mates, BASE) if name != settings.only)
        self.words: dict[str, Word] = {}  # the last of each speaker
        self.told: dict[str, tuple[float, Told]] = {}  # of each mate the newest map, and since when it is so [s]
        super().__init__(settings)

    def begin(self, episode: dict[str, Any] | None = None, now: float | None = None) -> None:
        """As `TeamDriver.begin`: what was told before an arena's episode is forgotten; who was faster may have told of
        it already."""
        super().begin(episode, now)
        self.passed: dict[str, float] = {}  # times of the maps that were passed on
        self.beats, self.before = Beats(), set[Any]()
        for word in self.words.values():
            self.hear(word)

    def hear(self, word: Word) -> bool:
        """Take in a word; whether it is one of a speaker, and of this episode."""
        if word.name not in self.speakers:
            return False
        self.words[word.name] = word
        self.begun = word.time if self.begun is None else self.begun
        if not self._counts(word.time):
            return False
        self.beats.hear(word.name, word.time)
        others = {name: time for name, time in word.hears.items() if name in self.speakers and self._counts(time)}
        self.beats.hear_of(others)
        return True

    def take_word(self, name: str, text: str) -> bool:
        """What came on /NAME/maexp/word, as `write_word` writes it; whether it counts.

        Raises:
            ValueError: it is none, or not its.
        """
        word = read_word(text)
        if word.name != name:
            raise ValueError(f"a word of {word.name!r} came")
        return self.hear(word)

    def map_topics(self) -> dict[str, str]:
        """Where maps are told, a robot's own and those that were heard; the names of the robots that made these."""
        told = [(speaker, source) for speaker in self.speakers for source in self.mates]
        return {map_topic(speaker, source): source for speaker, source in told}

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
        try:
            grid = check_map(grid)
        except ValueError as error:
            raise ValueError(f"a map of {grid.values.size:,} cells is none: {error}") from None
        if grid.values.size == 0 or grid.resolution < FINEST:
            wanted = f"it must have cells, of at least {FINEST:g} m"
            raise ValueError(f"a map of {grid.values.size:,} cells of {grid.resolution:g} m is none: {wanted}")
        self.told[source] = time, Told(grid, message)

    def has_heard(self, name: str, now: float) -> bool:
        """Whether somebody has spoken at `now` [s] or since."""
        return name in self.words and self.words[name].time >= now

    def _counts(self, time: float) -> bool:
        """What was told before an episode of an arena, of another place, does not."""
        return self.episode is None or self.begun is None or time >= self.begun

    def word(self, now: float) -> Word | None:
        """What to tell of itself at `now` [s]; None: it does not know where it is."""
        raise NotImplementedError

    def tell_own(self, now: float) -> tuple[float, OccupancyGrid] | None:
        """Its own map in the team's frame, to be told at `now` [s], and since when it is so; None: it has none.

        Raises:
            ValueError: where it lies in the team's frame is not known.
        """
        raise NotImplementedError

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
        self.beats.forget_later(latest)
        decision = self._decide(now)
        decision.notes.extend(f"the map of {source} is left out: its time has not come yet" for source in later)
        return decision

    def _decide(self, now: float) -> Decision:
        return super().decide(now)

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """What it knows, in the team's frame: its own map, and those that it has heard; None: nothing yet.

        Raises:
            ValueError: where its own map lies in the team's frame is not known.
        """
        raise NotImplementedError

    def _add_told(self, grids: list[OccupancyGrid], notes: list[str], reach: float = 0.0) -> OccupancyGrid | None:
        """These maps and those that were heard in one, as of `merge_told`; None: there are none."""
        counting = {name: told.grid for name, (time, told) in self.told.items() if self._counts(time)}
        return merge_told(grids, counting, notes, reach)

    def _take_linked(self) -> set[Any]:
        """Whom it is connected with now: whose words have come since the last decision but one."""
        lately = self.beats.take_lately()
        linked, self.before = lately | self.before, lately
        return linked


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
        return None if own is None else self._add_told([own], notes, self._reach())

    _merge = known

    def _reach(self) -> float:
        return self.planner.team.radar_range

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


class BaseDriver(RadioDriver):
    """A `RadioDriver` that stands in one place, `settings.comm.base_station`, and drives nothing.

    Args:
        settings: of the team, with `only` "base_station".

    Raises:
        ValueError: as for `RadioDriver`; its place is missing.
    """

    def __init__(self, settings: DriverSettings):
        comm = read_comm(settings.comm)
        if comm is None or isinstance(comm.base_station, bool):
            raise ValueError(f"only={BASE} needs its place: comm.base_station=[x,y], in metres, in the team's frame")
        self.place = comm.base_station
        super().__init__(settings)

    def _make_planner(self) -> None:
        return None

    def word(self, now: float) -> Word:
        """Where it stands, and whom it hears."""
        x, y = self.place
        return Word(BASE, (x, y, 0.0), 0.0, now, hears=self.beats.tell(now - self.settings.memory))

    def tell_own(self, now: float) -> None:
        """It sees nothing itself."""

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """As of `RadioDriver`."""
        return self._add_told([], notes)

    def _decide(self, now: float) -> Decision:
        return Decision([], None, [])


def make_driver(settings: DriverSettings) -> TeamDriver:
    """Of the whole team, or of the one robot or the base station that `only` names.

    Raises:
        ValueError: as `TeamDriver`.
    """
    kind = {"": TeamDriver, BASE: BaseDriver}.get(settings.only, RobotDriver)
    return kind(settings)
