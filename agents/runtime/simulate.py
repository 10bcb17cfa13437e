"""A team in closed loop: round robots with a lidar on a known floor, sent by a `TeamPlanner` once a second.

Small on purpose: no noise, no dynamics, one map for all, and robots that step aside for each other. It shows what a
planner makes of its own decisions, call after call, to the last corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from .floors import FREE
from .planner import Plan, TeamPlanner

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
