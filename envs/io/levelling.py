"""A cloud set upright: axis up, stray points, floor plane, tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.io.cloud_files import Faces
from maexp.envs.maps.point_cloud import MapError

MAX_TILT = np.deg2rad(15)
STEEP = np.deg2rad(60)  # steeper large planes are walls
STEEP_SHARE = 0.15  # of the points in a plane between the two: the cloud does not stand upright
HYPOTHESES = 4000
PLANE_THICKNESS = 0.05  # [m]; points nearer than this lie in the plane
SLAB = 0.05  # [m]; height of the layers a floor is looked for in
HEADROOM = 0.5  # [m]; a slab with next to nothing higher than this above it is a ceiling
DOUBLE = 0.7  # of a floor lie under another one closer than HEADROOM: a slab, or two scans of one floor
DOUBLE_CELL = 0.25  # [m]
LIKE = np.deg2rad(2)  # faces of a mesh that are tilted alike
STRAY = 4.0  # a point is stray where its neighbours are this many times farther than usual


def turn_up(points: np.ndarray, axis: str) -> np.ndarray:
    """The cloud [.., 3] turned (not mirrored) so that `axis` ("x", "-y", ...) becomes z."""
    if axis == "z":
        return points
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    turned = {"-z": (x, -y, -z), "y": (x, -z, y), "-y": (x, z, -y), "x": (-z, y, x), "-x": (z, y, -x)}[axis]
    return np.stack(turned, axis=1)


def guess_up(points: np.ndarray) -> str:
    """ "y" for a cloud that is less than half as tall along y as along z, for places are wider than tall."""
    low, high = np.percentile(points, [1, 99], axis=0)
    span = high - low
    return "y" if span[1] < 0.5 * span[2] and span[1] > 1e-3 * span[0] else "z"


def find_strays(points: np.ndarray) -> np.ndarray:
    """Points [m] much farther from their six nearest neighbours than usual; bool [count]."""
    if len(points) < 20:
        return np.zeros(len(points), dtype=bool)
    away, _ = cKDTree(points).query(points, k=7)
    mean = away[:, 1:].mean(axis=1)
    return mean > STRAY * max(float(np.median(mean)), 1e-9)


def thin(points: np.ndarray, voxel: float) -> np.ndarray:
    """The first point of every voxel of side `voxel` [m]; indices [kept]."""
    cell = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    size = cell.max(axis=0) + 1
    if float(size[0]) * float(size[1]) * float(size[2]) > 2**62:
        return np.arange(len(points))
    code = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    return np.sort(np.unique(code, return_index=True)[1])


@dataclass(frozen=True)
class Floor:
    """Where the floor of an upright cloud lies."""

    height: float  # [m], after levelling
    rotation: np.ndarray  # levels the cloud: points @ rotation.T
    tilt: float  # [rad] that was taken out
    scanned: bool  # the floor itself was seen; else `height` is where the lowest points are
    story: str
    double: str = ""  # a warning: there are two floors, one just above the other


def find_floor(points: np.ndarray, level: bool | None, faces: Faces | None = None, climb: bool = True) -> Floor:
    """The lowest large plane within 15 degrees of level.

    Of a mesh it is the lowest large one that looks up; of points [m] one found by seeded RANSAC on a thinned cloud.
    Any such plane levels the cloud, a ceiling too. Where the lowest slab has nothing above it, it is the ceiling:
    no floor was scanned, and the lowest percentile of the points stands in for it. A floor just under another one of
    its size is the underside of a slab (`climb`).
    """
    some = points[thin(points, 0.1)]
    rotation, tilt = np.eye(3), 0.0
    normal = None if faces is None else _face_normal(faces)
    faces = None if normal is None else faces
    if level is not False:
        if normal is None:
            normal = _best_normal(some)
        if normal is not None:
            tilt = float(np.arccos(min(1.0, normal[2])))
            rotation = _rotation_up(normal)
    heights = some @ rotation[2]
    usual = f"levelled by {np.rad2deg(tilt):.1f} degrees, " if np.rad2deg(tilt) > 0.01 else ""
    floor = _facing_floor(faces, rotation) if faces is not None else None
    facing = floor is not None
    if not facing and len(slabs := _slabs(heights)) and (heights > slabs[0] + HEADROOM).mean() > 0.05:
        floor = float(np.median(heights[np.abs(heights - slabs[0]) < 1.5 * SLAB]))
    if floor is not None:
        upper = _floor_above(points @ rotation.T, floor) if climb else None
        if upper is None:
            return Floor(floor, rotation, tilt, True, f"{usual}floor found at {floor:.2f} m")
        told = f"{usual}floor found at {upper:.2f} m, {upper - floor:.2f} m above another"
        double = f"two floors lie {upper - floor:.2f} m above each other, and the upper one was taken: if the scan has "
        double += "drifted, register it again, or set importing.floor"
        return Floor(upper, rotation, tilt, True, told, "" if facing else double)
    floor = float(np.percentile(heights, 1))
    story = f"{usual}no floor was scanned: taken below the lowest points, {floor:.2f} m"
    return Floor(floor, rotation, tilt, False, story)


def _face_normal(faces: Faces) -> np.ndarray | None:
    """Upward normal of most of the area that is nearly level; None where the faces are as uneven as a scan's."""
    up = faces.normals * np.where(faces.normals[:, 2:] < 0, -1.0, 1.0)
    flat = up[:, 2] > np.cos(MAX_TILT)
    up, areas = up[flat], faces.areas[flat]
    if not len(up):
        return None
    tried = up[np.argsort(-areas, kind="stable")[:200]]
    best = tried[int(np.argmax([areas[up @ normal > np.cos(LIKE)].sum() for normal in tried]))]
    for _ in range(3):
        alike = up @ best > np.cos(LIKE)
        best = (up[alike] * areas[alike, None]).sum(axis=0)
        best = best / np.linalg.norm(best)
    return best if areas[up @ best > np.cos(LIKE)].sum() > 0.5 * areas.sum() else None


