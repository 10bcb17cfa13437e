"""Radar: ray-masked point filtering (design 4.1; paper, section IV-A).

A free point P_f (seen from the robot's centre) is masked when some occluder P_o in range has

    |P_o| - |P_f| < alpha2   and   (cos(P_f, P_o) > 1 - alpha1  or  angle(P_f, P_o) < asin(min(1, rho / |P_o|)))

Both angular tests fold into ``dot(P_f, u_o) > c_o |P_f|`` with
``c_o = min(1 - alpha1, sqrt(1 - min(1, rho / |P_o|)^2))``.

Directions are cut into bins so that most points need no pairwise test. For every bin we keep the
distance of the nearest occluder that may touch it (``near``) and of the nearest one that surely
covers all of it (``full``). A free point nearer than ``near`` is visible, one behind ``full`` is
masked, and only the rest meets the occluders one by one: the verdict is the same, bit for bit. Where only
another robot's body may be near enough (``near`` of the static occluders is kept beside), it meets bodies only.

Likewise an occluder all of whose bins are full nearer than itself decides nothing: every free point
that it could mask is masked. So occluders are entered the nearest rows of cells first, and cells and bodies
behind what is full are left out at once: with walls around, the cost follows what is seen, not the
square of the range. In a cloud that is not ``planar`` bins do not decide alone, and nothing is left out.
"""

import warp as wp

from maexp.kernels.types import (
    HALF,
    ROBOTS_PER_WORD,
    VIEWER_NOW,
    Maps,
    Robots,
    cell_center,
    floor_within,
    point_xy,
    row_range,
    row_span,
    within,
)

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile

BINS = wp.constant(128)
FAR = wp.constant(1.0e30)
BIN_MARGIN = wp.constant(1.0e-4)  # in diamond angle; far above float32 error of the exact test
LEAST_SINE = wp.constant(0.01)  # below it that of the angle whose cosine is tested differs by more than rounding
CELL_HALF = wp.constant(0.709)  # half the diagonal of a cell in edges, with room for rounding
WORTH_A_TEST = wp.constant(6)  # free points of a cell from which on it pays to ask first whether it is hidden
WORTH_AN_OCCLUDER = wp.constant(2)  # occluders from which on it does


@wp.func
def diamond_angle(x: float, y: float) -> float:
    """A monotone stand-in for atan2 on [0, 4), exact enough for bins and free of trigonometry."""
    total = wp.abs(x) + wp.abs(y)
    if total == 0.0:
        return 0.0
    p = y / total
    return wp.where(x < 0.0, 2.0 - p, wp.where(y < 0.0, 4.0 + p, p))


@wp.func
def bin_of(x: float, y: float) -> int:
    return wp.min(int(diamond_angle(x, y) * (float(BINS) / 4.0)), BINS - 1)


@wp.func
def lower_all_bins(bins: wp.array3d(dtype=wp.float32), e: int, i: int, dist: float):
    for b in range(BINS):
        bins[e, i, b] = wp.min(bins[e, i, b], dist)


@wp.func
def keep_walls(bins: wp.array3d(dtype=wp.float32), e: int, i: int):
    """Keep the bins' nearest static occluders, before bodies are entered."""
    for b in range(BINS):
        bins[e, i, 2 * BINS + b] = bins[e, i, b]


@wp.func
def sector(x: float, y: float, c: float, s: float) -> wp.vec2:
    """First and last diamond angle (the last up to 8) of the directions within an angle of the vector (x, y).

    ``c`` and ``s`` are the cosine and sine of the angle.
    """
    start = diamond_angle(c * x + s * y, c * y - s * x)
    stop = diamond_angle(c * x - s * y, c * y + s * x)
    if stop < start - BIN_MARGIN:
        stop += 4.0
    return wp.vec2(start, stop)


