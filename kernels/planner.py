"""Local planners: how to go. DWA, and direct controls from the policy."""

from typing import TYPE_CHECKING

import warp as wp

from maexp.kernels.dynamics import curvature, heading_change
from maexp.kernels.geometry import box_distance, rectangle_distance, rectangles_gap
from maexp.kernels.launches import Launch
from maexp.kernels.types import (
    ERROR_ACTION,
    ERROR_CAPACITY,
    HALF,
    OMNIDIRECTIONAL,
    REGIONS,
    ROBOTS_PER_WORD,
    Maps,
    Robots,
    point_xy,
    row_range,
    row_span,
    within,
)

if TYPE_CHECKING:
    from maexp.kernels.shards import Shard

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile

NEAREST = 1.0e-6  # distances below count as this [m], so that the logarithm stays finite


@wp.func
def spread(k: int, count: int, limit: float) -> float:
    """Value ``k`` of ``count`` evenly spaced over [-limit, limit]; a single one is 0."""
    if count > 1:
        return -limit + 2.0 * limit * float(k) / float(count - 1)
    return 0.0


@wp.func
def is_known(flags: wp.array3d(dtype=wp.int32), e: int, i: int, j: int, limited: int) -> bool:
    """Whether robot i knows point j: its own flag where communication is limited, any word otherwise."""
    if limited != 0:
        return (flags[e, i / ROBOTS_PER_WORD, j] & (1 << (i % ROBOTS_PER_WORD))) != 0
    for w in range(flags.shape[1]):
        if flags[e, w, j] != 0:
            return True
    return False


@wp.func
def gather_obstacles(
    maps: Maps,
    m: int,
    e: int,
    i: int,
    at: wp.vec2,
    in_range: float,
    middle: wp.vec2,
    reach: float,
    limited: int,
    known_boundary: wp.array3d(dtype=wp.int32),
    nearby: wp.array3d(dtype=wp.vec2),
) -> int:
    """List the known boundary points in range of a robot and within ``reach`` of ``middle``; returns how many."""
    count = int(0)
    around = wp.where(in_range < reach, at, middle)
    rows = row_range(maps, m, around, wp.min(in_range, reach))
    first = maps.boundary_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, around, wp.min(in_range, reach))
        if span[0] <= span[1]:
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            for j in range(maps.boundary_cell[base + span[0]], maps.boundary_cell[base + span[1] + 1]):
                p = point_xy(maps.boundary[first + j])
                if wp.length(p - at) <= in_range and wp.length(p - middle) <= reach:
                    if is_known(known_boundary, e, i, j, limited):
                        if count < nearby.shape[2]:
                            nearby[e, i, count] = p
                        count += 1
    return count


@wp.func
def gather_mates(
    robots: Robots,
    e: int,
    i: int,
    in_range: float,
    middle: wp.vec2,
    reach: float,
    center: wp.array2d(dtype=wp.vec3),
    near: wp.array3d(dtype=wp.int32),
    near_count: wp.array2d(dtype=wp.int32),
    mates: wp.array3d(dtype=wp.int32),
) -> int:
    """List the robots in radar range whose bodies come within ``reach`` of ``middle``; returns how many."""
    count = int(0)
    here = point_xy(center[e, i])
    for k in range(near_count[e, i]):
        other = near[e, i, k]
        there = point_xy(center[e, other])
        if within(there - middle, reach + HALF * (robots.length[e, other] + robots.width[e, other])):
            if wp.length(there - here) <= in_range:
                mates[e, i, count] = other
                count += 1
    return count