def _facing_floor(faces: Faces, rotation: np.ndarray) -> float | None:
    """Height of the lowest large area of a mesh that looks up and has something above it; None: there is none."""
    heights, up = faces.centres @ rotation[2], faces.normals @ rotation[2] > np.cos(MAX_TILT)
    if not up.any():
        return None
    order = np.argsort(heights[up], kind="stable")
    levels, areas = heights[up][order], faces.areas[up][order]
    total = np.concatenate([[0.0], np.cumsum(areas)])
    near = total[np.searchsorted(levels, levels + SLAB, side="right")] - total[np.arange(len(levels))]
    for low in levels[near > 0.3 * near.max()]:
        if faces.areas[heights > low + HEADROOM].sum() > 0.05 * faces.areas.sum():
            inside = (levels >= low) & (levels <= low + SLAB)
            return float(np.average(levels[inside], weights=areas[inside]))
    return None


def _floor_above(points: np.ndarray, floor: float) -> float | None:
    """Height of a floor that covers most of the one at `floor`, too near above for a robot between; None: none does."""
    low, above = points[:, 2] - floor, points[:, 2]
    cells = np.floor(points[:, :2] / DOUBLE_CELL).astype(np.int64)
    cells -= cells.min(axis=0)
    code = cells[:, 0] * (int(cells[:, 1].max()) + 1) + cells[:, 1]
    lower = np.unique(code[np.abs(low) < SLAB])
    near = (low > 2 * SLAB) & (low < HEADROOM)
    bins = np.bincount((low[near] / SLAB).astype(int), minlength=int(HEADROOM / SLAB))
    count = (np.abs(low) < SLAB / 2).sum()
    for at in np.flatnonzero(bins > 0.4 * count)[::-1]:
        height = floor + (at + 0.5) * SLAB
        layer = np.abs(above - height) < SLAB
        if np.isin(lower, code[layer]).mean() > DOUBLE:
            return float(np.median(above[layer]))
    return None


def _slabs(heights: np.ndarray) -> np.ndarray:
    """Heights [m] of horizontal layers that hold far more points than walls would, lowest first."""
    low = heights.min()
    bins = np.bincount(np.floor((heights - low) / SLAB).astype(int))
    pairs = np.convolve(bins, [1, 1])  # a slab may straddle two layers
    large = np.flatnonzero((pairs > 0.3 * pairs.max()) & (pairs > 3 * np.median(pairs[pairs > 0])))
    return low + large * SLAB


def _best_normal(points: np.ndarray) -> np.ndarray | None:
    """Upward normal of the nearly level plane that most points lie in; None where there is none.

    Raises MapError where far more points lie in a plane that is neither level nor a wall.
    """
    random = np.random.default_rng(0)
    some = points if len(points) <= 3000 else points[random.choice(len(points), 3000, replace=False)]
    corners = some[random.integers(len(some), size=(HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    normals = normals[good] / length[good, None]
    normals *= np.where(normals[:, 2] < 0, -1.0, 1.0)[:, None]
    floors = normals[:, 2] > np.cos(STEEP)
    normals, anchors = normals[floors], corners[good][floors, 0]
    offsets = (normals * anchors).sum(axis=1)
    support = np.array([(np.abs(some @ n - d) < PLANE_THICKNESS).sum() for n, d in zip(normals, offsets, strict=True)])
    level = normals[:, 2] > np.cos(MAX_TILT)
    steep, usual = (support[kind].max(initial=0) for kind in (~level, level))
    if steep > max(2 * usual, STEEP_SHARE * len(some)):
        tilt = np.rad2deg(np.arccos(normals[~level][support[~level].argmax(), 2]))
        raise MapError(
            f"the largest plane of the cloud is tilted by {tilt:.0f} degrees, more than {np.rad2deg(MAX_TILT):.0f}: "
            "turn it upright, set up, or set level=false to take it as it stands"
        )
    if usual < 0.05 * len(some):
        return None
    best = int(np.where(level, support, 0).argmax())
    normal, offset = normals[best], offsets[best]
    for _ in range(3):  # refine on all points
        inside = points[np.abs(points @ normal - offset) < PLANE_THICKNESS]
        centre = inside.mean(axis=0)
        normal = np.linalg.svd(inside - centre, full_matrices=False)[2][2]
        normal = normal * np.where(normal[2] < 0, -1.0, 1.0)
        offset = float(normal @ centre)
    return normal if normal[2] > np.cos(MAX_TILT) else None


def _rotation_up(normal: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes `normal` to +z, [3, 3]."""
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + normal[2])
