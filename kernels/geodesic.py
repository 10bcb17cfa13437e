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
"""

from collections.abc import Callable

import torch
import warp as wp

from maexp.kernels.launches import finish_filling, launch_on

wp.set_module_options({"enable_backward": False})  # nobody differentiates: half the time to compile

STRAIGHT = 10  # weight of a step to a straight neighbour; one cell of travel
DIAGONAL = 14  # weight of a step to a diagonal neighbour
UNREACHED = 1 << 30  # distance of cells that no source reaches; two of them still fit in int32


BLOCKED, OPEN, TIGHT = 0, 1, 2  # states of a cell
TIGHT_FACTOR = 4  # a step into a tight cell weighs so much more: it is taken where the way around is long
TIGHT_STRAIGHT = TIGHT_FACTOR * STRAIGHT
TIGHT_DIAGONAL = TIGHT_FACTOR * DIAGONAL

BUCKETS = 64  # more than half the most that a step may add to a key, and a power of two
LAST_BUCKET = BUCKETS - 1

SKIP = -2  # as the stop of a search: leave its distances as they are


@wp.func
def least_distance(x: int, y: int, end_x: int, end_y: int) -> int:
    """Distance between two cells if nothing is in the way; 0 without an end (-1)."""
    if end_x < 0:
        return 0
    dx = wp.abs(x - end_x)
    dy = wp.abs(y - end_y)
    return STRAIGHT * wp.max(dx, dy) + (DIAGONAL - STRAIGHT) * wp.min(dx, dy)


@wp.func
def _lower_label(
    cell: int,
    x: int,
    y: int,
    value: int,
    end: wp.vec2i,
    distance: wp.array(dtype=wp.int32),
    after: wp.array(dtype=wp.int32),
    before: wp.array(dtype=wp.int32),
    bucket: wp.array(dtype=wp.int32),
) -> int:
    """Lower a cell's label, if `value` is lower, and move it to the bucket of its key; return how many joined."""
    old = distance[cell]
    if value >= old:
        return 0
    distance[cell] = value
    left = least_distance(x, y, end[0], end[1])
    if old < UNREACHED:  # it waits in the bucket of its old key
        ahead = after[cell]
        behind = before[cell]
        if behind < 0:
            bucket[((old + left) >> 1) & LAST_BUCKET] = ahead
        else:
            after[behind] = ahead
        if ahead >= 0:
            before[ahead] = behind
    slot = ((value + left) >> 1) & LAST_BUCKET
    head = bucket[slot]
    after[cell] = head
    before[cell] = -1
    if head >= 0:
        before[head] = cell
    bucket[slot] = cell
    return wp.where(old < UNREACHED, 0, 1)


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
    next: wp.array2d(dtype=wp.int32),  # [item, cell], of its bucket's list
    previous: wp.array2d(dtype=wp.int32),  # [item, cell]
    buckets: wp.array2d(dtype=wp.int32),  # [item, bucket], first cell; -1 = none
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
    ok = passable[row]
    dist = distance[item]
    after = next[item]
    before = previous[item]
    bucket = buckets[item]
    for cell in range(touched[item, 0], touched[item, 1] + 1):
        dist[cell] = UNREACHED
    for k in range(BUCKETS):
        bucket[k] = -1
    end = wp.vec2i(-1, -1)
    if goal >= 0:
        end = wp.vec2i(goal % w, goal / w)
    lowest = wp.int32(w * h)
    highest = wp.int32(-1)
    waiting = wp.int32(0)
    key = wp.int32(UNREACHED)
    for i in range(sources.shape[1]):
        source = sources[item, i]
        if source >= 0 and source < w * h:
            if ok[source] != wp.uint8(BLOCKED):
                waiting += _lower_label(source, source % w, source / w, 0, end, dist, after, before, bucket)
                key = wp.min(key, least_distance(source % w, source / w, end[0], end[1]))
                lowest = wp.min(lowest, source)
                highest = wp.max(highest, source)
    limit = wp.int32(2147483646)
    while waiting > 0 and key <= limit:
        slot = (key >> 1) & LAST_BUCKET
        cell = bucket[slot]
        if cell < 0:
            key += 2
        else:
            ahead = after[cell]
            bucket[slot] = ahead
            if ahead >= 0:
                before[ahead] = -1
            waiting -= 1
            d = dist[cell]
            x = cell % w
            y = cell / w
            lowest = wp.min(lowest, cell)
            highest = wp.max(highest, cell)
            if cell == goal:
                limit = d
            east = wp.bool(False)
            west = wp.bool(False)
            if x + 1 < w:
                east = ok[cell + 1] != wp.uint8(BLOCKED)
            if x > 0:
                west = ok[cell - 1] != wp.uint8(BLOCKED)
            if east:
                value = d + wp.where(ok[cell + 1] == wp.uint8(TIGHT), TIGHT_STRAIGHT, STRAIGHT)
                waiting += _lower_label(cell + 1, x + 1, y, value, end, dist, after, before, bucket)
            if west:
                value = d + wp.where(ok[cell - 1] == wp.uint8(TIGHT), TIGHT_STRAIGHT, STRAIGHT)
                waiting += _lower_label(cell - 1, x - 1, y, value, end, dist, after, before, bucket)
            for k in range(2):
                v = y + 1 - 2 * k
                if v >= 0 and v < h:
                    beside = v * w + x
                    if ok[beside] != wp.uint8(BLOCKED):
                        value = d + wp.where(ok[beside] == wp.uint8(TIGHT), TIGHT_STRAIGHT, STRAIGHT)
                        waiting += _lower_label(beside, x, v, value, end, dist, after, before, bucket)
                        if east:
                            if ok[beside + 1] != wp.uint8(BLOCKED):
                                value = d + wp.where(ok[beside + 1] == wp.uint8(TIGHT), TIGHT_DIAGONAL, DIAGONAL)
                                waiting += _lower_label(beside + 1, x + 1, v, value, end, dist, after, before, bucket)
                        if west:
                            if ok[beside - 1] != wp.uint8(BLOCKED):
                                value = d + wp.where(ok[beside - 1] == wp.uint8(TIGHT), TIGHT_DIAGONAL, DIAGONAL)
                                waiting += _lower_label(beside - 1, x - 1, v, value, end, dist, after, before, bucket)
    # Labels lie at most one row and one column beyond the cells that were left.
    touched[item, 0] = wp.max(lowest - w - 1, 0)
    touched[item, 1] = wp.min(highest + w + 1, w * h - 1)


