"""Radar: ray-masked point filtering (design 4.1; paper, section IV-A).

A free point P_f (seen from the robot's centre) is masked when some occluder P_o in range has

    |P_o| - |P_f| < alpha2   and   (cos(P_f, P_o) > 1 - alpha1  or  angle(P_f, P_o) < asin(min(1, rho / |P_o|)))

Both angular tests fold into ``dot(P_f, u_o) > c_o |P_f|`` with
``c_o = min(1 - alpha1, sqrt(1 - min(1, rho / |P_o|)^2))``.

Directions are cut into bins so that most points need no pairwise test. For every bin we keep the
distance of the nearest occluder that may touch it (``near``) and of the nearest one that surely
covers all of it (``full``). A free point nearer than ``near`` is visible, one behind ``full`` is
masked, and only the rest meets the occluders one by one: the verdict is the same, bit for bit.
"""

import warp as wp

from maexp.kernels.types import ROBOTS_PER_WORD, Maps, Robots, row_range, row_span

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile

BINS = wp.constant(128)
FAR = wp.constant(1.0e30)
BIN_MARGIN = wp.constant(1.0e-4)  # in diamond angle; far above float32 error of the exact test


@wp.func
def diamond_angle(x: float, y: float) -> float:
    """A monotone stand-in for atan2 on [0, 4), exact enough for bins and free of trigonometry."""
    total = wp.abs(x) + wp.abs(y)
    if total == 0.0:
        return 0.0
    p = y / total
    if x < 0.0:
        return 2.0 - p
    if y < 0.0:
        return 4.0 + p
    return p


@wp.func
def bin_of(x: float, y: float) -> int:
    return wp.min(int(diamond_angle(x, y) * (float(BINS) / 4.0)), BINS - 1)


@wp.func
def lower_all_bins(bins: wp.array3d(dtype=wp.float32), e: int, i: int, dist: float):
    for b in range(BINS):
        bins[e, i, b] = wp.min(bins[e, i, b], dist)


@wp.func
def cover_bins(bins: wp.array3d(dtype=wp.float32), e: int, i: int, u: wp.vec3, c: float, dist: float):
    """Enter an occluder of direction ``u`` and angular half-width acos(c) into the bins."""
    if c < 0.0 or wp.abs(u[2]) > 1.0e-6:
        lower_all_bins(bins, e, i, dist)
        return
    s = wp.sqrt(wp.max(1.0 - c * c, 0.0))
    start = diamond_angle(c * u[0] + s * u[1], c * u[1] - s * u[0])
    stop = diamond_angle(c * u[0] - s * u[1], c * u[1] + s * u[0])
    if stop < start - BIN_MARGIN:
        stop += 4.0
    scale = float(BINS) / 4.0
    first = int(wp.floor((start - BIN_MARGIN) * scale))
    last = int(wp.floor((stop + BIN_MARGIN) * scale))
    full_from = (start + BIN_MARGIN) * scale
    full_to = (stop - BIN_MARGIN) * scale
    for b in range(first, last + 1):
        k = b & (BINS - 1)
        bins[e, i, k] = wp.min(bins[e, i, k], dist)
        if float(b) >= full_from and float(b + 1) <= full_to:
            bins[e, i, BINS + k] = wp.min(bins[e, i, BINS + k], dist)


