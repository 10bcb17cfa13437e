"""Where robots fit and how far it is to drive: `maexp.kernels.geodesic`, `known_grid` and `ways` in NumPy and SciPy.

A step to a straight neighbour weighs 10, to a diagonal one 14, into a tight cell (too near to obstacles for comfort)
`TIGHT_FACTOR` times as much; a diagonal step needs both straight cells beside it passable. Distances are integers.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from .grid import FREE, OBSTACLE, KnownGrid

STRAIGHT, DIAGONAL = 10, 14
TIGHT_FACTOR = 4
BLOCKED, OPEN, TIGHT = 0, 1, 2
UNREACHED = 1 << 30
SNAP_CELLS = 4  # how far from a robot on a blocked cell its way may start, in cells along x and y
MARGIN_CELLS = 0.5  # distance kept from obstacles beyond a robot's radius, in cells
COMFORT = 2.0  # cells nearer to obstacles than this many clearances are tight
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
        index = np.zeros(passable.size, np.int32)
        index[used] = np.arange(len(used), dtype=np.int32)
        found = dijkstra(_graph(passable, used, index), indices=index[np.asarray(sources)[valid]])
        for robot, lengths in zip(valid, found, strict=True):
            distance[robot, used] = np.minimum(lengths, UNREACHED)
    return distance.reshape(-1, *passable.shape)


def _graph(passable: np.ndarray, used: np.ndarray, index: np.ndarray) -> csr_array:
    """Steps between passable cells: row and column = number among `used`, value = weight."""
    open_to = _neighbours(passable).reshape(-1, len(STEPS))[used]
    start, step = np.nonzero(open_to)
    end = used[start] + (STEPS[:, 1] * passable.shape[1] + STEPS[:, 0])[step]
    weight = np.stack([WEIGHTS, TIGHT_FACTOR * WEIGHTS]).astype(np.float64)
    first = np.zeros(len(used) + 1, np.int32)
    np.cumsum(np.bincount(start, minlength=len(used)), out=first[1:])
    tight = passable.ravel()[end] == TIGHT
    return csr_array((weight[tight.view(np.int8), step], index[end], first), shape=(len(used),) * 2)


def _neighbours(passable: np.ndarray) -> np.ndarray:
    """Whether a step of `STEPS` leads from every cell to a passable one, bool [H, W, 8]."""
    height, width = passable.shape
    wide = np.pad(passable != BLOCKED, 1)
    result = np.empty((height, width, len(STEPS)), bool)
    for k, (u, v) in enumerate(STEPS):
        result[..., k] = wide[1 + v : 1 + v + height, 1 + u : 1 + u + width]
    result[..., 4:] &= result[..., BESIDE[0]] & result[..., BESIDE[1]]
    return result


def cells_ahead(passable: list[np.ndarray], distance: np.ndarray, cells: np.ndarray, ahead: float) -> np.ndarray:
    """The cell that lies `ahead` [cells] from each robot on its way to each of its cells, int64 [n, k]; -1 = no way.

    Args:
        passable: of `mark_passable`, one a robot.
        distance: of `flood`, int32 [n, H, W].
        cells: int64 [n, k].
    """
    ways = _WayBack(passable, distance)
    robot = np.repeat(np.arange(len(cells)), cells.shape[1])
    result = np.where(distance.reshape(len(distance), -1)[robot, cells.ravel()] < UNREACHED, cells.ravel(), -1)
    going = np.flatnonzero(result >= 0)
    at = ways.enter(result[going], robot[going])
    while len(going):  # all robots at once: there are many short steps
        far = ways.distance[at] > int(STRAIGHT * ahead)
        result[going[~far]] = ways.leave(at[~far])
        going, at = going[far], ways.step(at[far])
    return result.reshape(cells.shape)


def trace(passable: np.ndarray, distance: np.ndarray, end: int) -> np.ndarray:
    """The cells of a shortest way from the source to a reached cell, corners and both ends only, int64 [k]."""
    ways = _WayBack([passable], distance[None])
    way = ways.leave(ways.follow(int(ways.enter(np.array([end]), 0)[0])))[::-1]
    turn = np.diff(way)
    return way[np.concatenate([[True], turn[1:] != turn[:-1], [True]])] if len(way) > 1 else way


class _WayBack:
    """Steps from reached cells towards the source of each robot, on cells numbered with a rim of one around its grid,
    robot after robot.
    """

    def __init__(self, passable: list[np.ndarray], distance: np.ndarray):
        self.height, self.width = distance.shape[1:]
        self.area = (self.height + 2) * (self.width + 2)
        rim = ((0, 0), (1, 1), (1, 1))
        self.distance = np.pad(distance, rim, constant_values=UNREACHED).ravel()
        self.tight = np.pad([one == TIGHT for one in passable], rim).ravel()
        self.steps = STEPS[:, 1] * (self.width + 2) + STEPS[:, 0]

    def enter(self, cells: np.ndarray, robot: np.ndarray | int) -> np.ndarray:
        """Cells of the grids of robots in the numbers of the rimmed ones."""
        return (cells // self.width + 1) * (self.width + 2) + cells % self.width + 1 + robot * self.area

    def leave(self, at: np.ndarray) -> np.ndarray:
        """The way back of `enter`, without the robot."""
        at = at % self.area
        return (at // (self.width + 2) - 1) * self.width + at % (self.width + 2) - 1

    def step(self, at: np.ndarray) -> np.ndarray:
        """The cell before each, int64 [n]: none of them a source."""
        near = self.distance[at[:, None] + self.steps]
        factor = np.where(self.tight[at], TIGHT_FACTOR, 1)
        fits = near == self.distance[at][:, None] - WEIGHTS * factor[:, None]
        reached = near < UNREACHED
        fits[:, 4:] &= reached[:, BESIDE[0]] & reached[:, BESIDE[1]]
        return at + self.steps[fits.argmax(1)]

    def follow(self, at: int) -> np.ndarray:
        """All cells from one to the source, int64 [k]: as `step` goes, faster for a single way."""
        distance, tight, way = memoryview(self.distance), memoryview(self.tight), [at]
        steps, weights = self.steps.tolist(), WEIGHTS.tolist()
        sides = list(zip(*BESIDE, strict=True))
        while (here := distance[at]) > 0:
            factor = TIGHT_FACTOR if tight[at] else 1
            for k, step in enumerate(steps):
                if distance[at + step] == here - factor * weights[k] and (
                    k < 4 or all(distance[at + steps[side]] < UNREACHED for side in sides[k - 4])
                ):
                    at += step
                    break
            way.append(at)
        return np.array(way)
