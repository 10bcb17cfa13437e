"""Static raster of a map: which point each pixel shows, computed once per map and picture size.

A frame then only looks up one colour per point, so drawing costs the same for 1,000 and for 200,000 points.
Pictures have x to the right and y up; sizes are in pixels, positions in metres.
"""

import weakref
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

REACH = 0.75  # a point paints pixels up to this share of its spacing away: no holes in rotated, jittered clouds
MARGIN = 0.02  # free border around the map, as a share of its longer side
_CACHE_SIZE = 16


@dataclass(frozen=True)
class MapRaster:
    """Pixel ownership of one map at one picture size.

    ``owner`` int32 (height, width) is an index into a colour table of ``1 + free + boundary + 1`` rows:
    nothing, the free points, the boundary points, and all obstacle points that touch no free space.
    ``scale`` is in pixels per metre; ``corner`` (x, y) [m] is the upper left corner of the picture.
    """

    owner: np.ndarray
    scale: float
    corner: tuple[float, float]
    num_free: int
    num_boundary: int

    @property
    def height(self) -> int:
        return self.owner.shape[0]

    @property
    def width(self) -> int:
        return self.owner.shape[1]

    def to_pixels(self, positions) -> np.ndarray:
        """Positions (..., 2) [m] to pixel coordinates (..., 2), column then row, float64."""
        positions = np.asarray(positions, dtype=np.float64)
        return (positions - self.corner) * (self.scale, -self.scale)

    def paint(self, table: np.ndarray) -> np.ndarray:
        """Colours of the picture, uint8 (height, width, 3), from a colour ``table`` uint8 (entries, 3)."""
        packed = np.zeros(len(table), dtype=np.uint32)
        packed.view(np.uint8).reshape(-1, 4)[:, :3] = table
        image = np.take(packed, self.owner)
        return image.view(np.uint8).reshape(self.height, self.width, 4)[..., :3]


_cache: OrderedDict[tuple[int, int], tuple[weakref.ref, MapRaster]] = OrderedDict()


def map_raster(map, size: int) -> MapRaster:
    """Raster of a :class:`PointCloudMap`, ``size`` pixels wide and at most as high; kept for the last few maps."""
    key = (id(map), size)
    if key in _cache and _cache[key][0]() is map:  # an id is reused once its map is gone
        _cache.move_to_end(key)
        return _cache[key][1]
    raster = _build(map, size)
    _cache[key] = (weakref.ref(map), raster)
    if len(_cache) > _CACHE_SIZE:
        _cache.popitem(last=False)
    return raster


def _build(map, size: int) -> MapRaster:
    (xmin, ymin), (xmax, ymax) = map.extent
    border = MARGIN * max(xmax - xmin, ymax - ymin) + REACH * float(np.max(map.free_spacing))
    span = np.array([xmax - xmin, ymax - ymin]) + 2.0 * border
    scale = size / span.max()
    width, height = size, max(int(np.ceil(span[1] * scale - 1e-6)), 8)
    corner = (float(0.5 * (xmin + xmax) - 0.5 * size / scale), float(ymax + border))

    hidden = _without(map.obstacles, map.boundary)
    spacing_hidden = np.asarray(map.obstacle_spacing)[hidden]
    centers = _pixel_centers(width, height, scale, corner)
    free, free_far = _nearest(map.free, map.free_spacing, centers)
    edge, edge_far = _nearest(map.boundary, map.boundary_spacing, centers)
    solid, solid_far = _nearest(map.obstacles[hidden], spacing_hidden, centers)

    num_free, num_boundary = len(map.free), len(map.boundary)
    owner = np.zeros(len(centers), dtype=np.int32)
    best = np.full(len(centers), REACH)
    for far, index in (
        (edge_far, 1 + num_free + edge),
        (solid_far, np.full_like(solid, 1 + num_free + num_boundary)),
        (free_far, 1 + free),
    ):
        wins = far < best
        owner[wins], best[wins] = index[wins], far[wins]
    owner = owner.reshape(height, width)
    raster = MapRaster(owner, float(scale), corner, num_free, num_boundary)
    # Points denser than pixels: a pixel that holds an obstacle is obstacle, or thin walls would vanish.
    _stamp(raster, map.obstacles[hidden], np.full(len(spacing_hidden), 1 + num_free + num_boundary))
    _stamp(raster, map.boundary, 1 + num_free + np.arange(num_boundary))
    owner.setflags(write=False)
    return raster


def _pixel_centers(width: int, height: int, scale: float, corner) -> np.ndarray:
    """World positions (height * width, 2) [m] of the pixel centres, row by row from the top."""
    columns = corner[0] + (np.arange(width) + 0.5) / scale
    rows = corner[1] - (np.arange(height) + 0.5) / scale
    return np.stack([np.tile(columns, height), np.repeat(rows, width)], axis=1)


def _nearest(points, spacing, centers) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel the point nearest in units of its spacing: index and that distance (inf: none)."""
    nearest, share = np.zeros(len(centers), dtype=np.int64), np.full(len(centers), np.inf)
    spacing = np.asarray(spacing, dtype=np.float64)
    levels = np.rint(2.0 * np.log2(spacing)).astype(int)  # a search per density, or fine hides coarse
    for level in np.unique(levels):
        members = np.flatnonzero(levels == level)
        distance, index = cKDTree(np.asarray(points)[members, :2]).query(
            centers, p=np.inf, distance_upper_bound=REACH * spacing[members].max()
        )  # the maximum norm: lattice points paint squares
        found = np.flatnonzero(index < len(members))
        point = members[index[found]]
        closer = distance[found] / spacing[point] < share[found]
        found, point = found[closer], point[closer]
        nearest[found], share[found] = point, distance[found] / spacing[point]
    return nearest, share


def _without(points, others) -> np.ndarray:
    """Mask (points,) of the points that do not occur, exactly, among ``others``."""
    known = {row.tobytes() for row in np.ascontiguousarray(others, dtype=np.float32)}
    rows = np.ascontiguousarray(points, dtype=np.float32)
    return np.fromiter((row.tobytes() not in known for row in rows), dtype=bool, count=len(rows))


def _stamp(raster: MapRaster, points, entries: np.ndarray) -> None:
    """Give each point's own pixel to its table entry."""
    if len(points) == 0:
        return
    column, row = np.floor(raster.to_pixels(np.asarray(points)[:, :2])).astype(int).T
    inside = (column >= 0) & (column < raster.width) & (row >= 0) & (row < raster.height)
    raster.owner[row[inside], column[inside]] = entries[inside]
