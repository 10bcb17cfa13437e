"""Warp kernels of the simulation, and single ones as functions of torch tensors.

Warp compiles a kernel at its first launch and keeps the result in a cache, so only a machine's
first run waits.
"""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # its banner would stand in every table and pipe
wp.init()

from maexp.kernels.api import merge_maps, unpack_flags, visible_points  # noqa: E402
from maexp.kernels.frontier import frontier_cells  # noqa: E402
from maexp.kernels.geodesic import geodesic_distance  # noqa: E402

__all__ = ["frontier_cells", "geodesic_distance", "merge_maps", "unpack_flags", "visible_points"]
