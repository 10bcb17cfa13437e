"""Masked reset in volumes: choose the map, place the team, forget the last episode.

Random numbers are keyed by (seed, env, episode), so env i plays the same episodes for any batch size.
"""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.reset import EVALUATION, TRIES, _clear_env
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import BESIDE, ERROR_START, PI, ROOM_UNIT, START_CLEARANCE

wp.set_module_options(MODULE_OPTIONS)


@wp.struct
class StartPlaces:
    """Where robots may start: in the middle of voxels that their kind can stand in, clear of walls. G kinds, M maps."""

    point: wp.array(dtype=wp.vec3)  # [m], of one kind and map after another
    begin: wp.array2d(dtype=wp.int32)  # [G, M + 1], the first of each map
    kind: wp.array(dtype=wp.int32)  # [robot]
    threshold: wp.array(dtype=wp.float32)  # [robot], a centre this near to a wall or another centre collides [m]


@wp.func
def has_room(places: StartPlaces, e: int, i: int, p: wp.vec3, center: wp.array2d(dtype=wp.vec3)) -> bool:
    """Whether robot i may start at ``p`` beside robots 0 .. i - 1."""
    for other in range(i):
        larger = wp.max(places.threshold[i], places.threshold[other])
        if wp.length(center[e, other] - p) < START_CLEARANCE * larger:
            return False
    return True


@wp.func
def find_beside(places: StartPlaces, e: int, i: int, m: int, center: wp.array2d(dtype=wp.vec3)) -> int:
    """The place nearest to robot 0 where robot i has room beside one of robots 0 .. i - 1; -1: there is none."""
    best = int(-1)
    nearest = wp.float32(wp.inf)
    for j in range(places.begin[places.kind[i], m], places.begin[places.kind[i], m + 1]):
        p = places.point[j]
        gap = wp.length(p - center[e, 0])
        if gap < nearest:
            if has_room(places, e, i, p, center):
                for other in range(i):
                    larger = wp.max(places.threshold[i], places.threshold[other])
                    if wp.length(center[e, other] - p) <= BESIDE * START_CLEARANCE * larger:
                        nearest = gap
                        best = j
    return best


@wp.func
def gather_team(places: StartPlaces, e: int, start: int, m: int, center: wp.array2d(dtype=wp.vec3)) -> bool:
    """Place robot 0 at place ``start`` and the others beside it; whether there is room for all."""
    center[e, 0] = places.point[start]
    for i in range(1, center.shape[1]):
        j = find_beside(places, e, i, m, center)
        if j < 0:
            return False
        center[e, i] = places.point[j]
    return True


@wp.kernel
def _place_team(
    # Map:
    map_starts: wp.array2d(dtype=wp.vec4),  # [map, robot] x, y, z [m], heading [rad]; inf: drawn
    # Settings:
    places: StartPlaces,
    num_maps: int,
    together: int,
    # State in:
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    starts: wp.array2d(dtype=wp.vec4),  # [env, robot] the same; inf: those of the map
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    map_id: wp.array(dtype=wp.int32),  # [env]
    covered_surface: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
):
    """Draw the map of a new episode and, where none is given, a start for every robot: clear of walls and of the
    others, any heading; or a place where the team starts ``together``."""
    e = wp.tid()
    if mask[e] == 0:
        return
    key = wp.rand_init(seed[0], env_id[e])
    rng = wp.rand_init(wp.randi(key), episode[e])
    m = wp.randi(rng, 0, num_maps)
    if episode[e] >= EVALUATION:  # evaluation takes the maps in turn, so that each is played as often as the others
        first_map = wp.rand_init(seed[0])
        m = (env_id[e] + (episode[e] - EVALUATION) + wp.randi(first_map, 0, num_maps)) % num_maps
    map_id[e] = m
    covered_surface[e] = 0
    robots = pose.shape[1]
    if wp.isfinite(starts[e, 0][0]) or wp.isfinite(map_starts[m, 0][0]):
        for i in range(robots):
            start = map_starts[m, i]
            if wp.isfinite(starts[e, 0][0]):
                start = starts[e, i]
            center[e, i] = wp.vec3(start[0], start[1], start[2])
            pose[e, i] = wp.vec4(start[0], start[1], 0.0, start[3])
        return
    first = places.begin[places.kind[0], m]
    count = places.begin[places.kind[0], m + 1] - first
    if together != 0:
        gathered = wp.bool(False)
        shift = wp.randi(rng, 0, count)
        for k in range(TRIES + count):  # crowded: the first that fits after a random one
            j = first + (k + shift) % count
            if k < TRIES:
                j = first + wp.randi(rng, 0, count)
            gathered = gather_team(places, e, j, m, center)
            if gathered:
                break
        if not gathered:
            wp.atomic_or(error, e, ERROR_START)
    else:
        crowded = wp.bool(False)
        for i in range(robots):
            first = places.begin[places.kind[i], m]
            count = places.begin[places.kind[i], m + 1] - first
            place = int(-1)
            for _try in range(TRIES):
                j = first + wp.randi(rng, 0, count)
                if place < 0 and has_room(places, e, i, places.point[j], center):
                    place = j
            if place < 0:  # crowded: take the first free place after a random one
                shift = wp.randi(rng, 0, count)
                for k in range(count):
                    j = first + (k + shift) % count
                    if has_room(places, e, i, places.point[j], center):
                        place = j
                        break
            if place < 0:
                if not crowded:
                    wp.atomic_or(error, e, ERROR_START + ROOM_UNIT * i)
                crowded = True
                place = first
            center[e, i] = places.point[place]
    for i in range(robots):
        p = center[e, i]
        pose[e, i] = wp.vec4(p[0], p[1], 0.0, PI * (2.0 * wp.randf(rng) - 1.0))


@wp.kernel
def _clear_robots(
    # State in:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    velocity: wp.array2d(dtype=wp.vec3),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec4),  # [env, robot]
    way_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    way_next: wp.array2d(dtype=wp.int32),  # [env, robot]
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
    velocity[e, i] = wp.vec3(0.0, 0.0, 0.0)
    slip[e, i] = 0.0
    control[e, i] = wp.vec2(0.0, 0.0)
    p = center[e, i]
    goal[e, i] = wp.vec4(p[0], p[1], p[2], pose[e, i][3])
    way_count[e, i] = 0
    way_next[e, i] = 0
    collided[e, i] = 0
    crashed[e, i] = 0
    path_length[e, i] = 0.0
    episode_reward[e, i] = 0.0
    for k in range(milestone_path.shape[2]):
        milestone_path[e, i, k] = 0.0
    for k in range(terms.shape[2]):
        terms[e, i, k] = 0.0
        unscaled[e, i, k] = 0.0


def place_teams(launch: Launch, shard: Shard) -> None:
    """Clear the envs of ``mask``, choose their maps and place their robots."""
    shard.call(launch, _clear_env, shard.shape[0])
    shard.call(launch, _place_team, shard.shape[0])
    shard.call(launch, _clear_robots)
