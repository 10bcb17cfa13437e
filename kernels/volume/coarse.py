"""Where robots can go by what they know, on cells of several voxels: room, cells, frontiers in blocks, distances.

Rows are those of what is known: one for a team, or where communication is limited one for each robot. A voxel has room
if all around it is known to be free as far as the body reaches; a cell is open if one of its voxels has room.
Cells are bits of columns, too; cell (x, y, z) has number ``(x * ny + y) * nz + z``.
"""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.volume.grid import VoxelMaps, has_bit, is_inside

wp.set_module_options(MODULE_OPTIONS)

UNREACHED = 32767
"""Steps to cells that a robot cannot get to."""
SOLID = 0.3
"""A cell with such a share of surface among its voxels blocks rays."""
LEAST_FRONTIER = 12
"""Frontier voxels in a block that are worth a target."""
SEARCH = 3
"""Cells around the middle of a block's frontier in which its target is looked for."""
SNAP = 3
"""The same around a robot that stands in a cell without room."""


@wp.struct
class Cells:
    """Cells of maps of a batch."""

    side: int  # voxels along a side
    body: int  # voxels around one that has room
    block: int  # voxels along a side of a block


@wp.func
def cells_of(size: wp.vec3i, side: int) -> wp.vec3i:
    """Cells, or blocks, along x, y, z."""
    return wp.vec3i((size[0] + side - 1) / side, (size[1] + side - 1) / side, (size[2] + side - 1) / side)


@wp.func
def shifted(words: wp.array2d(dtype=wp.int32), c: int, w: int, by: int) -> wp.uint32:
    """A column's word of layers that are ``by`` lower (up to 31): bit z is that of layer z + by; beyond: 0."""
    count = words.shape[1]
    result = wp.uint32(0)
    if by >= 0:
        result = wp.uint32(words[c, w]) >> wp.uint32(by)
        if by > 0 and w + 1 < count:
            result = result | (wp.uint32(words[c, w + 1]) << wp.uint32(32 - by))
    else:
        result = wp.uint32(words[c, w]) << wp.uint32(-by)
        if w > 0:
            result = result | (wp.uint32(words[c, w - 1]) >> wp.uint32(32 + by))
    return result


@wp.kernel
def _find_room(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env]
    # State in:
    known_free: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    # Out:
    room: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
):
    """Voxels with room."""
    e, r, c = wp.tid()
    size = maps.size[map_id[e]]
    if looked[e] == 0 or c >= size[0] * size[1]:
        return
    x = c / size[1]
    y = c % size[1]
    known = known_free[e, r]
    k = cells.body
    for w in range(room.shape[3]):
        value = wp.uint32(known[c, w])
        if value != wp.uint32(0):
            for dx in range(-k, k + 1):
                for dy in range(-k, k + 1):
                    if x + dx >= 0 and y + dy >= 0 and x + dx < size[0] and y + dy < size[1]:
                        if value != wp.uint32(0):
                            for dz in range(-k, k + 1):
                                value = value & shifted(known, c + dx * size[1] + dy, w, dz)
                    else:
                        value = wp.uint32(0)
        room[e, r, c, w] = int(value)


@wp.kernel
def _find_cells(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env]
    # State in:
    known_free: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    known_surface: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    # In:
    room: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    # Out:
    open: wp.array4d(dtype=wp.int32),  # [env, row, cell column, word]
    unknown: wp.array3d(dtype=wp.uint8),  # [env, row, cell], unknown voxels; 255: it blocks rays
):
    """Which cells are open, and what is unknown in each."""
    e, r, q = wp.tid()
    size = maps.size[map_id[e]]
    f = cells.side
    shape = cells_of(size, f)
    if looked[e] == 0 or q >= shape[0] * shape[1]:
        return
    x0 = q / shape[1] * f
    y0 = q % shape[1] * f
    limit = int(wp.ceil(SOLID * float(f * f * f)))
    for w in range(open.shape[3]):
        open[e, r, q, w] = 0
    known = int(0)
    for x in range(x0, wp.min(x0 + f, size[0])):
        for y in range(y0, wp.min(y0 + f, size[1])):
            for w in range(known_free.shape[3]):
                known = known | known_free[e, r, x * size[1] + y, w] | known_surface[e, r, x * size[1] + y, w]
    if known == 0:
        wide = (wp.min(x0 + f, size[0]) - x0) * (wp.min(y0 + f, size[1]) - y0)
        for z in range(shape[2]):
            unknown[e, r, q * shape[2] + z] = wp.uint8(wide * (wp.min(z * f + f, size[2]) - z * f))
        return
    for z in range(shape[2]):
        left = int(0)
        walls = int(0)
        some = wp.bool(False)
        for x in range(x0, wp.min(x0 + f, size[0])):
            for y in range(y0, wp.min(y0 + f, size[1])):
                c = x * size[1] + y
                for k in range(z * f, wp.min(z * f + f, size[2])):
                    w = k / 32
                    bit = wp.uint32(1) << wp.uint32(k % 32)
                    if (wp.uint32(known_free[e, r, c, w]) & bit) != wp.uint32(0):
                        if (wp.uint32(room[e, r, c, w]) & bit) != wp.uint32(0):
                            some = True
                    elif (wp.uint32(known_surface[e, r, c, w]) & bit) != wp.uint32(0):
                        walls += 1
                    else:
                        left += 1
        if walls >= limit:
            left = 255
        unknown[e, r, q * shape[2] + z] = wp.uint8(left)
        if some:
            open[e, r, q, z / 32] = int(wp.uint32(open[e, r, q, z / 32]) | (wp.uint32(1) << wp.uint32(z % 32)))


