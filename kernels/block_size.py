"""How large the blocks are in which frontier cells are gathered, in the simulator and on robots.

Needs only NumPy: robots' computers have neither Warp nor torch.
"""

import numpy as np

BLOCKS_PER_SIDE = 4.0
"""Blocks along the radar's range, or along the longer side of a map that is smaller than the range."""


def block_sides(
    cell: np.ndarray | float, reach: float, width: np.ndarray | float, height: np.ndarray | float
) -> np.ndarray:
    """Edges of blocks, int32, in cells.

    A radar that reaches far beyond the map would otherwise gather all of it in one block: one target for all robots.

    Args:
        cell: edges of the grids' cells [m].
        reach: how far the radar sees [m].
        width, height: of the grids in cells; inf where nobody knows yet how large the place is.
    """
    span = np.minimum(np.float32(reach) / np.asarray(cell, np.float32), np.maximum(width, height))
    return np.maximum(2, np.round(span / BLOCKS_PER_SIDE)).astype(np.int32)
