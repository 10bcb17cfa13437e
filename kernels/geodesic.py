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
from maexp.kernels.constants import UNREACHED
from maexp.kernels.cpp_snippets import search_from
from maexp.kernels.launches import finish_filling, launch_on
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


SKIP = -2  # as the stop of a search: leave its distances as they are


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
