"""Odometry that drifts: where robots believe to be, and how far that is from where they are.

With every step the error of a robot's estimate grows by a random walk: on a way of d metres by `odometry_drift` sqrt(d)
along each axis and `odometry_turn` sqrt(d) in its heading, normally distributed; and what it drives is added up in the
heading that it believes. Jumps add `odometry_jump` along each axis, `odometry_jump_rate` times a second. All is drawn
by (seed, env, episode, step, robot).

A robot plans its way by where it believes to be, and drives it by what its radar shows: walls and other robots are as
far from it as they are, and only the place that it drives to is off by the error.
"""

import warp as wp

from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.dynamics import Robots, wrap_angle
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import PI, Maps, point_xy

wp.set_module_options(MODULE_OPTIONS)

ODOMETRY_KEY = 5 << 24  # apart from other random numbers
DRAWS = 8  # keys of a robot in a step


@wp.func
def keyed_normal(seed: int, env_id: int, episode: int, step: int, index: int) -> float:
    """A normally distributed number, from those of ``index`` and the one after it (Box and Muller 1958)."""
    share = 1.0 - keyed_uniform(seed, env_id, episode, step, index)
    return wp.sqrt(-2.0 * wp.log(share)) * wp.cos(2.0 * PI * keyed_uniform(seed, env_id, episode, step, index + 1))


@wp.kernel
def _drift_odometry(
    # Settings:
    odometry_drift: float,
    odometry_turn: float,
    odometry_jump: float,
    odometry_jump_rate: float,
    dt: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    # State in and out:
    odometry_error: wp.array2d(dtype=wp.vec3),  # [env, robot]
):
    """Add to the error of robot (e, i) what the way adds that it is about to drive in this step."""
    e, i = wp.tid()
    if active[e] == 0 or collided[e, i] != 0:
        return
    old = pose[e, i]
    off = odometry_error[e, i]
    step = local_step[e]
    key = ODOMETRY_KEY + DRAWS * i
    wander = wp.sqrt(wp.length(wp.vec2(old[2], slip[e, i])) * dt)
    scale = odometry_drift * wander
    if odometry_jump_rate > 0.0:
        if keyed_uniform(seed[0], env_id[e], episode[e], step, key + 6) < odometry_jump_rate * dt:
            scale = wp.sqrt(scale * scale + odometry_jump * odometry_jump)
    if scale == 0.0 and wander == 0.0:
        return
    along = keyed_normal(seed[0], env_id[e], episode[e], step, key)
    across = keyed_normal(seed[0], env_id[e], episode[e], step, key + 2)
    turned = keyed_normal(seed[0], env_id[e], episode[e], step, key + 4)
    c = wp.cos(old[3])
    s = wp.sin(old[3])
    true_way = wp.vec2(old[2] * c - slip[e, i] * s, old[2] * s + slip[e, i] * c) * dt
    c = wp.cos(off[2])
    s = wp.sin(off[2])
    x = off[0] + (c - 1.0) * true_way[0] - s * true_way[1] + scale * along
    y = off[1] + s * true_way[0] + (c - 1.0) * true_way[1] + scale * across
    odometry_error[e, i] = wp.vec3(x, y, off[2] + odometry_turn * wander * turned)


@wp.kernel
def _estimate_poses(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    begins: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    # State in and out:
    odometry_error: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # State out:
    pose_estimate: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center_estimate: wp.array2d(dtype=wp.vec3),  # [env, robot]
):
    """Where robot (e, i) believes to be: without an error where its episode ``begins``, and never off the map."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    if begins != 0:
        odometry_error[e, i] = wp.vec3(0.0, 0.0, 0.0)
    m = map_id[e]
    off = odometry_error[e, i]
    true = pose[e, i]
    theta = wrap_angle(true[3] + off[2])
    forward = robots.center_offset[e, i] * wp.vec2(wp.cos(theta), wp.sin(theta))
    at = wp.vec2(true[0] + off[0], true[1] + off[1]) + forward
    at = wp.max(wp.min(at, maps.upper[m]), maps.lower[m])
    center_estimate[e, i] = wp.vec3(at[0], at[1], 0.0)
    pose_estimate[e, i] = wp.vec4(at[0] - forward[0], at[1] - forward[1], true[2], theta)


@wp.func
def place_from(true: wp.vec3, believed: wp.vec3, turn: float, place: wp.vec2) -> wp.vec2:
    """Where a robot drives that wants to get to a place of its map; ``turn``: its heading less what it believes."""
    c = wp.cos(turn)
    s = wp.sin(turn)
    way = place - point_xy(believed)
    return point_xy(true) + wp.vec2(c * way[0] - s * way[1], s * way[0] + c * way[1])


@wp.kernel
def _take_aim(
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    pose_estimate: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center_estimate: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # Scratch out:
    goal_aim: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint_aim: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Where the goal and the waypoint of robot (e, i) lie as it drives to them."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    turn = pose[e, i][3] - pose_estimate[e, i][3]
    goal_aim[e, i] = place_from(center[e, i], center_estimate[e, i], turn, goal[e, i])
    waypoint_aim[e, i] = place_from(center[e, i], center_estimate[e, i], turn, waypoint[e, i])


def drift_odometry(launch: Launch, shard: Shard) -> None:
    """Let the robots' estimates drift, if they do, by the way that they drive next."""
    if shard.settings.drifts:
        shard.call(launch, _drift_odometry)


def estimate_poses(launch: Launch, shard: Shard, running: wp.array, begins: int) -> None:
    """Where robots believe to be, if that drifts, in the envs where ``running`` [env] is set; ``begins``: 1 at a
    reset."""
    if shard.settings.drifts:
        shard.call(launch, _estimate_poses, active=running, begins=begins)


def take_aim(launch: Launch, shard: Shard) -> None:
    """Where robots drive that are elsewhere than they believe (`Shard.aims`), once their waypoints are set."""
    if shard.settings.drifts:
        shard.call(launch, _take_aim)
