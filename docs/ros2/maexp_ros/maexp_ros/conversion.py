"""From ROS messages to arrays and back; imports nothing of ROS, so that it can be tested without."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

COLOURS = ((0.84, 0.37, 0.0), (0.42, 0.12, 0.59), (0.84, 0.2, 0.51), (0.0, 0.24, 0.55), (0.0, 0.35, 0.24))
SPHERE, LINE_STRIP, SPHERE_LIST = 2, 4, 7  # of visualization_msgs/Marker
ADD, DELETE_ALL = 0, 3


@dataclass(frozen=True)
class Grid:
    """An occupancy grid.

    Attributes:
        values: int8 [rows along y, columns along x], -1 unknown, 0 free to 100 occupied.
        resolution: side of a cell [m].
        origin: x, y [m] and yaw [rad] of its lower left corner.
    """

    values: np.ndarray
    resolution: float
    origin: tuple[float, float, float]


def read_grid(message) -> Grid:
    """The grid of a nav_msgs/OccupancyGrid."""
    info = message.info
    values = np.asarray(message.data, dtype=np.int8).reshape(info.height, info.width)
    place = info.origin.position
    return Grid(values, float(f"{info.resolution:.7g}"), (place.x, place.y, read_yaw(info.origin.orientation)))


def read_yaw(turn) -> float:
    """Angle about z [rad] of a geometry_msgs/Quaternion."""
    return math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))


def read_pose(transform) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad] of a geometry_msgs/Transform."""
    return transform.translation.x, transform.translation.y, read_yaw(transform.rotation)


def place_grid(grid: Grid, pose: tuple[float, float, float]) -> Grid:
    """The grid in the frame in which its own frame stands at `pose`."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    gx, gy, turn = grid.origin
    return Grid(grid.values, grid.resolution, (x + c * gx - s * gy, y + s * gx + c * gy, turn + yaw))


def merge_grids(grids: list[Grid]) -> Grid:
    """One grid of several in one frame: occupied where any is, free where any is and none occupied.

    It has the finest resolution and lies along the frame's axes. One grid alone stays as it is.
    """
    if len(grids) == 1:
        return grids[0]
    cell = min(grid.resolution for grid in grids)
    corners = np.concatenate([_corners(grid) for grid in grids])
    low = np.floor(corners.min(axis=0) / cell) * cell
    columns, rows = np.ceil((corners.max(axis=0) - low) / cell - 1e-6).astype(int)
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
    return Grid(merged, cell, (float(low[0]), float(low[1]), 0.0))


def _corners(grid: Grid) -> np.ndarray:
    height, width = grid.values.shape
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    local = grid.resolution * np.array([[0, 0], [width, 0], [0, height], [width, height]])
    return local @ np.array([[c, s], [-s, c]]) + (x, y)


def heading_of(way: np.ndarray) -> float:
    """The direction [rad] in which a robot comes to the end of its way [m], [k, 2]."""
    step = way[-1] - way[-2] if len(way) > 1 else np.array([1.0, 0.0])
    return math.atan2(step[1], step[0])


def fill_pose(pose, x: float, y: float, yaw: float) -> None:
    """Writes a place into a geometry_msgs/Pose."""
    pose.position.x, pose.position.y, pose.position.z = float(x), float(y), 0.0
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def fill_way(marker, point, number: int, way: np.ndarray) -> None:
    """A way [k, 2] as a line of robot `number` in a visualization_msgs/Marker; `point` makes a geometry_msgs/Point."""
    _fill_marker(marker, "ways", number, LINE_STRIP, 0.05)
    marker.points = [point(x=float(x), y=float(y), z=0.05) for x, y in way]


def fill_goal(marker, number: int, goal: np.ndarray) -> None:
    """A goal [2] as a ball."""
    _fill_marker(marker, "goals", number, SPHERE, 0.3)
    fill_pose(marker.pose, goal[0], goal[1], 0.0)


def fill_targets(marker, point, targets: np.ndarray) -> None:
    """All places that were chosen from, [K, 2], as small balls."""
    _fill_marker(marker, "targets", 0, SPHERE_LIST, 0.12)
    marker.color.r, marker.color.g, marker.color.b = 0.5, 0.5, 0.5
    marker.points = [point(x=float(x), y=float(y), z=0.05) for x, y in targets]


def _fill_marker(marker, group: str, number: int, kind: int, size: float) -> None:
    marker.ns, marker.id, marker.type, marker.action = group, number, kind, ADD
    marker.scale.x = marker.scale.y = marker.scale.z = size
    marker.pose.orientation.w = 1.0
    colour = COLOURS[number % len(COLOURS)]
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = *colour, 0.9
