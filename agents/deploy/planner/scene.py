"""What a team chooses from, out of its grid and poses: who takes part, ways, targets and what is to be seen there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.ndimage import label
from scipy.optimize import linear_sum_assignment

from maexp.agents.deploy.planner.assignment import plan_in_turn
from maexp.agents.deploy.planner.frontiers import STRIDE, Targets, list_targets, look_around, mark_frontier
from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.grid_search import cells_ahead, flood, gap_squares, grow_trees, mark_passable, snap
from maexp.agents.deploy.planner.team import Team
from maexp.envs.targets.heuristics import CLASSICAL, rank
from maexp.kernels.constants import MARGIN_CELLS, OBSTACLE, SNAP_CELLS, STRAIGHT, UNREACHED, block_sides

UNREACHABLE = 1e12  # stands for no way where numbers must be finite [m]


@dataclass(frozen=True)
class ArrayScene:
    """What targets are chosen from: n robots that take part, K targets, lengths on the grid in metres. Planners use it
    as a `maexp.envs.targets.heuristics.Scene`.

    Attributes:
        grid, radar_range: what the team knows, and how far robots see.
        robots: int64 [n], which of the team take part.
        at: float64 [n, 2], where they are.
        passable, distance: per robot uint8 and int32 [H, W], as `mark_passable` and `flood` make them.
        targets: blocks, cells and sizes of the targets.
        travel: float32 [n, K], way from robot to target; infinite where there is none or it is not to be taken.
        way: the same without anything that is not to be taken.
        points: float64 [K, 2], where the targets are.
        gain: float32 [K], unknown cells in radar range and sight of each, as a share of the radar's disc.
        middle: float32 [K, 2], the middle of those, from the target.
        near: bool [n, K], which robots stand beside which targets.
        rng: for choices at random.
    """

    grid: KnownGrid
    radar_range: float
    robots: np.ndarray
    at: np.ndarray
    passable: list[np.ndarray]
    distance: np.ndarray
    targets: Targets
    travel: np.ndarray
    way: np.ndarray
    points: np.ndarray
    gain: np.ndarray
    middle: np.ndarray
    near: np.ndarray
    rng: np.random.Generator
    xp: ClassVar[Any] = np

    @property
    def cell(self) -> float:
        return self.grid.cell

    @property
    def alive(self) -> np.ndarray:
        return np.ones(len(self.at), bool)

    @property
    def size(self) -> np.ndarray:
        return self.targets.size

    def ways_ahead(self, cells: float) -> np.ndarray:
        return self.ways_to(np.tile(self.targets.cell, (len(self.at), 1)), cells)

    def ways_to(self, targets: np.ndarray, cells: float) -> np.ndarray:
        """`ways_ahead`, to cells, int64 [n, M]."""
        first = cells_ahead(self.passable, self.distance, targets, cells)
        return self.grid.centers(np.maximum(first, 0)) - self.at[:, None]

    def total(self, values: np.ndarray) -> np.ndarray:
        return values.sum(1)

    def in_turn(self, gain: np.ndarray, value: np.ndarray) -> np.ndarray:
        gain = np.broadcast_to(gain, value.shape).astype(np.float32)
        points = np.broadcast_to(self.points / self.radar_range, (*value.shape, 2))
        return plan_in_turn(gain, value.astype(np.float32), points)[0]

    def match(self, among: np.ndarray) -> np.ndarray:
        matched = np.zeros(among.shape, bool)
        matched[linear_sum_assignment(np.where(among, self.travel, UNREACHABLE))] = True
        return matched

    def heard(self, values: np.ndarray, blank: float) -> np.ndarray:
        return values[None]

    def found_by_trees(self, samples: int, branch: float) -> np.ndarray:
        ends = grow_trees(self.grid, self.at, self.rng, samples, branch)
        block = self.targets.block_of(ends % self.grid.width, ends // self.grid.width)
        return (self.targets.block[:, None] == block).all(-1).any(1)

    def of(self, rows: np.ndarray) -> ArrayScene:
        """The scene for some of its robots, bool [n]."""
        passable = [mask for mask, kept in zip(self.passable, rows, strict=True) if kept]
        parts = {name: getattr(self, name)[rows] for name in ("robots", "at", "distance", "travel", "way", "near")}
        return replace(self, passable=passable, **parts)


def look_at(
    grid: KnownGrid,
    team: Team,
    radar_range: float,
    clearance_factor: float,
    bounded: bool,
    least_area: float | None,
    shift: tuple[int, int],
    rng: np.random.Generator,
    notes: list[str],
) -> ArrayScene:
    """Looks at the grid for the whole team.

    Args:
        radar_range: how far robots see [m].
        clearance_factor: radii that robots keep from walls where there is room.
        bounded: nothing lies beyond the grid's edge.
        least_area: targets with less to see do not count [m^2]; None: what a robot covers.
        shift: the grid's corner, in cells from where blocks are counted.
        rng: for choices at random.
        notes: robots that are left out are added, a sentence each.
    """
    robots, passable, distance = find_ways(grid, team, clearance_factor, notes)
    radius = team.radius[robots]
    search = math.ceil(np.float32(radius.max(initial=0.0)) / np.float32(grid.cell) + np.float32(MARGIN_CELLS)) + 1
    extent = (grid.width, grid.height) if bounded else (math.inf, math.inf)
    side = int(block_sides(grid.cell, radar_range, *extent))
    targets = list_targets(mark_frontier(grid.known, bounded), (distance < UNREACHED).any(0), side, search, shift)
    area, middle = look_around(grid, targets.cell, radar_range, bounded)
    least = math.pi * radius.min(initial=math.inf) ** 2 if least_area is None else least_area
    kept = area * grid.cell**2 >= least
    targets, area, middle = targets.select(kept), area[kept], middle[kept]
    points = grid.centers(targets.cell)
    way = distance.reshape(len(robots), grid.known.size)[:, targets.cell]
    way = np.where(way < UNREACHED, way * np.float32(grid.cell / STRAIGHT), np.float32(np.inf))
    at = grid.from_map(team.at[robots])
    beside = np.maximum(1.5 * grid.cell, clearance_factor * radius)[:, None]
    return ArrayScene(
        grid=grid,
        radar_range=radar_range,
        robots=robots,
        at=at,
        passable=passable,
        distance=distance,
        targets=targets,
        travel=way,
        way=way,
        points=points,
        gain=area / np.float32(math.pi * (radar_range / grid.cell) ** 2),
        middle=middle,
        near=np.linalg.norm(points - at[:, None], axis=-1) <= beside,
        rng=rng,
    )


def find_ways(grid: KnownGrid, team: Team, clearance_factor: float, notes: list[str]):
    """The robots that have a place on the grid, and where each can get to."""
    gaps = gap_squares(grid.known)
    sizes, which = np.unique(team.radius, return_inverse=True)
    masks = [mark_passable(grid, gaps, size, clearance_factor * size) for size in sizes]
    sources = np.full(len(team.names), -1)
    for robot in np.flatnonzero(np.isfinite(team.at).all(-1)):
        sources[robot] = _find_start(grid, masks[which[robot]], team, robot, notes)
    robots = np.flatnonzero(sources >= 0)
    distance = np.full((len(robots), *grid.known.shape), UNREACHED, np.int32)
    for k, mask in enumerate(masks):
        rows = which[robots] == k
        if rows.any():
            distance[rows] = flood(mask, sources[robots[rows]])
    return robots, [masks[which[robot]] for robot in robots], distance


def _find_start(grid: KnownGrid, passable: np.ndarray, team: Team, robot: int, notes: list[str]) -> int:
    """The cell that a robot's ways start from, -1 = none."""
    cell = int(grid.cells(grid.from_map(team.at[robot])))
    x, y = team.at[robot]
    if cell < 0:
        notes.append(f"{team.title(robot)} is outside of the grid at ({x:.2f}, {y:.2f}) and was left out")
        return -1
    start = snap(passable, cell)
    if start < 0:
        start = _snap_far(grid, passable, cell, 4.0 * team.radius[robot])
    if start < 0:
        notes.append(f"{team.title(robot)} is in a wall or on unknown ground at ({x:.2f}, {y:.2f}) and was left out")
    elif grid.known.flat[cell] == OBSTACLE:
        notes.append(f"{team.title(robot)} is in a wall at ({x:.2f}, {y:.2f}): its way starts beside it")
    return start