@wp.func
def frontier_word(
    free: wp.array2d(dtype=wp.int32),
    solid: wp.array2d(dtype=wp.int32),
    size: wp.vec3i,
    x: int,
    y: int,
    w: int,
) -> wp.uint32:
    """Known free voxels of a column's word with an unknown one beside them; beyond the box nothing is unknown."""
    c = x * size[1] + y
    value = wp.uint32(free[c, w])
    if value == wp.uint32(0):
        return value
    last = size[2] - 32 * w
    edge = wp.uint32(0)
    if last <= 32:
        edge = wp.uint32(1) << wp.uint32(last - 1)
    known = shifted(free, c, w, 1) | shifted(solid, c, w, 1) | edge
    below = shifted(free, c, w, -1) | shifted(solid, c, w, -1)
    if w == 0:
        below = below | wp.uint32(1)
    known = known & below
    if x > 0:
        known = known & (wp.uint32(free[c - size[1], w]) | wp.uint32(solid[c - size[1], w]))
    if x + 1 < size[0]:
        known = known & (wp.uint32(free[c + size[1], w]) | wp.uint32(solid[c + size[1], w]))
    if y > 0:
        known = known & (wp.uint32(free[c - 1, w]) | wp.uint32(solid[c - 1, w]))
    if y + 1 < size[1]:
        known = known & (wp.uint32(free[c + 1, w]) | wp.uint32(solid[c + 1, w]))
    return value & ~known


@wp.func
def nearest_open(open: wp.array2d(dtype=wp.int32), shape: wp.vec3i, at: wp.vec3, most: int) -> int:
    """Number of the open cell whose middle is nearest to a point [cells], at most so many cells off; -1: none."""
    best = int(-1)
    least = wp.float32(wp.inf)
    x0 = int(wp.floor(at[0]))
    y0 = int(wp.floor(at[1]))
    z0 = int(wp.floor(at[2]))
    for x in range(wp.max(x0 - most, 0), wp.min(x0 + most + 1, shape[0])):
        for y in range(wp.max(y0 - most, 0), wp.min(y0 + most + 1, shape[1])):
            for z in range(wp.max(z0 - most, 0), wp.min(z0 + most + 1, shape[2])):
                if has_bit(open, x * shape[1] + y, z):
                    gap = wp.length(wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5) - at)
                    if gap < least:
                        least = gap
                        best = (x * shape[1] + y) * shape[2] + z
    return best


