"""A team in closed loop: round robots with a lidar on a known floor, sent by a `TeamPlanner` once a second.

Small on purpose: no noise, no dynamics, one map for all, and robots that step aside for each other. It shows what a
planner makes of its own decisions, call after call, to the last corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from maexp.agents.deploy.planner.team_planner import Plan, TeamPlanner

WALL, FREE = 100, 0
NEAR = 1.0  # a team begins so near to where it was told to, or within four of its robots' radii [m]


def make_floor(cells: int, room: int = 80, door: int = 10) -> np.ndarray:
    """A square floor of rooms with doors, int8 [cells, cells] as ROS has it: 0 free, 100 wall."""
    grid = np.zeros((cells, cells), np.int8)
    walls = np.append(np.arange(0, cells - 1, room), cells - 1)
    grid[walls], grid[:, walls] = WALL, WALL
    for middle in range(room // 2, cells, room):
        for wall in walls[1:-1]:
            grid[middle : middle + door, wall] = FREE
            grid[wall, middle : middle + door] = FREE
    return grid


def read_floor(path: str | Path, cell: float) -> tuple[np.ndarray, float]:
    """The largest room that hangs together of a map_server yaml, on cells of at least so many metres.

    Returns:
        int8 [H, W], row = y: 0 free, all else a wall (100); and the edge of a cell [m].

    Raises:
        ValueError: the file is no such map, or PyYAML and Pillow, which read it, are not installed.
    """
    try:
        from maexp.envs.io.grid import FREE as OPEN  # late: robots have neither PyYAML nor Pillow
        from maexp.envs.io.occupancy import read_occupancy
        from maexp.envs.io.options import ImportOptions
        from maexp.envs.io.report import ImportReport
    except ImportError as error:
        raise ValueError(f"{path} is read with PyYAML and Pillow: pip install pyyaml pillow ({error})") from None
    grid = read_occupancy(Path(path), ImportOptions(), ImportReport(str(path)))
    free = (grid.labels == OPEN).T
    times = max(1, round(cell / grid.cell))
    free = free[: len(free) // times * times, : free.shape[1] // times * times]
    free = free.reshape(len(free) // times, times, -1, times).all((1, 3))
    parts, _ = label(free)
    largest = parts == np.bincount(parts[free]).argmax()
    y, x = np.nonzero(largest)
    part = np.pad(largest[y.min() : y.max() + 1, x.min() : x.max() + 1], 1)
    return np.where(part, FREE, WALL).astype(np.int8), grid.cell * times


def place_team(grid: np.ndarray, cell: float, radius: float, count: int, first) -> np.ndarray:
    """Robots beside each other, as a team begins: float64 [count, 2] [m].

    Args:
        grid: of `make_floor`.
        cell: its edge [m].
        radius: of the robots [m].
        count: how many.
        first: x, y [m] that the robots stand nearest to, or a `numpy.random.Generator` that draws a place.

    Raises:
        ValueError: there is no room, or none near `first`.
    """
    open_ = distance_transform_edt(grid == FREE) * cell > radius + cell
    y, x = np.nonzero(open_)
    room = (np.stack([x, y], -1) + 0.5) * cell
    if not len(room):
        raise ValueError(f"no robot of robot_radius={radius:g} m has room on this floor")
    if isinstance(first, np.random.Generator):
        first = room[first.integers(len(room))]
    parts, _ = label(open_)
    away = np.linalg.norm(room - first, axis=-1)
    home = away.argmin()
    if not away[home] <= max(NEAR, 4.0 * radius):
        raise ValueError(
            f"start={first[0]:g} {first[1]:g} is no place for a robot of {radius:g} m, nor is any near it: "
            f"the nearest is {room[home][0]:.1f} {room[home][1]:.1f}"
        )
    room = room[parts[y, x] == parts[y[home], x[home]]]
    room = room[np.linalg.norm(room - first, axis=-1).argsort(kind="stable")]
    places: list[np.ndarray] = []
    while len(room) and len(places) < count:
        places.append(room[0])
        room = room[np.linalg.norm(room - room[0], axis=-1) >= 2.5 * radius]
    if len(places) < count:
        raise ValueError(f"robots={count} of {radius:g} m have no room here: {len(places)} do")
    return np.array(places)


TICK = 0.1  # seconds of a step
LOOKS = 5  # ticks between two scans
MARKS = (0.95, 0.99, 0.995)
SPARE = 2.0  # a target counts as left over if no goal lies so near to it [m]
ASIDE = np.radians([0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0])  # headings that a robot tries, off its way
STANDS = 0.5  # metres between places to see the floor from, for what could be seen
BEAM = 0.5  # cells between two points of a beam, and between two beams at the end of their range


@dataclass
class Course:
    """What came of an exploration.

    Attributes:
        reached: seconds until each of `MARKS` of what can be seen of the floor was seen; infinite: never.
        share: of what can be seen of the floor, seen at the end.
        seconds: until it was done, or broken off.
        done: whether the planner said that nothing was left.
        driven: way of all robots [m].
        needless: pairs of robots in one call with the same goal, or goals nearer than their bodies, while a target
            was left over.
        close: the same, whether or not one was.
        waits: calls in which a robot was told to wait.
        notes: what the planner said, with the time.
        tracks: where the robots were, float64 [ticks, N, 2] [m].
    """

    reached: np.ndarray
    share: float = 0.0
    seconds: float = 0.0
    done: bool = False
    driven: float = 0.0
    needless: int = 0
    close: int = 0
    waits: int = 0
    notes: list[str] = field(default_factory=list)
    tracks: np.ndarray | None = None


class SimulatedFloor:
    """A floor and what a team has seen of it.

    Args:
        grid: int8 [H, W], row = y: 0 free, all else walls.
        cell: edge of a cell [m].
        places: float64 [N, 2], where the robots begin [m].
        radius, reach, speed: of a robot: body [m], lidar [m], driving [m/s].
    """

    def __init__(self, grid: np.ndarray, cell: float, places: np.ndarray, radius: float, reach: float, speed: float):
        self.grid, self.cell, self.at = grid, cell, np.array(places, np.float64)
        self.radius, self.reach, self.speed = radius, reach, speed
        self.seen = np.zeros(grid.shape, bool)
        self.gap = distance_transform_edt(grid == FREE) * cell - 0.5 * cell
        beams = np.arange(0.0, 2.0 * math.pi, BEAM * cell / reach)
        unit = np.stack([np.cos(beams), np.sin(beams)], -1)
        self.rays = unit[:, None] * np.arange(0.0, reach, BEAM * cell)[:, None]
        self.counts = self._within_sight() & (grid == FREE)
        self.look()

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of points [..., 2] [m], the nearest on the floor."""
        index = np.floor(points / self.cell).astype(np.int64)
        return tuple(index[..., k].clip(0, self.grid.shape[1 - k] - 1) for k in (1, 0))

    def look(self) -> None:
        """Scan from where the robots are: every beam sees as far as the first wall, and that."""
        for at in self.at:
            self._scan(at, self.seen)

    def _scan(self, at: np.ndarray, seen: np.ndarray) -> None:
        """Mark what a lidar sees from there."""
        y, x = self.cells(at + self.rays)
        wall = self.grid[y, x] != FREE
        clear = np.cumsum(wall, axis=1) - wall == 0
        seen[y[clear], x[clear]] = True

    def _within_sight(self) -> np.ndarray:
        """The cells that robots of this size can see from where they get to, bool [H, W]."""
        fits = self.gap >= self.radius
        starts = self.cells(self.at)
        fits[starts] = True
        parts, _ = label(fits)
        y, x = np.nonzero(np.isin(parts, parts[starts]))
        blocks = np.stack([y, x]) // max(1, round(STANDS / self.cell))
        first = np.unique(blocks, axis=1, return_index=True)[1]
        seen = np.zeros(self.grid.shape, bool)
        for at in (np.stack([x, y], -1)[first] + 0.5) * self.cell:
            self._scan(at, seen)
        return seen

    def known(self) -> np.ndarray:
        """The team's map as ROS has it: -1 unknown, 0 free, 100 wall."""
        return np.where(self.seen, np.where(self.grid == FREE, 0, 100), -1)

    def share(self) -> float:
        """Of the free cells that robots of this size can see from where they get to, those seen."""
        return float(self.seen[self.counts].mean())

    def drive(self, ways: list[np.ndarray]) -> float:
        """One tick along the ways, corners left to come [k, 2] each, which are used up; metres driven."""
        driven = 0.0
        for robot, way in enumerate(ways):
            while len(way) and np.linalg.norm(way[0] - self.at[robot]) < 1e-6:
                way = way[1:]
            ways[robot] = way
            if not len(way):
                continue
            to = way[0] - self.at[robot]
            length = min(self.speed * TICK, float(np.linalg.norm(to)))
            step = self._step(robot, math.atan2(to[1], to[0]), length)
            self.at[robot] += step
            driven += float(np.linalg.norm(step))
            if len(way) > 1 and np.linalg.norm(way[0] - self.at[robot]) < self.speed * TICK:
                ways[robot] = way[1:]
        return driven

    def _step(self, robot: int, heading: float, length: float) -> np.ndarray:
        """The step of that length nearest to a heading that leads into no wall and no other robot; 0: there is none."""
        others = np.delete(self.at, robot, 0)
        before = np.linalg.norm(others - self.at[robot], axis=-1)
        here = self.gap[self.cells(self.at[robot])]
        for aside in ASIDE:
            step = length * np.array([math.cos(heading + aside), math.sin(heading + aside)])
            after = np.linalg.norm(others - self.at[robot] - step, axis=-1)
            room = self.gap[self.cells(self.at[robot] + step)]
            if (room >= min(self.radius, here) - 1e-9) and ((after >= 2.0 * self.radius) | (after > before)).all():
                return step
        return np.zeros(2)


