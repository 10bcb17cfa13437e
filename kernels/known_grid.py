"""Navigation grids: what a team (or each robot) knows of its map, cell by cell, and where its robots fit.

Rows: `rows_per_env` consecutive rows belong to one env, one row where knowledge is shared, one per robot
where communication is limited. Cells are numbered ``iy * width + ix`` with the width of the env's map.
"""

import numpy as np
import warp as wp

from maexp.kernels.frontier import FREE, OBSTACLE, UNKNOWN
from maexp.kernels.geodesic import BLOCKED, TIGHT, wp_blocked
from maexp.kernels.launches import lanes_on
from maexp.kernels.planner import is_known
from maexp.kernels.types import Maps

wp_unknown = wp.constant(wp.uint8(UNKNOWN))
wp_free = wp.constant(wp.uint8(FREE))
wp_obstacle = wp.constant(wp.uint8(OBSTACLE))


@wp.struct
class NavGrids:
    """One grid per map of `Maps`, static; M maps."""

    origin: wp.array(dtype=wp.vec2)  # [M], lower corner of cell (0, 0) [m]
    cell: wp.array(dtype=wp.float32)  # [M], edge length [m]
    width: wp.array(dtype=wp.int32)  # [M], cells along x
    height: wp.array(dtype=wp.int32)  # [M], cells along y
    free_cell: wp.array(dtype=wp.int32)  # cell of every free point, in the order of Maps.free
    boundary_cell: wp.array(dtype=wp.int32)  # cell of every boundary point, in the order of Maps.boundary
    cell_begin: wp.array(dtype=wp.int32)  # [M + 1], where a map's cells start in `stand_in`
    stand_in: wp.array(
        dtype=wp.int32
    )  # cell whose state each takes, itself where it holds points; -1 = none


@wp.func
def nav_cell(grids: NavGrids, m: int, at: wp.vec2) -> int:
    """Cell of a point, clamped to the grid."""
    p = (at - grids.origin[m]) / grids.cell[m]
    x = wp.clamp(int(wp.floor(p[0])), 0, grids.width[m] - 1)
    y = wp.clamp(int(wp.floor(p[1])), 0, grids.height[m] - 1)
    return y * grids.width[m] + x


@wp.func
def nav_center(grids: NavGrids, m: int, cell: int) -> wp.vec2:
    """Centre of a cell [m]."""
    w = grids.width[m]
    return grids.origin[m] + grids.cell[m] * wp.vec2(float(cell % w) + 0.5, float(cell / w) + 0.5)


@wp.kernel(enable_backward=False)
def _assign_grids(
    # State in:
    map_id: wp.array(dtype=wp.int32),  # [env]
    rows_per_env: int,
    # Out:
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
):
    row = wp.tid()
    grid_of_row[row] = map_id[row / rows_per_env]


@wp.kernel(enable_backward=False)
def _clear_known(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    lanes: int,
    # Out:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
):
    row, lane = wp.tid()
    m = grid_of_row[row]
    for cell in range(lane, grids.width[m] * grids.height[m], lanes):
        known[row, cell] = wp_unknown


@wp.kernel(enable_backward=False)
def _paint_points(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    point_begin: wp.array(dtype=wp.int32),  # [map + 1]
    point_cell: wp.array(dtype=wp.int32),  # [points of all maps]
    # State in:
    flags: wp.array3d(dtype=wp.int32),  # [env, word, point]
    rows_per_env: int,
    value: wp.uint8,
    lanes: int,
    # Out:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
):
    """Gives `value` to the cells of known points; with one row an env, what any robot knows counts."""
    row, lane = wp.tid()
    e = row / rows_per_env
    m = map_id[e]
    first = point_begin[m]
    limited = wp.where(rows_per_env > 1, 1, 0)
    for point in range(lane, point_begin[m + 1] - first, lanes):
        if is_known(flags, e, row % rows_per_env, point, limited):
            known[row, point_cell[first + point]] = value


@wp.kernel(enable_backward=False)
def _fill_voids(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    lanes: int,
    # State in and out:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
):
    """Cells without a point of their own (a cloud is no lattice) take the state of their stand-in."""
    row, lane = wp.tid()
    m = grid_of_row[row]
    first = grids.cell_begin[m]
    for cell in range(lane, grids.width[m] * grids.height[m], lanes):
        other = grids.stand_in[first + cell]
        if other >= 0 and other != cell:
            known[row, cell] = known[row, other]


@wp.kernel(enable_backward=False)
def _open_cells(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # State in:
    known: wp.array2d(dtype=wp.uint8),  # [known row, cell]
    known_of_row: wp.array(dtype=wp.int32),  # [mask row]
    through_unknown: int,
    lanes: int,
    # Out:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
):
    row, lane = wp.tid()
    m = grid_of_row[row]
    source = known_of_row[row]
    for cell in range(lane, grids.width[m] * grids.height[m], lanes):
        state = known[source, cell]
        open = state == wp_free or (state == wp_unknown and through_unknown != 0)
        passable[row, cell] = wp.where(open, wp.uint8(1), wp.uint8(0))


