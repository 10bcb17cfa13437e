"""How fast and how close: what makes DWA brake in time and pass doors on its way along a path.

DWA looks three steps ahead, which is shorter than the way a robot needs to stop, and it enters no place narrower
than twice its clearance. So the waypoint is drawn nearer until DWA drives no faster than it can brake, and the
clearance shrinks where the path itself is narrower.
"""

import warp as wp

from maexp.kernels.cpp_snippets import nearest_wall
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import Launch
from maexp.kernels.occupancy_grid import NavGrids, nav_center, wall_bits
from maexp.kernels.path_steps import PATH_CELLS, path_slot
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import point_xy

wp.set_module_options(MODULE_OPTIONS)

CREEP = 0.25  # least distance of a waypoint that is not the end, in clearances of the robot
HEADROOM = 4.0  # speed is held to what brakes within so many times the gap to the nearest obstacle
BRAKE = 0.5  # share of the way ahead that it may take to brake for what stands there
SLACK = 0.5  # waypoints lie farther than that by this share of the spare gap, which lets robots drive fast in the open
SLACK_GAP = 2.0  # spare gap from which on the whole share counts, in collision thresholds
SLACK_TIME = 0.5  # the gap that counts is the least of those here and where the robot is so much later [s]
SAMPLES = 6  # intervals between the places ahead where the gap is measured
AHEAD = 2.0  # the part of the path that the clearance is fitted to, in clearances around the robot
FIT = 0.95  # share of its narrowest gap that DWA still keeps
LEAST = 1.1  # the clearance never falls below so many collision thresholds


@wp.func
def clear_ahead(
    e: int,
    i: int,
    way: wp.vec2,
    keep: float,
    stops: bool,
    collided: wp.array2d(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
) -> float:
    """Room to brake on the straight `way` [m]: half the gap to a robot that may come closer, and its length if the
    robot is to stop at its end."""
    room = float(1.0e30)
    if stops:
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


@wp.func
def nearest_obstacle(grids: NavGrids, m: int, walls: wp.array2d(dtype=wp.int32), row: int, at: wp.vec2) -> float:
    """Distance to the nearest known obstacle cell [m], `LOOK_CELLS` cells at most."""
    p = (at - grids.origin[m]) / grids.cell[m]
    w = grids.width[m]
    return nearest_wall(walls, row, p, w, grids.height[m], wall_bits(w)) * grids.cell[m]


@wp.func
def room_ahead(
    grids: NavGrids,
    m: int,
    walls: wp.array2d(dtype=wp.int32),
    row: int,
    at: wp.vec2,
    velocity: wp.vec2,
    threshold: float,
    span: float,
) -> float:
    """Room to brake [m] among the obstacles along the first `span` [m] of the way that a robot is moving."""
    ahead = wp.normalize(velocity)
    room = float(1.0e30)
    for k in range(SAMPLES + 1):
        s = span * float(k) / float(SAMPLES)
        gap = nearest_obstacle(grids, m, walls, row, at + ahead * s) - threshold
        room = wp.min(room, BRAKE * s + HEADROOM * wp.max(gap, 0.0))
    return room


@wp.kernel
def _fit_clearance(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    rows_per_env: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item]
    path_used: wp.array(dtype=wp.int32),  # [item]
    # Out:
    clearance: wp.array2d(dtype=wp.float32),  # [env, robot], what DWA keeps now [m]
):
    """Lower the clearance to what the path nearby has: DWA would not enter a door that it cannot keep clear of."""
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    item = e * center.shape[1] + i
    m = map_id[e]
    row = e * rows_per_env + i % rows_per_env
    at = point_xy(center[e, i])
    full = robots.clearance[e, i]
    total = path_total[item]
    gap = float(1.0e30)
    for j in range(wp.min(wp.min(total, PATH_CELLS), path_used[item] + 1)):
        point = nav_center(grids, m, path[item, path_slot(j, total)])
        if wp.length(point - at) <= AHEAD * full:
            gap = wp.min(gap, nearest_obstacle(grids, m, walls, row, point))
    least = wp.min(LEAST * robots.collision_threshold[e, i], full)
    clearance[e, i] = wp.clamp(FIT * gap, least, full)


@wp.kernel
def _hold_back(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    rows_per_env: int,
    lead_time: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # In:
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    # State in and out:
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Draw waypoints nearer, so that robots drive no faster than they can brake: before other robots, before what
    stands where they are moving, and before the goal.

    DWA brakes only for a waypoint that it would pass in its `lead_time` [s], three steps: a waypoint at
    lead_time * v holds it at about the speed v. At least `CREEP` clearances, or it would not get going.
    """
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    row = e * rows_per_env + i % rows_per_env
    at = point_xy(center[e, i])
    way = waypoint[e, i] - at
    full = wp.length(way)
    clearance = robots.clearance[e, i]
    threshold = robots.collision_threshold[e, i]
    accel = robots.max_accel[e, i]
    p = pose[e, i]
    c = wp.cos(p[3])
    s = wp.sin(p[3])
    velocity = wp.vec2(p[2] * c - slip[e, i] * s, p[2] * s + slip[e, i] * c)
    span = 0.5 * wp.dot(velocity, velocity) / accel + clearance
    stops = wp.length(waypoint[e, i] - goal[e, i]) == 0.0
    room = clear_ahead(e, i, way, 2.0 * clearance, stops, collided, center)
    room = wp.min(room, room_ahead(grids, m, walls, row, at, velocity, threshold, span))
    gap = nearest_obstacle(grids, m, walls, row, at)
    gap = wp.min(gap, nearest_obstacle(grids, m, walls, row, at + velocity * SLACK_TIME))
    spare = wp.max(gap - threshold, 0.0)
    slack = SLACK * spare * wp.min(spare / (SLACK_GAP * threshold), 1.0)
    length = wp.max(lead_time * wp.sqrt(2.0 * accel * room) + slack, CREEP * clearance)
    if full > length:
        waypoint[e, i] = at + way * (length / full)


def fit_clearance(launch: Launch, shard: Shard) -> None:
    """Fit the clearance that DWA is to keep to the paths."""
    shard.call(launch, _fit_clearance, **shard.wavefront.values, **shard.believed)


def hold_back(launch: Launch, shard: Shard) -> None:
    """Draw waypoints nearer, so that robots can brake."""
    lead_time = shard.settings.horizon * shard.settings.dt
    shard.call(launch, _hold_back, lead_time=lead_time, **shard.wavefront.values, **shard.aims)
