"""Motion of the robots, and the parameters that every kernel reads of them.

A pose is ``(x, y, v, theta)`` of the reference point [m, m, m/s, rad]: the rear axle of an Ackermann
car, the body's centre otherwise. ``slip`` is the sideways speed of an omnidirectional robot [m/s].
"""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import PI

wp.set_module_options(MODULE_OPTIONS)

ACKERMANN = 0
DIFFERENTIAL = 1
OMNIDIRECTIONAL = 2
KINDS = {"ackermann": ACKERMANN, "differential": DIFFERENTIAL, "omnidirectional": OMNIDIRECTIONAL}


@wp.struct
class Robots:
    """Parameters of every robot, arrays [env, robot]."""

    kind: wp.array2d(dtype=wp.int32)
    length: wp.array2d(dtype=wp.float32)  # [m]
    width: wp.array2d(dtype=wp.float32)  # [m]
    wheelbase: wp.array2d(dtype=wp.float32)  # [m]
    center_offset: wp.array2d(dtype=wp.float32)  # reference point to body centre [m]
    max_speed: wp.array2d(dtype=wp.float32)  # [m/s]
    max_accel: wp.array2d(dtype=wp.float32)  # [m/s^2]
    max_turn: wp.array2d(dtype=wp.float32)  # steering angle [rad] or yaw rate [rad/s]
    curvature: wp.array3d(dtype=wp.float32)  # [env, robot, turn] `curvature` of the turns that DWA tries [rad/m]
    collision_threshold: wp.array2d(dtype=wp.float32)  # [m]
    clearance: wp.array2d(dtype=wp.float32)  # clearance_factor * collision_threshold [m]
    radar_range: wp.array2d(dtype=wp.float32)  # [m]
    radar_cos_fov: wp.array2d(dtype=wp.float32)  # cosine of half the field of view; -2 sees all round
    radar_cos_beam: wp.array2d(dtype=wp.float32)  # 1 - alpha1
    radar_alpha2: wp.array2d(dtype=wp.float32)  # [m]


@wp.func
def wrap_angle(theta: float) -> float:
    """Angle in [-pi, pi)."""
    return theta - 2.0 * PI * wp.floor((theta + PI) / (2.0 * PI))


@wp.func
def turn_limit(robots: Robots, e: int, i: int) -> float:
    """Largest value of a robot's second control."""
    if robots.kind[e, i] == OMNIDIRECTIONAL:
        return robots.max_accel[e, i]
    return robots.max_turn[e, i]


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


@wp.kernel
def _move_robots(
    # Robots:
    robots: Robots,
    # Settings:
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State in and out:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    path_length: wp.array2d(dtype=wp.float32),  # [env, robot]
    # State out:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
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


def move_robots(launch: Launch, shard: Shard) -> None:
    """Move the robots by one local step."""
    shard.call(launch, _move_robots)
