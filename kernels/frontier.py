"""Frontiers: where what the team knows to be free borders on what it does not know.

A grid cell is `UNKNOWN`, `FREE` or `OBSTACLE`; a frontier cell is a free one that shares an edge with an
unknown one. What lies outside the grid is not unknown: nothing can ever be seen there.

Every cell is asked by itself, so none is missed and nothing is searched; `geodesic` names the searches.
"""

from collections.abc import Callable

import torch
import warp as wp

from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN
from maexp.kernels.launches import finish_filling, launch_on
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def is_frontier(known: wp.array2d(dtype=wp.uint8), row: int, x: int, y: int, w: int, h: int) -> wp.uint8:
    """1 for a frontier cell, else 0."""
    cell = y * w + x
    found = wp.uint8(0)
    if known[row, cell] == wp.uint8(FREE):
        if x > 0:
            if known[row, cell - 1] == wp.uint8(UNKNOWN):
                found = wp.uint8(1)
        if x + 1 < w:
            if known[row, cell + 1] == wp.uint8(UNKNOWN):
                found = wp.uint8(1)
        if y > 0:
            if known[row, cell - w] == wp.uint8(UNKNOWN):
                found = wp.uint8(1)
        if y + 1 < h:
            if known[row, cell + w] == wp.uint8(UNKNOWN):
                found = wp.uint8(1)
    return found


@wp.kernel
def _mark_frontier(
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    # Map:
    grid_of_row: wp.array(dtype=wp.int32),  # [row], -1: leave it as it is
    width: wp.array(dtype=wp.int32),  # [grid]
    height: wp.array(dtype=wp.int32),  # [grid]
    # Out:
    frontier: wp.array2d(dtype=wp.uint8),  # [row, cell]
):
    row, y = wp.tid()
    grid = grid_of_row[row]
    if grid < 0:
        return
    w = width[grid]
    h = height[grid]
    if y >= h:
        return
    for x in range(w):
        frontier[row, y * w + x] = is_frontier(known, row, x, y, w, h)
    if y == h - 1:
        for cell in range(w * h, known.shape[1]):
            frontier[row, cell] = wp.uint8(0)


def mark_frontier(
    known: wp.array,
    grid_of_row: wp.array,
    width: wp.array,
    height: wp.array,
    frontier: wp.array,
    tallest: int,
    launch: Callable | None = None,
):
    """Mark the frontier cells of a batch of grids of different sizes.

    Args:
        known: uint8 [rows, cells], `UNKNOWN`, `FREE` or `OBSTACLE`; cell = iy * width + ix, own width.
        grid_of_row: int32 [rows], which grid (map) a row has now; -1: leave its frontier as it is.
        width, height: int32 [grids], cells of each grid along x and y.
        frontier: uint8 [rows, cells], out: 1 on frontier cells, 0 elsewhere.
        tallest: cells of the tallest grid along y.
        launch: launches or records ``launch(kernel, dim, arguments)``; on the arrays' device.
    """
    launch = launch or launch_on(known.device)
    launch(_mark_frontier, (known.shape[0], tallest), [known, grid_of_row, width, height, frontier])


def frontier_cells(known_free: torch.Tensor, known_obstacle: torch.Tensor) -> torch.Tensor:
    """Frontier cells of a batch of grids.

    Args:
        known_free: bool or integer [B, H, W] (rows along y), nonzero = seen and free.
        known_obstacle: bool or integer [B, H, W], nonzero = seen and blocked; a cell that is both is blocked.

    Returns:
        bool [B, H, W]: free cells that share an edge with a cell neither free nor blocked.

    Raises:
        ValueError: shapes that differ or are not [B, H, W].
    """
    if known_free.dim() != 3 or known_free.shape != known_obstacle.shape:
        raise ValueError(
            "known_free and known_obstacle must have one shape [B, H, W], got "
            f"{tuple(known_free.shape)} and {tuple(known_obstacle.shape)}"
        )
    batch, height, width = known_free.shape
    if known_free.numel() == 0:
        return torch.zeros(known_free.shape, dtype=torch.bool, device=known_free.device)
    known = (known_free != 0).to(torch.uint8)
    known[known_obstacle != 0] = OBSTACLE
    known = known.view(batch, -1)
    frontier = torch.empty_like(known)
    device = wp.get_device(str(known.device))
    maps = [wp.array(v, dtype=wp.int32, device=device) for v in ([0] * batch, [width], [height])]
    finish_filling(device)
    mark_frontier(
        wp.from_torch(known),
        *maps,
        wp.from_torch(frontier),
        height,
    )
    return frontier.view(batch, height, width) != 0
