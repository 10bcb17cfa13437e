"""Radar: ray-masked point filtering (paper, section IV-A).

A free point P_f (seen from the robot's centre) is masked when some occluder P_o in range has

    |P_o| - |P_f| < alpha2   and   (cos(P_f, P_o) > 1 - alpha1  or  angle(P_f, P_o) < asin(min(1, rho / |P_o|)))

Both angular tests fold into ``dot(P_f, u_o) > c_o |P_f|`` with
``c_o = min(1 - alpha1, sqrt(1 - min(1, rho / |P_o|)^2))``.

Most points need no pairwise test: bins of directions decide (`kernels/occlusion.py`). Occluders are entered there the
nearest rows of cells first, and cells and bodies that are hidden are left out at once: with walls around, the cost
follows what is seen, not the square of the range. In a cloud that is not ``planar`` bins do not decide alone, and
nothing is left out.
"""

import warp as wp

from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import Launch
from maexp.kernels.occlusion import BINS, Sensor, add_occluder, add_outline, is_hidden, is_masked, keep_walls, shadow
from maexp.kernels.sensing import sense
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import (
    ERROR_CAPACITY,
    FAR,
    HALF,
    ROBOTS_PER_WORD,
    VIEWER_NOW,
    Maps,
    cell_center,
    floor_within,
    point_xy,
    row_range,
    row_span,
    within,
)

wp.set_module_options(MODULE_OPTIONS)

CELL_HALF = 0.709  # half the diagonal of a cell in edges, with room for rounding
WORTH_A_TEST = 6  # free points of a cell from which on it pays to ask first whether it is hidden
WORTH_AN_OCCLUDER = 2  # occluders from which on it does


@wp.func
def run_length(begin: wp.array(dtype=wp.int32), base: int, span: wp.vec2i, worth: int, cull: int) -> int:
    """How many cells of a row to take at once: one where they hold so many points that to test each pays, else all."""
    cells = span[1] - span[0] + 1
    if cells > 0 and cull != 0:
        if begin[base + span[1] + 1] - begin[base + span[0]] >= worth * cells:
            return 1
    return wp.max(cells, 1)


