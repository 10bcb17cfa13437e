"""Masked reset: choose the map, clear the flags, place the team.

Random numbers are keyed by (seed, env, episode), so env i plays the same episodes for any batch size.
"""

import warp as wp

from maexp.kernels.bandwidth import forget_messages
from maexp.kernels.drifting_maps import forget_drawings
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import Launch, lanes_on
from maexp.kernels.sensing import forget_returns
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import BESIDE, ERROR_START, PI, ROOM_UNIT, START_CLEARANCE, Maps, point_xy

wp.set_module_options(MODULE_OPTIONS)

TRIES = 64
EVALUATION = 2**30
"""Number of the first episode in the keys of evaluation episodes, beyond those of any training run."""


@wp.func
def start_is_free(
    maps: Maps, robots: Robots, e: int, i: int, point: int, p: wp.vec3, center: wp.array2d(dtype=wp.vec3)
) -> bool:
    """Whether robot i may start at free point ``point``, robots 0 .. i - 1 being placed."""
    need = START_CLEARANCE * robots.collision_threshold[e, i]
    if maps.free_clearance[point] < need:
        return False
    for other in range(i):
        room = wp.max(need, START_CLEARANCE * robots.collision_threshold[e, other])
        if wp.length(center[e, other] - p) < room:
            return False
    return True


@wp.func
def find_beside(
    maps: Maps, robots: Robots, e: int, i: int, first: int, count: int, center: wp.array2d(dtype=wp.vec3)
) -> int:
    """The free point nearest to robot 0 where robot i has room beside one of robots 0 .. i - 1; -1: there is none.

    Both keep so far from walls that none fits between two places beside each other.
    """
    best = int(-1)
    nearest = wp.float32(wp.inf)
    for j in range(first, first + count):
        p = maps.free[j]
        gap = wp.length(p - center[e, 0])
        if gap < nearest:
            if start_is_free(maps, robots, e, i, j, p, center):
                for other in range(i):
                    larger = wp.max(robots.collision_threshold[e, i], robots.collision_threshold[e, other])
                    if wp.length(center[e, other] - p) <= BESIDE * START_CLEARANCE * larger:
                        nearest = gap
                        best = j
    return best


@wp.func
def gather_team(
    maps: Maps, robots: Robots, e: int, start: int, first: int, count: int, center: wp.array2d(dtype=wp.vec3)
) -> bool:
    """Place robot 0 at free point ``start`` and the others beside it; whether there is room for all."""
    if not start_is_free(maps, robots, e, 0, start, maps.free[start], center):
        return False
    center[e, 0] = maps.free[start]
    for i in range(1, center.shape[1]):
        point = find_beside(maps, robots, e, i, first, count, center)
        if point < 0:
            return False
        center[e, i] = maps.free[point]
    return True


@wp.func
def put_robot(
    e: int,
    i: int,
    at: wp.vec2,
    theta: float,
    robots: Robots,
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
):
    """Robot i stands with its centre at ``at``."""
    back = robots.center_offset[e, i]
    pose[e, i] = wp.vec4(at[0] - back * wp.cos(theta), at[1] - back * wp.sin(theta), 0.0, theta)
    center[e, i] = wp.vec3(at[0], at[1], 0.0)


@wp.kernel
def _place_team(
    # Map:
    maps: Maps,
    map_starts: wp.array2d(dtype=wp.vec3),  # [map, robot] the same; inf: drawn
    # Robots:
    robots: Robots,
    # Settings:
    num_maps: int,
    together: int,
    # State in:
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    starts: wp.array2d(dtype=wp.vec3),  # [env, robot] x, y [m], heading [rad]; inf: those of the map
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    map_id: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
):
    """Draw the map of a new episode and, where none is given, a start for every robot: clear of walls and of the
    others, any heading; or a place where the team starts ``together``."""
    e = wp.tid()
    if mask[e] == 0:
        return
    # rand_init mixes seed and offset; the first draw keeps episodes of neighbouring envs apart.
    key = wp.rand_init(seed[0], env_id[e])
    rng = wp.rand_init(wp.randi(key), episode[e])
    m = wp.randi(rng, 0, num_maps)
    if episode[e] >= EVALUATION:  # evaluation takes the maps in turn, so that each is played as often as the others
        first_map = wp.rand_init(seed[0])
        m = (env_id[e] + (episode[e] - EVALUATION) + wp.randi(first_map, 0, num_maps)) % num_maps
    map_id[e] = m
    first = maps.free_begin[m]
    count = maps.free_begin[m + 1] - first
    given = wp.isfinite(starts[e, 0])
    if given or wp.isfinite(map_starts[m, 0]):
        for i in range(pose.shape[1]):
            start = map_starts[m, i]
            if given:
                start = starts[e, i]
            put_robot(e, i, wp.vec2(start[0], start[1]), start[2], robots, pose, center)
        return
    if together != 0:
        shift = wp.randi(rng, 0, count)
        gathered = wp.bool(False)
        for k in range(TRIES + count):  # crowded: the first that fits after a random one
            place = first + (k + shift) % count
            if k < TRIES:
                place = first + wp.randi(rng, 0, count)
            gathered = gather_team(maps, robots, e, place, first, count, center)
            if gathered:
                break
        if not gathered:
            wp.atomic_or(error, e, ERROR_START)
        for i in range(pose.shape[1]):
            put_robot(e, i, point_xy(center[e, i]), PI * (2.0 * wp.randf(rng) - 1.0), robots, pose, center)
        return
    crowded = wp.bool(False)
    for i in range(pose.shape[1]):
        point = int(-1)
        for _try in range(TRIES):
            j = first + wp.randi(rng, 0, count)
            if point < 0 and start_is_free(maps, robots, e, i, j, maps.free[j], center):
                point = j
        if point < 0:  # crowded: take the first free start after a random one
            shift = wp.randi(rng, 0, count)
            for k in range(count):
                j = first + (k + shift) % count
                if start_is_free(maps, robots, e, i, j, maps.free[j], center):
                    point = j
                    break
        theta = PI * (2.0 * wp.randf(rng) - 1.0)
        if point < 0:
            if not crowded:
                wp.atomic_or(error, e, ERROR_START + ROOM_UNIT * i)
            crowded = True
            point = first
        put_robot(e, i, point_xy(maps.free[point]), theta, robots, pose, center)


