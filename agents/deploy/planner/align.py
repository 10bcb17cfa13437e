"""Where the map of one robot lies in that of another, from the maps alone; NumPy and SciPy only.

All turns are tried on coarse cells, all shifts at once by correlation. The best are refined by iterated closest points
and judged by the walls that each map shows where the other one knows the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from maexp.agents.deploy.planner.frames import OccupancyGrid, Pose, check_map, compose

ACROSS = 128  # coarse cells across the larger map
TURNS = 120  # that are tried
PEAKS = 4  # shifts of each turn that are looked at
REFINED = 16  # candidates that are refined
POINTS = 3000  # of walls that are refined with
CONTRADICTION = 0.7  # what a wall on free ground takes away, as a share of what a wall on a wall adds
NEAR, TURNED = 1.0, math.radians(10.0)  # candidates nearer to each other are one [m, rad]
OCCUPIED = 65.0  # cells of so many percent and more are walls


@dataclass(frozen=True)
class Alignment:
    """Where one map lies in another.

    Attributes:
        pose: of the second map's frame in that of the first: x, y [m], yaw [rad].
        confidence: 0 to 1: how well walls agree, times how far the next best place is behind.
        agreement: share of the walls that both maps can show and both do.
        shared: length of these walls [m].
    """

    pose: Pose
    confidence: float
    agreement: float
    shared: float


@dataclass(frozen=True)
class _Layers:
    """Walls and free ground of a map as points [n, 2] [m], and lookups of them in its own cells."""

    walls: np.ndarray
    free: np.ndarray
    grid: OccupancyGrid
    gap: np.ndarray  # of every cell to the nearest wall [m]


def align_grids(
    a: OccupancyGrid,
    b: OccupancyGrid,
    *,
    occupied: float = OCCUPIED,
    least_agreement: float = 0.85,
    least_shared: float = 8.0,
    least_lead: float = 0.3,
) -> Alignment | None:
    """Find out where map `b` lies in the frame of map `a`; None where they share too little, or it is ambiguous.

    Args:
        a, b: maps of two robots.
        occupied: cells with so many percent and more are walls.
        least_agreement: of the walls that both can show.
        least_shared: length of walls that both show [m].
        least_lead: how far the next best place must be behind, as a share of the best.

    Raises:
        ValueError: one is no occupancy grid.
    """
    one, two = _read(check_map(a), occupied), _read(check_map(b), occupied)
    if min(len(one.walls), len(one.free), len(two.walls), len(two.free)) < 10:
        return None
    found = []
    for pose in _candidates(one, two):
        pose = _refine(one, two, pose)
        found.append((*_judge(one, two, pose), pose))
    found.sort(key=lambda row: row[0], reverse=True)
    score, agreement, shared, pose = found[0]
    rivals = [row[0] for row in found[1:] if not _are_near(row[3], pose, two)]
    lead = 1.0 - max([0.0, *rivals]) / max(score, 1e-9)
    if agreement < least_agreement or shared < least_shared or lead < least_lead:
        return None
    return Alignment(pose, agreement * min(1.0, lead / 0.5), agreement, shared)


def _read(grid: OccupancyGrid, occupied: float) -> _Layers:
    values, cell = grid.values, grid.resolution
    walls, free = values >= occupied, (values >= 0) & (values < occupied)
    walls &= values <= 100
    gap = distance_transform_edt(~walls) * cell if walls.any() else np.full(values.shape, np.inf)
    return _Layers(_points(grid, walls), _points(grid, free & (gap > 2.0 * cell)), grid, gap)


def _points(grid: OccupancyGrid, cells: np.ndarray) -> np.ndarray:
    """Middles of cells in the map's frame, [n, 2] [m]."""
    y, x = np.nonzero(cells)
    return move(grid.origin, (np.stack([x, y], -1) + 0.5) * grid.resolution)


