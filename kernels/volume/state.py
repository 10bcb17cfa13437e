"""State and scratch of a simulation in volumes: one table of every array, torch tensors that own the memory.

What means the same as in the plane has the same name, and the row of `maexp.kernels.state`.
"""

from types import SimpleNamespace

import torch
import warp as wp

from maexp.kernels import state as plane
from maexp.kernels.arrays import Field, count_bytes

AXES = {
    "E": ("env", "teams of the batch"),
    "N": ("robot", "robots of a team"),
    "U": ("radio", "radios of a team: those of its robots"),
    "W": ("word", "words of 32 radios"),
    "R": ("row", "as N where communication is limited, else 1: who knows something of their own"),
    "C": ("column", "columns of voxels of the largest map"),
    "D": ("column", "as C where communication is limited, else 1"),
    "L": ("word", "words of 32 layers of the highest map"),
    "c": ("cell column", "columns of cells of the largest map"),
    "d": ("cell column", "twice that"),
    "l": ("word", "words of 32 layers of cells"),
    "z": ("cell", "cells of the largest map"),
    "B": ("block", "blocks of the largest map"),
    "V": ("voxel", "voxels of a window (`motion.SPAN`)"),
    "P": ("point", "points of a way (`motion.WAY_POINTS`)"),
    "K": ("term", "terms of the reward"),
    "M": ("mark", "coverages of `reward.MARKS`"),
    "1": ("1", "one"),
}
"""Letter: (name in the kernels' signatures, what is counted)."""


def _same(*names: str) -> dict[str, Field]:
    """Rows of the plane's tables; their axis R is called K here."""
    rows = plane.STATE | plane.SCRATCH
    return {
        name: Field(rows[name].kind, rows[name].axes.replace("R", "K"), rows[name].unit, rows[name].meaning)
        for name in names
    }


# fmt: off
STATE = _same(
    "seed", "env_id", "episode", "map_id", "active", "local_step", "macro_step", "terminated", "error", "pose", "slip",
    "control", "collided", "failed", "path_length", "cells_sent", "comm", "hears", "contacts", "covered",
    "covered_before", "covered_sum", "shared", "known_weight", "base", "base_sum", "worst_sum", "told_step",
    "connected",
    "milestone_step", "milestone_overlap", "milestone_path", "terms", "unscaled", "episode_reward",
) | {
    "starts": Field(wp.vec4, "E N", "m, m, m, rad", "x, y, z, heading of following resets; inf: those of the map, or"
        " drawn"),
    "center": Field(wp.vec3, "E N", "m", "centre of the body"),
    "velocity": Field(wp.vec3, "E N", "m/s", "of the centre"),
    "goal": Field(wp.vec4, "E N", "m, m, m, rad", "where the policy sends the robot, and its heading there"),
    "way": Field(wp.vec3, "E N P", "m", "next points of the way there"),
    "way_count": Field(wp.int32, "E N", "", "how many those are"),
    "way_next": Field(wp.int32, "E N", "", "the one that the robot heads for"),
    "seen_free": Field(wp.int32, "E N C L", "", "bits of the free voxels that each robot has seen"),
    "known_free": Field(wp.int32, "E R C L", "", "what each row knows to be free"),
    "known_surface": Field(wp.int32, "E R C L", "", "what it knows to be occupied"),
    "team_free": Field(wp.int32, "E C L", "", "free voxels that the team has seen"),
    "team_surface": Field(wp.int32, "E C L", "", "occupied ones"),
    "twice_free": Field(wp.int32, "E C L", "", "free voxels that two robots or more have seen"),
    "room": Field(wp.int32, "E R C L", "", "voxels that a body may be in, as of the latest decision"),
    "covered_surface": Field(wp.int32, "E", "", "occupied voxels that the team has seen, of those that can be seen"),
}
"""What a simulation is at a moment: saved, loaded, and all that the future depends on."""

SCRATCH = _same("mask", "crashed", "discovered", "overlap", "counted", "reached") | {
    "wanted": Field(wp.vec4, "E N", "m, m, m, rad", "where the policy sends the robot next, and its heading there; NaN:"
        " none is given"),
    "new_velocity": Field(wp.vec3, "E N", "m/s", "at the end of this local step"),
    "new_heading": Field(wp.float32, "E N", "rad", "at the end of this local step"),
    "before": Field(wp.int32, "E N V", "", "number of the voxel before each of a window, on the way around a corner"),
    "queue": Field(wp.int32, "E N V", "", "voxels to be looked at next"),
    "visible_free": Field(wp.int32, "E N C L", "", "free voxels that the robot sees now; 0 between local steps"),
    "visible_surface": Field(wp.int32, "E N C L", "", "occupied ones"),
    "told_free": Field(wp.int32, "E R D L", "", "what each knew before it hears others"),
    "told_surface": Field(wp.int32, "E R D L", "", "the same of occupied voxels"),
    "looked": Field(wp.int32, "E", "", "1 for the envs whose ways are to be found"),
    "open": Field(wp.int32, "E R c l", "", "bits of cells that a robot can be in"),
    "unknown": Field(wp.uint8, "E R z", "", "unknown voxels in each cell; 255: it blocks rays"),
    "distance": Field(wp.int16, "E N z", "", "steps from the robot to each cell; `coarse.UNREACHED`"),
    "wave": Field(wp.int32, "E N d l", "", "cells that the search has just come to"),
    "been": Field(wp.int32, "E N c l", "", "cells that it has come to"),
    "listed": Field(wp.int32, "E N d", "", "their columns"),
    "target": Field(wp.int32, "E R B", "", "the cell to go to for each block with a frontier; -1: none"),
    "frontier_size": Field(wp.int32, "E R B", "", "frontier voxels in each block"),
    "point": Field(wp.vec3, "E R B", "m", "where the targets are"),
    "gain": Field(wp.float32, "E R B", "", "what is to be seen from each, as a share of a view"),
    "middle": Field(wp.vec3, "E R B", "m", "the middle of that, from the target"),
    "best_heading": Field(wp.float32, "E R B", "rad", "where most of it is to be seen"),
}
"""What the kernels of a step, a reset or a decision hand to each other."""
# fmt: on


def allocate(sizes: dict[str, int], device: torch.device) -> dict[str, torch.Tensor]:
    """Zeroed tensors of state and scratch."""
    return plane.allocate(STATE, sizes, device) | plane.allocate(SCRATCH, sizes, device)


def memory_per_env(sizes: dict[str, int]) -> dict[str, int]:
    """Bytes of every field for one env."""
    return count_bytes(STATE | SCRATCH, sizes | {"E": 1})


def warp_views(tensors: dict[str, torch.Tensor], first: int, last: int) -> SimpleNamespace:
    """Warp arrays over envs ``first`` to ``last`` of all state and scratch tensors."""
    views = {}
    for name, field in (STATE | SCRATCH).items():
        rows = tensors[name][first:last] if field.axes.startswith("E") else tensors[name]
        views[name] = wp.from_torch(rows, dtype=field.kind)
    return SimpleNamespace(**views)
