"""Radars that miss returns or give false ones: what a robot sees of the points in its view in a local step, and when it
knows them.

A point in view gives a return with the probability `return_chance`, drawn by (seed, env, episode, step, robot, point).
A robot knows a point once it has had as many returns of it as `radar.evidence` asks for. Each counts its own: what it
tells others is what it knows.

A free point in view gives a false return with the probability `radar.false_alarm`, drawn before the other: it looks
like a wall. True and false returns cancel each other. A robot takes a point for a wall once so many more were false,
until they cancel or it knows the point, by itself or from others. It tells nobody of false walls; where all know the
same, they stand in the map of all.
"""

import math

import warp as wp

from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import Launch, lanes_on
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, VIEWER_NOW, Maps

wp.set_module_options(MODULE_OPTIONS)

COUNTED = 128  # beside the returns of a boundary point: looked at in this local step
FALSE = 128  # beside those of a free point: they were false


@wp.struct
class Sensing:
    """Radars that miss returns; arrays of robots are the same in all envs."""

    chance: wp.array2d(dtype=wp.float32)  # [map, robot], `return_chance`
    needed: wp.array(dtype=wp.int32)  # [robot], returns after which a robot knows a point
    false_alarm: wp.array(dtype=wp.float32)  # [robot], probability of a false return


def return_chance(missed: float, noise: float, spacing: float) -> float:
    """Probability that a point in view gives a return, and that this is taken for a return of that point.

    The error of a measured range is normal. A return whose error is half the spacing of the points or more is taken for
    one of another place, and dropped.

    Args:
        missed: probability that there is no return.
        noise: standard deviation of the error [m].
        spacing: of the map's points [m].
    """
    return (1.0 - missed) * (math.erf(0.5 * spacing / (math.sqrt(2.0) * noise)) if noise > 0.0 else 1.0)


@wp.func
def gives_return(
    chance: float, seed: int, env_id: int, episode: int, step: int, i: int, point: int, points: int
) -> bool:
    """Whether robot i has a return of a point in this step. Negative numbers keep the draws apart from all others."""
    return chance >= 1.0 or keyed_uniform(seed, env_id, episode, step, -1 - i * points - point) < chance


@wp.func
def weigh_return(evidence: int, true: bool) -> int:
    """The evidence for a free point after one more return: so many true ones, or `FALSE` and so many false ones."""
    balance = evidence
    if evidence >= FALSE:
        balance = FALSE - evidence
    balance += wp.where(true, 1, -1)
    return wp.where(balance >= 0, balance, FALSE - balance)


