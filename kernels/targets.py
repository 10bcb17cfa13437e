"""Targets of exploration as robots see them: where they are, how far, and which are given up.

Rows are those of `KnownGrids`. S envs are looked at, some or all; `env` says which.
"""

import warp as wp

from maexp.kernels.constants import OBSTACLE, STRAIGHT, UNREACHED
from maexp.kernels.geodesic import SKIP
from maexp.kernels.greedy_assignment import squared
from maexp.kernels.occupancy_grid import NavGrids, nav_cell, nav_center
from maexp.kernels.path_steps import nearest_passable, step_back
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.traversability import near_wall
from maexp.kernels.types import point_xy

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _locate_robots(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: search nothing, leave the distances as they are
    # Settings:
    rows_per_env: int,
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
    m = grid_of_row[e * rows_per_env]
    if m < 0:
        stop[item] = SKIP
        return
    stop[item] = -1
    sources[item, 0] = -1
    if active[e] != 0 and collided[e, i] == 0:
        here = nav_cell(grids, m, point_xy(center[e, i]))
        sources[item, 0] = nearest_passable(passable, row_of_item[item], here, grids.width[m], grids.height[m])


@wp.kernel
def _find_open_ground(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
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
            open = not near_wall(walls, row, at % w, at / w, w, grids.height[m], room[e, i] / grids.cell[m])
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
        here = step_back(passable, row_of_item[item], distance, item, here, grids.width[m], grids.height[m])
    cell[e, i, k] = here


@wp.kernel
def _list_targets(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    listed: wp.array2d(dtype=wp.int32),  # [env, slot], blocks
    count: wp.array(dtype=wp.int32),  # [env]
    target_cell: wp.array2d(dtype=wp.int32),  # [row, block]
    size: wp.array2d(dtype=wp.int32),  # [row, block]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    # Out:
    block: wp.array3d(dtype=wp.int64),  # [look, 1, slot], -1 fills up
    cell: wp.array3d(dtype=wp.int64),  # [look, row, slot], -1 = none
    point: wp.array3d(dtype=wp.vec2),  # [look, robot, slot] [m]
    way: wp.array3d(dtype=wp.float32),  # [look, robot, slot] [m], infinite: none
    around: wp.array3d(dtype=wp.float32),  # [look, robot, slot], frontier cells of the block
):
    """The blocks with a target of the envs looked at, side by side."""
    s, slot = wp.tid()
    e = env[s]
    m = map_id[e]
    k = wp.int32(-1)
    if slot < count[e]:
        k = listed[e, slot]
    block[s, 0, slot] = wp.int64(k)
    robots = way.shape[1]
    for i in range(robots):
        r = wp.where(rows_per_env > 1, i, 0)
        at = wp.int32(-1)
        if k >= 0:
            at = target_cell[e * rows_per_env + r, k]
            around[s, i, slot] = float(size[e * rows_per_env + r, k])
        else:
            around[s, i, slot] = 0.0
        cell[s, r, slot] = wp.int64(at)
        point[s, i, slot] = nav_center(grids, m, wp.max(at, 0))
        way[s, i, slot] = wp.inf
        if at >= 0:
            steps = distance[e * robots + i, at]
            if steps < UNREACHED:
                way[s, i, slot] = float(steps) * (grids.cell[m] / float(STRAIGHT))


@wp.kernel
def _note_stuck(
    # Settings:
    least: float,  # a robot that has moved less since the last decision is stuck [m]
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    # State in:
    macro_step: wp.array(dtype=wp.int32),  # [env]
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    counted: wp.array(dtype=wp.int32),  # [env], the macro step of the last count
    # In and out:
    chosen: wp.array3d(dtype=wp.int64),  # [env, robot, 1], the block it was on the way to; -1 = none
    stood: wp.array2d(dtype=wp.vec2),  # [env, robot], where it was at the last decision [m]
    dwell: wp.array3d(dtype=wp.int32),  # [env, robot, block], decisions in vain
):
    """Forget what was of another episode, and count decisions of robots that are stuck on the way to a target."""
    s, i = wp.tid()
    e = env[s]
    if macro_step[e] == 0:
        chosen[e, i, 0] = wp.int64(-1)
        for k in range(dwell.shape[2]):
            dwell[e, i, k] = 0
    elif macro_step[e] == counted[e]:
        return
    at = point_xy(center[e, i])
    k = int(chosen[e, i, 0])
    if k >= 0 and active[e] != 0 and collided[e, i] == 0 and wp.sqrt(squared(at - stood[e, i])) < least:
        dwell[e, i, k] = dwell[e, i, k] + 1
    stood[e, i] = at


@wp.kernel
def _count_visits(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    clearance: float,  # [m]
    shared: int,  # 1: what one robot finds out all know
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    # State in:
    macro_step: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # In:
    counted: wp.array(dtype=wp.int32),  # [env]
    block: wp.array3d(dtype=wp.int64),  # [look, 1, slot]
    way: wp.array3d(dtype=wp.float32),  # [look, robot, slot]
    point: wp.array3d(dtype=wp.vec2),  # [look, robot, slot]
    # In and out:
    dwell: wp.array3d(dtype=wp.int32),  # [env, robot, block]
):
    """Count decisions beside a target, within a clearance or one and a half cells."""
    s, slot = wp.tid()
    e = env[s]
    k = int(block[s, 0, slot])
    if k < 0 or (macro_step[e] != 0 and macro_step[e] == counted[e]):
        return
    near = wp.max(1.5 * grids.cell[map_id[e]], clearance)
    met = wp.bool(False)
    for i in range(dwell.shape[1]):
        if way[s, i, slot] < wp.inf:
            if wp.sqrt(squared(point[s, i, slot] - point_xy(center[e, i]))) <= near:
                met = wp.bool(True)
                if shared == 0:
                    dwell[e, i, k] = dwell[e, i, k] + 1
    if met and shared != 0:
        for i in range(dwell.shape[1]):
            dwell[e, i, k] = dwell[e, i, k] + 1


@wp.kernel
def _drop_targets(
    # Settings:
    most: int,  # decisions in vain after which a target is given up
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    # State in:
    macro_step: wp.array(dtype=wp.int32),  # [env]
    # In:
    block: wp.array3d(dtype=wp.int64),  # [look, 1, slot]
    way: wp.array3d(dtype=wp.float32),  # [look, robot, slot]
    dwell: wp.array3d(dtype=wp.int32),  # [env, robot, block]
    # Out:
    kept: wp.array3d(dtype=wp.float32),  # [look, robot, slot], infinite for targets given up
    left: wp.array(dtype=wp.int32),  # [look], 0 before, 1: some robot has a target left
    counted: wp.array(dtype=wp.int32),  # [env]
):
    s, i = wp.tid()
    e = env[s]
    counted[e] = macro_step[e]
    for slot in range(kept.shape[2]):
        value = way[s, i, slot]
        if value < wp.inf:
            if dwell[e, i, int(block[s, 0, slot])] >= most:
                value = wp.inf
            else:
                left[s] = 1
        kept[s, i, slot] = value


@wp.kernel
def _try_again(
    # In:
    env: wp.array(dtype=wp.int32),  # [look]
    left: wp.array(dtype=wp.int32),  # [look]
    way: wp.array3d(dtype=wp.float32),  # [look, robot, slot]
    # Out:
    kept: wp.array3d(dtype=wp.float32),  # [look, robot, slot]
    dwell: wp.array3d(dtype=wp.int32),  # [env, robot, block]
):
    """Where a team has no target left, try them all once more."""
    s, i = wp.tid()
    if left[s] == 0:
        for slot in range(kept.shape[2]):
            kept[s, i, slot] = way[s, i, slot]
        for k in range(dwell.shape[2]):
            dwell[env[s], i, k] = 0
