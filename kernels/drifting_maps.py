"""Maps that shift with odometry: robots draw what they see where they believe it to be.

A map is a navigation grid. With every look a robot draws the points in view that it knows, as far and in such a
direction from where it believes to be as they are from where it is. The last look at a cell counts, and of one look,
walls. Ground covers all cells within a quarter of a cell, so that a lattice of points that has turned leaves no holes.
At the end of the range, where the walls beside it are out of view, ground is drawn only where the map shows nothing:
else it would rub out these walls. The same goes for who has collided, whose looks would count for ever.

Where communication is limited, a robot has a map of its own. A point that it knows from others it draws once, where one
of them has drawn it, and only where its own map shows nothing. Else all draw in the one map of the team.

Nothing is forgotten: what a map shows where nobody looks any more stays. Which points are known has nothing to do with
where they are drawn: coverage, rewards and messages count true points.
"""

import torch
import warp as wp

from maexp.kernels.drifting_grid import place_x, place_y
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import Launch, lanes_on
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps, point_xy

wp.set_module_options(MODULE_OPTIONS)

TOLD = 2
"""What `drawn` holds of ground that gives way to all else, and with 1 more of such walls; of a look in local step t, it
holds `TOLD` (t + 2) or 1 more."""
MARGIN = 2.0  # cells from the end of the range within which a wall beside a point may be out of range
MICRON = 1.0e6  # distances are summed in whole numbers: so their order does not count


@wp.func
def half_cells(grids: NavGrids, m: int, scale: float, at: wp.vec2) -> wp.vec2i:
    """A place in half cells from the grid's corner, rounded, and clamped to the grid; ``scale``: half cells a metre."""
    p = scale * (at - grids.origin[m])
    x = wp.clamp(int(wp.floor(p[0] + 0.5)), 0, 2 * grids.width[m])
    y = wp.clamp(int(wp.floor(p[1] + 0.5)), 0, 2 * grids.height[m])
    return wp.vec2i(x, y)


@wp.func
def place_number(grids: NavGrids, m: int, half: wp.vec2i) -> int:
    """The number of a place."""
    return 1 + half[1] * (2 * grids.width[m] + 1) + half[0]


@wp.func
def turned_place(believed: wp.vec3, true: wp.vec3, c: float, s: float, at: wp.vec3) -> wp.vec2:
    """Where a robot believes a point to be; ``c``, ``s``: cosine and sine of the error of its heading."""
    way = at - true
    return point_xy(believed) + wp.vec2(c * way[0] - s * way[1], s * way[0] + c * way[1])


@wp.func
def draw_cell(grids: NavGrids, m: int, of: int, x: int, y: int, key: int, cells: wp.array(dtype=wp.int32)):
    """Draw cell (x, y), and the voids that follow it as they follow cell ``of`` of the map, as far away as there."""
    w = grids.width[m]
    h = grids.height[m]
    wp.atomic_max(cells, y * w + x, key)
    begin = grids.cell_begin[m] + of
    for k in range(grids.void_begin[begin], grids.void_begin[begin + 1]):
        u = x + grids.voids[k] % w - of % w
        v = y + grids.voids[k] / w - of / w
        if u >= 0 and v >= 0 and u < w and v < h:
            wp.atomic_max(cells, v * w + u, key)


@wp.func
def draw_point(grids: NavGrids, m: int, of: int, half: wp.vec2i, key: int, cells: wp.array(dtype=wp.int32)):
    """Draw a point of cell ``of`` at a place on a map: a wall in one cell, ground in all that its half cell touches."""
    x = half[0]
    y = half[1]
    last_x = wp.min(x / 2, grids.width[m] - 1)
    last_y = wp.min(y / 2, grids.height[m] - 1)
    if key % 2 != 0:
        draw_cell(grids, m, of, last_x, last_y, key, cells)
    else:
        for v in range(wp.max(y - 1, 0) / 2, last_y + 1):
            for u in range(wp.max(x - 1, 0) / 2, last_x + 1):
                draw_cell(grids, m, of, u, v, key, cells)


