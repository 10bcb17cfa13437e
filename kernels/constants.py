"""Numbers that the kernels share with what computes the same without Warp (`maexp.agents.deploy.planner`).

Imports nothing: robots' computers have neither Warp nor torch.
"""

import numpy as np

DT = 0.1  # length of a local step [s]

# What is known of a cell.
UNKNOWN, FREE, OBSTACLE = 0, 1, 2

# Ways: distances are integers, a step weighs `STRAIGHT` or `DIAGONAL`.
STRAIGHT = 10  # weight of a step to a straight neighbour; one cell of travel
DIAGONAL = 14  # weight of a step to a diagonal neighbour
BLOCKED, OPEN, TIGHT = 0, 1, 2  # states of a cell
TIGHT_FACTOR = 4  # a step into a tight cell weighs so much more: it is taken where the way around is long
UNREACHED = 1 << 30  # distance of cells that no source reaches; two of them still fit in int32
MARGIN_CELLS = 0.5  # distance kept from obstacles beyond the collision threshold, in cells
COMFORT = 2.0  # cells nearer to obstacles than this many clearances are tight: taken where a detour is long
SNAP_CELLS = 4  # how far a search may start from a robot that stands on a blocked cell, in cells along x and y

# Signals (`maexp.kernels.radio`).
LOSS = 31.0  # along the first cells [dB]
BLOCKED_LOSS = 40.0  # of ten times as many blocked cells [dB]
CLEAR_LOSS = 20.0  # of ten times as many clear cells [dB]
CLEAR_CELLS = 35.0  # up to so many cost nothing more
NUDGE = 1e-4  # added to places on a line, in cells: rounding must not decide on which side of an edge they lie

# Targets.
RAYS = 48  # rays that look around from a target


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