@wp.func
def cover_bins(bins: wp.array3d(dtype=wp.float32), e: int, i: int, edges: wp.vec2, dist: float) -> bool:
    """Enter an occluder between two diamond angles; False where all its bins are full before."""
    scale = float(BINS) / 4.0
    full_from = (edges[0] + BIN_MARGIN) * scale
    full_to = (edges[1] - BIN_MARGIN) * scale
    farthest = float(0.0)
    for b in range(int(wp.floor((edges[0] - BIN_MARGIN) * scale)), int(wp.floor((edges[1] + BIN_MARGIN) * scale)) + 1):
        k = b & (BINS - 1)
        farthest = wp.max(farthest, bins[e, i, BINS + k])
        bins[e, i, k] = wp.min(bins[e, i, k], dist)
        if float(b) >= full_from and float(b + 1) <= full_to:
            bins[e, i, BINS + k] = wp.min(bins[e, i, BINS + k], dist)
    return farthest > dist


@wp.func
def is_hidden(bins: wp.array3d(dtype=wp.float32), e: int, i: int, x: float, y: float, size: float, near: float) -> bool:
    """Whether all bins that a disc of radius ``size`` around (x, y) touches are full nearer than ``near``."""
    dist = wp.sqrt(x * x + y * y)
    if size >= dist * 0.9999:
        return False
    s = size / dist
    edges = sector(x, y, wp.sqrt(1.0 - s * s), s)
    scale = float(BINS) / 4.0
    for b in range(int(wp.floor((edges[0] - BIN_MARGIN) * scale)), int(wp.floor((edges[1] + BIN_MARGIN) * scale)) + 1):
        if bins[e, i, BINS + (b & (BINS - 1))] > near:
            return False
    return True


@wp.func
def shadow(delta: wp.vec3, rho: float, cos_beam: float, spread: float) -> wp.vec4:
    """Of an occluder at ``delta`` from the sensor: cosine of its angular half-width, distance, and `sector`."""
    dist = wp.length(delta)
    s = wp.min(1.0, rho / dist)
    c = wp.min(cos_beam, wp.sqrt(1.0 - s * s))
    sine = wp.max(s, spread)
    if sine < LEAST_SINE:
        sine = wp.sqrt(wp.max(1.0 - c * c, 0.0))
    edges = sector(delta[0], delta[1], c, sine)
    return wp.vec4(c, dist, edges[0], edges[1])


