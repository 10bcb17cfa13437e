"""From a grid of free and blocked cells to a point-cloud map; the random stream of a map."""

import hashlib

import numpy as np
from scipy import ndimage

from maexp.envs.maps.point_cloud import PointCloudMap


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


def wall_points(free: np.ndarray, wall: np.ndarray, spacing: float, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Points between neighbouring wall cells that touch free space, so that no robot drives through the wall.

    Args:
        free, wall: cells, bool (nx, ny).
        spacing: side of a cell [m].
        gap: how far apart the points of a wall, those at cell centres included, may lie [m].

    Returns:
        float64 (n, 2) in cells, none half-way between two, and int64 (n,): the number in `np.argwhere(wall)` of the
        cell from which each starts.
    """
    parts = 1
    while (1 / parts + 0.02) * np.sqrt(2) * spacing >= gap and parts < 100:
        parts += 1
    number = np.cumsum(wall).reshape(wall.shape) - 1
    edge = wall & ndimage.binary_dilation(free, np.ones((3, 3)))
    points, first = [np.zeros((0, 2))], [np.zeros(0, int)]
    for step in ((1, 0), (0, 1), (1, 1), (1, -1)) if parts > 1 else ():
        here = np.argwhere(edge)
        there = here + step
        here = here[((there >= 0) & (there < wall.shape)).all(axis=1)]
        here = here[edge[tuple((here + step).T)]]
        for k in range(1, parts):
            points.append(here + 0.98 * k / parts * np.array(step))
            first.append(number[tuple(here.T)])
    return np.concatenate(points), np.concatenate(first)


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
