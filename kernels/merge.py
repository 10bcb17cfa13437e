"""Maps of the robots and of the team (design 4.2): counting what is new, overlap, merging, sharing.

Flags live in words of 32 robots, ``[env, word, point]``. ``now`` holds the scan of this local step,
``seen`` everything a robot has scanned itself, ``known`` what it also heard from others.
All sums are integers: weights are spacing squared in the map's unit, 1 on maps of even density.
"""

import warp as wp

from maexp.kernels.types import ROBOTS_PER_WORD, Maps

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile


@wp.func
def many_bits(word: int) -> bool:
    return wp.bit_count(word) > 1


@wp.kernel
def _count_points(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    # State in:
    active: wp.array(dtype=wp.int32),
    now_free: wp.array3d(dtype=wp.int32),
    seen_free: wp.array3d(dtype=wp.int32),
    visible: wp.array3d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    # Out:
    fresh: wp.array2d(dtype=wp.int32),
    overlap: wp.array2d(dtype=wp.int32),
    covered: wp.array(dtype=wp.int32),
    shared: wp.array(dtype=wp.int32),
):
    """Weigh the points robot (e, i) sees now: new to the team, seen by another now; update the team's sums.

    ``covered`` grows by points nobody had seen, ``shared`` by points that now have two or more viewers;
    of several robots that see a point now the lowest one reports it.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    first = maps.free_begin[map_id[e]]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    below = ~(-1 << (i % ROBOTS_PER_WORD))
    words = now_free.shape[1]
    fresh_sum = int(0)
    overlap_sum = int(0)
    covered_sum = int(0)
    shared_sum = int(0)
    for k in range(wp.min(visible_count[e, i], visible.shape[2])):
        j = visible[e, i, k]
        weight = maps.free_weight[first + j]
        others = int(0)  # does another robot see it now?
        lowest = int(1)  # is this the lowest robot that sees it now?
        before = int(0)  # viewers before this step: 0, 1, 2 (or more)
        after = int(0)
        for w in range(words):
            now = now_free[e, w, j]
            old = seen_free[e, w, j]
            if now != 0:
                if w != word or (now & ~bit) != 0:
                    others = 1
                if w < word or (w == word and (now & below) != 0):
                    lowest = 0
            if old != 0:
                before = wp.where(before > 0 or many_bits(old), 2, 1)
            merged = old | now
            if merged != 0:
                after = wp.where(after > 0 or many_bits(merged), 2, 1)
        if before == 0:
            fresh_sum += weight
        if others != 0:
            overlap_sum += weight
        if lowest != 0:
            if before == 0:
                covered_sum += weight
            if before < 2 and after == 2:
                shared_sum += weight
    fresh[e, i] = fresh_sum
    overlap[e, i] = overlap_sum
    wp.atomic_add(covered, e, covered_sum)
    wp.atomic_add(shared, e, shared_sum)


@wp.kernel
def _merge_scan(
    # State in:
    active: wp.array(dtype=wp.int32),
    visible: wp.array3d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    # State out:
    now_free: wp.array3d(dtype=wp.int32),
    seen_free: wp.array3d(dtype=wp.int32),
):
    """Add the scan of robot (e, i) to what it has seen and clear the scan's flags."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    for k in range(wp.min(visible_count[e, i], visible.shape[2])):
        j = visible[e, i, k]
        wp.atomic_or(seen_free, e, word, j, bit)
        wp.atomic_and(now_free, e, word, j, ~bit)


@wp.kernel
def _hear_robots(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    # State in:
    active: wp.array(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
    comm_range: float,
    line_of_sight: int,
    # State out:
    comm: wp.array3d(dtype=wp.bool),
    hears: wp.array3d(dtype=wp.int32),
):
    """Decide whom robot (e, i) hears: itself, and robots in range (and in sight, if asked)."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    for w in range(hears.shape[2]):
        hears[e, i, w] = 0
    for other in range(center.shape[1]):
        heard = wp.length(center[e, i] - center[e, other]) <= comm_range
        if heard and line_of_sight != 0 and other != i:
            # walls block whatever the radar's obstacle radius: half a diagonal of the spacing closes them
            width = 0.70710678 * maps.resolution[m]
            a = center[e, wp.min(i, other)]  # one direction for both, lest rounding let only one hear the other
            b = center[e, wp.max(i, other)]
            for j in range(maps.boundary_begin[m], maps.boundary_begin[m + 1]):
                if segment_distance(maps.boundary[j], a, b) < width:
                    heard = False
                    break
        if other == i:
            heard = True
        comm[e, i, other] = heard
        if heard:
            w = other / ROBOTS_PER_WORD
            hears[e, i, w] = hears[e, i, w] | (1 << (other % ROBOTS_PER_WORD))


@wp.func
def segment_distance(p: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    along = b - a
    t = wp.clamp(wp.dot(p - a, along) / wp.max(wp.dot(along, along), 1.0e-12), 0.0, 1.0)
    return wp.length(p - a - t * along)


@wp.kernel
def _share_points(
    # State in:
    active: wp.array(dtype=wp.int32),
    hears: wp.array3d(dtype=wp.int32),
    seen: wp.array3d(dtype=wp.int32),
    told: wp.array3d(dtype=wp.int32),
    # State out:
    known: wp.array3d(dtype=wp.int32),
):
    """Robot i knows a point if it has seen it or a robot it hears had seen or been ``told`` of it."""
    e, j = wp.tid()
    if active[e] == 0:
        return
    words = seen.shape[1]
    anyone = int(0)
    for w in range(words):
        anyone = anyone | seen[e, w, j] | told[e, w, j]
    if anyone == 0:
        return
    for w in range(words):
        result = int(0)
        for b in range(ROBOTS_PER_WORD):
            i = w * ROBOTS_PER_WORD + b
            if i < hears.shape[1]:
                for v in range(words):
                    if (hears[e, i, v] & (seen[e, v, j] | told[e, v, j])) != 0:
                        result = result | (1 << b)
        known[e, w, j] = result | seen[e, w, j] | told[e, w, j]


@wp.kernel
def _copy_flags(
    # State in:
    active: wp.array(dtype=wp.int32),
    flags: wp.array3d(dtype=wp.int32),
    # Scratch out:
    copy: wp.array3d(dtype=wp.int32),
):
    """Freeze flags, so that news travels one hop a step whatever the order of threads."""
    e, w, j = wp.tid()
    if active[e] != 0:
        copy[e, w, j] = flags[e, w, j]
