"""Bytes and operations of every kernel, counted from its definition.

A formula gives, per robot of the team and launch, the bytes that must move and the operations that must be done
for the counts `c` of `census`. Rules:

- bytes: every word that a robot reads or writes counts once a launch, in whatever cache it lies; read-modify-write
  counts twice. float32 and int32 are 4 bytes, a vec3 12.
- operations: an addition, product, comparison, minimum, division, root or bit operation is 1; sine, cosine, tangent,
  logarithm and power are 10, about what their polynomials take. Index arithmetic is left out.
- what is done once an env (points drawn, milestones) is divided by the robots of the team.

The share of a ceiling that follows from them says how far a kernel is from moving or computing no more than it must,
not how busy the machine is.
"""

from collections.abc import Callable
from dataclasses import dataclass

from maexp.kernels.shadows import BINS
from maexp.kernels.types import REGIONS

WORD, VEC2, VEC3, VEC4 = 4, 8, 12, 16
TRIG = 10
ROW = 2 * WORD  # a row of cells: where its run of points starts and stops
Counts = dict[str, float]


@dataclass(frozen=True)
class Cost:
    """Bytes moved and operations done, per robot and launch."""

    bytes: float
    operations: float


def set_goal(c: Counts) -> Cost:
    """Region and offset in, goal and waypoint out; two products and sums a coordinate."""
    return Cost(c["active"] * (8 + VEC2 + 2 * WORD + 2 * VEC2 + 2 * VEC2), c["active"] * 14)


def face_robots(c: Counts) -> Cost:
    """Sine and cosine of a heading, and the disc that a robot stays in: a tangent says how far it may turn."""
    return Cost(c["active"] * (VEC4 + VEC3 + 7 * WORD + VEC2 + VEC3), c["active"] * (3 * TRIG + 16))


def list_near(c: Counts) -> Cost:
    """The discs of all robots, and the numbers of those near."""
    return Cost(c["active"] * (VEC3 * c["robots"] + 3 * WORD) + c["near"] * WORD, c["active"] * 8 * c["others"])


def plan_dwa(c: Counts) -> Cost:
    """List the known points in reach, then score turns x accelerations after `horizon` steps."""
    body = VEC4 + WORD + VEC3 + VEC2 + 9 * WORD  # pose, slip, centre, waypoint, parameters
    moved = c["plan_rows"] * ROW + c["plan_near"] * VEC3 + c["plan_known"] * (WORD * c["words"] + 2 * VEC2)
    moved += c["near"] * (WORD + VEC3) + c["mates"] * (VEC2 + 2 * WORD) + VEC2 + c["turns"] * WORD
    step = 10 + 2 * TRIG + 4  # position, heading's sine and cosine, speed
    point = 30 + 2 * TRIG if c["footprint"] else 6  # distance of a listed point to the predicted body
    mate = 14 + 2 * TRIG * c["footprint"]  # distance to the body of another robot that may come near enough to matter
    candidate = (c["horizon"] - 1) * step + 4 + c["plan_known"] * point + c["mates"] * mate + 8 + TRIG
    turn = 4 + 3 + 2 * TRIG  # first heading with sine and cosine
    work = c["plan_near"] * 6 + c["near"] * 6 + c["turns"] * turn + c["candidates"] * candidate
    return Cost(c["driving"] * body + moved, c["driving"] * work)


def plan_direct(c: Counts) -> Cost:
    """Command times limits."""
    return Cost(c["active"] * (2 * VEC2 + 4 * WORD), c["active"] * 6)


def move_robots(c: Counts) -> Cost:
    """One Euler step: pose and slip in and out, centre out, path in and out, control and parameters in."""
    moved = 2 * VEC4 + 4 * WORD + VEC3 + VEC2 + 6 * WORD
    return Cost(c["driving"] * moved, c["driving"] * (30 + 5 * TRIG))


def detect_collisions(c: Counts) -> Cost:
    """Boundary points in the cells around the threshold, and the other centres."""
    moved = VEC3 + VEC4 + 6 * WORD + c["hit_near"] * VEC3 + c["near"] * (WORD + VEC3)
    return Cost(c["driving"] * moved, c["driving"] * 6 * (c["hit_near"] + c["near"]))


def collect_occluders(c: Counts) -> Cost:
    """Distances of the occluders near, directions and half-widths of those in range, and their bins."""
    bins = 2 * BINS * WORD
    moved = c["rows"] * ROW + c["occluder_near"] * (VEC3 + WORD) + c["near"] * (VEC4 + VEC2 + 4 * WORD)
    moved += c["occluders"] * (VEC3 + VEC2) + bins
    work = 8 * c["occluder_near"] + 30 * c["outline_points"] + c["near"] * 10
    work += c["occluders"] * (6 + 40) + 4 * c["bins_touched"]  # c_o, both edges in diamond angle; then two minima a bin
    return Cost(c["active"] * moved, work)


def scan_free(c: Counts) -> Cost:
    """Distance and bin of the free points near; pairwise tests of those that the bins leave undecided."""
    tested = min(1.0, c["undecided"])
    moved = c["rows"] * ROW + c["free_near"] * VEC3 + 2 * BINS * WORD
    moved += tested * c["occluders"] * (VEC3 + VEC2) + c["visible"] * (2 * WORD + WORD)
    work = 8 * c["free_near"] + 18 * c["free_in"] + 9 * c["pair_tests"] + 4 * c["visible"]
    return Cost(c["active"] * moved, work)


