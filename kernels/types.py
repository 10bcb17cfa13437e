"""Static data that every kernel reads: maps, as a struct of Warp arrays.

Three kinds of arrays are kept apart: static (here, and `kernels.dynamics.Robots`), state (`kernels.state`) and scratch
(ibid.).

Maps of a batch differ in size. Their points are concatenated; ``x_begin[m]`` is the first point of
map ``m``. Within a map the points are sorted by cell of a regular grid (row-major, x fastest), so
the points of a row of cells are one contiguous run; ``x_cell`` holds the start of every cell's run,
relative to ``x_begin[m]``. Indices of points are relative to their map everywhere else.
"""

import warp as wp

ROBOTS_PER_WORD = 32
"""Robots that share one int32 of flags: robot ``i`` owns bit ``i % 32`` of word ``i // 32``."""

VIEWER_NOW = 1 << 16
"""What a robot that sees a point now adds to its viewers during a scan; one that has ever seen it adds 1."""

REGIONS = 8
"""Regions along one side of the map's extent (L in the paper)."""

PIXELS = 125
"""Pixels along one side of the picture of a map."""

PIXEL_SHARED = 1 << 14
"""Flag beside a pixel's index, above all of them: it shows several free points."""

PICTURE_CHANNELS = 4
"""Of a robot's picture: what it has seen, walls, bodies, its way."""
CHANNEL_EXPLORED = 0
CHANNEL_OBSTACLE = 1
CHANNEL_POSITION = 2
CHANNEL_TRAJECTORY = 3

TEAM_CHANNELS = 3
"""Of the team's picture: the first two of a robot's, and how many robots have explored it."""
CHANNEL_VIEWERS = 2

START_CLEARANCE = 3.0
"""Starts keep this many collision thresholds from the boundary and from other robots."""

BESIDE = 1.5
"""Robots that start together stand at most so many clearances from another one."""

PI = 3.14159265358979

FAR = 1.0e30
"""Longer than any distance [m]."""

NOTHING = -3.0e38
"""Below every value and preference."""

LANES = 8
"""Items that a CPU's vector unit takes at once where a kernel says so; on a GPU a thread takes them in turn."""
Lanes = wp.types.vector(length=LANES, dtype=wp.float32)

ERROR_ACTION = 1
"""Bit of the error word: an action was NaN or infinite."""
ERROR_START = 2
"""Bit of the error word: no free start was found for a robot."""
ERROR_CAPACITY = 4
"""Bit of the error word: a scratch buffer overflowed."""
ERROR_REGION = 8
"""Bit of the error word: an action named a region that is none."""
ERRORS = ERROR_ACTION | ERROR_START | ERROR_CAPACITY | ERROR_REGION
ROOM_UNIT = 256
"""The error word of a team without room for all holds so many times the robots that had room before it was crowded."""


