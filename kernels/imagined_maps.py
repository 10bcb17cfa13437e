"""Imagined worlds: maps made of what robots know and a guess for the rest, written into the arrays of `Maps`.

Every world has room for a grid of cells, and each cell holds at most one point, free or wall. Known ground and known
walls are where robots have seen them; what stands in unknown cells is a guess. Cells are those of the robots'
navigation grid with `margin` more on every side: nothing tells a world where its true map ends.

W worlds, a row of knowledge each (`known_grid`); C cells, Q tiles (the radar's cells, `tile` cells along a side).
"""

import warp as wp

from maexp.kernels.constants import OBSTACLE, UNKNOWN
from maexp.kernels.launches import Launch, launch_named
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps

wp.set_module_options(MODULE_OPTIONS)

NOBODY = 2147483647  # stands for no point


@wp.kernel
def _find_walls(
    # Map:
    maps: Maps,
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    lanes: int,
    # In:
    flags: wp.array3d(dtype=wp.int32),  # [env, word, boundary], of the true map's points
    # Out:
    wall: wp.array2d(dtype=wp.int32),  # [world, true cell], the first known boundary point in it
):
    """Where in its cell a known wall stands: the first of its points that the row knows."""
    row, lane = wp.tid()
    e = row / rows_per_env
    m = map_id[e]
    robot = row % rows_per_env
    begin = maps.boundary_begin[m]
    for j in range(lane, maps.boundary_begin[m + 1] - begin, lanes):
        seen = int(0)
        if rows_per_env > 1:
            seen = flags[e, robot / ROBOTS_PER_WORD, j] & (1 << (robot % ROBOTS_PER_WORD))
        else:
            for word in range(flags.shape[1]):
                seen = seen | flags[e, word, j]
        if seen != 0:
            wp.atomic_min(wall, row, grids.boundary_cell[begin + j], j)


@wp.func
def believed(state: wp.array2d(dtype=wp.uint8), row: int, x: int, y: int, w: int, h: int) -> int:
    """What is believed of a cell of a world; outside of it nothing, as `UNKNOWN`."""
    if x < 0 or y < 0 or x >= w or y >= h:
        return UNKNOWN
    return int(state[row, y * w + x])


@wp.kernel
def _believe(
    # Map:
    grids: NavGrids,
    place: wp.array(dtype=wp.int32),  # [world], number of the true grid
    width: wp.array(dtype=wp.int32),  # [world], cells along x, those of the margin too
    margin: wp.array(dtype=wp.int32),  # [world], cells
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [world, true cell]
    guess: wp.array2d(dtype=wp.uint8),  # [world, cell], `FREE` or `OBSTACLE` for what is unknown
    # Out:
    state: wp.array2d(dtype=wp.uint8),  # [world, cell], `FREE` or `OBSTACLE`
    certain: wp.array2d(dtype=wp.uint8),  # [world, cell], 1 where that is known
):
    """What is known where it is, a guess elsewhere."""
    row, cell = wp.tid()
    m = place[row]
    w = grids.width[m]
    x = cell % width[row] - margin[row]
    y = cell / width[row] - margin[row]
    value = wp.uint8(UNKNOWN)
    if x >= 0 and y >= 0 and x < w and y < grids.height[m]:
        value = known[row, y * w + x]
    certain[row, cell] = wp.where(value == wp.uint8(UNKNOWN), wp.uint8(0), wp.uint8(1))
    if value == wp.uint8(UNKNOWN):
        value = guess[row, cell]
    state[row, cell] = value


@wp.kernel
def _count_tiles(
    # Map:
    width: wp.array(dtype=wp.int32),  # [world]
    height: wp.array(dtype=wp.int32),  # [world]
    tile: wp.array(dtype=wp.int32),  # [world], cells along a side of a tile
    tiles_x: wp.array(dtype=wp.int32),  # [world]
    # In:
    state: wp.array2d(dtype=wp.uint8),  # [world, cell]
    # Out:
    count: wp.array3d(dtype=wp.int32),  # [world, tile, 3], free points, walls, pairs of a free point and a wall beside
):
    """What each tile holds."""
    row, k = wp.tid()
    w = width[row]
    h = height[row]
    q = tile[row]
    x0 = (k % tiles_x[row]) * q
    y0 = (k / tiles_x[row]) * q
    free = int(0)
    walls = int(0)
    pairs = int(0)
    for y in range(y0, wp.min(y0 + q, h)):
        for x in range(x0, wp.min(x0 + q, w)):
            if state[row, y * w + x] == wp.uint8(OBSTACLE):
                walls += 1
            else:
                free += 1
                for v in range(y - 1, y + 2):
                    for u in range(x - 1, x + 2):
                        if believed(state, row, u, v, w, h) == OBSTACLE:
                            pairs += 1
    count[row, k, 0] = free
    count[row, k, 1] = walls
    count[row, k, 2] = pairs


