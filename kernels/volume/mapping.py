"""Maps of robots and of the team in volumes: what a scan adds, how much that is, and what robots tell each other.

Voxels are counted by bits: ``counted`` free ones are the coverage, ``counted_surface`` occupied ones the surface.
"""

import warp as wp

from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD
from maexp.kernels.volume.grid import VoxelMaps, all_set
from maexp.kernels.volume.scan import Sensors, is_due

wp.set_module_options(MODULE_OPTIONS)

LOSS_KEY = 3 << 24  # apart from other random numbers, as in the plane


@wp.kernel
def _merge_scans(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    sensors: Sensors,
    ahead: int,
    limited: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in and out:
    visible_free: wp.array4d(dtype=wp.int32),  # [env, robot, column, word], 0 afterwards
    visible_surface: wp.array4d(dtype=wp.int32),  # [env, robot, column, word], 0 afterwards
    # State in and out:
    seen_free: wp.array4d(dtype=wp.int32),  # [env, robot, column, word]
    known_free: wp.array4d(dtype=wp.int32),  # [env, knower, column, word]
    known_surface: wp.array4d(dtype=wp.int32),  # [env, knower, column, word]
    team_free: wp.array3d(dtype=wp.int32),  # [env, column, word]
    team_surface: wp.array3d(dtype=wp.int32),  # [env, column, word]
    twice_free: wp.array3d(dtype=wp.int32),  # [env, column, word], seen by two robots or more
    covered: wp.array(dtype=wp.int32),  # [env]
    covered_surface: wp.array(dtype=wp.int32),  # [env]
    shared: wp.array(dtype=wp.int32),  # [env]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    # Scratch out:
    discovered: wp.array2d(dtype=wp.int32),  # [env, robot]
    overlap: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Count what the robots of a team see now, and add it to what they have seen: new to the team (of robots that see
    it at once, all have discovered it), and seen by another now."""
    e = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    size = maps.size[m]
    base = maps.begin[m]
    robots = center.shape[1]
    for i in range(robots):
        discovered[e, i] = 0
        overlap[e, i] = 0
    for i in range(robots):
        if is_due(sensors, i, local_step[e] + ahead):
            q = (center[e, i] - maps.origin[m]) / maps.resolution[m]
            r = sensors.reach[i] / maps.resolution[m] + 1.0
            for x in range(wp.max(int(q[0] - r), 0), wp.min(int(q[0] + r) + 1, size[0])):
                for y in range(wp.max(int(q[1] - r), 0), wp.min(int(q[1] + r) + 1, size[1])):
                    c = x * size[1] + y
                    for w in range(visible_free.shape[3]):
                        seen = visible_free[e, i, c, w]
                        if seen != 0:
                            worth = seen & maps.counted[base + c, w]
                            discovered[e, i] = discovered[e, i] + wp.bit_count(worth & ~team_free[e, c, w])
                            others = int(0)
                            for j in range(robots):
                                if j != i:
                                    others = others | visible_free[e, j, c, w]
                            overlap[e, i] = overlap[e, i] + wp.bit_count(worth & others)
    for i in range(robots):
        if is_due(sensors, i, local_step[e] + ahead):
            q = (center[e, i] - maps.origin[m]) / maps.resolution[m]
            r = sensors.reach[i] / maps.resolution[m] + 1.0
            k = wp.where(limited != 0, i, 0)
            for x in range(wp.max(int(q[0] - r), 0), wp.min(int(q[0] + r) + 1, size[0])):
                for y in range(wp.max(int(q[1] - r), 0), wp.min(int(q[1] + r) + 1, size[1])):
                    c = x * size[1] + y
                    for w in range(visible_free.shape[3]):
                        free = visible_free[e, i, c, w]
                        if free != 0:
                            visible_free[e, i, c, w] = 0
                            counted = maps.counted[base + c, w]
                            before = team_free[e, c, w]
                            news = free & ~seen_free[e, i, c, w]
                            again = news & before & ~twice_free[e, c, w]
                            covered[e] = covered[e] + wp.bit_count(free & ~before & counted)
                            shared[e] = shared[e] + wp.bit_count(again & counted)
                            twice_free[e, c, w] = twice_free[e, c, w] | again
                            team_free[e, c, w] = before | free
                            seen_free[e, i, c, w] = seen_free[e, i, c, w] | free
                            if limited != 0:
                                heard = counted & free & ~known_free[e, k, c, w]
                                known_weight[e, i] = known_weight[e, i] + wp.bit_count(heard)
                            known_free[e, k, c, w] = known_free[e, k, c, w] | free
                        solid = visible_surface[e, i, c, w]
                        if solid != 0:
                            visible_surface[e, i, c, w] = 0
                            news = solid & ~team_surface[e, c, w] & maps.counted_surface[base + c, w]
                            covered_surface[e] = covered_surface[e] + wp.bit_count(news)
                            team_surface[e, c, w] = team_surface[e, c, w] | solid
                            known_surface[e, k, c, w] = known_surface[e, k, c, w] | solid


@wp.kernel
def _hear_robots(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    comm_range: float,
    line_of_sight: int,
    loss: float,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # State out:
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
):
    """Decide whom robot (e, i) hears: itself, and robots in range (and in sight, if asked); failed ones neither hear
    nor are heard. Messages are lost by (seed, env, episode, step, pair)."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    robots = center.shape[1]
    for w in range(hears.shape[2]):
        hears[e, i, w] = 0
    for other in range(robots):
        low = wp.min(i, other)
        high = wp.max(i, other)
        a = (center[e, low] - maps.origin[m]) / maps.resolution[m]
        b = (center[e, high] - maps.origin[m]) / maps.resolution[m]
        heard = wp.length(center[e, low] - center[e, high]) <= comm_range
        heard = heard and failed[e, i] == 0 and failed[e, other] == 0
        if heard and line_of_sight != 0 and other != i:
            heard = all_set(maps.occupied, maps.begin[m], maps.size[m], a, b, False)
        if heard and loss > 0.0:
            key = LOSS_KEY + low * robots + high
            heard = keyed_uniform(seed[0], env_id[e], episode[e], local_step[e], key) >= loss
        if other == i:
            heard = True
        comm[e, i, other] = heard
        if heard:
            w = other / ROBOTS_PER_WORD
            hears[e, i, w] = hears[e, i, w] | (1 << (other % ROBOTS_PER_WORD))


@wp.kernel
def _share_maps(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    # State in and out:
    known_free: wp.array4d(dtype=wp.int32),  # [env, robot, column, word]
    known_surface: wp.array4d(dtype=wp.int32),  # [env, robot, column, word]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    cells_sent: wp.array(dtype=wp.int64),  # [env]
    # Scratch out:
    told_free: wp.array4d(dtype=wp.int32),  # [env, robot, column, word]
    told_surface: wp.array4d(dtype=wp.int32),  # [env, robot, column, word]
):
    """Robots learn what those that they hear knew before: news travels one hop a step. A robot sends a voxel once,
    however many hear it."""
    e = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    robots = known_free.shape[1]
    sent = int(0)
    for c in range(maps.size[m][0] * maps.size[m][1]):
        for w in range(known_free.shape[3]):
            some = int(0)
            for i in range(robots):
                told_free[e, i, c, w] = known_free[e, i, c, w]
                told_surface[e, i, c, w] = known_surface[e, i, c, w]
                some = some | known_free[e, i, c, w] | known_surface[e, i, c, w]
            if some != 0:
                for i in range(robots):
                    free = told_free[e, i, c, w]
                    solid = told_surface[e, i, c, w]
                    for j in range(robots):
                        if comm[e, i, j]:
                            free = free | told_free[e, j, c, w]
                            solid = solid | told_surface[e, j, c, w]
                    news = free & ~told_free[e, i, c, w] & maps.counted[maps.begin[m] + c, w]
                    known_weight[e, i] = known_weight[e, i] + wp.bit_count(news)
                    known_free[e, i, c, w] = free
                    known_surface[e, i, c, w] = solid
                for j in range(robots):
                    lacks = int(0)
                    for i in range(robots):
                        if i != j and comm[e, i, j]:
                            lacks = lacks | (told_free[e, j, c, w] & ~told_free[e, i, c, w])
                    sent += wp.bit_count(lacks)
    cells_sent[e] = cells_sent[e] + wp.int64(sent)


@wp.kernel
def _clear_words(
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # Out:
    words: wp.array3d(dtype=wp.int32),  # [env, column, word]
):
    e, c = wp.tid()
    if mask[e] != 0:
        for w in range(words.shape[2]):
            words[e, c, w] = 0


def merge_scans(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """Add what robots see to what they and the team know, in the envs where ``running`` [env] is set."""
    shard.call(launch, _merge_scans, shard.shape[0], active=running, ahead=ahead)


def share_maps(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Let robots hear from others, where communication is limited and ``running`` [env] is set."""
    if shard.settings.limited:
        shard.call(launch, _hear_robots, active=running)
        shard.call(launch, _share_maps, shard.shape[0], active=running)


def forget_maps(launch: Launch, shard: Shard) -> None:
    """Clear what is known in the envs of ``mask``."""
    s = shard.view
    words = [s.seen_free, s.known_free, s.known_surface, s.team_free, s.team_surface, s.twice_free]
    for flags in (*words, s.visible_free, s.visible_surface):
        flat = flags.reshape((flags.shape[0], -1, flags.shape[-1]))
        shard.call(launch, _clear_words, flat.shape[:2], words=flat)
