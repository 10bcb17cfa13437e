"""Steps over navigation grids: from where a search starts, what is in sight, and the way back.

Functions that kernels call, with no loop over a whole grid: `geodesic`, which names the other searches, has that.
"""

import warp as wp

from maexp.kernels.constants import DIAGONAL, SNAP_CELLS, STRAIGHT, TIGHT, TIGHT_FACTOR, UNREACHED

PATH_CELLS = 64  # cells of a path that are kept, counted from the robot


@wp.func
def path_slot(j: int, total: int) -> int:
    """Where the j-th cell of a path, counted from the robot, is stored (the path is written from its end)."""
    return (total - 1 - j) % PATH_CELLS


@wp.func
def is_passable(passable: wp.array2d(dtype=wp.uint8), row: int, cell: int) -> bool:
    return passable[row, cell] != wp.uint8(0)


@wp.func
def nearest_passable(passable: wp.array2d(dtype=wp.uint8), row: int, cell: int, w: int, h: int) -> int:
    """The passable cell nearest to `cell`, at most `SNAP_CELLS` away along x and y; -1 where none is."""
    best = wp.int32(-1)
    best_gap = wp.int32(1 << 30)
    x = cell % w
    y = cell / w
    for v in range(wp.max(y - SNAP_CELLS, 0), wp.min(y + SNAP_CELLS, h - 1) + 1):
        for u in range(wp.max(x - SNAP_CELLS, 0), wp.min(x + SNAP_CELLS, w - 1) + 1):
            gap = (v - y) * (v - y) + (u - x) * (u - x)
            if gap < best_gap and is_passable(passable, row, v * w + u):
                best = v * w + u
                best_gap = gap
    return best


@wp.func
def nearer(
    x: int,
    y: int,
    dx: int,
    dy: int,
    found: wp.vec2i,
    passable: wp.array2d(dtype=wp.uint8),
    row: int,
    distance: wp.array2d(dtype=wp.int32),
    item: int,
    w: int,
    h: int,
) -> wp.vec2i:
    """`found` (a squared gap, a cell), or the cell at (x + dx, y + dy) if it is nearer and counts."""
    result = found
    u = x + dx
    v = y + dy
    gap = dx * dx + dy * dy
    if u >= 0 and u < w and v >= 0 and v < h:
        cell = v * w + u
        if gap < found[0] or (gap == found[0] and cell < found[1]):
            counts = wp.bool(False)
            if item >= 0:
                counts = distance[item, cell] < UNREACHED
            else:
                counts = is_passable(passable, row, cell)
            if counts:
                result = wp.vec2i(gap, cell)
    return result


@wp.func
def nearest_cell(
    cell: int,
    passable: wp.array2d(dtype=wp.uint8),
    row: int,
    distance: wp.array2d(dtype=wp.int32),
    item: int,
    w: int,
    h: int,
) -> int:
    """The reached cell of `item` (the passable cell of `row`, if `item` is -1) nearest to a cell; -1 where none is.

    Of several as near the one with the lowest number.
    """
    x = cell % w
    y = cell / w
    found = wp.vec2i(1 << 30, -1)
    k = wp.int32(0)
    while k < wp.max(w, h) and k * k <= found[0]:  # squares around the cell, from the inside out
        for j in range(-k, k + 1):
            found = nearer(x, y, j, -k, found, passable, row, distance, item, w, h)
            found = nearer(x, y, j, k, found, passable, row, distance, item, w, h)
            found = nearer(x, y, -k, j, found, passable, row, distance, item, w, h)
            found = nearer(x, y, k, j, found, passable, row, distance, item, w, h)
        k += 1
    return found[1]


@wp.func
def in_sight(passable: wp.array2d(dtype=wp.uint8), row: int, start: int, end: int, w: int) -> bool:
    """Whether every cell that the segment between two cell centres touches, `start` apart, is passable."""
    x = start % w
    y = start / w
    dx = end % w - x
    dy = end / w - y
    nx = wp.abs(dx)
    ny = wp.abs(dy)
    sx = wp.sign(dx)
    sy = wp.sign(dy)
    i = wp.int32(0)
    j = wp.int32(0)
    clear = wp.bool(True)
    while clear and (i < nx or j < ny):
        side = (1 + 2 * i) * ny - (1 + 2 * j) * nx  # which edge the segment crosses first; 0 = the corner
        if side == 0:
            clear = is_passable(passable, row, y * w + x + sx)
            clear = clear and is_passable(passable, row, (y + sy) * w + x)
        if side <= 0:
            x += sx
            i += 1
        if side >= 0:
            y += sy
            j += 1
        clear = clear and is_passable(passable, row, y * w + x)
    return clear


@wp.func
def step_back(
    passable: wp.array2d(dtype=wp.uint8),
    row: int,
    distance: wp.array2d(dtype=wp.int32),
    item: int,
    cell: int,
    w: int,
    h: int,
) -> int:
    """The neighbour before `cell` on a shortest path from the source, -1 at the source.

    Of several the first counts: east, north, west, south, then north-east, north-west, south-west, south-east.
    """
    x = cell % w
    y = cell / w
    d = distance[item, cell]
    factor = wp.where(passable[row, cell] == wp.uint8(TIGHT), TIGHT_FACTOR, 1)
    found = wp.int32(-1)
    for k in range(8):
        ux = wp.where(k == 0 or k == 4 or k == 7, 1, wp.where(k == 2 or k == 5 or k == 6, -1, 0))
        uy = wp.where(k == 1 or k == 4 or k == 5, 1, wp.where(k == 3 or k == 6 or k == 7, -1, 0))
        u = x + ux
        v = y + uy
        if found < 0 and u >= 0 and u < w and v >= 0 and v < h:
            weight = wp.where(k < 4, STRAIGHT, DIAGONAL) * factor
            if distance[item, v * w + u] == d - weight:
                # A diagonal step cuts no corner: both cells beside it are reached (they touch reached cells).
                if k < 4 or (distance[item, y * w + u] < UNREACHED and distance[item, v * w + x] < UNREACHED):
                    found = v * w + u
    return found