@wp.kernel
def _place_tiles(
    # Map:
    begin: wp.array(dtype=wp.int32),  # [world], where its tiles begin in `free_cell` and `boundary_cell`
    free_begin: wp.array(dtype=wp.int32),  # [world + 1]
    # Settings:
    most_pairs: int,  # that a world has room for
    # In:
    count: wp.array3d(dtype=wp.int32),  # [world, tile, 3]
    # Out:
    free_cell: wp.array(dtype=wp.int32),  # [tiles of all worlds]
    boundary_cell: wp.array(dtype=wp.int32),  # [tiles of all worlds]
    pair_begin: wp.array2d(dtype=wp.int32),  # [world, tile]
    total: wp.array2d(dtype=wp.int32),  # [world, 2], free points and walls
    neighbour_begin: wp.array(dtype=wp.int32),  # [free points of all worlds + 1]
):
    """Where the points of each tile begin."""
    row = wp.tid()
    free = int(0)
    walls = int(0)
    pairs = int(row * most_pairs)
    for k in range(count.shape[1]):
        free_cell[begin[row] + k] = free
        boundary_cell[begin[row] + k] = walls
        pair_begin[row, k] = pairs
        free += count[row, k, 0]
        walls += count[row, k, 1]
        pairs += count[row, k, 2]
    free_cell[begin[row] + count.shape[1]] = free
    boundary_cell[begin[row] + count.shape[1]] = walls
    neighbour_begin[free_begin[row] + free] = pairs
    total[row, 0] = free
    total[row, 1] = walls


@wp.func
def wall_place(
    maps: Maps, grids: NavGrids, wall: wp.array2d(dtype=wp.int32), row: int, m: int, x: int, y: int, middle: wp.vec3
) -> wp.vec3:
    """Where the wall of a true cell stands: its known point, that of the cell whose state it takes, else its middle."""
    w = grids.width[m]
    if x < 0 or y < 0 or x >= w or y >= grids.height[m]:
        return middle
    source = grids.stand_in[grids.cell_begin[m] + y * w + x]
    if source < 0:
        return middle
    j = wall[row, source]
    if j == NOBODY:
        return middle
    return maps.boundary[maps.boundary_begin[m] + j]


@wp.kernel
def _write_points(
    # Map:
    maps: Maps,
    grids: NavGrids,
    place: wp.array(dtype=wp.int32),  # [world]
    origin: wp.array(dtype=wp.vec2),  # [world], lower corner of its cell (0, 0) [m]
    edge: wp.array(dtype=wp.float32),  # [world], of a cell [m]
    width: wp.array(dtype=wp.int32),  # [world]
    height: wp.array(dtype=wp.int32),  # [world]
    margin: wp.array(dtype=wp.int32),  # [world]
    tile: wp.array(dtype=wp.int32),  # [world]
    tiles_x: wp.array(dtype=wp.int32),  # [world]
    begin: wp.array(dtype=wp.int32),  # [world]
    free_begin: wp.array(dtype=wp.int32),  # [world + 1]
    boundary_begin: wp.array(dtype=wp.int32),  # [world + 1]
    # In:
    state: wp.array2d(dtype=wp.uint8),  # [world, cell]
    certain: wp.array2d(dtype=wp.uint8),  # [world, cell]
    worth: wp.array2d(dtype=wp.uint8),  # [world, cell]
    wall: wp.array2d(dtype=wp.int32),  # [world, true cell]
    free_cell: wp.array(dtype=wp.int32),  # [tiles of all worlds]
    boundary_cell: wp.array(dtype=wp.int32),  # [tiles of all worlds]
    # Out:
    free_weight: wp.array(dtype=wp.int32),  # [free points of all worlds]
    free: wp.array(dtype=wp.vec3),  # [free points of all worlds]
    boundary: wp.array(dtype=wp.vec3),  # [walls of all worlds]
    cell_of_free: wp.array(dtype=wp.int32),  # [free points of all worlds]
    cell_of_boundary: wp.array(dtype=wp.int32),  # [walls of all worlds]
    index: wp.array2d(dtype=wp.int32),  # [world, cell], number of its point
):
    """The points of each tile, row by row: free ones in the middle of their cells, known walls where they stand."""
    row, k = wp.tid()
    m = place[row]
    w = width[row]
    q = tile[row]
    x0 = (k % tiles_x[row]) * q
    y0 = (k / tiles_x[row]) * q
    next_free = free_cell[begin[row] + k]
    next_wall = boundary_cell[begin[row] + k]
    for y in range(y0, wp.min(y0 + q, height[row])):
        for x in range(x0, wp.min(x0 + q, w)):
            cell = y * w + x
            at = origin[row] + edge[row] * wp.vec2(float(x) + 0.5, float(y) + 0.5)
            middle = wp.vec3(at[0], at[1], 0.0)
            if state[row, cell] == wp.uint8(OBSTACLE):
                if certain[row, cell] != wp.uint8(0):
                    middle = wall_place(maps, grids, wall, row, m, x - margin[row], y - margin[row], middle)
                boundary[boundary_begin[row] + next_wall] = middle
                cell_of_boundary[boundary_begin[row] + next_wall] = cell
                index[row, cell] = next_wall
                next_wall += 1
            else:
                free[free_begin[row] + next_free] = middle
                free_weight[free_begin[row] + next_free] = int(worth[row, cell])
                cell_of_free[free_begin[row] + next_free] = cell
                index[row, cell] = next_free
                next_free += 1


