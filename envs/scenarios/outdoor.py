"""Outdoor tiles of 288 m: streets, blocks of buildings, trees, water and open ground over rolling terrain.

Streets and blocks are laid out in bent street coordinates (u, v) [m], turned against the lattice, as towns are.
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios.lattice import grid_points, largest_component, make_generator, wall_points

SIZE = 288.0  # [m]
RESOLUTIONS = (1.5, 1.6, 1.8, 2.0)  # [m]; each divides the tile
DRIVABLE_CLEARANCE = 2.25  # [m]: three collision thresholds, what a start needs
CAR_WIDTH = 1.5  # [m]: two collision thresholds; points of a wall farther apart let a car through
WATER = -3.0  # height of a pond or river [m]: obstacles, though below ground
STEEPEST = 0.3  # slope a car climbs

Rect = tuple[float, float, float, float]  # u0, v0, u1, v1


class Landscape:
    """What stands where: `height` [m] above ground of the obstacle over each lattice point, NaN where free.

    Args:
        resolution: lattice spacing [m].
        rng: source of the bend and the angle of the streets, and of everything built later.
    """

    def __init__(self, resolution: float, rng: np.random.Generator):
        self.rng, self.resolution = rng, resolution
        axis = np.arange(round(SIZE / resolution)) * resolution - SIZE / 2
        x, y = np.meshgrid(axis, axis, indexing="ij")
        angle = rng.uniform(-0.4, 0.4)
        u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        bend = rng.uniform(0, 7, size=2)
        wave = rng.uniform(150, 280, size=2) / (2 * np.pi)
        self.u = u + bend[0] * np.sin(v / wave[0])
        self.v = v + bend[1] * np.sin(u / wave[1])
        self.height = np.full(x.shape, np.nan)
        self._discs: list[tuple[float, float, float, float]] = []

    def box(self, rect: Rect, height: float) -> None:
        """A box of `height` [m] on `rect`."""
        self.height[self.inside(rect)] = height

    def inside(self, rect: Rect) -> np.ndarray:
        """Lattice points within `rect`, bool (n, n)."""
        u0, v0, u1, v1 = rect
        return (self.u >= u0) & (self.u <= u1) & (self.v >= v0) & (self.v <= v1)

    def disc(self, u: float, v: float, radius: float, height: float) -> None:
        """A round thing (tree, bush, pond); at least the nearest lattice point, once `plant` has run."""
        self._discs.append((u, v, radius, height))

    def plant(self) -> None:
        """Draw the discs, all at once."""
        if not self._discs:
            return
        discs = np.array(self._discs)
        lattice = cKDTree(np.stack([self.u.ravel(), self.v.ravel()], axis=1))
        distance, nearest = lattice.query(discs[:, :2])
        height = self.height.ravel()
        height[nearest[distance < self.resolution]] = discs[distance < self.resolution, 3]
        for hit, (_, _, _, tall) in zip(lattice.query_ball_point(discs[:, :2], discs[:, 2]), discs, strict=True):
            height[hit] = tall
        self.height = height.reshape(self.height.shape)


def build_outdoor(index: int, *, scenario: str) -> PointCloudMap:
    """Tile `index`: a town centre, a housing estate, a campus or open country at 1.5 to 2 m."""
    rng = make_generator(scenario, index)
    scene = Landscape(RESOLUTIONS[int(rng.integers(len(RESOLUTIONS)))], rng)
    theme = ("centre", "housing", "campus", "country")[int(rng.integers(4))]
    _lay_town(scene, _THEMES[theme])
    ground = _terrain(scene, 14.0 if theme == "country" else 6.0)
    free = _drivable(scene, ground)
    obstacle_height = (ground + np.nan_to_num(scene.height, nan=0.0))[~free]
    between, first = wall_points(free, ~free, scene.resolution, CAR_WIDTH)
    between = np.c_[between, np.zeros(len(between))] * scene.resolution
    return PointCloudMap(
        grid_points(free, scene.resolution),
        np.concatenate([grid_points(~free, scene.resolution), between.astype(np.float32)]),
        scene.resolution,
        name=f"{scenario}_{index}",
        scenario=scenario,
        free_height=ground[free].astype(np.float32),
        obstacle_height=np.concatenate([obstacle_height, obstacle_height[first]]).astype(np.float32),
    )


def _terrain(scene: Landscape, relief: float) -> np.ndarray:
    """Ground height [m] above the lowest point: hills of about 60 m and bumps of about 25 m across."""
    ground = np.zeros(scene.u.shape)
    for scale, share in ((60.0, 1.0), (25.0, 0.15)):
        noise = ndimage.gaussian_filter(scene.rng.standard_normal(ground.shape), scale / scene.resolution)
        ground += share * relief * noise / np.ptp(noise)
    return ground - ground.min()


def _drivable(scene: Landscape, ground: np.ndarray) -> np.ndarray:
    """Free lattice points a car can get to: flat enough, wide enough, in one piece, inside the tile's edge."""
    slope = np.hypot(*np.gradient(ground, scene.resolution))
    free = np.isnan(scene.height) & (slope < STEEPEST)
    free[[0, -1], :] = False
    free[:, [0, -1]] = False
    passable = ndimage.distance_transform_edt(free) * scene.resolution >= DRIVABLE_CLEARANCE
    reach = ndimage.distance_transform_edt(~largest_component(passable)) * scene.resolution
    return largest_component(free & (reach <= 4.0))


