"""State and scratch of a simulation: one table of every array, torch tensors that own the memory, Warp views.

Rows of different envs never share memory, so a simulation is split into shards, runs of envs with
Warp views of their own, and every shard may run in its own thread.
"""

from types import SimpleNamespace

import torch
import warp as wp

from maexp.kernels.arrays import Field, count_bytes
from maexp.kernels.dynamics import Robots
from maexp.kernels.occlusion import BINS
from maexp.kernels.reward import MARKS, REWARD_TERMS
from maexp.kernels.types import ROBOTS_PER_WORD

AXES = {
    "E": ("env", "teams of the batch"),
    "N": ("robot", "robots of a team"),
    "U": ("radio", "radios of a team: those of its robots, then the base station's where there is one"),
    "W": ("word", "words of 32 radios; radio i owns bit i % 32 of word i // 32"),
    "F": ("free", "free points of the largest map"),
    "B": ("boundary", "boundary points of the largest map"),
    "H": ("word", "as W where communication is limited, else 1"),
    "P": ("free", "as F where communication is limited, else 1"),
    "Q": ("boundary", "as B where communication is limited, else 1"),
    "J": ("robot", "as N where odometry drifts, else 1"),
    "A": ("robot", "as N where radars miss returns, else 1"),
    "C": ("free", "as F where radars miss returns, else 1"),
    "I": ("boundary", "as B where radars miss returns, else 1"),
    "L": ("word", "as W where radars give false returns, else 1"),
    "Z": ("free", "as F where radars give false returns, else 1"),
    "r": ("row", "as N where maps have errors and communication is limited, else 1"),
    "f": ("free", "as F where maps have errors, else 1"),
    "b": ("boundary", "as B where maps have errors, else 1"),
    "c": ("cell", "cells of the largest navigation grid where maps have errors, else 1"),
    "X": ("radio", "as U where messages take room or time, else 1"),
    "Y": ("point", "points of the largest map where messages take room or time, else 1"),
    "R": ("term", "terms of the reward"),
    "M": ("mark", "coverages of `reward.MARKS`: 85, 95 and 99 %"),
    "T": ("step", "local steps that a trajectory remembers; step t stands at t % T"),
    "S": ("slot", "entries of a list of robots, N"),
    "V": ("slot", "entries of a list of visible points"),
    "O": ("slot", "entries of a list of boundary points in range"),
    "G": ("slot", "entries of a list of pixels of a body"),
    "K": ("occluder", "entries of a list of occluders"),
    "D": ("bin", "three times `shadows.BINS`: nearest occluder, nearest full cover, nearest of the walls"),
    "1": ("1", "one"),
}
"""Letter: (name in the kernels' signatures, what is counted)."""