def explore(floor: SimulatedFloor, planner: TeamPlanner, seconds: float) -> Course:
    """Let a team explore a floor, until the planner says done or for so many seconds; it plans once a second."""
    course, tracks = Course(np.full(len(MARKS), np.inf)), [floor.at.copy()]
    ways: list[np.ndarray] = [np.zeros((0, 2))] * len(floor.at)
    for tick in range(round(seconds / TICK)):
        now = tick * TICK
        if tick % round(1.0 / TICK) == 0:
            plan = planner.plan(floor.known(), floor.cell, (0.0, 0.0), floor.at, now=now, time_left=1.0 - now / seconds)
            _note(course, plan, floor, now)
            if plan.done:
                course.done = True
                break
            ways = [way[1:] for way in plan.ways]
        course.driven += floor.drive(ways)
        if tick % LOOKS == LOOKS - 1:
            floor.look()
        tracks.append(floor.at.copy())
    course.share, course.seconds, course.tracks = floor.share(), now, np.array(tracks)
    return course


def _note(course: Course, plan: Plan, floor: SimulatedFloor, now: float) -> None:
    share = floor.share()
    course.reached[(share >= np.array(MARKS)) & np.isinf(course.reached)] = now
    course.waits += int(plan.waits.sum())
    course.notes += [f"{now:.0f} s: {note}" for note in plan.notes]
    close, needless = count_close(plan, floor.radius)
    course.close += close
    course.needless += needless


def count_close(plan: Plan, radius: float) -> tuple[int, int]:
    """Pairs of robots with the same goal, or goals nearer than their bodies; the same while a target was left over."""
    goals = plan.goals[plan.active]
    if len(goals) < 2:
        return 0, 0
    gaps = np.linalg.norm(goals[:, None] - goals, axis=-1)[np.triu_indices(len(goals), 1)]
    close = int((gaps < 2.0 * radius).sum())
    left = np.linalg.norm(plan.targets[:, None] - goals, axis=-1).min(-1) > SPARE
    return close, close * bool(left.any())