def _street_lines(rng: np.random.Generator, spacing: tuple[float, float]) -> list[tuple[float, float]]:
    """Middle and half width [m] of the parallel streets across the tile; every third or so is an avenue."""
    lines = []
    position = -SIZE * 0.8 + rng.uniform(0, spacing[0])
    while position < SIZE * 0.8:
        lines.append((position, rng.uniform(7, 9) if rng.random() < 0.3 else rng.uniform(4, 5.5)))
        position += rng.uniform(*spacing)
    return lines


def _lay_town(scene: Landscape, theme: dict) -> None:
    """Streets with their trees and parked cars, something in every block between them, at times a river."""
    rng = scene.rng
    across, along = _street_lines(rng, theme["spacing"]), _street_lines(rng, theme["spacing"])
    kinds, weights = zip(*theme["blocks"].items(), strict=True)
    for (u0, left), (u1, right) in zip(across, across[1:], strict=False):
        for (v0, low), (v1, high) in zip(along, along[1:], strict=False):
            rect = (u0 + left, v0 + low, u1 - right, v1 - high)
            if max(abs(rect[0] + rect[2]), abs(rect[1] + rect[3])) < 2 * 0.72 * SIZE:
                kinds[int(np.searchsorted(np.cumsum(weights), rng.random() * sum(weights)))](scene, rect)
    for lines, swap in ((across, False), (along, True)):
        for position, half in lines:
            _line_street(scene, position, half, swap, theme["cars"])
    scene.plant()
    if rng.random() < theme["river"]:
        _cut_river(scene, along)


def _line_street(scene: Landscape, position: float, half: float, swap: bool, cars: float) -> None:
    """Trees on both sides of an avenue; cars parked along one side of a narrower street."""
    rng = scene.rng
    step = rng.uniform(12, 18)
    for w in np.arange(-SIZE * 0.72, SIZE * 0.72, step):
        if half > 6:
            for side in (-1, 1):
                u, v = position + side * (half - 1.0), w
                if rng.random() < 0.85:
                    scene.disc(*((v, u) if swap else (u, v)), rng.uniform(0.5, 1.4), rng.uniform(5, 9))
        elif rng.random() < cars:
            u = position + half - 1.2
            car = (u - 1.1, w, u + 1.1, w + 4.6)
            scene.box((car[1], car[0], car[3], car[2]) if swap else car, 1.5)


