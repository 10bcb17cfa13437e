"""What one team of an env in volumes looks like at a moment, for drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from maexp.envs.volume.map import unpack_words

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv


def take_snapshot(env: ExplorationEnv, index: int) -> dict:
    """Env ``index`` as NumPy arrays: voxels bool [X, Y, Z] of its map, robots [N, ...]."""
    s, m = env.simulation.tensors, int(env.simulation.tensors["map_id"][index])
    place = env.maps[m]

    def voxels(name: str) -> np.ndarray:
        nx, ny, nz = place.shape
        words = s[name][index, : nx * ny].reshape(nx, ny, -1).cpu().numpy()
        return unpack_words(words, nz)

    center = s["center"][index].cpu().numpy().copy()
    return {
        "map": place,
        "seeable": env.bank.seeable[m],
        "pose": s["pose"][index].cpu().numpy().copy(),
        "center": center,
        "goal": s["goal"][index].cpu().numpy().copy(),
        "radar_range": np.array([r.range for r in env.radar_configs], dtype=np.float32),
        "seen_free": voxels("team_free"),
        "seen_surface": voxels("team_surface"),
        "coverage": int(s["covered"][index]) / int(env.simulation.map_tensors["total_weight"][m]),
        "local_step": int(s["local_step"][index]),
        "collided": (s["collided"][index] != 0).cpu().numpy(),
        "trail": center[None],
    }
