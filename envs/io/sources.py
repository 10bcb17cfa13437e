"""Where labelled grids come from: an image of one cell size, or points that are counted anew at each cell size."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import ndimage

from maexp.envs.io.grid import EIGHT, FREE, MAX_CELLS, OBSTACLE, UNKNOWN, Grid, resample
from maexp.envs.maps.point_cloud import MapError

DIRECTIONS = 16
WALLED_IN = 13  # of 16 directions must meet a wall for a place to lie inside
HEAD_HEIGHT = 1.8  # [m]; free space is not inferred below what hangs lower
SIGHT = 40.0  # [m]; walls farther than this enclose nothing


class Source(Protocol):
    """Gives the same place at any cell size."""

    finest: float  # cells [m] smaller than this show nothing more

    def at(self, cell: float) -> Grid:
        """The place in cells of `cell` [m]."""


class GridSource:
    """A grid that came from an image."""

    def __init__(self, grid: Grid):
        self.grid = grid
        self.finest = grid.cell

    def at(self, cell: float) -> Grid:
        return resample(self.grid, cell)


class FloorSource:
    """Points over one flat floor at height 0: what lies on the floor is free, what a robot would hit is not.

    Args:
        points: [m], float64 [count, 3]; heights above the floor.
        low, high: a robot drives over what is lower than `low` and passes under what is higher than `high` [m].
        finest: smallest useful cell [m].
        open_space: places known to be empty [m], [open_count, 3], or None.
        infer: take as free what walls enclose, seen or not.
        holes: gaps of the floor up to this many cells across are filled.
    """

    def __init__(self, points, low: float, high: float, finest: float, *, open_space=None, infer=False, holes=2):
        height = points[:, 2]
        self.walls = points[(height > low) & (height <= high)]
        self._tall = points[(height > low) & (height <= max(high, HEAD_HEIGHT)), :2]  # sparse walls have fewer gaps
        ground = [points[np.abs(height) <= low, :2]]
        if open_space is not None:
            ground.append(open_space[(open_space[:, 2] > 0) & (open_space[:, 2] <= high), :2])
        self.ground = np.concatenate(ground)
        self.finest = finest
        self.infer = infer
        self.holes = holes
        inside = np.concatenate([self._tall, self.ground])
        self._low, self._high = inside.min(axis=0), inside.max(axis=0)

    def at(self, cell: float) -> Grid:
        shape = grid_shape(self._low, self._high, cell)
        walls = count_points(self.walls[:, :2], self._low, cell, shape) > 0
        free = count_points(self.ground, self._low, cell, shape) > 0
        if self.infer:
            tall = count_points(self._tall, self._low, cell, shape) > 0
            free |= walled_in(tall, cell) & ~tall
        free &= ~walls
        if self.holes:
            free |= fill_holes(free, self.holes) & ~walls
        labels = np.where(walls, OBSTACLE, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
        top = np.zeros(shape, dtype=np.float32)
        index = cell_index(self.walls[:, :2], self._low, cell, shape)
        np.maximum.at(top, index, self.walls[:, 2].astype(np.float32))
        return Grid(labels, cell, tuple(self._low.tolist()), height=top)

    def floor_share(self, cell: float) -> float:
        """How much of what the walls enclose was scanned as floor."""
        shape = grid_shape(self._low, self._high, cell)
        walls = count_points(self.walls[:, :2], self._low, cell, shape) > 0
        inside = walled_in(walls, cell) & ~walls
        seen = fill_holes(count_points(self.ground, self._low, cell, shape) > 0, 2)
        return float(seen[inside].mean()) if inside.any() else 1.0


def grid_shape(low: np.ndarray, high: np.ndarray, cell: float) -> tuple[int, int]:
    """Cells of side `cell` [m] that cover `low` to `high` [m]."""
    shape = np.floor((high - low) / cell) + 1
    if not shape.prod() <= MAX_CELLS:
        raise MapError(
            f"{high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m need more than {MAX_CELLS} cells of {cell:g} m: check "
            "units, crop, or take a coarser resolution"
        )
    return int(shape[0]), int(shape[1])


def cell_index(places: np.ndarray, low: np.ndarray, cell: float, shape) -> tuple[np.ndarray, np.ndarray]:
    """Index pair of the cell of each place [m], [count, 2]."""
    index = np.floor((places - low) / cell).astype(np.int64).clip(0, np.array(shape) - 1)
    return index[:, 0], index[:, 1]


def count_points(places: np.ndarray, low: np.ndarray, cell: float, shape) -> np.ndarray:
    """Places [m] in each cell, int [nx, ny]."""
    x, y = cell_index(places, low, cell, shape)
    return np.bincount(x * shape[1] + y, minlength=shape[0] * shape[1]).reshape(shape)


def fill_holes(free: np.ndarray, width: int) -> np.ndarray:
    """`free` and the gaps in it of up to `width` cells; bool [nx, ny]."""
    margin = width + 1
    closed = ndimage.binary_closing(np.pad(free, margin), np.ones((width + 1, width + 1), dtype=bool))
    return free | closed[margin:-margin, margin:-margin]


def walled_in(walls: np.ndarray, cell: float) -> np.ndarray:
    """Cells from which at least 13 of 16 directions meet a wall within 40 m; bool [nx, ny].

    Along each direction the reach doubles at every turn, so it costs a few shifts of the whole grid.
    """
    thick = ndimage.binary_dilation(walls, EIGHT)
    votes = np.zeros(walls.shape, dtype=np.uint8)
    for angle in np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS):
        ahead = np.array([np.cos(angle), np.sin(angle)])
        hit, reach = thick.copy(), 1
        while reach * cell <= SIGHT and reach < 2 * max(walls.shape):
            dx, dy = np.rint(reach * ahead).astype(int)
            hit |= _look(hit, dx, dy)
            reach *= 2
        votes += hit
    return votes >= WALLED_IN


def _look(hit: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """`hit` at the cell (dx, dy) away from each; False outside."""
    seen = np.zeros_like(hit)
    nx, ny = hit.shape
    if abs(dx) < nx and abs(dy) < ny:
        seen[max(0, -dx) : nx - max(0, dx), max(0, -dy) : ny - max(0, dy)] = hit[
            max(0, dx) : nx - max(0, -dx), max(0, dy) : ny - max(0, -dy)
        ]
    return seen
