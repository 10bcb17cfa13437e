"""Voxels as bits: maps, and what robots know of them, as words of 32 layers for each column of voxels.

Column ``c = x * ny + y`` of a map has ``words`` words; bit ``b`` of word ``w`` is layer ``z = 32 * w + b``. Maps of a
batch differ in size: each counts columns by its own ``ny``, and arrays are as long as the largest needs.
"""

import warp as wp

from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)

CORNER = 0.03
"""Lines may cut corners of voxels by so much of a voxel."""


@wp.struct
class VoxelMaps:
    """Maps of the batch; M maps."""

    free: wp.array2d(dtype=wp.int32)  # [all columns, word]
    occupied: wp.array2d(dtype=wp.int32)  # [all columns, word]
    counted: wp.array2d(dtype=wp.int32)  # [all columns, word], the free voxels that coverage counts
    counted_surface: wp.array2d(dtype=wp.int32)  # [all columns, word], the occupied ones
    begin: wp.array(dtype=wp.int32)  # [M], first column
    size: wp.array(dtype=wp.vec3i)  # [M], voxels along x, y, z
    origin: wp.array(dtype=wp.vec3)  # [M], lowest corner [m]
    resolution: wp.array(dtype=wp.float32)  # [M], side of a voxel [m]


@wp.func
def bit_of(z: int) -> wp.uint32:
    """Bit of a layer in its word."""
    return wp.uint32(1) << wp.uint32(z % 32)


@wp.func
def is_inside(size: wp.vec3i, x: int, y: int, z: int) -> bool:
    return x >= 0 and y >= 0 and z >= 0 and x < size[0] and y < size[1] and z < size[2]


@wp.func
def has_bit(words: wp.array2d(dtype=wp.int32), column: int, z: int) -> bool:
    return (wp.uint32(words[column, z / 32]) & bit_of(z)) != wp.uint32(0)


@wp.func
def set_bit(words: wp.array2d(dtype=wp.int32), column: int, z: int):
    words[column, z / 32] = int(wp.uint32(words[column, z / 32]) | bit_of(z))


@wp.func
def voxel_of(maps: VoxelMaps, m: int, p: wp.vec3) -> wp.vec3i:
    """The voxel that holds a point [m]."""
    q = (p - maps.origin[m]) / maps.resolution[m]
    return wp.vec3i(int(wp.floor(q[0])), int(wp.floor(q[1])), int(wp.floor(q[2])))


@wp.func
def next_wall(at: float, step: float) -> float:
    """How far along a line, in shares of it, the first wall between voxels is."""
    if step > 0.0:
        return (wp.floor(at) + 1.0 - at) / step
    if step < 0.0:
        return (at - wp.floor(at)) / -step
    return wp.inf


@wp.func
def all_set(words: wp.array2d(dtype=wp.int32), first: int, size: wp.vec3i, a: wp.vec3, b: wp.vec3, value: bool) -> bool:
    """Whether all voxels on the straight line from a to b [voxels] have their bits set (``value``), or none has.

    Those outside are not set. Voxels of which the line cuts off less than `CORNER` do not count: it may pass from one
    to another over their edge. ``first`` is the first of the map's columns.
    """
    d = b - a
    at = wp.vec3i(int(wp.floor(a[0])), int(wp.floor(a[1])), int(wp.floor(a[2])))
    end = wp.vec3i(int(wp.floor(b[0])), int(wp.floor(b[1])), int(wp.floor(b[2])))
    to = wp.vec3(next_wall(a[0], d[0]), next_wall(a[1], d[1]), next_wall(a[2], d[2]))
    near = CORNER / wp.max(wp.length(d), 1.0e-6)
    steps = wp.abs(end[0] - at[0]) + wp.abs(end[1] - at[1]) + wp.abs(end[2] - at[2])
    for _k in range(steps + 1):
        found = wp.bool(False)
        if is_inside(size, at[0], at[1], at[2]):
            found = has_bit(words, first + at[0] * size[1] + at[1], at[2])
        if found != value:
            return False
        if at[0] == end[0] and at[1] == end[1] and at[2] == end[2]:
            return True
        if at[0] == end[0]:
            to[0] = wp.inf
        if at[1] == end[1]:
            to[1] = wp.inf
        if at[2] == end[2]:
            to[2] = wp.inf
        until = wp.min(wp.min(to[0], to[1]), to[2]) + near
        for axis in range(3):
            if to[axis] <= until:
                at[axis] = at[axis] + int(wp.sign(d[axis]))
                to[axis] = to[axis] + 1.0 / wp.abs(d[axis])
    return True