@wp.func
def add_cells(
    maps: Maps,
    m: int,
    row: int,
    col: int,
    run: int,
    sensor: Sensor,
    cull: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the occluders of a run of cells, unless it is one that is hidden; returns the new count."""
    count = int(start)
    e = sensor.env
    i = sensor.robot
    cell = maps.cell_begin[m] + row * maps.cells_x[m] + col
    begin = maps.occluder_cell[cell]
    end = maps.occluder_cell[cell + run]
    if run == 1 and end > begin and cull != 0:
        at = cell_center(maps, m, row, col) - wp.vec2(sensor.origin[0], sensor.origin[1])
        half = CELL_HALF * maps.cell_size[m]
        dist = wp.length(at)
        width = wp.max(maps.occluder_radius_max[m], sensor.spread * (dist + half))
        if is_hidden(bins, e, i, at[0], at[1], half + width, dist - half):
            return count
    first = maps.occluder_begin[m]
    for j in range(first + begin, first + end, 2):
        k = wp.min(j + 1, first + end - 1)
        delta = maps.occluder[j] - sensor.origin
        delta2 = maps.occluder[k] - sensor.origin
        cast = shadow(delta, maps.occluder_radius[j], sensor)
        cast2 = shadow(delta2, maps.occluder_radius[k], sensor)
        count = add_occluder(delta, cast, sensor, cull, count, bins, direction, limit)
        if k > j:
            count = add_occluder(delta2, cast2, sensor, cull, count, bins, direction, limit)
    return count


@wp.func
def add_body(
    maps: Maps,
    m: int,
    robots: Robots,
    other: int,
    pose: wp.vec4,
    forward: wp.vec2,
    at: wp.vec2,
    sensor: Sensor,
    planar: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the outline of robot ``other`` at ``at`` from the sensor, unless it is hidden; returns the new count."""
    e = sensor.env
    length = robots.length[e, other]
    width = robots.width[e, other]
    dist = wp.length(at)
    half = HALF * wp.sqrt(length * length + width * width)
    reach = half + wp.max(0.36 * wp.max(length, width), sensor.spread * (dist + half))
    if dist > 1.0001 * sensor.radius + half or (
        planar != 0 and is_hidden(bins, e, sensor.robot, at[0], at[1], reach, dist - half)
    ):
        return start
    return add_outline(
        pose,
        forward,
        length,
        width,
        robots.center_offset[e, other],
        maps.resolution[m],
        maps.outline_radius_max[m],
        sensor,
        planar,
        start,
        bins,
        direction,
        limit,
    )


@wp.kernel
def _collect_occluders(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    planar: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    facing: wp.array2d(dtype=wp.vec2),  # [env, robot]
    near: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    near_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # Scratch out:
    bins: wp.array3d(dtype=wp.float32),  # [env, robot, bin]
    direction: wp.array3d(dtype=wp.vec3),  # [env, robot, occluder]
    limit: wp.array3d(dtype=wp.vec2),  # [env, robot, occluder]
    occluder_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    wall_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """Gather what can mask the radar of robot (e, i): static occluders, the nearest rows first, and other bodies."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    radius = robots.radar_range[e, i]
    cos_beam = robots.radar_cos_beam[e, i]
    spread = wp.sqrt(wp.max(1.0 - cos_beam * cos_beam, 0.0))
    if cos_beam < 0.0:
        spread = FAR
    origin = center[e, i]
    sensor = Sensor()
    sensor.env = e
    sensor.robot = i
    sensor.origin = origin
    sensor.radius = radius
    sensor.cos_beam = cos_beam
    sensor.spread = spread
    visible_count[e, i] = 0
    for b in range(2 * BINS):
        bins[e, i, b] = FAR
    count = int(0)
    at = wp.vec2(origin[0], origin[1])
    rows = row_range(maps, m, at, radius)
    # Few occluders a cell: to ask first costs more than to enter them.
    cells = maps.cells_x[m] * maps.cells_y[m]
    cull = wp.where(maps.occluder_begin[m + 1] - maps.occluder_begin[m] >= WORTH_AN_OCCLUDER * cells, planar, 0)
    middle = floor_within(at[1] - maps.cell_origin[m][1], maps.cell_size[m], 0, maps.cells_y[m] - 1)
    for k in range(2 * wp.max(middle - rows[0], rows[1] - middle) + 1):
        row = rows[0] + k
        if cull != 0:
            row = middle + wp.where(k % 2 == 0, k / 2, -(k + 1) / 2)
        if row >= rows[0] and row <= rows[1]:
            span = row_span(maps, m, row, at, radius)
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            run = run_length(maps.occluder_cell, base, span, WORTH_AN_OCCLUDER, cull)
            for col in range(span[0], span[1] + 1, run):
                count = add_cells(
                    maps,
                    m,
                    row,
                    col,
                    run,
                    sensor,
                    cull,
                    count,
                    bins,
                    direction,
                    limit,
                )
    walls = int(count)
    for k in range(near_count[e, i]):
        other = near[e, i, k]
        there = point_xy(center[e, other] - origin)
        if within(there, radius + HALF * (robots.length[e, other] + robots.width[e, other])):
            if count == walls:
                keep_walls(bins, e, i)
            count = add_body(
                maps,
                m,
                robots,
                other,
                pose[e, other],
                facing[e, other],
                there,
                sensor,
                planar,
                count,
                bins,
                direction,
                limit,
            )
    if count > direction.shape[2]:
        wp.atomic_or(error, e, ERROR_CAPACITY)
        count = direction.shape[2]
    occluder_count[e, i] = count
    wall_count[e, i] = wp.where(count > walls, walls, 0)


@wp.kernel
def _scan_free(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    planar: int,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    bins: wp.array3d(dtype=wp.float32),  # [env, robot, bin]
    direction: wp.array3d(dtype=wp.vec3),  # [env, robot, occluder]
    limit: wp.array3d(dtype=wp.vec2),  # [env, robot, occluder]
    occluder_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    wall_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    error: wp.array(dtype=wp.int32),  # [env]
    # Scratch in and out:
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # Scratch out:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
):
    """List the free points that robot (e, i) sees now and count its view at each of them."""
    e, i, lane = wp.tid()
    if active[e] == 0 or failed[e, i] != 0:
        return
    m = map_id[e]
    radius = robots.radar_range[e, i]
    alpha2 = robots.radar_alpha2[e, i]
    cos_fov = robots.radar_cos_fov[e, i]
    heading = wp.vec3(wp.cos(pose[e, i][3]), wp.sin(pose[e, i][3]), 0.0)
    origin = center[e, i]
    count = occluder_count[e, i]
    walls = wall_count[e, i]
    at = wp.vec2(origin[0], origin[1])
    half = CELL_HALF * maps.cell_size[m]
    rows = row_range(maps, m, at, radius)
    first = maps.free_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, at, radius)
        base = maps.cell_begin[m] + row * maps.cells_x[m]
        run = run_length(maps.free_cell, base, span, WORTH_A_TEST, planar)
        for col in range(span[0], span[1] + 1, run):
            hidden = bool(False)
            if run == 1 and planar != 0:
                to = cell_center(maps, m, row, col) - at
                hidden = is_hidden(bins, e, i, to[0], to[1], half, wp.length(to) - half + wp.min(alpha2, 0.0))
            if not hidden:
                for j in range(maps.free_cell[base + col] + lane, maps.free_cell[base + col + run], lanes):
                    delta = maps.free[first + j] - origin
                    dist = wp.length(delta)
                    if dist <= radius and wp.dot(delta, heading) >= cos_fov * dist:
                        if not is_masked(delta, dist, alpha2, e, i, walls, count, bins, direction, limit):
                            wp.atomic_add(viewers_free, e, 0, j, VIEWER_NOW)
                            slot = wp.atomic_add(visible_count, e, i, 1)
                            if slot < visible.shape[2]:
                                visible[e, i, slot] = j
                            else:
                                wp.atomic_or(error, e, ERROR_CAPACITY)


@wp.kernel
def _scan_boundary(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # Settings:
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    visible: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    visible_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    seen_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    viewers_boundary: wp.array3d(dtype=wp.int32),  # [env, 1, boundary]
):
    """Mark the boundary points in range that touch a free point seen now by the same robot."""
    e, i, lane = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    radius = robots.radar_range[e, i]
    origin = center[e, i]
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    first = maps.free_begin[m]
    begin = maps.boundary_begin[m]
    for k in range(lane, wp.min(visible_count[e, i], visible.shape[2]), lanes):
        point = first + visible[e, i, k]
        for n in range(maps.neighbour_begin[point], maps.neighbour_begin[point + 1]):
            j = maps.neighbour[n]
            if (seen_boundary[e, word, j] & bit) == 0 and wp.length(maps.boundary[begin + j] - origin) <= radius:
                if (wp.atomic_or(seen_boundary, e, word, j, bit) & bit) == 0:
                    wp.atomic_add(viewers_boundary, e, 0, j, 1)


def scan(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """What every robot sees now, in the envs where ``running`` [env] is set; maps of an env are planar. ``ahead`` is 0
    at a reset, 1 in a local step."""
    lanes = (*shard.shape, shard.lanes)
    shard.call(launch, _collect_occluders, active=running, planar=1)
    shard.call(launch, _scan_free, lanes, active=running, planar=1)
    if shard.values["sensing"] is None:
        shard.call(launch, _scan_boundary, lanes, active=running)
    else:
        sense(launch, shard, running, ahead)
