"""Rays of a sensor as a tree: rays from the middle of one eighth of a voxel, merged while they pass the same voxels.

Voxels are numbered from the one that holds the sensor. The tree stands in an array depth first, and every voxel knows
where to go on when it blocks the rays through it.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

OCTANTS = 8  # trees: one for each eighth of the voxel that the sensor is in
DENSITY = 0.65  # rays for each voxel on the sphere of the sensor's range
TOUCH = 2.5  # voxels that a robot feels all around


@dataclass(frozen=True, eq=False)
class RayTrees:
    """The trees of a sensor.

    Attributes:
        offset: int32 [K, 3], voxels from the sensor's own, of one tree after another.
        skip: int32 [K], number of the next entry that no ray through this one passes.
        begin: int32 [OCTANTS + 1], first entry of each tree.
        weight: float32 [K], one over the entries of a tree with the same offset.
        view: float, voxels in view if nothing stood in the way.
    """

    offset: np.ndarray
    skip: np.ndarray
    begin: np.ndarray
    weight: np.ndarray
    view: float


@lru_cache(maxsize=16)
def grow_trees(reach: float, vertical_fov: float, density: float = DENSITY) -> RayTrees:
    """Trees of rays of a length [voxels] up to so far up and down [rad], all around; so many rays for each voxel on the
    sphere of that length."""
    low = math.sin(0.5 * min(vertical_fov, math.pi))
    solid = 4.0 * math.pi * low
    count = max(16, round(density * solid * reach**2))
    k = np.arange(count) + 0.5
    up = low * (2.0 * k / count - 1.0)
    turn = math.pi * (1.0 + 5.0**0.5) * k  # golden angle
    flat = np.sqrt(1.0 - up**2)
    rays = reach * np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=-1)
    if low < 1.0:  # what a robot touches it knows, wherever its sensor looks
        rays = np.concatenate([rays, TOUCH * _sphere(64)])
    parts = [_tree(rays, np.array([o & 1, o >> 1 & 1, o >> 2]) * 0.5 + 0.25) for o in range(OCTANTS)]
    begin = np.cumsum([0, *(len(skip) for _, skip in parts)]).astype(np.int32)
    offset = np.concatenate([offset for offset, _ in parts]).astype(np.int32)
    skip = np.concatenate([skip + first for (_, skip), first in zip(parts, begin, strict=False)]).astype(np.int32)
    weight = np.concatenate([_weigh(offset) for offset, _ in parts]).astype(np.float32)
    return RayTrees(offset, skip, begin, weight, solid * reach**3 / 3.0)


def _sphere(count: int) -> np.ndarray:
    """Unit vectors all around, [count, 3]."""
    k = np.arange(count) + 0.5
    up, turn = 2.0 * k / count - 1.0, math.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - up**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=-1)


def _weigh(offset: np.ndarray) -> np.ndarray:
    """One over the entries [K, 3] that are the same."""
    _, which, count = np.unique(offset, axis=0, return_inverse=True, return_counts=True)
    return 1.0 / count[which.ravel()]


def _tree(rays: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entries of the tree of rays [R, 3] from a start in voxel (0, 0, 0): offsets [K, 3] and skips [K]."""
    voxels, length = _march(rays, start)
    side = int(np.abs(voxels).max()) + 1
    code = ((voxels[..., 0] + side) * (2 * side + 1) + voxels[..., 1] + side) * (2 * side + 1) + voxels[..., 2] + side
    code = np.where(np.arange(code.shape[1]) < length[:, None], code, -1)
    code = code[np.lexsort(code.T[::-1])]
    same = np.zeros(code.shape, dtype=bool)
    same[1:] = np.cumprod(code[1:] == code[:-1], axis=1).astype(bool)
    rows, depth = np.nonzero(~same & (code >= 0))
    kept = code[rows, depth]
    size = 2 * side + 1
    offset = np.stack([kept // size**2, kept // size % size, kept % size], axis=-1) - side
    skip, open_at = np.full(len(kept), len(kept)), []  # entries whose end is not yet found, by depth
    for number, level in enumerate(depth):
        while open_at and open_at[-1][0] >= level:
            skip[open_at.pop()[1]] = number
        open_at.append((level, number))
    return offset, skip


def _march(rays: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Voxels that each ray passes, int [R, S, 3], its own first, and how many those are, [R]."""
    step = np.sign(rays).astype(np.int64)
    with np.errstate(divide="ignore"):
        delta = 1.0 / np.abs(rays)
        to = np.where(step > 0, 1.0 - start, start) * delta
    at = np.zeros(rays.shape, dtype=np.int64)
    steps, over = [at.copy()], []
    while True:
        axis = to.argmin(1)
        rows = np.arange(len(rays))
        ends = to[rows, axis] > 1.0
        over.append(ends)
        if ends.all():
            break
        at[rows, axis] += step[rows, axis]
        to[rows, axis] += delta[rows, axis]
        steps.append(at.copy())
    length = np.argmax(np.stack(over, 1), axis=1) + 1
    return np.stack(steps, axis=1), length
