"""Distances to drive on a grid, and frontiers: Dijkstra with a heap, and a look at every neighbour."""

import heapq

import numpy as np

STRAIGHT, DIAGONAL = 10, 14  # integer chamfer weights
UNREACHED = 1 << 30  # where no source leads


def neighbours(passable, row: int, column: int):
    """`(row, column, weight)` of the passable ones of 8, without cutting the corner of a blocked cell."""
    height, width = passable.shape

    def ok(r, c):
        return 0 <= r < height and 0 <= c < width and bool(passable[r, c])

    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            if (dr or dc) and ok(row + dr, column + dc):
                if dr == 0 or dc == 0:
                    yield row + dr, column + dc, STRAIGHT
                elif ok(row + dr, column) and ok(row, column + dc):
                    yield row + dr, column + dc, DIAGONAL


def geodesic_distance(passable, sources) -> np.ndarray:
    """int64 (H, W): weight of the shortest path from the nearest source; UNREACHED where none leads.

    sources: cell numbers row * W + column; -1 and blocked cells count for nothing.
    """
    passable = np.asarray(passable, bool)
    best = np.full(passable.shape, UNREACHED, np.int64)
    places = [divmod(int(s), passable.shape[1]) for s in sources if s >= 0]
    queue = [(0, r, c) for r, c in places if passable[r, c]]
    heapq.heapify(queue)
    while queue:
        cost, r, c = heapq.heappop(queue)
        if best[r, c] < UNREACHED:
            continue
        best[r, c] = cost
        for nr, nc, weight in neighbours(passable, r, c):
            if best[nr, nc] == UNREACHED:
                heapq.heappush(queue, (cost + weight, nr, nc))
    return best


def frontier_cells(free, obstacle) -> np.ndarray:
    """Bool (H, W): known free cells with a cell neither free nor obstacle straight beside them (4).

    A cell flagged both free and obstacle is an obstacle; what lies outside the grid is not unknown.
    """
    free, obstacle = np.asarray(free, bool), np.asarray(obstacle, bool)
    found = np.zeros(free.shape, bool)
    for r in range(free.shape[0]):
        for c in range(free.shape[1]):
            if not free[r, c] or obstacle[r, c]:
                continue
            for nr, nc in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
                if 0 <= nr < free.shape[0] and 0 <= nc < free.shape[1]:
                    found[r, c] |= not free[nr, nc] and not obstacle[nr, nc]
    return found