@wp.kernel
def _draw_looks(
    # Map:
    maps: Maps,
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    false_alarms: int,
    first: int,
    ahead: int,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    pose_estimate: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center_estimate: wp.array2d(dtype=wp.vec3),  # [env, robot]
    seen_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    false_walls: wp.array3d(dtype=wp.int32),  # [env, word, free]
    # Scratch in:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    viewed: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    drawn: wp.array3d(dtype=wp.int32),  # [env, row, cell]
    # State out:
    place_free: wp.array3d(dtype=wp.int32),  # [env, row, free]
    place_boundary: wp.array3d(dtype=wp.int32),  # [env, row, boundary]
):
    """Draw what robot (e, first + k) sees: ground that it knows, and walls that it knows beside any ground in view.

    A false wall gets a place and is not drawn: it stands in the map as long as the robot takes it for one.
    """
    e, k, lane = wp.tid()
    if active[e] == 0:
        return
    i = first + k
    row = wp.min(i, drawn.shape[1] - 1)
    m = map_id[e]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    radius = robots.radar_range[e, i]
    origin = center[e, i]
    believed = center_estimate[e, i]
    turn = pose_estimate[e, i][3] - pose[e, i][3]
    c = wp.cos(turn)
    s = wp.sin(turn)
    scale = 2.0 / grids.cell[m]
    look = TOLD * (local_step[e] + ahead + 2)
    if collided[e, i] != 0:
        look = TOLD
    inner = radius - MARGIN * grids.cell[m]
    first_free = maps.free_begin[m]
    first_wall = maps.boundary_begin[m]
    known = visible_count[e, i]
    cells = drawn[e, row]
    for slot in range(lane, wp.min(viewed[e, i], visible.shape[2]), lanes):
        j = visible[e, i, slot]
        point = first_free + j
        wrong = int(0)
        if false_alarms != 0:
            wrong = false_walls[e, word, j] & bit
        if slot < known or wrong != 0:
            at = maps.free[point]
            half = half_cells(grids, m, scale, turned_place(believed, origin, c, s, at))
            place_free[e, row, j] = place_number(grids, m, half)
            if slot < known:
                key = wp.where(wp.length(at - origin) <= inner, look, TOLD)
                draw_point(grids, m, grids.free_cell[point], half, key, cells)
        for n in range(maps.neighbour_begin[point], maps.neighbour_begin[point + 1]):
            wall = maps.neighbour[n]
            at = maps.boundary[first_wall + wall]
            if (seen_boundary[e, word, wall] & bit) != 0 and wp.length(at - origin) <= radius:
                half = half_cells(grids, m, scale, turned_place(believed, origin, c, s, at))
                place_boundary[e, row, wall] = place_number(grids, m, half)
                draw_point(grids, m, grids.boundary_cell[first_wall + wall], half, look + 1, cells)


@wp.func
def find_teller(
    e: int,
    i: int,
    j: int,
    hears: wp.array3d(dtype=wp.int32),
    place: wp.array3d(dtype=wp.int32),
) -> int:
    """The first robot that has a place for a point, if possible one that robot i hears now; -1: none."""
    any = int(-1)
    for k in range(place.shape[1]):
        word = k / ROBOTS_PER_WORD
        bit = 1 << (k % ROBOTS_PER_WORD)
        if place[e, k, j] != 0:
            if (hears[e, i, word] & bit) != 0:
                return k
            if any < 0:
                any = k
    return any


@wp.kernel
def _draw_told(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    point_begin: wp.array(dtype=wp.int32),  # [map + 1]
    point_cell: wp.array(dtype=wp.int32),  # [points of all maps]
    # Settings:
    key: int,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    hears: wp.array3d(dtype=wp.int32),  # [env, radio, word]
    known: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # State in and out:
    drawn: wp.array3d(dtype=wp.int32),  # [env, row, cell]
    place: wp.array3d(dtype=wp.int32),  # [env, row, point]
):
    """Draw points that robots know and have not drawn, robot after robot, where another has drawn them."""
    e, lane = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    points = point_begin[m + 1] - point_begin[m]
    for i in range(drawn.shape[1]):
        mine = place[e, i]
        cells = drawn[e, i]
        knows = known[e, i / ROBOTS_PER_WORD]
        bit = 1 << (i % ROBOTS_PER_WORD)
        for j in range(lane, points, lanes):
            if (knows[j] & bit) != 0 and mine[j] == 0:
                teller = find_teller(e, i, j, hears, place)
                if teller >= 0:
                    there = place[e, teller, j]
                    mine[j] = there
                    half = wp.vec2i(place_x(grids, m, there), place_y(grids, m, there))
                    draw_point(grids, m, point_cell[point_begin[m] + j], half, key, cells)


