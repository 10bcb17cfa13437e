"""Shadows: directions around a sensor cut into bins, and what occluders cast there.

For every bin we keep the distance of the nearest occluder that may touch it (``near``) and of the nearest one
that surely covers all of it (``full``). A free point nearer than ``near`` is visible, one behind ``full`` is
masked. Only points between the two are tested against every occluder, so the verdict is the same, bit for bit.
``near`` of the static occluders is kept apart: where only another robot's body may hide a point, it is tested
against bodies only.

Likewise an occluder all of whose bins are full nearer than itself decides nothing: every free point
that it could mask is masked.
"""

import warp as wp

BINS = 128
BIN_MARGIN = 1.0e-4  # in diamond angle; far above float32 error of the exact test
LEAST_SINE = 0.01  # below it that of the angle whose cosine is tested differs by more than rounding


@wp.struct
class Sensor:
    """The radar of robot ``robot`` of env ``env``, and how wide its beams are."""

    env: int
    robot: int
    origin: wp.vec3  # [m]
    radius: float  # [m]
    cos_beam: float  # of half a beam
    spread: float  # its sine, `FAR` beyond a right angle


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
def shadow(delta: wp.vec3, rho: float, sensor: Sensor) -> wp.vec4:
    """Of an occluder at ``delta`` from the sensor: cosine of its angular half-width, distance, and `sector`."""
    dist = wp.length(delta)
    s = wp.min(1.0, rho / dist)
    c = wp.min(sensor.cos_beam, wp.sqrt(1.0 - s * s))
    sine = wp.max(s, sensor.spread)
    if sine < LEAST_SINE:
        sine = wp.sqrt(wp.max(1.0 - c * c, 0.0))
    edges = sector(delta[0], delta[1], c, sine)
    return wp.vec4(c, dist, edges[0], edges[1])


@wp.func
def add_occluder(
    delta: wp.vec3,
    cast: wp.vec4,
    sensor: Sensor,
    cull: int,
    count: int,
    bins: wp.array3d(dtype=wp.float32),
    direction: wp.array3d(dtype=wp.vec3),
    limit: wp.array3d(dtype=wp.vec2),
) -> int:
    """Append an occluder at ``delta`` that casts a `shadow` if it is in range and matters; returns the new count."""
    c = cast[0]
    dist = cast[1]
    e = sensor.env
    i = sensor.robot
    if dist > sensor.radius or dist == 0.0:
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
    sensor: Sensor,
    cull: int,
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
    nearest = nearest_outline(
        wp.vec2(sensor.origin[0], sensor.origin[1]) - center, forward, length, width, along, across
    )
    total = 2 * (along + across)
    for j in range(along + across):
        dp = outline_point(nearest - j + total, along, across, center, forward, length, width) - sensor.origin
        dq = outline_point(nearest + 1 + j, along, across, center, forward, length, width) - sensor.origin
        dp[2] = 0.0
        dq[2] = 0.0
        sp = shadow(dp, rho, sensor)
        sq = shadow(dq, rho, sensor)
        count = add_occluder(dp, sp, sensor, cull, count, bins, direction, limit)
        count = add_occluder(dq, sq, sensor, cull, count, bins, direction, limit)
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