@wp.struct
class Maps:
    """Maps of the batch. Lengths in metres; M maps."""

    # Free points: position, weight (spacing squared, in units of the map), distance to the next boundary point.
    free: wp.array(dtype=wp.vec3)
    free_weight: wp.array(dtype=wp.int32)
    free_clearance: wp.array(dtype=wp.float32)
    free_begin: wp.array(dtype=wp.int32)  # [M + 1]
    free_cell: wp.array(dtype=wp.int32)
    total_weight: wp.array(dtype=wp.int32)  # [M]

    # Boundary points (obstacles that touch free space), and for every free point those within 1.5 of their spacings.
    boundary: wp.array(dtype=wp.vec3)
    boundary_begin: wp.array(dtype=wp.int32)  # [M + 1]
    boundary_cell: wp.array(dtype=wp.int32)
    neighbour_begin: wp.array(dtype=wp.int32)  # [all free points + 1]
    neighbour: wp.array(dtype=wp.int32)

    # Points that mask the radar: the boundary, or all obstacles where the radius leaves gaps.
    occluder: wp.array(dtype=wp.vec3)
    occluder_radius: wp.array(dtype=wp.float32)
    occluder_radius_max: wp.array(dtype=wp.float32)  # [M]
    occluder_begin: wp.array(dtype=wp.int32)  # [M + 1]
    occluder_cell: wp.array(dtype=wp.int32)

    resolution: wp.array(dtype=wp.float32)  # [M], spacing at which outlines of robots are sampled
    outline_radius_max: wp.array(dtype=wp.float32)  # [M], upper bound of their obstacle radius

    # The grid of cells: lower corner, edge length, cells along x and y, first entry in the *_cell arrays.
    cell_origin: wp.array(dtype=wp.vec2)
    cell_size: wp.array(dtype=wp.float32)
    cells_x: wp.array(dtype=wp.int32)
    cells_y: wp.array(dtype=wp.int32)
    cell_begin: wp.array(dtype=wp.int32)

    # Extent, and the square frame of the picture: centre of pixel (0, 0) and pixel size.
    lower: wp.array(dtype=wp.vec2)
    upper: wp.array(dtype=wp.vec2)
    frame_origin: wp.array(dtype=wp.vec2)
    pixel_size: wp.array(dtype=wp.float32)
    # Pixels that show a point, and points that a pixel shows. Points are numbered free first, then boundary;
    # ``shown_begin`` is the first entry of a map's points in ``point_pixel_begin``. A pixel that a free point
    # shares with others is flagged in ``point_pixel`` (PIXEL_SHARED).
    shown_begin: wp.array(dtype=wp.int32)  # [M]
    point_pixel_begin: wp.array(dtype=wp.int32)
    point_pixel: wp.array(dtype=wp.int32)
    pixel_point_begin: wp.array(dtype=wp.int32)  # [M * 125 * 125 + 1]
    pixel_point: wp.array(dtype=wp.int32)


HALF = 0.501
"""Of length and width of a body: no part of it is farther from its centre."""


@wp.func
def point_xy(p: wp.vec3) -> wp.vec2:
    return wp.vec2(p[0], p[1])


@wp.func
def within(offset: wp.vec2, radius: float) -> bool:
    """False only for an offset longer than the radius: asked of every pair of robots before the exact root."""
    return wp.dot(offset, offset) <= 1.0001 * radius * radius


@wp.func
def cell_center(maps: Maps, m: int, row: int, col: int) -> wp.vec2:
    return maps.cell_origin[m] + maps.cell_size[m] * wp.vec2(float(col) + 0.5, float(row) + 0.5)


@wp.func
def floor_within(value: float, size: float, low: int, high: int) -> int:
    """``value / size`` rounded down, in [low, high]: clamped as a float, for a huge range overflows an int."""
    return int(wp.clamp(wp.floor(value / size), float(low), float(high)))


@wp.func
def row_span(maps: Maps, m: int, row: int, center: wp.vec2, radius: float) -> wp.vec2i:
    """First and last column of cells in ``row`` that a disc can touch (first > last: none)."""
    size = maps.cell_size[m]
    origin = maps.cell_origin[m]
    low = origin[1] + float(row) * size
    gap = wp.max(wp.max(low - center[1], center[1] - low - size), 0.0)
    half = wp.sqrt(wp.max(radius * radius - gap * gap, 0.0)) + 1.0e-3 * size
    count = maps.cells_x[m]
    first = floor_within(center[0] - half - origin[0], size, 0, count)
    last = floor_within(center[0] + half - origin[0], size, -1, count - 1)
    return wp.vec2i(first, last)


@wp.func
def row_range(maps: Maps, m: int, center: wp.vec2, radius: float) -> wp.vec2i:
    """First and last row of cells that a disc can touch (first > last: none)."""
    size = maps.cell_size[m]
    origin = maps.cell_origin[m]
    reach = radius + 1.0e-3 * size
    count = maps.cells_y[m]
    first = floor_within(center[1] - reach - origin[1], size, 0, count)
    last = floor_within(center[1] + reach - origin[1], size, -1, count - 1)
    return wp.vec2i(first, last)
