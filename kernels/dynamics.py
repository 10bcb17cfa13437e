"""Motion of the robots and their footprints (design 4.3).

A pose is ``(x, y, v, theta)`` of the reference point [m, m, m/s, rad]: the rear axle of an Ackermann
car, the body's centre otherwise. ``slip`` is the sideways speed of an omnidirectional robot [m/s].
"""

import warp as wp

from maexp.kernels.types import ACKERMANN, DIFFERENTIAL, HALF, PI, Robots, point_xy, within

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile


@wp.func
def wrap_angle(theta: float) -> float:
    """Angle in [-pi, pi)."""
    return theta - 2.0 * PI * wp.floor((theta + PI) / (2.0 * PI))


@wp.func
def curvature(kind: int, turn: float, wheelbase: float) -> float:
    """Turn per metre driven [rad/m] that a control asks of a car; 0 for the other kinds."""
    if kind == ACKERMANN:
        return wp.tan(turn) / wheelbase
    return 0.0


@wp.func
def heading_change(kind: int, v: float, turn: float, curve: float, dt: float) -> float:
    """Change of heading in one explicit Euler step [rad]."""
    if kind == ACKERMANN:
        return v * curve * dt
    if kind == DIFFERENTIAL:
        return turn * dt
    return 0.0


@wp.func
def box_distance(p: wp.vec2, center: wp.vec2, ahead: wp.vec2, length: float, width: float) -> float:
    """Distance of a point to a rectangle whose length lies along the unit vector ``ahead``, 0 inside."""
    d = p - center
    c = ahead[0]
    s = ahead[1]
    a = wp.max(wp.abs(c * d[0] + s * d[1]) - 0.5 * length, 0.0)
    b = wp.max(wp.abs(c * d[1] - s * d[0]) - 0.5 * width, 0.0)
    return wp.sqrt(a * a + b * b)


@wp.func
def rectangle_distance(p: wp.vec2, center: wp.vec2, theta: float, length: float, width: float) -> float:
    """Distance of a point to an oriented rectangle, 0 inside."""
    return box_distance(p, center, wp.vec2(wp.cos(theta), wp.sin(theta)), length, width)


@wp.func
def rectangle_corner(k: int, center: wp.vec2, theta: float, length: float, width: float) -> wp.vec2:
    a = wp.where(k < 2, 0.5, -0.5) * length
    b = wp.where(k == 0 or k == 3, 0.5, -0.5) * width
    c = wp.cos(theta)
    s = wp.sin(theta)
    return wp.vec2(center[0] + a * c - b * s, center[1] + a * s + b * c)


@wp.func
def separated(
    center: wp.vec2, theta: float, length: float, width: float,
    other: wp.vec2, theta_o: float, length_o: float, width_o: float,
) -> bool:
    """Whether an axis of the first rectangle separates the two."""
    c = wp.cos(theta)
    s = wp.sin(theta)
    d = other - center
    co = wp.abs(wp.cos(theta_o - theta))
    so = wp.abs(wp.sin(theta_o - theta))
    along = 0.5 * (length + co * length_o + so * width_o)
    across = 0.5 * (width + so * length_o + co * width_o)
    return wp.abs(c * d[0] + s * d[1]) > along or wp.abs(c * d[1] - s * d[0]) > across


@wp.func
def rectangles_gap(
    center: wp.vec2, theta: float, length: float, width: float,
    other: wp.vec2, theta_o: float, length_o: float, width_o: float,
) -> float:
    """Distance of two oriented rectangles, 0 where they overlap.

    The nearest points of two disjoint convex polygons include a corner of one of them.
    """
    if not separated(center, theta, length, width, other, theta_o, length_o, width_o):
        if not separated(other, theta_o, length_o, width_o, center, theta, length, width):
            return 0.0
    gap = float(1.0e30)
    for k in range(4):
        p = rectangle_corner(k, center, theta, length, width)
        q = rectangle_corner(k, other, theta_o, length_o, width_o)
        gap = wp.min(gap, rectangle_distance(p, other, theta_o, length_o, width_o))
        gap = wp.min(gap, rectangle_distance(q, center, theta, length, width))
    return gap


@wp.kernel
def _face_robots(
    # Robots:
    robots: Robots,
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
    reach = here[2] + wp.max(robots.radar_range[e, i], robots.threshold[e, i])
    count = int(0)
    for other in range(place.shape[1]):
        there = place[e, other]
        if within(point_xy(there - here), reach + there[2]):
            if other != i:
                near[e, i, count] = other
                count += 1
    near_count[e, i] = count


@wp.kernel
def _move_robots(
    # Robots:
    robots: Robots,
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State out:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    path_length: wp.array2d(dtype=wp.float32),  # [env, robot]
    # Scratch out:
    facing: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Clamp the controls to the robot's limits and move it by one local step."""
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    kind = robots.kind[e, i]
    accel = robots.max_accel[e, i]
    turn = robots.max_turn[e, i]
    u = control[e, i]
    old = pose[e, i]
    side = slip[e, i]
    limit = robots.max_speed[e, i]
    path_length[e, i] = path_length[e, i] + wp.length(wp.vec2(old[2], side)) * dt
    c = wp.cos(old[3])
    s = wp.sin(old[3])
    x = old[0] + (old[2] * c - side * s) * dt
    y = old[1] + (old[2] * s + side * c) * dt
    if kind == ACKERMANN or kind == DIFFERENTIAL:
        u = wp.vec2(wp.clamp(u[0], -accel, accel), wp.clamp(u[1], -turn, turn))
        curve = curvature(kind, u[1], robots.wheelbase[e, i])
        theta = wrap_angle(old[3] + heading_change(kind, old[2], u[1], curve, dt))
        pose[e, i] = wp.vec4(x, y, wp.clamp(old[2] + u[0] * dt, -limit, limit), theta)
    else:
        u = wp.vec2(wp.clamp(u[0], -accel, accel), wp.clamp(u[1], -accel, accel))
        velocity = wp.vec2(old[2] + u[0] * dt, side + u[1] * dt)
        speed = wp.length(velocity)
        if speed > limit:
            velocity = velocity * (limit / speed)
        slip[e, i] = velocity[1]
        pose[e, i] = wp.vec4(x, y, velocity[0], old[3])
    offset = robots.center_offset[e, i]
    ahead = wp.vec2(wp.cos(pose[e, i][3]), wp.sin(pose[e, i][3]))
    facing[e, i] = ahead
    center[e, i] = wp.vec3(pose[e, i][0] + offset * ahead[0], pose[e, i][1] + offset * ahead[1], 0.0)
