"""Distances between points, segments and the rectangles that bodies are [m]."""

import warp as wp


@wp.func
def box_distance(p: wp.vec2, center: wp.vec2, ahead: wp.vec2, length: float, width: float) -> float:
    """Distance of a point to a rectangle whose length lies along the unit vector ``ahead``, 0 inside."""
    d = p - center
    c = ahead[0]
    s = ahead[1]
    a = wp.max(wp.abs(c * d[0] + s * d[1]) - 0.5 * length, 0.0)
    b = wp.max(wp.abs(c * d[1] - s * d[0]) - 0.5 * width, 0.0)
    return wp.sqrt(a * a + b * b)


@wp.func
def rectangle_distance(p: wp.vec2, center: wp.vec2, theta: float, length: float, width: float) -> float:
    """Distance of a point to an oriented rectangle, 0 inside."""
    return box_distance(p, center, wp.vec2(wp.cos(theta), wp.sin(theta)), length, width)


@wp.func
def rectangle_corner(k: int, center: wp.vec2, theta: float, length: float, width: float) -> wp.vec2:
    """Corner k of an oriented rectangle, counted around it from front left."""
    a = wp.where(k < 2, 0.5, -0.5) * length
    b = wp.where(k == 0 or k == 3, 0.5, -0.5) * width
    c = wp.cos(theta)
    s = wp.sin(theta)
    return wp.vec2(center[0] + a * c - b * s, center[1] + a * s + b * c)


@wp.func
def separated(
    center: wp.vec2,
    theta: float,
    length: float,
    width: float,
    other: wp.vec2,
    theta_o: float,
    length_o: float,
    width_o: float,
) -> bool:
    """Whether an axis of the first rectangle separates the two."""
    c = wp.cos(theta)
    s = wp.sin(theta)
    d = other - center
    co = wp.abs(wp.cos(theta_o - theta))
    so = wp.abs(wp.sin(theta_o - theta))
    along = 0.5 * (length + co * length_o + so * width_o)
    across = 0.5 * (width + so * length_o + co * width_o)
    return wp.abs(c * d[0] + s * d[1]) > along or wp.abs(c * d[1] - s * d[0]) > across


@wp.func
def rectangles_gap(
    center: wp.vec2,
    theta: float,
    length: float,
    width: float,
    other: wp.vec2,
    theta_o: float,
    length_o: float,
    width_o: float,
) -> float:
    """Distance of two oriented rectangles, 0 where they overlap.

    The nearest points of two disjoint convex polygons include a corner of one of them.
    """
    if not separated(center, theta, length, width, other, theta_o, length_o, width_o):
        if not separated(other, theta_o, length_o, width_o, center, theta, length, width):
            return 0.0
    gap = float(1.0e30)
    for k in range(4):
        p = rectangle_corner(k, center, theta, length, width)
        q = rectangle_corner(k, other, theta_o, length_o, width_o)
        gap = wp.min(gap, rectangle_distance(p, other, theta_o, length_o, width_o))
        gap = wp.min(gap, rectangle_distance(q, center, theta, length, width))
    return gap


@wp.func
def segment_distance(p: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    """Distance of a point to a segment [m]."""
    along = b - a
    t = wp.clamp(wp.dot(p - a, along) / wp.max(wp.dot(along, along), 1.0e-12), 0.0, 1.0)
    return wp.length(p - a - t * along)