def _cut_river(scene: Landscape, along: list[tuple[float, float]]) -> None:
    """A river across the tile; two streets in three cross it on a bridge."""
    rng = scene.rng
    middle = rng.uniform(-70, 70) + rng.uniform(5, 15) * np.sin(scene.v / rng.uniform(25, 45) + rng.uniform(0, 6))
    offset = np.abs(scene.u - middle)
    half = rng.uniform(6, 11)
    water = offset < half
    scene.height[(offset < half + 7)] = np.nan  # banks one can drive along
    scene.height[water] = WATER
    for k, (position, street) in enumerate(along):
        if k % 3 != 2:
            scene.height[water & (np.abs(scene.v - position) < street)] = np.nan


def _perimeter(scene: Landscape, rect: Rect) -> None:
    """Closed block around a courtyard, entered through one or two gates."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, rng.uniform(1.5, 3))
    depth = rng.uniform(10, 14)
    if min(u1 - u0, v1 - v0) < 2 * depth + 10:
        scene.box((u0, v0, u1, v1), rng.uniform(10, 22))
        return
    sides = [(u0, v0, u1, v0 + depth), (u0, v1 - depth, u1, v1), (u0, v0, u0 + depth, v1), (u1 - depth, v0, u1, v1)]
    for side in sides:
        scene.box(side, rng.uniform(10, 22))
    court = (u0 + depth, v0 + depth, u1 - depth, v1 - depth)
    for k in np.argsort(rng.random(4))[: 1 + int(rng.integers(2))]:
        gate = rng.uniform(6.5, 9) / 2
        if k < 2:
            at = rng.uniform(court[0] + gate, court[2] - gate)
            hole = (at - gate, sides[k][1], at + gate, sides[k][3])
        else:
            at = rng.uniform(court[1] + gate, court[3] - gate)
            hole = (sides[k][0], at - gate, sides[k][2], at + gate)
        scene.height[scene.inside(hole)] = np.nan
    _trees(scene, _shrink(court, 3), 0.004)
    if rng.random() < 0.4 and court[2] - court[0] > 34:
        middle = (court[0] + court[2]) / 2
        scene.box((middle - 5, court[1], middle + 5, court[1] + 0.5 * (court[3] - court[1])), rng.uniform(4, 8))


def _slabs(scene: Landscape, rect: Rect) -> None:
    """Parallel slab buildings on a lawn with trees."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, rng.uniform(4, 7))
    swap = rng.random() < 0.5
    if swap:
        u0, v0, u1, v1 = v0, u0, v1, u1
    depth, v = rng.uniform(11, 14), v0
    while v + depth <= v1:
        start = u0 + rng.uniform(0, 0.25) * (u1 - u0)
        slab = (start, v, start + rng.uniform(0.6, 0.75) * (u1 - u0), v + depth)
        scene.box((slab[1], slab[0], slab[3], slab[2]) if swap else slab, rng.uniform(12, 30))
        v += depth + rng.uniform(11, 18)
    _trees(scene, rect, 0.003)


