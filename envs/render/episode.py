"""A recorded episode of one team: everything a picture needs, in one file, so that it replays without simulation."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from maexp.envs.maps.point_cloud import MapError, PointCloudMap, read_npz, write_npz
from maexp.kernels.constants import DT

_FORMAT = "maexp-episode-1"
_KINDS = {
    "step": "iu",
    "pose": "f",
    "center": "f",
    "goal": "f",
    "waypoint": "f",
    "collided": "b",
    "coverage": "f",
    "body": "f",
    "radar_range": "f",
    "free_seen_at": "iu",
    "boundary_seen_at": "iu",
    "visible": "u",
}
_MAY_BE_NAN = ("goal", "waypoint")  # before the first goal


@dataclass(frozen=True, eq=False)
class Episode:
    """What a team of N robots did in T records on a map with F free and B boundary points.

    Attributes:
        map: where.
        policy: who decided.
        step: local steps since the start, [T], rising.
        pose, center, goal, waypoint: as in ``ExplorationEnv.snapshot``, [T, N, 4] and [T, N, 2].
        collided: [T, N]; coverage: [T].
        body, radar_range: [N, 2] and [N] [m].
        free_seen_at, boundary_seen_at: record in which a robot first saw a point, -1: never; [N, F], [N, B].
            What was seen stays seen, so this tells every record's flags.
        visible: what a robot sees at each record, eight points to a byte (``np.packbits``), [T, N, ceil(F / 8)].
    """

    map: PointCloudMap
    policy: str
    step: np.ndarray
    pose: np.ndarray
    center: np.ndarray
    goal: np.ndarray
    waypoint: np.ndarray
    collided: np.ndarray
    coverage: np.ndarray
    body: np.ndarray
    radar_range: np.ndarray
    free_seen_at: np.ndarray
    boundary_seen_at: np.ndarray
    visible: np.ndarray

    @property
    def seconds(self) -> np.ndarray:
        """Time of each record [s], [T]."""
        return self.step * DT

    @property
    def num_robots(self) -> int:
        return self.pose.shape[1]

    def __len__(self) -> int:
        return len(self.step)

    def snapshot(self, record: int = -1) -> dict:
        """What ``ExplorationEnv.snapshot`` returned at a record; the trail runs straight between records."""
        record = range(len(self))[record]
        steps, past = np.arange(self.step[record] + 1), self.step[: record + 1]
        ways = self.center[: record + 1].reshape(record + 1, -1).T
        trail = np.stack([np.interp(steps, past, way) for way in ways], axis=-1).reshape(len(steps), -1, 2)
        visible = np.unpackbits(self.visible[record], axis=-1, count=len(self.map.free)).astype(bool)
        fields = ("pose", "center", "goal", "waypoint", "collided")
        return {name: getattr(self, name)[record] for name in fields} | {
            "map": self.map,
            "policy": self.policy,
            "body": self.body,
            "radar_range": self.radar_range,
            "seen_free": self._seen(self.free_seen_at, record),
            "seen_boundary": self._seen(self.boundary_seen_at, record),
            "visible": visible,
            "coverage": float(self.coverage[record]),
            "local_step": int(self.step[record]),
            "trail": trail,
        }

    @staticmethod
    def _seen(first: np.ndarray, record: int) -> np.ndarray:
        return (first >= 0) & (first <= record)

    def save(self, path: str | os.PathLike) -> Path:
        """Writes the episode and its map as .npz (no pickle); the file appears whole or not at all."""
        arrays = {name: getattr(self, name) for name in _KINDS}
        texts = {"episode_format": _FORMAT, "policy": self.policy}
        arrays |= {name: np.array(text, dtype=np.str_) for name, text in texts.items()}
        return write_npz(path, self.map.to_arrays() | arrays)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Episode:
        """Reads what `save` wrote; raises MapError on any other or damaged file."""
        return cls.from_arrays(read_npz(path), path)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], path: str | os.PathLike) -> Episode:
        """The episode among the arrays that `path` held; raises MapError as `load` does."""
        missing = {"episode_format", "policy", *_KINDS} - arrays.keys()
        if missing:
            raise MapError(f"{path} is not an episode of MAexp (no {', '.join(sorted(missing))}); record it again")
        texts = {name: arrays[name] for name in ("episode_format", "policy")}
        if any(text.dtype.kind != "U" or text.shape != () for text in texts.values()):
            raise MapError(f"{path}: episode_format and policy must be text; record it again")
        if str(texts["episode_format"]) != _FORMAT:
            raise MapError(f"{path} has episode format {texts['episode_format']}; this version reads {_FORMAT}")
        place = PointCloudMap.from_arrays(arrays, path)
        episode = cls(place, str(texts["policy"]), **{name: arrays[name] for name in _KINDS})
        episode._check(path)
        return episode

    def _check(self, path) -> None:
        """Raises MapError unless all arrays are of one episode on this map."""
        count, robots = self.step.shape[:1] + (0,), self.radar_range.shape[:1] + (0,)
        t, n, f, b = count[0], robots[0], len(self.map.free), len(self.map.boundary)
        shapes = {
            "step": (t,),
            "pose": (t, n, 4),
            "center": (t, n, 2),
            "goal": (t, n, 2),
            "waypoint": (t, n, 2),
            "collided": (t, n),
            "coverage": (t,),
            "body": (n, 2),
            "radar_range": (n,),
            "free_seen_at": (n, f),
            "boundary_seen_at": (n, b),
            "visible": (t, n, -(-f // 8)),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype.kind not in _KINDS[name] or 0 in (t, n):
                found = f"{name} has shape {array.shape} and type {array.dtype}"
                raise MapError(f"{path} is damaged: {found}, {shape} was expected; record it again")
            if name == "body" and not (array > 0).all():
                raise MapError(f"{path} is damaged: a body of {array.min():g} m; record it again")
            if array.dtype.kind == "f" and name not in _MAY_BE_NAN and not np.isfinite(array).all():
                raise MapError(f"{path} is damaged: {name} has NaN or infinite values; record it again")
        if self.visible.dtype != np.uint8 or self.step[0] < 0 or (np.diff(self.step.astype(np.int64)) <= 0).any():
            raise MapError(f"{path} is damaged: its steps do not rise or its flags are not packed; record it again")
        if self.step[-1] > 10_000_000:  # pictures interpolate between steps: a crafted number would fill the memory
            raise MapError(f"{path} is damaged: it claims {self.step[-1]} local steps; record it again")


class EpisodeRecorder:
    """Collects the snapshots of one team's episode; ``episode()`` is what came of them.

    recorder = EpisodeRecorder("nearest_frontier")
    watch_episode(env, policy, lambda snapshots: recorder.add(snapshots[0]))
    recorder.episode().save("episode.npz")
    """

    def __init__(self, policy: str = ""):
        self.policy = policy
        self._moments: list[dict] = []
        self._seen: dict[str, np.ndarray] = {}

    def add(self, snapshot: dict) -> None:
        """One more moment; the same one again (a team that is done stands still) changes nothing."""
        if self._moments and self._moments[-1]["step"] == snapshot["local_step"]:
            return
        record = len(self._moments)
        for name in ("free", "boundary"):
            seen = snapshot[f"seen_{name}"]
            first = self._seen.setdefault(name, np.full(seen.shape, -1, dtype=np.int32))
            first[seen & (first < 0)] = record
        self._last = {name: snapshot[name] for name in ("map", "body", "radar_range")}
        inputs = {name: snapshot[name] for name in ("pose", "center", "goal", "waypoint", "collided")}
        inputs |= {"step": np.int32(snapshot["local_step"]), "coverage": np.float32(snapshot["coverage"])}
        self._moments.append(inputs | {"visible": np.packbits(snapshot["visible"], axis=-1)})

    def episode(self) -> Episode:
        """The episode so far.

        Raises:
            ValueError: nothing was recorded.
        """
        if not self._moments:
            raise ValueError("nothing was recorded; add at least one snapshot")
        stacked = {name: np.stack([inputs[name] for inputs in self._moments]) for name in self._moments[0]}
        seen = {f"{name}_seen_at": first.copy() for name, first in self._seen.items()}
        return Episode(policy=self.policy, **self._last, **stacked, **seen)