@wp.func
def body_distance(
    robots: Robots,
    count: int,
    e: int,
    i: int,
    at: wp.vec2,
    theta: float,
    clearance: float,
    footprint: int,
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
    facing: wp.array2d(dtype=wp.vec2),
    mates: wp.array3d(dtype=wp.int32),
) -> float:
    """Distance from a predicted body of robot i to the nearest of the listed bodies, where they are now.

    Bodies that surely keep the clearance may be left out.
    """
    nearest = float(1.0e30)
    own = float(footprint) * (robots.length[e, i] + robots.width[e, i])
    for k in range(count):
        other = mates[e, i, k]
        there = point_xy(center[e, other])
        length = robots.length[e, other]
        width = robots.width[e, other]
        if within(there - at, 1.001 * clearance + own + HALF * (length + width)):
            gap = float(0.0)
            if footprint != 0:
                gap = rectangles_gap(
                    at, theta, robots.length[e, i], robots.width[e, i], there, pose[e, other][3], length, width
                )
            else:
                gap = box_distance(at, there, facing[e, other], length, width)
            nearest = wp.min(nearest, gap)
    return nearest


@wp.func
def obstacle_distance(
    count: int,
    e: int,
    i: int,
    at: wp.vec2,
    theta: float,
    length: float,
    width: float,
    footprint: int,
    nearby: wp.array3d(dtype=wp.vec2),
) -> float:
    """Distance from a predicted body (its centre, or its footprint) to the nearest listed point."""
    nearest = float(1.0e30)
    if footprint != 0:
        for k in range(count):
            nearest = wp.min(nearest, rectangle_distance(nearby[e, i, k], at, theta, length, width))
        return nearest
    for k in range(count):
        d = nearby[e, i, k] - at
        nearest = wp.min(nearest, wp.dot(d, d))
    return wp.sqrt(nearest)


@wp.kernel
def _plan_dwa(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    num_accel: int,
    num_steering: int,
    horizon: int,
    clearance_weight: float,
    footprint: int,
    limited: int,
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    known_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    # Scratch in:
    facing: wp.array2d(dtype=wp.vec2),  # [env, robot]
    near: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    near_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # Scratch out:
    nearby: wp.array3d(dtype=wp.vec2),  # [env, robot, slot]
    mates: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
):
    """Dynamic window: the candidate with the best score after ``horizon`` steps.

    Candidates are numbered with accelerations outside and turns inside; the first maximum wins.

    score = -distance(waypoint) + clearance_weight * log(d / clearance) where d < clearance, d the distance of the
    predicted body to what is known to be in the way.
    """
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    kind = robots.kind[e, i]
    accel = robots.max_accel[e, i]
    turn = robots.max_turn[e, i]
    length = robots.length[e, i]
    width = robots.width[e, i]
    offset = robots.center_offset[e, i]
    clearance = robots.clearance[e, i]
    start = pose[e, i]
    at = point_xy(center[e, i])
    steps = float(horizon)
    speed = wp.abs(start[2]) + wp.abs(slip[e, i])
    reach_turn = turn
    if kind == OMNIDIRECTIONAL:
        reach_turn = accel
    # The first step's position and heading do not depend on the acceleration: turns outside save trigonometry.
    v0 = start[2]
    side0 = slip[e, i]
    c0 = wp.cos(start[3])
    s0 = wp.sin(start[3])
    x0 = start[0] + (v0 * c0 - side0 * s0) * dt
    y0 = start[1] + (v0 * s0 + side0 * c0) * dt
    # What is farther than this from there cannot come nearer than the clearance, below which alone it counts.
    middle = wp.vec2(x0, y0)
    travel = dt * (steps - 1.0) * (speed + 1.5 * accel * dt * steps) + wp.abs(offset)
    reach = 1.001 * (travel + clearance) + float(footprint) * (length + width)
    in_range = robots.radar_range[e, i]
    count = gather_obstacles(maps, m, e, i, at, in_range, middle, reach, limited, known_boundary, nearby)
    if count > nearby.shape[2]:
        wp.atomic_or(error, e, ERROR_CAPACITY)
        count = nearby.shape[2]
    mate_count = gather_mates(robots, e, i, in_range, middle, reach, center, near, near_count, mates)
    best = float(-1.0e30)
    best_k = int(0)
    for b in range(num_steering):
        u = spread(b, num_steering, reach_turn)
        curve = curvature(kind, u, robots.wheelbase[e, i])
        theta1 = start[3] + heading_change(kind, v0, u, curve, dt)
        c1 = wp.cos(theta1)
        s1 = wp.sin(theta1)
        for a in range(num_accel):
            push = spread(a, num_accel, accel)
            x = float(x0)
            y = float(y0)
            v = v0 + push * dt
            side = float(side0)
            theta = float(theta1)
            c = float(c1)
            s = float(s1)
            for _step in range(horizon - 1):
                if kind == OMNIDIRECTIONAL:
                    side += u * dt
                x += (v * c - side * s) * dt
                y += (v * s + side * c) * dt
                theta += heading_change(kind, v, u, curve, dt)
                v += push * dt
                c = wp.cos(theta)
                s = wp.sin(theta)
            p = wp.vec2(x + offset * c, y + offset * s)
            score = -wp.length(waypoint[e, i] - p)
            if not score < best:  # what is in the way can only lower it
                d = obstacle_distance(count, e, i, p, theta, length, width, footprint, nearby)
                d = wp.min(d, body_distance(
                    robots, mate_count, e, i, p, theta, clearance, footprint, pose, center, facing, mates))  # fmt: skip
                if d < clearance:
                    score += clearance_weight * wp.log(wp.max(d, NEAREST) / clearance)
                k = a * num_steering + b
                if score > best or (score == best and k < best_k):
                    best = score
                    best_k = k
                    control[e, i] = wp.vec2(push, u)


