"""Warp kernels of the simulation, and single ones as functions of torch tensors.

Warp compiles a kernel at its first launch and keeps the result in a cache, so only a machine's
first run waits.
"""

from maexp.kernels.startup import start_warp

start_warp()

from maexp.kernels.api import merge_maps, received_power, unpack_flags, visible_points
from maexp.kernels.frontier import frontier_cells
from maexp.kernels.geodesic import geodesic_distance

__all__ = [
    "frontier_cells", "geodesic_distance", "merge_maps", "received_power", "unpack_flags", "visible_points"
]  # fmt: skip
