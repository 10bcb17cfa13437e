"""How robots fly: along the way to their goal, and never so fast that they could not stop in known room.

A robot heads for the farthest point of its way that it sees through room, slows down before it, and keeps away from
others. If with its new speed it could no longer stop in room, it brakes instead, straight on: that it could have
stopped before makes this safe.
"""

import warp as wp

from maexp.kernels.dynamics import wrap_angle
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.volume.coarse import UNREACHED, Cells, cells_of, place_in_cell, step_back
from maexp.kernels.volume.grid import VoxelMaps, all_set, has_bit, is_inside, voxel_of

wp.set_module_options(MODULE_OPTIONS)

WAY_POINTS = 256
"""Points of a way that a robot keeps, the next ones: more than it passes in a decision."""
AHEAD = 8
"""Points of the way that it tries to see in a step."""
APART = 3.0
"""Robots drift apart that are nearer than so many thresholds."""
ARRIVED = 0.002
"""A robot this near to its goal is there [m]."""
TURN_EARLY = 2.0
"""So far from its goal a robot turns to the heading that it is to have there [m]; before it looks where it flies."""


SLACK = 0.96
"""Share of its threshold that a robot must keep from walls: ways cut corners of voxels by `grid.CORNER`."""
WINDOW = 4
"""Voxels to each side of a robot among which it looks for a way around a corner."""
SPAN = 2 * WINDOW + 1


@wp.struct
class Fliers:
    """Limits of a team's robots."""

    max_speed: wp.array(dtype=wp.float32)  # [robot] [m/s]
    max_accel: wp.array(dtype=wp.float32)  # [robot] [m/s^2]
    max_yaw_rate: wp.array(dtype=wp.float32)  # [robot] [rad/s]
    threshold: wp.array(dtype=wp.float32)  # [robot], a centre this near to a wall or another centre collides [m]
    looks_ahead: wp.array(dtype=wp.int32)  # [robot], 1: its sensor does not see all around


