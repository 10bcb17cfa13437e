"""The voxels that a sensor can see from where robots can go."""

from __future__ import annotations

import math

import numpy as np

FEW = 2000  # places to see from: with fewer ones all offsets are tried
NEAREST = 1500  # offsets that are all tried; of the farther ones every `SKIPPED`-th
SKIPPED = 8
FINE = 8  # points a voxel along a line of sight


def seeable(world, sensor_range: float, vertical_fov: float, reachable: np.ndarray, exact: bool = False) -> np.ndarray:
    """Free voxels that a sensor sees from some reachable one; bool [X, Y, Z].

    A voxel is seen if its middle is in range and in the field of view, and the line between the middles runs through
    free voxels alone. The heading is free, so that the horizontal field of view does not matter.

    Args:
        world: a `VoxelMap`.
        sensor_range: [m].
        vertical_fov: all of it, half above and half below the horizon [rad].
        reachable: voxels where the sensor can be, bool [X, Y, Z], as of `maexp.envs.volume.reach`.
        exact: try all offsets; else, where there are many places, far ones are sampled, which misses a few voxels.
    """
    margin = int(sensor_range / world.resolution + 1e-6)
    free = np.pad(world.free, margin)
    shape, flat = free.shape, free.ravel()
    sources = np.pad(reachable & world.free, margin).ravel()
    seen = sources.copy()
    left = np.flatnonzero(flat & ~seen)
    exact = exact or np.count_nonzero(sources) < FEW
    for offset in _offsets(margin, sensor_range / world.resolution, vertical_fov, exact):
        if not len(left):
            break
        ahead = left[sources[left + np.ravel_multi_index(offset + margin, shape) - _middle(margin, shape)]]
        for cell in _line(offset):
            if not len(ahead):
                break
            step = np.ravel_multi_index(cell + margin, shape) - _middle(margin, shape)
            ahead = ahead[flat[ahead + step]]
        if len(ahead):
            seen[ahead] = True
            left = left[~seen[left]]
    inside = slice(margin, -margin) if margin else slice(None)
    return seen.reshape(shape)[inside, inside, inside]


def _middle(margin: int, shape) -> int:
    return int(np.ravel_multi_index((margin,) * 3, shape))


def _offsets(margin: int, reach: float, vertical_fov: float, exact: bool) -> np.ndarray:
    """From a voxel to where it may be seen from, the nearest first; int [count, 3]."""
    side = np.arange(-margin, margin + 1)
    offsets = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(offsets, axis=1)
    rise = np.arctan2(np.abs(offsets[:, 2]), np.hypot(offsets[:, 0], offsets[:, 1]))
    good = (away > 0) & (away <= reach + 1e-9) & (rise <= 0.5 * vertical_fov + 1e-9)
    offsets = offsets[good][np.argsort(away[good], kind="stable")]
    return offsets if exact else np.concatenate([offsets[:NEAREST], offsets[NEAREST::SKIPPED]])


def _line(offset: np.ndarray) -> np.ndarray:
    """Voxels between voxel 0 and `offset` on the straight line, without the ends; int [count, 3]."""
    count = FINE * math.ceil(float(np.linalg.norm(offset)))
    cells = np.rint(np.linspace(0.0, 1.0, count + 1)[:, None] * offset).astype(int)
    keep = (cells != 0).any(axis=1) & (cells != offset).any(axis=1)
    keep[1:] &= (cells[1:] != cells[:-1]).any(axis=1)
    return cells[keep]
