"""What a sensor can see of a map from where robots can be, and room on a whole map."""

import numpy as np
import torch
import warp as wp

from maexp.kernels.launches import launch_on
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.volume.grid import has_bit, is_inside
from maexp.kernels.volume.rays import RayTrees

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _mark_seeable(
    # Map:
    size: wp.vec3i,
    free: wp.array2d(dtype=wp.int32),  # [column, word]
    occupied: wp.array2d(dtype=wp.int32),  # [column, word]
    # In:
    place: wp.array(dtype=wp.vec3i),  # [place], voxels
    octant: wp.array(dtype=wp.int32),  # [place]
    offset: wp.array(dtype=wp.vec3i),  # [entry]
    skip: wp.array(dtype=wp.int32),  # [entry]
    begin: wp.array(dtype=wp.int32),  # [eighth]
    # In and out:
    seeable: wp.array2d(dtype=wp.int32),  # [column, word]
    surface: wp.array2d(dtype=wp.int32),  # [column, word]
):
    k = wp.tid()
    v = place[k]
    n = begin[octant[k]]
    while n < begin[octant[k] + 1]:
        d = offset[n]
        x = v[0] + d[0]
        y = v[1] + d[1]
        z = v[2] + d[2]
        passes = wp.bool(False)
        if is_inside(size, x, y, z):
            c = x * size[1] + y
            bit = int(wp.uint32(1) << wp.uint32(z % 32))
            if has_bit(free, c, z):
                wp.atomic_or(seeable, c, z / 32, bit)
                passes = True
            elif has_bit(occupied, c, z):
                wp.atomic_or(surface, c, z / 32, bit)
        if passes:
            n += 1
        else:
            n = skip[n]


def mark_seeable(
    shape: tuple[int, int, int], free: np.ndarray, occupied: np.ndarray, places: np.ndarray, trees: RayTrees
) -> tuple[np.ndarray, np.ndarray]:
    """Free and occupied voxels that are seen from places.

    Args:
        shape: voxels along x, y, z.
        free, occupied: words, int32 [columns, words].
        places: voxels, int [K, 3]; rays start in their eighths in turn.
        trees: of the sensor.

    Returns:
        Words of both, int32 [columns, words].
    """
    seen = [torch.zeros(free.shape, dtype=torch.int32) for _ in range(2)]
    arrays = [
        wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=kind, device="cpu")
        for values, kind in (
            (free, wp.int32),
            (occupied, wp.int32),
            (places, wp.vec3i),
            (np.arange(len(places)) % 8, wp.int32),
            (trees.offset, wp.vec3i),
            (trees.skip, wp.int32),
            (trees.begin, wp.int32),
        )
    ]
    launch_on("cpu")(_mark_seeable, len(places), [wp.vec3i(*shape), *arrays, *map(wp.from_torch, seen)])
    return seen[0].numpy(), seen[1].numpy()
