"""The `wavefront` planner: a waypoint in sight on the shortest way to the goal, for DWA to drive to.

Every few local steps a robot's map is brought up to date and, where the path held so far is blocked or used
up, the distance from the robot is searched over cells not known to be blocked (unknown ones count as
passable) until the goal is reached. A goal inside an obstacle or out of reach is replaced by the reached cell
nearest to it. Every local step the waypoint becomes the farthest cell of the path that is in the robot's
radar range and in sight, drawn nearer where the robot could not brake in time.

A path holds its first `PATH_CELLS` cells only; the search is repeated long before a robot gets there. What is
held never outlives a macro step: a new goal always searches anew.
"""

import numpy as np
import warp as wp

from maexp.kernels.geodesic import SKIP, UNREACHED, DistanceSearch, wp_diagonal, wp_straight
from maexp.kernels.known_grid import KnownGrids, NavGrids, PassableGrids, nav_cell, nav_center
from maexp.kernels.types import Robots, point_xy

PATH_CELLS = 64  # cells of a path that are kept, counted from the robot
SNAP_CELLS = 4  # how far the search may start from a robot that stands on a blocked cell, in cells
MARGIN_CELLS = 0.5  # distance kept from obstacles beyond the collision threshold, in cells

CREEP = 0.5  # least distance of a waypoint that is not the end, in clearances of the robot

wp_creep = wp.constant(CREEP)
wp_path_cells = wp.constant(PATH_CELLS)
wp_snap_cells = wp.constant(SNAP_CELLS)
wp_unreached = wp.constant(wp.int32(UNREACHED))
wp_skip = wp.constant(wp.int32(SKIP))


@wp.func
def is_passable(passable: wp.array2d(dtype=wp.uint8), row: int, cell: int) -> bool:
    return passable[row, cell] != wp.uint8(0)


@wp.func
def nearest_passable(passable: wp.array2d(dtype=wp.uint8), row: int, cell: int, w: int, h: int) -> int:
    """The passable cell nearest to `cell`, at most `SNAP_CELLS` away along x and y; -1 where none is."""
    best = wp.int32(-1)
    best_gap = wp.int32(1 << 30)
    x = cell % w
    y = cell / w
    for v in range(wp.max(y - wp_snap_cells, 0), wp.min(y + wp_snap_cells, h - 1) + 1):
        for u in range(wp.max(x - wp_snap_cells, 0), wp.min(x + wp_snap_cells, w - 1) + 1):
            gap = (v - y) * (v - y) + (u - x) * (u - x)
            if gap < best_gap and is_passable(passable, row, v * w + u):
                best = v * w + u
                best_gap = gap
    return best


@wp.func
def in_sight(passable: wp.array2d(dtype=wp.uint8), row: int, start: int, end: int, w: int) -> bool:
    """Whether every cell that the segment between two cell centres touches, `start` apart, is passable."""
    x = start % w
    y = start / w
    dx = end % w - x
    dy = end / w - y
    nx = wp.abs(dx)
    ny = wp.abs(dy)
    sx = wp.sign(dx)
    sy = wp.sign(dy)
    i = wp.int32(0)
    j = wp.int32(0)
    clear = wp.bool(True)
    while clear and (i < nx or j < ny):
        side = (1 + 2 * i) * ny - (1 + 2 * j) * nx  # which edge the segment crosses first; 0 = the corner
        if side == 0:
            clear = is_passable(passable, row, y * w + x + sx)
            clear = clear and is_passable(passable, row, (y + sy) * w + x)
        if side <= 0:
            x += sx
            i += 1
        if side >= 0:
            y += sy
            j += 1
        clear = clear and is_passable(passable, row, y * w + x)
    return clear