# fmt: off
STATE = {
    # Which episode an env plays.
    "seed": Field(wp.int32, "1", "", "key of all random numbers, with env_id and episode"),
    "env_id": Field(wp.int32, "E", "", "number of the env in keys of random numbers; of an evaluation episode"),
    "episode": Field(wp.int32, "E", "", "number of the episode; evaluation's begin at 2^30, -1: none yet"),
    "map_id": Field(wp.int32, "E", "", "map of the episode"),
    "starts": Field(wp.vec3, "E N", "m, m, rad",
        "x, y, heading of following resets; inf: those of the map, or drawn"),

    # Its clock and its end.
    "active": Field(wp.int32, "E", "", "1 while the episode runs: local steps leave other envs alone"),
    "local_step": Field(wp.int32, "E", "steps", "local steps made in this episode"),
    "macro_step": Field(wp.int32, "E", "steps", "decisions made in this episode"),
    "terminated": Field(wp.int32, "E", "", "1 once the coverage is reached or all robots have collided"),
    "error": Field(wp.int32, "E", "", "bits `ERROR_*` of `types`, raised and cleared after every macro step"),

    # Where the robots are and where they go.
    "pose": Field(wp.vec4, "E N", "m, m, m/s, rad", "x, y, speed forward, heading of the reference point (`dynamics`)"),
    "slip": Field(wp.float32, "E N", "m/s", "speed to the left, of omnidirectional robots; 0 for the others"),
    "center": Field(wp.vec3, "E N", "m", "centre of the body, z = 0: radar, planner and collisions measure from it"),
    "odometry_error": Field(wp.vec3, "E J", "m, m, rad", "what the robot takes its pose to be, less what it is: x, y,"
        " heading of the reference point"),
    "pose_estimate": Field(wp.vec4, "E J", "m, m, m/s, rad", "the pose that the robot believes to have, on the map"),
    "center_estimate": Field(wp.vec3, "E J", "m", "where it believes its centre to be"),
    "goal": Field(wp.vec2, "E N", "m", "where the policy sends the robot"),
    "waypoint": Field(wp.vec2, "E N", "m", "where it drives now: the goal, or a waypoint on the way there"),
    "control": Field(wp.vec2, "E N", "m/s^2, rad", "acceleration, then steering [rad], yaw rate [rad/s] or sideways"
        " acceleration [m/s^2], as its kind has it"),
    "collided": Field(wp.int32, "E N", "", "1 once the robot has collided: it stands for good"),
    "failed": Field(wp.int32, "E N", "", "1 while the robot has failed: it stands, sees nothing and says nothing"),
    "path_length": Field(wp.float32, "E N", "m", "way driven in this episode"),
    "track": Field(wp.int32, "E N T", "", "pixel of the body's centre after each local step (ix * 125 + iy)"),

    # What they have seen and know. Points are numbered within their map, sorted by cell (`types.Maps`).
    "seen_free": Field(wp.int32, "E W F", "", "bit of every robot that has scanned the free point"),
    "seen_boundary": Field(wp.int32, "E W B", "", "the same of boundary points"),
    "viewers_free": Field(wp.int32, "E 1 F", "", "robots that have ever scanned the point; during a scan also"
        " `VIEWER_NOW` for each that sees it now"),
    "viewers_boundary": Field(wp.int32, "E 1 B", "", "robots that have ever scanned the point"),
    "evidence_free": Field(wp.uint8, "E A C", "",
        "returns of the free point that the robot has had, until it knows it; `sensing.FALSE` and more: false ones"),
    "evidence_boundary": Field(wp.uint8, "E A I", "", "the same of boundary points"),
    "false_walls": Field(wp.int32, "E L Z", "", "bit of every robot that takes the free point for a wall"),
    "known_free": Field(wp.int32, "E H P", "", "bit of every robot that has scanned the point or heard of it"),
    "known_boundary": Field(wp.int32, "E H Q", "", "the same of boundary points"),
    "drawn": Field(wp.int32, "E r c", "", "what stands in the cell in a robot's map, or the team's, and since when"
        " (`mapping`); 0: nothing"),
    "place_free": Field(wp.int32, "E r f", "", "where the free point is believed to be (`mapping.place_number`); 0:"
        " never drawn"),
    "place_boundary": Field(wp.int32, "E r b", "", "the same of boundary points"),
    "learned": Field(wp.int32, "E X Y", "", "points in the order in which the radio learned of them; boundary points"
        " are numbered after the map's free ones"),
    "learned_count": Field(wp.int32, "E X", "", "how many those are"),
    "offered": Field(wp.int32, "E X X", "", "[i, j]: how many of those radio i has sent radio j, or need not"),
    "underway": Field(wp.uint8, "E X Y", "steps", "until a message that tells the radio of the point arrives, and 1;"
        " 0: none does"),
    "cells_sent": Field(wp.int64, "E", "", "points that radios have told others of, where communication is limited"),
    "comm": Field(wp.bool, "E N N", "", "[i, j]: robot i hears robot j; all true unless communication is limited"),
    "hears": Field(wp.int32, "E U W", "", "the same in bits, of all radios that radio i hears"),
    "contacts": Field(wp.int32, "E U W", "", "all that radio i has heard since the decision before, in bits"),
    "base": Field(wp.vec3, "E", "m", "where the base station is, or would be, z = 0"),

    # How much that is. Weights: `Maps.free_weight`, 1 a point on maps of even density.
    "covered": Field(wp.int32, "E", "weight", "of the free points that the team has seen"),
    "covered_before": Field(wp.int32, "E", "weight", "the same before this local step"),
    "covered_sum": Field(wp.int64, "E", "weight", "sum of `covered` over the episode's local steps"),
    "shared": Field(wp.int32, "E", "weight", "of the free points that two robots or more have seen"),
    "known_weight": Field(wp.int32, "E U", "weight", "of the free points that a radio knows, where communication is"
        " limited"),
    "base_sum": Field(wp.int64, "E", "weight", "sum of what the base station knows over the episode's local steps"),
    "worst_sum": Field(wp.int64, "E", "weight", "the same of the robot that knows least at each step"),
    "told_step": Field(wp.int32, "E", "steps", "local step after which every radio knew 95 %; -1 before"),
    "connected": Field(wp.int32, "E N", "steps", "local steps in which the robot was connected (`radio._note_links`)"),
    "milestone_step": Field(wp.int32, "E M", "steps", "local step that reached the mark; -1 before"),
    "milestone_overlap": Field(wp.float32, "E M", "", "shared / covered at that moment"),
    "milestone_path": Field(wp.float32, "E N M", "m", "`path_length` at that moment"),

    # What it earns.
    "terms": Field(wp.float32, "E N R", "", "terms of the reward, scaled and summed over the macro step"),
    "unscaled": Field(wp.float32, "E N R", "", "the same without the scales w and v, summed over the episode"),
    "episode_reward": Field(wp.float32, "E N", "", "reward of the episode up to the last macro step"),
}
"""What a simulation is at a moment: saved, loaded, and all that the future depends on."""