@wp.kernel
def _find_way(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    # In:
    wanted: wp.array2d(dtype=wp.vec4),  # [env, robot] x, y, z [m], heading [rad]; NaN: as it is best
    room: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    distance: wp.array3d(dtype=wp.int16),  # [env, robot, cell]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    goal: wp.array2d(dtype=wp.vec4),  # [env, robot]
    way: wp.array3d(dtype=wp.vec3),  # [env, robot, point] [m]
    way_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    way_next: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Take the goal, and the way there: to the cell that the robot can get to nearest to it."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    w = wanted[e, i]
    p = wp.vec3(w[0], w[1], w[2])
    if not (wp.isfinite(p[0]) and wp.isfinite(p[1]) and wp.isfinite(p[2])):
        wp.atomic_or(error, e, 1)
        return
    m = map_id[e]
    size = maps.size[m]
    shape = cells_of(size, cells.side)
    row = wp.min(i, room.shape[1] - 1)
    at = (p - maps.origin[m]) / (maps.resolution[m] * float(cells.side))
    x = int(wp.floor(at[0]))
    y = int(wp.floor(at[1]))
    z = int(wp.floor(at[2]))
    cell = int(-1)
    if is_inside(shape, x, y, z):
        cell = (x * shape[1] + y) * shape[2] + z
        if int(distance[e, i, cell]) >= UNREACHED:
            cell = -1
    inside = cell >= 0
    if cell < 0:
        least = wp.float32(wp.inf)
        for k in range(shape[0] * shape[1] * shape[2]):
            if int(distance[e, i, k]) < UNREACHED:
                q = wp.vec3(
                    float(k / (shape[1] * shape[2])) + 0.5,
                    float(k / shape[2] % shape[1]) + 0.5,
                    float(k % shape[2]) + 0.5,
                )
                gap = wp.length(q - at)
                if gap < least:
                    least = gap
                    cell = k
    heading = w[3]
    if not wp.isfinite(heading):
        heading = pose[e, i][3]
    way_next[e, i] = 0
    way_count[e, i] = 0
    goal[e, i] = wp.vec4(p[0], p[1], p[2], heading)
    if cell < 0:
        return
    last = place_in_cell(maps, m, cells, room[e, row], cell)
    if inside:
        v = voxel_of(maps, m, p)
        if is_inside(size, v[0], v[1], v[2]):  # the last cell may reach over the edge
            if has_bit(room[e, row], v[0] * size[1] + v[1], v[2]):
                last = p
    steps = int(distance[e, i, cell])
    if steps < WAY_POINTS:
        way[e, i, steps] = last
    way_count[e, i] = wp.min(steps + 1, WAY_POINTS)
    here = step_back(distance[e, i], shape, cell)
    while here >= 0:
        n = int(distance[e, i, here])
        if n < WAY_POINTS:
            point = place_in_cell(maps, m, cells, room[e, row], here)
            for k in range(n, wp.min(steps, WAY_POINTS)):
                way[e, i, k] = point
        steps = n
        here = step_back(distance[e, i], shape, here)


@wp.func
def voxel_middle(v: wp.vec3i) -> wp.vec3:
    return wp.vec3(float(v[0]) + 0.5, float(v[1]) + 0.5, float(v[2]) + 0.5)


@wp.func
def window_voxel(at: wp.vec3i, n: int) -> wp.vec3i:
    """The voxel with a number in the window around another one."""
    return wp.vec3i(at[0] + n / (SPAN * SPAN) - WINDOW, at[1] + n / SPAN % SPAN - WINDOW, at[2] + n % SPAN - WINDOW)


@wp.func
def around_corner(
    size: wp.vec3i,
    room: wp.array2d(dtype=wp.int32),
    a: wp.vec3,
    b: wp.vec3,
    before: wp.array(dtype=wp.int32),
    queue: wp.array(dtype=wp.int32),
) -> wp.vec3:
    """Where to head for on the way from a to b [voxels], which a does not see: the farthest voxel in sight on the
    shortest way from voxel to voxel, or the middle of the own voxel."""
    at = wp.vec3i(int(wp.floor(a[0])), int(wp.floor(a[1])), int(wp.floor(a[2])))
    to = wp.vec3i(int(wp.floor(b[0])), int(wp.floor(b[1])), int(wp.floor(b[2])))
    for n in range(SPAN * SPAN * SPAN):
        before[n] = -2
    own = (WINDOW * SPAN + WINDOW) * SPAN + WINDOW
    before[own] = -1
    queue[0] = own
    first = int(0)
    last = int(1)
    best = own
    least = wp.length(voxel_middle(to) - voxel_middle(at))
    while first < last and least > 0.0:
        n = queue[first]
        first += 1
        v = window_voxel(at, n)
        for k in range(27):
            u = v + wp.vec3i(k / 9 - 1, k / 3 % 3 - 1, k % 3 - 1)
            d = u - at
            within = wp.max(wp.max(wp.abs(d[0]), wp.abs(d[1])), wp.abs(d[2])) <= WINDOW
            if within and is_inside(size, u[0], u[1], u[2]):
                number = ((d[0] + WINDOW) * SPAN + d[1] + WINDOW) * SPAN + d[2] + WINDOW
                if before[number] == -2 and has_bit(room, u[0] * size[1] + u[1], u[2]):
                    before[number] = n
                    queue[last] = number
                    last += 1
                    gap = wp.length(voxel_middle(to) - voxel_middle(u))
                    if gap < least:
                        least = gap
                        best = number
    n = best
    while n >= 0:
        c = voxel_middle(window_voxel(at, n))
        if all_set(room, 0, size, a, c, True):
            return c
        n = before[n]
    return voxel_middle(at)


@wp.func
def can_stop(
    maps: VoxelMaps, m: int, room: wp.array2d(dtype=wp.int32), p: wp.vec3, v: wp.vec3, accel: float, dt: float
) -> bool:
    """Whether a robot that flies on for a step at a speed and then brakes stays in room."""
    speed = wp.length(v)
    if speed < 1.0e-6:
        return True
    reach = speed * dt + 0.5 * speed * speed / accel + speed * dt
    a = (p - maps.origin[m]) / maps.resolution[m]
    b = a + v * (reach / (speed * maps.resolution[m]))
    return all_set(room, 0, maps.size[m], a, b, True)


@wp.func
def clear_of_others(
    e: int,
    i: int,
    p: wp.vec3,
    v: wp.vec3,
    accel: float,
    dt: float,
    fliers: Fliers,
    center: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
) -> bool:
    """Whether a robot that flies on for a step and then brakes stays clear of the others: of where they are, by twice
    its way, for they may come the same; and of where they will be, if they fly on until it stands."""
    speed = wp.length(v)
    if speed < 1.0e-6:
        return True
    until = 2.0 * dt + speed / accel
    reach = 2.0 * (2.0 * speed * dt + 0.5 * speed * speed / accel)
    ahead = v / speed
    for j in range(center.shape[1]):
        if j != i:
            need = 1.5 * wp.max(fliers.threshold[i], fliers.threshold[j]) + 0.1
            gap = center[e, j] - p
            if wp.dot(gap, ahead) > 0.0:
                along = wp.min(wp.dot(gap, ahead), reach)
                if wp.length(gap - along * ahead) < need:
                    return False
            toward = v - velocity[e, j]
            closing = wp.dot(gap, toward)
            if closing > 0.0:
                t = wp.min(closing / wp.dot(toward, toward), until)
                if wp.length(gap - t * toward) < need and wp.dot(gap, v) > 0.0:
                    return False
    return True


@wp.kernel
def _plan_motion(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    fliers: Fliers,
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec4),  # [env, robot]
    way: wp.array3d(dtype=wp.vec3),  # [env, robot, point]
    way_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # In:
    room: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    # State in and out:
    way_next: wp.array2d(dtype=wp.int32),  # [env, robot]
    # Scratch out:
    before: wp.array3d(dtype=wp.int32),  # [env, robot, voxel]
    queue: wp.array3d(dtype=wp.int32),  # [env, robot, voxel]
    new_velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
    new_heading: wp.array2d(dtype=wp.float32),  # [env, robot]
):
    """Velocity and heading of robot (e, i) at the end of this local step."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    new_velocity[e, i] = wp.vec3(0.0, 0.0, 0.0)
    new_heading[e, i] = pose[e, i][3]
    if collided[e, i] != 0 or failed[e, i] != 0:
        return
    m = map_id[e]
    row = wp.min(i, room.shape[1] - 1)
    p = center[e, i]
    v = velocity[e, i]
    accel = fliers.max_accel[i]
    a = (p - maps.origin[m]) / maps.resolution[m]
    k = way_next[e, i]
    count = way_count[e, i]
    sees = wp.bool(True)
    for _try in range(AHEAD):
        if sees and k + 1 < count:
            b = (way[e, i, k + 1] - maps.origin[m]) / maps.resolution[m]
            sees = all_set(room[e, row], 0, maps.size[m], a, b, True)
            if sees:
                k += 1
    if not sees and k + 1 < count:  # here, and the next one is around a corner
        if wp.length(way[e, i, k] - p) < 0.5 * maps.resolution[m]:
            k += 1
    way_next[e, i] = k
    wish = wp.vec3(0.0, 0.0, 0.0)
    rest = float(0.0)
    if count > 0:
        b = (way[e, i, k] - maps.origin[m]) / maps.resolution[m]
        if not all_set(room[e, row], 0, maps.size[m], a, b, True):
            came = before[e, i]
            waiting = queue[e, i]
            b = around_corner(maps.size[m], room[e, row], a, b, came, waiting)
        to = (b - a) * maps.resolution[m]
        rest = wp.length(to)
        if rest > ARRIVED:
            speed = wp.min(wp.min(fliers.max_speed[i], wp.sqrt(1.6 * accel * rest)), rest / dt)
            wish = to * (speed / rest)
    for j in range(center.shape[1]):
        if j != i:
            away = p - center[e, j]
            gap = wp.length(away)
            room_needed = APART * wp.max(fliers.threshold[i], fliers.threshold[j])
            if gap < room_needed and gap > 1.0e-6:
                wish = wish + away * (fliers.max_speed[i] * (1.0 - gap / room_needed) / gap)
    limit = wp.length(wish)
    if limit > fliers.max_speed[i]:
        wish = wish * (fliers.max_speed[i] / limit)
    change = wish - v
    size = wp.length(change)
    if size > accel * dt:
        change = change * (accel * dt / size)
    fresh = v + change
    good = can_stop(maps, m, room[e, row], p, fresh, accel, dt)
    if good:
        good = clear_of_others(e, i, p, fresh, accel, dt, fliers, center, velocity)
    if not good:
        speed = wp.length(v)
        fresh = v * (wp.max(speed - accel * dt, 0.0) / wp.max(speed, 1.0e-6))
        if speed <= accel * dt:  # at rest: try slowly, straight to the point and aside
            fresh = wp.vec3(0.0, 0.0, 0.0)
            slow = wish * (0.5 * accel * dt / wp.max(wp.length(wish), 1.0e-6))
            if can_stop(maps, m, room[e, row], p, slow, accel, dt):
                if clear_of_others(e, i, p, slow, accel, dt, fliers, center, velocity):
                    fresh = slow
    new_velocity[e, i] = fresh
    heading = pose[e, i][3]
    aim = goal[e, i][3]
    end = wp.length(wp.vec3(goal[e, i][0], goal[e, i][1], goal[e, i][2]) - p)
    flat = wp.vec2(fresh[0], fresh[1])
    if (end > TURN_EARLY or fliers.looks_ahead[i] == 0) and wp.length(flat) > 0.2:
        aim = wp.atan2(flat[1], flat[0])
    turn = fliers.max_yaw_rate[i] * dt
    new_heading[e, i] = wrap_angle(heading + wp.clamp(wrap_angle(aim - heading), -turn, turn))


@wp.kernel
def _move(
    # Settings:
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    new_velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
    new_heading: wp.array2d(dtype=wp.float32),  # [env, robot]
    # State in and out:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
    path_length: wp.array2d(dtype=wp.float32),  # [env, robot]
    # State out:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
):
    """Move for a step at the mean of the old and the new velocity."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    fresh = new_velocity[e, i]
    p = center[e, i] + 0.5 * dt * (velocity[e, i] + fresh)
    path_length[e, i] = path_length[e, i] + wp.length(p - center[e, i])
    center[e, i] = p
    velocity[e, i] = fresh
    slip[e, i] = fresh[2]
    pose[e, i] = wp.vec4(p[0], p[1], wp.length(wp.vec2(fresh[0], fresh[1])), new_heading[e, i])


