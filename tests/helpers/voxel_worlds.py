"""Small volumes for kernel tests: maps of different sizes, envs on them, and what they hold as grids."""

from collections.abc import Callable

import numpy as np
import torch

from maexp.envs import ExplorationEnv
from maexp.envs.volume.map import VoxelMap, unpack_words
from maexp.kernels.launches import launch_on

RESOLUTION = 0.25


def hall(shape=(33, 22, 41), seed: int = 0, origin=(1.5, -2.25, 0.75), boxes: int = 22) -> VoxelMap:
    """A box of walls with solid boxes in it; some of what is solid is unknown instead."""
    rng = np.random.default_rng(seed)
    free = np.zeros(shape, dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    for _ in range(boxes):
        low = rng.integers(1, np.array(shape) - 4)
        x, y, z = low + rng.integers(1, 6, 3)
        free[low[0] : x, low[1] : y, low[2] : z] = False
    occupied = ~free & (rng.random(shape) < 0.95)
    return VoxelMap(free, occupied, RESOLUTION, origin, name=f"hall_{seed}", scenario="cave")


def maps() -> list[VoxelMap]:
    """Two maps: one of two words a column, and a wider and lower one; neither is a multiple of a cell or a block."""
    return [hall(), hall((25, 38, 19), seed=1, origin=(-3.0, 0.5, 0.0), boxes=16)]


def volume_env(num_envs: int = 5, num_robots: int = 3, seed: int = 4, **settings) -> ExplorationEnv:
    """An env on both maps that has been reset."""
    settings = {"maps": maps(), "num_threads": 1} | settings
    env = ExplorationEnv(settings.pop("maps"), num_envs, num_robots, seed=seed, **settings)
    env.reset()
    return env


def run(env: ExplorationEnv, stage: Callable, *running: torch.Tensor, **given) -> None:
    """Run a stage of the kernels at once, on all envs."""
    for shard in env.simulation.shards:
        stage(launch_on("cpu"), shard, *running, **given)


def map_of(env: ExplorationEnv, e: int) -> VoxelMap:
    """The map that an env plays on."""
    return env.maps[int(env.simulation.tensors["map_id"][e])]


def grid(env: ExplorationEnv, name: str, e: int, i: int | None = None, shape=None) -> np.ndarray:
    """Words of an env (and a robot, or a row) as bool [X, Y, Z]."""
    words = env.simulation.tensors[name][e]
    nx, ny, nz = shape or map_of(env, e).shape
    return unpack_words((words if i is None else words[i])[: nx * ny].reshape(nx, ny, -1).numpy().copy(), nz)


def place(env: ExplorationEnv, rng, spread: float = 1.5) -> None:
    """Put robots at random points of free voxels, each near the first of its team, with random headings."""
    s = env.simulation.tensors
    for e in range(s["center"].shape[0]):
        m = map_of(env, e)
        index = np.argwhere(m.free)
        first = index[rng.integers(len(index))]
        near = index[np.linalg.norm(index - first, axis=1) <= spread / m.resolution]
        chosen = near[rng.integers(len(near), size=s["center"].shape[1])]
        points = (chosen + rng.uniform(0.05, 0.95, chosen.shape)) * m.resolution + m.origin
        s["center"][e] = torch.from_numpy(points).float()
        s["pose"][e, :, :2] = s["center"][e, :, :2]
        s["pose"][e, :, 3] = torch.from_numpy(rng.uniform(-np.pi, np.pi, len(points))).float()
