"""What one team of an env looks like at a moment, for drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from maexp.kernels import unpack_flags
from maexp.kernels.types import PIXELS

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv


def take_snapshot(env: ExplorationEnv, index: int) -> dict:
    """Env ``index`` as NumPy arrays, points in the order of its map."""
    s = env.simulation.tensors
    m = int(s["map_id"][index])
    step = int(s["local_step"][index])
    place = env.maps[m]

    def flags(name: str, order: np.ndarray) -> np.ndarray:
        count = len(order)
        sorted_flags = unpack_flags(s[name][index : index + 1, :, :count], env.num_robots)[0].cpu().numpy()
        result = np.empty_like(sorted_flags)
        result[:, order] = sorted_flags
        return result

    visible = np.zeros((env.num_robots, len(place.free)), dtype=bool)
    for i in range(env.num_robots):
        listed = s["visible"][index, i, : int(s["visible_count"][index, i])].cpu().numpy()
        visible[i, env.bank.order_free[m][listed]] = True
    total = int(env.simulation.map_tensors["total_weight"][m])
    return {
        "map": place,
        "pose": s["pose"][index].cpu().numpy().copy(),
        "center": s["center"][index, :, :2].cpu().numpy().copy(),
        "body": np.array([[r.length, r.width] for r in env.robot_configs], dtype=np.float32),
        "goal": s["goal"][index].cpu().numpy().copy(),
        "waypoint": s["waypoint"][index].cpu().numpy().copy(),
        "radar_range": np.array([r.range for r in env.radar_configs], dtype=np.float32),
        "seen_free": flags("seen_free", env.bank.order_free[m]),
        "seen_boundary": flags("seen_boundary", env.bank.order_boundary[m]),
        "visible": visible,
        "coverage": int(s["covered"][index]) / total,
        "local_step": step,
        "collided": (s["collided"][index] != 0).cpu().numpy(),
        "trail": _trail(env, index, m, step),
    }


def _trail(env: ExplorationEnv, index: int, m: int, step: int) -> np.ndarray:
    """Past centres of the robots at the picture's resolution, oldest first, [T, N, 2] [m]."""
    track = env.simulation.tensors["track"][index].cpu().numpy()
    depth = track.shape[1]
    pixels = track[:, np.arange(max(0, step - depth + 1), step + 1) % depth].T
    origin = env.bank.arrays["frame_origin"][m]
    size = env.bank.arrays["pixel_size"][m]
    side = PIXELS
    return origin + size * np.stack([pixels // side, pixels % side], axis=-1)
