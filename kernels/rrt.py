"""Rapidly-exploring random trees that look for frontiers: a branch that leaves what is known has found one.

A tree grows from every robot over its passable cells. Coordinates are in cells of the env's grid.

What `rrt_frontiers` is made of: it measures no ways, and what no sample comes near is not found.
`frontier` finds all, `geodesic`, which names the other searches, how far they are.
"""

import warp as wp

from maexp.kernels.constants import FREE, UNKNOWN
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def walk_branch(
    known: wp.array2d(dtype=wp.uint8),
    row: int,
    start: wp.vec2,
    end: wp.vec2,
    w: int,
    h: int,
) -> int:
    """Walk a segment in half cells: -1 = known and free all along, -2 = blocked, else the last free cell before
    the unknown."""
    steps = 1 + int(2.0 * wp.length(end - start))
    last = wp.int32(-2)
    result = wp.int32(-1)
    for k in range(steps + 1):
        if result == -1:
            p = start + (end - start) * (float(k) / float(steps))
            x = int(wp.floor(p[0]))
            y = int(wp.floor(p[1]))
            if x < 0 or y < 0 or x >= w or y >= h:
                result = -2
            else:
                state = known[row, y * w + x]
                if state == wp.uint8(FREE):
                    last = y * w + x
                elif state == wp.uint8(UNKNOWN):
                    result = last
                else:
                    result = -2
    return result


@wp.kernel
def _grow_tree(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    block: wp.array(dtype=wp.int32),  # [grid], side of a block in cells
    # State in:
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    macro_step: wp.array(dtype=wp.int32),  # [env]
    # In:
    known: wp.array2d(dtype=wp.uint8),  # [row, cell]
    sources: wp.array2d(dtype=wp.int32),  # [item, 1], the robot's cell; -1 = none
    # Settings:
    rows_per_env: int,
    robots: int,
    samples: int,
    branch: float,  # longest branch, in radar-independent cells of the grid
    # Scratch:
    node: wp.array2d(dtype=wp.vec2),  # [item, node]
    # Out, zero before:
    found: wp.array2d(dtype=wp.int32),  # [row, block], 1 = a branch left the known here
):
    item = wp.tid()
    e = item / robots
    i = item % robots
    m = map_id[e]
    w = grids.width[m]
    h = grids.height[m]
    b = block[m]
    across = (w + b - 1) / b
    row = e * rows_per_env + wp.where(rows_per_env > 1, i, 0)
    cell = sources[item, 0]
    if cell < 0:
        return
    key = wp.rand_init(seed[0], env_id[e])
    key = wp.rand_init(wp.randi(key), episode[e])
    rng = wp.rand_init(wp.randi(key), macro_step[e] * robots + i)
    node[item, 0] = wp.vec2(float(cell % w) + 0.5, float(cell / w) + 0.5)
    count = wp.int32(1)
    for _sample in range(samples):
        p = wp.vec2(wp.randf(rng) * float(w), wp.randf(rng) * float(h))
        nearest = wp.int32(0)
        gap = wp.float32(1.0e30)
        for k in range(count):
            d = node[item, k] - p
            if wp.dot(d, d) < gap:
                gap = wp.dot(d, d)
                nearest = k
        start = node[item, nearest]
        length = wp.sqrt(gap)
        if length > branch:
            p = start + (p - start) * (branch / length)
        end = walk_branch(known, row, start, p, w, h)
        if end >= 0:
            wp.atomic_max(found, row, (end / w / b) * across + (end % w) / b, 1)
        if end == -1 and count < node.shape[1]:
            node[item, count] = p
            count += 1