@wp.func
def add_occluder(
    delta: wp.vec3,
    rho: float,
    radius: float,
    cos_beam: float,
    e: int,
    i: int,
    count: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append an occluder at ``delta`` from the sensor if it is in range; returns the new count."""
    dist = wp.length(delta)
    if dist > radius or dist == 0.0:
        return count
    s = wp.min(1.0, rho / dist)
    c = wp.min(cos_beam, wp.sqrt(1.0 - s * s))
    u = delta / dist
    if count < direction.shape[2]:
        direction[e, i, count] = u
        limit[e, i, count] = wp.vec2(c, dist)
        cover_bins(bins, e, i, u, c, dist)
    return count + 1


@wp.func
def add_outline(
    pose: wp.vec4,
    length: float,
    width: float,
    offset: float,
    spacing: float,
    radius_max: float,
    origin: wp.vec3,
    radius: float,
    cos_beam: float,
    e: int,
    i: int,
    start: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append the outline of another robot's body, sampled at ``spacing`` or finer."""
    count = start
    forward = wp.vec2(wp.cos(pose[3]), wp.sin(pose[3]))
    left = wp.vec2(-forward[1], forward[0])
    center = wp.vec2(pose[0], pose[1]) + offset * forward
    along = wp.max(2, int(wp.ceil(length / spacing)))
    across = wp.max(2, int(wp.ceil(width / spacing)))
    rho = wp.min(radius_max, wp.max(length / float(along), width / float(across)) * 0.70710678)
    for k in range(2 * (along + across)):
        a = 0.5  # position on the outline, in lengths and widths from the centre
        b = 0.5
        if k < along:
            a = -0.5 + float(k) / float(along)
            b = -0.5
        elif k < along + across:
            b = -0.5 + float(k - along) / float(across)
        elif k < 2 * along + across:
            a = 0.5 - float(k - along - across) / float(along)
        else:
            a = -0.5
            b = 0.5 - float(k - 2 * along - across) / float(across)
        p = center + a * length * forward + b * width * left
        count = add_occluder(
            wp.vec3(p[0] - origin[0], p[1] - origin[1], 0.0),
            rho, radius, cos_beam, e, i, count, bins, direction, limit,
        )  # fmt: skip
    return count


@wp.func
def is_masked(
    delta: wp.vec3,
    dist: float,
    alpha2: float,
    e: int,
    i: int,
    count: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> bool:
    """Whether any of the ``count`` occluders masks the free point at ``delta``."""
    b = bin_of(delta[0], delta[1])
    if dist == 0.0 or not (bins[e, i, b] - dist < alpha2):
        return False
    if bins[e, i, BINS + b] - dist < alpha2 and wp.abs(delta[2]) <= 1.0e-6 * dist:
        return True
    for k in range(count):
        cd = limit[e, i, k]
        if cd[1] - dist < alpha2:
            if wp.dot(delta, direction[e, i, k]) > cd[0] * dist:
                return True
    return False


@wp.kernel
def _collect_occluders(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
    # Robots:
    robots: Robots,
    # State in:
    active: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.vec4),
    center: wp.array2d(dtype=wp.vec3),
    # Scratch out:
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
    occluder_count: wp.array2d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    error: wp.array(dtype=wp.int32),
):
    """Gather what can mask the radar of robot (e, i): static occluders and the other robots' bodies."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    radius = robots.radar_range[e, i]
    cos_beam = robots.radar_cos_beam[e, i]
    origin = center[e, i]
    visible_count[e, i] = 0
    for b in range(2 * BINS):
        bins[e, i, b] = FAR
    count = int(0)
    at = wp.vec2(origin[0], origin[1])
    rows = row_range(maps, m, at, radius)
    first = maps.occluder_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, at, radius)
        if span[0] <= span[1]:
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            for j in range(first + maps.occluder_cell[base + span[0]], first + maps.occluder_cell[base + span[1] + 1]):
                count = add_occluder(
                    maps.occluder[j] - origin, maps.occluder_radius[j], radius, cos_beam,
                    e, i, count, bins, direction, limit,
                )  # fmt: skip
    for other in range(pose.shape[1]):
        if other != i:
            length = robots.length[e, other]
            width = robots.width[e, other]
            if wp.length(center[e, other] - origin) <= radius + length + width:
                count = add_outline(
                    pose[e, other], length, width, robots.center_offset[e, other],
                    maps.resolution[m], maps.outline_radius_max[m], origin, radius, cos_beam,
                    e, i, count, bins, direction, limit,
                )  # fmt: skip
    if count > direction.shape[2]:
        wp.atomic_or(error, e, 4)
        count = direction.shape[2]
    occluder_count[e, i] = count


@wp.kernel
def _scan_free(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),
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
    # Scratch out:
    now_free: wp.array3d(dtype=wp.int32),
    visible: wp.array3d(dtype=wp.int32),
    visible_count: wp.array2d(dtype=wp.int32),
    error: wp.array(dtype=wp.int32),
):
    """Set the flags of the free points that robot (e, i) sees now and list them."""
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
    word = i / ROBOTS_PER_WORD
    bit = 1 << (i % ROBOTS_PER_WORD)
    at = wp.vec2(origin[0], origin[1])
    rows = row_range(maps, m, at, radius)
    first = maps.free_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, at, radius)
        if span[0] <= span[1]:
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            stop = maps.free_cell[base + span[1] + 1]
            for j in range(maps.free_cell[base + span[0]] + lane, stop, lanes):
                delta = maps.free[first + j] - origin
                dist = wp.length(delta)
                if dist <= radius and wp.dot(delta, heading) >= cos_fov * dist:
                    if not is_masked(delta, dist, alpha2, e, i, count, bins, direction, limit):
                        wp.atomic_or(now_free, e, word, j, bit)
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
    now_free: wp.array3d(dtype=wp.int32),
    # State out:
    seen_boundary: wp.array3d(dtype=wp.int32),
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
    at = wp.vec2(origin[0], origin[1])
    rows = row_range(maps, m, at, radius)
    first = maps.boundary_begin[m]
    for row in range(rows[0], rows[1] + 1):
        span = row_span(maps, m, row, at, radius)
        if span[0] <= span[1]:
            base = maps.cell_begin[m] + row * maps.cells_x[m]
            stop = maps.boundary_cell[base + span[1] + 1]
            for j in range(maps.boundary_cell[base + span[0]] + lane, stop, lanes):
                if (seen_boundary[e, word, j] & bit) == 0:
                    if wp.length(maps.boundary[first + j] - origin) <= radius:
                        for k in range(maps.neighbour_begin[first + j], maps.neighbour_begin[first + j + 1]):
                            if (now_free[e, word, maps.neighbour[k]] & bit) != 0:
                                wp.atomic_or(seen_boundary, e, word, j, bit)
                                break