@wp.kernel
def _plan_direct(
    # Robots:
    robots: Robots,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    command: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State out:
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Take the controls from the policy: shares of the robot's limits in [-1, 1]."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    first = wp.clamp(command[e, i][0], -1.0, 1.0) * robots.max_accel[e, i]
    second = wp.clamp(command[e, i][1], -1.0, 1.0)
    if robots.kind[e, i] == OMNIDIRECTIONAL:
        second = second * robots.max_accel[e, i]
    else:
        second = second * robots.max_turn[e, i]
    control[e, i] = wp.vec2(first, second)


@wp.kernel
def _set_goal(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    region: wp.array2d(dtype=wp.int64),  # [env, robot]
    offset: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Goal = region centre + offset * half a region (region = ix * REGIONS + iy); out of bounds is clamped."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    o = offset[e, i]
    if not (wp.isfinite(o[0]) and wp.isfinite(o[1])):
        wp.atomic_or(error, e, ERROR_ACTION)
        return
    r = int(wp.clamp(region[e, i], wp.int64(0), wp.int64(REGIONS * REGIONS - 1)))
    half = (maps.upper[m] - maps.lower[m]) / (2.0 * float(REGIONS))
    x = maps.lower[m][0] + half[0] * (float(2 * (r / REGIONS) + 1) + wp.clamp(o[0], -1.0, 1.0))
    y = maps.lower[m][1] + half[1] * (float(2 * (r % REGIONS) + 1) + wp.clamp(o[1], -1.0, 1.0))
    goal[e, i] = wp.vec2(x, y)
    waypoint[e, i] = wp.vec2(x, y)


def set_goals(launch: Launch, shard: "Shard") -> None:
    """Turn the policy's regions and offsets into goals."""
    if shard.settings.planner != "direct":
        shard.call(launch, _set_goal, "error goal waypoint")


def plan(launch: Launch, shard: "Shard") -> None:
    """How to go: controls of every robot. Under `wavefront` DWA drives to its waypoints with its clearances."""
    if shard.settings.planner == "direct":
        shard.call(launch, _plan_direct, "control")
        return
    robots = shard.robots if shard.wavefront is None else shard.wavefront.narrowed
    shard.call(
        launch, _plan_dwa, "error control nearby mates",
        robots=robots, known_boundary=shard.known("boundary"),
    )  # fmt: skip
