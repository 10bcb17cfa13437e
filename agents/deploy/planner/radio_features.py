"""What robots know of radios, call by call, for policies that look at it (``observation.radio``):
`maexp.envs.comm.radio_features` and what `maexp.envs.comm.strategy` remembers, in NumPy."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.features import Motion
from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.grid_search import snap
from maexp.agents.deploy.planner.scene import ArrayScene
from maexp.agents.deploy.planner.stall_monitor import STEP, Watch
from maexp.agents.deploy.planner.team import Team
from maexp.envs.config.comm import CELLS_OF_RADAR, CommConfig
from maexp.envs.config_fields import check_settings
from maexp.envs.targets.features import DETOUR, PACE, Contacts, FeatureInputs, add_telling, predict_margin
from maexp.envs.targets.heuristics import WAY_AHEAD
from maexp.kernels.constants import FREE, NUDGE, STRAIGHT, UNREACHED

BASE = "base_station"
"""Names the base station among those that a robot is connected with."""
USED = ("range", "line_of_sight", "signal", "power", "threshold", "cell", "base_station")
"""What predictions take from `CommConfig`."""

Links = Mapping[Hashable, Collection[Hashable]]
"""Robots, and the names of those that each is connected with now, over any number of others."""


@dataclass(frozen=True)
class Contact:
    """The last moment in which a robot was connected with a radio.

    Attributes:
        used: share of the whole time that was over then.
        place: x, y of that radio [m].
        known: free ground that the robot knew [m^2].
        driven: its odometer [m].
    """

    used: float
    place: tuple[float, float]
    known: float
    driven: float


@dataclass(frozen=True)
class Memory:
    """What a robot knows of radios; robots tell it each other.

    Attributes:
        at: where it is, x, y [m].
        driven: its odometer [m].
        known: free ground that it knows [m^2].
        linked: it is connected with the base station.
        tells: it is on its way there, to tell what it knows.
        met: by the radio's name, `BASE` for the base station.
    """

    at: tuple[float, float]
    driven: float = 0.0
    known: float = 0.0
    linked: bool = False
    tells: bool = False
    met: Mapping[Any, Contact] = field(default_factory=dict)

    def since(self, radio: Hashable, used: float, decision: float) -> float:
        """Share of the whole time since they were connected; never counts from the decision before the first."""
        return used - self.met[radio].used if radio in self.met else used + decision

    def untold(self, radio: Hashable) -> float:
        """What it knows and that radio did not know then [m^2]."""
        return self.known - (self.met[radio].known if radio in self.met else 0.0)


class ContactBook:
    """What the robots of a team remember of radios, and who of them is on its way to tell the base station.

    Args:
        comm: the radios.
        time_limit: the time for the whole exploration [s].
        motion: how the robots move.
        patience, pause: a robot that does not move on its way to tell for so long gives that up, for so long [s].

    Attributes:
        memories: of each robot; of others, what they told.
        crew: names of all robots that there are.
    """

    def __init__(self, comm: CommConfig, time_limit: float, motion: Motion, patience: float, pause: float):
        self.comm, self.time_limit, self.motion = comm, time_limit, motion
        self.patience, self.pause = patience, pause
        self.base: Any = None if comm.base_station is False else np.array(comm.base_station)
        self.forget()

    def forget(self) -> None:
        """Forget the past."""
        self.memories: dict[Hashable, Memory] = {}
        self.crew: set[Hashable] = set()
        self.stood: dict[Hashable, tuple[np.ndarray, float]] = {}  # where and since when robots that tell do not move
        self.given: dict[Hashable, float] = {}  # until when robots have given telling up
        self.seen: set[Hashable] = set()  # robots whose memory was brought up to date at the last look

    def look(self, team: Team, grid: KnownGrid, used: float, links: Links, now: float) -> list[str]:
        """Bring the memory up to date; returns what was given up.

        Args:
            grid: what the team knows.
            used: share of the whole time that is over.
            links: robots that are not named keep the memory that they have.
            now: time [s].
        """
        if BASE in team.names:
            raise ValueError(f"{BASE!r} names the base station: give the robot another name")
        known = float(np.count_nonzero(grid.known == FREE)) * grid.cell**2
        self.crew |= set(team.names)
        self.used, self.now, self.seen, notes = used, now, set(links), []
        places = {name: tuple(at) for name, at in zip(team.names, team.at.tolist(), strict=True) if at[0] == at[0]}
        places = {name: memory.at for name, memory in self.memories.items()} | places
        if self.base is not None:
            places[BASE] = tuple(self.base.tolist())
        for robot, name in enumerate(team.names):
            if name in links and np.isfinite(team.at[robot]).all():
                self._remember(name, known, places, links[name])
                notes += self._check(team, robot)
        return notes

    def _remember(self, name: Hashable, known: float, places: dict[Hashable, tuple], linked: Collection) -> None:
        at = places[name]
        old = self.memories.get(name, Memory(at))
        driven = old.driven + math.dist(at, old.at)
        new = {radio: Contact(self.used, places[radio], known, driven) for radio in linked if radio in places}
        memory = Memory(at, driven, known, BASE in new, old.tells, {**old.met, **new})
        self.memories[name] = replace(memory, tells=old.tells and self._has_news(memory))

    @staticmethod
    def _has_news(memory: Memory) -> bool:
        """Whether it knows something that the base station does not, and cannot tell that from where it is."""
        return memory.untold(BASE) > 0.0 and not memory.linked

    def _check(self, team: Team, robot: int) -> list[str]:
        """A robot on its way that does not move gives it up for a while."""
        name = team.names[robot]
        if not self.memories[name].tells:
            self.stood.pop(name, None)
            return []
        at, since = self.stood.setdefault(name, (team.at[robot], self.now))
        if np.linalg.norm(team.at[robot] - at) >= STEP * team.radius[robot]:
            self.stood[name] = team.at[robot], self.now
        elif self.now - since >= self.patience:
            return [self._give_up(team, robot, f"it did not move for {self.patience:g} s")]
        return []

    def _give_up(self, team: Team, robot: int, why: str) -> str:
        """A robot goes on exploring for a while."""
        name = team.names[robot]
        self.stood.pop(name, None)
        self.given[name] = self.now + self.pause
        self.memories[name] = replace(self.memories[name], tells=False)
        return f"{team.title(robot)} gave up telling the base station: {why}"

    def ends(self, team: Team, scene: ArrayScene, notes: list[str]) -> np.ndarray:
        """Where the ways of robots end that may go and tell the base station, int64 [n] of the scene's robots: the
        cell nearest to it that they get to; -1: they may not, or are there already. Who has come there in vain gives it
        up for a while; a note of that is added."""
        result = np.full(len(scene.robots), -1)
        for row, robot in enumerate(scene.robots):
            memory = self.memories.get(team.names[robot])
            free = self.given.get(team.names[robot], -math.inf) <= self.now
            if self.base is not None and memory is not None and free and self._has_news(memory):
                end = self._nearest(scene, row)
                gap = np.linalg.norm(scene.grid.centers(np.array(end)) - scene.at[row]) if end >= 0 else 0.0
                result[row] = end if gap > team.radius[robot] else -1
                if memory.tells and result[row] < 0 and team.names[robot] in self.seen:  # others say themselves
                    notes.append(self._give_up(team, robot, "nothing was heard of it where the way ends"))
        return result

    def _nearest(self, scene: ArrayScene, row: int) -> int:
        """The cell nearest to the base station that a robot gets to; -1: none."""
        place = scene.grid.from_map(self.base)
        cell = int(scene.grid.cells(place))
        cell = -1 if cell < 0 else snap(scene.passable[row], cell)
        if cell >= 0 and scene.distance[row].flat[cell] < UNREACHED:
            return cell
        reached = np.flatnonzero(scene.distance[row].ravel() < UNREACHED)
        gap = np.linalg.norm(scene.grid.centers(reached) - place, axis=-1)
        return int(reached[gap.argmin()]) if len(reached) else -1

    def send(self, team: Team, robots: np.ndarray, tells: np.ndarray) -> None:
        """Note who of these robots, int [n], goes to tell the base station, bool [n], until they are connected."""
        for robot, goes in zip(robots.tolist(), tells.tolist(), strict=True):
            if (memory := self.memories.get(team.names[robot])) is not None:
                self.memories[team.names[robot]] = replace(memory, tells=goes)

    def on_duty(self, team: Team, robots: np.ndarray) -> np.ndarray:
        """Who of these robots, int [n], is on its way to tell, bool [n]."""
        memories = [self.memories.get(team.names[robot]) for robot in robots]
        return np.array([memory is not None and memory.tells for memory in memories], bool)

    def add_to(self, inputs: FeatureInputs, scene: ArrayScene, names: list[Hashable], can: np.ndarray) -> FeatureInputs:
        """The moment with one candidate more, [n, M + 1], to go and tell the base station, and with `Contacts`.

        Args:
            names: of the scene's robots.
            can: bool [n], who has this choice.
        """
        base = scene.at if self.base is None else np.broadcast_to(scene.grid.from_map(self.base), scene.at.shape)
        to = (base - scene.at)[:, None]
        way, begin = self._way_to_base(scene, base, to)
        inputs = add_telling(inputs, can[:, None], way, begin, to)
        return replace(inputs, radio=self._contacts(inputs, scene, names))

    def _way_to_base(self, scene: ArrayScene, base: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far it is to the base station [m], [n, 1], and a point near the beginning of the way, from the robot,
        [n, 1, 2]; guessed from the straight line where the known ground does not lead there."""
        grid = scene.grid
        x, y = np.clip(np.floor(base / grid.cell).astype(np.int64), 0, (grid.width - 1, grid.height - 1)).T
        cell = (y * grid.width + x)[:, None]
        steps = np.take_along_axis(scene.distance.reshape(len(cell), -1), cell, 1)
        reached = (steps < UNREACHED) & (grid.cells(base)[:, None] >= 0)
        way = np.where(reached, steps * (grid.cell / STRAIGHT), DETOUR * np.linalg.norm(to, axis=-1))
        return way, np.where(reached[..., None], scene.ways_to(cell, WAY_AHEAD), to)

    def _contacts(self, inputs: FeatureInputs, scene: ArrayScene, names: list[Hashable]) -> Contacts:
        memories = [self.memories.get(name, Memory((0.0, 0.0))) for name in names]
        others = [sorted(self.crew - {name}, key=str) for name in names]
        disc, point = math.pi * scene.radar_range**2, inputs.to + inputs.at[:, None]
        decision = self.motion.seconds / self.time_limit

        def each(values: list[float]) -> np.ndarray:
            return np.reshape(np.array(values, np.float64), (len(names), 1))

        pairs = list(zip(memories, others, strict=True))
        since = [[memory.since(mate, self.used, decision) for mate in mates] for memory, mates in pairs]
        tells = np.zeros_like(inputs.mask)
        tells[:, -1] = inputs.mask[:, -1]
        shared = {
            "mates_untold": each([max([0.0, *map(memory.untold, mates)]) for memory, mates in pairs]) / disc,
            "mates_since": each([sum(row) / max(len(row), 1) for row in since]),
            "mates_far": np.stack(
                [self._far_from_mates(scene, at, *pair) for at, pair in zip(point, pairs, strict=True)]
            ),
        }
        if self.base is None:
            none = dict.fromkeys(("untold", "since", "linked", "way", "spare"), each([0.0] * len(names)))
            blank = np.zeros_like(inputs.travel)
            return Contacts(tells=tells, **none, far=blank, signal=blank, **shared)
        way = each([self._way_back(memory) for memory in memories])
        gap = np.linalg.norm(point - scene.grid.from_map(self.base), axis=-1)
        drive = self.motion.max_speed * PACE * self.time_limit
        return Contacts(
            tells=tells,
            untold=each([memory.untold(BASE) for memory in memories]) / disc,
            since=each([memory.since(BASE, self.used, decision) for memory in memories]),
            linked=each([memory.linked for memory in memories]),
            way=way / scene.radar_range,
            spare=1.0 - self.used - way / drive,
            far=gap / scene.radar_range,
            signal=self._signal(scene, point, gap),
            **shared,
        )

    def _way_back(self, memory: Memory) -> float:
        """How far it is back into contact with the base station [m], as a robot guesses it."""
        met = memory.met.get(BASE)
        driven = math.inf if met is None else memory.driven - met.driven
        return min(driven, DETOUR * math.dist(memory.at, self.base))

    @staticmethod
    def _far_from_mates(scene: ArrayScene, point: np.ndarray, memory: Memory, mates: list[Hashable]) -> np.ndarray:
        """From points [M, 2] to the nearest place where a mate was last heard [radar ranges], [M]."""
        places = [memory.met[mate].place for mate in mates if mate in memory.met]
        if not places:
            return np.full(len(point), np.inf)
        gap = np.linalg.norm(point[:, None] - scene.grid.from_map(np.array(places)), axis=-1)
        return gap.min(-1) / scene.radar_range

    def _signal(self, scene: ArrayScene, point: np.ndarray, gap: np.ndarray) -> np.ndarray:
        """As of `Contacts`, [n, M]."""
        comm, grid = self.comm, scene.grid
        cell = scene.radar_range / CELLS_OF_RADAR if comm.cell == "auto" else comm.cell
        blocked = np.zeros(gap.shape)
        if comm.signal or comm.line_of_sight:
            blocked = count_blocked(grid, grid.from_map(self.base), point.reshape(-1, 2)).reshape(gap.shape)
        return predict_margin(np, comm, cell, gap, blocked, grid.cell)


