"""Who is near whom in a local step: looked up once, for planner, collisions and radar."""

import warp as wp

from maexp.kernels.dynamics import Robots, curvature, heading_change
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import HALF, point_xy, within

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _face_robots(
    # Robots:
    robots: Robots,
    # Settings:
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch out:
    facing: wp.array2d(dtype=wp.vec2),  # [env, robot]
    place: wp.array2d(dtype=wp.vec3),  # [env, robot]
):
    """Write the heading of robot (e, i), which the robots near it read, and in ``place`` a disc it stays in this step.

    ``place`` is its centre's x and y and how far from there its body may reach before or after it moves [m].
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    facing[e, i] = wp.vec2(wp.cos(pose[e, i][3]), wp.sin(pose[e, i][3]))
    speed = wp.abs(pose[e, i][2]) + wp.abs(slip[e, i])
    kind = robots.kind[e, i]
    most = robots.max_turn[e, i]
    turn = heading_change(kind, speed, most, curvature(kind, most, robots.wheelbase[e, i]), dt)
    swing = wp.min(2.0, 1.001 * turn) * wp.abs(robots.center_offset[e, i])  # of the centre, by that change of heading
    room = dt * speed + swing + HALF * (robots.length[e, i] + robots.width[e, i])
    place[e, i] = wp.vec3(center[e, i][0], center[e, i][1], room)


@wp.kernel
def _list_near(
    # Robots:
    robots: Robots,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    place: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch out:
    near: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    near_count: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """List the robots whose bodies may be in radar range of robot (e, i), or touch it, before or after it moves.

    Planner, collisions and radar then look at these only: a large team is gone through once a step.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    here = place[e, i]
    reach = here[2] + wp.max(robots.radar_range[e, i], robots.collision_threshold[e, i])
    count = int(0)
    for other in range(place.shape[1]):
        there = place[e, other]
        if within(point_xy(there - here), reach + there[2]):
            if other != i:
                near[e, i, count] = other
                count += 1
    near_count[e, i] = count


def list_near(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Who is near whom, and which way robots face, in the envs where ``running`` [env] is set."""
    shard.call(launch, _face_robots, active=running)
    shard.call(launch, _list_near, active=running)
