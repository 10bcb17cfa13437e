"""Frontier cells gathered in square blocks, each with a cell to go to and what was last seen from there.

Rows are those of `KnownGrids`: one per env where the team shares what it knows, else one per robot. Blocks are
numbered ``by * blocks_x + bx`` with ``blocks_x = ceil(width / block)`` of the env's map.
"""

import numpy as np
import warp as wp

from maexp.kernels.arrays import Field, make_arrays
from maexp.kernels.constants import MARGIN_CELLS, UNREACHED
from maexp.kernels.cpp_snippets import has_wall
from maexp.kernels.frontier import is_frontier
from maexp.kernels.launches import Launch, launch_named
from maexp.kernels.occupancy_grid import NavGrids, wall_bits
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.wavefront import PathSearch

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _mark_rows(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    rows_per_env: int,
    # In:
    looked: wp.array(dtype=wp.int32),  # [env], 0: leave what is there as it is
    # Out:
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
):
    row = wp.tid()
    e = row / rows_per_env
    grid_of_row[row] = wp.where(looked[e] != 0, map_id[e], -1)


@wp.func
def is_reached(distance: wp.array2d(dtype=wp.int32), e: int, first: int, last: int, robots: int, cell: int) -> bool:
    """Whether one of the robots `first` to `last` (not included) gets to a cell."""
    for i in range(first, last):
        if distance[e * robots + i, cell] < UNREACHED:
            return True
    return False


@wp.kernel
def _note_changes(
    # Map:
    width: wp.array(dtype=wp.int32),  # [grid]
    map_of_row: wp.array(dtype=wp.int32),  # [row]
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    # Settings:
    lanes: int,
    # In:
    news: wp.array2d(dtype=wp.int32),  # [row, slot]
    news_count: wp.array(dtype=wp.int32),  # [row], -1 = any cell
    # In and out:
    changed: wp.array2d(dtype=wp.int32),  # [row, word], a bit for every cell
    renewed: wp.array(dtype=wp.int32),  # [row]
    # Out:
    size: wp.array2d(dtype=wp.int32),  # [row, block]
    sums: wp.array3d(dtype=wp.int64),  # [row, block, 2]
    frontier: wp.array2d(dtype=wp.uint8),  # [row, cell]
):
    """Add what the last painting changed to what has changed since; nothing holds of a row that was painted anew."""
    row, lane = wp.tid()
    anew = news_count[row] < 0
    if anew:
        for word in range(lane, changed.shape[1], lanes):
            changed[row, word] = -1
    w = width[map_of_row[row]]
    for k in range(lane, news_count[row], lanes):
        x = news[row, k] % w
        wp.atomic_or(changed, row, news[row, k] / w * wall_bits(w) + x / 32, 1 << (x % 32))
    if grid_of_row[row] >= 0 and (anew or renewed[row] != 0):
        for k in range(lane, size.shape[1], lanes):
            size[row, k] = 0
            sums[row, k, 0] = wp.int64(0)
            sums[row, k, 1] = wp.int64(0)
        for cell in range(lane, frontier.shape[1], lanes):
            frontier[row, cell] = wp.uint8(0)
    if anew:
        renewed[row] = 1


@wp.func
def changed_around(changed: wp.array2d(dtype=wp.int32), row: int, y: int, word: int, h: int, across: int) -> wp.uint32:
    """A bit for every cell of a word of a line that has changed, or shares an edge with one that has."""
    here = wp.uint32(changed[row, y * across + word])
    bits = here | here << wp.uint32(1) | here >> wp.uint32(1)
    if word > 0:
        bits = bits | wp.uint32(changed[row, y * across + word - 1]) >> wp.uint32(31)
    if word + 1 < across:
        bits = bits | wp.uint32(changed[row, y * across + word + 1]) << wp.uint32(31)
    if y > 0:
        bits = bits | wp.uint32(changed[row, (y - 1) * across + word])
    if y + 1 < h:
        bits = bits | wp.uint32(changed[row, (y + 1) * across + word])
    return bits


@wp.kernel
def _sum_frontier(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    block: wp.array(dtype=wp.int32),  # [grid], side of a block in cells
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    changed: wp.array2d(dtype=wp.int32),  # [row, word]
    # In and out:
    frontier: wp.array2d(dtype=wp.uint8),  # [row, cell]
    size: wp.array2d(dtype=wp.int32),  # [row, block], frontier cells
    sums: wp.array3d(dtype=wp.int64),  # [row, block, 2], sums of their x and y, from the block's corner
):
    """Mark the frontier cells of a line of cells where one or a neighbour has changed, and gather them in blocks."""
    row, y = wp.tid()
    m = grid_of_row[row]
    if m < 0:
        return
    w = grids.width[m]
    h = grids.height[m]
    if y >= h:
        return
    across = wall_bits(w)
    b = block[m]
    first = y / b * ((w + b - 1) / b)
    for word in range(across):
        bits = changed_around(changed, row, y, word, h, across)
        for k in range(wp.where(bits != wp.uint32(0), wp.min(32, w - 32 * word), 0)):
            if (bits >> wp.uint32(k)) % wp.uint32(2) != wp.uint32(0):
                x = 32 * word + k
                now = is_frontier(known, row, x, y, w, h)
                step = int(now) - int(frontier[row, y * w + x])
                if step != 0:
                    frontier[row, y * w + x] = now
                    place = first + x / b
                    wp.atomic_add(size, row, place, step)
                    wp.atomic_add(sums, row, place, 0, wp.int64(step * (x % b)))
                    wp.atomic_add(sums, row, place, 1, wp.int64(step * (y % b)))


