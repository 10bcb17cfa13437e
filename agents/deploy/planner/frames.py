"""Frames and maps as ROS has them, from messages to arrays; imports nothing of ROS.

Messages are read by the names of their fields, so those of rclpy, of DDS and of recordings do alike.
"""

from __future__ import annotations

import math
from collections.abc import Container, Hashable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.grid import check_grid
from maexp.envs.quaternions import fill_turn, read_yaw

Pose = tuple[float, float, float]
"""x, y [m] and yaw [rad]."""
NOWHERE: Pose = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class OccupancyGrid:
    """An occupancy grid.

    Attributes:
        values: int8 [rows along y, columns along x], -1 unknown, 0 free to 100 occupied.
        resolution: side of a cell [m].
        origin: its lower left corner.
    """

    values: np.ndarray
    resolution: float
    origin: Pose


Maps = Mapping[Hashable, tuple[float, OccupancyGrid]]
"""Robots, the times [s] at which their own maps were so, and these. Only so a robot that was told what one of them has
since cleared, can clear it, too."""


def is_newer(told: tuple, last: tuple | None, itself: bool) -> bool:
    """Whether a robot's map that came, `told`, takes the place of the `last` one; both begin with their times. Of one
    time, the robot `itself` is believed, and what comes by others is the same once more."""
    return last is None or told[0] > last[0] or (itself and told[0] == last[0])


def read_map(message) -> OccupancyGrid:
    """The grid of a nav_msgs/OccupancyGrid.

    Raises:
        ValueError: it has not as many cells as it says, or its origin is none.
    """
    info = message.info
    try:
        values = np.asarray(message.data, dtype=np.int8)
    except (OverflowError, TypeError):
        raise ValueError("its data are not int8, -1 to 100") from None
    if values.size != info.height * info.width:
        raise ValueError(f"a map of {info.width} x {info.height} cells came with {values.size} of them")
    origin = read_pose(info.origin)
    return OccupancyGrid(values.reshape(info.height, info.width), float(f"{info.resolution:.7g}"), origin)


def apply_update(message, update):
    """A nav_msgs/OccupancyGrid with a map_msgs/OccupancyGridUpdate written into it, as a new message.

    Raises:
        ValueError: the update does not lie within the map, or has not as many cells as it says.
    """
    info, cells = message.info, np.asarray(update.data)
    x, y, width, height = update.x, update.y, update.width, update.height
    if not (0 <= x <= x + width <= info.width and 0 <= y <= y + height <= info.height):
        raise ValueError(
            f"an update of {width} x {height} cells at {x}, {y} lies outside of {info.width} x {info.height}"
        )
    if cells.size != width * height:
        raise ValueError(f"an update of {width} x {height} cells came with {cells.size} of them")
    values = read_map(message).values.copy()
    values[y : y + height, x : x + width] = cells.reshape(height, width)
    made = copy(message)
    made.header, made.data = copy(message.header), values.ravel()
    made.header.stamp = update.header.stamp
    return made


def fill_grid(message, frame: str, grid: OccupancyGrid) -> None:
    """Writes a grid of a frame into a nav_msgs/OccupancyGrid; the time is left to the caller."""
    message.header.frame_id, info = frame, message.info
    info.resolution, (info.height, info.width) = float(grid.resolution), grid.values.shape
    fill_pose(info.origin, *grid.origin)
    message.data = grid.values.ravel().tolist()


def read_time(stamp) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return stamp.sec + 1e-9 * stamp.nanosec


def read_pose(pose) -> Pose:
    """Of a geometry_msgs/Pose; NaN where its numbers are beyond all bounds."""
    try:
        return pose.position.x, pose.position.y, read_yaw(pose.orientation)
    except OverflowError:
        return math.nan, math.nan, math.nan


def fill_pose(pose, x: float, y: float, yaw: float) -> None:
    """Writes a place into a geometry_msgs/Pose."""
    pose.position.x, pose.position.y, pose.position.z = float(x), float(y), 0.0
    fill_turn(pose.orientation, yaw)


def compose(pose: Pose, inner: Pose) -> Pose:
    """`inner`, given in a frame that stands at `pose`, in the frame of `pose`."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    return x + c * inner[0] - s * inner[1], y + s * inner[0] + c * inner[1], yaw + inner[2]


def invert(pose: Pose) -> Pose:
    """Where the outer frame stands in the inner one."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    return -c * x - s * y, s * x - c * y, -yaw


