"""DWA: how to go, by the dynamic window approach.

Every pair of an acceleration and a turn is rolled out for a few local steps and scored, `LANES` turns at once.
"""

import torch
import warp as wp

from maexp.kernels.dynamics import OMNIDIRECTIONAL, Robots, curvature, heading_change, turn_limit
from maexp.kernels.geometry import rectangle_distance, rectangles_gap
from maexp.kernels.launches import launch_on
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.state import robots_struct
from maexp.kernels.types import (
    ERROR_CAPACITY,
    FAR,
    HALF,
    LANES,
    ROBOTS_PER_WORD,
    Lanes,
    Maps,
    point_xy,
    row_range,
    row_span,
    within,
)

wp.set_module_options(MODULE_OPTIONS)

NEAREST = 1.0e-6  # distances below count as this [m], so that the logarithm stays finite


@wp.func
def spread(k: int, count: int, limit: float) -> float:
    """Value ``k`` of ``count`` evenly spaced over [-limit, limit]; a single one is 0."""
    if count > 1:
        return -limit + 2.0 * limit * float(k) / float(count - 1)
    return 0.0


@wp.kernel
def _list_curvatures(
    # Robots:
    robots: Robots,
    # Settings:
    num_steering: int,
    # Out:
    curvatures: wp.array3d(dtype=wp.float32),  # [env, robot, turn]
):
    """`Robots.curvature`: a tangent costs as much as two sines, and these never change."""
    e, i, b = wp.tid()
    u = spread(b, num_steering, turn_limit(robots, e, i))
    curvatures[e, i, b] = curvature(robots.kind[e, i], u, robots.wheelbase[e, i])


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
def lane_roots(squares: Lanes) -> Lanes:
    """Square root of each lane."""
    roots = Lanes()
    for n in range(LANES):
        roots[n] = wp.sqrt(squares[n])
    return roots


@wp.func
def clearances(
    robots: Robots,
    count: int,
    mate_count: int,
    e: int,
    i: int,
    x: Lanes,
    y: Lanes,
    nearby: wp.array3d(dtype=wp.vec2),
    center: wp.array2d(dtype=wp.vec3),
    facing: wp.array2d(dtype=wp.vec2),
    mates: wp.array3d(dtype=wp.int32),
) -> Lanes:
    """Distances of predicted centres to the nearest of the listed points and bodies, where those are now [m]."""
    squares = Lanes(FAR)
    for k in range(count):
        p = nearby[e, i, k]
        dx = Lanes(p[0]) - x
        dy = Lanes(p[1]) - y
        squares = wp.min(squares, wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy))
    nearest = lane_roots(squares)
    for k in range(mate_count):  # as `box_distance`
        other = mates[e, i, k]
        ahead = facing[e, other]
        dx = x - Lanes(center[e, other][0])
        dy = y - Lanes(center[e, other][1])
        along = wp.abs(ahead[0] * dx + ahead[1] * dy) - Lanes(0.5 * robots.length[e, other])
        across = wp.abs(ahead[0] * dy - ahead[1] * dx) - Lanes(0.5 * robots.width[e, other])
        along = wp.max(along, Lanes(0.0))
        across = wp.max(across, Lanes(0.0))
        nearest = wp.min(nearest, lane_roots(wp.cw_mul(along, along) + wp.cw_mul(across, across)))
    return nearest