@wp.kernel
def _forget_drawings(
    # Settings:
    lanes: int,
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State out:
    drawn: wp.array3d(dtype=wp.int32),  # [env, row, cell]
    place_free: wp.array3d(dtype=wp.int32),  # [env, row, free]
    place_boundary: wp.array3d(dtype=wp.int32),  # [env, row, boundary]
):
    e, row, lane = wp.tid()
    if mask[e] == 0:
        return
    for cell in range(lane, drawn.shape[2], lanes):
        drawn[e, row, cell] = 0
    for j in range(lane, place_free.shape[2], lanes):
        place_free[e, row, j] = 0
    for j in range(lane, place_boundary.shape[2], lanes):
        place_boundary[e, row, j] = 0


@wp.kernel
def _measure_maps(
    # Map:
    maps: Maps,
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    lanes: int,
    limited: int,
    # State in:
    place_free: wp.array3d(dtype=wp.int32),  # [env, row, free]
    # In:
    known: wp.array3d(dtype=wp.int32),  # [env, word, free]
    # Out:
    total: wp.array2d(dtype=wp.int64),  # [env, row], sum of distances [um]
    count: wp.array2d(dtype=wp.int32),  # [env, row]
):
    """How far the ground that a row knows is from where it is drawn."""
    e, row, lane = wp.tid()
    m = map_id[e]
    first = maps.free_begin[m]
    bit = wp.where(limited != 0, 1 << (row % ROBOTS_PER_WORD), -1)
    distance = wp.int64(0)
    points = int(0)
    for j in range(lane, maps.free_begin[m + 1] - first, lanes):
        place = place_free[e, row, j]
        if place != 0 and (known[e, row / ROBOTS_PER_WORD, j] & bit) != 0:
            half = wp.vec2(float(place_x(grids, m, place)), float(place_y(grids, m, place)))
            gap = grids.origin[m] + (0.5 * grids.cell[m]) * half - point_xy(maps.free[first + j])
            distance += wp.int64(MICRON * wp.length(gap))
            points += 1
    wp.atomic_add(total, e, row, distance)
    wp.atomic_add(count, e, row, points)


def draw_maps(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """Let robots draw what they see and what they have heard of, if maps have errors, in the envs where ``running``
    [env] is set; ``ahead``: 0 after the scan of a reset, 1 after that of a local step.

    In the one map of a team, robots draw one after the other: of points that several see, the first has the place.
    """
    if not shard.settings.map_errors:
        return
    envs, robots = shard.shape
    viewed = shard.view.visible_count if shard.values["sensing"] is None else shard.view.viewed_count
    given = {"active": running, "ahead": ahead, "viewed": viewed}
    if not shard.settings.limited:
        for robot in reversed(range(robots)):
            shard.call(launch, _draw_looks, (envs, 1, shard.lanes), first=robot, **given)
        return
    shard.call(launch, _draw_looks, (envs, robots, shard.lanes), first=0, **given)
    maps, grids, lanes = shard.values["maps"], shard.values["grids"], lanes_on(shard.device, 1024)
    for what, key in (("free", TOLD), ("boundary", TOLD + 1)):
        layer = {
            "point_begin": getattr(maps, f"{what}_begin"),
            "point_cell": getattr(grids, f"{what}_cell"),
            "known": getattr(shard.view, f"known_{what}"),
            "place": getattr(shard.view, f"place_{what}"),
            "key": key,
        }
        shard.call(launch, _draw_told, (envs, lanes), active=running, lanes=lanes, **layer)


def forget_drawings(launch: Launch, shard: Shard) -> None:
    """Clear the maps of the envs of ``mask``, if they have errors."""
    if shard.settings.map_errors:
        lanes = lanes_on(shard.device, 1024)
        shard.call(launch, _forget_drawings, (*shard.view.drawn.shape[:2], lanes), lanes=lanes)


def measure_maps(launch: Launch, shard: Shard) -> tuple[torch.Tensor, torch.Tensor]:
    """How far known ground is from where it is drawn: the sum over points [um], int64 [E, rows], and how many those
    are, int32 [E, rows]."""
    shape, device = shard.view.place_free.shape[:2], wp.device_to_torch(shard.device)
    total = torch.zeros(shape, dtype=torch.int64, device=device)
    count = torch.zeros(shape, dtype=torch.int32, device=device)
    lanes = lanes_on(shard.device, 1024)
    given = {"known": shard.known("free"), "total": wp.from_torch(total), "count": wp.from_torch(count)}
    shard.call(launch, _measure_maps, (*shape, lanes), lanes=lanes, **given)
    return total, count
