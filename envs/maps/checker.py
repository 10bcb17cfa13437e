"""Checks a map before a team is sent into it, and repairs what can be repaired."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import BOUNDARY_REACH, MapError, PointCloudMap, find_boundary
from maexp.envs.maps.reachability import (
    ROOM_LIMIT,
    Raster,
    count_room,
    find_leaks,
    find_reach,
    label_components,
    visible_free,
)
from maexp.envs.scenarios import find_scenario
from maexp.kernels.state import axis_sizes, memory_per_env
from maexp.kernels.types import PICTURE_CHANNELS, PIXELS, START_CLEARANCE, TEAM_CHANNELS

SEAL_ROUNDS = 4
VISIBLE_SHARE = 0.95  # below it no episode can reach the coverage that ends it
BOUNDARY_SHARE = 0.95  # of the obstacle points that touch free space must be boundary points


@dataclass
class MapReport:
    """Verdict on a map. `ok` says whether a team can explore it; lengths in metres."""

    name: str
    scenario: str
    resolution: float
    extent: tuple[tuple[float, float], tuple[float, float]]
    num_free: int
    num_obstacles: int
    num_boundary: int
    free_area: float  # [m^2]
    components: list[int]  # free points of each connected piece, largest first
    sealed: bool
    leaks: int  # free points from which a ray may leave
    room: int  # robots that surely find a start; counted up to ROOM_LIMIT
    num_robots: int
    start_clearance: float  # [m]
    starts_cut_off: int  # starts from which a robot cannot reach the rest
    visible_share: float  # of the free points, from places robots can reach
    memory_per_env: int  # bytes, for num_robots
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.errors

    @property
    def verdict(self) -> str:
        if self.errors:
            return "unusable"
        return "usable, with warnings" if self.warnings else "good"

    def table(self) -> str:
        """The report as text: one line a finding."""
        (xmin, ymin), (xmax, ymax) = self.extent
        room = f"at least {self.room}" if self.room >= ROOM_LIMIT else str(self.room)
        pieces = ", ".join(f"{size:,}" for size in self.components[:5])
        rows = [
            ("map", f"{self.name} (scenario {self.scenario})"),
            ("verdict", self.verdict),
            ("points", f"{self.num_free:,} free, {self.num_obstacles:,} obstacle, {self.num_boundary:,} boundary"),
            ("resolution", f"{self.resolution:g} m"),
            ("extent", f"{xmax - xmin:.1f} x {ymax - ymin:.1f} m, from ({xmin:.1f}, {ymin:.1f})"),
            ("free area", f"{self.free_area:,.1f} m2"),
            ("components", f"{len(self.components)} (free points: {pieces}{' ...' * (len(self.components) > 5)})"),
            ("sealed", "yes" if self.sealed else f"no: rays leave from {self.leaks:,} free points"),
            ("room", f"{room} robots, starts {self.start_clearance:g} m from walls and each other"),
            ("visible", f"{self.visible_share:.1%} of the free points, from where robots can go"),
            ("memory per env", f"{self.memory_per_env / 2**20:.2f} MiB for {self.num_robots} robots"),
        ]
        lines = [f"{name:<14}  {text}" for name, text in rows]
        lines += [f"error: {text}" for text in self.errors]
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def check_map(
    world: PointCloudMap,
    *,
    num_robots: int = 3,
    start_clearance: float | None = None,
    radar_range: float | None = None,
    threshold: float | None = None,
) -> MapReport:
    """Whether a team can explore `world`, and what it is made of.

    Args:
        world: the map.
        num_robots: size of the team.
        start_clearance: distance of starts from walls and from each other [m]; default 3 x `threshold`.
        radar_range: [m]; default: the scenario's.
        threshold: distance at which a robot collides [m]; default: the scenario's.

    Raises:
        ValueError: the map names a scenario that does not exist.
    """
    scenario = find_scenario(world.scenario)
    threshold = scenario.collision_threshold if threshold is None else threshold
    start_clearance = START_CLEARANCE * threshold if start_clearance is None else start_clearance
    radar_range = scenario.radar_range if radar_range is None else radar_range

    components = np.bincount(label_components(world.free, world.free_spacing)).tolist()
    leaks = find_leaks(world).free
    starts = find_starts(world, start_clearance)
    reach = find_reach(world, threshold, starts)
    report = MapReport(
        name=world.name,
        scenario=world.scenario,
        resolution=world.resolution,
        extent=world.extent,
        num_free=len(world.free),
        num_obstacles=len(world.obstacles),
        num_boundary=len(world.boundary),
        free_area=world.free_area,
        components=components,
        sealed=not len(leaks),
        leaks=len(leaks),
        room=count_room(starts, start_clearance),
        num_robots=num_robots,
        start_clearance=start_clearance,
        starts_cut_off=int((~reach.connected).sum()),
        visible_share=float(visible_free(world, reach.places, radar_range).mean()),
        memory_per_env=estimate_memory(world, num_robots, radar_range),
    )
    _judge(report, world)
    report.errors += _too_coarse(world, radar_range)
    return report


def _too_coarse(world: PointCloudMap, radar_range: float) -> list[str]:
    """The error of a map whose points lie farther apart than a radar reaches; else nothing."""
    if radar_range >= world.resolution:
        return []
    return [
        f"a radar of {radar_range:g} m does not reach from one point to the next, {world.resolution:g} m away: "
        "check the units, or use a finer resolution"
    ]


def find_starts(world: PointCloudMap, start_clearance: float) -> np.ndarray:
    """Free points [m] at least `start_clearance` [m] from every boundary point, [count, 3]."""
    if not len(world.boundary):
        return world.free
    away, _ = cKDTree(world.boundary[:, :2]).query(world.free[:, :2])
    return world.free[away >= start_clearance * (1 - 1e-6)]


def estimate_memory(world: PointCloudMap, num_robots: int, radar_range: float, track: int = 1000) -> int:
    """Bytes one env of `num_robots` takes on this map: state and scratch of the kernels, and the observation twice.

    `track`: poses of a robot's trajectory that are kept.
    """
    in_range = [_count_in_range(points, world.free, radar_range) for points in (world.free, world.boundary)]
    sizes = axis_sizes(
        1, num_robots, len(world.free), len(world.boundary), *in_range, in_range[1], track, limited=False
    )
    pictures = 2 * (PICTURE_CHANNELS * num_robots + TEAM_CHANNELS) * PIXELS**2
    return sum(memory_per_env(sizes).values()) + pictures


def _count_in_range(points: np.ndarray, places: np.ndarray, radius: float) -> int:
    """The most `points` [m] that lie within `radius` [m] of one of some 500 `places` [m]."""
    if not len(points):
        return 0
    some = places[:: max(1, len(places) // 500), :2]
    return int(cKDTree(points[:, :2]).query_ball_point(some, radius, return_length=True).max())


def _judge(report: MapReport, world: PointCloudMap) -> None:
    """Fills in errors (no team can use the map) and warnings."""
    errors, warnings = report.errors, report.warnings
    if len(report.components) > 1:
        rest = sum(report.components[1:])
        errors.append(
            f"free space is in {len(report.components)} pieces ({rest:,} points outside the largest): repair the map"
        )
    if not report.sealed:
        errors.append(f"rays leave the map from {report.leaks:,} free points: repair the map, or add walls")
    if report.room < report.num_robots:
        errors.append(
            f"there is room for {report.room} of num_robots={report.num_robots} robots, {report.start_clearance:g} m "
            "from walls and each other: use fewer or smaller robots, or a finer resolution"
        )
    if not _boundary_fits(world):
        errors.append("the boundary points are not the obstacle points that touch free space: repair the map")
    both = int(np.isin(_as_rows(world.free), _as_rows(world.obstacles)).sum())
    if both:
        errors.append(f"{both:,} points are free and obstacle at once: repair the map")
    if report.starts_cut_off:
        warnings.append(
            f"{report.starts_cut_off:,} starts lie behind gaps too narrow for a robot: repair the map with close_gaps"
        )
    if report.visible_share < VISIBLE_SHARE:
        warnings.append(
            f"only {report.visible_share:.1%} of the free points can be seen from where robots can go, so no episode "
            f"reaches {VISIBLE_SHARE:.0%}: drop what lies behind narrow gaps"
        )


def repair_map(
    world: PointCloudMap,
    *,
    close_gaps: bool = True,
    threshold: float | None = None,
    start_clearance: float | None = None,
) -> tuple[PointCloudMap, list[str]]:
    """A map that passes the checker, as far as dropping and adding points can help; and what was done.

    Free points that are obstacles too go; so do, with `close_gaps`, free points behind gaps too narrow for a
    robot that collides at `threshold` [m] (default: the scenario's). The largest connected piece stays, free points
    that no robot can see go where they are more than 5 %, and obstacle points close the map where rays leave. Exact
    duplicates never enter a map.
    """
    scenario = find_scenario(world.scenario)
    threshold = scenario.collision_threshold if threshold is None else threshold
    start_clearance = START_CLEARANCE * threshold if start_clearance is None else start_clearance
    if hopeless := _too_coarse(world, scenario.radar_range):
        raise MapError(f"{world.name}: {hopeless[0]}")
    steps = []
    if not _boundary_fits(world):
        world = _replace(world)
        steps.append("found the boundary points anew")
    both = np.isin(_as_rows(world.free), _as_rows(world.obstacles))
    if both.any():
        world = _replace(world, free_mask=~both)
        steps.append(f"dropped {both.sum():,} free points that are obstacles too")
    if close_gaps:
        behind = _find_cut_off(world, threshold, start_clearance)
        if behind.any():
            world = _replace(world, free_mask=~behind)
            steps.append(f"dropped {behind.sum():,} free points behind gaps too narrow for a robot")
    piece = label_components(world.free, world.free_spacing)
    if piece.any():
        world = _replace(world, free_mask=piece == 0)
        steps.append(f"kept the largest of {piece.max() + 1} pieces: dropped {(piece > 0).sum():,} free points")
    unseen = _find_unseen(world, threshold, start_clearance)
    if unseen.any():
        world = _replace(world, free_mask=~unseen)
        steps.append(f"dropped {unseen.sum():,} free points that no robot can see from where it can go")
    for _ in range(SEAL_ROUNDS):  # a winding leak may need a second look
        wall = find_seal(world)
        if not len(wall):
            break
        world = _replace(world, wall=wall)
        steps.append(f"sealed the map with {len(wall):,} obstacle points")
    return world, steps


def find_seal(world: PointCloudMap) -> np.ndarray:
    """Obstacle points [m] that close the map where rays leave; float64 [count, 2], empty if it is sealed.

    A lattice of 0.9 resolutions leaves no place farther than 0.64 from a point of it, less than the radius 0.71 that
    a point blocks; so all its points between 0.75 and 2.1 resolutions from free space close it, and of those only
    the ones next to a way out are needed.
    """
    leaks = find_leaks(world)
    if not len(leaks.free):
        return np.zeros((0, 2))
    unit = world.resolution
    lattice = Raster.around(world, 0.9 * unit, 3 * unit)
    places = lattice.places(np.ones(lattice.shape, dtype=bool))
    away, _ = cKDTree(world.free[:, :2]).query(places, distance_upper_bound=2.1 * unit)  # infinite beyond
    ring = places[(away > 0.75 * unit) & (away < 2.1 * unit)]
    near = round(0.7 * unit / leaks.raster.step) + 1
    way_out = ndimage.binary_dilation(leaks.mouths, np.ones((2 * near + 1, 2 * near + 1)))
    return ring[way_out[leaks.raster.nearest(ring)]]


def _boundary_fits(world: PointCloudMap) -> bool:
    """Whether the boundary points are about the obstacle points that touch free space: 95 % of them near one another.

    Robots collide with boundary points only, and radars end there.
    """
    touching = find_boundary(world.free, world.obstacles, np.maximum(world.obstacle_spacing, world.resolution))
    wanted = world.obstacles[touching]
    if not len(wanted) or not len(world.boundary):
        return len(wanted) == len(world.boundary)
    missed = cKDTree(world.boundary).query(wanted)[0] > 1e-3 * world.resolution
    odd = cKDTree(wanted).query(world.boundary)[0] > BOUNDARY_REACH * world.resolution
    return missed.mean() <= 1 - BOUNDARY_SHARE and odd.mean() <= 1 - BOUNDARY_SHARE


def _find_cut_off(world: PointCloudMap, threshold: float, start_clearance: float) -> np.ndarray:
    """Free points nearest to places that a robot cannot reach from most starts; bool [free_count]."""
    reach = find_reach(world, threshold, find_starts(world, start_clearance))
    if reach.chosen == 0:
        return np.zeros(len(world.free), dtype=bool)
    index = np.argwhere(reach.piece > 0)
    piece = reach.piece[index[:, 0], index[:, 1]]
    _, nearest = cKDTree(index * reach.raster.step + reach.raster.corner).query(world.free[:, :2])
    return piece[nearest] != reach.chosen


def _find_unseen(world: PointCloudMap, threshold: float, start_clearance: float) -> np.ndarray:
    """Free points that robots cannot see, where they are so many that no episode could end; bool [free_count]."""
    reach = find_reach(world, threshold, find_starts(world, start_clearance))
    if not len(reach.places):
        return np.zeros(len(world.free), dtype=bool)
    unseen = ~visible_free(world, reach.places, find_scenario(world.scenario).radar_range)
    return unseen if unseen.mean() > 1 - VISIBLE_SHARE else np.zeros_like(unseen)


def _replace(world: PointCloudMap, free_mask=None, wall=None) -> PointCloudMap:
    """The map with some of its free points, and `wall` [m] as further obstacle points."""
    if free_mask is None:
        free_mask = np.ones(len(world.free), dtype=bool)
    elif not free_mask.any():
        raise MapError(f"{world.name}: the repair would drop every free point; the map has no room for a robot")
    wall = np.zeros((0, 2)) if wall is None else wall
    spacing = np.full(len(wall), world.resolution, dtype=np.float32)
    floor = 0.0 if world.free_height is None else float(world.free_height.mean())
    return PointCloudMap(
        world.free[free_mask],
        np.concatenate([world.obstacles, np.pad(wall, ((0, 0), (0, 1)))]),
        world.resolution,
        name=world.name,
        scenario=world.scenario,
        free_spacing=world.free_spacing[free_mask],
        obstacle_spacing=np.concatenate([world.obstacle_spacing, spacing]),
        free_height=None if world.free_height is None else world.free_height[free_mask],
        obstacle_height=None
        if world.obstacle_height is None
        else np.concatenate([world.obstacle_height, np.full(len(wall), floor)]),
    )


def _as_rows(points: np.ndarray) -> np.ndarray:
    """Each point as one opaque value, to compare points exactly."""
    return np.ascontiguousarray(points).view("V12").ravel()
