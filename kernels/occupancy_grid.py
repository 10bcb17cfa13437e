"""Navigation grids: what a team (or each robot) knows of its map, cell by cell.

Rows: `rows_per_env` consecutive rows belong to one env, one row where knowledge is shared, one per robot
where communication is limited. Cells are numbered ``iy * width + ix`` with the width of the env's map.

Painting enters what has become known since the last time, and lists the cells that changed.
Knowledge only grows within an episode, but for false walls. A row where less is known than was painted (a new episode,
a state that was loaded, a false wall that is none), or whose env has another map, is cleared and painted anew: nobody
has to say so.

Each who looks has grids of its own, the local planner as well as a policy's `Navigation`: the list is of what has
changed since it looked, and a policy that shared it would take from the planner what that has not seen. They look at
different moments, and where both look at one, looking for what is new is most of the work
(docs/reports/conditions.md).
"""

import warp as wp

from maexp.kernels.arrays import Field, make_arrays
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN
from maexp.kernels.cpp_snippets import count_nonzero, next_news
from maexp.kernels.launches import Launch, lanes_on, launch_named
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps

wp.set_module_options(MODULE_OPTIONS)


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
    stand_in: wp.array(dtype=wp.int32)  # cell whose state each takes, itself where it has points; -1 = none
    void_begin: wp.array(dtype=wp.int32)  # [all cells + 1], where the voids of a cell start in `voids`
    voids: wp.array(dtype=wp.int32)  # cells without points of their own, by the cell whose state they take


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


@wp.func
def wall_bits(width: int) -> int:
    """Words of a row of the bitmap of walls."""
    return (width + 31) / 32


@wp.kernel
def _begin_painting(
    # Out:
    met: wp.array(dtype=wp.int32),  # [row]
    news_count: wp.array(dtype=wp.int32),  # [row]
):
    row = wp.tid()
    met[row] = 0
    news_count[row] = 0


@wp.func
def enter_cell(
    row: int,
    cell: int,
    w: int,
    value: wp.uint8,
    listed: bool,
    known: wp.array2d(dtype=wp.uint8),
    walls: wp.array2d(dtype=wp.int32),
    news: wp.array2d(dtype=wp.int32),
    news_count: wp.array(dtype=wp.int32),
):
    """Give a cell a state and list it."""
    known[row, cell] = value
    if value == wp.uint8(OBSTACLE):
        x = cell % w
        wp.atomic_or(walls, row, cell / w * wall_bits(w) + x / 32, 1 << (x % 32))
    if listed:
        slot = wp.atomic_add(news_count, row, 1)
        if slot < news.shape[1]:
            news[row, slot] = cell