class DistanceSearch:
    """Buffers and launches of a batch of distance searches, allocated once and used again at every call.

    Args:
        items: searches in a batch.
        cells: capacity of a grid, the largest width * height of the batch.
        num_sources: sources of one search.
        device: Warp device.

    Attributes:
        sources: int32 [items, num_sources], cell numbers, -1 = none. Fill before `launch`.
        stop: int32 [items], the one cell whose distance is wanted (other labels are upper bounds, but exact on all
            shortest ways to it); -1 = search all; `SKIP` = do not search, leave the distances as they are.
        distance: int32 [items, cells], 10 a straight step; `UNREACHED` elsewhere.
    """

    def __init__(self, items: int, cells: int, num_sources: int = 1, device: str | wp.Device = "cpu"):
        def numbers(*shape, value=0):
            return wp.full(shape, value, dtype=wp.int32, device=device)

        self.sources = numbers(items, num_sources, value=-1)
        self.stop = numbers(items, value=-1)
        self.distance = numbers(items, cells, value=UNREACHED)
        self.next, self.previous = numbers(items, cells), numbers(items, cells)
        self.buckets = numbers(items, BUCKETS)
        self.touched = numbers(items, 2)  # cell 0 is cleared in vain once

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
            launch: ``launch(kernel, dim, inputs, outputs)`` launches or records.
            passable: uint8 [rows, cells], `BLOCKED`, `OPEN` or `TIGHT`; cell = iy * width + ix, own width.
            row_of_item: int32 [items], the row of `passable` that a search runs on.
            grid_of_row: int32 [rows], which grid (map) a row has now.
            width, height: int32 [grids], cells of each grid along x and y.
        """
        launch(
            _search_distance, self.distance.shape[0],
            [passable, row_of_item, grid_of_row, width, height, self.sources, self.stop],
            [self.next, self.previous, self.buckets, self.touched, self.distance],
        )  # fmt: skip


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