@wp.kernel
def _sense_points(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    sensing: Sensing,
    # Settings:
    ahead: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    seen_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    # State in and out:
    evidence_free: wp.array3d(dtype=wp.uint8),  # [env, robot, free]
    evidence_boundary: wp.array3d(dtype=wp.uint8),  # [env, robot, boundary]
    seen_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    false_walls: wp.array3d(dtype=wp.int32),  # [env, word, free]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    viewers_boundary: wp.array3d(dtype=wp.int32),  # [env, 1, boundary]
    # Scratch in and out:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # Scratch out:
    viewed_count: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Mark the boundary points in view of robot (e, i) that it knows now, as `visibility._scan_boundary` does, and
    leave in the list of visible free points those that give a true return and are known, the others behind them.

    A boundary point is in view where a free point is that it touches, whether or not that gives a return itself.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    step = local_step[e] + ahead
    chance = sensing.chance[m, i]
    needed = sensing.needed[i]
    false_alarm = sensing.false_alarm[i]
    radius = robots.radar_range[e, i]
    origin = center[e, i]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    first = maps.free_begin[m]
    begin = maps.boundary_begin[m]
    free = maps.free_begin[m + 1] - first
    points = free + maps.boundary_begin[m + 1] - begin
    count = wp.min(visible_count[e, i], visible.shape[2])
    for k in range(count):
        point = first + visible[e, i, k]
        for n in range(maps.neighbour_begin[point], maps.neighbour_begin[point + 1]):
            j = maps.neighbour[n]
            found = int(evidence_boundary[e, i, j])
            if found < COUNTED and (seen_boundary[e, word, j] & bit) == 0:
                if wp.length(maps.boundary[begin + j] - origin) <= radius:
                    if gives_return(chance, seed[0], env_id[e], episode[e], step, i, free + j, points):
                        found += 1
                        if found >= needed:
                            wp.atomic_or(seen_boundary, e, word, j, bit)
                            wp.atomic_add(viewers_boundary, e, 0, j, 1)
                    evidence_boundary[e, i, j] = wp.uint8(found + COUNTED)
    kept = int(0)
    for k in range(count):
        j = visible[e, i, k]
        for n in range(maps.neighbour_begin[first + j], maps.neighbour_begin[first + j + 1]):
            near = maps.neighbour[n]
            evidence_boundary[e, i, near] = wp.uint8(int(evidence_boundary[e, i, near]) % COUNTED)
        wrong = bool(False)
        if false_alarm > 0.0:
            draw = -1 - (center.shape[1] + i) * points - j
            wrong = keyed_uniform(seed[0], env_id[e], episode[e], step, draw) < false_alarm
        known = not wrong and gives_return(chance, seed[0], env_id[e], episode[e], step, i, j, points)
        if (wrong or known) and (seen_free[e, word, j] & bit) == 0:
            found = weigh_return(int(evidence_free[e, i, j]), known)
            if found <= FALSE + needed:
                evidence_free[e, i, j] = wp.uint8(found)
            if wrong and found >= FALSE + needed:
                wp.atomic_or(false_walls, e, word, j, bit)
            if false_alarm > 0.0 and found == 0:
                wp.atomic_and(false_walls, e, word, j, ~bit)
            known = known and found < FALSE and found >= needed
        if known:
            visible[e, i, k] = visible[e, i, kept]
            visible[e, i, kept] = j
            kept += 1
        else:
            wp.atomic_sub(viewers_free, e, 0, j, VIEWER_NOW)
    viewed_count[e, i] = count
    visible_count[e, i] = kept


@wp.kernel
def _forget_returns(
    # Settings:
    lanes: int,
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    evidence: wp.array3d(dtype=wp.uint8),  # [env, robot, point]
):
    e, i, lane = wp.tid()
    if mask[e] != 0:
        for j in range(lane, evidence.shape[2], lanes):
            evidence[e, i, j] = wp.uint8(0)


@wp.kernel
def _settle_walls(
    # Settings:
    limited: int,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    known_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    # State in and out:
    false_walls: wp.array3d(dtype=wp.int32),  # [env, word, free]
):
    """What is known to be free is no wall: to a robot, or where all know the same to all."""
    e, lane = wp.tid()
    if active[e] == 0:
        return
    for word in range(false_walls.shape[1]):
        for j in range(lane, false_walls.shape[2], lanes):
            walls = false_walls[e, word, j]
            if walls != 0:
                if limited != 0:
                    false_walls[e, word, j] = walls & ~known_free[e, word, j]
                elif viewers_free[e, 0, j] != 0:
                    false_walls[e, word, j] = 0


def sense(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """What radars that miss returns make of what is in view, where ``running`` [env] is set; ``ahead``: 0 in the scan
    of a reset, 1 in that of a local step."""
    shard.call(launch, _sense_points, active=running, ahead=ahead)


def settle_walls(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Take back false walls of what has become known, where ``running`` [env] is set."""
    if shard.settings.false_alarms:
        lanes = lanes_on(shard.device, 1024)
        shard.call(launch, _settle_walls, (shard.shape[0], lanes), active=running, lanes=lanes)


def forget_returns(launch: Launch, shard: Shard) -> None:
    """Clear the returns of the envs of ``mask``, if any are counted."""
    if shard.values["sensing"] is not None:
        lanes = lanes_on(shard.device, 1024)
        for evidence in (shard.view.evidence_free, shard.view.evidence_boundary):
            dim = (*evidence.shape[:2], lanes)
            shard.call(launch, _forget_returns, dim, evidence=evidence, lanes=lanes)
