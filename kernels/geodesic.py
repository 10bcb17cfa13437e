"""Geodesic distances on navigation grids: how far it is to drive, not to fly.

Cells are numbered ``cell = iy * width + ix``. A step to a straight neighbour weighs 10, to a diagonal one 14
(chamfer weights: 8 % from Euclid at worst), and a diagonal step needs both straight cells beside it passable
(no cutting of corners). Distances are integers, so every run and every device gives the same bits.

Cells may be `TIGHT`, too near to obstacles for comfort: steps into them weigh `TIGHT_FACTOR` times as much.

The search is Dijkstra's, exact, or where only the way to one cell is wanted A*'s, which looks in its direction first:
the key of a cell is its distance plus the least distance that may be left. Keys are even and grow by at most 70 along
a step, so cells wait in a ring of 64 buckets, one for every key that can occur; those of a bucket are a linked list,
and a cell whose label drops moves to another. A* goes on until all keys up to the goal's distance are done: then all
cells of all shortest ways to the goal have their exact distance.

Five files look over the cells of a grid. This one alone measures ways. `wavefront` keeps a way from search to search
and picks the waypoint that is driven to; `ways` has the short steps around a search, from cell to cell; `frontier`
needs no search, for a cell's neighbours say whether it is one; `tree` samples as RRT does, to find some frontiers
without looking at every cell.
"""

from collections.abc import Callable

import torch
import warp as wp

from maexp.kernels.arrays import Field, make_arrays
from maexp.kernels.constants import BLOCKED, DIAGONAL, STRAIGHT, TIGHT, TIGHT_FACTOR, UNREACHED
from maexp.kernels.launches import finish_filling, launch_on
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


BUCKETS = 64  # more than half the most that a step may add to a key, and a power of two
LAST_BUCKET = BUCKETS - 1

SKIP = -2  # as the stop of a search: leave its distances as they are


# In C++: half the time of the same in Warp's Python, most of which goes to looking at eight neighbours. Rows of cells
# have no gaps. Warp's debug mode does not look at pointers, but it heeds `assert`.
SEARCH = f"""
    const int cells = w * h;
    const wp::uint8* state = &wp::index(passable, row, 0);
    int* label = &wp::index(distance, item, 0);
    int* labelled = &wp::index(touched, item, 0);
    int* after = &wp::index(next, place, 0);
    int* before = &wp::index(previous, place, 0);
    assert(cells <= passable.shape[1] && cells <= distance.shape[1]);
    assert(cells <= next.shape[1] && cells <= previous.shape[1]);
    assert(labelled[0] >= 0 && labelled[1] < distance.shape[1]);

    auto search = [&](auto left)  // the least that may be left from a cell to the goal
    {{
        int bucket[{BUCKETS}];
        int waiting = 0, key = {UNREACHED}, limit = 2147483646, lowest = cells, highest = -1;

        auto lower = [&](int cell, int x, int y, int value)  // and move the cell to the bucket of its key
        {{
            assert(x >= 0 && x < w && y >= 0 && y < h && cell == y * w + x);
            const int old = label[cell];
            if (value >= old) return;
            label[cell] = value;
            const int rest = left(x, y);
            if (old < {UNREACHED})
            {{
                const int ahead = after[cell], behind = before[cell];
                if (behind < 0) bucket[((old + rest) >> 1) & {LAST_BUCKET}] = ahead; else after[behind] = ahead;
                if (ahead >= 0) before[ahead] = behind;
            }}
            else ++waiting;
            int& head = bucket[((value + rest) >> 1) & {LAST_BUCKET}];
            after[cell] = head;
            before[cell] = -1;
            if (head >= 0) before[head] = cell;
            head = cell;
        }};
        auto visit = [&](int cell, int x, int y, int value, int weight)
        {{
            lower(cell, x, y, value + (state[cell] == {TIGHT} ? {TIGHT_FACTOR} * weight : weight));
        }};

        for (int k = 0; k < {BUCKETS}; ++k) bucket[k] = -1;
        for (int k = 0; k < sources.shape[1]; ++k)
        {{
            const int source = wp::index(sources, item, k);
            if (source < 0 || source >= cells || state[source] == {BLOCKED}) continue;
            const int y = source / w, x = source - y * w;
            lower(source, x, y, 0);
            key = wp::min(key, left(x, y));
            lowest = wp::min(lowest, source);
            highest = wp::max(highest, source);
        }}
        while (waiting > 0 && key <= limit)
        {{
            int& head = bucket[(key >> 1) & {LAST_BUCKET}];
            const int cell = head;
            if (cell < 0) {{ key += 2; continue; }}
            const int d = label[cell], y = cell / w, x = cell - y * w;
            head = after[cell];
            if (head >= 0) before[head] = -1;
            --waiting;
            lowest = wp::min(lowest, cell);
            highest = wp::max(highest, cell);
            if (cell == goal) limit = d;
            const bool east = x + 1 < w && state[cell + 1] != {BLOCKED}, west = x > 0 && state[cell - 1] != {BLOCKED};
            if (east) visit(cell + 1, x + 1, y, d, {STRAIGHT});
            if (west) visit(cell - 1, x - 1, y, d, {STRAIGHT});
            auto pass = [&](int beside, int v)
            {{
                if (state[beside] == {BLOCKED}) return;
                visit(beside, x, v, d, {STRAIGHT});
                if (east && state[beside + 1] != {BLOCKED}) visit(beside + 1, x + 1, v, d, {DIAGONAL});
                if (west && state[beside - 1] != {BLOCKED}) visit(beside - 1, x - 1, v, d, {DIAGONAL});
            }};
            if (y + 1 < h) pass(cell + w, y + 1);
            if (y > 0) pass(cell - w, y - 1);
        }}
        // Labels lie at most one row and one column beyond the cells that were left.
        labelled[0] = wp::max(lowest - w - 1, 0);
        labelled[1] = wp::min(highest + w + 1, cells - 1);
    }};

    for (int cell = labelled[0]; cell <= labelled[1]; ++cell) label[cell] = {UNREACHED};
    if (goal < 0) search([](int, int) {{ return 0; }});
    else
    {{
        const int goal_y = goal / w, goal_x = goal - goal_y * w;
        search([=](int x, int y)
        {{
            const int dx = wp::abs(x - goal_x), dy = wp::abs(y - goal_y);
            return {STRAIGHT} * wp::max(dx, dy) + {DIAGONAL - STRAIGHT} * wp::min(dx, dy);
        }});
    }}
"""


