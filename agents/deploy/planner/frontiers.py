"""Frontiers, the targets they are gathered in and what can be seen from there: `maexp.kernels.targets` and `outlook`.

A frontier cell is a free one that shares an edge with an unknown one. Frontier cells are gathered in square blocks,
each with one cell to go to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.kernels.constants import FREE, OBSTACLE, RAYS, UNKNOWN

LOOKED_AT_ONCE = 4_000_000  # cells of rays in one go: bounds the memory
STRIDE = 1 << 20  # more blocks than a row has
WALL, UNSEEN = 1, 2  # bits of a cell: obstacle, unknown; then a bit for each way to come diagonally between two walls
CORNERS = {(1, 1): 4, (-1, 1): 8, (-1, -1): 16, (1, -1): 32}


@dataclass(frozen=True)
class Targets:
    """K targets.

    Attributes:
        block: int64 [K, 2], bx, by: stays the same while the grid grows or shifts by whole cells.
        cell: int64 [K], the cell to go to.
        size: int64 [K], frontier cells of the block.
        side: of a block, in cells.
        shift: the grid's corner, in cells from where blocks are counted.
    """

    block: np.ndarray
    cell: np.ndarray
    size: np.ndarray
    side: int
    shift: tuple[int, int]

    def select(self, kept: np.ndarray) -> Targets:
        """Those of `kept`, bool [K]."""
        return replace(self, block=self.block[kept], cell=self.cell[kept], size=self.size[kept])

    def keys(self) -> list[tuple[int, int]]:
        """The blocks as plain numbers."""
        return [(x, y) for x, y in self.block.tolist()]

    def block_of(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The blocks that cells lie in, int64 [..., 2]."""
        return np.stack([x + self.shift[0], y + self.shift[1]], axis=-1) // self.side


def mark_frontier(known: np.ndarray, bounded: bool) -> np.ndarray:
    """Frontier cells, bool [H, W].

    Args:
        bounded: nothing lies beyond the grid's edge; else the unknown does.
    """
    unknown = np.pad(known == UNKNOWN, 1, constant_values=not bounded)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    return (known == FREE) & beside


