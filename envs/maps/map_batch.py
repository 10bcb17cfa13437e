"""Maps as the kernels want them: points sorted by cell, neighbours, pixels, and bounds of every buffer.

Everything here is static and computed once per batch with NumPy and SciPy.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from maexp.envs.config import RadarConfig
from maexp.envs.maps.point_cloud import BOUNDARY_REACH, PointCloudMap
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.types import PIXEL_SHARED, PIXELS

CELLS_PER_RANGE = 5
FRAME_MARGIN = 0.05


@dataclass
class MapBank:
    """All maps of a batch.

    ``arrays`` holds every field of `kernels.types.Maps`; ``order[m]`` the permutation from the sorted
    free (``order_boundary``: boundary) points back to the map's own order; the counts bound how many
    points can ever be in range of a robot, so that buffers of that size cannot overflow. ``grids`` are the navigation
    grids of maps that have theirs from elsewhere, as `nav_grid.bank_nav_grids` gives them, and ``block_sides`` what
    `nav_grid.bank_block_sides` gives for them.
    """

    maps: list[PointCloudMap]
    arrays: dict[str, np.ndarray]
    order_free: list[np.ndarray]
    order_boundary: list[np.ndarray]
    max_free: int
    max_boundary: int
    free_in_range: int
    boundary_in_range: int
    occluders_in_range: int
    grids: tuple[NavGrids, int] | None = None
    block_sides: np.ndarray | None = None

    def tensors(self, device: torch.device) -> dict[str, torch.Tensor]:
        """The arrays as tensors on ``device``."""
        return {name: torch.from_numpy(np.ascontiguousarray(a)).to(device) for name, a in self.arrays.items()}


def build_bank(maps: list[PointCloudMap], radars: list[RadarConfig]) -> MapBank:
    """Prepare ``maps`` for robots with ``radars`` (completed: ranges set)."""
    reach = max(r.range for r in radars)
    parts = [_prepare(m, reach, radars) for m in maps]
    arrays: dict[str, np.ndarray] = {}
    for name in parts[0]["points"]:  # concatenated runs of points
        arrays[name] = np.concatenate([p["points"][name] for p in parts])
    for name in ("free", "boundary", "occluder"):
        arrays[f"{name}_begin"] = _begins([len(p["points"][name]) for p in parts])
    arrays["cell_begin"] = _begins([len(p["points"]["free_cell"]) for p in parts])[:-1]
    neighbours = [p["neighbour_count"] for p in parts]
    arrays["neighbour_begin"] = _begins(np.concatenate(neighbours))
    arrays["pixel_point_begin"] = _begins(np.concatenate([p["pixel_count"] for p in parts]))
    arrays["point_pixel_begin"] = _begins(np.concatenate([p["shown_count"] for p in parts]))
    arrays["shown_begin"] = _begins([len(p["shown_count"]) for p in parts])[:-1]
    for name in parts[0]["scalars"]:
        arrays[name] = np.stack([np.asarray(p["scalars"][name]) for p in parts])
    return MapBank(
        maps=list(maps),
        arrays=arrays,
        order_free=[p["order_free"] for p in parts],
        order_boundary=[p["order_boundary"] for p in parts],
        max_free=max(len(m.free) for m in maps),
        max_boundary=max(len(m.boundary) for m in maps),
        free_in_range=max(p["bounds"]["free"] for p in parts),
        boundary_in_range=max(p["bounds"]["boundary"] for p in parts),
        occluders_in_range=max(p["bounds"]["occluder"] for p in parts),
    )


def _begins(counts) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _prepare(m: PointCloudMap, reach: float, radars: list[RadarConfig]) -> dict:
    """Everything of one map: sorted points with their grid, neighbours, pixels, scalars, bounds."""
    occluder, radius, outline_max = _occluders(m, radars)
    grid = _Grid.around([m.free, m.boundary, occluder], reach / CELLS_PER_RANGE)
    free_order, free_cell = grid.sort(m.free)
    boundary_order, boundary_cell = grid.sort(m.boundary)
    occluder_order, occluder_cell = grid.sort(occluder)
    free, boundary = m.free[free_order], m.boundary[boundary_order]
    weight, total = _weights(m)
    neighbour_count, neighbour = _neighbours(m, free, boundary, boundary_order)
    frame_origin, pixel = _frame(m.extent)
    pixel_of, point_of = _pixels(m, free, boundary, free_order, boundary_order, frame_origin, pixel)
    is_free = point_of < len(free)
    shared = is_free & (np.bincount(pixel_of[is_free], minlength=PIXELS**2) > 1)[pixel_of]
    clearance = cKDTree(m.boundary).query(free)[0] if len(boundary) else np.full(len(free), np.inf)
    (x0, y0), (x1, y1) = m.extent
    return {
        "points": {
            "free": free,
            "free_weight": weight[free_order],
            "free_clearance": np.minimum(clearance, 1e30).astype(np.float32),
            "free_cell": free_cell,
            "boundary": boundary,
            "boundary_cell": boundary_cell,
            "neighbour": neighbour,
            "occluder": occluder[occluder_order],
            "occluder_radius": radius[occluder_order],
            "occluder_cell": occluder_cell,
            "pixel_point": point_of[np.argsort(pixel_of, kind="stable")],
            "point_pixel": np.where(shared, pixel_of + PIXEL_SHARED, pixel_of)[np.argsort(point_of, kind="stable")],
        },
        "scalars": {
            "total_weight": np.int32(total),
            "resolution": np.float32(m.resolution),
            "outline_radius_max": np.float32(outline_max),
            "occluder_radius_max": radius.max(initial=0.0),
            "cell_origin": np.float32(grid.origin),
            "cell_size": np.float32(grid.size),
            "cells_x": np.int32(grid.shape[0]),
            "cells_y": np.int32(grid.shape[1]),
            "lower": np.float32([x0, y0]),
            "upper": np.float32([x1, y1]),
            "frame_origin": np.float32(frame_origin),
            "pixel_size": np.float32(pixel),
        },
        "neighbour_count": neighbour_count,
        "pixel_count": np.bincount(pixel_of, minlength=PIXELS * PIXELS),
        "shown_count": np.bincount(point_of, minlength=len(free) + len(boundary)),
        "order_free": free_order,
        "order_boundary": boundary_order,
        "bounds": {
            "free": grid.most_in_range(free_cell, reach),
            "boundary": grid.most_in_range(boundary_cell, reach),
            "occluder": grid.most_in_range(occluder_cell, reach),
        },
    }


def _occluders(m: PointCloudMap, radars: list[RadarConfig]) -> tuple[np.ndarray, np.ndarray, float]:
    """Points that mask and their radii. Where the radius closes the gaps, the boundary suffices."""
    settings = {r.obstacle_radius for r in radars}
    if len(settings) > 1:
        raise ValueError("radar.obstacle_radius must be the same for all robots of a team: it belongs to the map")
    radius = settings.pop()
    closing_obstacles = m.obstacle_spacing / math.sqrt(2.0)
    closing_boundary = m.boundary_spacing / math.sqrt(2.0)
    if radius == "auto":
        return m.boundary, closing_boundary.astype(np.float32), 1e30
    if bool((radius >= closing_boundary * (1.0 - 1e-6)).all()) and len(m.boundary):
        return m.boundary, np.full(len(m.boundary), radius, np.float32), float(radius)
    return m.obstacles, np.full(len(closing_obstacles), radius, np.float32), float(radius)


@dataclass
class _Grid:
    """Regular cells over the points of a map."""

    origin: np.ndarray
    size: float
    shape: tuple[int, int]

    @classmethod
    def around(cls, clouds: list[np.ndarray], size: float) -> "_Grid":
        points = np.concatenate([c[:, :2] for c in clouds if len(c)]).astype(np.float64)
        low, high = points.min(0), points.max(0)
        # No more cells than about twice the points: a tiny range on a huge map must not exhaust memory.
        size = max(size, math.sqrt(float(np.prod(high - low + size)) / (2.0 * len(points) + 64.0)))
        shape = np.floor((high - low) / size).astype(int) + 1
        return cls(low, size, (int(shape[0]), int(shape[1])))

    def sort(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Order of the points by cell (stable), and where each cell's run starts (with a closing entry)."""
        # float32 as in the kernels, so that a point lies in the cell they look for it in
        q = np.floor((points[:, :2] - np.float32(self.origin)) / np.float32(self.size)).astype(int)
        q = np.clip(q, 0, np.array(self.shape) - 1)
        cell = q[:, 1] * self.shape[0] + q[:, 0]
        order = np.argsort(cell, kind="stable")
        counts = np.bincount(cell, minlength=self.shape[0] * self.shape[1])
        return order, _begins(counts)

    def most_in_range(self, starts: np.ndarray, reach: float) -> int:
        """Upper bound of how many points a disc of radius ``reach`` can hold anywhere."""
        counts = np.diff(starts).reshape(self.shape[1], self.shape[0])
        k = int(math.ceil(reach / self.size)) + 1
        sums = np.zeros((counts.shape[0] + 1, counts.shape[1] + 1), dtype=np.int64)
        sums[1:, 1:] = counts.cumsum(0).cumsum(1)
        y, x = np.arange(counts.shape[0])[:, None], np.arange(counts.shape[1])[None]
        y0, y1 = np.maximum(y - k, 0), np.minimum(y + k + 1, counts.shape[0])
        x0, x1 = np.maximum(x - k, 0), np.minimum(x + k + 1, counts.shape[1])
        return int((sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]).max())


