"""Where robots can be on a map, and what they can see from there: geometry behind the checker and the importer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import BOUNDARY_REACH, MapError, PointCloudMap

MAX_RASTER_CELLS = 30_000_000
WIDE = 24  # steps; wider discs are painted row by row
MAX_PAIRS = 100_000_000  # of points that touch; 16 bytes each
ROOM_LIMIT = 64  # teams larger than this are not counted out


def label_components(points: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Number of the connected piece of each point, largest piece first; int [count].

    Two points [m] touch within 1.5 times the larger of their spacings [m].
    """
    planar = points[:, :2].astype(np.float64)
    tree, reach = cKDTree(planar), BOUNDARY_REACH * float(spacing.max()) * (1 + 1e-6)
    count = tree.count_neighbors(tree, reach)
    if count > MAX_PAIRS:
        raise MapError(f"{count:,} pairs of free points lie within {reach:g} m: thin them, or correct the spacing")
    pairs = tree.query_pairs(reach, output_type="ndarray")
    if len(pairs) and spacing.min() < spacing.max():
        reach = BOUNDARY_REACH * np.maximum(spacing[pairs[:, 0]], spacing[pairs[:, 1]]) * (1 + 1e-6)
        pairs = pairs[np.linalg.norm(planar[pairs[:, 0]] - planar[pairs[:, 1]], axis=1) <= reach]
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(len(points), len(points)))
    count, labels = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(labels, minlength=count), kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return rank[labels]


@dataclass(frozen=True)
class Raster:
    """Places every `step` metres: place (i, j) lies at `corner` + step * (i, j)."""

    corner: np.ndarray
    step: float
    shape: tuple[int, int]

    @classmethod
    def around(cls, world: PointCloudMap, step: float, margin: float) -> Raster:
        """Covers all points and `margin` [m] more; the step grows if that needs too many places."""
        points = np.concatenate([world.free[:, :2], world.obstacles[:, :2]]).astype(np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        span = high - low + 2 * margin
        step = max(step, float(np.sqrt(span.prod() / MAX_RASTER_CELLS)))
        corner = low - margin
        anchor = world.free[0, :2]  # places of a lattice map fall on its points
        corner = anchor - np.ceil((anchor - corner) / step) * step
        shape = tuple((np.ceil((high + margin - corner) / step).astype(int) + 1).tolist())
        return cls(corner, step, shape)

    def places(self, mask: np.ndarray) -> np.ndarray:
        return np.argwhere(mask) * self.step + self.corner

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Index pair of the place nearest to each point [m], [count, 2 or 3]."""
        index = np.rint((points[:, :2] - self.corner) / self.step).astype(int)
        index = index.clip(0, np.array(self.shape) - 1)
        return index[:, 0], index[:, 1]

    def paint(self, points: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Places within `radius` [count] of a point [m]; bool, exact for points off the raster too."""
        painted = np.zeros(self.shape, dtype=bool)
        if not len(points):
            return painted
        base = np.floor((points[:, :2].astype(np.float64) - self.corner) / self.step).astype(int)
        limit = np.array(self.shape)
        reach = int(np.ceil(radius.max() / self.step))
        if reach > WIDE:
            return self._paint_wide(points[:, :2].astype(np.float64), radius, base[:, 0], reach)
        for dx in range(-reach, reach + 2):
            for dy in range(-reach, reach + 2):
                index = base + (dx, dy)
                away = np.linalg.norm(index * self.step + self.corner - points[:, :2], axis=1)
                hit = (away <= radius) & (index >= 0).all(axis=1) & (index < limit).all(axis=1)
                painted[index[hit, 0], index[hit, 1]] = True
        return painted

    def _paint_wide(self, points: np.ndarray, radius: np.ndarray, base: np.ndarray, reach: int) -> np.ndarray:
        """The same row by row, where discs are so much larger than the step that place by place takes minutes."""
        rows, columns = self.shape
        ends = np.zeros((rows, columns + 1), dtype=np.int32)  # +1 where a chord of a disc begins, -1 behind its end
        for dx in range(-reach, reach + 2):
            row = base + dx
            half = radius**2 - (row * self.step + self.corner[0] - points[:, 0]) ** 2
            met = (half >= 0) & (row >= 0) & (row < rows)
            row, half, middle = row[met], np.sqrt(half[met]), points[met, 1] - self.corner[1]
            first = np.ceil((middle - half) / self.step).clip(0, columns).astype(int)
            behind = (np.floor((middle + half) / self.step) + 1).clip(0, columns).astype(int)
            behind = np.maximum(first, behind)  # a chord between two places
            np.add.at(ends, (row, first), 1)
            np.add.at(ends, (row, behind), -1)
        return ends.cumsum(axis=1)[:, :-1] > 0


@dataclass(frozen=True)
class Leaks:
    """Where rays can leave a map."""

    free: np.ndarray  # indices of the free points they leave from
    raster: Raster
    mouths: np.ndarray  # places outside the walls that they lead to within a few steps, bool


def find_leaks(world: PointCloudMap) -> Leaks:
    """Free points from which a ray can leave the map between the obstacle points.

    Obstacle points block a disc of spacing / sqrt(2), as for the radar. Every ray is a path, so when no path
    leaves, no ray does. (A path may leave where no straight ray could: the verdict errs to the safe side.)
    """
    fine = min(world.resolution, float(world.obstacle_spacing.min(initial=np.inf)))
    raster = Raster.around(world, fine / 2, 4 * world.resolution)
    blocked = raster.paint(world.obstacles, world.obstacle_spacing / np.sqrt(2) * (1 + 1e-4))
    pieces, _ = ndimage.label(~blocked)
    rim = np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])
    outside = np.isin(pieces, np.unique(rim[rim > 0]))
    inside = raster.paint(world.free, 0.75 * world.free_spacing) & outside
    mouths = ndimage.binary_dilation(inside, iterations=6, mask=outside) & ~inside
    return Leaks(np.flatnonzero(outside[raster.nearest(world.free)]), raster, mouths)


