"""Where robots fit on what is known: masks of navigation grids, one per env and distinct distance to keep.

Masks follow the list of cells that the last painting of `KnownGrids` changed; where that is too long, or a row was
cleared, they are drawn anew.
"""

import numpy as np
import warp as wp

from maexp.kernels.arrays import Field, make_arrays
from maexp.kernels.constants import BLOCKED, FREE, OBSTACLE, TIGHT, UNKNOWN
from maexp.kernels.cpp_snippets import has_wall
from maexp.kernels.launches import Launch, launch_named
from maexp.kernels.occupancy_grid import KnownGrids, NavGrids, wall_bits
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _assign_grids(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    # Out:
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
):
    row = wp.tid()
    grid_of_row[row] = map_id[row / rows_per_env]


@wp.kernel
def _open_cells(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # Settings:
    through_unknown: int,
    lanes: int,
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [known row, cell]
    news_count: wp.array(dtype=wp.int32),  # [known row], -1 = all cells
    known_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # Out:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
):
    """Masks to be drawn anew: open but for obstacles."""
    row, lane = wp.tid()
    m = grid_of_row[row]
    source = known_of_row[row]
    if news_count[source] >= 0:
        return
    for cell in range(lane, grids.width[m] * grids.height[m], lanes):
        state = known[source, cell]
        open = state == wp.uint8(FREE) or (state == wp.uint8(UNKNOWN) and through_unknown != 0)
        passable[row, cell] = wp.where(open, wp.uint8(1), wp.uint8(0))


@wp.func
def half_chord(gap: int, radius: float, most: int) -> int:
    """The most cells to the side, of `most`, that lie nearer than a radius [cells], `gap` rows away; -1: none."""
    square = radius * radius
    half = wp.int32(most)
    while half >= 0 and float(gap * gap + half * half) >= square:
        half -= 1
    return half


@wp.func
def near_wall(walls: wp.array2d(dtype=wp.int32), row: int, x: int, y: int, w: int, h: int, radius: float) -> bool:
    """Whether a known obstacle lies nearer to a cell than a radius, in cells."""
    across = wall_bits(w)
    half = int(wp.ceil(radius))
    for gap in range(int(wp.ceil(radius)) + 1):
        half = half_chord(gap, radius, half)
        if half < 0:
            return False
        first = wp.max(x - half, 0)
        last = wp.min(x + half, w - 1)
        if y - gap >= 0:
            if has_wall(walls, row, (y - gap) * across, first, last):
                return True
        if gap > 0 and y + gap < h:
            if has_wall(walls, row, (y + gap) * across, first, last):
                return True
    return False


@wp.kernel
def _open_news(
    # Settings:
    lanes: int,
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [known row, cell]
    news: wp.array2d(dtype=wp.int32),  # [known row, slot]
    news_count: wp.array(dtype=wp.int32),  # [known row]
    known_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # Out:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
):
    """Open cells that have become known to be free; the next launches close those near obstacles."""
    row, lane = wp.tid()
    source = known_of_row[row]
    for k in range(lane, news_count[source], lanes):
        if known[source, news[source, k]] == wp.uint8(FREE):
            passable[row, news[source, k]] = wp.uint8(1)


@wp.func
def close_around(cell: int, w: int, h: int, row: int, r: float, value: wp.uint8, passable: wp.array2d(dtype=wp.uint8)):
    """Give `value` to what is not blocked and lies nearer than `r` cells to an obstacle cell."""
    x = cell % w
    y = cell / w
    half = int(wp.ceil(r))
    for gap in range(int(wp.ceil(r)) + 1):
        half = half_chord(gap, r, half)
        first = wp.max(x - half, 0)
        last = wp.min(x + half, w - 1)
        for side in range(wp.where(gap == 0, 1, 2)):
            v = y + wp.where(side == 0, gap, -gap)
            if v >= 0 and v < h:
                for u in range(v * w + first, v * w + last + 1):
                    if passable[row, u] != wp.uint8(BLOCKED):
                        passable[row, u] = value