def _houses(scene: Landscape, rect: Rect) -> None:
    """Two rows of detached houses, hedges between the plots, trees in the gardens."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, 2)
    middle = (v0 + v1) / 2
    u = u0
    while u + 13 < u1:
        plot = min(rng.uniform(15, 22), u1 - u)
        for side in (-1, 1):
            width, depth = rng.uniform(8, min(13, plot - 3)), rng.uniform(8, 12)
            edge = v0 + rng.uniform(3, 6) if side < 0 else v1 - rng.uniform(3, 6) - depth
            left = u + rng.uniform(1.5, max(1.6, plot - width - 1.5))
            scene.box((left, edge, left + width, edge + depth), rng.uniform(5, 9))
            if rng.random() < 0.5:  # garage
                scene.box((left + width, edge + 2, left + width + 3.2, edge + 8), 2.8)
        if rng.random() < 0.6:  # hedge from the back of the plot towards the houses
            reach = 0.5 * max(0.0, (v1 - v0) / 2 - 18)
            scene.box((u + plot - 0.9, middle - reach, u + plot + 0.9, middle + reach), 1.6)
        u += plot
    if v1 - v0 > 44 and rng.random() < 0.5:  # fenced gardens: no car gets in
        scene.box((u0 + 3, v0 + 15, u1 - 3, v1 - 15), 1.2)
    elif v1 - v0 > 44:  # hedge along the backs
        scene.box((u0 + 8, middle - 0.9, u1 - 8, middle + 0.9), 1.6)
    _trees(scene, (u0, v0 + 14, u1, v1 - 14), 0.006)


def _terraces(scene: Landscape, rect: Rect) -> None:
    """Terraced houses along both long sides, walled gardens between, a passage at times."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, rng.uniform(3, 5))
    if u1 - u0 < v1 - v0:
        _slabs(scene, rect)
        return
    depth, middle = rng.uniform(9, 11), (u0 + u1) / 2 + rng.uniform(-8, 8)
    for left, right in ((u0, middle - 3.5), (middle + 3.5, u1)):
        scene.box((left, v0, right, v0 + depth), rng.uniform(6, 9))
        scene.box((left, v1 - depth, right, v1), rng.uniform(6, 9))
        scene.box((left, v0 + depth, right, v1 - depth), 1.8)


def _big_hall(scene: Landscape, rect: Rect) -> None:
    """One large building of one to three wings, the rest of the block a car park."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, rng.uniform(4, 8))
    cut = u0 + rng.uniform(0.45, 0.6) * (u1 - u0)
    height = rng.uniform(8, 20)
    scene.box((u0, v0, cut, v1 - rng.uniform(0, 0.3) * (v1 - v0)), height)
    if rng.random() < 0.6:
        scene.box((cut, v0, cut + rng.uniform(0.3, 0.6) * (u1 - cut), v0 + rng.uniform(12, 18)), height)
    _car_park(scene, (cut + 6, v0 + 22, rect[2], rect[3]))


def _car_park(scene: Landscape, rect: Rect) -> None:
    """Double rows of parked cars with aisles of 8 m, a tree here and there."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, 3)
    share = rng.uniform(0.4, 0.9)
    v = v0
    while v + 10 <= v1:
        for u in np.arange(u0 + 6, u1 - 8, 2.8):
            for row in (0, 5):
                if rng.random() < share:
                    scene.box((u, v + row, u + 2.2, v + row + 4.6), 1.5)
        scene.disc(u0 + 4, v + 5, 1.0, 5.0)
        scene.disc(u1 - 4, v + 5, 1.0, 5.0)
        v += 18


def _park(scene: Landscape, rect: Rect) -> None:
    """Lawn with groups of trees, a hedge around half of it, at times a pond."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, 3)
    scene.box((u0, v0, u0 + 0.6 * (u1 - u0), v0 + 1.6), 1.4)
    scene.box((u1 - 1.6, v0 + 0.4 * (v1 - v0), u1, v1), 1.4)
    _trees(scene, (u0 + 4, v0 + 4, u1 - 4, v1 - 4), rng.uniform(0.008, 0.016))
    if rng.random() < 0.4:
        u, v, radius = (u0 + u1) / 2, (v0 + v1) / 2, 0.22 * min(u1 - u0, v1 - v0)
        for k in range(4):
            scene.disc(u + rng.uniform(-6, 6), v + rng.uniform(-6, 6), radius * rng.uniform(0.6, 1) + k, WATER)


def _square(scene: Landscape, rect: Rect) -> None:
    """Open square with a large building (church, town hall) and rows of trees."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, 5)
    u, v = (u0 + u1) / 2, (v0 + v1) / 2
    long = 0.3 * min(u1 - u0, v1 - v0)
    scene.box((u - long, v - 7, u + long, v + 7), 15.0)
    scene.box((u + 0.3 * long, v - 12, u + 0.3 * long + 9, v + 12), 15.0)
    scene.box((u - long - 8, v - 4, u - long, v + 4), 35.0)
    for w in np.arange(u0, u1, rng.uniform(8, 11)):
        scene.disc(w, v0, 1.2, 7.0)
        scene.disc(w, v1, 1.2, 7.0)


