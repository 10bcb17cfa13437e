"""Room to stop on the way that a robot will truly drive, for differential drives.

Such a robot turns at a limited rate, so the faster it is the wider its circle: while it turns toward a waypoint it
swings out into what stands there. Here its speed is held to what stops on that circle and on the straight line after
it, and before other robots there. Where it is too fast for the circle but not for the line it drives on, it brakes on
the line and turns later.
"""

import warp as wp

from maexp.kernels.dynamics import DIFFERENTIAL, Robots, wrap_angle
from maexp.kernels.launches import Launch
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.shards import Shard
from maexp.kernels.speed_limits import clear_ahead, nearest_obstacle
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import PI, point_xy

wp.set_module_options(MODULE_OPTIONS)

EASE = 0.8  # share of the greatest deceleration that is counted on
SPARE_CELLS = 0.25  # gap that is kept beyond the collision threshold, in cells
LOOKS = 24  # places at most where the gap along a way is measured
LEAST_LOOK = 0.2  # they are at least so many cells apart
STRAIGHT_ON = 0.05  # a waypoint within this angle lies straight ahead [rad]
SLOWEST = 0.05  # circles are those of at least this speed [m/s]
NUDGE = 0.1  # least distance of a waypoint, in clearances of the robot: else none would get going
NARROW = 1.1  # clearance that DWA keeps while a robot has to brake, in collision thresholds


@wp.func
def place_on_way(at: wp.vec2, heading: float, curve: float, turn: float, s: float) -> wp.vec2:
    """Where `s` [m] lead that begin on a circle of curvature `curve` [1/m], for `turn` [rad], and go straight on."""
    if turn == 0.0:
        return at + s * wp.vec2(wp.cos(heading), wp.sin(heading))
    bend = wp.min(s, turn / curve)
    end = heading + curve * bend
    ahead = wp.vec2(wp.cos(end), wp.sin(end))
    return at + wp.vec2(ahead[1] - wp.sin(heading), wp.cos(heading) - ahead[0]) / curve + (s - bend) * ahead


@wp.func
def free_way(
    grids: NavGrids,
    m: int,
    walls: wp.array2d(dtype=wp.int32),
    row: int,
    at: wp.vec2,
    heading: float,
    curve: float,
    turn: float,
    keep: float,
    span: float,
) -> float:
    """How much [m] of a way as in `place_on_way` is free, `span` at most: obstacles are no nearer than `keep`."""
    s = float(0.0)
    blocked = int(0)
    for _k in range(LOOKS):
        if blocked == 0 and s < span:
            gap = nearest_obstacle(grids, m, walls, row, place_on_way(at, heading, curve, turn, s)) - keep
            if gap < 0.0:
                blocked = 1
            else:
                s += wp.max(gap, LEAST_LOOK * grids.cell[m])
    return wp.min(s, span)


@wp.kernel
def _hold_turns(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    rows_per_env: int,
    horizon: int,
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    # State in and out:
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # In and out:
    clearance: wp.array2d(dtype=wp.float32),  # [env, robot], what DWA keeps now [m]
):
    """Draw the waypoints of differential drives nearer, or straight ahead of them, so that they can stop.

    No way counts farther than the radar reaches. A waypoint is never nearer than
    braking leads: DWA would swerve to drive less far. While a robot is too fast DWA cares only for what it would hit,
    or it would drive on to get away from a wall at its side.
    """
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0 or robots.kind[e, i] != DIFFERENTIAL:
        return
    m = map_id[e]
    row = e * rows_per_env + i % rows_per_env
    at = point_xy(center[e, i])
    way = waypoint[e, i] - at
    full = wp.length(way)
    accel = robots.max_accel[e, i]
    top = robots.max_speed[e, i]
    threshold = robots.collision_threshold[e, i]
    speed = wp.abs(pose[e, i][2])
    heading = pose[e, i][3] + wp.where(pose[e, i][2] < 0.0, PI, 0.0)
    lead_time = float(horizon) * dt
    sight = robots.radar_range[e, i] - threshold - grids.cell[m]
    span = wp.min(0.5 * top * top / (EASE * accel) + lead_time * top, sight)
    # Who stands nearer to an obstacle than that may still leave it.
    keep = wp.min(threshold + SPARE_CELLS * grids.cell[m], nearest_obstacle(grids, m, walls, row, at))
    straight = free_way(grids, m, walls, row, at, heading, 0.0, 0.0, keep, span)
    free = straight
    turn = wrap_angle(wp.atan2(way[1], way[0]) - heading)
    if wp.abs(turn) > STRAIGHT_ON:
        curve = wp.sign(turn) * robots.max_turn[e, i] / wp.max(speed, SLOWEST)
        free = free_way(grids, m, walls, row, at, heading, curve, turn, keep, span)
    fastest = wp.sqrt(2.0 * EASE * accel * wp.max(free - lead_time * speed, 0.0))
    ahead = wp.vec2(wp.cos(heading), wp.sin(heading))
    mates = clear_ahead(e, i, ahead, 2.0 * robots.clearance[e, i], False, collided, center)
    fastest = wp.min(fastest, wp.sqrt(2.0 * EASE * accel * mates))
    soonest = wp.max(lead_time * (speed - 0.5 * accel * (lead_time - dt)), 0.0)
    length = wp.max(wp.min(full, wp.max(lead_time * fastest, NUDGE * robots.clearance[e, i])), soonest)
    if fastest < speed:
        clearance[e, i] = wp.min(clearance[e, i], NARROW * threshold)
        if straight > free:
            way = ahead
            length = soonest
    waypoint[e, i] = at + length * wp.normalize(way)


def hold_turns(launch: Launch, shard: Shard) -> None:
    """Draw the waypoints of differential drives to where they can stop on the way that they will drive."""
    shard.call(launch, _hold_turns, waypoint=shard.aims["waypoint"], **shard.wavefront.values)
