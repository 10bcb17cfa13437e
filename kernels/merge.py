"""Maps of the robots and of the team: counting what is new, overlap, merging, sharing.

Flags live in words of 32 robots, ``[env, word, point]``: ``seen`` holds everything a robot has scanned itself,
``known`` what it also heard from others. How many robots have ever seen a point is counted beside (``viewers``, and in
its upper half how many see it in this local step), so that no kernel goes through the words of a large team.
All sums are integers: weights are spacing squared in the map's unit, 1 on maps of even density.
"""

from typing import TYPE_CHECKING

import warp as wp

from maexp.kernels.geometry import segment_distance
from maexp.kernels.launches import Launch
from maexp.kernels.types import ROBOTS_PER_WORD, VIEWER_NOW, Maps

if TYPE_CHECKING:
    from maexp.kernels.shards import Shard

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile


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


@wp.kernel
def _hear_robots(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    comm_range: float,
    line_of_sight: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # State out:
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    hears: wp.array3d(dtype=wp.int32),  # [env, robot, word]
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


@wp.kernel
def _share_points(
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    hears: wp.array3d(dtype=wp.int32),  # [env, robot, word]
    seen: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # Scratch in:
    told: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # State out:
    known: wp.array3d(dtype=wp.int32),  # [env, word, point]
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
    active: wp.array(dtype=wp.int32),  # [env]
    flags: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # Scratch out:
    copy: wp.array3d(dtype=wp.int32),  # [env, word, point]
):
    """Freeze flags, so that news travels one hop a step whatever the order of threads."""
    e, w, j = wp.tid()
    if active[e] != 0:
        copy[e, w, j] = flags[e, w, j]


def merge_scan(launch: Launch, shard: "Shard", running: wp.array) -> None:
    """Count what is new and what overlaps, and add the scan to the team's map, where ``running`` [env] is set."""
    shard.call(launch, _count_points, "discovered overlap", active=running)
    shard.call(launch, _merge_scan, "seen_free viewers_free covered shared", active=running)


def share_maps(launch: Launch, shard: "Shard", running: wp.array) -> None:
    """Let robots hear from others, where communication is limited and ``running`` [env] is set."""
    if not shard.settings.limited:
        return
    shard.call(launch, _hear_robots, "comm hears", active=running)
    for what in ("free", "boundary"):
        seen, told, known = (getattr(shard.view, f"{kind}_{what}") for kind in ("seen", "told", "known"))
        envs, _, points = known.shape
        shard.call(launch, _copy_flags, "copy", known.shape, active=running, flags=known, copy=told)
        shard.call(launch, _share_points, "known", (envs, points), active=running, seen=seen, told=told, known=known)
