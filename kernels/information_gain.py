"""What could be seen for the first time from a cell: rays go out as far as the radar reaches or a known wall stands.

What was seen from a target is kept, and holds as long as the target stays and nothing changes where its rays went.
"""

import math

import warp as wp

from maexp.kernels.constants import RAYS
from maexp.kernels.cpp_snippets import see_cells
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


RAY_ANGLE = 2.0 * math.pi / RAYS


@wp.kernel
def _spread_rays(
    # Out:
    cell: wp.array2d(dtype=wp.vec2i),  # [ray, step], from the middle
    part: wp.array2d(dtype=wp.vec3),  # [ray, step], cells that one stands for, and those times the way there [cells]
):
    """The cells that each ray goes through."""
    ray, step = wp.tid()
    way = wp.vec2(wp.cos((float(ray) + 0.5) * RAY_ANGLE), wp.sin((float(ray) + 0.5) * RAY_ANGLE))
    t = float(step)
    cell[ray, step] = wp.vec2i(int(wp.floor(t * way[0] + 0.5)), int(wp.floor(t * way[1] + 0.5)))
    share = t * RAY_ANGLE
    moment = way * (share * t)
    part[ray, step] = wp.vec3(share, moment[0], moment[1])


@wp.func
def look_from(
    grids: NavGrids,
    m: int,
    known: wp.array2d(dtype=wp.uint8),
    row: int,
    cell: int,
    ray_cell: wp.array2d(dtype=wp.vec2i),
    ray_part: wp.array2d(dtype=wp.vec3),
    radius: float,
):
    """Unknown cells in sight of a cell, the middle of those, from there [m], and the corners of what was looked at.

    `RAYS` rays go out cell by cell, as far as the radius or a known obstacle; a cell of a ray stands for the share
    of its circle that falls to one ray.
    """
    reach = int(wp.min(radius / grids.cell[m], float(ray_cell.shape[1] - 1)))  # no ray is longer
    found = see_cells(known, row, cell, grids.width[m], grids.height[m], reach, ray_cell, ray_part)
    total = wp.float32(found[0])
    middle = wp.vec2(wp.float32(found[1]), wp.float32(found[2])) * (grids.cell[m] / wp.max(total, 1.0e-6))
    return total, middle, int(found[3]), int(found[4])


@wp.kernel
def _look_around(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    target_cell: wp.array2d(dtype=wp.int32),  # [row, target], -1 = none
    ray_cell: wp.array2d(dtype=wp.vec2i),  # [ray, step], as far as the radius or the longest grid
    ray_part: wp.array2d(dtype=wp.vec3),  # [ray, step]
    # Settings:
    radius: float,  # [m]
    # Out:
    area: wp.array2d(dtype=wp.float32),  # [row, target], unknown cells in sight of the target
    middle: wp.array2d(dtype=wp.vec2),  # [row, target], the middle of those, from the target [m]
):
    """What a robot at each target might see for the first time: known walls hide what is behind them."""
    row, k = wp.tid()
    area[row, k] = 0.0
    middle[row, k] = wp.vec2(0.0, 0.0)
    cell = target_cell[row, k]
    if cell >= 0:
        total, way, _low, _high = look_from(grids, grid_of_row[row], known, row, cell, ray_cell, ray_part, radius)
        area[row, k] = total
        middle[row, k] = way


@wp.kernel
def _look_from_targets(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    radius: float,  # [m]
    rows_per_env: int,
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    block: wp.array3d(dtype=wp.int64),  # [look, 1, slot]
    cell: wp.array3d(dtype=wp.int64),  # [look, row, slot], the target of the block; -1 = none
    ray_cell: wp.array2d(dtype=wp.vec2i),  # [ray, step]
    ray_part: wp.array2d(dtype=wp.vec3),  # [ray, step]
    # In and out:
    cached_from: wp.array2d(dtype=wp.int32),  # [row, block], the cell whose outlook still holds; -1 = none
    cached_area: wp.array2d(dtype=wp.float32),  # [row, block]
    cached_middle: wp.array2d(dtype=wp.vec2),  # [row, block]
    # Out:
    cached_window: wp.array3d(dtype=wp.int32),  # [row, block, 2], corners of what was looked at
    area: wp.array3d(dtype=wp.float32),  # [look, row, slot]
    middle: wp.array3d(dtype=wp.vec2),  # [look, row, slot]
):
    """The same from the targets of blocks; what still holds is not looked at again."""
    s, r, slot = wp.tid()
    area[s, r, slot] = 0.0
    middle[s, r, slot] = wp.vec2(0.0, 0.0)
    at = int(cell[s, r, slot])
    if at >= 0:
        row = env[s] * rows_per_env + r
        k = int(block[s, 0, slot])
        if cached_from[row, k] != at:
            total, way, low, high = look_from(grids, map_id[env[s]], known, row, at, ray_cell, ray_part, radius)
            cached_area[row, k] = total
            cached_middle[row, k] = way
            cached_window[row, k, 0] = low
            cached_window[row, k, 1] = high
            cached_from[row, k] = at
        area[s, r, slot] = cached_area[row, k]
        middle[s, r, slot] = cached_middle[row, k]