def _weights(m: PointCloudMap) -> tuple[np.ndarray, int]:
    """Integer weights proportional to spacing squared: 1 for even density, in 16ths of the finest else."""
    area = m.free_spacing.astype(np.float64) ** 2
    unit = area.min()
    weight = np.ones(len(area)) if np.allclose(area, unit, rtol=1e-4) else np.round(16.0 * area / unit)
    total = weight.sum()
    if total >= 2**31:
        raise ValueError(
            f"map {m.name}: spacings from {m.free_spacing.min():g} to {m.free_spacing.max():g} m differ too much "
            "to weigh: bring them closer together"
        )
    return weight.astype(np.int32), int(total)


def _neighbours(m: PointCloudMap, free, boundary, boundary_order) -> tuple[np.ndarray, np.ndarray]:
    """Boundary points that lie within 1.5 of their spacings of every free point, as counts and one run."""
    if not len(boundary):
        return np.zeros(len(free), np.int64), np.zeros(0, np.int32)
    reach = BOUNDARY_REACH * np.maximum(m.resolution, m.boundary_spacing[boundary_order]) * (1.0 + 1e-5)
    lists = cKDTree(free).query_ball_point(boundary, reach)
    walls = np.repeat(np.arange(len(boundary), dtype=np.int32), [len(x) for x in lists])
    points = np.concatenate([np.asarray(x, dtype=np.int64) for x in lists])
    return np.bincount(points, minlength=len(free)), walls[np.argsort(points, kind="stable")]