@wp.func
def step_back(distance: wp.array2d(dtype=wp.int32), item: int, cell: int, w: int, h: int) -> int:
    """The neighbour before `cell` on a shortest path from the source, -1 at the source.

    Of several the first counts: east, north, west, south, then north-east, north-west, south-west, south-east.
    """
    x = cell % w
    y = cell / w
    d = distance[item, cell]
    found = wp.int32(-1)
    for k in range(8):
        ux = wp.where(k == 0 or k == 4 or k == 7, 1, wp.where(k == 2 or k == 5 or k == 6, -1, 0))
        uy = wp.where(k == 1 or k == 4 or k == 5, 1, wp.where(k == 3 or k == 6 or k == 7, -1, 0))
        u = x + ux
        v = y + uy
        if found < 0 and u >= 0 and u < w and v >= 0 and v < h:
            weight = wp.where(k < 4, wp_straight, wp_diagonal)
            if distance[item, v * w + u] == d - weight:
                # A diagonal step cuts no corner: both cells beside it are reached (they touch reached cells).
                if k < 4 or (
                    distance[item, y * w + u] < wp_unreached and distance[item, v * w + x] < wp_unreached
                ):
                    found = v * w + u
    return found


@wp.func
def path_slot(j: int, total: int) -> int:
    """Where the j-th cell of a path, counted from the robot, is stored (the path is written from its end)."""
    return (total - 1 - j) % wp_path_cells


@wp.kernel(enable_backward=False)
def _start_search(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),
    # State in:
    active: wp.array(dtype=wp.int32),
    collided: wp.array2d(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
    goal: wp.array2d(dtype=wp.vec2),
    target: wp.array2d(dtype=wp.vec2),
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item]
    path_used: wp.array(dtype=wp.int32),  # [item]
    # Out:
    sources: wp.array2d(dtype=wp.int32),  # [item, 1]
    stop: wp.array(dtype=wp.int32),  # [item]
):
    """Which robots need a new path, from where and to where; the others skip the search."""
    e, i = wp.tid()
    item = e * center.shape[1] + i
    stop[item] = wp_skip
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    w = grids.width[m]
    h = grids.height[m]
    row = row_of_item[item]
    # A goal just set is its own target: then nothing is kept.
    moved = target[e, i] - goal[e, i]
    fresh = moved[0] == 0.0 and moved[1] == 0.0
    total = path_total[item]
    used = path_used[item]
    kept = wp.min(total, wp_path_cells)
    keep = not fresh and used >= 0 and (kept == total or 2 * used < kept)
    if keep:
        for j in range(used, kept):
            if not is_passable(passable, row, path[item, path_slot(j, total)]):
                keep = False
    if not keep:
        start = nearest_passable(passable, row, nav_cell(grids, m, point_xy(center[e, i])), w, h)
        end = nav_cell(grids, m, goal[e, i])
        if not is_passable(passable, row, end):
            end = -1
        sources[item, 0] = start
        stop[item] = end


@wp.kernel(enable_backward=False)
def _trace_path(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),
    # State in:
    goal: wp.array2d(dtype=wp.vec2),
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    stop: wp.array(dtype=wp.int32),  # [item]
    # State out:
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item], cells of the whole path; 0 = none
    path_used: wp.array(dtype=wp.int32),  # [item], how far along it the waypoint is; -1 = out of sight
    path_ends: wp.array(dtype=wp.int32),  # [item], 1 = at the goal, 0 = at the nearest reached cell
):
    """Follows the distances back from the goal, or from the reached cell nearest to it."""
    e, i = wp.tid()
    item = e * goal.shape[1] + i
    if stop[item] == wp_skip:
        return
    m = map_id[e]
    w = grids.width[m]
    h = grids.height[m]
    end = stop[item]
    path_ends[item] = 1
    if end >= 0:
        if distance[item, end] >= wp_unreached:
            end = -1
    if end < 0:
        path_ends[item] = 0
        wanted = nav_cell(grids, m, goal[e, i])
        nearest = wp.int32(1 << 30)
        for cell in range(w * h):
            if distance[item, cell] < wp_unreached:
                x = cell % w - wanted % w
                y = cell / w - wanted / w
                if x * x + y * y < nearest:
                    nearest = x * x + y * y
                    end = cell
    total = wp.int32(0)
    cell = end
    while cell >= 0:
        path[item, total % wp_path_cells] = cell
        total += 1
        cell = step_back(distance, item, cell, w, h)
    path_total[item] = total
    path_used[item] = 0


