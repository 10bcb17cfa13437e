"""From a grid of free and blocked cells to a point-cloud map; the random stream of a map."""

import hashlib

import numpy as np
from scipy import ndimage

from maexp.envs.map import PointCloudMap


def make_generator(scenario: str, index: int) -> np.random.Generator:
    """Random stream of map `index` of `scenario`: the same on every machine and run.

    Python's own `hash` is salted per process, hence SHA-256.
    """
    digest = hashlib.sha256(f"{scenario}/{index}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype="<u4"))


def grid_points(mask: np.ndarray, resolution: float) -> np.ndarray:
    """Points of the true cells of `mask`, shape (nx, ny): float32 (n, 3) [m].

    Cell (ix, iy) lies at resolution * (ix, iy).
    """
    cells = np.argwhere(mask)
    points = np.zeros((len(cells), 3), dtype=np.float32)
    points[:, :2] = cells * resolution
    return points


def grid_map(free: np.ndarray, resolution: float, *, name: str, scenario: str, **fields) -> PointCloudMap:
    """Map with a free point for each true cell of `free`, shape (nx, ny), an obstacle point for each other.

    `fields` are handed on to `PointCloudMap` (heights, spacing).
    """
    return PointCloudMap(
        grid_points(free, resolution),
        grid_points(~free, resolution),
        resolution,
        name=name,
        scenario=scenario,
        **fields,
    )


def largest_component(mask: np.ndarray) -> np.ndarray:
    """Largest 4-connected component of a boolean grid, shape as `mask`.

    Four neighbours, because no robot slips between two obstacle points that touch at a corner.
    """
    labels, count = ndimage.label(mask)
    if count == 0:
        return np.zeros_like(mask, dtype=bool)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())