@wp.func_native(SEARCH)
def search_from(
    passable: wp.array2d(dtype=wp.uint8),
    row: int,
    sources: wp.array2d(dtype=wp.int32),
    item: int,
    goal: int,
    place: int,
    w: int,
    h: int,
    next: wp.array2d(dtype=wp.int32),
    previous: wp.array2d(dtype=wp.int32),
    touched: wp.array2d(dtype=wp.int32),
    distance: wp.array2d(dtype=wp.int32),
):
    """Distances of all cells, or of the ways to `goal`; those of the search before are cleared."""
    ...


@wp.kernel
def _search_distance(
    # In:
    passable: wp.array2d(dtype=wp.uint8),  # [row, cell], 0 blocked, 1 open, 2 tight
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    # Map:
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    width: wp.array(dtype=wp.int32),  # [grid]
    height: wp.array(dtype=wp.int32),  # [grid]
    # In:
    sources: wp.array2d(dtype=wp.int32),  # [item, source], -1 = none
    stop: wp.array(dtype=wp.int32),  # [item], the cell whose distance is wanted; -1 = those of all; SKIP
    # Scratch:
    next: wp.array2d(dtype=wp.int32),  # [place, cell], of its bucket's list
    previous: wp.array2d(dtype=wp.int32),  # [place, cell]
    # In and out:
    touched: wp.array2d(dtype=wp.int32),  # [item, 2], first and last cell with a label
    # Out:
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
):
    item = wp.tid()
    goal = stop[item]
    if goal == SKIP:
        return
    row = row_of_item[item]
    w = width[grid_of_row[row]]
    h = height[grid_of_row[row]]
    place = item % next.shape[0]
    search_from(passable, row, sources, item, goal, place, w, h, next, previous, touched, distance)


