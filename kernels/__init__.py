"""Warp kernels of the simulation, and single ones as functions of torch tensors.

Warp compiles a kernel at its first launch and keeps the result in a cache, so only a machine's
first run waits. Names are looked up on first use: `constants` and `lazy` do without Warp.
"""

from maexp.kernels.lazy import lazy_names

_HOMES = {
    "frontier_cells": "frontier",
    "geodesic_distance": "geodesic",
    "merge_maps": "api",
    "received_power": "api",
    "unpack_flags": "api",
    "visible_points": "api",
}
__all__ = ["frontier_cells", "geodesic_distance", "merge_maps", "received_power", "unpack_flags", "visible_points"]

__getattr__ = lazy_names(__name__, _HOMES)
