"""What the team knows, read from an occupancy grid as ROS has it: unknown, free or obstacle by cell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maexp.envs.grid_values import read_ones
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN

MAX_CELLS = 36_000_000


@dataclass(frozen=True)
class KnownGrid:
    """Cells in rows along y; cell number = iy * width + ix.

    Points "on the grid" are measured from its lower left corner along its own axes [m].

    Attributes:
        known: uint8 [H, W], `UNKNOWN`, `FREE` or `OBSTACLE`.
        cell: edge length [m].
        corner: lower left corner in the map's frame [m].
        yaw: the grid's turn in the map's frame [rad].
    """

    known: np.ndarray
    cell: float
    corner: tuple[float, float]
    yaw: float = 0.0

    @property
    def height(self) -> int:
        """Cells along y."""
        return self.known.shape[0]

    @property
    def width(self) -> int:
        """Cells along x."""
        return self.known.shape[1]

    def from_map(self, points: ArrayLike) -> np.ndarray:
        """Points of the map's frame on the grid, [..., 2] [m]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return (np.asarray(points, np.float64) - self.corner) @ np.array([[c, -s], [s, c]])

    def to_map(self, points: ArrayLike) -> np.ndarray:
        """Points on the grid in the map's frame, [..., 2] [m]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.asarray(points, np.float64) @ np.array([[c, s], [-s, c]]) + self.corner

    def centers(self, cells: np.ndarray) -> np.ndarray:
        """Middles of cells on the grid, float64 [..., 2] [m]."""
        cells = np.asarray(cells)
        return (np.stack([cells % self.width, cells // self.width], axis=-1) + 0.5) * self.cell

    def cells(self, points: np.ndarray) -> np.ndarray:
        """Cells of points on the grid, int64 [...]; -1 outside of it and for NaN."""
        index = np.floor(np.asarray(points) / self.cell)
        inside = np.all((index >= 0) & (index < (self.width, self.height)), axis=-1)
        index = np.where(inside[..., None], index, 0).astype(np.int64)
        return np.where(inside, index[..., 1] * self.width + index[..., 0], -1)


def read_grid(grid, resolution, origin, occupied: float, notes: list[str]) -> KnownGrid:
    """The grid of one call.

    Args:
        grid: [H, W] of numbers, `grid[row = y, column = x]`: -1 unknown, 0 (free) to 100 (occupied); masked cells of
            a masked array are unknown. Where no cell holds more than 1, 1 is occupied.
        resolution: edge of a cell [m].
        origin: x, y [m] and, if given, yaw [rad] of the lower left corner.
        occupied: from this value on a cell is an obstacle.
        notes: what was taken otherwise than it stands there is added in a sentence.

    Raises:
        ValueError: what was given cannot be an occupancy grid.
    """
    values, cell, (x, y, yaw) = check_grid(grid, resolution, origin, notes)
    valid = (values >= 0) & (values <= 100)
    odd = int(np.count_nonzero(~valid & (values != (255 if values.dtype.kind == "u" else -1))))
    if odd:
        notes.append(f"grid: {odd} cells hold neither -1 nor 0 to 100 and were taken as unknown")
    known = np.where(values >= occupied, np.uint8(OBSTACLE), np.uint8(FREE))
    known[~valid] = UNKNOWN
    return KnownGrid(known, cell, (x, y), yaw)


def check_grid(
    grid, resolution, origin, notes: list[str] | None = None, name: str = "grid"
) -> tuple[np.ndarray, float, tuple[float, float, float]]:
    """The values of an occupancy grid, the edge of its cells [m], and x, y [m] and yaw [rad] of its lower left corner.

    Args:
        grid, resolution, origin, notes: of `read_grid`.
        name: what notes call the grid.

    Raises:
        ValueError: as `read_grid`.
    """
    values = read_ones(_check_values(grid), [] if notes is None else notes, name)
    cell = _number(resolution)
    if not (cell is not None and 1e-4 <= cell <= 1e3):
        raise ValueError(f"resolution={resolution!r} must be the edge of a cell in metres, 0.0001 to 1000")
    return values, cell, _check_origin(origin)


def is_planned_on(width: float, height: float, reach: float) -> bool:
    """Whether a grid is small enough.

    Args:
        width, height: of the grid [cells].
        reach: how far around it robots look [cells].
    """
    around = (width + 2.0 * reach) * (height + 2.0 * reach)
    return width * height <= MAX_CELLS and around <= 2 * MAX_CELLS


def _check_values(grid) -> np.ndarray:
    advice = "give numbers [rows along y, columns along x], as np.reshape(msg.data, (height, width))"
    try:
        values = fill_masked(grid)
    except ValueError:  # rows of different lengths
        raise ValueError(f"grid has rows of different lengths: {advice}") from None
    if values.dtype.kind not in "iuf":
        raise ValueError(f"grid is a {type(grid).__name__} of {values.dtype}: {advice}")
    if values.ndim != 2:
        raise ValueError(f"grid has {values.ndim} axes: {advice}")
    if values.size > MAX_CELLS:
        raise ValueError(f"grid has {values.size:,} cells, and at most {MAX_CELLS:,} are planned on: make cells larger")
    if values.dtype.kind == "f" and ((values > 0) & (values < 1)).any() and not ((values > 1) & (values <= 100)).any():
        raise ValueError("grid holds shares between 0 and 1: multiply them by 100, unknown cells stay -1")
    return values


def fill_masked(grid) -> np.ndarray:
    """An array, with -1 in the masked cells of a masked one."""
    if not isinstance(grid, np.ma.MaskedArray) or grid.dtype.kind not in "iuf":
        return np.asarray(grid)
    return np.ma.filled(grid.astype(np.int64) if grid.dtype.kind == "u" else grid, -1)


def _check_origin(origin) -> tuple[float, float, float]:
    numbers = [_number(coordinate) for coordinate in _listed(origin)]
    known = [number for number in numbers if number is not None]
    if len(known) != len(numbers) or len(known) not in (2, 3) or max(map(abs, known)) > 1e8:
        raise ValueError(f"origin={origin!r} must be x, y [m] and at most a yaw [rad] of the lower left corner")
    x, y, yaw = [*known, 0.0][:3]
    return x, y, yaw


def _listed(value) -> list:
    try:
        return list(value)
    except TypeError:
        return []


def _number(value) -> float | None:
    """A finite number, else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None
