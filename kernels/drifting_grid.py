"""Known grids of maps that shift with odometry (`mapping`): what robots have drawn, and what changed since one looked.

Unlike those of true maps they lose walls and move them: a row that has lost one counts as painted anew.
"""

import warp as wp

from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN
from maexp.kernels.launches import Launch, launch_named
from maexp.kernels.occupancy_grid import KnownGrids, NavGrids, _clear_stale, enter_cell, wall_bits
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ROBOTS_PER_WORD, Maps

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def place_x(grids: NavGrids, m: int, place: int) -> int:
    """Half cells from the grid's corner to a place (`mapping.place_number`), along x."""
    return (place - 1) % (2 * grids.width[m] + 1)


@wp.func
def place_y(grids: NavGrids, m: int, place: int) -> int:
    """The same along y."""
    return (place - 1) / (2 * grids.width[m] + 1)


@wp.kernel
def _begin_copying(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    # In and out:
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # Out:
    stale: wp.array(dtype=wp.int32),  # [row]
    news_count: wp.array(dtype=wp.int32),  # [row]
):
    """A row is stale that was of another map."""
    row = wp.tid()
    m = map_id[row / rows_per_env]
    stale[row] = wp.where(m != grid_of_row[row], 1, 0)
    grid_of_row[row] = m
    news_count[row] = 0


@wp.kernel
def _copy_drawn(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # Settings:
    rows_per_env: int,
    lanes: int,
    # State in:
    drawn: wp.array3d(dtype=wp.int32),  # [env, row, cell]
    # In and out:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    news_count: wp.array(dtype=wp.int32),  # [row]
    # Out:
    stale: wp.array(dtype=wp.int32),  # [row]
    news: wp.array2d(dtype=wp.int32),  # [row, slot]
):
    """Show what is drawn. A row that loses a wall, or shows less, is stale."""
    row, lane = wp.tid()
    e = row / rows_per_env
    m = grid_of_row[row]
    w = grids.width[m]
    keys = drawn[e, row % rows_per_env]
    shown = known[row]
    for cell in range(lane, w * grids.height[m], lanes):
        key = keys[cell]
        value = wp.uint8(UNKNOWN)
        if key != 0:
            value = wp.where(key % 2 != 0, wp.uint8(OBSTACLE), wp.uint8(FREE))
        before = shown[cell]
        if value != before:
            if before == wp.uint8(OBSTACLE):
                x = cell % w
                wp.atomic_and(walls, row, cell / w * wall_bits(w) + x / 32, ~(1 << (x % 32)))
            if before == wp.uint8(OBSTACLE) or value == wp.uint8(UNKNOWN):
                stale[row] = 1
            enter_cell(row, cell, w, value, True, known, walls, news, news_count)


@wp.kernel
def _enter_false_walls(
    # Map:
    maps: Maps,
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    # Settings:
    rows_per_env: int,
    lanes: int,
    # State in:
    false_flags: wp.array3d(dtype=wp.int32),  # [env, word, free]
    place_free: wp.array3d(dtype=wp.int32),  # [env, row, free]
    # In and out:
    walls: wp.array2d(dtype=wp.int32),  # [row, word]
    news_count: wp.array(dtype=wp.int32),  # [row]
    # Out:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    news: wp.array2d(dtype=wp.int32),  # [row, slot]
):
    """Show false walls where the row has its free points that it takes for them."""
    row, lane = wp.tid()
    e = row / rows_per_env
    m = grid_of_row[row]
    w = grids.width[m]
    robot = row % rows_per_env
    for j in range(lane, maps.free_begin[m + 1] - maps.free_begin[m], lanes):
        flags = int(0)
        if rows_per_env > 1:
            flags = false_flags[e, robot / ROBOTS_PER_WORD, j] & (1 << (robot % ROBOTS_PER_WORD))
        else:
            for word in range(false_flags.shape[1]):
                flags = flags | false_flags[e, word, j]
        place = place_free[e, robot, j]
        if flags != 0 and place != 0:
            x = wp.min(place_x(grids, m, place) / 2, w - 1)
            y = wp.min(place_y(grids, m, place) / 2, grids.height[m] - 1)
            enter_cell(row, y * w + x, w, wp.uint8(OBSTACLE), True, known, walls, news, news_count)


@wp.kernel
def _end_copying(
    # Settings:
    capacity: int,
    # In:
    stale: wp.array(dtype=wp.int32),  # [row]
    # In and out:
    news_count: wp.array(dtype=wp.int32),  # [row]
):
    row = wp.tid()
    if stale[row] != 0 or news_count[row] > capacity:
        news_count[row] = -1


class DrawnGrids(KnownGrids):
    """`KnownGrids` that show what robots have drawn, not what is known of the true map.

    Args:
        drawn: int32 [E, R, cells], what stands in each cell (`kernels.mapping`).
        place_free: int32 [E, R, free], where free points are believed to be.
        more: those of `KnownGrids`.
    """

    def __init__(self, *more, drawn: wp.array, place_free: wp.array):
        super().__init__(*more)
        self.drawn, self.place_free = drawn, place_free

    def paint(self, launch: Launch) -> None:
        """Bring `known` up to date."""
        rows, values = self.known.shape[0], vars(self) | {"capacity": self.news.shape[1]}
        launch_named(launch, _begin_copying, rows, values)
        launch_named(launch, _clear_stale, (rows, self.lanes), values)
        launch_named(launch, _copy_drawn, (rows, self.lanes), values)
        if self.false_flags is not None:
            launch_named(launch, _enter_false_walls, (rows, self.lanes), values)
        launch_named(launch, _end_copying, rows, values)
