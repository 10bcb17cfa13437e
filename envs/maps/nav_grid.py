"""Navigation grids of maps: a cell for every point, and what stands in for cells without one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp
from scipy.ndimage import distance_transform_edt

from maexp.envs.maps.map_batch import MapBank
from maexp.envs.maps.point_cloud import BOUNDARY_REACH, PointCloudMap
from maexp.kernels.constants import block_sides
from maexp.kernels.occupancy_grid import NavGrids


@dataclass(frozen=True)
class NavGrid:
    """Regular grid over a map's extent; cell number = iy * width + ix.

    Attributes:
        origin: lower corner of cell (0, 0) [m]; points of a lattice lie at cell centres.
        cell: edge length [m], the map's resolution.
        width, height: cells along x and y.
        free_cell: int32 [free_count], the cell of every free point.
        boundary_cell: int32 [boundary_count], the cell of every boundary point.
        stand_in: int32 [width * height], the cell whose state a cell takes: itself where it holds points, the
            nearest cell that does where one is within the spacing of its points, else -1 (solid, outside).
    """

    origin: tuple[float, float]
    cell: float
    width: int
    height: int
    free_cell: np.ndarray
    boundary_cell: np.ndarray
    stand_in: np.ndarray

    def reorder(self, free_order: np.ndarray, boundary_order: np.ndarray) -> NavGrid:
        """The grid for points taken in another order (a bank sorts them): new point k is old `order[k]`."""
        return replace(self, free_cell=self.free_cell[free_order], boundary_cell=self.boundary_cell[boundary_order])


def grid_shape(map: PointCloudMap) -> tuple[int, int]:
    """Cells of a map's navigation grid along x and y."""
    (xmin, ymin), (xmax, ymax) = map.extent
    width, height = (int(np.floor(side / map.resolution + 0.5)) + 1 for side in (xmax - xmin, ymax - ymin))
    return width, height


def build_nav_grid(map: PointCloudMap) -> NavGrid:
    """The navigation grid of a map: cells as large as its resolution, the extent's corner at a cell centre."""
    cell = float(map.resolution)
    origin = np.array(map.extent[0]) - 0.5 * cell
    width, height = grid_shape(map)

    def cell_of(points: np.ndarray) -> np.ndarray:
        index = np.floor((points[:, :2].astype(np.float64) - origin) / cell).astype(np.int64)
        index = np.clip(index, 0, [width - 1, height - 1])
        return (index[:, 1] * width + index[:, 0]).astype(np.int32)

    free_cell, boundary_cell = cell_of(map.free), cell_of(map.boundary)
    spacing = np.zeros(width * height)
    np.maximum.at(spacing, free_cell, map.free_spacing)
    np.maximum.at(spacing, boundary_cell, map.boundary_spacing)
    empty = (spacing == 0).reshape(height, width)
    gap, nearest = distance_transform_edt(empty, return_indices=True)
    nearest = (nearest[0] * width + nearest[1]).reshape(-1)
    in_reach = gap.reshape(-1) * cell <= BOUNDARY_REACH * spacing[nearest]
    return NavGrid(
        origin=(float(origin[0]), float(origin[1])),
        cell=cell,
        width=width,
        height=height,
        free_cell=free_cell,
        boundary_cell=boundary_cell,
        stand_in=np.where(in_reach, nearest, -1).astype(np.int32),
    )


def open_cells(grid: NavGrid) -> np.ndarray:
    """Cells that a map leaves free, bool [width * height]: neither a boundary point's nor outside."""
    free = np.zeros(len(grid.stand_in), dtype=bool)
    free[grid.free_cell] = True
    free[grid.boundary_cell] = False
    return free[grid.stand_in] & (grid.stand_in >= 0)


def stands_free(map: PointCloudMap, place: tuple[float, float]) -> bool:
    """Whether a place [m] lies on free ground."""
    grid = build_nav_grid(map)
    x, y = np.floor((np.array(place) - grid.origin) / grid.cell)
    inside = 0 <= x < grid.width and 0 <= y < grid.height
    return bool(inside and open_cells(grid)[int(y) * grid.width + int(x)])


def stack_nav_grids(grids: list[NavGrid], device: str = "cpu") -> tuple[NavGrids, int]:
    """Device arrays over several maps, and the cells of the largest (points in the order of `Maps`)."""
    begin = np.cumsum([0] + [len(g.stand_in) for g in grids])
    values = {
        "origin": (np.array([g.origin for g in grids], np.float32), wp.vec2),
        "cell": (np.array([g.cell for g in grids], np.float32), wp.float32),
        "width": (np.array([g.width for g in grids], np.int32), wp.int32),
        "height": (np.array([g.height for g in grids], np.int32), wp.int32),
        "free_cell": (np.concatenate([g.free_cell for g in grids]), wp.int32),
        "boundary_cell": (np.concatenate([g.boundary_cell for g in grids]), wp.int32),
        "cell_begin": (begin.astype(np.int32), wp.int32),
        "stand_in": (np.concatenate([g.stand_in for g in grids]), wp.int32),
    }
    counts, voids = zip(*(list_voids(g.stand_in) for g in grids), strict=True)
    values["void_begin"] = (np.cumsum([0, *np.concatenate(counts)]).astype(np.int32), wp.int32)
    values["voids"] = (np.concatenate(voids), wp.int32)
    stacked = NavGrids()
    for name, (array, kind) in values.items():
        setattr(stacked, name, wp.array(array, dtype=kind, device=str(torch.device(device))))
    return stacked, int(np.diff(begin).max())


def list_voids(stand_in: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many other cells take the state of each cell, and those cells, in the order of whose state they take."""
    voids = np.flatnonzero((stand_in >= 0) & (stand_in != np.arange(len(stand_in))))
    voids = voids[np.argsort(stand_in[voids], kind="stable")]
    return np.bincount(stand_in[voids], minlength=len(stand_in)), voids.astype(np.int32)


def bank_block_sides(bank: MapBank, reach: float) -> np.ndarray:
    """Edges of the blocks of frontier cells on each map of a bank, int32 [M], in cells, for a radar's reach [m]."""
    if bank.block_sides is not None:
        return bank.block_sides
    width, height = np.array([grid_shape(world) for world in bank.maps]).T
    return block_sides(np.array([world.resolution for world in bank.maps]), reach, width, height)


def bank_nav_grids(bank: MapBank, device: str = "cpu") -> tuple[NavGrids, int]:
    """`stack_nav_grids` for the maps of a bank, points in the bank's order."""
    if bank.grids is not None:
        return bank.grids
    orders = zip(bank.maps, bank.order_free, bank.order_boundary, strict=True)
    return stack_nav_grids([build_nav_grid(m).reorder(free, boundary) for m, free, boundary in orders], device)