@wp.kernel
def _join_points(
    # Map:
    width: wp.array(dtype=wp.int32),  # [world]
    height: wp.array(dtype=wp.int32),  # [world]
    tile: wp.array(dtype=wp.int32),  # [world]
    tiles_x: wp.array(dtype=wp.int32),  # [world]
    free_begin: wp.array(dtype=wp.int32),  # [world + 1]
    # In:
    state: wp.array2d(dtype=wp.uint8),  # [world, cell]
    index: wp.array2d(dtype=wp.int32),  # [world, cell]
    pair_begin: wp.array2d(dtype=wp.int32),  # [world, tile]
    # Out:
    neighbour_begin: wp.array(dtype=wp.int32),  # [free points of all worlds + 1]
    neighbour: wp.array(dtype=wp.int32),  # [pairs of all worlds]
):
    """The walls beside each free point, straight or at a corner."""
    row, k = wp.tid()
    w = width[row]
    h = height[row]
    q = tile[row]
    x0 = (k % tiles_x[row]) * q
    y0 = (k / tiles_x[row]) * q
    pair = pair_begin[row, k]
    for y in range(y0, wp.min(y0 + q, h)):
        for x in range(x0, wp.min(x0 + q, w)):
            if state[row, y * w + x] != wp.uint8(OBSTACLE):
                neighbour_begin[free_begin[row] + index[row, y * w + x]] = pair
                for v in range(y - 1, y + 2):
                    for u in range(x - 1, x + 2):
                        if believed(state, row, u, v, w, h) == OBSTACLE:
                            neighbour[pair] = index[row, v * w + u]
                            pair += 1


@wp.kernel
def _recall(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env], its world
    free_begin: wp.array(dtype=wp.int32),  # [world + 1]
    boundary_begin: wp.array(dtype=wp.int32),  # [world + 1]
    cell_of_free: wp.array(dtype=wp.int32),  # [free points of all worlds]
    cell_of_boundary: wp.array(dtype=wp.int32),  # [walls of all worlds]
    # Settings:
    lanes: int,
    robots: int,
    # In:
    certain: wp.array2d(dtype=wp.uint8),  # [world, cell]
    total: wp.array2d(dtype=wp.int32),  # [world, 2]
    # Out:
    seen_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    seen_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    viewers_boundary: wp.array3d(dtype=wp.int32),  # [env, 1, boundary]
):
    """Every robot of a team knows what is certain, as if all had seen it."""
    e, lane = wp.tid()
    row = map_id[e]
    for j in range(lane, seen_free.shape[2], lanes):
        some = int(0)
        if j < total[row, 0]:
            some = int(certain[row, cell_of_free[free_begin[row] + j]])
        viewers_free[e, 0, j] = some * robots
        for word in range(seen_free.shape[1]):
            seen_free[e, word, j] = -some
    for j in range(lane, seen_boundary.shape[2], lanes):
        some = int(0)
        if j < total[row, 1]:
            some = int(certain[row, cell_of_boundary[boundary_begin[row] + j]])
        viewers_boundary[e, 0, j] = some * robots
        for word in range(seen_boundary.shape[1]):
            seen_boundary[e, word, j] = -some


def write_worlds(launch: Launch, worlds: int, cells: int, tiles: int, values: dict) -> None:
    """Write what W worlds are made of into their arrays; `values` names them as the kernels do."""
    launch_named(launch, _find_walls, (worlds, values["lanes"]), values)
    launch_named(launch, _believe, (worlds, cells), values)
    launch_named(launch, _count_tiles, (worlds, tiles), values)
    launch_named(launch, _place_tiles, worlds, values)
    launch_named(launch, _write_points, (worlds, tiles), values)
    launch_named(launch, _join_points, (worlds, tiles), values)


def recall(launch: Launch, envs: int, values: dict) -> None:
    """Let the robots of E envs know what is certain in their worlds."""
    launch_named(launch, _recall, (envs, values["lanes"]), values)
