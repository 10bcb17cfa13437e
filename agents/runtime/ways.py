"""Where robots fit and how far it is to drive: `maexp.kernels.geodesic`, `known_grid` and `ways` in NumPy and SciPy.

A step to a straight neighbour weighs 10, to a diagonal one 14, into a tight cell (too near to obstacles for comfort)
`TIGHT_FACTOR` times as much; a diagonal step needs both straight cells beside it passable. Distances are integers.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from maexp.kernels.constants import (
    BLOCKED,
    COMFORT,
    DIAGONAL,
    FREE,
    MARGIN_CELLS,
    OBSTACLE,
    OPEN,
    SNAP_CELLS,
    STRAIGHT,
    TIGHT,
    TIGHT_FACTOR,
    UNREACHED,
)

from .grid import KnownGrid

# East, north, west, south, then north-east, north-west, south-west, south-east: the first that fits counts.
STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)])
WEIGHTS = np.array([STRAIGHT] * 4 + [DIAGONAL] * 4)
BESIDE = ([0, 2, 2, 0], [1, 1, 3, 3])  # the straight steps beside each diagonal one


def gap_squares(known: np.ndarray) -> np.ndarray:
    """Squared distance of every cell to the nearest obstacle cell, in cells, float64 [H, W]; infinite without any."""
    walls = known == OBSTACLE
    if not walls.any():
        return np.full(known.shape, np.inf)
    return np.rint(distance_transform_edt(~walls) ** 2)


def mark_passable(grid: KnownGrid, gaps: np.ndarray, radius: float, clearance: float) -> np.ndarray:
    """`BLOCKED`, `OPEN` or `TIGHT` for a robot, uint8 [H, W]; unknown cells are blocked.

    Args:
        gaps: of `gap_squares`.
        radius, clearance: distances to keep, and to keep where there is room [m].
    """
    margin = np.float32(MARGIN_CELLS)
    near, far = (np.float32(r) / np.float32(grid.cell) + margin for r in (radius, COMFORT * clearance))
    passable = np.where(gaps < far * far, np.uint8(TIGHT), np.uint8(OPEN))
    passable[(grid.known != FREE) | (gaps < near * near)] = BLOCKED
    return passable


def snap(passable: np.ndarray, cell: int, reach: int = SNAP_CELLS) -> int:
    """The passable cell nearest to `cell`, at most `reach` away along x and y; -1 where none is."""
    height, width = passable.shape
    y, x = divmod(int(cell), width)
    y0, x0 = max(y - reach, 0), max(x - reach, 0)
    v, u = np.nonzero(passable[y0 : y + reach + 1, x0 : x + reach + 1])
    if not len(v):
        return -1
    best = np.argmin((v + y0 - y) ** 2 + (u + x0 - x) ** 2)
    return int((v[best] + y0) * width + u[best] + x0)


def flood(passable: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Distances from every source, int32 [N, H, W]; `UNREACHED` elsewhere.

    Args:
        passable: of `mark_passable`.
        sources: passable cells, int [N]; -1 reaches nothing.
    """
    distance = np.full((len(sources), passable.size), UNREACHED, np.int32)
    used = np.flatnonzero(passable)
    valid = np.flatnonzero(np.asarray(sources) >= 0)
    if len(used) and len(valid):
        found = dijkstra(_graph(passable), indices=np.searchsorted(used, np.asarray(sources)[valid]))
        for robot, lengths in zip(valid, found, strict=True):
            distance[robot, used] = np.minimum(lengths, UNREACHED)
    return distance.reshape(-1, *passable.shape)


def _graph(passable: np.ndarray) -> csr_array:
    """Steps between passable cells, which are numbered row by row: row and column = from and to, value = weight.

    Every cell has eight entries; where no step leads, one to itself, which no way takes. It is faster than to leave
    them out.
    """
    wide = np.pad(passable, 1)
    kind, width = wide.ravel(), wide.shape[1]
    at = np.flatnonzero(kind)
    own = np.arange(len(at), dtype=np.int32)
    number = np.zeros(kind.size, np.int32)
    number[at] = own
    ends, weights, beside = np.empty((len(at), 8), np.int32), np.empty((len(at), 8)), []
    for k, (u, v) in enumerate(STEPS):
        end = at + (v * width + u)
        to = kind[end]
        if k < 4:
            beside.append(to != BLOCKED)
        else:
            to *= beside[BESIDE[0][k - 4]] & beside[BESIDE[1][k - 4]]
        ends[:, k] = np.where(to != BLOCKED, number[end], own)
        weights[:, k] = np.array([UNREACHED, WEIGHTS[k], TIGHT_FACTOR * WEIGHTS[k]], np.float64)[to]
    first = np.arange(0, ends.size + 1, 8, dtype=np.int32)
    return csr_array((weights.ravel(), ends.ravel(), first), shape=(len(at),) * 2)


