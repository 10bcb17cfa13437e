"""ROS messages as arrays: yaw, occupancy grids, point clouds and the transforms of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from maexp.envs.io.grid import FREE, MAX_CELLS, MAX_ORIGIN, OBSTACLE, UNKNOWN, Grid
from maexp.envs.io.occupancy import label_ones
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.quaternions import read_yaw

OCCUPIED, FREE_BELOW = 0.65, 0.25  # shares of 100, as nav2's map saver has them
REALS = {7: "f4", 8: "f8"}  # PointField's codes of float32 and float64


def to_grid(path: Path, message, options: ImportOptions, report: ImportReport) -> Grid:
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
    label_ones(values.reshape(height, width).T, labels, report)
    if ((values > 1) & (values < 100)).any():
        for name, value in (("free_threshold", free), ("occupied_threshold", occupied)):
            if getattr(options, name) is None:
                report.assume(f"the {name} of the grid's values was taken to be {value:g}", f"set importing.{name}")
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


TOLERANCE = 0.2  # [s]; a transform this much older or younger still counts
FIXED = ("map", "odom")  # frames that do not move (REP 105), the better one first


class TfTree:
    """What ``tf2_msgs/TFMessage``s say, kept as a track for every frame."""

    def __init__(self):
        self.moves = False  # whether a transform that was used changes over time
        self._listed: dict[str, list[tuple[str, float, tuple, tuple]]] = {}
        self._tracks: dict[str, _Track] = {}

    def add(self, message) -> None:
        """The transforms of a message, from parent to child."""
        for transform in message.transforms:
            shift, turn, stamp = transform.transform.translation, transform.transform.rotation, transform.header.stamp
            entry = (
                _bare(transform.header.frame_id),
                stamp.sec + 1e-9 * stamp.nanosec,
                (shift.x, shift.y, shift.z),
                (turn.x, turn.y, turn.z, turn.w),
            )
            self._listed.setdefault(_bare(transform.child_frame_id), []).append(entry)
            self._tracks.clear()

    def find(self, frame: str, time: float) -> tuple[str, np.ndarray, np.ndarray] | None:
        """The fixed frame, rotation [3, 3] and translation [3] [m] that bring `frame` into it at `time` [s].

        None where a transform on the way is not known at that time. The fixed frame is map, or odom, or what has no
        parent.
        """
        frame, rotation, translation = _bare(frame), np.eye(3), np.zeros(3)
        passed = {frame}
        while frame != FIXED[0] and frame in self._listed:
            track = self._tracks.setdefault(frame, _Track(self._listed[frame]))
            if frame == FIXED[1] and track.parent != FIXED[0]:
                break
            step = track.at(time)
            if step is None or track.parent in passed:
                return None
            turn, shift = step
            rotation, translation = turn @ rotation, turn @ translation + shift
            self.moves |= track.moves
            frame = track.parent
            passed.add(frame)
        return frame, rotation, translation


class _Track:
    """The transforms of one frame to its parent, by time."""

    def __init__(self, entries: list[tuple[str, float, tuple, tuple]]):
        self.parent = entries[-1][0]
        entries = [entry for entry in entries if entry[0] == self.parent]
        times, first = np.unique([entry[1] for entry in entries], return_index=True)
        self.times = times
        self.shifts = np.array([entries[i][2] for i in first], dtype=np.float64)
        turns = np.array([entries[i][3] for i in first], dtype=np.float64)
        turns[np.linalg.norm(turns, axis=1) < 1e-6] = (0.0, 0.0, 0.0, 1.0)
        self.turns = Rotation.from_quat(turns)
        self.moves = len(times) > 1 and bool(np.ptp(self.shifts, axis=0).any() or np.ptp(turns, axis=0).any())

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Rotation and translation, between the two nearest entries; a single entry holds for ever."""
        if len(self.times) == 1:
            return self.turns[0].as_matrix(), self.shifts[0]
        if not self.times[0] - TOLERANCE <= time <= self.times[-1] + TOLERANCE:
            return None
        time = float(np.clip(time, self.times[0], self.times[-1]))
        shift = [np.interp(time, self.times, self.shifts[:, axis]) for axis in range(3)]
        after = int(np.clip(np.searchsorted(self.times, time), 1, len(self.times) - 1))
        pair = slice(after - 1, after + 1)
        turn = Slerp(self.times[pair], self.turns[pair])(time)
        return turn.as_matrix(), np.array(shift)


def _bare(frame: str) -> str:
    return frame.lstrip("/")