def list_targets(frontier: np.ndarray, reached: np.ndarray, side: int, search: int, shift: tuple[int, int]) -> Targets:
    """The reached cell nearest to the middle of each block's frontier cells, in the block or close to it.

    Args:
        frontier, reached: bool [H, W].
        side: of a block, in cells.
        search: how far outside its block a target may lie, in cells.
        shift: the grid's corner, in cells from where blocks are counted.
    """
    y, x = np.nonzero(frontier)
    across = (np.stack([x, y], axis=1) + shift) // side
    lower = across.min(0, initial=0)
    key = (across - lower) @ (1, STRIDE)  # row by row, as the kernels number them
    key, which = np.unique(key, return_inverse=True)
    block = np.stack([key % STRIDE, key // STRIDE], axis=1) + lower
    size = np.bincount(which, minlength=len(block))
    total = np.stack([np.bincount(which, coordinates, len(block)) for coordinates in (x, y)], axis=1).astype(np.int64)
    cell = _nearest_reached(reached, block * side - shift, size, total, side, search)
    found = cell >= 0
    return Targets(block[found], cell[found], size[found], side, shift)


def _nearest_reached(reached, lower, size, total, side: int, search: int) -> np.ndarray:
    """Of each block with its lower corner at `lower` the reached cell nearest to `total / size`, -1 = none."""
    height, width = reached.shape
    margin = side + search
    wide = np.pad(reached, margin)
    span = np.arange(-search, side + search)
    result = np.full(len(lower), -1)
    batch = max(1, LOOKED_AT_ONCE // len(span) ** 2)
    for first in range(0, len(lower), batch):
        part = slice(first, first + batch)
        x, y = (lower[part, k, None] + span for k in (0, 1))
        open = wide[(y + margin)[:, :, None], (x + margin)[:, None, :]]
        # Compared after scaling by `size`, which keeps the mean in integers.
        gap_x, gap_y = ((v * size[part, None] - total[part, k, None]) ** 2 for k, v in enumerate((x, y)))
        gap = np.where(open, gap_y[:, :, None] + gap_x[:, None, :], np.iinfo(np.int64).max).reshape(len(x), -1)
        best = gap.argmin(1)
        row = np.arange(len(best))
        cell = y[row, best // len(span)] * width + x[row, best % len(span)]
        result[part] = np.where(open.reshape(len(x), -1)[row, best], cell, -1)
    return result


def look_around(grid: KnownGrid, cells: np.ndarray, radius: float, bounded: bool) -> tuple[np.ndarray, np.ndarray]:
    """What could be seen for the first time from cells, within ``radius`` [m] and in front of known walls.

    Returns:
        float32 [K], unknown cells; float32 [K, 2], their middle, from the cell [m].
    """
    reach = int(np.float32(radius) / np.float32(grid.cell))
    width = grid.width + 2 * reach
    index, need, value = _rays(reach, width)
    image = _sight_image(grid.known, reach, bounded).ravel()
    start = (cells // grid.width + reach) * width + cells % grid.width + reach
    seen = np.zeros((len(cells), 3))
    batch = max(1, LOOKED_AT_ONCE // max(1, index.size))
    for first in range(0, len(cells), batch):
        state = image[start[first : first + batch, None, None] + index]
        hidden = np.logical_or.accumulate((state & need) != 0, axis=2)
        shown = ((state & UNSEEN) != 0) & ~hidden
        seen[first : first + batch] = shown.reshape(len(shown), -1).astype(np.float32) @ value
    middle = seen[:, 1:] * (grid.cell / np.maximum(seen[:, :1], 1e-6))
    return seen[:, 0].astype(np.float32), middle.astype(np.float32)


def _rays(reach: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells of `RAYS` rays from their start, int64 [R, S]; the bits that end them there, uint8 [R, S]; and what a
    cell stands for: its share of the circle, and that times its place in cells, float32 [R * S, 3]."""
    angle = (np.arange(RAYS, dtype=np.float32) + np.float32(0.5)) * np.float32(2.0 * math.pi / RAYS)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    step = np.arange(1, reach + 1, dtype=np.float32)[:, None]
    at = np.floor(step * unit + np.float32(0.5)).astype(np.int64)
    moved = np.diff(at, axis=1, prepend=0)
    need = np.full(at.shape[:2], WALL, np.uint8)
    for (u, v), bit in CORNERS.items():
        need[(moved == (u, v)).all(-1)] |= bit
    part = step[:, 0] * np.float32(2.0 * math.pi / RAYS)
    value = np.stack(np.broadcast_arrays(part, unit[..., 0] * part * step[:, 0], unit[..., 1] * part * step[:, 0]), -1)
    return at[..., 1] * width + at[..., 0], need, value.reshape(-1, 3)


def _sight_image(known: np.ndarray, reach: int, bounded: bool) -> np.ndarray:
    """Bits of every cell, uint8 [H + 2 reach, W + 2 reach], for rays that leave the grid too."""
    wide = np.pad(known, reach, constant_values=OBSTACLE if bounded else UNKNOWN)
    wall = wide == OBSTACLE
    image = wall * np.uint8(WALL) | (wide == UNKNOWN) * np.uint8(UNSEEN)
    ring = np.pad(wall, 1)
    middle = slice(1, -1)
    for (u, v), bit in CORNERS.items():  # coming by (u, v): the cells beside are those back along x and along y
        back_x, back_y = ring[middle, 1 - u : ring.shape[1] - 1 - u], ring[1 - v : ring.shape[0] - 1 - v, middle]
        image |= (back_x & back_y) * np.uint8(bit)
    return image
