"""Search on the robots' grid in NumPy and SciPy: where robots fit, distances, paths, random trees, coarser grids."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from maexp.agents.deploy.planner.grid import KnownGrid
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
    UNKNOWN,
    UNREACHED,
)

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


def grow_trees(grid: KnownGrid, at: np.ndarray, rng: np.random.Generator, samples: int, branch: float) -> np.ndarray:
    """Free cells where the branches of the robots' trees left what is known, int64 [n].

    Args:
        at: where the robots are [m], float [N, 2].
        samples: points drawn for each tree.
        branch: longest step towards one of them [m].

    All trees grow at once, and x + iy stands for a place in cells: what this takes is mostly the number of calls.
    """
    robots = len(at)
    size = np.array([grid.width, grid.height])
    draw = np.minimum(rng.random((robots, samples, 2)) * size, size - 1e-6)
    branch = branch / grid.cell
    node = np.full((robots, samples + 1), np.inf, complex)
    node[:, 0] = (at / grid.cell) @ (1, 1j)
    flat, known, first_node = node.ravel(), grid.known.ravel(), np.arange(robots) * node.shape[1]
    numbers, row, count, ends = np.arange(int(2.0 * branch) + 3), np.arange(robots), [1] * robots, []
    for point in (draw @ (1, 1j)).T:
        away = node[:, : max(count)] - point[:, None]
        gap = away.real**2 + away.imag**2
        start = flat.take(gap.argmin(1) + first_node)
        length = np.sqrt(gap.min(1))
        way = (point - start) * np.minimum(1.0, branch / np.maximum(length, 1e-9))
        steps = np.minimum(2.0 * length, 2.0 * branch).astype(np.int64)
        shares = np.minimum(numbers / (steps[:, None] + 1), 1.0)  # where a branch is looked at; its end fills the row
        looked = start[:, None] + way[:, None] * shares
        cells = looked.imag.astype(np.int64) * grid.width + looked.real.astype(np.int64)
        state = known.take(cells)
        first = (state != FREE).argmax(1)
        for robot, (k, end) in enumerate(zip(first.tolist(), state[row, first].tolist(), strict=True)):
            if end == FREE:  # all along
                node[robot, count[robot]] = start[robot] + way[robot]
                count[robot] += 1
            elif end == UNKNOWN and k > 0:
                ends.append(cells[robot, k - 1])
    return np.array(ends, np.int64)


MANY_CELLS = 250_000  # a grid of more is planned on in coarser cells
CELLS_PER_RADIUS = 2.0  # of the smallest robot, at least
ROUNDING = 1e-6  # 0.3 m are six cells of 0.05 m, though the quotient of these numbers is a little less
CORNERS = np.ones((3, 3), bool)  # cells that touch at a corner are connected


def coarsen(grid: KnownGrid, radius: float, many: int | None = None) -> KnownGrid:
    """A grid of ``many`` cells (`MANY_CELLS`) in blocks of 3 x 3, 5 x 5, ... cells: as few as needed, as large as
    robots of ``radius`` [m] allow, so that no passage closes that they fit through. Others as they are.

    A block with an obstacle in any of its cells is one, otherwise it is what its middle cell is: so goals and ways lie
    where the fine grid is known to be free. Blocks are counted from the map frame's origin: the same ones as the grid
    grows.
    """
    largest, side, many = radius / (CELLS_PER_RADIUS * grid.cell) + ROUNDING, 1, many or MANY_CELLS
    while grid.known.size > many * side**2 and side + 2 <= largest:
        side += 2
    parts = None if side == 1 else _parts(grid, radius)
    while side > 1:
        coarse, middle = _join(grid, side, parts)
        if not _splits(coarse, middle, radius):
            return coarse
        side -= 2
    return grid


def _join(grid: KnownGrid, side: int, parts: np.ndarray) -> tuple[KnownGrid, np.ndarray]:
    """The grid in blocks of ``side`` x ``side`` cells, and ``parts`` in the middle of each."""
    c, s = math.cos(grid.yaw), math.sin(grid.yaw)
    along = np.array(grid.corner) @ np.array([[c, -s], [s, c]]) / grid.cell  # the corner on the grid's own axes
    low = np.rint(along).astype(np.int64) % side
    (left, below), (right, above) = low, -(low + (grid.width, grid.height)) % side

    def blocks(cells: np.ndarray) -> np.ndarray:
        padded = np.pad(cells, ((below, above), (left, right)), mode="edge")
        return padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side)

    solid = (blocks(grid.known == OBSTACLE)).any((1, 3))
    known, inside = (blocks(layer)[:, side // 2, :, side // 2] for layer in (grid.known, parts))
    x, y = grid.to_map(-low * grid.cell)
    known = np.where(solid, np.uint8(OBSTACLE), known)
    return KnownGrid(known, grid.cell * side, (float(x), float(y)), grid.yaw), inside


def _parts(grid: KnownGrid, radius: float) -> np.ndarray:
    """Numbers of the connected parts where a robot fits, int [H, W]; 0 elsewhere."""
    fits = (grid.known == FREE) & (gap_squares(grid.known) >= (radius / grid.cell + MARGIN_CELLS - ROUNDING) ** 2)
    return label(fits, CORNERS)[0]


def _splits(coarse: KnownGrid, parts: np.ndarray, radius: float) -> bool:
    """Whether what was one part falls apart, or the larger share of one is lost; slivers do not count."""
    now, least = _parts(coarse, radius), math.pi * (2.0 * radius / coarse.cell) ** 2
    before = np.bincount(parts.ravel())
    pairs, cells = np.unique(np.stack([parts, now])[:, (parts > 0) & (now > 0)], axis=1, return_counts=True)
    largest = np.zeros(len(before), np.int64)
    np.maximum.at(largest, pairs[0], cells)
    rest = np.bincount(pairs[0], weights=cells, minlength=len(before)) - largest
    return bool((rest[1:] > least).any() or ((before > least) & (largest == 0))[1:].any())