def cells_ahead(passable: list[np.ndarray], distance: np.ndarray, cells: np.ndarray, ahead: float) -> np.ndarray:
    """The cell that lies `ahead` [cells] from each robot on its way to each of its cells, int64 [n, k]; -1 = no way.

    Args:
        passable: of `mark_passable`, one a robot.
        distance: of `flood`, int32 [n, H, W].
        cells: int64 [n, k].
    """
    ways = _WayBack(passable, distance)
    near, result = int(STRAIGHT * ahead), np.full(cells.shape, -1)
    for robot, row in enumerate(cells):
        found: dict[int, int] = {}  # of the cells that ways have led over: they go on alike from there
        for k in np.flatnonzero(distance[robot].ravel()[row] < UNREACHED):
            way = []
            for at in ways.follow(ways.enter(int(row[k]), robot)):
                if at in found or ways.distance[at] <= near:
                    break
                way.append(at)
            result[robot, k] = end = found.get(at, at)
            found.update(dict.fromkeys(way, end))
    return np.where(result >= 0, ways.leave(result), -1)


def trace(passable: np.ndarray, distance: np.ndarray, end: int) -> np.ndarray:
    """The cells of a shortest way from the source to a reached cell, corners and both ends only, int64 [k]."""
    ways = _WayBack([passable], distance[None])
    way = ways.leave(np.array(list(ways.follow(ways.enter(int(end), 0)))))[::-1]
    turn = np.diff(way)
    return way[np.concatenate([[True], turn[1:] != turn[:-1], [True]])] if len(way) > 1 else way


def trace_from(start: np.ndarray, grid: KnownGrid, passable: np.ndarray, distance: np.ndarray, end: int) -> np.ndarray:
    """Corners of a way from where a robot stands to a reached cell, float64 [k, 2] [m], in the map's frame.

    The middle of the robot's own cell is left out: on cells longer than what it drives between two calls it would turn
    back there every time. The line to the next corner leads over cells of the way and those beside its diagonals alone.
    """
    cells = trace(passable, distance, end)
    if len(cells) > 1 and cells[0] == grid.cells(grid.from_map(start)):
        cells = cells[1:]
    return np.concatenate([start[None], grid.to_map(grid.centers(cells))])


class _WayBack:
    """Steps from reached cells towards the source of each robot, on cells numbered with a rim of one around its grid,
    robot after robot.
    """

    def __init__(self, passable: list[np.ndarray], distance: np.ndarray):
        self.height, self.width = distance.shape[1:]
        self.area = (self.height + 2) * (self.width + 2)
        rim = ((0, 0), (1, 1), (1, 1))
        # Views of memory: single cells are read faster from them than from arrays.
        self.distance = memoryview(np.pad(distance, rim, constant_values=UNREACHED).ravel())
        self.tight = memoryview(np.pad([row == TIGHT for row in passable], rim).ravel())
        self.steps = (STEPS[:, 1] * (self.width + 2) + STEPS[:, 0]).tolist()

    def enter(self, cell: int, robot: int) -> int:
        """A cell of the grid of a robot in the numbers of the rimmed ones."""
        return (cell // self.width + 1) * (self.width + 2) + cell % self.width + 1 + robot * self.area

    def leave(self, at: np.ndarray) -> np.ndarray:
        """The way back of `enter`, without the robot."""
        at = at % self.area
        return (at // (self.width + 2) - 1) * self.width + at % (self.width + 2) - 1

    def follow(self, at: int) -> Iterator[int]:
        """All cells from one to the source: each time the first step of `STEPS` that fits."""
        distance, tight = self.distance, self.tight
        straight = self.steps[:4]
        diagonal = [(step, straight[a], straight[b]) for step, a, b in zip(self.steps[4:], *BESIDE, strict=True)]
        yield at
        while (here := distance[at]) > 0:
            factor = TIGHT_FACTOR if tight[at] else 1
            before = here - STRAIGHT * factor
            for step in straight:
                if distance[at + step] == before:
                    break
            else:
                before = here - DIAGONAL * factor
                for step, a, b in diagonal:
                    if distance[at + step] == before and distance[at + a] < UNREACHED and distance[at + b] < UNREACHED:
                        break
            at += step
            yield at
