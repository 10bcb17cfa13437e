"""What robots see: voxels on the rays of their sensors, up to the first that is occupied."""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.volume.grid import VoxelMaps, is_inside, set_bit, voxel_of

wp.set_module_options(MODULE_OPTIONS)

NEAR = 2.0
"""Voxels this near are in view whichever way a sensor looks: they are under it."""
WIDER = 1.5
"""Rays are followed through voxels so far beside a view: what lies behind may be within it."""


@wp.struct
class Sensors:
    """Sensors of a team's robots: each has trees of rays (`rays.RayTrees`), on each map its own."""

    offset: wp.array(dtype=wp.vec3i)  # [entry]
    skip: wp.array(dtype=wp.int32)  # [entry], within its tree
    begin: wp.array4d(dtype=wp.int32)  # [2, map, robot, 9], first entry of each eighth's tree; first those of a reset
    reach: wp.array(dtype=wp.float32)  # [robot], of scans and of a reset's [m]
    cos_fov: wp.array(dtype=wp.float32)  # [robot], of half the view to the sides; -2: all around
    every: wp.array(dtype=wp.int32)  # [robot], local steps from one scan to the next


@wp.func
def octant_of(maps: VoxelMaps, m: int, p: wp.vec3) -> int:
    """Which eighth of its voxel a point is in."""
    q = (p - maps.origin[m]) / maps.resolution[m]
    x = wp.where(q[0] - wp.floor(q[0]) >= 0.5, 1, 0)
    y = wp.where(q[1] - wp.floor(q[1]) >= 0.5, 2, 0)
    z = wp.where(q[2] - wp.floor(q[2]) >= 0.5, 4, 0)
    return x + y + z


@wp.func
def is_ahead(d: wp.vec3i, ahead: wp.vec2, cos_fov: float, near: float) -> bool:
    """Whether a voxel at an offset is within a view to the sides."""
    flat = wp.vec2(float(d[0]), float(d[1]))
    size = wp.length(flat)
    return size <= near or wp.dot(flat, ahead) >= cos_fov * size


@wp.func
def leads_ahead(d: wp.vec3i, ahead: wp.vec2, cos_fov: float) -> bool:
    """Whether rays through a voxel at an offset may come to others within a view to the sides."""
    flat = wp.vec2(float(d[0]), float(d[1]))
    sin_fov = wp.sqrt(wp.max(1.0 - cos_fov * cos_fov, 0.0))
    fore = wp.dot(flat, ahead)
    side = wp.abs(flat[0] * ahead[1] - flat[1] * ahead[0])
    return fore * cos_fov + side * sin_fov >= 0.0 and side * cos_fov - fore * sin_fov <= WIDER


@wp.func
def is_due(sensors: Sensors, i: int, step: int) -> bool:
    """Whether robot i scans at the end of local step ``step``, counted from 1; 0: the scan of a reset."""
    return step % sensors.every[i] == 0


@wp.kernel
def _scan(
    # Map:
    maps: VoxelMaps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    sensors: Sensors,
    ahead: int,  # 1: the local step is not yet counted
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    # Scratch in and out:
    visible_free: wp.array4d(dtype=wp.int32),  # [env, robot, column, word], 0 before
    visible_surface: wp.array4d(dtype=wp.int32),  # [env, robot, column, word], 0 before
):
    e, i = wp.tid()
    if active[e] == 0 or failed[e, i] != 0 or not is_due(sensors, i, local_step[e] + ahead):
        return
    m = map_id[e]
    size = maps.size[m]
    p = center[e, i]
    v = voxel_of(maps, m, p)
    octant = octant_of(maps, m, p)
    free = visible_free[e, i]
    surface = visible_surface[e, i]
    look = wp.vec2(wp.cos(pose[e, i][3]), wp.sin(pose[e, i][3]))
    limited = sensors.cos_fov[i] > -1.5
    base = maps.begin[m]
    for kind in range(ahead, 2):  # a reset looks around nearby, then as ever
        first = sensors.begin[kind, m, i, 0]
        k = sensors.begin[kind, m, i, octant]
        end = sensors.begin[kind, m, i, octant + 1]
        while k < end:
            d = sensors.offset[k]
            on = wp.bool(True)
            follow = wp.bool(True)
            if limited and kind == 1:
                on = is_ahead(d, look, sensors.cos_fov[i], NEAR)
                follow = on or leads_ahead(d, look, sensors.cos_fov[i])
            x = v[0] + d[0]
            y = v[1] + d[1]
            z = v[2] + d[2]
            passes = wp.bool(False)
            if follow and is_inside(size, x, y, z):
                c = x * size[1] + y
                w = z / 32
                bit = wp.uint32(1) << wp.uint32(z % 32)
                if (wp.uint32(maps.free[base + c, w]) & bit) != wp.uint32(0):
                    if on:
                        free[c, w] = int(wp.uint32(free[c, w]) | bit)
                    passes = True
                elif on and (wp.uint32(maps.occupied[base + c, w]) & bit) != wp.uint32(0):
                    set_bit(surface, c, z)
            if passes:
                k += 1
            else:
                k = first + sensors.skip[k]


def scan(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """Mark what robots see, in the envs where ``running`` [env] is set."""
    shard.call(launch, _scan, active=running, ahead=ahead)