@wp.kernel
def _paint_points(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    point_begin: wp.array(dtype=wp.int32),  # [map + 1]
    point_cell: wp.array(dtype=wp.int32),  # [points of all maps]
    grid_of_row: wp.array(dtype=wp.int32),  # [row], map of what is painted
    looked: wp.array(dtype=wp.int32),  # [env], 0: leave what is there as it is
    # Settings:
    again: int,  # 0: every row; 1: rows that were cleared
    rows_per_env: int,
    value: wp.uint8,
    shift: int,  # of this layer's points in `painted`
    lanes: int,
    # State in:
    flags: wp.array3d(dtype=wp.int32),  # [env, word, point]
    # In:
    stale: wp.array(dtype=wp.int32),  # [row]
    # In and out:
    painted: wp.array2d(dtype=wp.uint8),  # [row, point]
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    met: wp.array(dtype=wp.int32),  # [row], known points
    total: wp.array(dtype=wp.int32),  # [row], painted points
    news_count: wp.array(dtype=wp.int32),  # [row]
    # Out:
    news: wp.array2d(dtype=wp.int32),  # [row, slot]
):
    """Give `value` to the cells of points known now and not yet painted, and to the voids that follow them.

    With one row an env, what any robot knows counts. Obstacles come first: a cell that holds one stays one.
    """
    row, lane = wp.tid()
    e = row / rows_per_env
    m = map_id[e]
    if looked[e] == 0 or m != grid_of_row[row] or (again != 0 and stale[row] == 0):
        return
    first = point_begin[m]
    w = grids.width[m]
    begin = grids.cell_begin[m]
    # Where knowledge is shared any flag counts, else the robot's own, a bit of one word.
    robot = row % rows_per_env
    words = wp.where(rows_per_env > 1, 1, flags.shape[1])
    mask = wp.where(rows_per_env > 1, 1 << (robot % ROBOTS_PER_WORD), -1)
    word = robot / ROBOTS_PER_WORD
    found = int(0)
    added = int(0)
    end = point_begin[m + 1] - first
    point = int(lane)
    while point < end:
        unpainted = next_news(flags, e, word, words, mask, painted, row, shift, point, end, lanes)
        point = unpainted[0]
        found += unpainted[1]
        if point < end:
            painted[row, shift + point] = wp.uint8(1)
            added += 1
            cell = point_cell[first + point]
            state = known[row, cell]
            if state == wp.uint8(UNKNOWN) or (value == wp.uint8(OBSTACLE) and state != value):
                listed = again == 0
                enter_cell(row, cell, w, value, listed, known, walls, news, news_count)
                for k in range(grids.void_begin[begin + cell], grids.void_begin[begin + cell + 1]):
                    enter_cell(row, grids.voids[k], w, value, listed, known, walls, news, news_count)
        point += lanes
    if again == 0:
        wp.atomic_add(met, row, found)
    wp.atomic_add(total, row, added)


@wp.kernel
def _find_stale(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    capacity: int,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env], 0: leave what is there as it is
    met: wp.array(dtype=wp.int32),  # [row]
    # In and out:
    total: wp.array(dtype=wp.int32),  # [row]
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    news_count: wp.array(dtype=wp.int32),  # [row]
    # Out:
    stale: wp.array(dtype=wp.int32),  # [row]
):
    """A row is stale where something painted is not known (any more), or was on another map."""
    row = wp.tid()
    if looked[row / rows_per_env] == 0:
        stale[row] = 0
        return
    m = map_id[row / rows_per_env]
    stale[row] = wp.where(met[row] != total[row] or m != grid_of_row[row], 1, 0)
    if stale[row] != 0:
        total[row] = 0
        grid_of_row[row] = m
    if stale[row] != 0 or news_count[row] > capacity:
        news_count[row] = -1


@wp.kernel
def _clear_stale(
    # Settings:
    lanes: int,
    # In:
    stale: wp.array(dtype=wp.int32),  # [row]
    # Out:
    painted: wp.array2d(dtype=wp.uint8),  # [row, point]
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
):
    row, lane = wp.tid()
    if stale[row] != 0:
        for point in range(lane, painted.shape[1], lanes):
            painted[row, point] = wp.uint8(0)
        for cell in range(lane, known.shape[1], lanes):
            known[row, cell] = wp.uint8(UNKNOWN)
        for word in range(lane, walls.shape[1], lanes):
            walls[row, word] = 0


@wp.kernel
def _clear_counts(
    # Out:
    known_count: wp.array(dtype=wp.int32),  # [row]
):
    known_count[wp.tid()] = 0


@wp.kernel
def _count_known(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # Settings:
    lanes: int,
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    # In and out:
    known_count: wp.array(dtype=wp.int32),  # [row], 0 before
):
    row, lane = wp.tid()
    m = grid_of_row[row]
    if m >= 0:
        wp.atomic_add(known_count, row, count_nonzero(known, row, lane, grids.width[m] * grids.height[m], lanes))


