"""Geodesic distances on navigation grids: how far it is to drive, not to fly.

Cells are numbered ``cell = iy * width + ix``. A step to a straight neighbour weighs 10, to a diagonal one 14
(chamfer weights: 8 % from Euclid at worst), and a diagonal step needs both straight cells beside it passable
(no cutting of corners). Distances are integers, so every run and every device gives the same bits.

Cells may be `TIGHT`, too near to obstacles for comfort: steps into them weigh `TIGHT_FACTOR` times as much.

The search is Dijkstra's, exact, with four plain queues in place of a heap: cells leave in order of distance, so
what steps of one weight (straight or diagonal, into open or tight cells) add to a queue of their own is in
order. The nearest of the four heads is the next cell. A cell enters each queue at most once (a later step of
the same weight is never shorter), and those for open or for tight cells only: two arrays as long as the grid,
filled from both ends, never overflow.
"""

from collections.abc import Callable
from functools import partial

import torch
import warp as wp

from maexp.kernels.launches import lanes_on

STRAIGHT = 10  # weight of a step to a straight neighbour; one cell of travel
DIAGONAL = 14  # weight of a step to a diagonal neighbour
UNREACHED = 1 << 30  # distance of cells that no source reaches; two of them still fit in int32

wp_straight = wp.constant(wp.int32(STRAIGHT))
wp_diagonal = wp.constant(wp.int32(DIAGONAL))
wp_unreached = wp.constant(wp.int32(UNREACHED))

BLOCKED, OPEN, TIGHT = 0, 1, 2  # states of a cell
TIGHT_FACTOR = 4  # a step into a tight cell weighs so much more: it is taken where the way around is long
wp_blocked = wp.constant(wp.uint8(BLOCKED))
wp_tight = wp.constant(wp.uint8(TIGHT))
wp_tight_factor = wp.constant(wp.int32(TIGHT_FACTOR))

SKIP = -2  # as the stop of a search: leave its distances as they are
wp_skip = wp.constant(wp.int32(SKIP))


@wp.kernel(enable_backward=False)
def _clear_distance(
    # Query:
    stop: wp.array(dtype=wp.int32),  # [item]
    lanes: int,
    # Out:
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
):
    item, lane = wp.tid()
    if stop[item] != wp_skip:
        for cell in range(lane, distance.shape[1], lanes):
            distance[item, cell] = wp_unreached


@wp.func
def _enter_cell(
    cell: wp.int32,
    value: wp.int32,
    tight: wp.int32,
    tails: wp.vec2i,
    passable: wp.array(dtype=wp.uint8),
    distance: wp.array(dtype=wp.int32),
    queue: wp.array(dtype=wp.int32),
):
    """Lowers a cell's label by a step of weight `value` from `distance`, queues it; returns the new tails.

    A queue holds open cells from its front and tight ones from its back: a cell is one or the other.
    """
    result = tails
    if passable[cell] == wp_tight:
        if value + tight < distance[cell]:
            distance[cell] = value + tight
            queue[queue.shape[0] - 1 - tails[1]] = cell
            result = wp.vec2i(tails[0], tails[1] + 1)
    elif value < distance[cell]:
        distance[cell] = value
        queue[tails[0]] = cell
        result = wp.vec2i(tails[0] + 1, tails[1])
    return result


@wp.func
def _step_cell(
    cell: wp.int32,
    d: wp.int32,
    weight: wp.int32,
    tails: wp.vec2i,
    passable: wp.array(dtype=wp.uint8),
    distance: wp.array(dtype=wp.int32),
    queue: wp.array(dtype=wp.int32),
):
    """Enters a cell by a step of `weight` from a cell at distance `d`, if it can be entered."""
    return _enter_cell(cell, d + weight, weight * (wp_tight_factor - 1), tails, passable, distance, queue)