SCRATCH = {
    # What the host asks for.
    "mask": Field(wp.int32, "E", "", "1 for the envs that a reset starts anew, or whose pictures are drawn"),
    "wanted": Field(wp.vec2, "E N", "m", "where the policy sends the robot next"),
    "command": Field(wp.vec2, "E N", "", "the policy's controls, if it drives itself, shares of the limits in [-1, 1]"),

    # Who is near whom in this local step.
    "facing": Field(wp.vec2, "E N", "", "unit vector ahead of the robot"),
    "place": Field(wp.vec3, "E N", "m", "x, y and radius of a disc that the body stays in"),
    "near": Field(wp.int32, "E N S", "", "robots that may be in radar range, or touch"),
    "near_count": Field(wp.int32, "E N", "", "how many those are"),

    # Planning.
    "goal_aim": Field(wp.vec2, "E J", "m", "where the goal lies for a robot that is elsewhere than it believes"),
    "waypoint_aim": Field(wp.vec2, "E J", "m", "the same of the waypoint"),
    "nearby": Field(wp.vec2, "E N O", "m", "known boundary points that may be in the way"),
    "mates": Field(wp.int32, "E N S", "", "robots that may be in the way"),

    # Colliding.
    "crashed": Field(wp.int32, "E N", "", "1 where the robot collides in this local step"),

    # Scanning.
    "bins": Field(wp.float32, "E N D", "m", "distances of what is nearest in each bin of directions (`shadows`)"),
    "direction": Field(wp.vec3, "E N K", "", "unit vector from the sensor to each occluder"),
    "limit": Field(wp.vec2, "E N K", "1, m", "cosine of its angular half-width, its distance"),
    "occluder_count": Field(wp.int32, "E N", "", "how many those are"),
    "wall_count": Field(wp.int32, "E N", "", "how many of them, the first, belong to the map; 0: no matter"),
    "visible": Field(wp.int32, "E N V", "", "free points that the robot sees now"),
    "visible_count": Field(wp.int32, "E N", "", "how many those are"),
    "viewed_count": Field(wp.int32, "E N", "", "how many were in view where radars miss returns, those without a return"
        " behind the others"),

    # Merging.
    "discovered": Field(wp.int32, "E N", "weight", "of the visible points that are new to the team"),
    "overlap": Field(wp.int32, "E N", "weight", "of the visible points that another robot sees now"),
    "told_free": Field(wp.int32, "E H P", "", "what each can tell of before it hears others"),
    "told_boundary": Field(wp.int32, "E H Q", "", "the same of boundary points"),

    "counted": Field(wp.int32, "E", "weight", "what may end the episode where that is not what the team has seen"),
    "reached": Field(wp.int32, "E W", "", "bits of the radios found to be connected with the base station"),

    # Drawing.
    "body_pixel": Field(wp.int32, "E N G", "", "pixels of the robot's body, that of its centre first"),
    "body_count": Field(wp.int32, "E N", "", "how many those are"),
}
"""What the kernels of a step, a reset or an observation hand to each other: no later one reads it."""
# fmt: on


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
    base_station: bool = False,
    sensing: bool = False,
    drifts: bool = False,
    messages: bool = False,
    false_alarms: bool = False,
    map_errors: bool = False,
    cells: int = 1,
) -> dict[str, int]:
    """Length of every named axis of `STATE` and `SCRATCH`."""
    radios = num_robots + base_station
    words = -(-radios // ROBOTS_PER_WORD)
    return {
        "E": num_envs,
        "N": num_robots,
        "U": radios,
        "W": words,
        "F": max(free, 1),
        "B": max(boundary, 1),
        "H": words if limited else 1,
        "P": max(free, 1) if limited else 1,
        "Q": max(boundary, 1) if limited else 1,
        "J": num_robots if drifts else 1,
        "A": num_robots if sensing else 1,
        "C": max(free, 1) if sensing else 1,
        "I": max(boundary, 1) if sensing else 1,
        "L": words if false_alarms else 1,
        "Z": max(free, 1) if false_alarms else 1,
        "r": num_robots if map_errors and limited else 1,
        "f": max(free, 1) if map_errors else 1,
        "b": max(boundary, 1) if map_errors else 1,
        "c": cells if map_errors else 1,
        "X": radios if messages else 1,
        "Y": max(free + boundary, 1) if messages else 1,
        "V": max(visible, 1),
        "K": max(occluders, 1),
        "O": max(nearby, 1),
        "G": body_pixels,
        "T": track,
        "R": len(REWARD_TERMS),
        "D": 3 * BINS,
        "S": num_robots,
        "M": len(MARKS),
        "1": 1,
    }


def allocate(fields: dict[str, Field], sizes: dict[str, int], device: torch.device) -> dict[str, torch.Tensor]:
    """Zeroed tensors for ``fields`` (`STATE` or `SCRATCH`)."""
    return {name: torch.zeros(field.shape(sizes), dtype=field.dtype, device=device) for name, field in fields.items()}


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


def robots_struct(tensors: dict[str, torch.Tensor], first: int, last: int) -> Robots:
    """`Robots` over envs ``first`` to ``last``; ``tensors`` holds one [E, N] tensor per field."""
    robots = Robots()
    for name, tensor in tensors.items():
        kind = wp.int32 if tensor.dtype == torch.int32 else wp.float32
        setattr(robots, name, wp.from_torch(tensor[first:last], dtype=kind))
    return robots