KNOWN = {
    "looked": Field(wp.int32, "env", "", "1: bring the env up to date; 0: leave it, what changes counts later", 1),
    "known": Field(wp.uint8, "row cell", "", "`UNKNOWN`, `FREE` or `OBSTACLE`"),
    "walls": Field(wp.int32, "row word", "", "a bit for every `OBSTACLE`; rows of cells begin with a word"),
    "painted": Field(wp.uint8, "row point", "", "1 for points that the grid shows"),
    "grid_of_row": Field(wp.int32, "row", "", "the map; set by `paint`", -1),
    "news": Field(wp.int32, "row slot", "", "cells that the last `paint` changed"),
    "news_count": Field(wp.int32, "row", "", "how many; -1: any may have", -1),
    "met": Field(wp.int32, "row", "", "known points"),
    "total": Field(wp.int32, "row", "", "painted points"),
    "stale": Field(wp.int32, "row", "", "1 where the grid is painted anew"),
    "known_count": Field(wp.int32, "row", "", "cells that are not `UNKNOWN`; set by `count`"),
}
"""Arrays of `KnownGrids`; a row is an env's where the team shares what it knows, else a robot's."""


class KnownGrids:
    """Grids of a run of envs, painted from the flags of seen points.

    Args:
        maps, grids: static data of the maps.
        map_id: int32 [E], the map of each env.
        free_flags, boundary_flags: int32 [E, W, points], bit i % 32 of word i // 32 for robot i.
        false_flags: the same of free points that are taken for walls; None: none ever are.
        rows_per_env: 1 (the team's knowledge) or the number of robots (each robot's own).
        cells: cells of the largest grid.

    Attributes: those of `KNOWN`.
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
        false_flags: wp.array | None = None,
    ):
        self.false_flags = false_flags
        self.maps, self.grids, self.map_id = maps, grids, map_id
        self.free_flags, self.boundary_flags = free_flags, boundary_flags
        self.rows_per_env = rows_per_env
        self.lanes = lanes_on(map_id.device, 256)
        rows, device = map_id.shape[0] * rows_per_env, map_id.device
        points = free_flags.shape[2] + boundary_flags.shape[2]
        if false_flags is not None:
            points += false_flags.shape[2]
        words, slots = wall_capacity(grids), news_capacity(cells)
        sizes = {"env": map_id.shape[0], "row": rows, "cell": cells, "word": words, "point": points, "slot": slots}
        vars(self).update(make_arrays(KNOWN, sizes, device))

    def paint(self, launch: Launch) -> None:
        """Bring `known` up to date."""
        rows, values = self.known.shape[0], vars(self) | {"capacity": self.news.shape[1]}
        launch_named(launch, _begin_painting, rows, values)
        self._paint_layers(launch, again=0)
        launch_named(launch, _find_stale, rows, values)
        launch_named(launch, _clear_stale, (rows, self.lanes), values)
        self._paint_layers(launch, again=1)

    def count(self, launch: Launch) -> None:
        """Bring `known_count` up to date with `known`."""
        launch_named(launch, _clear_counts, self.known.shape[0], vars(self))
        launch_named(launch, _count_known, (self.known.shape[0], self.lanes), vars(self))

    def _paint_layers(self, launch: Launch, again: int) -> None:
        """Paint obstacles, then free points, and over them what is taken for walls."""
        maps, grids = self.maps, self.grids
        obstacles = {
            "point_begin": maps.boundary_begin,
            "point_cell": grids.boundary_cell,
            "flags": self.boundary_flags,
            "value": wp.uint8(OBSTACLE),
            "shift": self.free_flags.shape[2],
        }
        free = {
            "point_begin": maps.free_begin,
            "point_cell": grids.free_cell,
            "flags": self.free_flags,
            "value": wp.uint8(FREE),
            "shift": 0,
        }
        layers = [obstacles, free]
        if self.false_flags is not None:
            shift = self.free_flags.shape[2] + self.boundary_flags.shape[2]
            layers.append(free | {"flags": self.false_flags, "value": wp.uint8(OBSTACLE), "shift": shift})
        for layer in layers:
            given = vars(self) | layer | {"again": again}
            launch_named(launch, _paint_points, (self.known.shape[0], self.lanes), given)


def news_capacity(cells: int) -> int:
    """Cells that may change in one painting before masks are drawn anew instead."""
    return max(256, cells // 4)


def wall_capacity(grids: NavGrids) -> int:
    """Words of the bitmap of walls of the largest grid."""
    return int((grids.height.numpy() * -(-grids.width.numpy() // 32)).max())
