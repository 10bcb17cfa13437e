"""Messages that take room and time: what radios send of what they know where `comm.bandwidth` or `comm.delay` is set.

A message tells of points of the map. A radio sends what some radio that hears it does not know: oldest first, and of
one step the free points before the boundary, each in the order of the map. All who hear it hear the same message; what
does not fit waits. What is sent in step t is known in step t + delay, even if the radios have parted by then or the
receiver has failed. Without limits this is what `merge._share_points` does.

Left out: what it takes to tell which points one knows, where one is and where one goes (free and at once); radios that
disturb each other; headers. Two that send the same point in the same step both count.
"""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def knows_point(
    e: int,
    i: int,
    point: int,
    free: int,
    known_free: wp.array3d(dtype=wp.int32),
    known_boundary: wp.array3d(dtype=wp.int32),
) -> bool:
    """Whether radio i knows a point; boundary points are numbered after the ``free`` free ones."""
    bit = 1 << (i % ROBOTS_PER_WORD)
    if point < free:
        return (known_free[e, i / ROBOTS_PER_WORD, point] & bit) != 0
    return (known_boundary[e, i / ROBOTS_PER_WORD, point - free] & bit) != 0


@wp.func
def learn_point(
    e: int,
    i: int,
    point: int,
    slot: int,
    maps: Maps,
    m: int,
    known_free: wp.array3d(dtype=wp.int32),
    known_boundary: wp.array3d(dtype=wp.int32),
    learned: wp.array3d(dtype=wp.int32),
) -> int:
    """Let radio i know a point, the one number ``slot`` in its order; returns what that weighs."""
    free = maps.free_begin[m + 1] - maps.free_begin[m]
    bit = 1 << (i % ROBOTS_PER_WORD)
    learned[e, i, slot] = point
    if point < free:
        wp.atomic_or(known_free, e, i / ROBOTS_PER_WORD, point, bit)
        return maps.free_weight[maps.free_begin[m] + point]
    wp.atomic_or(known_boundary, e, i / ROBOTS_PER_WORD, point - free, bit)
    return 0


@wp.kernel
def _note_own(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    seen_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    seen_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    # State in and out:
    known_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    known_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    learned_count: wp.array2d(dtype=wp.int32),  # [env, radio]
    # State out:
    learned: wp.array3d(dtype=wp.int32),  # [env, radio, point]
):
    """Radio (e, i) knows what its robot has seen."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    free = maps.free_begin[m + 1] - maps.free_begin[m]
    count = learned_count[e, i]
    weight = int(0)
    for j in range(free):
        if (seen_free[e, word, j] & ~known_free[e, word, j] & bit) != 0:
            weight += learn_point(e, i, j, count, maps, m, known_free, known_boundary, learned)
            count += 1
    for j in range(maps.boundary_begin[m + 1] - maps.boundary_begin[m]):
        if (seen_boundary[e, word, j] & ~known_boundary[e, word, j] & bit) != 0:
            weight += learn_point(e, i, free + j, count, maps, m, known_free, known_boundary, learned)
            count += 1
    learned_count[e, i] = count
    known_weight[e, i] = known_weight[e, i] + weight


@wp.kernel
def _send(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    message_cells: int,
    message_delay: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    known_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    known_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    learned: wp.array3d(dtype=wp.int32),  # [env, radio, point]
    learned_count: wp.array2d(dtype=wp.int32),  # [env, radio]
    # State in and out:
    offered: wp.array3d(dtype=wp.int32),  # [env, radio, radio]
    underway: wp.array3d(dtype=wp.uint8),  # [env, radio, point]
    cells_sent: wp.array(dtype=wp.int64),  # [env]
):
    """Radio (e, i) sends the next points of its order that somebody who hears it does not know.

    Several may write the same number to ``underway``; what is on its way already arrives first.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    free = maps.free_begin[m + 1] - maps.free_begin[m]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    radios = hears.shape[1]
    count = learned_count[e, i]
    slot = count
    for other in range(radios):
        if other != i and (hears[e, other, word] & bit) != 0:
            slot = wp.min(slot, offered[e, i, other])
    sent = int(0)
    while slot < count and sent < message_cells:
        point = learned[e, i, slot]
        wanted = int(0)
        for other in range(radios):
            if other != i and (hears[e, other, word] & bit) != 0 and offered[e, i, other] <= slot:
                if not knows_point(e, other, point, free, known_free, known_boundary):
                    wanted = 1
                    if underway[e, other, point] == wp.uint8(0):
                        underway[e, other, point] = wp.uint8(message_delay + 1)
        sent += wanted
        slot += 1
    for other in range(radios):
        if other != i and (hears[e, other, word] & bit) != 0:
            offered[e, i, other] = wp.max(offered[e, i, other], slot)
    wp.atomic_add(cells_sent, e, wp.int64(sent))


@wp.kernel
def _arrive(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    known_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    known_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    learned_count: wp.array2d(dtype=wp.int32),  # [env, radio]
    underway: wp.array3d(dtype=wp.uint8),  # [env, radio, point]
    # State out:
    learned: wp.array3d(dtype=wp.int32),  # [env, radio, point]
):
    """What is on its way to radio (e, i) gets nearer, or arrives."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    free = maps.free_begin[m + 1] - maps.free_begin[m]
    count = learned_count[e, i]
    weight = int(0)
    for point in range(free + maps.boundary_begin[m + 1] - maps.boundary_begin[m]):
        left = int(underway[e, i, point])
        if left > 0:
            underway[e, i, point] = wp.uint8(left - 1)
            if left == 1 and not knows_point(e, i, point, free, known_free, known_boundary):
                weight += learn_point(e, i, point, count, maps, m, known_free, known_boundary, learned)
                count += 1
    learned_count[e, i] = count
    known_weight[e, i] = known_weight[e, i] + weight


@wp.kernel
def _forget_messages(
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    learned_count: wp.array2d(dtype=wp.int32),  # [env, radio]
    offered: wp.array3d(dtype=wp.int32),  # [env, radio, radio]
    underway: wp.array3d(dtype=wp.uint8),  # [env, radio, point]
):
    e, i = wp.tid()
    if mask[e] == 0:
        return
    learned_count[e, i] = 0
    for other in range(offered.shape[2]):
        offered[e, i, other] = 0
    for point in range(underway.shape[2]):
        underway[e, i, point] = wp.uint8(0)


def forget_messages(launch: Launch, shard: Shard) -> None:
    """Nothing is on its way in the envs of ``mask``."""
    if shard.settings.messages:
        shard.call(launch, _forget_messages, shard.radios)


def pass_messages(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Let radios send and hear of points, where ``running`` [env] is set."""
    for kernel in (_note_own, _send, _arrive):
        shard.call(launch, kernel, shard.radios, active=running)