@wp.kernel
def _forget_changes(
    # Settings:
    lanes: int,
    # In:
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    # Out:
    changed: wp.array2d(dtype=wp.int32),  # [row, word]
    renewed: wp.array(dtype=wp.int32),  # [row]
):
    row, lane = wp.tid()
    if grid_of_row[row] >= 0:
        renewed[row] = 0
        for word in range(lane, changed.shape[1], lanes):
            changed[row, word] = 0


@wp.func
def scaled_gap(step: int, count: int, sum: wp.int64) -> wp.int64:
    """Square of how far `step` is from the mean of `count` numbers, times the square of `count`.

    So the mean stays in integers; 64 bits, for blocks may be large.
    """
    gap = wp.int64(step) * wp.int64(count) - sum
    return gap * gap


@wp.func
def place_target(
    row: int,
    k: int,
    w: int,
    h: int,
    b: int,
    search: int,
    size: wp.array2d(dtype=wp.int32),
    sums: wp.array3d(dtype=wp.int64),
    distance: wp.array2d(dtype=wp.int32),
    rows_per_env: int,
    robots: int,
) -> int:
    """The reached cell nearest to the middle of a block's frontier cells, in or close to it; -1: none."""
    count = size[row, k]
    across = (w + b - 1) / b
    x0 = (k % across) * b
    y0 = (k / across) * b
    e = row / rows_per_env
    first = wp.where(rows_per_env > 1, row % rows_per_env, 0)
    last = wp.where(rows_per_env > 1, first + 1, robots)
    low_x = wp.max(x0 - search, 0)
    high_x = wp.min(wp.min(x0 + b, w) + search, w)
    low_y = wp.max(y0 - search, 0)
    high_y = wp.min(wp.min(y0 + b, h) + search, h)
    middle_x = x0 + int(sums[row, k, 0] / wp.int64(count))
    middle_y = y0 + int(sums[row, k, 1] / wp.int64(count))
    # From the middle outward, until nothing nearer can come; of several as near the one with the lowest number.
    best_gap = wp.int64(1) << wp.int64(62)
    best = wp.int32(-1)
    for side_y in range(2):
        y = middle_y + side_y
        go_y = wp.bool(True)
        while go_y and y >= low_y and y < high_y:
            gap_y = scaled_gap(y - y0, count, sums[row, k, 1])
            go_y = gap_y <= best_gap
            if go_y:
                for side_x in range(2):
                    x = middle_x + side_x
                    go_x = wp.bool(True)
                    while go_x and x >= low_x and x < high_x:
                        gap = gap_y + scaled_gap(x - x0, count, sums[row, k, 0])
                        cell = y * w + x
                        go_x = gap <= best_gap
                        if gap < best_gap or (gap == best_gap and cell < best):
                            if is_reached(distance, e, first, last, robots, cell):
                                best_gap = gap
                                best = cell
                                go_x = wp.bool(False)
                        x += 2 * side_x - 1
            y += 2 * side_y - 1
    return best


@wp.func
def has_changed(changed: wp.array2d(dtype=wp.int32), row: int, low: int, high: int, w: int) -> bool:
    """Whether a cell has changed in the box between two."""
    for y in range(low / w, high / w + 1):
        if has_wall(changed, row, y * wall_bits(w), low % w, high % w):
            return True
    return False


@wp.kernel
def _place_targets(
    # Map:
    grids: NavGrids,
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    block: wp.array(dtype=wp.int32),  # [grid], side of a block in cells
    search: wp.array(dtype=wp.int32),  # [grid], how far outside its block a target may lie, in cells
    # In:
    size: wp.array2d(dtype=wp.int32),  # [row, block], frontier cells
    sums: wp.array3d(dtype=wp.int64),  # [row, block, 2]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    changed: wp.array2d(dtype=wp.int32),  # [row, word]
    renewed: wp.array(dtype=wp.int32),  # [row], what was kept is of another map
    cached_window: wp.array3d(dtype=wp.int32),  # [row, block, 2], corners of what was looked at from there
    # Settings:
    rows_per_env: int,
    robots: int,
    lanes: int,
    # Out:
    target_cell: wp.array2d(dtype=wp.int32),  # [row, block], cell to go to; -1 = none
    cached_from: wp.array2d(dtype=wp.int32),  # [row, block], the cell whose outlook still holds; -1 = none
):
    """Where to go for each block with frontier cells."""
    row, lane = wp.tid()
    m = grid_of_row[row]
    if m < 0:
        return
    w = grids.width[m]
    for k in range(lane, size.shape[1], lanes):
        cell = wp.int32(-1)
        if size[row, k] > 0:
            cell = place_target(
                row, k, w, grids.height[m], block[m], search[m], size, sums, distance, rows_per_env, robots
            )
        target_cell[row, k] = cell
        if cached_from[row, k] >= 0:
            if cached_from[row, k] != cell or renewed[row] != 0:
                cached_from[row, k] = -1
            elif has_changed(changed, row, cached_window[row, k, 0], cached_window[row, k, 1], w):
                cached_from[row, k] = -1


