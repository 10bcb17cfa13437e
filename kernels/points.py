"""Kernels for points in the plane and in space: one source, compiled for either kind of vector."""

from typing import Any

import warp as wp

VECTORS: dict[int, Any] = {2: wp.vec2, 3: wp.vec3}
"""Warp's vector of so many coordinates."""


def for_points(kernel: wp.Kernel) -> dict[int, wp.Kernel]:
    """A kernel whose arrays of ``dtype=Any`` hold points, for each number of coordinates in `VECTORS`."""
    generic = [argument for argument in kernel.adj.args if getattr(argument.type, "dtype", None) is Any]
    return {
        size: wp.overload(kernel, {a.label: wp.array(dtype=vector, ndim=a.type.ndim) for a in generic})
        for size, vector in VECTORS.items()
    }
