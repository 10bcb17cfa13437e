"""Maps of the robots and of the team: counting what is new, overlap, merging, sharing.

Flags live in words of 32 radios, ``[env, word, point]``: ``seen`` holds everything a robot has scanned itself,
``known`` what it, or the base station, also heard from others. How many robots have ever seen a point is counted beside
(``viewers``, and in its upper half how many see it in this local step), so that no kernel goes through the words of a
large team. All sums are integers: weights are spacing squared in the map's unit, 1 on maps of even density.
"""

import warp as wp

from maexp.kernels.bandwidth import pass_messages
from maexp.kernels.cpp_snippets import keyed_uniform, next_untold
from maexp.kernels.geometry import segment_distance
from maexp.kernels.launches import Launch, lanes_on
from maexp.kernels.radio import radio_at, receive_signals
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, VIEWER_NOW, Maps, floor_within

wp.set_module_options(MODULE_OPTIONS)

LOSS_KEY = 3 << 24  # apart from other random numbers


@wp.kernel
def _count_points(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    # Scratch in:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # Scratch out:
    discovered: wp.array2d(dtype=wp.int32),  # [env, robot]
    overlap: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Weigh the points robot (e, i) sees now: new to the team, seen by another now."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    first = maps.free_begin[map_id[e]]
    discovered_sum = int(0)
    overlap_sum = int(0)
    for k in range(wp.min(visible_count[e, i], visible.shape[2])):
        j = visible[e, i, k]
        weight = maps.free_weight[first + j]
        viewers = viewers_free[e, 0, j]
        if viewers % VIEWER_NOW == 0:
            discovered_sum += weight
        if viewers / VIEWER_NOW > 1:
            overlap_sum += weight
    discovered[e, i] = discovered_sum
    overlap[e, i] = overlap_sum


@wp.kernel
def _merge_scan(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    seen_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    covered: wp.array(dtype=wp.int32),  # [env]
    shared: wp.array(dtype=wp.int32),  # [env]
):
    """Add the scan of robot (e, i) to what it has seen, and clear the scan's counts.

    A point's first viewer adds it to ``covered``, its second one to ``shared``.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    first = maps.free_begin[map_id[e]]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    covered_sum = int(0)
    shared_sum = int(0)
    for k in range(wp.min(visible_count[e, i], visible.shape[2])):
        j = visible[e, i, k]
        wp.atomic_and(viewers_free, e, 0, j, VIEWER_NOW - 1)
        if (seen_free[e, word, j] & bit) == 0:
            wp.atomic_or(seen_free, e, word, j, bit)
            before = wp.atomic_add(viewers_free, e, 0, j, 1) % VIEWER_NOW
            if before == 0:
                covered_sum += maps.free_weight[first + j]
            elif before == 1:
                shared_sum += maps.free_weight[first + j]
    wp.atomic_add(covered, e, covered_sum)
    wp.atomic_add(shared, e, shared_sum)


@wp.func
def is_blocked(maps: Maps, m: int, a: wp.vec3, b: wp.vec3, width: float) -> bool:
    """Whether a boundary point lies within ``width`` of a segment. Looks at the cells along it only."""
    size = maps.cell_size[m]
    origin = maps.cell_origin[m]
    pad = width + 1.0e-3 * size
    along = b - a
    first = maps.boundary_begin[m]
    top = floor_within(wp.max(a[1], b[1]) + pad - origin[1], size, -1, maps.cells_y[m] - 1)
    for row in range(floor_within(wp.min(a[1], b[1]) - pad - origin[1], size, 0, maps.cells_y[m]), top + 1):
        low = origin[1] + float(row) * size - pad - a[1]
        enter = float(0.0)  # shares of the segment between which it can touch the row
        leave = float(1.0)
        if along[1] != 0.0:
            one = low / along[1]
            two = (low + size + 2.0 * pad) / along[1]
            enter = wp.clamp(wp.min(one, two), 0.0, 1.0)
            leave = wp.clamp(wp.max(one, two), 0.0, 1.0)
        left = a[0] - origin[0] + wp.min(enter * along[0], leave * along[0]) - pad
        right = a[0] - origin[0] + wp.max(enter * along[0], leave * along[0]) + pad
        base = maps.cell_begin[m] + row * maps.cells_x[m]
        begin = base + floor_within(left, size, 0, maps.cells_x[m])
        end = base + floor_within(right, size, -1, maps.cells_x[m] - 1) + 1
        if begin < end:
            for j in range(first + maps.boundary_cell[begin], first + maps.boundary_cell[end]):
                if segment_distance(maps.boundary[j], a, b) < width:
                    return True
    return False


@wp.func
def works(e: int, k: int, failed: wp.array2d(dtype=wp.int32)) -> bool:
    """Whether radio k works: the base station's always does."""
    if k < failed.shape[1]:
        return failed[e, k] == 0
    return True


@wp.kernel
def _hear_robots(
    # Map:
    maps: Maps,
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
    base: wp.array(dtype=wp.vec3),  # [env]
    # State out:
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
):
    """Decide whom radio (e, i) hears: itself, and radios in range (and in sight, if asked); failed ones neither hear
    nor are heard. Messages are lost by (seed, env, episode, step, pair)."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    for w in range(hears.shape[2]):
        hears[e, i, w] = 0
    robots = center.shape[1]
    for other in range(hears.shape[1]):
        low = wp.min(i, other)
        high = wp.max(i, other)
        a = radio_at(e, low, center, base)
        b = radio_at(e, high, center, base)
        heard = wp.length(a - b) <= comm_range and works(e, i, failed) and works(e, other, failed)
        if heard and line_of_sight != 0 and other != i:
            # walls block whatever the radar's obstacle radius: half a diagonal of the spacing closes them
            width = 0.70710678 * maps.resolution[m]
            # one direction for both, lest rounding let only one hear the other
            heard = not is_blocked(maps, m, a, b, width)
        if heard and loss > 0.0:
            key = LOSS_KEY + low * hears.shape[1] + high
            heard = keyed_uniform(seed[0], env_id[e], episode[e], local_step[e], key) >= loss
        if other == i:
            heard = True
        if i < robots and other < robots:
            comm[e, i, other] = heard
        if heard:
            w = other / ROBOTS_PER_WORD
            hears[e, i, w] = hears[e, i, w] | (1 << (other % ROBOTS_PER_WORD))


@wp.func
def count_tellers(
    e: int,
    j: int,
    last: wp.uint32,
    hears: wp.array3d(dtype=wp.int32),
    tells: wp.array2d(dtype=wp.int32),  # [word, point]
) -> int:
    """Radios that tell of a point: somebody who hears them does not know it."""
    words = tells.shape[0]
    tellers = int(0)
    for v in range(words):
        bits = int(0)
        for w in range(words):
            missing = ~wp.uint32(tells[w, j])
            if w == words - 1:
                missing = missing & last
            while missing != wp.uint32(0):
                below = missing - wp.uint32(1)
                listener = w * ROBOTS_PER_WORD + int(wp.bit_count(below & ~missing))
                bits = bits | (hears[e, listener, v] & tells[v, j])
                missing = missing & below
        tellers += wp.bit_count(bits)
    return tellers


@wp.kernel
def _share_points(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    lanes: int,
    weighed: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    seen: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # State in and out:
    known: wp.array3d(dtype=wp.int32),  # [env, word, point]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    cells_sent: wp.array(dtype=wp.int64),  # [env]
    # Scratch out:
    told: wp.array3d(dtype=wp.int32),  # [env, word, point]
):
    """Radio i knows a point if it or a radio it hears has seen it or had been told of it.

    ``told`` holds what each tells, so that news travels one hop a step whatever the order of radios. Free points,
    which are ``weighed``, count in what a radio knows.
    """
    e, lane = wp.tid()
    if active[e] == 0:
        return
    words = seen.shape[1]
    last = ~wp.uint32(0) >> wp.uint32(words * ROBOTS_PER_WORD - hears.shape[1])  # robots of the last word
    sees = seen[e]
    knows = known[e]
    tells = told[e]
    sent = int(0)
    j = next_untold(seen, known, hears, e, lane, lanes)
    while j < seen.shape[2]:
        for w in range(words):
            tells[w, j] = sees[w, j] | knows[w, j]
        heard = int(0)
        for w in range(words):
            result = tells[w, j]
            missing = ~wp.uint32(result)
            if w == words - 1:
                missing = missing & last
            while missing != wp.uint32(0):  # those who do not know it yet
                below = missing - wp.uint32(1)
                bit = int(wp.bit_count(below & ~missing))
                for v in range(words):
                    if (hears[e, w * ROBOTS_PER_WORD + bit, v] & tells[v, j]) != 0:
                        result = result | (1 << bit)
                        heard = 1
                missing = missing & below
            news = wp.uint32(result & ~knows[w, j])
            knows[w, j] = result
            while weighed != 0 and news != wp.uint32(0):
                below = news - wp.uint32(1)
                radio = w * ROBOTS_PER_WORD + int(wp.bit_count(below & ~news))
                wp.atomic_add(known_weight, e, radio, maps.free_weight[maps.free_begin[map_id[e]] + j])
                news = news & below
        if heard != 0:
            sent += count_tellers(e, j, last, hears, tells)
        j = next_untold(seen, known, hears, e, j + lanes, lanes)
    wp.atomic_add(cells_sent, e, wp.int64(sent))


def merge_scan(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Count what is new and what overlaps, and add the scan to the team's map, where ``running`` [env] is set."""
    shard.call(launch, _count_points, active=running)
    shard.call(launch, _merge_scan, active=running)


def share_maps(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Let radios hear from others, where communication is limited and ``running`` [env] is set."""
    if not shard.settings.limited:
        return
    shard.call(launch, _hear_robots, shard.radios, active=running)
    receive_signals(launch, shard, running)
    if shard.settings.messages:
        pass_messages(launch, shard, running)
        return
    for what in ("free", "boundary"):
        seen, known, told = (getattr(shard.view, f"{kind}_{what}") for kind in ("seen", "known", "told"))
        given = {"seen": seen, "known": known, "told": told, "lanes": lanes_on(shard.device, 1024)}
        given["weighed"] = int(what == "free")
        dim = (shard.shape[0], given["lanes"])
        shard.call(launch, _share_points, dim, active=running, **given)
