"""Labelled grids: unknown, free or obstacle cells; the common form of every file on its way to a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from maexp.envs.maps.point_cloud import MapError
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN

MAX_CELLS = 40_000_000
MAX_ORIGIN = 1e8  # [m]
EIGHT = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True)
class Grid:
    """Cells of one size.

    Attributes:
        labels: UNKNOWN, FREE or OBSTACLE, uint8 [nx, ny]; first index along the grid's x.
        cell: side of a cell [m].
        origin: world position of the outer corner of cell (0, 0) [m].
        yaw: angle of the grid's x axis in the world [rad].
        height: mean height of the surface in each cell [m], float32 [nx, ny], or None.
    """

    labels: np.ndarray
    cell: float
    origin: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    height: np.ndarray | None = None

    def count(self, label: int) -> int:
        return int((self.labels == label).sum())

    def centres(self, mask: np.ndarray) -> np.ndarray:
        """World positions of the true cells of `mask` [m], float64 [count, 2]."""
        return self.to_world(np.argwhere(mask) + 0.5)

    def to_world(self, index: np.ndarray) -> np.ndarray:
        """World positions [m] of fractional cell indices, both [..., 2]."""
        local = np.asarray(index, dtype=np.float64) * self.cell
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return local @ np.array([[c, s], [-s, c]]) + np.asarray(self.origin)

    def to_index(self, places: np.ndarray) -> np.ndarray:
        """Fractional cell indices of world positions [m], both [..., 2]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return (np.asarray(places, dtype=np.float64) - self.origin) @ np.array([[c, -s], [s, c]]) / self.cell

    def cut(self, low, high) -> Grid:
        """The cells from index `low` (inclusive) to `high` (exclusive)."""
        (x0, y0), (x1, y1) = low, high
        height = None if self.height is None else self.height[x0:x1, y0:y1]
        corner = tuple(self.to_world(np.array([x0, y0])).tolist())
        return replace(self, labels=self.labels[x0:x1, y0:y1], origin=corner, height=height)

    def pad(self, margin: int) -> Grid:
        """`margin` unknown cells more on every side."""
        labels = np.pad(self.labels, margin, constant_values=UNKNOWN)
        height = None if self.height is None else np.pad(self.height, margin, mode="edge")
        corner = tuple(self.to_world(np.array([-margin, -margin])).tolist())
        return replace(self, labels=labels, origin=corner, height=height)

    def trim(self, margin: int) -> Grid:
        """The bounding box of the free cells and `margin` cells around it."""
        padded = self.pad(margin)
        inside = np.argwhere(padded.labels == FREE)
        return padded.cut(inside.min(axis=0) - margin, inside.max(axis=0) + 1 + margin)


def resample(grid: Grid, cell: float) -> Grid:
    """Coarser cells, cautiously: one obstacle makes a cell an obstacle, and half of a free cell must be free.

    A cell without obstacle and less than half free is unknown. Only coarsens: `cell` >= grid.cell.
    """
    ratio = cell / grid.cell
    if ratio <= 1 + 1e-9:
        return grid
    shape = [max(1, math.ceil(n / ratio - 1e-9)) for n in grid.labels.shape]
    edges = [np.minimum(np.arange(n) * ratio, old - 1) for n, old in zip(shape, grid.labels.shape, strict=True)]
    starts = [np.ceil(edge - 0.5 - 1e-9).astype(int).clip(0) for edge in edges]  # pixels by their centre

    def total(mask: np.ndarray) -> np.ndarray:
        rows = np.add.reduceat(mask.astype(np.int32), starts[0], axis=0)
        return np.add.reduceat(rows, starts[1], axis=1)

    obstacle, free = total(grid.labels == OBSTACLE), total(grid.labels == FREE)
    pixels = total(np.ones_like(grid.labels))
    labels = np.full(shape, UNKNOWN, dtype=np.uint8)
    labels[(free > 0) & (free * 2 >= pixels)] = FREE
    labels[obstacle > 0] = OBSTACLE
    return replace(grid, labels=labels, cell=cell, height=None)


def refine(grid: Grid, cell: float) -> Grid:
    """Finer cells, each with the label of the old one that its centre lies in: no wall gets a hole.

    Only refines: `cell` <= grid.cell.
    """
    ratio = cell / grid.cell
    if ratio >= 1 - 1e-9:
        return grid
    nx, ny = (round(n / ratio) for n in grid.labels.shape)
    if nx * ny > MAX_CELLS:
        raise MapError(
            f"{nx} x {ny} cells of {cell:g} m are more than {MAX_CELLS:,}: crop, or take a coarser resolution"
        )
    old_x, old_y = (((np.arange(n) + 0.5) * ratio - 1e-9).astype(int) for n in (nx, ny))
    height = None if grid.height is None else grid.height[np.ix_(old_x, old_y)]
    return replace(grid, labels=grid.labels[np.ix_(old_x, old_y)], cell=cell, height=height)


