"""From a labelled grid to a map that passes the checker: resolution, gaps, components, sealing."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.io.grid import FREE, OBSTACLE, UNKNOWN, Grid, close_gaps, keep_component, refine, seal, thin_walls
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport
from maexp.envs.io.sources import Source
from maexp.envs.maps.point_cloud import MapError, PointCloudMap
from maexp.envs.maps.reachability import count_room
from maexp.envs.scenarios import Scenario, find_scenario
from maexp.envs.scenarios.lattice import wall_points
from maexp.kernels.types import START_CLEARANCE

STEPS_DOWN = (1.0, 0.8, 0.6, 0.4, 0.3, 0.2)  # resolutions tried, in units of the scenario's
KEPT_SHARE = 0.85  # a resolution must keep this share of the area a finer one would
CLEANED_CELLS = 6_000_000  # cleaning takes some 200 bytes a cell
POINTS_IN_RANGE = 2.0  # a radar must reach this many points far
LOST_SHARE = 0.2  # of the free space, in other pieces or behind narrow gaps: from here on it is worth a warning
GAP = 2.0  # points farther apart than this many collision thresholds let a robot through


def finish_map(source: Source, scenario: Scenario, name: str, options: ImportOptions, report: ImportReport):
    """The map of a source of grids; raises MapError where no resolution leaves room for the team."""
    if options.resolution is not None:
        cleaned = _Cleaned(_grid_at(source, options.resolution, report), scenario, options)
        _require_room(cleaned, options, scenario)
        reason = "as set"
    else:
        cleaned, reason = _choose_resolution(source, scenario, options, report)
    if (radius := options.robot_radius) is not None:
        told = f"round, {2 * radius:g} m across, collides {radius:g} m and starts {START_CLEARANCE * radius:g} m"
        report.add("robot", f"{told} from walls (robot.radius={radius:g})")
    _tell_of_density(cleaned.start.cell, source, report)
    _warn_of_coarse_cells(cleaned, scenario, options, report)
    report.add("resolution", f"{cleaned.start.cell:g} m a cell, {reason}", after=cleaned.start.labels.size)
    cleaned.tell(report)
    _warn_of_pieces(cleaned, options, report)
    _warn_of_narrow_gaps(cleaned, scenario, options, report)
    return _to_map(cleaned.grid, scenario, name, options, report)


def _grid_at(source: Source, cell: float, report: ImportReport) -> Grid:
    """The place in cells of `cell` [m]: parts of larger ones where the file shows nothing so small.

    Counted anew, points that lie farther apart than the cells would leave holes in walls.
    """
    grid = source.at(max(cell, source.finest))
    if not grid.count(FREE):
        raise MapError(f"{report.path}: no cell of {grid.cell:g} m is free; check units, up, floor and crop")
    return refine(grid, cell)


def _tell_of_density(cell: float, source: Source, report: ImportReport) -> None:
    if cell < source.finest * (1 - 1e-6):
        report.add(
            "density",
            f"the file shows nothing smaller than {source.finest:g} m: walls and floor are found in cells of that "
            f"size and then cut into cells of {cell:g} m",
        )


def _warn_of_coarse_cells(cleaned: _Cleaned, scenario: Scenario, options: ImportOptions, report: ImportReport) -> None:
    """Robots meet walls before they could know of them where points lie farther apart than the threshold."""
    cell, threshold = cleaned.start.cell, scenario.collision_threshold
    if cell <= threshold * (1 + 1e-6):
        return
    if options.resolution is not None:
        what, remedy = f"importing.resolution={cell:g} m is", f"set {threshold:g} or less, or leave it out"
    elif cleaned.start.labels.size * (cell / threshold) ** 2 > CLEANED_CELLS:
        what = f"in a box of this size, of at most {CLEANED_CELLS:,} cells, those of {cell:g} m are"
        remedy = "set importing.crop"
    else:
        needed = math.ceil(1.1 * cleaned.area / threshold**2 / 1000) * 1000
        what = f"with importing.max_points={options.max_points} the cells of {cell:g} m are"
        remedy = f"set importing.max_points={needed}, or importing.crop"
    report.warn(
        f"{what} coarser than {threshold:g} m, the distance at which {_whose(options, scenario)} collides, so "
        f"robots may be lost at ragged walls; {remedy}"
    )


def _warn_of_pieces(cleaned: _Cleaned, options: ImportOptions, report: ImportReport) -> None:
    """Only where nobody has chosen a piece."""
    lost = cleaned.dropped_pieces / cleaned.free_before
    if lost < LOST_SHARE or options.component != "largest":
        return
    report.warn(
        f"{lost:.0%} of the free space is not joined to the largest piece of it, and is left out; if robots start in "
        "another piece, name a place in it with importing.component=[x,y]"
    )


def _warn_of_narrow_gaps(cleaned: _Cleaned, scenario: Scenario, options: ImportOptions, report: ImportReport) -> None:
    lost = (cleaned.dropped_gaps + cleaned.dropped_rest) / (cleaned.free_before - cleaned.dropped_pieces)
    if lost < LOST_SHARE:
        return
    if options.min_passage is not None:
        why = f"importing.min_passage={options.min_passage:g} m, and is left out; set less to keep it"
    else:
        why = f"{cleaned.passage:g} m, too narrow for {_whose(options, scenario)}, and is left out; if yours are "
        why += "smaller, say how large they are with robot.radius"
    report.warn(f"{lost:.0%} of the free space lies behind gaps narrower than {why}")


def _whose(options: ImportOptions, scenario: Scenario) -> str:
    """A robot of whose size the map is for."""
    radius = options.robot_radius
    return f"a robot of scenario={scenario.name}" if radius is None else f"a robot of robot.radius={radius:g}"


def crop_grid(grid: Grid, options: ImportOptions, report: ImportReport) -> Grid:
    """Cuts away everything outside `options.crop` and around the free cells."""
    before = grid.count(FREE)
    if options.crop is not None:
        xmin, ymin, xmax, ymax = options.crop
        corners = grid.to_index(np.array([(x, y) for x in (xmin, xmax) for y in (ymin, ymax)]))
        limit = np.array(grid.labels.shape)
        low = np.floor(corners.min(axis=0)).clip(0, limit).astype(int)
        grid = grid.cut(low, np.maximum(np.ceil(corners.max(axis=0)).clip(0, limit).astype(int), low))
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in grid.labels.shape), indexing="ij")
        place = grid.to_world(np.stack([x, y], axis=-1))
        inside = (place[..., 0] >= xmin) & (place[..., 0] <= xmax)
        inside &= (place[..., 1] >= ymin) & (place[..., 1] <= ymax)
        labels = np.where(inside, grid.labels, UNKNOWN).astype(np.uint8)
        grid = Grid(labels, grid.cell, grid.origin, grid.yaw, grid.height)
        report.add("crop", f"to x {xmin:g} to {xmax:g} m, y {ymin:g} to {ymax:g} m", before, grid.count(FREE))
    if not grid.count(FREE):
        raise MapError(f"{report.path}: no free space is left inside importing.crop={options.crop}; choose another box")
    return grid.trim(4)


class _Cleaned:
    """A grid at one resolution after gaps, components and sealing, with the counts for the report."""

    def __init__(self, grid: Grid, scenario: Scenario, options: ImportOptions):
        if grid.labels.size > CLEANED_CELLS:
            nx, ny = grid.labels.shape
            raise MapError(
                f"{nx} x {ny} cells of {grid.cell:g} m are more than {CLEANED_CELLS:,}: crop, or take a coarser "
                "resolution"
            )
        self.start = grid
        self.passage = options.min_passage
        if self.passage is None:
            self.passage = 2 * scenario.collision_threshold
        self.free_before = grid.count(FREE)
        grid, self.pieces, self.dropped_pieces = keep_component(grid.pad(1), options.component)
        grid, self.dropped_gaps = close_gaps(grid, self.passage / 2, options.component)
        grid, _, self.dropped_rest = keep_component(grid, options.component)
        self.grid, self.sealed = seal(grid)
        self.free = self.grid.count(FREE)
        self.area = self.free * grid.cell**2
        self.room = self._count_room(START_CLEARANCE * scenario.collision_threshold, options.num_robots)

    def _count_room(self, clearance: float, wanted: int) -> int:
        if not self.free:
            return 0
        free = self.grid.centres(self.grid.labels == FREE)
        walls = self.grid.centres(self.grid.labels == OBSTACLE)
        away, _ = cKDTree(walls).query(free, distance_upper_bound=clearance)
        return count_room(free[away >= clearance * (1 - 1e-6)], clearance, max(wanted, 8))

    def tell(self, report: ImportReport) -> None:
        left = self.free_before
        for name, detail, dropped in (
            ("component", f"kept one of {self.pieces} pieces of free space", self.dropped_pieces),
            ("narrow gaps", f"closed gaps narrower than {self.passage:g} m", self.dropped_gaps + self.dropped_rest),
        ):
            report.add(name, detail, left, left - dropped)
            left -= dropped
        report.add("seal", f"{self.sealed:,} unknown cells that touch free space became walls", left, left)


def _choose_resolution(
    source: Source, scenario: Scenario, options: ImportOptions, report: ImportReport
) -> tuple[_Cleaned, str]:
    """The coarsest cells that keep the free area, give the team room, and tell a robot of a wall before it collides.

    Coarse cells swallow doors and narrow rooms: the finest candidate, at most a third of the scenario's
    resolution, tells how much area there is to keep.
    """
    base, threshold = scenario.resolution, scenario.collision_threshold
    sizes = sorted({min(max(base * step, source.finest), threshold) for step in STEPS_DOWN}, reverse=True)
    grid, *_ = keep_component(_grid_at(source, max(sizes[-1], source.finest), report), options.component)
    area = grid.count(FREE) * grid.cell**2
    step = min(0.05, 0.2 * base)
    coarsest = math.ceil(math.sqrt(area / options.max_points) / step) * step
    if coarsest > sizes[0]:
        sizes = [round(coarsest, 3), *(size for size in sizes if size > coarsest / 4)]
    least = math.sqrt(1.02 * grid.labels.size / CLEANED_CELLS) * grid.cell  # finer ones are too many to clean
    sizes = [size for size in sizes if size >= least] or [round(math.ceil(least / step) * step, 3)]
    if sizes[0] * POINTS_IN_RANGE > scenario.radar_range:
        raise MapError(
            f"{report.path}: {area:,.0f} m2 of free space need cells of {sizes[0]:g} m to stay below "
            f"importing.max_points={options.max_points}, too coarse for a radar of {scenario.radar_range:g} m: set "
            "importing.crop, check importing.units, raise importing.max_points, or take an importing.scenario of "
            "larger robots"
        )
    tried = {}

    def clean(size: float) -> _Cleaned:
        if size not in tried:
            tried[size] = _Cleaned(_grid_at(source, size, report), scenario, options)
        return tried[size]

    finest = next((size for size in sizes if size <= max(base, sizes[0]) / 3), sizes[-1])
    goal = KEPT_SHARE * clean(finest).area
    for size in sizes:
        cleaned = clean(size)
        if cleaned.room >= options.num_robots and cleaned.area >= goal:
            share = f"keeps {cleaned.area:,.0f} of the {clean(finest).area:,.0f} m2 a robot can use at {finest:g} m"
            return cleaned, f"the coarsest that {share} and gives {options.num_robots} robots room"
    roomy = [cleaned for cleaned in tried.values() if cleaned.room >= options.num_robots]
    best = max(roomy or tried.values(), key=lambda cleaned: (cleaned.room, cleaned.area))
    _require_room(best, options, scenario)
    return best, "the one that keeps most area"


def _require_room(cleaned: _Cleaned, options: ImportOptions, scenario: Scenario) -> None:
    if cleaned.room >= options.num_robots:
        return
    hint = "use a finer importing.resolution, fewer robots, or check importing.units, up and floor"
    if options.min_passage is not None:
        hint = f"set a smaller importing.min_passage, {hint}"
    if options.robot_radius is not None:
        size, hint = f"a robot of robot.radius={options.robot_radius:g}", f"say a smaller robot.radius, {hint}"
    else:
        size = f"a {scenario.body_length:g} x {scenario.body_width:g} m robot"
        small = find_scenario("indoor_small").body_length
        hint += f", or say how large your robots are, as robot.radius={small / 2:g}" * (scenario.body_length > small)
    raise MapError(
        f"found {cleaned.area:,.1f} m2 of free space that {size} can use at {cleaned.start.cell:g} m, with room for "
        f"{cleaned.room} of num_robots={options.num_robots} (starts "
        f"{START_CLEARANCE * scenario.collision_threshold:g} m from walls and each other); {hint}"
    )


def _to_map(grid: Grid, scenario: Scenario, name: str, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    grid = grid.trim(options.wall_depth + 1)
    before = grid.count(OBSTACLE)
    grid, _ = thin_walls(grid, options.wall_depth)
    report.add("walls", f"kept {options.wall_depth} cells of wall behind the boundary", before, grid.count(OBSTACLE))
    masks = {"free": grid.labels == FREE, "obstacle": grid.labels == OBSTACLE}
    points = {kind: grid.centres(mask) for kind, mask in masks.items()}
    between, first = wall_points(*masks.values(), grid.cell, GAP * scenario.collision_threshold)
    points["obstacle"] = np.concatenate([points["obstacle"], grid.to_world(between + 0.5)])
    if len(between):
        report.add("gaps in walls", "points between those of the walls, or a robot fits through", after=len(between))
    heights = {f"{kind}_height": None if grid.height is None else grid.height[mask] for kind, mask in masks.items()}
    if grid.height is not None:
        heights["obstacle_height"] = np.concatenate([heights["obstacle_height"], heights["obstacle_height"][first]])
    low = points["free"].min(axis=0)
    recentre = options.recentre
    if recentre is None:
        recentre = max(np.abs(cloud).max(initial=0.0) for cloud in points.values()) > 10_000
    if recentre:
        points = {kind: cloud - low for kind, cloud in points.items()}
        report.add("recentre", f"subtracted ({low[0]:.3f}, {low[1]:.3f}) m")
    return PointCloudMap(points["free"], points["obstacle"], grid.cell, name=name, scenario=scenario.name, **heights)