@wp.kernel
def _clear_flags(
    # Settings:
    lanes: int,
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    flags: wp.array3d(dtype=wp.int32),  # [env, word, point]
):
    e, w, lane = wp.tid()
    if mask[e] != 0:
        for j in range(lane, flags.shape[2], lanes):
            flags[e, w, j] = 0


@wp.kernel
def _clear_env(
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    covered: wp.array(dtype=wp.int32),  # [env]
    covered_before: wp.array(dtype=wp.int32),  # [env]
    covered_sum: wp.array(dtype=wp.int64),  # [env]
    shared: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    macro_step: wp.array(dtype=wp.int32),  # [env]
    terminated: wp.array(dtype=wp.int32),  # [env]
    milestone_step: wp.array2d(dtype=wp.int32),  # [env, mark]
    milestone_overlap: wp.array2d(dtype=wp.float32),  # [env, mark]
):
    e = wp.tid()
    if mask[e] == 0:
        return
    covered[e] = 0
    covered_before[e] = 0
    covered_sum[e] = wp.int64(0)
    shared[e] = 0
    local_step[e] = 0
    macro_step[e] = 0
    terminated[e] = 0
    for k in range(milestone_step.shape[1]):
        milestone_step[e, k] = -1
        milestone_overlap[e, k] = 0.0


@wp.kernel
def _clear_robots(
    # State in:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    path_length: wp.array2d(dtype=wp.float32),  # [env, robot]
    milestone_path: wp.array3d(dtype=wp.float32),  # [env, robot, mark]
    terms: wp.array3d(dtype=wp.float32),  # [env, robot, term]
    unscaled: wp.array3d(dtype=wp.float32),  # [env, robot, term]
    episode_reward: wp.array2d(dtype=wp.float32),  # [env, robot]
    # Scratch out:
    crashed: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    e, i = wp.tid()
    if mask[e] == 0:
        return
    slip[e, i] = 0.0
    control[e, i] = wp.vec2(0.0, 0.0)
    goal[e, i] = point_xy(center[e, i])
    waypoint[e, i] = point_xy(center[e, i])
    collided[e, i] = 0
    crashed[e, i] = 0
    path_length[e, i] = 0.0
    episode_reward[e, i] = 0.0
    for k in range(milestone_path.shape[2]):
        milestone_path[e, i, k] = 0.0
    for k in range(terms.shape[2]):
        terms[e, i, k] = 0.0
        unscaled[e, i, k] = 0.0


@wp.kernel
def _start_env(
    # State in:
    covered: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    covered_before: wp.array(dtype=wp.int32),  # [env]
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch out:
    discovered: wp.array2d(dtype=wp.int32),  # [env, robot]
    overlap: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """The scan at reset counts in coverage and earns nothing."""
    e = wp.tid()
    if mask[e] == 0:
        return
    covered_before[e] = covered[e]
    active[e] = 1
    for i in range(discovered.shape[1]):
        discovered[e, i] = 0
        overlap[e, i] = 0


def place_teams(launch: Launch, shard: Shard) -> None:
    """Clear the envs of ``mask``, choose their maps and place their robots."""
    s = shard.view
    flags = [s.seen_free, s.seen_boundary, s.viewers_free, s.viewers_boundary]
    if shard.settings.limited:
        flags += [s.known_free, s.known_boundary]
    if shard.settings.false_alarms:
        flags.append(s.false_walls)
    lanes = lanes_on(shard.device, 1024)
    for flag in flags:
        shard.call(launch, _clear_flags, (*flag.shape[:2], lanes), flags=flag, lanes=lanes)
    forget_returns(launch, shard)
    forget_messages(launch, shard)
    forget_drawings(launch, shard)
    shard.call(launch, _clear_env, shard.shape[0])
    shard.call(launch, _place_team, shard.shape[0])
    shard.call(launch, _clear_robots)


def start_episodes(launch: Launch, shard: Shard) -> None:
    """Let the envs of ``mask`` run, once their robots have taken the first scan."""
    shard.call(launch, _start_env, shard.shape[0])