def _frame(extent) -> tuple[np.ndarray, float]:
    """Centre of pixel (0, 0) and pixel size [m] of the square frame with a margin around the extent."""
    low, high = np.array(extent[0], dtype=np.float64), np.array(extent[1], dtype=np.float64)
    side = max(float((high - low).max()), 1e-6) * (1.0 + 2.0 * FRAME_MARGIN)
    pixel = side / PIXELS
    return 0.5 * (low + high) - 0.5 * side + 0.5 * pixel, pixel


def _pixels(m, free, boundary, free_order, boundary_order, origin, pixel) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (pixel, point): a pixel shows the points nearest to its centre; between points, an empty one the nearest.

    Points are numbered free first, then boundary.
    """
    points = np.concatenate([free[:, :2], boundary[:, :2]]).astype(np.float64)
    code = np.arange(len(points), dtype=np.int32)
    spacing = np.concatenate([m.free_spacing[free_order], m.boundary_spacing[boundary_order]])
    at = np.clip(np.floor((points - origin) / pixel + 0.5).astype(int), 0, PIXELS - 1)
    index = at[:, 0] * PIXELS + at[:, 1]
    empty = np.setdiff1d(np.arange(PIXELS * PIXELS), index)
    centres = origin + pixel * np.stack([empty // PIXELS, empty % PIXELS], axis=1)
    distance, nearest = cKDTree(points).query(centres)
    # Within half a spacing's diagonal of a point, a pixel lies between points rather than outside the map.
    between = distance <= spacing[nearest] / math.sqrt(2.0) * (1.0 + 1e-6)
    index = np.concatenate([index, empty[between]]).astype(np.int32)
    return index, np.concatenate([code, code[nearest[between]]])