def scan_boundary(c: Counts) -> Cost:
    """The visible points, and the flags of the boundary points beside them (most have been seen before)."""
    moved = c["visible"] * 3 * WORD + c["neighbours"] * 2 * WORD
    return Cost(moved, c["visible"] + 2 * c["neighbours"])


def count_points(c: Counts) -> Cost:
    """Viewers and weight of every visible point."""
    return Cost(c["visible"] * 3 * WORD + 2 * WORD, c["visible"] * 6)


def merge_scan(c: Counts) -> Cost:
    """Viewers read and written, and the flag read, for every visible point (most have been seen before)."""
    return Cost(c["visible"] * (WORD + 3 * WORD), 2 * c["visible"])


def reward_robots(c: Counts) -> Cost:
    """Five terms, weighted and plain, read and written."""
    return Cost(c["active"] * (8 * WORD + 5 * 4 * WORD), c["active"] * 30)


def record_track(c: Counts) -> Cost:
    """The pixel of a robot."""
    return Cost(c["active"] * (VEC3 + 2 * VEC2 + 2 * WORD), c["active"] * 8)


def close_step(c: Counts) -> Cost:
    """Counters of an env, and whether its robots have collided."""
    return Cost(c["active"] * (WORD + 12 * WORD / c["robots"]), c["active"] * (1 + 10 / c["robots"]))


def draw_points(c: Counts) -> Cost:
    """Viewers of every point of the map; flags and pixels of what each robot and the team have seen."""
    share = 1 / c["robots"]
    known, drawn, pixels = c["team_points"], c["drawn_points"], c["pixels_per_point"]
    flags = share * c["map_points"] * WORD + known * (2 * WORD + pixels * WORD * c["words"])
    viewers = known * pixels * c["shared_pixels"] * (2 * WORD + c["points_per_pixel"] * 2 * WORD)
    moved = flags + drawn * pixels + known * pixels * (WORD + 2) + viewers
    return Cost(moved, share * c["map_points"] + drawn * pixels * 4 + known * pixels * (c["words"] + 4))


def list_bodies(c: Counts) -> Cost:
    """The pixels around a body, each tested."""
    return Cost(VEC4 + VEC3 + 3 * WORD + c["body_pixels"] * WORD, c["pixels_tested"] * (18 + 2 * TRIG) + 20)


def draw_robots(c: Counts) -> Cost:
    """Bodies, from their lists of pixels, and the trajectory."""
    moved = c["robots"] * (WORD + 1 + c["body_pixels"] * (WORD + 1)) + c["track"] * (WORD + 1)
    return Cost(moved, c["robots"] * (1 + c["body_pixels"]) + c["track"] * 12)


def observe_pose(c: Counts) -> Cost:
    """Offsets of all regions to the robot and to its goal."""
    regions = REGIONS**2
    return Cost(VEC4 + VEC3 + VEC2 + 8 * WORD + VEC4 + regions * 4 * WORD, 20 + regions * 12)


def clear_flags(c: Counts) -> Cost:
    """All flags of an env: seen free and boundary points, and those of the scan."""
    words = c["words"] * (c["point_capacity"] + c["free_capacity"])
    return Cost(words * WORD / c["robots"], 0.0)


def clear_env(c: Counts) -> Cost:
    """Counters of an env."""
    return Cost(10 * WORD / c["robots"], 0.0)


def clear_robots(c: Counts) -> Cost:
    """State of a robot."""
    return Cost(VEC3 + 4 * VEC2 + 4 * WORD + 2 * WORD + 10 * WORD, 0.0)


def place_team(c: Counts) -> Cost:
    """64 tries, each a point's clearance; the distance to the robots placed before where it suffices."""
    tries = 64 * (WORD + VEC3)
    return Cost(tries + VEC4 + VEC3 + 4 * WORD, 64 * 6 + 2 * TRIG + 6 * c["others"] / 2)


def start_env(c: Counts) -> Cost:
    """Counters of an env and two of a robot."""
    return Cost(2 * WORD + 4 * WORD / c["robots"], 0.0)


FORMULAS: dict[str, Callable[[Counts], Cost]] = {
    "_set_goal": set_goal,
    "_face_robots": face_robots,
    "_list_near": list_near,
    "_plan_dwa": plan_dwa,
    "_plan_direct": plan_direct,
    "_move_robots": move_robots,
    "_detect_collisions": detect_collisions,
    "_collect_occluders": collect_occluders,
    "_scan_free": scan_free,
    "_scan_boundary": scan_boundary,
    "_count_points": count_points,
    "_merge_scan": merge_scan,
    "_reward_robots": reward_robots,
    "_record_track": record_track,
    "_close_step": close_step,
    "_draw_points": draw_points,
    "_list_bodies": list_bodies,
    "_draw_robots": draw_robots,
    "_observe_pose": observe_pose,
    "_clear_flags": clear_flags,
    "_clear_env": clear_env,
    "_clear_robots": clear_robots,
    "_place_team": place_team,
    "_start_env": start_env,
}
"""By kernel. Those of limited communication and of the `wavefront` planner are timed, not counted."""


def kernel_cost(kernel: str, counts: Counts) -> Cost | None:
    """What a kernel moves and computes per robot; None where no formula is written."""
    formula = FORMULAS.get(kernel)
    return None if formula is None else formula(counts)