def _snap_far(grid: KnownGrid, passable: np.ndarray, cell: int, room: float) -> int:
    """The nearest passable cell within `room` [m] on this side of the walls; -1 where none is.

    A robot may stand on ground that it does not see itself, and nearer to a wall than its radius allows.
    """
    reach = max(SNAP_CELLS, math.ceil(room / grid.cell))
    y, x = divmod(cell, grid.width)
    part = (slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1))
    side, _ = label(grid.known[part] != OBSTACLE)
    here = side[y - part[0].start, x - part[1].start]
    if here == 0:
        return -1
    near = np.zeros_like(passable)
    near[part] = passable[part] * (side == here)
    return snap(near, cell, reach)


def rank_any(scene: ArrayScene) -> np.ndarray:
    """Each robot any target that it can get to, and that one again as long as it is there."""
    start = scene.rng.bit_generator.seed_seq.entropy
    draw = [
        np.random.default_rng([start, robot, *block]).random()
        for robot in scene.robots.tolist()
        for block in (scene.targets.block + STRIDE).tolist()
    ]
    return rank(scene, np.reshape(draw, scene.travel.shape), np.isfinite(scene.travel))


CHOICES: dict[str, Callable[[ArrayScene], np.ndarray]] = {"random": rank_any} | CLASSICAL
"""Name -> `ArrayScene` to what each robot thinks of each target, float [n, K]; -inf: out of reach."""