class Frames:
    """Where frames stand in their parents, as was told last. There is no interpolation: robots are slow."""

    def __init__(self):
        self.parents: dict[str, tuple[str, Pose, float]] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self.parents

    def take(self, message, still: bool = False) -> None:
        """A tf2_msgs/TFMessage; `still`: it is of /tf_static, whose frames stay where they are."""
        for transform in message.transforms:
            move = transform.transform
            try:
                pose = (move.translation.x, move.translation.y, read_yaw(move.rotation))
            except OverflowError:
                continue
            time = math.inf if still else read_time(transform.header.stamp)
            self.put(transform.child_frame_id, transform.header.frame_id, pose, time)

    def put(self, frame: str, parent: str, pose: Pose, time: float) -> None:
        """Where a frame stands since `time` [s]; names may begin with a slash, as in ROS 1. A pose that is not finite
        changes nothing: the last one counts until it is too old."""
        if all(map(math.isfinite, pose)):
            self.parents[frame.lstrip("/")] = (parent.lstrip("/"), pose, time)

    def forget_later(self, time: float) -> None:
        """Forget the poses of moving frames that claim to be of later than that [s]."""
        self.parents = {frame: told for frame, told in self.parents.items() if told[2] <= time or math.isinf(told[2])}

    def find(self, frame: str, roots: Container[str]) -> tuple[str, Pose, float] | None:
        """The first of `roots` that a frame hangs from, its pose there, and the time of its own message [s]; None: it
        hangs from none. Parents may be older: localisation is silent where a robot stands still."""
        pose, time = NOWHERE, None
        for _ in range(len(self.parents) + 1):
            if frame in roots:
                return frame, pose, math.inf if time is None else time
            if frame not in self.parents:
                return None
            frame, place, told = self.parents[frame]
            pose, time = compose(place, pose), told if time is None else time
        return None


def place_grid(grid: OccupancyGrid, pose: Pose) -> OccupancyGrid:
    """The grid in the frame in which its own frame stands at `pose`."""
    return grid if pose == NOWHERE else OccupancyGrid(grid.values, grid.resolution, compose(pose, grid.origin))


def check_map(grid: Any, notes: list[str] | None = None, name: str = "grid") -> OccupancyGrid:
    """A map that somebody told, as `merge_grids` takes it: as it came, if that can be, else in plain numbers.

    Args:
        grid: what came.
        notes, name: of `check_grid`.

    Raises:
        ValueError: it would be refused as a robot's own grid, too.
    """
    try:
        values, cell, origin = check_grid(grid.values, grid.resolution, grid.origin, notes, name)
    except AttributeError:
        raise ValueError(f"a {type(grid).__name__} is no OccupancyGrid") from None
    plain = isinstance(grid, OccupancyGrid) and grid.values is values and isinstance(grid.origin, tuple | list)
    if plain and len(grid.origin) == 3 and all(isinstance(number, Real) for number in (grid.resolution, *grid.origin)):
        return grid
    return OccupancyGrid(values, cell, origin)


def merge_grids(grids: list[OccupancyGrid]) -> OccupancyGrid:
    """One grid of several in one frame: occupied where any is, free where any is and none occupied.

    It has the finest resolution and lies along the frame's axes. Grids that lie alike, or one alone, stay as they are.
    Of several, cells that hold neither -1 nor 0 to 100 are unknown: an unsigned 255 rubs out no wall.
    """
    first = grids[0]
    if len(grids) > 1:
        grids = [replace(grid, values=_known(grid.values)) for grid in grids]
    alike = (first.resolution, first.origin, first.values.shape)
    if all((grid.resolution, grid.origin, grid.values.shape) == alike for grid in grids):
        return OccupancyGrid(np.maximum.reduce([grid.values for grid in grids]), first.resolution, first.origin)
    cell, low, (columns, rows) = span(grids)
    x, y = np.meshgrid(low[0] + (np.arange(columns) + 0.5) * cell, low[1] + (np.arange(rows) + 0.5) * cell)
    merged = np.full((rows, columns), -1, dtype=np.int8)
    for grid in grids:
        gx, gy, yaw = grid.origin
        c, s = math.cos(yaw), math.sin(yaw)
        column = np.floor((c * (x - gx) + s * (y - gy)) / grid.resolution).astype(int)
        row = np.floor((c * (y - gy) - s * (x - gx)) / grid.resolution).astype(int)
        height, width = grid.values.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        merged[inside] = np.maximum(merged[inside], grid.values[row[inside], column[inside]])
    return OccupancyGrid(merged, cell, (float(low[0]), float(low[1]), 0.0))


def _known(values: np.ndarray) -> np.ndarray:
    """Cells, int8 or float; -1 where they tell nothing."""
    if values.dtype.kind == "f":
        return np.where((values >= 0) & (values <= 100), values, -1.0)
    return np.where((values >= 0) & (values <= 100), values.astype(np.int8), np.int8(-1))


def span(grids: list[OccupancyGrid]) -> tuple[float, np.ndarray, np.ndarray]:
    """What a grid of them all takes: edge of its cells [m], its lower corner [2] [m], columns and rows, int64 [2]."""
    cell = min(grid.resolution for grid in grids)
    corners = np.concatenate([_corners(grid) for grid in grids])
    low = np.floor(corners.min(axis=0) / cell + 1e-6) * cell
    return cell, low, np.ceil((corners.max(axis=0) - low) / cell - 1e-6).astype(int)


def _corners(grid: OccupancyGrid) -> np.ndarray:
    height, width = grid.values.shape
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    local = grid.resolution * np.array([[0, 0], [width, 0], [0, height], [width, height]])
    return local @ np.array([[c, s], [-s, c]]) + (x, y)


def heading_of(way: np.ndarray) -> float:
    """The direction [rad] in which a robot comes to the end of its way [m], [k, 2]."""
    step = way[-1] - way[-2] if len(way) > 1 else np.array([1.0, 0.0])
    return math.atan2(step[1], step[0])