@wp.func
def footprint_clearance(
    robots: Robots,
    count: int,
    mate_count: int,
    e: int,
    i: int,
    at: wp.vec2,
    theta: float,
    clearance: float,
    nearby: wp.array3d(dtype=wp.vec2),
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
    mates: wp.array3d(dtype=wp.int32),
) -> float:
    """Distance of a predicted body to the nearest of the listed points and bodies, where those are now [m].

    Bodies that surely keep the clearance may be left out.
    """
    length = robots.length[e, i]
    width = robots.width[e, i]
    nearest = float(FAR)
    for k in range(count):
        nearest = wp.min(nearest, rectangle_distance(nearby[e, i, k], at, theta, length, width))
    for k in range(mate_count):
        other = mates[e, i, k]
        there = point_xy(center[e, other])
        long = robots.length[e, other]
        wide = robots.width[e, other]
        if within(there - at, 1.001 * clearance + length + width + HALF * (long + wide)):
            gap = rectangles_gap(at, theta, length, width, there, pose[e, other][3], long, wide)
            nearest = wp.min(nearest, gap)
    return nearest


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
    turn = turn_limit(robots, e, i)
    offset = robots.center_offset[e, i]
    clearance = robots.clearance[e, i]
    start = pose[e, i]
    at = point_xy(center[e, i])
    steps = float(horizon)
    speed = wp.abs(start[2]) + wp.abs(slip[e, i])
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
    reach = 1.001 * (travel + clearance) + float(footprint) * (robots.length[e, i] + robots.width[e, i])
    in_range = robots.radar_range[e, i]
    count = gather_obstacles(maps, m, e, i, at, in_range, middle, reach, limited, known_boundary, nearby)
    if count > nearby.shape[2]:
        wp.atomic_or(error, e, ERROR_CAPACITY)
        count = nearby.shape[2]
    mate_count = gather_mates(robots, e, i, in_range, middle, reach, center, near, near_count, mates)
    aim = waypoint[e, i]
    best = float(-FAR)
    best_k = int(-1)
    for b in range(0, num_steering, LANES):
        turns = Lanes()
        curves = Lanes()
        theta1 = Lanes()
        c1 = Lanes()
        s1 = Lanes()
        for n in range(LANES):
            if b + n < num_steering:
                turns[n] = spread(b + n, num_steering, turn)
                curves[n] = robots.curvature[e, i, b + n]
                theta1[n] = start[3] + heading_change(kind, v0, turns[n], curves[n], dt)
                c1[n] = wp.cos(theta1[n])
                s1[n] = wp.sin(theta1[n])
        for a in range(num_accel):
            push = spread(a, num_accel, accel)
            x = Lanes(x0)
            y = Lanes(y0)
            v = v0 + push * dt
            side = Lanes(side0)
            theta = theta1
            c = c1
            s = s1
            for _step in range(horizon - 1):
                if kind == OMNIDIRECTIONAL:
                    side += turns * dt
                x += (v * c - wp.cw_mul(side, s)) * dt
                y += (v * s + wp.cw_mul(side, c)) * dt
                for n in range(LANES):
                    theta[n] = theta[n] + heading_change(kind, v, turns[n], curves[n], dt)
                    c[n] = wp.cos(theta[n])
                    s[n] = wp.sin(theta[n])
                v += push * dt
            x += offset * c
            y += offset * s
            dx = Lanes(aim[0]) - x
            dy = Lanes(aim[1]) - y
            away = lane_roots(wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy))
            if not -wp.min(away) < best:  # what is in the way can only lower a score
                d = Lanes()
                if footprint == 0:
                    d = clearances(robots, count, mate_count, e, i, x, y, nearby, center, facing, mates)
                for n in range(LANES):
                    score = -away[n]
                    if not score < best and b + n < num_steering:
                        if footprint != 0:
                            d[n] = footprint_clearance(
                                robots,
                                count,
                                mate_count,
                                e,
                                i,
                                wp.vec2(x[n], y[n]),
                                theta[n],
                                clearance,
                                nearby,
                                pose,
                                center,
                                mates,
                            )
                        if d[n] < clearance:
                            score += clearance_weight * wp.log(wp.max(d[n], NEAREST) / clearance)
                        k = a * num_steering + b + n
                        if score > best or (score == best and k < best_k):
                            best = score
                            best_k = k
    if best_k >= 0:
        push = spread(best_k / num_steering, num_accel, accel)
        control[e, i] = wp.vec2(push, spread(best_k % num_steering, num_steering, turn))


def list_curvatures(robots: dict[str, torch.Tensor], num_steering: int) -> torch.Tensor:
    """`Robots.curvature` of robots given by one [E, N] tensor per field: float32 [E, N, num_steering]."""
    shape, device = (*robots["kind"].shape, num_steering), robots["kind"].device
    curvatures = torch.empty(shape, dtype=torch.float32, device=device)
    launch_on(device)(
        _list_curvatures, shape, [robots_struct(robots, 0, shape[0]), num_steering, wp.from_torch(curvatures)]
    )
    return curvatures
