"""Geodesic distances on navigation grids: how far it is to drive, not to fly.

Cells are numbered ``cell = iy * width + ix``. A step to a straight neighbour weighs 10, to a diagonal one 14
(chamfer weights: 8 % from Euclid at worst), and a diagonal step needs both straight cells beside it passable
(no cutting of corners). Distances are integers, so every run and every device gives the same bits.

The search is Dijkstra's, exact, with two plain queues in place of a heap: cells leave in order of distance,
so what steps of weight 10 add to one queue is in order, and so is what steps of weight 14 add to the other.
The nearer of the two heads is the next cell. A cell enters each queue at most once (a later step of the same
weight is never shorter): queues as long as the grid never overflow.
"""

from collections.abc import Callable
from functools import partial

import torch
import warp as wp

STRAIGHT = 10  # weight of a step to a straight neighbour; one cell of travel
DIAGONAL = 14  # weight of a step to a diagonal neighbour
UNREACHED = 1 << 30  # distance of cells that no source reaches; two of them still fit in int32

wp_straight = wp.constant(wp.int32(STRAIGHT))
wp_diagonal = wp.constant(wp.int32(DIAGONAL))
wp_unreached = wp.constant(wp.int32(UNREACHED))

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
def _relax_cell(
    cell: wp.int32,
    value: wp.int32,
    tail: wp.int32,
    distance: wp.array(dtype=wp.int32),
    queue: wp.array(dtype=wp.int32),
):
    """Lowers the label of `cell` to `value` where that is shorter and queues it; returns the new tail."""
    new_tail = tail
    if value < distance[cell]:
        distance[cell] = value
        queue[tail] = cell
        new_tail = tail + 1
    return new_tail


@wp.kernel(enable_backward=False)
def _flood_distance(
    # Grid:
    passable: wp.array2d(dtype=wp.uint8),  # [row, cell]
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
    grid = grid_of_row[row]
    w = width[grid]
    h = height[grid]
    ok = passable[row]
    dist = distance[item]
    near = straight_queue[item]
    far = diagonal_queue[item]

    near_head = wp.int32(0)
    near_tail = wp.int32(0)
    far_head = wp.int32(0)
    far_tail = wp.int32(0)
    for i in range(sources.shape[1]):
        source = sources[item, i]
        if source >= 0 and source < w * h:
            if ok[source] != wp.uint8(0):
                near_tail = _relax_cell(source, wp.int32(0), near_tail, dist, near)

    level = wp.int32(0)
    while near_head < near_tail or far_head < far_tail:
        # A label may have dropped since the cell was queued: then the other queue holds it too, and taking it
        # here with its final label is as good.
        d = wp_unreached
        cell = wp.int32(-1)
        if near_head < near_tail:
            cell = near[near_head]
            d = dist[cell]
        use_far = wp.bool(False)
        if far_head < far_tail:
            if dist[far[far_head]] < d:
                cell = far[far_head]
                d = dist[cell]
                use_far = True
        if use_far:
            far_head += 1
        else:
            near_head += 1
        if d >= level:  # lower: settled before, through the other queue
            level = d
            if cell == stop_cell:
                break
            x = cell % w
            east = wp.bool(False)
            west = wp.bool(False)
            north = wp.bool(False)
            south = wp.bool(False)
            if x + 1 < w:
                east = ok[cell + 1] != wp.uint8(0)
            if x > 0:
                west = ok[cell - 1] != wp.uint8(0)
            if cell + w < w * h:
                north = ok[cell + w] != wp.uint8(0)
            if cell >= w:
                south = ok[cell - w] != wp.uint8(0)
            if east:
                near_tail = _relax_cell(cell + 1, d + wp_straight, near_tail, dist, near)
            if west:
                near_tail = _relax_cell(cell - 1, d + wp_straight, near_tail, dist, near)
            if north:
                near_tail = _relax_cell(cell + w, d + wp_straight, near_tail, dist, near)
                if east:
                    if ok[cell + w + 1] != wp.uint8(0):
                        far_tail = _relax_cell(cell + w + 1, d + wp_diagonal, far_tail, dist, far)
                if west:
                    if ok[cell + w - 1] != wp.uint8(0):
                        far_tail = _relax_cell(cell + w - 1, d + wp_diagonal, far_tail, dist, far)
            if south:
                near_tail = _relax_cell(cell - w, d + wp_straight, near_tail, dist, near)
                if east:
                    if ok[cell - w + 1] != wp.uint8(0):
                        far_tail = _relax_cell(cell - w + 1, d + wp_diagonal, far_tail, dist, far)
                if west:
                    if ok[cell - w - 1] != wp.uint8(0):
                        far_tail = _relax_cell(cell - w - 1, d + wp_diagonal, far_tail, dist, far)


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
            passable: uint8 [rows, cells], 0 = blocked; cell = iy * width + ix with the grid's own width.
            row_of_item: int32 [items], the row of `passable` that a search runs on.
            grid_of_row: int32 [rows], which grid (map) a row has now.
            width, height: int32 [grids], cells of each grid along x and y.
        """
        items = self.distance.shape[0]
        lanes = 1 if self.distance.device.is_cpu else 256
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
