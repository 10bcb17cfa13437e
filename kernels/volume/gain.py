"""What is to be seen from targets: unknown voxels on rays over cells, up to the first that blocks."""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import PI
from maexp.kernels.volume.coarse import UNREACHED, Cells, cells_of, place_in_cell
from maexp.kernels.volume.grid import VoxelMaps, is_inside

wp.set_module_options(MODULE_OPTIONS)

HEADINGS = 36
"""Headings that are tried where a sensor looks ahead."""
Turns = wp.types.vector(length=HEADINGS, dtype=wp.float32)


@wp.struct
class Views:
    """What targets of a row are looked around with: trees of rays over cells (`rays.RayTrees`)."""

    offset: wp.array(dtype=wp.vec3i)  # [entry]
    skip: wp.array(dtype=wp.int32)  # [entry], within its tree
    weight: wp.array(dtype=wp.float32)  # [entry], of its voxels: several entries may be the same cell
    begin: wp.array3d(dtype=wp.int32)  # [map, robot, 9]
    whole: wp.array2d(dtype=wp.float32)  # [map, robot], voxels that count as one view
    fov: wp.array(dtype=wp.float32)  # [robot], to the sides [rad]; 0: all around


@wp.func
def best_turn(turns: Turns, fov: float) -> int:
    """The heading with most in view to both sides, the first of equals."""
    half = int(0.5 * fov / (2.0 * PI) * float(HEADINGS))
    best = int(0)
    most = float(-1.0)
    for k in range(HEADINGS):
        total = float(0.0)
        for d in range(-half, half + 1):
            total += turns[(k + d + HEADINGS) % HEADINGS]
        if total > most:
            most = total
            best = k
    return best


@wp.func
def turn_of(d: wp.vec3i) -> int:
    """The heading of an offset, as a number."""
    angle = wp.atan2(float(d[1]), float(d[0])) / (2.0 * PI) * float(HEADINGS)
    return (int(wp.floor(angle + 0.5)) + HEADINGS) % HEADINGS


@wp.kernel
def _look_around(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    views: Views,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env]
    room: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    unknown: wp.array3d(dtype=wp.uint8),  # [env, row, cell], 255: it blocks rays
    distance: wp.array3d(dtype=wp.int16),  # [env, robot, cell]
    # In and out:
    target: wp.array3d(dtype=wp.int32),  # [env, row, block], -1: none; those that no robot gets to are given up
    # Out:
    point: wp.array3d(dtype=wp.vec3),  # [env, row, block] [m]
    gain: wp.array3d(dtype=wp.float32),  # [env, row, block], share of a view
    middle: wp.array3d(dtype=wp.vec3),  # [env, row, block], of what is to be seen, from the target [m]
    best_heading: wp.array3d(dtype=wp.float32),  # [env, row, block], where most of it is to be seen [rad]
):
    e, r, k = wp.tid()
    if looked[e] == 0:
        return
    point[e, r, k] = wp.vec3(0.0, 0.0, 0.0)
    gain[e, r, k] = 0.0
    middle[e, r, k] = wp.vec3(0.0, 0.0, 0.0)
    best_heading[e, r, k] = 0.0
    cell = target[e, r, k]
    if cell < 0:
        return
    reached = wp.bool(False)
    for i in range(distance.shape[1]):
        if int(distance[e, i, cell]) < UNREACHED:
            reached = True
    if not reached:
        target[e, r, k] = -1
        return
    m = map_id[e]
    shape = cells_of(maps.size[m], cells.side)
    edge = maps.resolution[m] * float(cells.side)
    at = place_in_cell(maps, m, cells, room[e, r], cell)
    point[e, r, k] = at
    cx = cell / (shape[1] * shape[2])
    cy = cell / shape[2] % shape[1]
    cz = cell % shape[2]
    first = views.begin[m, r, 0]
    n = views.begin[m, r, 0]
    end = views.begin[m, r, 1]
    total = float(0.0)
    sum = wp.vec3(0.0, 0.0, 0.0)
    turns = Turns()
    ahead = views.fov[r] > 0.0
    taken = int(-1)
    turn = int(0)
    if ahead:  # first which way, then what is to be seen
        while n < end:
            d = views.offset[n]
            left = int(255)
            if is_inside(shape, cx + d[0], cy + d[1], cz + d[2]):
                left = int(unknown[e, r, ((cx + d[0]) * shape[1] + cy + d[1]) * shape[2] + cz + d[2]])
            if left == 255:
                n = first + views.skip[n]
            else:
                turn = turn_of(d)
                turns[turn] = turns[turn] + views.weight[n] * float(left)
                n += 1
        taken = best_turn(turns, views.fov[r])
        best_heading[e, r, k] = 2.0 * PI * float(taken) / float(HEADINGS)
        n = first
    half = 0.5 * views.fov[r] / (2.0 * PI) * float(HEADINGS)
    while n < end:
        d = views.offset[n]
        left = int(255)
        if is_inside(shape, cx + d[0], cy + d[1], cz + d[2]):
            left = int(unknown[e, r, ((cx + d[0]) * shape[1] + cy + d[1]) * shape[2] + cz + d[2]])
        if left == 255:
            n = first + views.skip[n]
        else:
            on = wp.bool(left > 0)
            if on and ahead:
                off = wp.abs(turn_of(d) - taken)
                on = float(wp.min(off, HEADINGS - off)) <= half
            if on:
                worth = views.weight[n] * float(left)
                total += worth
                sum += worth * wp.vec3(float(d[0]), float(d[1]), float(d[2]))
            n += 1
    gain[e, r, k] = total / views.whole[m, r]
    if total > 0.0:
        middle[e, r, k] = sum * (edge / total)


def look_around(launch: Launch, shard: Shard) -> None:
    """What is to be seen from the targets of the envs that are looked at."""
    shard.call(launch, _look_around, shard.view.target.shape)