@wp.func
def near_wall(maps: VoxelMaps, m: int, p: wp.vec3, threshold: float) -> bool:
    """Whether a point is in no free voxel, or nearer than the threshold to an occupied one."""
    size = maps.size[m]
    q = (p - maps.origin[m]) / maps.resolution[m]
    r = threshold / maps.resolution[m]
    v = voxel_of(maps, m, p)
    if not is_inside(size, v[0], v[1], v[2]):
        return True
    if not has_bit(maps.free, maps.begin[m] + v[0] * size[1] + v[1], v[2]):
        return True
    n = int(wp.ceil(r))
    for x in range(v[0] - n, v[0] + n + 1):
        for y in range(v[1] - n, v[1] + n + 1):
            for z in range(v[2] - n, v[2] + n + 1):
                if is_inside(size, x, y, z):
                    if has_bit(maps.occupied, maps.begin[m] + x * size[1] + y, z):
                        dx = wp.max(wp.max(float(x) - q[0], q[0] - float(x) - 1.0), 0.0)
                        dy = wp.max(wp.max(float(y) - q[1], q[1] - float(y) - 1.0), 0.0)
                        dz = wp.max(wp.max(float(z) - q[2], q[2] - float(z) - 1.0), 0.0)
                        if dx * dx + dy * dy + dz * dz < SLACK * SLACK * r * r:
                            return True
    return False


@wp.kernel
def _detect_collisions(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    fliers: Fliers,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # State in and out:
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State out:
    velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
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
    p = center[e, i]
    hit = near_wall(maps, map_id[e], p, fliers.threshold[i])
    for j in range(center.shape[1]):
        if j != i and wp.length(center[e, j] - p) < wp.max(fliers.threshold[i], fliers.threshold[j]):
            hit = True
    if hit:
        crashed[e, i] = 1
        collided[e, i] = 1
        velocity[e, i] = wp.vec3(0.0, 0.0, 0.0)


def find_ways(launch: Launch, shard: Shard) -> None:
    """Take the goals that are wanted, and find the ways there."""
    shard.call(launch, _find_way)


def move_robots(launch: Launch, shard: Shard) -> None:
    """A local step of all robots, and what they hit."""
    shard.call(launch, _plan_motion)
    shard.call(launch, _move)
    shard.call(launch, _detect_collisions)