@wp.func
def clear_ahead(
    e: int,
    i: int,
    way: wp.vec2,
    keep: float,
    collided: wp.array2d(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
) -> float:
    """Room to brake on the straight `way` [m]: its length, or half the gap to a robot that may come closer."""
    room = wp.length(way)
    at = point_xy(center[e, i])
    for other in range(center.shape[1]):
        gap = point_xy(center[e, other]) - at
        if other != i and wp.dot(gap, way) > 0.0:
            free = wp.length(gap) - keep
            if collided[e, other] == 0:
                free = 0.5 * free
            room = wp.min(room, free)
    return wp.max(room, 0.0)


@wp.kernel(enable_backward=False)
def _hold_back(
    # Robots:
    robots: Robots,
    lead_time: float,
    # State in:
    active: wp.array(dtype=wp.int32),
    collided: wp.array2d(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
    # State out:
    target: wp.array2d(dtype=wp.vec2),
):
    """Draws waypoints nearer, so that robots drive no faster than they can brake before the waypoint.

    DWA brakes only for a target that it would pass in its `lead_time` [s], three steps: a target at
    lead_time * v holds it at about the speed v. At least `CREEP` clearances, or it would not get going.
    """
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    at = point_xy(center[e, i])
    way = target[e, i] - at
    keep = 2.0 * robots.clearance[e, i]
    room = clear_ahead(e, i, way, keep, collided, center)
    length = lead_time * wp.sqrt(2.0 * robots.max_accel[e, i] * room) + wp_creep * robots.clearance[e, i]
    full = wp.length(way)
    if full > length:
        target[e, i] = at + way * (length / full)


@wp.kernel(enable_backward=False)
def _pick_waypoint(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),
    # State in:
    active: wp.array(dtype=wp.int32),
    collided: wp.array2d(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
    goal: wp.array2d(dtype=wp.vec2),
    reach: wp.array2d(dtype=wp.float32),  # [env, robot], how far a waypoint may be [m]
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item]
    path_ends: wp.array(dtype=wp.int32),  # [item]
    # State out:
    path_used: wp.array(dtype=wp.int32),  # [item]
    target: wp.array2d(dtype=wp.vec2),
):
    """The farthest cell of the path in reach and in sight; the nearest one where none is; the goal itself
    once its cell is in sight, and where there is no path at all."""
    e, i = wp.tid()
    item = e * center.shape[1] + i
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    w = grids.width[m]
    at = point_xy(center[e, i])
    here = nav_cell(grids, m, at)
    total = path_total[item]
    kept = wp.min(total, wp_path_cells)
    chosen = wp.int32(-1)
    nearest = wp.int32(-1)
    nearest_gap = wp.float32(1.0e30)
    for k in range(kept):
        j = kept - 1 - k
        if chosen < 0:
            cell = path[item, path_slot(j, total)]
            gap = wp.length(nav_center(grids, m, cell) - at)
            if gap < nearest_gap:
                nearest = j
                nearest_gap = gap
            if gap <= reach[e, i]:
                if in_sight(passable, row_of_item[item], here, cell, w):
                    chosen = j
    path_used[item] = chosen
    if chosen < 0:
        chosen = nearest
    if chosen < 0 or (chosen == total - 1 and path_ends[item] == 1):
        target[e, i] = goal[e, i]
    else:
        target[e, i] = nav_center(grids, m, path[item, path_slot(chosen, total)])


class PathSearch:
    """Paths of every robot of a run of envs over `PassableGrids`.

    Args:
        passable: where each robot fits.
        mask_of_robot: which of the masks of its env each robot uses, N numbers.
    """

    def __init__(self, passable: PassableGrids, mask_of_robot: np.ndarray):
        device = passable.passable.device
        rows, cells = passable.passable.shape
        envs, robots = rows // passable.masks, len(mask_of_robot)
        items = envs * robots
        row_of_item = np.arange(envs)[:, None] * passable.masks + np.asarray(mask_of_robot)[None]
        self.passable, self.shape = passable, (envs, robots)
        self.row_of_item = wp.array(row_of_item.reshape(-1), dtype=wp.int32, device=device)
        self.search = DistanceSearch(items, cells, 1, device)
        self.path = wp.zeros((items, PATH_CELLS), dtype=wp.int32, device=device)
        self.path_total, self.path_used, self.path_ends = (
            wp.zeros(items, dtype=wp.int32, device=device) for _ in range(3)
        )

    def find(self, launch, active, collided, center, goal, target) -> None:
        """New paths for the robots that need one."""
        masks, known = self.passable, self.passable.known
        launch(
            _start_search, self.shape,
            [known.grids, known.map_id, active, collided, center, goal, target, masks.passable,
             self.row_of_item, self.path, self.path_total, self.path_used],
            [self.search.sources, self.search.stop],
        )  # fmt: skip
        self.flood(launch)
        self.trace(launch, goal)

    def flood(self, launch) -> None:
        """Distances from `search.sources`, as far as `search.stop`."""
        masks, grids = self.passable, self.passable.known.grids
        self.search.search(
            launch, masks.passable, self.row_of_item, masks.grid_of_row, grids.width, grids.height
        )

    def trace(self, launch, goal) -> None:
        """Paths to the cells of `search.stop`; where that is -1, to the reached cell nearest to `goal`."""
        known = self.passable.known
        launch(
            _trace_path, self.shape,
            [known.grids, known.map_id, goal, self.search.distance, self.search.stop],
            [self.path, self.path_total, self.path_used, self.path_ends],
        )  # fmt: skip

    def pick(self, launch, active, collided, center, goal, reach, target) -> None:
        """Waypoints into `target`."""
        masks, known = self.passable, self.passable.known
        launch(
            _pick_waypoint, self.shape,
            [known.grids, known.map_id, active, collided, center, goal, reach, masks.passable,
             self.row_of_item, self.path, self.path_total, self.path_ends],
            [self.path_used, target],
        )  # fmt: skip


class Wavefront:
    """The planner over one shard of a simulation: recorded launches.

    Attributes:
        field_launches: bring maps and paths up to date; every `replan_steps` local steps.
        waypoint_launches: bring `target` up to date; every local step.
    """

    def __init__(self, sim, shard):
        limited = sim.settings.comm_limited
        self.lead_time = sim.settings.horizon * sim.settings.dt
        self.view, self.robots = shard.view, shard.robots
        threshold = self.robots.threshold.numpy()
        robots = threshold.shape[1]
        if limited:
            radius, mask_of_robot = threshold, np.arange(robots)
        else:
            radius, mask_of_robot = np.unique(threshold, axis=1, return_inverse=True)
        self.known = KnownGrids(
            sim.maps, sim.nav_grids, self.view.map_id, shard.known("free"), shard.known("boundary"),
            robots if limited else 1, sim.nav_cells,
        )  # fmt: skip
        self.passable = PassableGrids(self.known, radius, MARGIN_CELLS, through_unknown=True)
        self.paths = PathSearch(self.passable, mask_of_robot.reshape(-1))
        self.field_launches = shard.record(self.find_paths)
        self.waypoint_launches = shard.record(self.pick_waypoints)

    def find_paths(self, launch) -> None:
        s = self.view
        self.known.paint(launch)
        self.passable.paint(launch)
        self.paths.find(launch, s.active, s.collided, s.center, s.goal, s.target)

    def pick_waypoints(self, launch) -> None:
        s = self.view
        self.paths.pick(launch, s.active, s.collided, s.center, s.goal, self.robots.radar_range, s.target)
        launch(
            _hold_back, self.paths.shape,
            [self.robots, self.lead_time, s.active, s.collided, s.center], [s.target],
        )  # fmt: skip
