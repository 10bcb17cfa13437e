"""Grids of many small cells in larger ones: what a plan takes grows with the cells."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import label

from maexp.kernels.constants import FREE, MARGIN_CELLS, OBSTACLE

from .grid import KnownGrid
from .ways import gap_squares

MANY_CELLS = 250_000  # a grid of more is planned on in coarser cells
CELLS_PER_RADIUS = 2.0  # of the smallest robot, at least
CORNERS = np.ones((3, 3), bool)  # cells that touch at a corner are connected


def coarsen(grid: KnownGrid, radius: float, many: int | None = None) -> KnownGrid:
    """A grid of ``many`` cells (`MANY_CELLS`) in blocks of 3 x 3, 5 x 5, ... cells: as few as needed, as large as
    robots of ``radius`` [m] allow, so that no passage closes that they fit through. Others as they are.

    A block with an obstacle in any of its cells is one, otherwise it is what its middle cell is: so goals and ways lie
    where the fine grid is known to be free. Blocks are counted from the map frame's origin: the same ones as the grid
    grows.
    """
    largest, side, many = radius / (CELLS_PER_RADIUS * grid.cell), 1, many or MANY_CELLS
    while grid.known.size > many * side**2 and side + 2 <= largest:
        side += 2
    parts = None if side == 1 else _parts(grid, radius)
    while side > 1:
        coarse, middle = _join(grid, side, parts)
        if not _splits(coarse, middle, radius):
            return coarse
        side -= 2
    return grid


def _join(grid: KnownGrid, side: int, parts: np.ndarray) -> tuple[KnownGrid, np.ndarray]:
    """The grid in blocks of ``side`` x ``side`` cells, and ``parts`` in the middle of each."""
    c, s = math.cos(grid.yaw), math.sin(grid.yaw)
    along = np.array(grid.corner) @ np.array([[c, -s], [s, c]]) / grid.cell  # the corner on the grid's own axes
    low = np.rint(along).astype(np.int64) % side
    (left, below), (right, above) = low, -(low + (grid.width, grid.height)) % side

    def blocks(cells: np.ndarray) -> np.ndarray:
        padded = np.pad(cells, ((below, above), (left, right)), mode="edge")
        return padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side)

    solid = (blocks(grid.known == OBSTACLE)).any((1, 3))
    known, inside = (blocks(layer)[:, side // 2, :, side // 2] for layer in (grid.known, parts))
    x, y = grid.to_map(-low * grid.cell)
    known = np.where(solid, np.uint8(OBSTACLE), known)
    return KnownGrid(known, grid.cell * side, (float(x), float(y)), grid.yaw), inside


def _parts(grid: KnownGrid, radius: float) -> np.ndarray:
    """Numbers of the connected parts where a robot fits, int [H, W]; 0 elsewhere."""
    fits = (grid.known == FREE) & (gap_squares(grid.known) >= (radius / grid.cell + MARGIN_CELLS) ** 2)
    return label(fits, CORNERS)[0]


def _splits(coarse: KnownGrid, parts: np.ndarray, radius: float) -> bool:
    """Whether what was one part falls apart, or the larger share of one is lost; slivers do not count."""
    now, least = _parts(coarse, radius), math.pi * (2.0 * radius / coarse.cell) ** 2
    before = np.bincount(parts.ravel())
    pairs, cells = np.unique(np.stack([parts, now])[:, (parts > 0) & (now > 0)], axis=1, return_counts=True)
    largest = np.zeros(len(before), np.int64)
    np.maximum.at(largest, pairs[0], cells)
    rest = np.bincount(pairs[0], weights=cells, minlength=len(before)) - largest
    return bool((rest[1:] > least).any() or ((before > least) & (largest == 0))[1:].any())