@wp.kernel(enable_backward=False)
def _close_cells(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # State in:
    known: wp.array2d(dtype=wp.uint8),  # [known row, cell]
    known_of_row: wp.array(dtype=wp.int32),  # [mask row]
    radius: wp.array(dtype=wp.float32),  # [mask row], distance from known obstacle cells [m]
    margin: float,  # the same, on top, in cells
    value: wp.uint8,
    lanes: int,
    # Out:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
):
    """Gives `value` to what is not blocked and lies nearer than the radius to known obstacles.

    Threads that write the same cell write the same.
    """
    row, lane = wp.tid()
    m = grid_of_row[row]
    w = grids.width[m]
    h = grids.height[m]
    source = known_of_row[row]
    r = radius[row] / grids.cell[m] + margin
    reach = int(wp.ceil(r))
    for cell in range(lane, w * h, lanes):
        if known[source, cell] == wp_obstacle:
            x = cell % w
            y = cell / w
            for v in range(wp.max(y - reach, 0), wp.min(y + reach, h - 1) + 1):
                for u in range(wp.max(x - reach, 0), wp.min(x + reach, w - 1) + 1):
                    if float((v - y) * (v - y) + (u - x) * (u - x)) < r * r:
                        if passable[row, v * w + u] != wp_blocked:
                            passable[row, v * w + u] = value


class KnownGrids:
    """Grids of a run of envs, painted from the flags of seen points.

    Args:
        maps, grids: static data of the maps.
        map_id: int32 [E], the map of each env.
        free_flags, boundary_flags: int32 [E, W, points], bit i % 32 of word i // 32 for robot i.
        rows_per_env: 1 (the team's knowledge) or the number of robots (each robot's own).
        cells: cells of the largest grid.

    Attributes:
        known: uint8 [E * rows_per_env, cells]: `UNKNOWN`, `FREE` or `OBSTACLE`.
        grid_of_row: int32 [E * rows_per_env], the map of each row; set by `paint`.
    """

    def __init__(
        self,
        maps: Maps,
        grids: NavGrids,
        map_id: wp.array,
        free_flags: wp.array,
        boundary_flags: wp.array,
        rows_per_env: int,
        cells: int,
    ):
        self.maps, self.grids, self.map_id = maps, grids, map_id
        self.free_flags, self.boundary_flags = free_flags, boundary_flags
        self.rows_per_env = rows_per_env
        self.lanes = lanes_on(map_id.device, 256)
        rows = map_id.shape[0] * rows_per_env
        self.known = wp.zeros((rows, cells), dtype=wp.uint8, device=map_id.device)
        self.grid_of_row = wp.zeros(rows, dtype=wp.int32, device=map_id.device)

    def paint(self, launch) -> None:
        """Brings `known` up to date; ``launch(kernel, dim, inputs, outputs)`` launches or records."""
        rows = self.known.shape[0]
        launch(_assign_grids, rows, [self.map_id, self.rows_per_env], [self.grid_of_row])
        dim = (rows, self.lanes)
        launch(_clear_known, dim, [self.grids, self.grid_of_row, self.lanes], [self.known])
        layers = [
            (self.maps.free_begin, self.grids.free_cell, self.free_flags, FREE),
            (self.maps.boundary_begin, self.grids.boundary_cell, self.boundary_flags, OBSTACLE),
        ]
        for begin, cell, flags, value in layers:
            launch(
                _paint_points, dim,
                [self.map_id, begin, cell, flags, self.rows_per_env, wp.uint8(value), self.lanes], [self.known],
            )  # fmt: skip
        launch(_fill_voids, dim, [self.grids, self.grid_of_row, self.lanes], [self.known])


class PassableGrids:
    """Where robots fit on `KnownGrids`: one mask per env and distinct distance to keep.

    Args:
        known: the grids to read.
        radius: float32 [E, K], distance to keep from known obstacles [m]; K masks per env. Where every robot
            has a known row of its own, K must be the number of robots.
        comfort: float32 [E, K], distance below which a cell is tight [m]; None: no cell is.
        margin: the same on top of both, in cells, for what the grid rounds away.
        through_unknown: whether unknown cells count as passable.

    Attributes:
        passable: uint8 [E * K, cells]: `BLOCKED`, `OPEN` or `TIGHT`.
        grid_of_row: int32 [E * K], the map of each row; set by `paint`.
    """

    def __init__(
        self,
        known: KnownGrids,
        radius: np.ndarray,
        comfort: np.ndarray | None,
        margin: float,
        through_unknown: bool,
    ):
        envs, masks = radius.shape
        if known.rows_per_env not in (1, masks):
            raise ValueError(f"{known.rows_per_env} known rows per env need as many masks, got {masks}")
        device = known.known.device
        self.known, self.masks = known, masks
        self.margin, self.through_unknown = float(margin), int(through_unknown)
        rings = [(comfort, TIGHT), (radius, BLOCKED)] if comfort is not None else [(radius, BLOCKED)]
        self.rings = [(wp.array(r.reshape(-1), dtype=wp.float32, device=device), value) for r, value in rings]
        rows = range(envs * masks)
        source = [row if known.rows_per_env == masks else row // masks for row in rows]
        self.known_of_row = wp.array(source, dtype=wp.int32, device=device)
        self.grid_of_row = wp.zeros(len(rows), dtype=wp.int32, device=device)
        self.passable = wp.zeros((len(rows), known.known.shape[1]), dtype=wp.uint8, device=device)

    def paint(self, launch) -> None:
        """Brings `passable` up to date with `known`."""
        launch(_assign_grids, self.grid_of_row.shape, [self.known.map_id, self.masks], [self.grid_of_row])
        grids, lanes = self.known.grids, self.known.lanes
        dim = (self.passable.shape[0], lanes)
        inputs = [grids, self.grid_of_row, self.known.known, self.known_of_row]
        launch(_open_cells, dim, [*inputs, self.through_unknown, lanes], [self.passable])
        for radius, value in self.rings:
            launch(
                _close_cells, dim, [*inputs, radius, self.margin, wp.uint8(value), lanes], [self.passable]
            )