@wp.kernel
def _list_blocks(
    # Map:
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    # Settings:
    rows_per_env: int,
    # In:
    target_cell: wp.array2d(dtype=wp.int32),  # [row, block], -1 = none
    # Out:
    listed: wp.array2d(dtype=wp.int32),  # [env, slot]
    count: wp.array(dtype=wp.int32),  # [env]
):
    """The blocks with a target in some row of an env, in order (of some 4,000 a hundred have one)."""
    e = wp.tid()
    if grid_of_row[e * rows_per_env] < 0:
        return
    found = wp.int32(0)
    for k in range(target_cell.shape[1]):
        some = wp.bool(False)
        for row in range(e * rows_per_env, (e + 1) * rows_per_env):
            some = some or target_cell[row, k] >= 0
        if some:
            listed[e, found] = k
            found += 1
    count[e] = found


BLOCKS = {
    "grid_of_row": Field(wp.int32, "row", "", "the map of rows of those envs, else -1; set by `mark`"),
    "renewed": Field(wp.int32, "row", "", "1 where nothing holds that was kept"),
    "changed": Field(wp.int32, "row word", "", "a bit for every cell that has changed since"),
    "frontier": Field(wp.uint8, "row cell", "", "1 for known free cells with an unknown neighbour"),
    "size": Field(wp.int32, "row block", "", "frontier cells in the block"),
    "sums": Field(wp.int64, "row block two", "cells", "sums of their x and y, from the block's corner"),
    "target_cell": Field(wp.int32, "row block", "", "the cell to go to; -1 = none"),
    "listed": Field(wp.int32, "env block", "", "the blocks with a target in some row of the env, in order"),
    "count": Field(wp.int32, "env", "", "how many those are"),
    "cached_from": Field(wp.int32, "row block", "", "the target whose outlook still holds; -1 = none", -1),
    "cached_window": Field(wp.int32, "row block two", "", "lower and upper corner of what was looked at from there"),
    "cached_area": Field(wp.float32, "row block", "cells", "unknown ones seen from there"),
    "cached_middle": Field(wp.vec2, "row block", "m", "their middle, from there"),
}
"""Arrays of `FrontierBlocks`; rows are those of `KNOWN`."""


class FrontierBlocks:
    """The blocks of a run of envs, brought up to date after every search of `paths` from all robots.

    Args:
        paths: known grids, masks and distances.
        side: int32 [grid], edges of blocks in cells (`block_size.block_sides`).
        threshold: the largest collision threshold [m]: so far outside its block, and a little more, may a target lie.

    Attributes: those of `BLOCKS`.
    """

    def __init__(self, paths: PathSearch, side: np.ndarray, threshold: float):
        known = paths.passable.known
        rows, cells = known.known.shape
        device, envs = known.known.device, rows // known.rows_per_env
        cell, width, height = (getattr(known.grids, name).numpy() for name in ("cell", "width", "height"))
        search = np.ceil(threshold / cell + MARGIN_CELLS).astype(np.int32) + 1
        self.paths, self.tallest = paths, int(height.max())
        self.num_blocks = int((-(-width // side) * -(-height // side)).max())
        self.block, self.search = (wp.array(v, dtype=wp.int32, device=device) for v in (side, search))

        sizes = {
            "env": envs,
            "row": rows,
            "word": known.walls.shape[1],
            "cell": cells,
            "block": self.num_blocks,
            "two": 2,
        }
        vars(self).update(make_arrays(BLOCKS, sizes, device))

    def values(self) -> dict:
        """The arrays of grids, ways and blocks, by the names of the kernels' parameters."""
        known = self.paths.passable.known
        return (
            self.paths.values()
            | vars(self)
            | {
                "width": known.grids.width,
                "map_of_row": known.grid_of_row,
                "known": known.known,
                "looked": known.looked,
                "news": known.news,
                "news_count": known.news_count,
                "rows_per_env": known.rows_per_env,
                "robots": self.paths.shape[1],
                "lanes": known.lanes,
            }
        )

    def mark(self, launch: Launch) -> None:
        """Note which rows are to be brought up to date."""
        launch_named(launch, _mark_rows, self.grid_of_row.shape, self.values())

    def place(self, launch: Launch) -> None:
        """Bring frontiers, blocks and targets up to date with the known grids and the distances."""
        values, rows = self.values(), self.grid_of_row.shape[0]
        split = (rows, values["lanes"])
        launch_named(launch, _note_changes, split, values)
        launch_named(launch, _sum_frontier, (rows, self.tallest), values)
        launch_named(launch, _place_targets, split, values)
        launch_named(launch, _forget_changes, split, values)
        launch_named(launch, _list_blocks, self.count.shape, values)
