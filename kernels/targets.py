"""Targets of exploration: frontier cells gathered in square blocks, each with a cell to go to and what it offers.

Rows are those of `KnownGrids`: one per env where the team shares what it knows, else one per robot. Blocks are
numbered ``by * blocks_x + bx`` with ``blocks_x = ceil(width / block)`` of the env's map.
"""

import math

import warp as wp

from maexp.kernels.frontier import OBSTACLE, UNKNOWN
from maexp.kernels.geodesic import SKIP, UNREACHED
from maexp.kernels.known_grid import NavGrids, nav_cell
from maexp.kernels.passable import near_wall
from maexp.kernels.types import point_xy
from maexp.kernels.ways import nearest_passable, step_back

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile

RAYS = 48  # rays that look around from a target

RAY_ANGLE = 2.0 * math.pi / RAYS


@wp.kernel
def _locate_robots(
    # Map:
    grids: NavGrids,
    grid_of_env: wp.array(dtype=wp.int32),  # [env], -1: search nothing, leave the distances as they are
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    # Out:
    sources: wp.array2d(dtype=wp.int32),  # [item, 1], -1 for robots that do not move any more
    stop: wp.array(dtype=wp.int32),  # [item], -1: search everywhere
):
    e, i = wp.tid()
    item = e * center.shape[1] + i
    m = grid_of_env[e]
    if m < 0:
        stop[item] = SKIP
        return
    stop[item] = -1
    sources[item, 0] = -1
    if active[e] != 0 and collided[e, i] == 0:
        here = nav_cell(grids, m, point_xy(center[e, i]))
        sources[item, 0] = nearest_passable(
            passable, row_of_item[item], here, grids.width[m], grids.height[m]
        )


@wp.func
def is_reached(
    distance: wp.array2d(dtype=wp.int32), e: int, first: int, last: int, robots: int, cell: int
) -> bool:
    """Whether one of the robots `first` to `last` (not included) gets to a cell."""
    found = wp.bool(False)
    for i in range(first, last):
        found = found or distance[e * robots + i, cell] < UNREACHED
    return found


@wp.kernel
def _sum_frontier(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    block: wp.array(dtype=wp.int32),  # [grid], side of a block in cells
    # In:
    frontier: wp.array2d(dtype=wp.uint8),  # [row, cell]
    # Out, zero before:
    size: wp.array2d(dtype=wp.int32),  # [row, block], frontier cells
    sums: wp.array3d(dtype=wp.int64),  # [row, block, 2], sums of their x and y, from the block's corner
):
    """Gather the frontier cells of a line of cells in their blocks."""
    row, y = wp.tid()
    m = grid_of_row[row]
    if m < 0:
        return
    w = grids.width[m]
    if y >= grids.height[m]:
        return
    b = block[m]
    first = y / b * ((w + b - 1) / b)
    line = frontier[row]
    for x in range(w):
        if line[y * w + x] != wp.uint8(0):
            k = first + x / b
            wp.atomic_add(size, row, k, 1)
            wp.atomic_add(sums, row, k, 0, wp.int64(x % b))
            wp.atomic_add(sums, row, k, 1, wp.int64(y % b))


@wp.kernel
def _place_targets(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    block: wp.array(dtype=wp.int32),  # [grid], side of a block in cells
    search: wp.array(dtype=wp.int32),  # [grid], how far outside its block a target may lie, in cells
    # In:
    size: wp.array2d(dtype=wp.int32),  # [row, block], frontier cells
    sums: wp.array3d(dtype=wp.int64),  # [row, block, 2]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    # Settings:
    rows_per_env: int,
    robots: int,
    # Out:
    target_cell: wp.array2d(dtype=wp.int32),  # [row, block], cell to go to; -1 = none
):
    """The reached cell nearest to the middle of a block's frontier cells, in the block or close to it."""
    row, k = wp.tid()
    m = grid_of_row[row]
    if m < 0:
        return
    target_cell[row, k] = -1
    count = size[row, k]
    if count == 0:
        return
    w = grids.width[m]
    h = grids.height[m]
    b = block[m]
    across = (w + b - 1) / b
    x0 = (k % across) * b
    y0 = (k / across) * b
    e = row / rows_per_env
    first = wp.where(rows_per_env > 1, row % rows_per_env, 0)
    last = wp.where(rows_per_env > 1, first + 1, robots)
    s = search[m]
    best_gap = wp.int64(1) << wp.int64(62)
    for y in range(wp.max(y0 - s, 0), wp.min(wp.min(y0 + b, h) + s, h)):
        for x in range(wp.max(x0 - s, 0), wp.min(wp.min(x0 + b, w) + s, w)):
            # Compared after scaling by `count`, which keeps the mean in integers; 64 bits, for blocks may be large.
            gap_x = wp.int64(x - x0) * wp.int64(count) - sums[row, k, 0]
            gap_y = wp.int64(y - y0) * wp.int64(count) - sums[row, k, 1]
            gap = gap_x * gap_x + gap_y * gap_y
            if gap < best_gap:
                if is_reached(distance, e, first, last, robots, y * w + x):
                    best_gap = gap
                    target_cell[row, k] = y * w + x


