"""One team's episode in a volume as arrays that replay without simulation, and its file format."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from maexp.envs.maps.point_cloud import MapError, read_npz, write_npz
from maexp.envs.volume.map import VoxelMap

_FORMAT = "maexp-voxel-episode-1"
_MOMENT = ("pose", "center", "goal", "collided")
NEVER = np.iinfo(np.int16).max
"""A record in which no voxel was first seen."""


class VolumeEpisode:
    """Records of one team, T of them.

    Attributes:
        map: the volume; ``seeable`` bool [X, Y, Z], the voxels that coverage counts.
        policy: name, for captions.
        step: local step of each record, [T]; coverage: share, [T].
        pose [T, N, 4], center [T, N, 3], goal [T, N, 4], collided [T, N]: as in snapshots.
        free_seen_at, surface_seen_at: record in which the team first saw a voxel, int16 [X, Y, Z]; `NEVER`: it did not.
    """

    def __init__(self, place: VoxelMap, policy: str, arrays: dict[str, np.ndarray]):
        self.map, self.policy, self.arrays = place, policy, arrays
        for name, values in arrays.items():
            setattr(self, name, values)

    def __len__(self) -> int:
        return len(self.arrays["step"])

    def snapshot(self, record: int = -1) -> dict:
        """What ``ExplorationEnv.snapshot`` returned at a record, with the trail of all before it."""
        record = range(len(self))[record]
        a = self.arrays
        return {name: a[name][record] for name in _MOMENT} | {
            "map": self.map,
            "policy": self.policy,
            "seeable": a["seeable"],
            "seen_free": a["free_seen_at"] <= record,
            "seen_surface": a["surface_seen_at"] <= record,
            "coverage": float(a["coverage"][record]),
            "local_step": int(a["step"][record]),
            "trail": a["center"][: record + 1],
        }

    def save(self, path: str | os.PathLike) -> Path:
        """Writes the episode and its map as .npz (no pickle); the file appears whole or not at all."""
        texts = {"episode_format": _FORMAT, "policy": self.policy}
        texts = {name: np.array(text, dtype=np.str_) for name, text in texts.items()}
        return write_npz(path, self.map.to_arrays() | texts | {f"episode_{k}": v for k, v in self.arrays.items()})

    @classmethod
    def load(cls, path: str | os.PathLike) -> VolumeEpisode:
        """Reads what `save` wrote; raises MapError on any other file."""
        arrays = read_npz(path)
        mark = arrays.get("episode_format")
        if mark is None or str(mark) != _FORMAT:
            raise MapError(f"{path} is no episode in a volume of this version of MAexp; record it again")
        own = {k.removeprefix("episode_"): v for k, v in arrays.items() if k.startswith("episode_")}
        del own["format"]
        return cls(VoxelMap.from_arrays(arrays, path), str(arrays["policy"]), own)


class VolumeRecorder:
    """Collects the snapshots of one team's episode; ``episode()`` is what came of them."""

    def __init__(self, policy: str = ""):
        self.policy = policy
        self._moments: list[dict] = []
        self._seen: dict[str, np.ndarray] = {}

    def add(self, snapshot: dict) -> None:
        """One more moment; the same one again (a team that is done stands still) changes nothing."""
        if self._moments and self._moments[-1]["step"] == snapshot["local_step"]:
            return
        record = len(self._moments)
        for name in ("free", "surface"):
            seen = snapshot[f"seen_{name}"]
            first = self._seen.setdefault(f"{name}_seen_at", np.full(seen.shape, NEVER, dtype=np.int16))
            first[seen & (first == NEVER)] = record
        self._map, self._seeable = snapshot["map"], snapshot["seeable"]
        inputs = {name: snapshot[name] for name in _MOMENT}
        inputs |= {"step": np.int32(snapshot["local_step"]), "coverage": np.float32(snapshot["coverage"])}
        self._moments.append(inputs)

    def episode(self) -> VolumeEpisode:
        """The episode so far.

        Raises:
            ValueError: nothing was recorded.
        """
        if not self._moments:
            raise ValueError("nothing was recorded; add at least one snapshot")
        stacked = {name: np.stack([inputs[name] for inputs in self._moments]) for name in self._moments[0]}
        return VolumeEpisode(self._map, self.policy, stacked | self._seen | {"seeable": self._seeable})