@dataclass(frozen=True)
class Reach:
    """Where robots can drive: `piece` numbers the connected pieces, 0 = no place for a robot's centre."""

    raster: Raster
    piece: np.ndarray
    chosen: int  # the piece most starts lie in; 0: none
    connected: np.ndarray  # whether each start lies in it, bool [starts]

    @property
    def places(self) -> np.ndarray:
        """Places of the chosen piece [m], [places, 2]."""
        return self.raster.places((self.piece == self.chosen) & (self.piece > 0))


def find_reach(world: PointCloudMap, clearance: float, starts: np.ndarray) -> Reach:
    """Where a robot's centre can drive from `starts` [m], keeping `clearance` [m] from the boundary points.

    Nothing drives between neighbouring boundary points, however far apart they stand.
    """
    step = world.resolution / np.ceil(world.resolution / max(min(world.resolution / 2, clearance), 1e-3))
    raster = Raster.around(world, step, world.resolution)
    inside = raster.paint(world.free, 0.75 * world.free_spacing)
    walls = np.maximum(clearance * (1 - 1e-6), 0.6 * world.boundary_spacing)
    pieces, count = ndimage.label(inside & ~raster.paint(world.boundary, walls))
    piece = pieces[raster.nearest(starts)] if len(starts) else np.zeros(0, dtype=int)
    votes = np.bincount(piece, minlength=count + 1)
    votes[0] = 0
    chosen = int(votes.argmax())
    return Reach(raster, pieces, chosen, (piece == chosen) & (piece > 0))