@wp.kernel
def _spread_rays(
    # Out:
    cell: wp.array2d(dtype=wp.vec2i),  # [ray, step], from the middle
    way: wp.array(dtype=wp.vec2),  # [ray], unit vectors
):
    """The cells that each ray goes through."""
    ray, step = wp.tid()
    ux = wp.cos((float(ray) + 0.5) * RAY_ANGLE)
    uy = wp.sin((float(ray) + 0.5) * RAY_ANGLE)
    t = float(step)
    cell[ray, step] = wp.vec2i(int(wp.floor(t * ux + 0.5)), int(wp.floor(t * uy + 0.5)))
    if step == 0:
        way[ray] = wp.vec2(ux, uy)


@wp.kernel
def _look_around(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    target_cell: wp.array2d(dtype=wp.int32),  # [row, target], -1 = none
    ray_cell: wp.array2d(dtype=wp.vec2i),  # [ray, step], as far as the radius in every grid
    ray_way: wp.array(dtype=wp.vec2),  # [ray]
    # Settings:
    radius: float,  # [m]
    # Out:
    area: wp.array2d(dtype=wp.float32),  # [row, target], unknown cells in sight of the target
    middle: wp.array2d(dtype=wp.vec2),  # [row, target], the middle of those, from the target [m]
):
    """What a robot at each target might see for the first time: known walls hide what is behind them.

    `RAYS` rays go out cell by cell, as far as the radius or a known obstacle; a cell of a ray stands for the share
    of its circle that falls to one ray.
    """
    row, k = wp.tid()
    m = grid_of_row[row]
    cell = target_cell[row, k]
    total = wp.float32(0.0)
    moment = wp.vec2(0.0, 0.0)
    if cell >= 0:
        w = grids.width[m]
        h = grids.height[m]
        reach = int(radius / grids.cell[m])
        x = cell % w
        y = cell / w
        line = known[row]
        for ray in range(RAYS):
            u = x
            v = y
            for step in range(1, reach + 1):
                at = ray_cell[ray, step] + wp.vec2i(x, y)
                if at[0] < 0 or at[0] >= w or at[1] < 0 or at[1] >= h:
                    break
                state = line[at[1] * w + at[0]]
                if state == wp.uint8(OBSTACLE):
                    break
                if at[0] != u and at[1] != v:  # not between two walls that touch at a corner either
                    if line[at[1] * w + u] == wp.uint8(OBSTACLE) and line[v * w + at[0]] == wp.uint8(OBSTACLE):
                        break
                if state == wp.uint8(UNKNOWN):
                    part = float(step) * RAY_ANGLE
                    total += part
                    moment += ray_way[ray] * (part * float(step))
                u = at[0]
                v = at[1]
    area[row, k] = total
    middle[row, k] = moment * (grids.cell[m] / wp.max(total, 1.0e-6))


@wp.kernel
def _find_open_ground(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    # Settings:
    rows_per_env: int,
    # In:
    cell: wp.array3d(dtype=wp.int32),  # [env, robot, sample]
    room: wp.array2d(dtype=wp.float32),  # [env, robot], distance from known obstacles [m]
    # Out:
    found: wp.array2d(dtype=wp.bool),  # [env, robot]
):
    """Whether one of a robot's cells lies no nearer to known obstacles than `room`."""
    e, i = wp.tid()
    m = map_id[e]
    w = grids.width[m]
    row = e * rows_per_env + wp.where(rows_per_env > 1, i, 0)
    open = wp.bool(False)
    for k in range(cell.shape[2]):
        at = cell[e, i, k]
        if not open and known[row, at] != wp.uint8(OBSTACLE):
            open = not near_wall(known, row, at % w, at / w, w, grids.height[m], room[e, i] / grids.cell[m])
    found[e, i] = open


@wp.kernel
def _first_cells(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # In:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    target_cell: wp.array3d(dtype=wp.int32),  # [env, robot, block], -1 = none
    # Settings:
    reach: int,  # length of the way to look ahead, 10 a cell
    # Out:
    cell: wp.array3d(dtype=wp.int32),  # [env, robot, block]; -1 = no way
):
    """The cell that lies `reach` ahead of the robot on its way to each target."""
    e, i, k = wp.tid()
    item = e * (distance.shape[0] / map_id.shape[0]) + i
    m = map_id[e]
    here = target_cell[e, i, k]
    if here >= 0:
        if distance[item, here] >= UNREACHED:
            here = -1
    while here >= 0 and distance[item, wp.max(here, 0)] > reach:
        here = step_back(
            passable, row_of_item[item], distance, item, here, grids.width[m], grids.height[m]
        )
    cell[e, i, k] = here
