"""The floor as cells: what ir-sim builds its walls from, and where people walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from maexp.envs import PointCloudMap


@dataclass(frozen=True)
class FloorCells:
    """Free cells of a map, one a point of it.

    Attributes:
        free: bool [nx, ny]; a margin of one cell around is not.
        cell: side of a cell [m].
        low: outer corner of cell (0, 0) [m].
    """

    free: np.ndarray
    cell: float
    low: np.ndarray

    def centre(self, index: np.ndarray) -> np.ndarray:
        """Places [m] of cells, both [..., 2]."""
        return self.low + (np.asarray(index) + 0.5) * self.cell

    def index(self, places: np.ndarray) -> np.ndarray:
        """Cells of places [m], both [..., 2]; those outside count as the edge."""
        index = np.floor((np.asarray(places) - self.low) / self.cell).astype(int)
        return index.clip(0, np.array(self.free.shape) - 1)

    def roomy(self, radius: float) -> np.ndarray:
        """Cells whose centre lies at least `radius` [m] from all walls; bool [nx, ny]."""
        return (ndimage.distance_transform_edt(self.free) - 0.5) * self.cell >= radius


def make_floor(world: PointCloudMap) -> FloorCells:
    """The cells of a map on a lattice, as imported floors are."""
    cell, points = world.resolution, world.free[:, :2].astype(np.float64)
    if np.ptp(world.free_spacing):
        raise ValueError(f"map {world.name} has points of different spacing: import it anew, or take a floor plan")
    low = points.min(axis=0) - 1.5 * cell
    index = np.floor((points - low) / cell + 1e-4).astype(int)
    free = np.zeros(index.max(axis=0) + 2, dtype=bool)
    free[index[:, 0], index[:, 1]] = True
    if free.sum() < 0.99 * len(points):
        raise ValueError(f"the points of map {world.name} stand on no lattice along x and y: import it unturned")
    return FloorCells(free, cell, low)
