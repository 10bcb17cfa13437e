"""Goals of robots: where each goes that has chosen a target or none, and goals as the paper's regions and offsets.

Numbers at random come from (seed, env, episode, macro step) alone: no generator's state, and the same for env i in any
batch.
"""

import warp as wp

from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.occupancy_grid import NavGrids, nav_center
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import REGIONS

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _draw_uniform(
    # State in:
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    macro_step: wp.array(dtype=wp.int32),  # [env]
    # Out:
    draw: wp.array3d(dtype=wp.float32),  # [env, robot, number]
):
    e, i, k = wp.tid()
    draw[e, i, k] = keyed_uniform(seed[0], env_id[e], episode[e], macro_step[e], i * draw.shape[2] + k)


@wp.kernel
def _aim(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    lower: wp.array(dtype=wp.vec2),  # [map]
    upper: wp.array(dtype=wp.vec2),  # [map]
    # State in:
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    macro_step: wp.array(dtype=wp.int32),  # [env]
    # In:
    chosen: wp.array2d(dtype=wp.int64),  # [env, robot], -1 = no target: it goes anywhere
    # In and out:
    cell: wp.array2d(dtype=wp.int64),  # [env, robot], where the target is; -1 without one
    # Out:
    toward: wp.array2d(dtype=wp.vec2),  # [env, robot], 0 without a target, else as it is
    target: wp.array2d(dtype=wp.vec2),  # [env, robot] [m]
):
    e, i = wp.tid()
    m = map_id[e]
    if chosen[e, i] >= wp.int64(0):
        target[e, i] = nav_center(grids, m, int(cell[e, i]))
    else:
        x = keyed_uniform(seed[0], env_id[e], episode[e], macro_step[e], 2 * i)
        y = keyed_uniform(seed[0], env_id[e], episode[e], macro_step[e], 2 * i + 1)
        cell[e, i] = wp.int64(-1)
        toward[e, i] = wp.vec2(0.0, 0.0)
        target[e, i] = lower[m] + wp.cw_mul(wp.vec2(x, y), upper[m] - lower[m])


@wp.func
def region_point(lower: wp.vec2, upper: wp.vec2, region: int, offset: wp.vec2) -> wp.vec2:
    """A place in a region (ix * REGIONS + iy): its centre + offset * half a region [m]."""
    half = (upper - lower) / (2.0 * float(REGIONS))
    x = lower[0] + half[0] * (float(2 * (region / REGIONS) + 1) + wp.clamp(offset[0], -1.0, 1.0))
    y = lower[1] + half[1] * (float(2 * (region % REGIONS) + 1) + wp.clamp(offset[1], -1.0, 1.0))
    return wp.vec2(x, y)


@wp.kernel
def _from_regions(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    lower: wp.array(dtype=wp.vec2),  # [map]
    upper: wp.array(dtype=wp.vec2),  # [map]
    # In:
    region: wp.array2d(dtype=wp.int64),  # [env, robot]
    offset: wp.array2d(dtype=wp.vec2),  # [env, robot], from -1 to 1
    # Out:
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot] [m]
):
    """Goals of the paper's action; NaN where an offset is not finite."""
    e, i = wp.tid()
    m = map_id[e]
    o = offset[e, i]
    if wp.isfinite(o[0]) and wp.isfinite(o[1]):
        r = int(wp.clamp(region[e, i], wp.int64(0), wp.int64(REGIONS * REGIONS - 1)))
        goal[e, i] = region_point(lower[m], upper[m], r, o)
    else:
        goal[e, i] = wp.vec2(wp.nan, wp.nan)


@wp.func
def split(at: float, lower: float, side: float):
    """Number of the interval that a coordinate lies in, of `REGIONS`, and where in it, from -1 to 1."""
    share = (at - lower) / wp.max(side, 1.0e-9) * float(REGIONS)
    index = wp.clamp(wp.floor(share), 0.0, float(REGIONS - 1))
    return int(index), wp.clamp((share - index) * 2.0 - 1.0, -1.0, 1.0)


@wp.kernel
def _to_regions(
    # Map:
    map_id: wp.array(dtype=wp.int32),  # [env]
    lower: wp.array(dtype=wp.vec2),  # [map]
    upper: wp.array(dtype=wp.vec2),  # [map]
    # In:
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot] [m]
    # Out:
    region: wp.array2d(dtype=wp.int64),  # [env, robot]
    offset: wp.array2d(dtype=wp.vec2),  # [env, robot], from -1 to 1
):
    """The paper's action that leads nearest to goals."""
    e, i = wp.tid()
    low = lower[map_id[e]]
    side = upper[map_id[e]] - low
    x, right = split(goal[e, i][0], low[0], side[0])
    y, up = split(goal[e, i][1], low[1], side[1])
    region[e, i] = wp.int64(x * REGIONS + y)
    offset[e, i] = wp.vec2(right, up)
