"""Collisions: by distance of centres, or by oriented footprints. A collided robot stops for good."""

import warp as wp

from maexp.kernels.dynamics import Robots
from maexp.kernels.geometry import rectangle_distance, rectangles_gap
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import Maps, point_xy, row_range, row_span

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def hits_boundary(
    maps: Maps, m: int, robots: Robots, e: int, i: int, at: wp.vec2, theta: float, footprint: int
) -> bool:
    """Whether a boundary point is nearer to the centre than the threshold, or inside the footprint."""
    length = robots.length[e, i]
    width = robots.width[e, i]
    radius = robots.collision_threshold[e, i]
    if footprint != 0:
        radius = 0.5 * wp.sqrt(length * length + width * width)
    rows = row_range(maps, m, at, radius)
    first = maps.boundary_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, at, radius)
        if span[0] <= span[1]:
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            for j in range(first + maps.boundary_cell[base + span[0]], first + maps.boundary_cell[base + span[1] + 1]):
                p = point_xy(maps.boundary[j])
                if footprint != 0:
                    if rectangle_distance(p, at, theta, length, width) == 0.0:
                        return True
                elif wp.length(p - at) < radius:
                    return True
    return False


@wp.kernel
def _detect_collisions(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    footprint: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    near: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    near_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State out:
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    # Scratch out:
    crashed: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Mark the robots that collide in this local step in ``crashed``, and for good in ``collided``."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    crashed[e, i] = 0
    if collided[e, i] != 0:
        return
    at = point_xy(center[e, i])
    theta = pose[e, i][3]
    hit = hits_boundary(maps, map_id[e], robots, e, i, at, theta, footprint)
    for k in range(near_count[e, i]):
        if not hit:
            other = near[e, i, k]
            there = point_xy(center[e, other])
            if footprint != 0:
                gap = rectangles_gap(
                    at,
                    theta,
                    robots.length[e, i],
                    robots.width[e, i],
                    there,
                    pose[e, other][3],
                    robots.length[e, other],
                    robots.width[e, other],
                )
                hit = gap == 0.0
            else:
                hit = wp.length(there - at) < robots.collision_threshold[e, i]
    if hit:
        crashed[e, i] = 1
        collided[e, i] = 1
        # It stops where it is. Other robots' tests read its place and heading, which stay.
        pose[e, i] = wp.vec4(pose[e, i][0], pose[e, i][1], 0.0, theta)
        slip[e, i] = 0.0


def detect_collisions(launch: Launch, shard: Shard) -> None:
    """Stop the robots that collide in this local step."""
    shard.call(launch, _detect_collisions)
