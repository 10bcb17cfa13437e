"""Transforms of a recording: where a frame was in the fixed frame, at any time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

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