SEARCH = {
    "sources": Field(wp.int32, "item source", "", "cell numbers, -1 = none. Fill before `search`", -1),
    "stop": Field(wp.int32, "item", "", "the one cell whose distance is wanted, -1 = all; `SKIP` = leave them", -1),
    "distance": Field(wp.int32, "item cell", "", "10 a straight step; `UNREACHED` elsewhere", UNREACHED),
    "next": Field(wp.int32, "place cell", "", "lists of buckets"),
    "previous": Field(wp.int32, "place cell", "", "the same backwards"),
    "touched": Field(wp.int32, "item end", "", "first and last cell to clear; cell 0 is cleared in vain once"),
}
"""Arrays of `DistanceSearch`."""


class DistanceSearch:
    """Buffers and launches of a batch of distance searches, allocated once and used again at every call.

    Args:
        items: searches in a batch.
        cells: capacity of a grid, the largest width * height of the batch.
        num_sources: sources of one search.
        device: Warp device.
        shared: one place to search in for all on the CPU, where one search ends before the next begins.

    Attributes: those of `SEARCH`. With a `stop` other labels are upper bounds, but exact on all shortest ways to it.
    """

    def __init__(
        self, items: int, cells: int, num_sources: int = 1, device: str | wp.Device = "cpu", shared: bool = False
    ):
        places = 1 if shared and wp.get_device(device).is_cpu else items
        sizes = {"item": items, "cell": cells, "source": num_sources, "place": places, "end": 2}
        vars(self).update(make_arrays(SEARCH, sizes, device))

    def search(
        self,
        launch: Callable,
        passable: wp.array,
        row_of_item: wp.array,
        grid_of_row: wp.array,
        width: wp.array,
        height: wp.array,
    ) -> None:
        """Fill `distance`.

        Args:
            launch: ``launch(kernel, dim, arguments)`` launches or records.
            passable: uint8 [rows, cells], `BLOCKED`, `OPEN` or `TIGHT`; cell = iy * width + ix, own width.
            row_of_item: int32 [items], the row of `passable` that a search runs on.
            grid_of_row: int32 [rows], which grid (map) a row has now.
            width, height: int32 [grids], cells of each grid along x and y.
        """
        launch(
            _search_distance,
            self.distance.shape[0],
            [
                passable,
                row_of_item,
                grid_of_row,
                width,
                height,
                self.sources,
                self.stop,
                self.next,
                self.previous,
                self.touched,
                self.distance,
            ],
        )


def geodesic_distance(passable: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
    """Travel distance from the nearest source to every cell of a batch of grids.

    Args:
        passable: bool or integer, shape [B, H, W] (rows along y, columns along x); nonzero = can be driven.
        sources: integer cell numbers iy * W + ix, shape [B] or [B, K], -1 = none; sources on blocked cells
            count for nothing.

    Returns:
        int32 [B, H, W]: 10 per straight and 14 per diagonal step, no corner cut; `UNREACHED` (2**30) where no
        source leads, blocked cells included. Divide by 10 and multiply by the cell size for metres.

    Raises:
        ValueError: wrong number of dimensions, batch sizes that differ, or a source outside the grid.
    """
    if passable.dim() != 3:
        raise ValueError(f"passable must have shape [B, H, W], got {tuple(passable.shape)}")
    if sources.dim() not in (1, 2) or sources.shape[0] != passable.shape[0]:
        raise ValueError(
            f"sources must have shape [B] or [B, K] with B = {passable.shape[0]}, got {tuple(sources.shape)}"
        )
    batch, height, width = passable.shape
    if passable.numel() == 0:
        return torch.empty(passable.shape, dtype=torch.int32, device=passable.device)
    if sources.numel() and (int(sources.max()) >= height * width or int(sources.min()) < -1):
        raise ValueError(f"sources must be cell numbers from -1 to H * W - 1 = {height * width - 1}")
    device = wp.get_device(str(passable.device))
    sources = sources.reshape(batch, -1).to(passable.device, torch.int32).contiguous()
    search = DistanceSearch(batch, height * width, max(sources.shape[1], 1), device)
    if sources.numel():
        search.sources = wp.from_torch(sources)
    mask = (passable != 0).to(torch.uint8).reshape(batch, -1).contiguous()
    maps = [wp.array(v, dtype=wp.int32, device=device) for v in (range(batch), [0] * batch, [width], [height])]
    finish_filling(device)
    search.search(
        launch_on(device),
        wp.from_torch(mask),
        *maps,
    )
    return wp.to_torch(search.distance).view(batch, height, width)