def seal(grid: Grid) -> tuple[Grid, int]:
    """Turns every unknown cell that touches free space, corners included, into an obstacle.

    Nothing sees or drives between cells that touch at a corner, so no ray leaves. Returns how many.
    """
    grid = grid.pad(1)
    edge = ndimage.binary_dilation(grid.labels == FREE, EIGHT) & (grid.labels == UNKNOWN)
    labels = grid.labels.copy()
    labels[edge] = OBSTACLE
    return replace(grid, labels=labels), int(edge.sum())


def keep_component(grid: Grid, component) -> tuple[Grid, int, int]:
    """One 4-connected piece of free space, "largest" or the one nearest to (x, y) [m]; the rest is unknown.

    Returns the grid, how many pieces there were, and how many free cells were dropped.
    """
    pieces, count = ndimage.label(grid.labels == FREE)
    if count == 0:
        return grid, 0, 0
    if isinstance(component, str):
        sizes = np.bincount(pieces.ravel())
        chosen = int(sizes[1:].argmax()) + 1
    else:
        cells = np.argwhere(pieces > 0)
        away = np.square(cells + 0.5 - grid.to_index(np.array(component))).sum(axis=1)
        chosen = int(pieces[tuple(cells[away.argmin()])])
    dropped = (pieces > 0) & (pieces != chosen)
    labels = grid.labels.copy()
    labels[dropped] = UNKNOWN
    return replace(grid, labels=labels), count, int(dropped.sum())


def drivable(grid: Grid, clearance: float) -> np.ndarray:
    """Places at half-cell steps where a robot's centre keeps `clearance` [m]; bool [2 nx + 1, 2 ny + 1].

    Place (i, j) lies at index (i / 2, j / 2): centres of cells at odd places. Every cell that is not free counts
    as an obstacle, and between cells a place is open only where all cells that touch it are free.
    """
    free = grid.labels == FREE
    fine = np.ones([2 * n + 1 for n in free.shape], dtype=bool)
    fine[1::2, 1::2] = free
    distance = ndimage.distance_transform_edt(fine) if not free.all() else np.full(fine.shape, np.inf)
    open_x = np.pad(free, ((1, 1), (0, 0)))
    open_x = open_x[1:] & open_x[:-1]  # edges between neighbours along x, [nx + 1, ny]
    open_y = np.pad(free, ((0, 0), (1, 1)))
    open_y = open_y[:, 1:] & open_y[:, :-1]
    corner = np.pad(open_x, ((0, 0), (1, 1)))
    inside = np.zeros_like(fine)
    inside[1::2, 1::2] = free
    inside[0::2, 1::2] = open_x
    inside[1::2, 0::2] = open_y
    inside[0::2, 0::2] = corner[:, 1:] & corner[:, :-1]
    return inside & (distance * (grid.cell / 2) >= clearance * (1 - 1e-6))


def close_gaps(grid: Grid, clearance: float, component) -> tuple[Grid, int]:
    """Drops free space behind gaps that a robot of `clearance` [m] cannot pass, so that nothing is out of reach.

    The drivable places fall into pieces; every free cell belongs to the piece it is nearest to along free cells.
    Cells of the other pieces become unknown, all cells where no robot finds room. Returns the grid and how many cells
    were dropped.
    """
    pieces, count = ndimage.label(drivable(grid, clearance))
    free = grid.labels == FREE
    owner = _piece_of_cells(pieces, free)
    reached = owner > 0
    if not reached.any():
        chosen = -1
    elif isinstance(component, str):
        chosen = int(np.bincount(owner[reached]).argmax())
    else:
        cells = np.argwhere(reached)
        away = np.square(cells + 0.5 - grid.to_index(np.array(component))).sum(axis=1)
        chosen = int(owner[tuple(cells[away.argmin()])])
    dropped = free & (owner != chosen)
    labels = grid.labels.copy()
    labels[dropped] = UNKNOWN
    return replace(grid, labels=labels), int(dropped.sum())


def _piece_of_cells(pieces: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Spreads the drivable pieces, at half-cell places, over the free cells around them; 0 where none reaches."""
    owner = np.zeros(free.shape, dtype=pieces.dtype)
    for dx in (0, 1, 2):
        for dy in (0, 1, 2):
            here = pieces[dx : dx + 2 * free.shape[0] : 2, dy : dy + 2 * free.shape[1] : 2]
            owner = np.where((owner == 0) & free, here, owner)
    while True:  # one ring of cells a turn: as many turns as the deepest nook is cells deep
        spread = ndimage.grey_dilation(owner, footprint=ndimage.generate_binary_structure(2, 1))
        rim = free & (owner == 0) & (spread > 0)
        if not rim.any():
            return owner
        owner[rim] = spread[rim]


def thin_walls(grid: Grid, depth: int) -> tuple[Grid, int]:
    """Keeps the obstacle cells within `depth` cells of free space; returns how many were dropped."""
    near = ndimage.binary_dilation(grid.labels == FREE, EIGHT, iterations=depth)
    hidden = (grid.labels == OBSTACLE) & ~near
    labels = grid.labels.copy()
    labels[hidden] = UNKNOWN
    return replace(grid, labels=labels), int(hidden.sum())
