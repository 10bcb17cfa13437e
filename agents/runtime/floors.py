"""Floors to try the runtime on: rooms with doors, or a real one from a file of ROS's map_server."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, label

WALL, FREE = 100, 0
NEAR = 1.0  # a team begins so near to where it was told to, or within four of its robots' radii [m]


def make_floor(cells: int, room: int = 80, door: int = 10) -> np.ndarray:
    """A square floor of rooms with doors, int8 [cells, cells] as ROS has it: 0 free, 100 wall."""
    grid = np.zeros((cells, cells), np.int8)
    walls = np.append(np.arange(0, cells - 1, room), cells - 1)
    grid[walls], grid[:, walls] = WALL, WALL
    for middle in range(room // 2, cells, room):
        for wall in walls[1:-1]:
            grid[middle : middle + door, wall] = FREE
            grid[wall, middle : middle + door] = FREE
    return grid


def read_floor(path: str | Path, cell: float) -> tuple[np.ndarray, float]:
    """The largest room that hangs together of a map_server yaml, on cells of at least so many metres.

    Returns:
        int8 [H, W], row = y: 0 free, all else a wall (100); and the edge of a cell [m].

    Raises:
        ValueError: the file is no such map, or PyYAML and Pillow, which read it, are not installed.
    """
    try:
        from maexp.envs.importing.grid import FREE as OPEN  # late: robots have neither PyYAML nor Pillow
        from maexp.envs.importing.import_report import ImportReport
        from maexp.envs.importing.occupancy import read_occupancy
        from maexp.envs.importing.options import ImportOptions
    except ImportError as error:
        raise ValueError(f"{path} is read with PyYAML and Pillow: pip install pyyaml pillow ({error})") from None
    grid = read_occupancy(Path(path), ImportOptions(), ImportReport(str(path)))
    free = (grid.labels == OPEN).T
    times = max(1, round(cell / grid.cell))
    free = free[: len(free) // times * times, : free.shape[1] // times * times]
    free = free.reshape(len(free) // times, times, -1, times).all((1, 3))
    parts, _ = label(free)
    largest = parts == np.bincount(parts[free]).argmax()
    y, x = np.nonzero(largest)
    part = np.pad(largest[y.min() : y.max() + 1, x.min() : x.max() + 1], 1)
    return np.where(part, FREE, WALL).astype(np.int8), grid.cell * times


def place_team(grid: np.ndarray, cell: float, radius: float, count: int, first) -> np.ndarray:
    """Robots beside each other, as a team begins: float64 [count, 2] [m].

    Args:
        grid: of `make_floor`.
        cell: its edge [m].
        radius: of the robots [m].
        count: how many.
        first: x, y [m] that the robots stand nearest to, or a `numpy.random.Generator` that draws a place.

    Raises:
        ValueError: there is no room, or none near `first`.
    """
    open_ = distance_transform_edt(grid == FREE) * cell > radius + cell
    y, x = np.nonzero(open_)
    room = (np.stack([x, y], -1) + 0.5) * cell
    if not len(room):
        raise ValueError(f"no robot of robot_radius={radius:g} m has room on this floor")
    if isinstance(first, np.random.Generator):
        first = room[first.integers(len(room))]
    parts, _ = label(open_)
    away = np.linalg.norm(room - first, axis=-1)
    home = away.argmin()
    if not away[home] <= max(NEAR, 4.0 * radius):
        raise ValueError(
            f"start={first[0]:g} {first[1]:g} is no place for a robot of {radius:g} m, nor is any near it: "
            f"the nearest is {room[home][0]:.1f} {room[home][1]:.1f}"
        )
    room = room[parts[y, x] == parts[y[home], x[home]]]
    room = room[np.linalg.norm(room - first, axis=-1).argsort(kind="stable")]
    places: list[np.ndarray] = []
    while len(room) and len(places) < count:
        places.append(room[0])
        room = room[np.linalg.norm(room - room[0], axis=-1) >= 2.5 * radius]
    if len(places) < count:
        raise ValueError(f"robots={count} of {radius:g} m have no room here: {len(places)} do")
    return np.array(places)