@wp.kernel
def _place_targets(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env]
    # State in:
    known_free: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    known_surface: wp.array4d(dtype=wp.int32),  # [env, row, column, word]
    # In:
    open: wp.array4d(dtype=wp.int32),  # [env, row, cell column, word]
    # Out:
    target: wp.array3d(dtype=wp.int32),  # [env, row, block], the cell to go to; -1: none
    frontier_size: wp.array3d(dtype=wp.int32),  # [env, row, block], frontier voxels
):
    """For each block with a frontier the open cell nearest to the middle of it."""
    e, r, k = wp.tid()
    size = maps.size[map_id[e]]
    b = cells.block
    blocks = cells_of(size, b)
    if looked[e] == 0:
        return
    target[e, r, k] = -1
    frontier_size[e, r, k] = 0
    if k >= blocks[0] * blocks[1] * blocks[2]:
        return
    x0 = k / (blocks[1] * blocks[2]) * b
    y0 = k / blocks[2] % blocks[1] * b
    z0 = k % blocks[2] * b
    z1 = wp.min(z0 + b, size[2])
    free = known_free[e, r]
    solid = known_surface[e, r]
    count = int(0)
    middle = wp.vec3(0.0, 0.0, 0.0)
    for w in range(z0 / 32, (z1 - 1) / 32 + 1):
        low = wp.max(z0 - 32 * w, 0)
        high = wp.min(z1 - 32 * w, 32)
        mask = ~wp.uint32(0) >> wp.uint32(32 - (high - low))
        mask = mask << wp.uint32(low)
        for x in range(x0, wp.min(x0 + b, size[0])):
            for y in range(y0, wp.min(y0 + b, size[1])):
                bits = frontier_word(free, solid, size, x, y, w) & mask
                while bits != wp.uint32(0):
                    below = bits - wp.uint32(1)
                    z = 32 * w + int(wp.bit_count(below & ~bits))
                    bits = bits & below
                    count += 1
                    middle += wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5)
    frontier_size[e, r, k] = count
    if count >= LEAST_FRONTIER:
        at = middle / (float(count) * float(cells.side))
        target[e, r, k] = nearest_open(open[e, r], cells_of(size, cells.side), at, SEARCH)


@wp.func
def spread(words: wp.array2d(dtype=wp.int32), c: int, w: int) -> wp.uint32:
    """A column's word with the layers above and below."""
    return wp.uint32(words[c, w]) | shifted(words, c, w, 1) | shifted(words, c, w, -1)


@wp.kernel
def _flood(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env]
    # State in:
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    open: wp.array4d(dtype=wp.int32),  # [env, row, cell column, word]
    # Scratch:
    wave: wp.array4d(dtype=wp.int32),  # [env, robot, 2 * cell column, word]
    been: wp.array4d(dtype=wp.int32),  # [env, robot, cell column, word]
    listed: wp.array3d(dtype=wp.int32),  # [env, robot, 2 * cell column]
    # Out:
    distance: wp.array3d(dtype=wp.int16),  # [env, robot, cell], steps; `UNREACHED`
):
    """Steps from each robot to all cells, by turns to the 6 and to the 26 neighbours; from a cell to those beside it
    and in one step or two to those askew."""
    e, i = wp.tid()
    if looked[e] == 0:
        return
    m = map_id[e]
    shape = cells_of(maps.size[m], cells.side)
    row = wp.min(i, open.shape[1] - 1)
    columns = shape[0] * shape[1]
    words = open.shape[3]
    passable = open[e, row]
    for c in range(columns):
        for w in range(words):
            been[e, i, c, w] = 0
            wave[e, i, c, w] = 0
            wave[e, i, columns + c, w] = 0
    for k in range(columns * shape[2]):
        distance[e, i, k] = wp.int16(UNREACHED)
    at = (center[e, i] - maps.origin[m]) / (maps.resolution[m] * float(cells.side))
    start = nearest_open(passable, shape, at, SNAP)
    if start < 0:
        return
    c = start / shape[2]
    z = start % shape[2]
    wave[e, i, c, z / 32] = int(wp.uint32(1) << wp.uint32(z % 32))
    been[e, i, c, z / 32] = wave[e, i, c, z / 32]
    distance[e, i, start] = wp.int16(0)
    listed[e, i, 0] = c
    count = int(1)
    half = int(0)
    step = int(0)
    while count > 0 and step < UNREACHED - 1:
        step += 1
        other = columns - half
        all26 = step % 2 == 0
        found = int(0)
        for k in range(count):
            c = listed[e, i, half + k]
            x = c / shape[1]
            y = c % shape[1]
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    straight = wp.abs(dx) + wp.abs(dy) <= 1
                    if (all26 or straight) and x + dx >= 0 and y + dy >= 0 and x + dx < shape[0] and y + dy < shape[1]:
                        n = c + dx * shape[1] + dy
                        for w in range(words):
                            bits = wp.uint32(wave[e, i, half + c, w])
                            if all26 or n == c:
                                bits = spread(wave[e, i], half + c, w)
                            bits = bits & wp.uint32(passable[n, w]) & ~wp.uint32(been[e, i, n, w])
                            if bits != wp.uint32(0):
                                some = int(0)
                                for v in range(words):
                                    some = some | wave[e, i, other + n, v]
                                if some == 0:
                                    listed[e, i, other + found] = n
                                    found += 1
                                wave[e, i, other + n, w] = int(wp.uint32(wave[e, i, other + n, w]) | bits)
                                been[e, i, n, w] = int(wp.uint32(been[e, i, n, w]) | bits)
                                while bits != wp.uint32(0):
                                    below = bits - wp.uint32(1)
                                    layer = 32 * w + int(wp.bit_count(below & ~bits))
                                    bits = bits & below
                                    distance[e, i, n * shape[2] + layer] = wp.int16(step)
        for k in range(count):
            c = listed[e, i, half + k]
            if not all26:  # these are left askew in the next step
                some = int(0)
                for w in range(words):
                    some = some | wave[e, i, other + c, w]
                if some == 0:
                    listed[e, i, other + found] = c
                    found += 1
            for w in range(words):
                if not all26:
                    wave[e, i, other + c, w] = wave[e, i, other + c, w] | wave[e, i, half + c, w]
                wave[e, i, half + c, w] = 0
        half = other
        count = found


