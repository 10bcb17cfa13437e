"""Ways over navigation grids: where a robot fits, what it sees straight ahead, and the next waypoint.

Grids are arrays (H, W), rows along y; cells are numbered row * W + column.
"""

import math

import numpy as np

from oracle.grid import UNREACHED, geodesic_distance

FREE, OBSTACLE = 1, 2
# Order in which a path looks for the cell before: straight steps from east on, then diagonals from north-east on.
BACK = [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)]


def passable_cells(known, radius: float, through_unknown: bool) -> np.ndarray:
    """Bool (H, W): free (or unknown) cells whose centre is `radius` [cells] or more from obstacle centres."""
    known = np.asarray(known)
    found = np.zeros(known.shape, bool)
    walls = [(r, c) for r, c in np.ndindex(known.shape) if known[r, c] == OBSTACLE]
    for r, c in np.ndindex(known.shape):
        if known[r, c] == FREE or (through_unknown and known[r, c] == 0):
            found[r, c] = all(math.hypot(r - y, c - x) >= radius for y, x in walls)
    return found


def touches(r: int, c: int, start, end) -> bool:
    """Whether the closed square of cell (r, c) meets the segment between the centres of two cells."""
    (y0, x0), (y1, x1) = start, end
    if max(y0, y1) < r - 0.5 or min(y0, y1) > r + 0.5 or max(x0, x1) < c - 0.5 or min(x0, x1) > c + 0.5:
        return False
    sides = [(x1 - x0) * (r + dy - y0) - (y1 - y0) * (c + dx - x0) for dy in (-0.5, 0.5) for dx in (-0.5, 0.5)]
    return min(sides) <= 0 <= max(sides)


def in_sight(passable, start, end) -> bool:
    """Whether every cell that the segment touches, the first apart, is passable."""
    height, width = np.shape(passable)
    return all(
        passable[r][c]
        for r in range(height)
        for c in range(width)
        if (r, c) != tuple(start) and touches(r, c, start, end)
    )


def path(passable, start: int, end: int) -> list[int]:
    """Cells from `start` to `end` on a shortest way, found backwards; ties as in `BACK`."""
    width = np.shape(passable)[1]
    distance = geodesic_distance(passable, [start])
    r, c = divmod(end, width)
    cells = [end]
    while distance[r, c] > 0:
        for dy, dx in BACK:
            y, x = r + dy, c + dx
            inside = 0 <= y < distance.shape[0] and 0 <= x < width
            weight = 14 if dy and dx else 10
            if not inside or distance[y, x] != distance[r, c] - weight:
                continue
            if dy and dx and not (passable[y][c] and passable[r][x]):
                continue
            r, c = y, x
            cells.append(r * width + c)
            break
    return cells[::-1]


def nearest_cell(mask, cell: int, reach: float = math.inf) -> int:
    """The true cell of `mask` nearest to `cell` (first of several), at most `reach` away along each axis; or -1."""
    width = np.shape(mask)[1]
    y, x = divmod(cell, width)
    best, best_gap = -1, math.inf
    for r, c in np.ndindex(np.shape(mask)):
        gap = (r - y) ** 2 + (c - x) ** 2
        if mask[r, c] and max(abs(r - y), abs(c - x)) <= reach and gap < best_gap:
            best, best_gap = r * width + c, gap
    return best


def waypoint(passable, robot, goal, reach: float, snap: int):
    """Waypoint (x, y) in cells from the lower corner of cell 0 for a robot at `robot` that wants to `goal`.

    The farthest cell centre of the path no farther than `reach` and in sight; `goal` itself when its cell is
    chosen and reachable; the path's nearest cell when none is in sight; `goal` when there is no path.
    """
    passable = np.asarray(passable, bool)
    width = passable.shape[1]
    here, end = (int(math.floor(p[1])) * width + int(math.floor(p[0])) for p in (robot, goal))
    start = nearest_cell(passable, here, snap)
    if start < 0:
        return tuple(goal)
    reached = geodesic_distance(passable, [start]) < UNREACHED
    at_goal = bool(reached.flat[end])
    end = nearest_cell(reached, end)
    cells = path(passable, start, end)

    def gap(cell):
        return math.hypot(cell % width + 0.5 - robot[0], cell // width + 0.5 - robot[1])

    chosen = None
    for cell in reversed(cells):
        if gap(cell) <= reach and in_sight(passable, divmod(here, width), divmod(cell, width)):
            chosen = cell
            break
    if chosen is None:
        chosen = min(reversed(cells), key=gap)
    if chosen == cells[-1] and at_goal:
        return tuple(goal)
    return (chosen % width + 0.5, chosen // width + 0.5)
