"""Radios: what is received of a signal behind walls, the base station, and what its radios know and who is connected.

Received power is the log-distance model with walls of IR2 (Tan et al. 2024, arXiv 2409.04730; its constants are those
of `ss_realistic_model.py` there, after Clark et al. 2022, hal-03365129). Along the straight line between two radios

    P = P_tx - 31 - 40 log10(blocked) - 20 log10(clear / 35)   [dBm]

with ``blocked`` the cells of the line that are no free ground, and ``clear`` its length in cells less those. The first
logarithm is absent where nothing blocks, the second where no more than 35 cells are clear.
"""

import warp as wp

from maexp.kernels.constants import BLOCKED_LOSS, CLEAR_CELLS, CLEAR_LOSS, LOSS, NUDGE
from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.launches import Launch
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps, point_xy

wp.set_module_options(MODULE_OPTIONS)

FADING_KEY = 1 << 24  # apart from the numbers that policies draw
UNION = 0
BASE = 1
"""Whose coverage ends an episode: places in `maexp.envs.config.DONE`."""


@wp.struct
class Radio:
    """Parameters of all radios (configuration)."""

    power: float  # sent [dBm]
    threshold: float  # received: a link needs more [dBm]
    cell: float  # edge of the cells that the model counts [m]
    noise: float  # greatest fading of each part of the loss [dB]


@wp.func
def count_blocked(
    grids: NavGrids, m: int, open: wp.array(dtype=wp.uint8), begin: int, a: wp.vec2, b: wp.vec2, nudge: float
) -> int:
    """Cells of the map's grid along a line that are no free ground; those of the grid start at `begin`.

    The line is cut in as many equal pieces as it crosses columns of cells, or rows if those are more; the middle of
    each stands for a cell. A `NUDGE` lets those on an edge, as of lines between middles of cells, count with the
    greater cell, so that the line there and the line back count the same. Where pairs are in order anyway it is 0, and
    published episodes keep their bits.
    """
    along = (b - a) / grids.cell[m]
    pieces = wp.max(int(wp.ceil(wp.max(wp.abs(along[0]), wp.abs(along[1])) - nudge)), 1)
    start = (a - grids.origin[m]) / grids.cell[m]
    blocked = int(0)
    for k in range(pieces):
        at = start + along * ((float(k) + 0.5) / float(pieces))
        x = int(wp.floor(at[0] + nudge))
        y = int(wp.floor(at[1] + nudge))
        inside = x >= 0 and y >= 0 and x < grids.width[m] and y < grids.height[m]
        if not inside:
            blocked += 1
        elif open[begin + y * grids.width[m] + x] == wp.uint8(0):
            blocked += 1
    return blocked


@wp.func
def received_power(radio: Radio, blocked: float, clear: float, fading_blocked: float, fading_clear: float) -> float:
    """Power that arrives [dBm] over so many cells; each part of the loss fades by a share of the noise."""
    power = radio.power - LOSS
    if blocked > 0.0:
        power -= BLOCKED_LOSS * wp.log10(wp.max(blocked, 1.0)) + radio.noise * fading_blocked
    if clear > CLEAR_CELLS:
        power -= CLEAR_LOSS * wp.log10(clear / CLEAR_CELLS) + radio.noise * fading_clear
    return power


@wp.kernel
def _measure_signals(
    # Map:
    grids: NavGrids,
    open: wp.array(dtype=wp.uint8),  # [cell]
    # Settings:
    radio: Radio,
    # In:
    senders: wp.array(dtype=wp.vec2),  # [pair]
    receivers: wp.array(dtype=wp.vec2),  # [pair]
    # Out:
    power: wp.array(dtype=wp.float32),  # [pair]
):
    """Received power without fading, on the first map [dBm]."""
    k = wp.tid()
    blocked = float(count_blocked(grids, 0, open, 0, senders[k], receivers[k], NUDGE)) * (grids.cell[0] / radio.cell)
    clear = wp.length(receivers[k] - senders[k]) / radio.cell - blocked
    power[k] = received_power(radio, blocked, clear, 0.0, 0.0)