def move(pose: Pose, points: np.ndarray) -> np.ndarray:
    """Points [n, 2] of a frame that stands at `pose`, in the outer frame [m]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def _candidates(one: _Layers, two: _Layers) -> list[Pose]:
    """Poses of the second map in the first, the best first, none near another."""
    middle = two.walls.mean(0)
    sizes = [np.ptp(np.concatenate([part.walls, part.free]), axis=0).max() for part in (one, two)]
    cell = max(max(sizes) / ACROSS, one.grid.resolution, two.grid.resolution)
    known = np.concatenate([one.walls, one.free])
    low = known.min(0) - cell
    reach = np.linalg.norm(np.concatenate([two.walls, two.free]) - middle, axis=-1).max() + 2.0 * cell
    span = np.ptp(known, axis=0) + 2.0 * cell + 2.0 * reach
    shape = tuple(fft.next_fast_len(math.ceil(side / cell) + 2, real=True) for side in span)
    walls, free = (_raster(part, low, cell, shape) for part in (one.walls, one.free))
    likes = fft.rfft2(gaussian_filter(walls, 1.0) / 0.4 - CONTRADICTION * free)
    avoids = fft.rfft2(CONTRADICTION * walls)
    scored: list[tuple[float, Pose]] = []
    size = math.ceil(NEAR / cell)
    for yaw in np.arange(TURNS) * (2.0 * math.pi / TURNS):
        turned = [move((0.0, 0.0, yaw), part - middle) + reach for part in (two.walls, two.free)]
        others = [fft.rfft2(_raster(part, np.zeros(2), cell, shape)) for part in turned]
        score = fft.irfft2(likes * others[0].conj() - avoids * others[1].conj(), shape)
        for _ in range(PEAKS):
            at = np.array(np.unravel_index(score.argmax(), shape))
            value = float(score[tuple(at)])
            shift = np.where(at > np.array(shape) - reach * 2.0 / cell - 1.0, at - shape, at) * cell
            x, y = low + shift + reach
            scored.append((value, compose((x, y, float(yaw)), (-middle[0], -middle[1], 0.0))))
            rows, columns = (np.arange(k - size, k + size + 1) % side for k, side in zip(at, shape, strict=True))
            score[np.ix_(rows, columns)] = -np.inf
    scored.sort(key=lambda row: row[0], reverse=True)
    found: list[Pose] = []
    for _, pose in scored:
        if not any(_are_near(pose, other, two) for other in found):
            found.append(pose)
        if len(found) == REFINED:
            break
    return found


def _raster(points: np.ndarray, low: np.ndarray, cell: float, shape: tuple[int, ...]) -> np.ndarray:
    """Cells [x, y] that hold points, float32."""
    index = np.floor((points - low) / cell).astype(np.int64)
    flags = np.zeros(shape, np.float32)
    flags[index[:, 0] % shape[0], index[:, 1] % shape[1]] = 1.0
    return flags


def _are_near(pose: Pose, other: Pose, two: _Layers) -> bool:
    """Whether two poses put the middle of the second map into nearly the same place, turned alike."""
    middle = two.walls.mean(0)[None]
    turn = abs(math.remainder(pose[2] - other[2], 2.0 * math.pi))
    return turn < TURNED and float(np.linalg.norm(move(pose, middle) - move(other, middle))) < NEAR


def _refine(one: _Layers, two: _Layers, pose: Pose) -> Pose:
    """By iterated closest points of walls, from far to near."""
    tree, points = cKDTree(one.walls), two.walls[:: max(1, len(two.walls) // POINTS)]
    finest = 2.0 * max(one.grid.resolution, two.grid.resolution)
    for limit in (*np.geomspace(max(1.0, finest), finest, 12), *[finest] * 6):
        moved = move(pose, points)
        far, nearest = tree.query(moved, distance_upper_bound=limit)
        hit = np.isfinite(far)
        if hit.sum() < 10:
            break
        ours, theirs = moved[hit], one.walls[nearest[hit]]
        middle, aim = ours.mean(0), theirs.mean(0)
        u, v = ours - middle, theirs - aim
        turn = math.atan2(float((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()), float((u * v).sum()))
        x, y = aim - move((0.0, 0.0, turn), middle[None])[0]
        pose = compose((float(x), float(y), turn), pose)
    return pose


def _judge(one: _Layers, two: _Layers, pose: Pose) -> tuple[float, float, float]:
    """Score, share of walls that agree, and length of walls that both show [m]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    back = (-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2])
    agreed, denied = np.zeros(2), np.zeros(2)
    for k, (walls, other) in enumerate(((move(pose, two.walls), one), (move(back, one.walls), two))):
        own = two.grid.resolution if k == 0 else one.grid.resolution
        value, gap = _look_up(other, walls)
        near = 2.5 * max(own, other.grid.resolution)
        agreed[k] = own * np.count_nonzero(gap <= near)
        denied[k] = own * np.count_nonzero((value >= 0) & (gap > near))
    total = agreed.sum() + denied.sum()
    agreement = float(agreed.sum() / total) if total else 0.0
    shared = float(agreed.min())
    return shared * agreement**4, agreement, shared


def _look_up(layers: _Layers, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a map shows at points, -1 outside of it, and how far the nearest wall is there [m]."""
    grid = layers.grid
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    index = np.floor((points - (x, y)) @ np.array([[c, -s], [s, c]]) / grid.resolution).astype(np.int64)
    height, width = grid.values.shape
    inside = (index >= 0).all(-1) & (index < (width, height)).all(-1)
    column, row = np.where(inside[:, None], index, 0).T
    return np.where(inside, grid.values[row, column], -1), np.where(inside, layers.gap[row, column], np.inf)