@wp.func
def add_occluder(
    delta: wp.vec3,
    cast: wp.vec4,
    radius: float,
    cull: int,
    e: int,
    i: int,
    count: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append an occluder at ``delta`` that casts a `shadow` if it is in range and matters; returns the new count."""
    c = cast[0]
    dist = cast[1]
    if dist > radius or dist == 0.0:
        return count
    u = delta / dist
    if c < 0.0 or wp.abs(u[2]) > 1.0e-6:
        lower_all_bins(bins, e, i, dist)
    elif not cover_bins(bins, e, i, wp.vec2(cast[2], cast[3]), dist) and cull != 0:
        return count
    if count < direction.shape[2]:
        direction[e, i, count] = u
        limit[e, i, count] = wp.vec2(c, dist)
    return count + 1


@wp.func
def outline_point(
    index: int, along: int, across: int, center: wp.vec2, forward: wp.vec2, length: float, width: float
) -> wp.vec3:
    """Point ``index``, up to twice round, of the outline of a body."""
    half = along + across
    k = wp.where(index >= 2 * half, index - 2 * half, index)
    side = wp.where(k >= half, -1.0, 1.0)
    k = wp.where(k >= half, k - half, k)
    lengthwise = k < along
    part = wp.where(lengthwise, float(k), float(k - along)) / wp.where(lengthwise, float(along), float(across))
    a = side * wp.where(lengthwise, -0.5 + part, 0.5)  # position on the outline, in lengths and widths from the centre
    b = side * wp.where(lengthwise, -0.5, -0.5 + part)
    p = center + a * length * forward + b * width * wp.vec2(-forward[1], forward[0])
    return wp.vec3(p[0], p[1], 0.0)


@wp.func
def nearest_outline(at: wp.vec2, forward: wp.vec2, length: float, width: float, along: int, across: int) -> int:
    """Index of a point of an outline near to what lies at ``at`` from its centre."""
    a = wp.dot(at, forward) / length
    b = wp.dot(at, wp.vec2(-forward[1], forward[0])) / width
    half = along + across
    k = int((wp.clamp(a, -0.5, 0.5) + 0.5) * float(along) + 0.5)
    if wp.abs(a) > wp.abs(b):
        k = along + int((wp.clamp(b, -0.5, 0.5) + 0.5) * float(across) + 0.5)
        return wp.where(a > 0.0, k, half + along + half - k)
    return wp.where(b < 0.0, k, half + along - k)


@wp.func
def add_outline(
    pose: wp.vec4,
    forward: wp.vec2,
    length: float,
    width: float,
    offset: float,
    spacing: float,
    radius_max: float,
    origin: wp.vec3,
    radius: float,
    cos_beam: float,
    spread: float,
    cull: int,
    e: int,
    i: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the outline of another robot's body, sampled at ``spacing`` or finer."""
    count = start
    center = wp.vec2(pose[0], pose[1]) + offset * forward
    along = wp.max(2, int(wp.ceil(length / spacing)))
    across = wp.max(2, int(wp.ceil(width / spacing)))
    rho = wp.min(radius_max, wp.max(length / float(along), width / float(across)) * 0.70710678)
    nearest = nearest_outline(wp.vec2(origin[0], origin[1]) - center, forward, length, width, along, across)
    total = 2 * (along + across)
    for j in range(along + across):
        dp = outline_point(nearest - j + total, along, across, center, forward, length, width) - origin
        dq = outline_point(nearest + 1 + j, along, across, center, forward, length, width) - origin
        dp[2] = 0.0
        dq[2] = 0.0
        sp = shadow(dp, rho, cos_beam, spread)
        sq = shadow(dq, rho, cos_beam, spread)
        count = add_occluder(dp, sp, radius, cull, e, i, count, bins, direction, limit)
        count = add_occluder(dq, sq, radius, cull, e, i, count, bins, direction, limit)
    return count


@wp.func
def is_masked(
    delta: wp.vec3,
    dist: float,
    alpha2: float,
    e: int,
    i: int,
    walls: int,
    count: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> bool:
    """Whether any of the ``count`` occluders, the first ``walls`` of them static, masks the free point at ``delta``.

    ``walls`` is 0 where there are no bodies, or static occluders and bodies are not told apart.
    """
    b = bin_of(delta[0], delta[1])
    if dist == 0.0 or not (bins[e, i, b] - dist < alpha2):
        return False
    if bins[e, i, BINS + b] - dist < alpha2 and wp.abs(delta[2]) <= 1.0e-6 * dist:
        return True
    first = int(0)
    if walls > 0:
        if not (bins[e, i, 2 * BINS + b] - dist < alpha2):
            first = walls
    for k in range(first, count):
        cd = limit[e, i, k]
        if cd[1] - dist < alpha2:
            if wp.dot(delta, direction[e, i, k]) > cd[0] * dist:
                return True
    return False


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
    origin: wp.vec3,
    radius: float,
    cos_beam: float,
    spread: float,
    cull: int,
    e: int,
    i: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the occluders of a run of cells, unless it is one that is hidden; returns the new count."""
    count = int(start)
    cell = maps.cell_begin[m] + row * maps.cells_x[m] + col
    begin = maps.occluder_cell[cell]
    end = maps.occluder_cell[cell + run]
    if run == 1 and end > begin and cull != 0:
        at = cell_center(maps, m, row, col) - wp.vec2(origin[0], origin[1])
        half = CELL_HALF * maps.cell_size[m]
        dist = wp.length(at)
        width = wp.max(maps.occluder_radius_max[m], spread * (dist + half))
        if is_hidden(bins, e, i, at[0], at[1], half + width, dist - half):
            return count
    first = maps.occluder_begin[m]
    for j in range(first + begin, first + end, 2):
        k = wp.min(j + 1, first + end - 1)
        delta = maps.occluder[j] - origin
        delta2 = maps.occluder[k] - origin
        cast = shadow(delta, maps.occluder_radius[j], cos_beam, spread)
        cast2 = shadow(delta2, maps.occluder_radius[k], cos_beam, spread)
        count = add_occluder(delta, cast, radius, cull, e, i, count, bins, direction, limit)
        if k > j:
            count = add_occluder(delta2, cast2, radius, cull, e, i, count, bins, direction, limit)
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
    origin: wp.vec3,
    radius: float,
    cos_beam: float,
    spread: float,
    planar: int,
    e: int,
    i: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the outline of robot ``other`` at ``at`` from the sensor, unless it is hidden; returns the new count."""
    length = robots.length[e, other]
    width = robots.width[e, other]
    dist = wp.length(at)
    half = 0.501 * wp.sqrt(length * length + width * width)
    reach = half + wp.max(0.36 * wp.max(length, width), spread * (dist + half))
    if dist > 1.0001 * radius + half or planar != 0 and is_hidden(bins, e, i, at[0], at[1], reach, dist - half):
        return start
    return add_outline(
        pose, forward, length, width, robots.center_offset[e, other], maps.resolution[m], maps.outline_radius_max[m],
        origin, radius, cos_beam, spread, planar, e, i, start, bins, direction, limit,
    )  # fmt: skip


@wp.kernel
def _collect_occluders(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    planar: int,
    # Robots:
    robots: Robots,
    # State in:
    active: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
    # Scratch in:
    facing: wp.array2d(dtype=wp.vec2),
    near: wp.array3d(dtype=wp.int32),
    near_count: wp.array2d(dtype=wp.int32),
    # Scratch out:
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
    occluder_count: wp.array2d(dtype=wp.int32),
    wall_count: wp.array2d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    error: wp.array(dtype=wp.int32),
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
                    maps, m, row, col, run, origin, radius, cos_beam, spread, cull,
                    e, i, count, bins, direction, limit,
                )  # fmt: skip
    walls = int(count)
    for k in range(near_count[e, i]):
        other = near[e, i, k]
        there = point_xy(center[e, other] - origin)
        if within(there, radius + HALF * (robots.length[e, other] + robots.width[e, other])):
            if count == walls:
                keep_walls(bins, e, i)
            count = add_body(
                maps, m, robots, other, pose[e, other], facing[e, other], there, origin,
                radius, cos_beam, spread, planar, e, i, count, bins, direction, limit,
            )  # fmt: skip
    if count > direction.shape[2]:
        wp.atomic_or(error, e, 4)
        count = direction.shape[2]
    occluder_count[e, i] = count
    wall_count[e, i] = wp.where(count > walls, walls, 0)


@wp.kernel
def _scan_free(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    planar: int,
    # Robots:
    robots: Robots,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
    # Scratch in:
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
    occluder_count: wp.array2d(dtype=wp.int32),
    wall_count: wp.array2d(dtype=wp.int32),
    # Scratch out:
    viewers_free: wp.array3d(dtype=wp.int32),
    visible: wp.array3d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    error: wp.array(dtype=wp.int32),
):
    """List the free points that robot (e, i) sees now and count its view at each of them."""
    e, i, lane = wp.tid()
    if active[e] == 0:
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
                                wp.atomic_or(error, e, 4)


@wp.kernel
def _scan_boundary(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    # Robots:
    robots: Robots,
    lanes: int,
    # State in:
    active: wp.array(dtype=wp.int32),
    center: wp.array2d(dtype=wp.vec3),
    visible: wp.array3d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    # State out:
    seen_boundary: wp.array3d(dtype=wp.int32),
    viewers_boundary: wp.array3d(dtype=wp.int32),
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