def read_names(setting: str, names: Any) -> tuple[Hashable, ...]:
    """Names of robots.

    Raises:
        ValueError: they are none; a single name is not several.
    """
    if isinstance(names, str | bytes | Mapping) or not isinstance(names, Collection):
        raise ValueError(f"{setting}={names!r}: give a list of names")
    return tuple(names)


def read_links(connected: bool | Links, team: Team) -> Links:
    """Who is connected with whom, as `ContactBook.look` takes it.

    Raises:
        ValueError: it is neither yes, no nor a mapping of the team's names to names.
    """
    if isinstance(connected, Mapping):
        if wrong := [name for name in connected if name not in team.names]:
            raise ValueError(f"connected names {wrong[0]!r}, and the robots are {', '.join(map(str, team.names))}")
        return {name: read_names(f"connected[{name!r}]", names) for name, names in connected.items()}
    if not isinstance(connected, bool | np.bool_):
        raise ValueError(f"connected={connected!r}: give True, False or {{name: [names]}}")
    there = [name for name, at in zip(team.names, team.at, strict=True) if np.isfinite(at).all()]
    base = [BASE] if connected else []
    return {name: [*base, *(mate for mate in there if mate != name)] for name in there}


def count_blocked(grid: KnownGrid, start: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Cells along the lines from `start`, [2], to points, [P, 2], on the grid [m] that are not known to be free ground,
    int64 [P]: `maexp.kernels.radio.count_blocked`. The points lie on the grid; what lies before it is blocked."""
    line, size = points - start, np.array([grid.width, grid.height]) * grid.cell
    pieces = np.maximum(np.ceil(np.abs(line / grid.cell).max(-1) - NUDGE), 1.0)
    edge = np.where(line > 0.0, -start, size - start) / np.where(line == 0.0, np.inf, line)
    enter = np.clip(edge.max(-1), 0.0, 1.0)  # share of the line before it comes upon the grid
    first = np.maximum(np.floor(enter * pieces) - 1.0, 0.0)
    part = first[:, None] + np.arange(int((pieces - first).max(initial=1.0)))
    there = part < pieces[:, None]
    share = np.where(there, (part + 0.5) / pieces[:, None], 0.0)
    cells = grid.cells(start + line[:, None] * share[..., None] + NUDGE * grid.cell)
    free = (cells >= 0) & (grid.known.flat[np.maximum(cells, 0)] == FREE)
    return first.astype(np.int64) + (there & ~free).sum(-1)


def open_book(
    policy: Any, radio: bool, comm: Any, time_limit: float | None, motion: Motion, watch: Watch
) -> ContactBook | None:
    """What a planner remembers of radios; None: its policy does not look at that.

    Args:
        radio: whether it does.
        comm, time_limit: as the planner got them.

    Raises:
        ValueError: they are missing, odd, or given in vain.
    """
    known = read_comm(comm)
    if not radio:
        if known is not None:
            raise ValueError(f"comm= is for policies trained with observation.radio=true, and {policy} was not")
        return None
    if known is None or time_limit is None:
        raise ValueError(
            f"{policy} was trained with observation.radio=true: say how far radios reach, where the base station is "
            "and how many seconds there are, as comm={'range': 8.0, 'base_station': (0.0, 0.0)}, time_limit=600.0 or, "
            "of maexp ros2 team, only=NAME comm.range=8 comm.base_station=[0,0] time_limit=600; or use a policy that "
            "was trained without it"
        )
    return ContactBook(known, time_limit, motion, watch.patience, watch.pause)


def read_comm(given: CommConfig | Mapping[str, Any] | None) -> CommConfig | None:
    """The radios as predictions take them; None: there are none.

    Raises:
        ValueError: a setting is unknown or out of its range (named, with its value).
    """
    if given is None:
        return None
    if isinstance(given, Mapping):
        names = [setting.name for setting in fields(CommConfig)]
        if wrong := [str(name) for name in given if name not in names]:
            raise ValueError(f"comm names {wrong[0]!r}: choose among {', '.join(USED)}")
        given = CommConfig(**given)
    elif not isinstance(given, CommConfig):
        raise ValueError(f"comm={given!r}: give a CommConfig, or a mapping as {{'range': 8.0}}")
    check_settings(given, "comm")
    given = given.checked()
    if given.strategy != "opportunistic":
        raise ValueError(f"comm.strategy={given.strategy} is for the simulator: here robots go where their policy says")
    if given.base_station is True:
        raise ValueError("comm.base_station=True says no place: give x, y in metres, in the frame of the map")
    return given
