"""State and scratch of a simulation: torch tensors that own the memory, Warp views that kernels read.

Rows of different envs never share memory, so a simulation is split into shards, runs of envs with
Warp views of their own, and every shard may run in its own thread.
"""

import math
from types import SimpleNamespace

import torch
import warp as wp

from maexp.kernels.reward import TERMS
from maexp.kernels.shadows import BINS
from maexp.kernels.types import ROBOTS_PER_WORD, Robots

# name: (axes, torch dtype, Warp dtype). Axes: E envs, N robots, W words of 32 robots, F free and B boundary points
# of the largest map; H, P, Q are W, F, B where communication is limited and 1 elsewhere; T track length,
# V visible points, K occluders, O boundary points in range, G pixels of a body; digits are literal.
STATE = {
    "seed": ("1", torch.int32, wp.int32),
    "map_id": ("E", torch.int32, wp.int32),
    "env_id": ("E", torch.int32, wp.int32),
    "episode": ("E", torch.int32, wp.int32),
    "starts": ("E N 3", torch.float32, wp.vec3),  # x, y, heading of following resets; inf: those of the map
    "active": ("E", torch.int32, wp.int32),
    "local_step": ("E", torch.int32, wp.int32),
    "macro_step": ("E", torch.int32, wp.int32),
    "terminated": ("E", torch.int32, wp.int32),
    "covered": ("E", torch.int32, wp.int32),
    "covered_before": ("E", torch.int32, wp.int32),
    "covered_sum": ("E", torch.int64, wp.int64),
    "shared": ("E", torch.int32, wp.int32),
    "error": ("E", torch.int32, wp.int32),
    "pose": ("E N 4", torch.float32, wp.vec4),
    "slip": ("E N", torch.float32, wp.float32),
    "center": ("E N 3", torch.float32, wp.vec3),
    "goal": ("E N 2", torch.float32, wp.vec2),
    "target": ("E N 2", torch.float32, wp.vec2),
    "control": ("E N 2", torch.float32, wp.vec2),
    "collided": ("E N", torch.int32, wp.int32),
    "path_length": ("E N", torch.float32, wp.float32),
    "milestone_step": ("E 2", torch.int32, wp.int32),
    "milestone_overlap": ("E 2", torch.float32, wp.float32),
    "milestone_path": ("E N 2", torch.float32, wp.float32),
    "terms": ("E N R", torch.float32, wp.float32),
    "raw": ("E N R", torch.float32, wp.float32),
    "episode_reward": ("E N", torch.float32, wp.float32),
    "seen_free": ("E W F", torch.int32, wp.int32),
    "seen_boundary": ("E W B", torch.int32, wp.int32),
    "viewers_free": ("E 1 F", torch.int32, wp.int32),
    "viewers_boundary": ("E 1 B", torch.int32, wp.int32),
    "known_free": ("E H P", torch.int32, wp.int32),
    "known_boundary": ("E H Q", torch.int32, wp.int32),
    "comm": ("E N N", torch.bool, wp.bool),
    "hears": ("E N W", torch.int32, wp.int32),
    "track": ("E N T", torch.int32, wp.int32),
}
SCRATCH = {
    "mask": ("E", torch.int32, wp.int32),
    "facing": ("E N 2", torch.float32, wp.vec2),
    "place": ("E N 3", torch.float32, wp.vec3),
    "near": ("E N N", torch.int32, wp.int32),
    "near_count": ("E N", torch.int32, wp.int32),
    "fresh": ("E N", torch.int32, wp.int32),
    "overlap": ("E N", torch.int32, wp.int32),
    "crashed": ("E N", torch.int32, wp.int32),
    "told_free": ("E H P", torch.int32, wp.int32),
    "told_boundary": ("E H Q", torch.int32, wp.int32),
    "visible": ("E N V", torch.int32, wp.int32),
    "visible_count": ("E N", torch.int32, wp.int32),
    "bins": ("E N D", torch.float32, wp.float32),
    "direction": ("E N K 3", torch.float32, wp.vec3),
    "limit": ("E N K 2", torch.float32, wp.vec2),
    "occluder_count": ("E N", torch.int32, wp.int32),
    "wall_count": ("E N", torch.int32, wp.int32),
    "nearby": ("E N O 2", torch.float32, wp.vec2),
    "mates": ("E N N", torch.int32, wp.int32),
    "body_pixel": ("E N G", torch.int32, wp.int32),
    "body_count": ("E N", torch.int32, wp.int32),
    "command": ("E N 2", torch.float32, wp.vec2),
    "region": ("E N", torch.int64, wp.int64),
    "offset": ("E N 2", torch.float32, wp.vec2),
}