@wp.kernel
def _count_known_blocked(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows: int,  # of a team: 1 where all know the same
    cells: int,  # of a row
    # In:
    open: wp.array(dtype=wp.uint8),  # [env * row * cell], what is known to be free ground
    senders: wp.array(dtype=wp.vec2),  # [env]
    receivers: wp.array3d(dtype=wp.vec2),  # [env, robot, place]
    # Out:
    blocked: wp.array3d(dtype=wp.int32),  # [env, robot, place]
):
    """Cells along the lines from a team's sender to places of its robots that are not known to be free ground."""
    e, i, k = wp.tid()
    begin = (e * rows + wp.min(i, rows - 1)) * cells
    blocked[e, i, k] = count_blocked(grids, map_id[e], open, begin, senders[e], receivers[e, i, k], NUDGE)


@wp.func
def radio_at(e: int, k: int, center: wp.array2d(dtype=wp.vec3), base: wp.array(dtype=wp.vec3)) -> wp.vec3:
    """Where radio k is: that of a robot, or after the robots the base station's [m]."""
    if k < center.shape[1]:
        return center[e, k]
    return base[e]


@wp.kernel
def _receive_signals(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    open: wp.array(dtype=wp.uint8),  # [cell]
    # Settings:
    radio: Radio,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    base: wp.array(dtype=wp.vec3),  # [env]
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    # State out:
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
):
    """Radio (e, i) loses those whose signal does not arrive. Fading depends on (seed, env, episode, step, pair)."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    robots = center.shape[1]
    radios = hears.shape[1]
    for other in range(radios):
        word = other / ROBOTS_PER_WORD
        bit = 1 << (other % ROBOTS_PER_WORD)
        if other != i and (hears[e, i, word] & bit) != 0:
            low = wp.min(i, other)
            high = wp.max(i, other)
            a = point_xy(radio_at(e, low, center, base))
            b = point_xy(radio_at(e, high, center, base))
            blocked = float(count_blocked(grids, m, open, grids.cell_begin[m], a, b, 0.0)) * (
                grids.cell[m] / radio.cell
            )
            clear = wp.length(b - a) / radio.cell - blocked
            key = FADING_KEY + 2 * (low * radios + high)
            through = float(0.0)
            across = float(0.0)
            if radio.noise > 0.0:
                through = keyed_uniform(seed[0], env_id[e], episode[e], local_step[e], key)
                across = keyed_uniform(seed[0], env_id[e], episode[e], local_step[e], key + 1)
            if received_power(radio, blocked, clear, through, across) <= radio.threshold:
                hears[e, i, word] = hears[e, i, word] & ~bit
                if i < robots and other < robots:
                    comm[e, i, other] = False


@wp.kernel
def _place_base(
    # Settings:
    base_x: float,
    base_y: float,
    # State in:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    base: wp.array(dtype=wp.vec3),  # [env]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    cells_sent: wp.array(dtype=wp.int64),  # [env]
    base_sum: wp.array(dtype=wp.int64),  # [env]
    worst_sum: wp.array(dtype=wp.int64),  # [env]
    told_step: wp.array(dtype=wp.int32),  # [env]
    connected: wp.array2d(dtype=wp.int32),  # [env, robot]
    contacts: wp.array3d(dtype=wp.int32),  # [env, radio, word]
):
    """Put the base station where it is asked for, or where robot 0 starts (inf); nobody knows anything yet."""
    e = wp.tid()
    if mask[e] == 0:
        return
    base[e] = center[e, 0]
    if wp.isfinite(base_x):
        base[e] = wp.vec3(base_x, base_y, 0.0)
    for k in range(known_weight.shape[1]):
        known_weight[e, k] = 0
        for w in range(contacts.shape[2]):
            contacts[e, k, w] = 0
    for i in range(connected.shape[1]):
        connected[e, i] = 0
    cells_sent[e] = wp.int64(0)
    base_sum[e] = wp.int64(0)
    worst_sum[e] = wp.int64(0)
    told_step[e] = -1


@wp.kernel
def _note_links(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    done: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    known_weight: wp.array2d(dtype=wp.int32),  # [env, radio]
    # State in and out:
    base_sum: wp.array(dtype=wp.int64),  # [env]
    worst_sum: wp.array(dtype=wp.int64),  # [env]
    told_step: wp.array(dtype=wp.int32),  # [env]
    connected: wp.array2d(dtype=wp.int32),  # [env, robot]
    contacts: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    # Scratch out:
    counted: wp.array(dtype=wp.int32),  # [env]
    reached: wp.array2d(dtype=wp.int32),  # [env, word]
):
    """Sum up what the base station and the worst robot know, and the steps in which each robot is connected: with the
    base station over any number of robots, or where there is none with another robot.

    ``counted`` is what may end the episode: what the base station knows, or the robot that knows least of those that
    have neither collided nor failed.
    """
    e = wp.tid()
    if active[e] == 0:
        return
    robots = connected.shape[1]
    radios = known_weight.shape[1]
    for k in range(radios):
        for w in range(contacts.shape[2]):
            contacts[e, k, w] = contacts[e, k, w] | hears[e, k, w]
    least = known_weight[e, 0]
    count = maps.total_weight[map_id[e]]
    standing = int(0)
    for i in range(robots):
        least = wp.min(least, known_weight[e, i])
        if collided[e, i] == 0 and failed[e, i] == 0:
            count = wp.min(count, known_weight[e, i])
            standing += 1
    if standing == 0:
        count = 0
    if done == BASE:
        count = known_weight[e, radios - 1]
    counted[e] = count
    worst_sum[e] = worst_sum[e] + wp.int64(least)
    if radios > robots:
        base_sum[e] = base_sum[e] + wp.int64(known_weight[e, robots])
        least = wp.min(least, known_weight[e, robots])
        for w in range(reached.shape[1]):
            reached[e, w] = hears[e, robots, w]
        found = wp.bool(True)
        while found:
            found = wp.bool(False)
            for i in range(robots):
                if (reached[e, i / ROBOTS_PER_WORD] & (1 << (i % ROBOTS_PER_WORD))) != 0:
                    for w in range(reached.shape[1]):
                        if (hears[e, i, w] & ~reached[e, w]) != 0:
                            reached[e, w] = reached[e, w] | hears[e, i, w]
                            found = wp.bool(True)
        for i in range(robots):
            if (reached[e, i / ROBOTS_PER_WORD] & (1 << (i % ROBOTS_PER_WORD))) != 0:
                connected[e, i] = connected[e, i] + 1
    else:
        for i in range(robots):
            others = int(0)
            for w in range(reached.shape[1]):
                own = wp.where(w == i / ROBOTS_PER_WORD, 1 << (i % ROBOTS_PER_WORD), 0)
                others = others | (hears[e, i, w] & ~own)
            if others != 0:
                connected[e, i] = connected[e, i] + 1
    if told_step[e] < 0 and float(least) / float(maps.total_weight[map_id[e]]) >= 0.95:
        told_step[e] = local_step[e] + 1


def place_base(launch: Launch, shard: Shard) -> None:
    """Put the base stations of the envs of ``mask`` in their places, where communication is limited."""
    if shard.settings.limited:
        shard.call(launch, _place_base, shard.shape[0])


def receive_signals(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Part those whose signals do not arrive, where radios send any."""
    if shard.settings.signal:
        shard.call(launch, _receive_signals, shard.radios, active=running)


def note_links(launch: Launch, shard: Shard) -> None:
    """Sum up who knows how much and who is connected, where communication is limited."""
    if shard.settings.limited:
        shard.call(launch, _note_links, shard.shape[0])