def _field(scene: Landscape, rect: Rect) -> None:
    """Open ground with a hedgerow on one or two sides and a lone tree."""
    rng = scene.rng
    u0, v0, u1, v1 = _shrink(rect, 2)
    for side in np.argsort(rng.random(4))[: int(rng.integers(1, 3))]:
        cut = rng.uniform(8, 14)
        hedge = [
            (u0 + cut, v0, u1, v0 + 2),
            (u0, v1 - 2, u1 - cut, v1),
            (u0, v0 + cut, u0 + 2, v1),
            (u1 - 2, v0, u1, v1 - cut),
        ][side]
        scene.box(hedge, 2.0)
    _trees(scene, rect, 0.0012)


def _maize(scene: Landscape, rect: Rect) -> None:
    """A field of maize: nothing drives through it or sees through it, but around it."""
    scene.box(_shrink(rect, scene.rng.uniform(3, 8)), 2.2)


def _wood(scene: Landscape, rect: Rect) -> None:
    """Trees with room to drive between them, thicker groves here and there."""
    rng = scene.rng
    inner = _shrink(rect, 3)
    _trees(scene, inner, 0.02)
    for _ in range(4):
        u, v = rng.uniform(inner[0], inner[2]), rng.uniform(inner[1], inner[3])
        for du, dv in rng.normal(0, 5, size=(14, 2)):
            scene.disc(u + du, v + dv, rng.uniform(1.5, 3), rng.uniform(6, 14))


def _farm(scene: Landscape, rect: Rect) -> None:
    """Barns around a yard, fields behind."""
    rng = scene.rng
    u, v = (rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2
    for du, dv, width, depth in ((-22, -6, 12, 28), (-4, 14, 24, 11), (14, -12, 11, 20)):
        du, dv = du + rng.uniform(-3, 3), dv + rng.uniform(-3, 3)
        scene.box((u + du, v + dv, u + du + width, v + dv + depth), rng.uniform(5, 9))
    _field(scene, rect)


def _trees(scene: Landscape, rect: Rect, density: float) -> None:
    """Scatter `density` trees a square metre over `rect`."""
    rng = scene.rng
    u0, v0, u1, v1 = rect
    for _ in range(rng.poisson(density * max(0.0, u1 - u0) * max(0.0, v1 - v0))):
        scene.disc(rng.uniform(u0, u1), rng.uniform(v0, v1), rng.uniform(0.4, 2.2), rng.uniform(4, 12))


def _shrink(rect: Rect, margin: float) -> Rect:
    return rect[0] + margin, rect[1] + margin, rect[2] - margin, rect[3] - margin


_THEMES: dict[str, dict] = {
    "centre": {
        "spacing": (58, 88),
        "cars": 0.25,
        "river": 0.3,
        "blocks": {_perimeter: 5, _slabs: 1, _square: 1, _park: 1, _car_park: 1, _big_hall: 0.6},
    },
    "housing": {
        "spacing": (54, 86),
        "cars": 0.3,
        "river": 0.2,
        "blocks": {_houses: 7, _terraces: 3, _slabs: 1, _park: 1, _car_park: 0.4},
    },
    "campus": {
        "spacing": (72, 110),
        "cars": 0.1,
        "river": 0.2,
        "blocks": {_big_hall: 3, _slabs: 3, _park: 2, _car_park: 1.5, _square: 0.5},
    },
    "country": {
        "spacing": (70, 110),
        "cars": 0.0,
        "river": 0.5,
        "blocks": {_field: 2.5, _maize: 1.5, _wood: 3, _farm: 2, _houses: 1.5},
    },
}