@wp.kernel
def _close_cells(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [mask row]
    # Settings:
    margin: float,  # the same, on top, in cells
    value: wp.uint8,
    through_unknown: int,
    lanes: int,
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [known row, cell]
    news: wp.array2d(dtype=wp.int32),  # [known row, slot]
    news_count: wp.array(dtype=wp.int32),  # [known row], -1 = all cells
    known_of_row: wp.array(dtype=wp.int32),  # [mask row]
    walls: wp.array2d(dtype=wp.int32),  # [known row, word]
    radius: wp.array(dtype=wp.float32),  # [mask row], distance from known obstacle cells [m]
    # In and out:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
):
    """Close the surroundings of obstacles (those that are news), and cells that have opened near older ones.

    Threads that write the same cell write the same.
    """
    row, lane = wp.tid()
    m = grid_of_row[row]
    w = grids.width[m]
    h = grids.height[m]
    source = known_of_row[row]
    r = radius[row] / grids.cell[m] + margin
    if news_count[source] < 0:
        for cell in range(lane, w * h, lanes):
            if known[source, cell] == wp.uint8(OBSTACLE):
                close_around(cell, w, h, row, r, value, passable)
    for k in range(lane, news_count[source], lanes):
        cell = news[source, k]
        if known[source, cell] == wp.uint8(OBSTACLE):
            if value == wp.uint8(BLOCKED):
                passable[row, cell] = wp.uint8(BLOCKED)
            close_around(cell, w, h, row, r, value, passable)
        elif through_unknown == 0:
            if near_wall(walls, source, cell % w, cell / w, w, h, r):
                passable[row, cell] = value


PASSABLE = {
    "passable": Field(wp.uint8, "mask cell", "", "`BLOCKED`, `OPEN` or `TIGHT`"),
    "grid_of_row": Field(wp.int32, "mask", "", "the map; set by `paint`"),
    "known_of_row": Field(wp.int32, "mask", "", "which known grid it is made of"),
    "reach": Field(wp.float32, "ring mask", "m", "below which cells are tight, and blocked"),
}
"""Arrays of `PassableGrids`."""


class PassableGrids:
    """Where robots fit on `KnownGrids`: one mask per env and distinct distance to keep. Paint after every painting
    of those.

    Args:
        known: the grids to read.
        radius: float32 [E, K], distance to keep from known obstacles [m]; K masks per env. Where every robot
            has a known row of its own, K must be the number of robots.
        comfort: float32 [E, K], distance below which a cell is tight [m]; None: no cell is.
        margin: the same on top of both, in cells, for what the grid rounds away.
        through_unknown: whether unknown cells count as passable.

    Attributes: those of `PASSABLE`; a row for each mask, [E * K].
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
        sizes = {"mask": envs * masks, "cell": known.known.shape[1], "ring": len(rings)}
        vars(self).update(make_arrays(PASSABLE, sizes, device))
        self.reach.assign(np.stack([reach.reshape(-1) for reach, _ in rings]).astype(np.float32))
        self.rings = [(self.reach[k], value) for k, (_, value) in enumerate(rings)]
        rows = np.arange(envs * masks, dtype=np.int32)
        self.known_of_row.assign(rows if known.rows_per_env == masks else rows // masks)

    def paint(self, launch: Launch) -> None:
        """Bring `passable` up to date with `known`."""
        known, lanes = self.known, self.known.lanes
        dim = (self.passable.shape[0], lanes)
        values = vars(self) | {
            "grids": known.grids,
            "map_id": known.map_id,
            "known": known.known,
            "news": known.news,
            "news_count": known.news_count,
            "walls": known.walls,
            "rows_per_env": self.masks,
            "lanes": lanes,
        }
        launch_named(launch, _assign_grids, self.grid_of_row.shape, values)
        launch_named(launch, _open_cells, dim, values)
        if not self.through_unknown:
            launch_named(launch, _open_news, dim, values)
        for radius, value in self.rings:
            ring = {"radius": radius, "value": wp.uint8(value)}
            launch_named(launch, _close_cells, dim, values | ring)