@wp.func
def place_in_cell(maps: VoxelMaps, m: int, cells: Cells, room: wp.array2d(dtype=wp.int32), cell: int) -> wp.vec3:
    """The middle of a voxel with room in a cell, the nearest to the middle of the cell; that middle where there is
    none [m]."""
    size = maps.size[m]
    f = cells.side
    shape = cells_of(size, f)
    x0 = cell / (shape[1] * shape[2]) * f
    y0 = cell / shape[2] % shape[1] * f
    z0 = cell % shape[2] * f
    half = 0.5 * float(f)
    middle = wp.vec3(float(x0) + half, float(y0) + half, float(z0) + half)
    best = middle
    least = wp.float32(wp.inf)
    for x in range(x0, wp.min(x0 + f, size[0])):
        for y in range(y0, wp.min(y0 + f, size[1])):
            for z in range(z0, wp.min(z0 + f, size[2])):
                if has_bit(room, x * size[1] + y, z):
                    p = wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5)
                    gap = wp.length(p - middle)
                    if gap < least:
                        least = gap
                        best = p
    return maps.origin[m] + best * maps.resolution[m]


@wp.func
def step_back(distance: wp.array(dtype=wp.int16), shape: wp.vec3i, cell: int) -> int:
    """The cell before this one on the way from the robot, straight before askew, one step before two; -1: it is the
    first."""
    here = int(distance[cell])
    if here == 0 or here >= UNREACHED:
        return -1
    x = cell / (shape[1] * shape[2])
    y = cell / shape[2] % shape[1]
    z = cell % shape[2]
    best = int(-1)
    least = int(8)
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                if is_inside(shape, x + dx, y + dy, z + dz):
                    n = ((x + dx) * shape[1] + y + dy) * shape[2] + z + dz
                    steps = wp.abs(dx) + wp.abs(dy) + wp.abs(dz)
                    gap = here - int(distance[n])
                    fits = gap == 1 and (steps == 1 or here % 2 == 0)
                    if gap == 2 and here % 2 == 0:  # it waited for a step askew
                        fits = True
                        steps += 4
                    if fits and steps < least:
                        best = n
                        least = steps
    return best


@wp.kernel
def _first_cells(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    cells: Cells,
    ahead: int,  # steps
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    distance: wp.array3d(dtype=wp.int16),  # [env, robot, cell]
    wanted: wp.array3d(dtype=wp.int32),  # [look, robot, candidate], -1: none
    # Out:
    cell: wp.array3d(dtype=wp.int32),  # [look, robot, candidate], -1: there is no way
):
    """The cell so many steps from the robot on its way to each candidate."""
    s, i, k = wp.tid()
    e = env[s]
    shape = cells_of(maps.size[map_id[e]], cells.side)
    here = wanted[s, i, k]
    if here >= 0:
        if int(distance[e, i, here]) >= UNREACHED:
            here = -1
    while here >= 0 and int(distance[e, i, wp.max(here, 0)]) > ahead:
        here = step_back(distance[e, i], shape, here)
    cell[s, i, k] = here


def find_cells(launch: Launch, shard: Shard) -> None:
    """Room and cells of the envs that are looked at."""
    s = shard.view
    shard.call(launch, _find_room, s.room.shape[:3])
    shard.call(launch, _find_cells, s.open.shape[:3])


def flood(launch: Launch, shard: Shard) -> None:
    """Distances from all robots."""
    shard.call(launch, _flood)


def place_targets(launch: Launch, shard: Shard) -> None:
    """Targets of all blocks."""
    shard.call(launch, _place_targets, shard.view.target.shape)
