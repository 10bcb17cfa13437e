"""Airborne scans: local ground, what stands on it, and the tile with most open ground."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from maexp.envs.io.grid import FREE, OBSTACLE, UNKNOWN, Grid
from maexp.envs.io.sources import cell_index, count_points, fill_holes, grid_shape
from maexp.envs.maps.point_cloud import MapError

GROUND_CELL = 2.0  # [m]; cells of the ground model
WINDOWS = (3, 5, 9, 17, 33, 65)  # cells; the widest is wider than a city block is deep
SLOPE = 0.12  # terrain steeper than this over a window is taken for a building
GROUND_CELLS = 8_000_000  # of the ground model
SPARSE = 50  # cells of the ground model a point, on average; the ground between is made up
PIT = 2.0  # [m]; lone cells this much lower than those around them are false returns


class TerrainSource:
    """Points over terrain: a cell is free where all its points lie near the local ground.

    Args:
        points: [m], float64 [count, 3].
        low, high: what stands `low` to `high` [m] above the ground is an obstacle. Where `high` is infinite nothing
            is passed under: seen from above, what is below a roof or a crown is not known.
        finest: smallest useful cell [m].
        holes: gaps of the ground up to this many cells across are filled.
    """

    def __init__(self, points: np.ndarray, low: float, high: float, finest: float, *, holes: int = 2):
        self.points = points
        self.above = points[:, 2] - _ground_below(points)
        self.low, self.high = low, high
        self.finest = finest
        self.holes = holes

    def at(self, cell: float) -> Grid:
        places = self.points[:, :2]
        start = places.min(axis=0)
        shape = grid_shape(start, places.max(axis=0), cell)
        standing = (self.above > self.low) & (self.above <= self.high)
        walls = count_points(places[standing], start, cell, shape) > 0
        ground = count_points(places[np.abs(self.above) <= self.low], start, cell, shape) > 0
        roofed = (count_points(places[self.above > self.high], start, cell, shape) > 0) & ~ground
        walls |= roofed
        free = fill_holes(ground & ~walls, self.holes) & ~walls
        labels = np.where(walls, OBSTACLE, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
        return Grid(labels, cell, tuple(start.tolist()), height=self._heights(start, cell, shape))

    def tile(self, side: float) -> TerrainSource:
        """The square of `side` [m] that holds most of the largest free region; `self` where the scan is no larger."""
        grid = self.at(max(self.finest, GROUND_CELL))
        if max(grid.labels.shape) * grid.cell <= side:
            return self
        width = np.minimum(int(side / grid.cell), grid.labels.shape)
        pieces, _ = ndimage.label(grid.labels == FREE)
        largest = pieces == np.bincount(pieces.ravel())[1:].argmax() + 1 if pieces.any() else pieces > 0
        total = np.pad(largest.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        a, b = width
        inside = total[a:, b:] - total[:-a, b:] - total[a:, :-b] + total[:-a, :-b]
        corner = np.array(np.unravel_index(int(inside.argmax()), inside.shape)) * grid.cell + np.asarray(grid.origin)
        places = self.points[:, :2]
        return self.keep(((places >= corner) & (places < corner + side)).all(axis=1))

    def keep(self, kept: np.ndarray) -> TerrainSource:
        """The same terrain with some of its points, bool [count]; the ground stays as it was found."""
        part = object.__new__(TerrainSource)
        part.__dict__.update(self.__dict__, points=self.points[kept], above=self.above[kept])
        return part

    def _heights(self, start, cell: float, shape) -> np.ndarray:
        """Highest point of each cell above the lowest ground [m]; the nearest cell's where there is none."""
        top = np.full(shape, -np.inf, dtype=np.float32)
        lowest = (self.points[:, 2] - self.above).min()
        index = cell_index(self.points[:, :2], start, cell, shape)
        np.maximum.at(top, index, (self.points[:, 2] - lowest).astype(np.float32))
        return _spread(top, np.isfinite(top))


def _ground_below(points: np.ndarray) -> np.ndarray:
    """Height of the ground under each point [m]: a progressive morphological filter (Zhang et al. 2003).

    Opening the surface with ever wider windows removes first cars and trees, then houses, then blocks; a cell is
    kept as ground while it drops less than the terrain's slope allows.
    """
    places = points[:, :2]
    start = places.min(axis=0)
    shape = grid_shape(start, places.max(axis=0), GROUND_CELL)
    cells = shape[0] * shape[1]
    if cells > GROUND_CELLS or cells > SPARSE * len(points):
        found = f"{len(points):,} points lie on {shape[0] * GROUND_CELL:,.0f} x {shape[1] * GROUND_CELL:,.0f} m"
        raise MapError(f"{found}, too wide or too sparse for a terrain: check units, or cut the file")
    index = cell_index(places, start, GROUND_CELL, shape)
    surface = np.full(shape, np.inf)
    np.minimum.at(surface, index, points[:, 2])
    known = np.isfinite(surface)
    surface = _spread(surface, known)
    around = ndimage.median_filter(surface, 5)
    surface = np.where(surface < around - PIT, around, surface)
    ground = known.copy()
    opened = surface
    for window in WINDOWS:
        if window > max(shape):
            break
        lower = ndimage.grey_opening(opened, (window, window), mode="nearest")
        ground &= opened - lower <= 0.3 + SLOPE * (window // 2) * GROUND_CELL
        opened = lower
    if not ground.any():
        ground = known
    terrain = ndimage.gaussian_filter(_spread(surface, ground), 1.0, mode="nearest")
    at = ((places - start) / GROUND_CELL - 0.5).T
    return ndimage.map_coordinates(terrain, at, order=1, mode="nearest")


def _spread(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Every cell that is not known takes the value of the nearest one that is."""
    if known.all():
        return values
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]