def axis_sizes(
    num_envs: int,
    num_robots: int,
    free: int,
    boundary: int,
    visible: int,
    occluders: int,
    nearby: int,
    track: int,
    limited: bool,
    body_pixels: int = 1,
) -> dict[str, int]:
    """Length of every named axis of `STATE` and `SCRATCH`."""
    words = -(-num_robots // ROBOTS_PER_WORD)
    return {
        "E": num_envs, "N": num_robots, "W": words, "F": max(free, 1), "B": max(boundary, 1),
        "H": words if limited else 1, "P": max(free, 1) if limited else 1, "Q": max(boundary, 1) if limited else 1,
        "V": max(visible, 1), "K": max(occluders, 1),
        "O": max(nearby, 1), "G": body_pixels, "T": track, "R": int(TERMS), "D": 3 * int(BINS),
    }  # fmt: skip


def shape_of(axes: str, sizes: dict[str, int]) -> tuple[int, ...]:
    """Shape of a field from the names of its axes."""
    return tuple(sizes[a] if a in sizes else int(a) for a in axes.split())


def allocate(fields: dict, sizes: dict[str, int], device: torch.device) -> dict[str, torch.Tensor]:
    """Zeroed tensors for ``fields`` (`STATE` or `SCRATCH`)."""
    return {
        name: torch.zeros(shape_of(axes, sizes), dtype=dtype, device=device)
        for name, (axes, dtype, _) in fields.items()
    }


def memory_per_env(sizes: dict[str, int]) -> dict[str, int]:
    """Bytes of every field for one env."""
    one = sizes | {"E": 1}
    result = {}
    for name, (axes, dtype, _) in (STATE | SCRATCH).items():
        result[name] = math.prod(shape_of(axes, one)) * dtype.itemsize
    return result


def grid_memory_per_env(
    cells: int, robots: int, known_rows: int, masks: int, points: int, wall_words: int, news: int
) -> int:
    """Bytes of the `wavefront` planner's grids and paths for one env (`kernels.wavefront`, `known_grid`, `geodesic`).

    Args:
        cells: of the largest navigation grid.
        robots: N.
        known_rows: grids of what is known, 1 for the team or one per robot.
        masks: grids of where robots fit.
        points: free and boundary points of the largest maps.
        wall_words: words of the bitmap of walls of the largest grid.
        news: capacity of the list of cells that changed.
    """
    known = known_rows * (cells + points + 4 * (wall_words + news) + 5 * 4)  # bytes, flags, words; counters of a row
    passable = masks * (cells + 4 + 4 + 2 * 4)  # uint8 per cell; its map, its source, two distances to keep
    search = robots * (3 * 4 * cells + 4 * 64 + 4 * 4)  # distances and lists of buckets, int32; BUCKETS, ends
    paths = robots * (4 * 64 + 4 * 4)  # PATH_CELLS cells; length, place, end, mask of each
    return known + passable + search + paths


def warp_views(tensors: dict[str, torch.Tensor], first: int, last: int) -> SimpleNamespace:
    """Warp arrays over envs ``first`` to ``last`` of all state and scratch tensors."""
    fields = STATE | SCRATCH
    views = {}
    for name, tensor in tensors.items():
        axes, _, kind = fields[name]
        views[name] = wp.from_torch(tensor[first:last] if axes.startswith("E") else tensor, dtype=kind)
    return SimpleNamespace(**views)


def robots_struct(tensors: dict[str, torch.Tensor], first: int, last: int) -> Robots:
    """`Robots` over envs ``first`` to ``last``; ``tensors`` holds one [E, N] tensor per field."""
    robots = Robots()
    for name, tensor in tensors.items():
        kind = wp.int32 if tensor.dtype == torch.int32 else wp.float32
        setattr(robots, name, wp.from_torch(tensor[first:last], dtype=kind))
    return robots