@wp.kernel(enable_backward=False)
def _flood_distance(
    # Grid:
    passable: wp.array2d(dtype=wp.uint8),  # [row, cell], 0 blocked, 1 open, 2 tight
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    grid_of_row: wp.array(dtype=wp.int32),  # [row]
    width: wp.array(dtype=wp.int32),  # [grid]
    height: wp.array(dtype=wp.int32),  # [grid]
    # Query:
    sources: wp.array2d(dtype=wp.int32),  # [item, source], -1 = none
    stop: wp.array(dtype=wp.int32),  # [item], the search ends once this cell is settled; -1 = never; SKIP
    # Scratch:
    straight_queue: wp.array2d(dtype=wp.int32),  # [item, cell]
    diagonal_queue: wp.array2d(dtype=wp.int32),  # [item, cell]
    # Out:
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
):
    item = wp.tid()
    stop_cell = stop[item]
    if stop_cell == wp_skip:
        return
    row = row_of_item[item]
    w = width[grid_of_row[row]]
    cells = w * height[grid_of_row[row]]
    ok = passable[row]
    dist = distance[item]
    near = straight_queue[item]
    far = diagonal_queue[item]
    last = near.shape[0] - 1
    near_head = wp.vec2i(0, 0)  # of open cells, of tight cells
    near_tail = wp.vec2i(0, 0)
    far_head = wp.vec2i(0, 0)
    far_tail = wp.vec2i(0, 0)
    for i in range(sources.shape[1]):
        source = sources[item, i]
        if source >= 0 and source < cells:
            if ok[source] != wp_blocked and dist[source] != 0:
                dist[source] = 0
                if ok[source] == wp_tight:
                    near[last - near_tail[1]] = source
                    near_tail = wp.vec2i(near_tail[0], near_tail[1] + 1)
                else:
                    near[near_tail[0]] = source
                    near_tail = wp.vec2i(near_tail[0] + 1, near_tail[1])

    level = wp.int32(0)
    busy = wp.bool(True)
    while busy:
        # The nearest of four heads. A label may have dropped since the cell was queued: then another queue
        # holds it too, and taking it here with its final label is as good.
        d = wp_unreached
        cell = wp.int32(-1)
        which = wp.int32(-1)
        if near_head[0] < near_tail[0]:
            cell = near[near_head[0]]
            d = dist[cell]
            which = 0
        if far_head[0] < far_tail[0]:
            if dist[far[far_head[0]]] < d:
                cell = far[far_head[0]]
                d = dist[cell]
                which = 1
        if near_head[1] < near_tail[1]:
            if dist[near[last - near_head[1]]] < d:
                cell = near[last - near_head[1]]
                d = dist[cell]
                which = 2
        if far_head[1] < far_tail[1]:
            if dist[far[last - far_head[1]]] < d:
                cell = far[last - far_head[1]]
                d = dist[cell]
                which = 3
        if which == 0:
            near_head = wp.vec2i(near_head[0] + 1, near_head[1])
        elif which == 1:
            far_head = wp.vec2i(far_head[0] + 1, far_head[1])
        elif which == 2:
            near_head = wp.vec2i(near_head[0], near_head[1] + 1)
        else:
            far_head = wp.vec2i(far_head[0], far_head[1] + 1)
        busy = which >= 0 and cell != stop_cell
        if busy and d >= level:  # lower: settled before, through another queue
            level = d
            x = cell % w
            east = wp.bool(False)
            west = wp.bool(False)
            if x + 1 < w:
                east = ok[cell + 1] != wp_blocked
            if x > 0:
                west = ok[cell - 1] != wp_blocked
            if east:
                near_tail = _step_cell(cell + 1, d, wp_straight, near_tail, ok, dist, near)
            if west:
                near_tail = _step_cell(cell - 1, d, wp_straight, near_tail, ok, dist, near)
            for k in range(2):
                beside = cell + w - 2 * w * k
                if beside >= 0 and beside < cells:
                    if ok[beside] != wp_blocked:
                        near_tail = _step_cell(beside, d, wp_straight, near_tail, ok, dist, near)
                        if east:
                            if ok[beside + 1] != wp_blocked:
                                far_tail = _step_cell(beside + 1, d, wp_diagonal, far_tail, ok, dist, far)
                        if west:
                            if ok[beside - 1] != wp_blocked:
                                far_tail = _step_cell(beside - 1, d, wp_diagonal, far_tail, ok, dist, far)


class DistanceSearch:
    """Buffers and launches of a batch of distance searches, allocated once and used again at every call.

    Args:
        items: searches in a batch.
        cells: capacity of a grid, the largest width * height of the batch.
        num_sources: sources of one search.
        device: Warp device.

    Attributes:
        sources: int32 [items, num_sources], cell numbers, -1 = none. Fill before `launch`.
        stop: int32 [items], end each search once this cell is settled (farther labels are then upper
            bounds); -1 = search all; `SKIP` = do not search, leave the distances as they are.
        distance: int32 [items, cells], 10 a straight step; `UNREACHED` elsewhere.
    """

    def __init__(self, items: int, cells: int, num_sources: int = 1, device: str | wp.Device = "cpu"):
        self.sources = wp.full((items, num_sources), -1, dtype=wp.int32, device=device)
        self.stop = wp.full(items, -1, dtype=wp.int32, device=device)
        self.distance = wp.empty((items, cells), dtype=wp.int32, device=device)
        self.straight_queue = wp.empty((items, cells), dtype=wp.int32, device=device)
        self.diagonal_queue = wp.empty((items, cells), dtype=wp.int32, device=device)

    def search(
        self,
        launch: Callable,
        passable: wp.array,
        row_of_item: wp.array,
        grid_of_row: wp.array,
        width: wp.array,
        height: wp.array,
    ) -> None:
        """Fills `distance`.

        Args:
            launch: ``launch(kernel, dim, inputs, outputs)`` launches or records.
            passable: uint8 [rows, cells], `BLOCKED`, `OPEN` or `TIGHT`; cell = iy * width + ix, own width.
            row_of_item: int32 [items], the row of `passable` that a search runs on.
            grid_of_row: int32 [rows], which grid (map) a row has now.
            width, height: int32 [grids], cells of each grid along x and y.
        """
        items = self.distance.shape[0]
        lanes = lanes_on(self.distance.device, 256)
        launch(_clear_distance, (items, lanes), [self.stop, lanes], [self.distance])
        launch(
            _flood_distance, items,
            [passable, row_of_item, grid_of_row, width, height, self.sources, self.stop],
            [self.straight_queue, self.diagonal_queue, self.distance],
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
    search.search(
        partial(wp.launch, device=device),
        wp.from_torch(mask),
        wp.array(range(batch), dtype=wp.int32, device=device),
        wp.zeros(batch, dtype=wp.int32, device=device),
        wp.array([width], dtype=wp.int32, device=device),
        wp.array([height], dtype=wp.int32, device=device),
    )
    return wp.to_torch(search.distance).view(batch, height, width)
