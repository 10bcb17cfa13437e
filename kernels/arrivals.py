"""Who has nothing more to do where it was sent: robots that have arrived, or whose target is explored or taken."""

import warp as wp

from maexp.kernels.frontier import is_frontier
from maexp.kernels.greedy_assignment import squared
from maexp.kernels.occupancy_grid import NavGrids, nav_cell
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import point_xy

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def has_frontier(known: wp.array2d(dtype=wp.uint8), row: int, cell: int, reach: int, w: int, h: int) -> bool:
    """Whether there is a frontier cell at most `reach` cells from a cell along x and y."""
    x = cell % w
    y = cell / w
    for v in range(wp.max(y - reach, 0), wp.min(y + reach, h - 1) + 1):
        for u in range(wp.max(x - reach, 0), wp.min(x + reach, w - 1) + 1):
            if is_frontier(known, row, u, v, w, h) != wp.uint8(0):
                return True
    return False


@wp.kernel
def _find_arrivals(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    reach: wp.array(dtype=wp.int32),  # [grid], how far from a target its frontier may lie, in cells
    # Settings:
    rows_per_env: int,
    clearance: float,  # [m]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    aim: wp.array2d(dtype=wp.vec2),  # [env, robot] [m]
    has_aim: wp.array2d(dtype=wp.bool),  # [env, robot]
    # Out:
    arrived: wp.array2d(dtype=wp.bool),  # [env, robot]
):
    """Robots within a clearance, or one and a half cells, of their target, robots near whose target no frontier is
    left, and robots at whose target another one has arrived."""
    e, i = wp.tid()
    arrived[e, i] = False
    if active[e] == 0 or collided[e, i] != 0 or not has_aim[e, i]:
        return
    m = map_id[e]
    near = wp.max(1.5 * grids.cell[m], clearance)
    for j in range(center.shape[1]):  # a wreck beside the target has not explored it: the frontier says so
        if collided[e, j] == 0 and squared(aim[e, i] - point_xy(center[e, j])) <= near * near:
            arrived[e, i] = True
    row = e * rows_per_env + wp.where(rows_per_env > 1, i, 0)
    cell = nav_cell(grids, m, aim[e, i])
    if not has_frontier(known, row, cell, reach[m], grids.width[m], grids.height[m]):
        arrived[e, i] = True