def count_room(starts: np.ndarray, distance: float, limit: int = ROOM_LIMIT) -> int:
    """How many robots surely find a start, `distance` [m] apart, however the earlier ones were drawn.

    Up to a few thousand starts: each robot in turn takes the start that spoils most of those left. More: each spoils
    at most a disc, so the area gives a bound. At most `limit`.
    """
    if not len(starts):
        return 0
    tree = cKDTree(starts[:, :2])
    if len(starts) > 4000:
        largest = int(tree.query_ball_point(starts[:: len(starts) // 2000, :2], distance, return_length=True).max())
        return min(limit, len(starts) // largest)
    near = tree.sparse_distance_matrix(tree, distance * (1 - 1e-6), output_type="coo_matrix")
    spoils = near.tocsr().astype(bool) + coo_matrix((np.ones(len(starts), bool), [np.arange(len(starts))] * 2))
    spoils = spoils.tocsr()
    left = np.ones(len(starts), dtype=bool)
    room = 0
    while left.any() and room < limit:
        cost = np.where(left, spoils @ left.astype(np.int32), -1)
        left[spoils[int(cost.argmax())].indices] = False
        room += 1
    return room


def visible_free(world: PointCloudMap, places: np.ndarray, radar_range: float) -> np.ndarray:
    """Which free points a radar of `radar_range` [m] sees from at least one of `places` [m]; bool [free_count].

    The radar's criterion with obstacle radius = spacing / sqrt(2). Looks from places spread over the map,
    then, for the points still unseen, from places around them: a lower bound that is tight in practice.
    """
    seen = np.zeros(len(world.free), dtype=bool)
    if not len(places) or radar_range < world.resolution:  # the second: millions of places, none in reach of another
        return seen
    scan = _Scan(world, radar_range)
    for place in places[_spread(places, radar_range / 3)]:
        scan.look(place, seen)
    tree = cKDTree(places)
    for rank in (1, 4, 16, 64, 256):  # the nearest place, then ever farther ones: other angles into a nook
        unseen = np.flatnonzero(~seen)[:500]
        if rank > len(places) or not len(unseen):
            break
        away, index = tree.query(scan.free[unseen], k=[rank], distance_upper_bound=radar_range)
        for place in np.unique(index[np.isfinite(away)]):
            scan.look(places[place], seen)
    return seen


class _Scan:
    """The radar's test, from one place at a time."""

    def __init__(self, world: PointCloudMap, radar_range: float):
        self.free = world.free[:, :2].astype(np.float64)
        self._walls = world.boundary[:, :2].astype(np.float64)
        self._radius = world.boundary_spacing.astype(np.float64) / np.sqrt(2)
        self._free_tree = cKDTree(self.free)
        self._wall_tree = cKDTree(self._walls) if len(self._walls) else None
        self._range = radar_range

    def look(self, place: np.ndarray, seen: np.ndarray) -> None:
        """Marks in `seen` the points visible from `place` [m]; tests only those not marked yet."""
        index = np.array(self._free_tree.query_ball_point(place, self._range), dtype=np.int64)
        index = index[~seen[index]] if len(index) else index
        if not len(index):
            return
        walls = self._wall_tree.query_ball_point(place, self._range) if self._wall_tree else []
        to_free = self.free[index] - place
        to_wall = self._walls[walls] - place
        free_away, wall_away = np.linalg.norm(to_free, axis=1), np.linalg.norm(to_wall, axis=1)
        real = wall_away > 0
        to_wall, wall_away = to_wall[real], wall_away[real]
        sine = np.minimum(1.0, self._radius[walls][real] / wall_away)
        cosine = np.minimum(1 - 1e-3, np.sqrt(1 - sine**2))
        inside = to_free @ (to_wall / wall_away[:, None]).T > cosine * free_away[:, None]
        masked = (inside & (wall_away < free_away[:, None] + 1e-6)).any(axis=1)
        seen[index[~masked]] = True


def _spread(places: np.ndarray, distance: float) -> np.ndarray:
    """Indices of one place in every square of side `distance` [m]: the one nearest to its middle."""
    cell = np.floor(places / distance).astype(np.int64)
    away = np.square(places / distance - cell - 0.5).sum(axis=1)
    order = np.lexsort((away, cell[:, 1], cell[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(cell[order], axis=0) != 0).any(axis=1)
    return order[first]
