"""From ROS messages to arrays: occupancy grids and point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maexp.envs.map import MapError
from maexp.envs.quaternions import read_yaw

from .grid import FREE, MAX_CELLS, MAX_ORIGIN, OBSTACLE, UNKNOWN, Grid
from .options import ImportOptions

OCCUPIED, FREE_BELOW = 0.65, 0.25  # shares of 100, as nav2's map saver has them
REALS = {7: "f4", 8: "f8"}  # PointField's codes of float32 and float64


def to_grid(path: Path, message, options: ImportOptions) -> Grid:
    """The grid of a ``nav_msgs/OccupancyGrid``: -1 is unknown, 0 to 100 the chance of an obstacle in percent."""
    info = message.info
    values = np.asarray(message.data, dtype=np.int8)
    width, height = int(info.width), int(info.height)
    cell = float(f"{info.resolution:.7g}")  # float32 in the message, which would make 0.05 a 0.0500000007
    if width * height != len(values) or not 0 < width * height <= MAX_CELLS:
        raise MapError(f"{path}: the grid promises {width} x {height} cells and holds {len(values)}; record it again")
    if not 1e-4 <= cell <= 100:
        raise MapError(f"{path}: the grid's resolution={cell:g} must be between 0.0001 and 100 m a cell")
    corner = (float(info.origin.position.x), float(info.origin.position.y))
    yaw = read_yaw(info.origin.orientation)
    if not all(abs(coordinate) <= MAX_ORIGIN for coordinate in (*corner, yaw)):
        raise MapError(f"{path}: the grid's origin={corner} with yaw {yaw:g} is no place; record it again")
    occupied = OCCUPIED if options.occupied_threshold is None else options.occupied_threshold
    free = FREE_BELOW if options.free_threshold is None else options.free_threshold
    if not 0 <= free <= occupied <= 1:
        told = f"free_threshold={free:g} and occupied_threshold={occupied:g}"
        raise MapError(f"{told} must be shares of 100 with 0 <= free <= occupied <= 1")
    share = values.reshape(height, width).T / 100.0
    labels = np.full(share.shape, UNKNOWN, dtype=np.uint8)
    labels[(share >= 0) & (share <= free)] = FREE
    labels[share >= occupied] = OBSTACLE
    if not (labels == FREE).any():
        span = f"{values.min()} to {values.max()}"
        raise MapError(f"{path}: no cell of the grid is free (values {span}); set free_threshold")
    return Grid(labels, cell, corner, yaw)


def to_points(path: Path, message) -> np.ndarray:
    """x, y, z of a ``sensor_msgs/PointCloud2`` in its own frame [m], float64 [count, 3]; NaN where it has none."""
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields) or any(fields[axis].datatype not in REALS for axis in "xyz"):
        raise MapError(f"{path}: a cloud has the fields {', '.join(fields)}; it needs x, y and z as float32 or float64")
    order = ">" if message.is_bigendian else "<"
    width, height, step, row = (int(v) for v in (message.width, message.height, message.point_step, message.row_step))
    last = max(fields[axis].offset + int(REALS[fields[axis].datatype][1]) for axis in "xyz")
    row = row if height > 1 else width * step  # some drivers leave it 0 for a single row
    data = np.asarray(message.data, dtype=np.uint8)
    if last > step or width * step > row or height * row > len(data):
        told = f"promises {width} x {height} points and holds {len(data)} bytes"
        raise MapError(f"{path}: a cloud {told}; record it again")
    layout = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + REALS[fields[axis].datatype] for axis in "xyz"],
            "offsets": [int(fields[axis].offset) for axis in "xyz"],
            "itemsize": step,
        }
    )
    rows = data[: height * row].reshape(height, row)[:, : width * step]
    table = np.frombuffer(rows.tobytes(), dtype=layout)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
