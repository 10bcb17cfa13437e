"""Where robots can be among voxels: clearance, support, climbing, and what hangs together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FLYING, DRIVING = "flying", "driving"
MOST_TRIED = 20_000  # places, where robots find room


@dataclass(frozen=True)
class Body:
    """A robot as far as it matters where it can go.

    Attributes:
        kind: "flying" or "driving" (on supported voxels).
        radius: [m]; a voxel is passable where a ball of it around the middle touches nothing but free voxels.
        step: height [m] that a driving robot climbs; rounded up to whole voxels.
        height: of a driving robot [m].
    """

    kind: str = FLYING
    radius: float = 0.25
    step: float = 0.27
    height: float = 0.5

    def climb(self, resolution: float) -> int:
        """Voxels that a driving robot climbs."""
        return max(0, math.ceil(self.step / resolution - 1e-6))


def ball(radius: float, resolution: float) -> np.ndarray:
    """Voxels nearer than `radius` [m] to the middle of the central one; bool [K, K, K]."""
    far = max(0, math.ceil(radius / resolution - 0.5 - 1e-9))
    gap = np.maximum(np.abs(np.arange(-far, far + 1)) - 0.5, 0.0) * resolution
    return gap[:, None, None] ** 2 + gap[:, None] ** 2 + gap**2 < radius**2 * (1 - 1e-9) + (far == 0)


def passable(free: np.ndarray, occupied: np.ndarray, body: Body, resolution: float) -> np.ndarray:
    """Voxels in which the middle of a robot can be; bool [X, Y, Z].

    A driving robot stands in the lowest free voxel over an occupied one; what is no higher above that voxel's bottom
    than it climbs does not hold up its sides.
    """
    shape = ball(body.radius, resolution)
    if body.kind == FLYING:
        return ndimage.binary_erosion(free, shape)
    supported = free.copy()
    supported[:, :, 0] = False
    supported[:, :, 1:] &= occupied[:, :, :-1]
    disc = shape[:, :, shape.shape[2] // 2]
    low, high = body.climb(resolution), max(1, math.ceil(body.height / resolution - 1e-6))
    level = ndimage.binary_erosion(free, disc[:, :, None])
    result = supported.copy()
    for up in range(high):
        above = free if up < low else level
        result &= _lifted(above, up)
    return result


def _lifted(mask: np.ndarray, up: int) -> np.ndarray:
    """The mask `up` voxels higher, at each voxel; False above the box."""
    if not up:
        return mask
    result = np.zeros_like(mask)
    result[:, :, :-up] = mask[:, :, up:]
    return result


def label_reachable(places: np.ndarray, body: Body, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Places that robots can go between: labels int32 [X, Y, Z], 0 where they cannot be, and sizes [count].

    Flying robots go to the 6 neighbours; driving ones to the 4 beside and up or down as they climb.
    """
    if body.kind == FLYING:
        labels, count = ndimage.label(places)
        return labels, np.bincount(labels.ravel(), minlength=count + 1)[1:]
    number = np.full(places.shape, -1, dtype=np.int64)
    total = int(np.count_nonzero(places))
    number[places] = np.arange(total)
    climb, nz = body.climb(resolution), places.shape[2]
    pairs = []
    for axis in (0, 1):
        here = number[:-1] if axis == 0 else number[:, :-1]
        there = number[1:] if axis == 0 else number[:, 1:]
        for up in range(-min(climb, nz - 1), min(climb, nz - 1) + 1):
            first = here[:, :, max(0, -up) : nz - max(0, up)]
            second = there[:, :, max(0, up) : nz + min(0, up)]
            both = (first >= 0) & (second >= 0)
            pairs.append(np.stack([first[both], second[both]]))
    index = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(index.shape[1], dtype=bool), index), shape=(total, total))
    count, found = connected_components(graph, directed=False)
    labels = np.zeros(places.shape, dtype=np.int32)
    labels[places] = found + 1
    return labels, np.bincount(found, minlength=count)


def largest_reach(free: np.ndarray, occupied: np.ndarray, body: Body, resolution: float) -> np.ndarray:
    """The largest set of places that a robot can go between; bool [X, Y, Z], all False where it fits nowhere."""
    labels, sizes = label_reachable(passable(free, occupied, body, resolution), body, resolution)
    return labels == int(sizes.argmax()) + 1 if len(sizes) else np.zeros_like(free)


def reach_from(free: np.ndarray, occupied: np.ndarray, body: Body, resolution: float, starts: np.ndarray) -> np.ndarray:
    """Places that robots in the voxels `starts`, int [count, 3], can get to; bool [X, Y, Z]."""
    labels, _ = label_reachable(passable(free, occupied, body, resolution), body, resolution)
    chosen = np.unique(labels[tuple(np.asarray(starts).T)])
    return np.isin(labels, chosen[chosen > 0])


def count_room(places: np.ndarray, resolution: float, apart: float, limit: int = 64) -> int:
    """Robots that surely find places `apart` [m] from each other, counted up to `limit`; places bool [X, Y, Z]."""
    index = np.argwhere(places)
    rng = np.random.default_rng(0)
    points = index[rng.permutation(len(index))[:MOST_TRIED]] * resolution
    room = 0
    while len(points) and room < limit:
        points = points[np.square(points - points[0]).sum(axis=1) >= apart**2 * (1 - 1e-9)]
        room += 1
    return room
