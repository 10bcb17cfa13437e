"""How many points, obstacles and robots the kernels of a local step meet: counted at one moment of a simulation.

The formulas of `counts` turn these counts into bytes and operations. Counting repeats the definitions with
NumPy on a sample of robots, apart from the kernels; it takes seconds, not microseconds.
"""


import numpy as np
import torch

from maexp.envs import ExplorationEnv
from maexp.kernels.shadows import BINS
from maexp.kernels.shards import Shard
from maexp.kernels.types import PIXEL_SHARED, PIXELS

SAMPLE = 64  # robots that are looked at one by one


def count_moment(env: ExplorationEnv, shard: Shard, active: torch.Tensor) -> dict[str, float]:
    """Means per robot of a shard at this moment; robots of frozen envs count as zeros.

    The scratch of the last scan must still be there: call it right after a local step, with what was `active` [E]
    before it (a step may end an episode).
    """
    envs = np.arange(shard.first, shard.last)
    pairs = [(e, i) for e in envs for i in range(env.num_robots)]
    pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, min(SAMPLE, len(pairs))).astype(int)]
    rows = [count_robot(env, e, i, bool(active[e])) for e, i in pairs]
    counts = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return counts | count_sizes(env, shard)


def count_sizes(env: ExplorationEnv, shard: Shard) -> dict[str, float]:
    """What does not depend on where the robots are."""
    sim, s = env.simulation, env.simulation.tensors
    part = slice(shard.first, shard.last)
    sizes, settings, n = sim.sizes, sim.settings, env.num_robots
    maps = s["map_id"][part].long()
    free, boundary = (torch.as_tensor(np.diff(env.bank.arrays[f"{k}_begin"]))[maps.cpu()] for k in ("free", "boundary"))
    seen = torch.stack([_bits(s[f"seen_{k}"][part]).sum() for k in ("free", "boundary")]).sum()
    known = torch.stack([(s[f"seen_{k}"][part] != 0).any(1).sum() for k in ("free", "boundary")]).sum()
    shown = {k: np.diff(env.bank.arrays[f"{k}_begin"]) for k in ("point_pixel", "pixel_point")}
    robots = n * len(maps)
    return {
        "robots": n,
        "others": n - 1,
        "words": sizes["W"],
        "turns": settings.num_steering,
        "candidates": settings.num_steering * settings.num_accel,
        "horizon": settings.horizon,
        "footprint": float(settings.footprint),
        "point_capacity": sizes["F"] + sizes["B"],
        "free_capacity": sizes["F"],
        "map_points": float((free + boundary).double().mean()),
        "drawn_points": float(seen) / robots,
        "team_points": float(known) / robots,
        "pixels_per_point": float(shown["point_pixel"].mean()),
        "shared_pixels": float((env.bank.arrays["point_pixel"] >= PIXEL_SHARED).mean()),
        "points_per_pixel": float(shown["pixel_point"][shown["pixel_point"] > 0].mean()),
        "track": float(torch.clamp(s["local_step"][part] + 1, max=sizes["T"]).double().mean()),
        "pixels_tested": _pixels_tested(env),
        "body_pixels": float(s["body_count"][part].double().mean()),
    }


def _bits(words: torch.Tensor) -> torch.Tensor:
    """Set bits of int32 words."""
    counted = torch.zeros(words.shape, dtype=torch.int64, device=words.device)
    for k in range(32):
        counted += (words >> k) & 1
    return counted


def _pixels_tested(env: ExplorationEnv) -> float:
    """Pixels that the square around a body holds, all of which are tested."""
    pixel = float(np.mean(env.bank.arrays["pixel_size"]))
    sides = [(one.length + one.width) / pixel + 1.0 for one in env.robot_configs]
    return float(np.mean([min(side, float(PIXELS)) ** 2 for side in sides]))


def count_robot(env: ExplorationEnv, e: int, i: int, active: bool) -> dict[str, float]:
    """What robot i of env e meets in one local step; nothing where the env is not active."""
    s = env.simulation.tensors
    names = (
        "active driving rows plan_rows free_near free_in undecided pair_tests visible occluder_near occluders "
        "bins_touched outline_points neighbours plan_near plan_known mates hit_near near"
    )
    counts = dict.fromkeys(names.split(), 0.0)
    if not active:
        return counts
    m, at = int(s["map_id"][e]), s["center"][e, i].double().cpu().numpy()
    robot, reach = env.robot_configs[i], env.radar_configs[i].range
    cloud = Cloud(env.bank.arrays, m)
    counts |= {"active": 1.0, "driving": float(s["collided"][e, i] == 0)}
    counts["rows"] = float(len(cloud.rows(at, reach)))
    free, near = cloud.near("free", at, reach)
    inside = np.linalg.norm(free - at, axis=1) <= reach
    counts |= {"free_near": len(near), "free_in": inside.sum(), "visible": float(s["visible_count"][e, i])}
    counts |= count_pairs(s, e, i, free[inside] - at, env.radar_configs[i].alpha2)
    counts["occluder_near"] = len(cloud.near("occluder", at, reach)[1])
    counts["near"] = float(s["near_count"][e, i])
    counts["occluders"] = float(s["occluder_count"][e, i])
    counts |= count_outlines(env, e, i, m, at, reach)
    counts["neighbours"] = count_neighbours(env, e, i, m)
    counts["hit_near"] = len(cloud.near("boundary", at, robot.collision_threshold)[1])
    return counts | count_plan(env, cloud, e, i, at)


class Cloud:
    """The points of map `m` of a bank, found by cell as the kernels find them."""

    def __init__(self, arrays: dict[str, np.ndarray], m: int):
        self.arrays, self.m = arrays, m
        self.origin, self.size = arrays["cell_origin"][m].astype(float), float(arrays["cell_size"][m])
        self.shape = int(arrays["cells_x"][m]), int(arrays["cells_y"][m])

    def rows(self, at: np.ndarray, radius: float) -> range:
        """Rows of cells that a disc can touch."""
        low, high = (np.floor((at[1] + sign * radius - self.origin[1]) / self.size) for sign in (-1, 1))
        return range(int(max(low, 0)), int(min(high, self.shape[1] - 1)) + 1)

    def near(self, kind: str, at: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Points in the cells that a disc can touch, and their numbers within the map."""
        begin, starts = int(self.arrays[f"{kind}_begin"][self.m]), self.arrays[f"{kind}_cell"]
        first_cell = int(self.arrays["cell_begin"][self.m])
        runs = [np.zeros(0, int)]
        for row in self.rows(at, radius):
            low = self.origin[1] + row * self.size
            gap = max(low - at[1], at[1] - low - self.size, 0.0)
            half = np.sqrt(max(radius**2 - gap**2, 0.0))
            ends = (np.floor((at[0] + sign * half - self.origin[0]) / self.size) for sign in (-1, 1))
            left, right = (int(np.clip(end, 0, self.shape[0] - 1)) for end in ends)
            base = first_cell + row * self.shape[0]
            runs.append(np.arange(starts[base + left], starts[base + right + 1]))
        index = np.concatenate(runs)
        return self.arrays[kind][begin + index].astype(float), index


def count_pairs(s: dict, e: int, i: int, delta: np.ndarray, alpha2: float) -> dict[str, float]:
    """Free points that the bins leave undecided, and their tests against occluders until one masks them."""
    bins = s["bins"][e, i].cpu().numpy().astype(float)
    count = int(s["occluder_count"][e, i])
    direction, limit = (s[name][e, i, :count].double().cpu().numpy() for name in ("direction", "limit"))
    dist = np.linalg.norm(delta, axis=1)
    total = np.abs(delta[:, 0]) + np.abs(delta[:, 1])
    p = delta[:, 1] / np.maximum(total, 1e-30)
    angle = np.where(delta[:, 0] < 0, 2.0 - p, np.where(delta[:, 1] < 0, 4.0 + p, p))
    k = np.minimum((angle * (BINS / 4.0)).astype(int), BINS - 1)
    open_points = (bins[k] - dist < alpha2) & ~(bins[BINS + k] - dist < alpha2) & (dist > 0)
    d, r = delta[open_points], dist[open_points]
    touched = {"undecided": float(len(d)), "bins_touched": 0.0, "pair_tests": 0.0}
    if count:
        width = 4.0 / BINS  # in diamond angle, whose rate is at most 1 per rad
        touched["bins_touched"] = float((2.0 + 2.0 * np.arccos(np.clip(limit[:, 0], -1, 1)) / width).sum())
    if count and len(d):
        hit = (limit[None, :, 1] - r[:, None] < alpha2) & (d @ direction.T > limit[None, :, 0] * r[:, None])
        touched["pair_tests"] = float(np.where(hit.any(1), hit.argmax(1) + 1, count).sum())
    return touched


def count_outlines(env: ExplorationEnv, e: int, i: int, m: int, at: np.ndarray, reach: float) -> dict[str, float]:
    """Points on the outlines of the other bodies near enough to be sampled."""
    centers = env.simulation.tensors["center"][e].double().cpu().numpy()
    spacing, points = float(env.bank.arrays["resolution"][m]), 0
    for other, robot in enumerate(env.robot_configs):
        if other != i and np.linalg.norm(centers[other] - at) <= reach + robot.length + robot.width:
            points += 2 * sum(max(2, int(np.ceil(side / spacing))) for side in (robot.length, robot.width))
    return {"outline_points": float(points)}


def count_neighbours(env: ExplorationEnv, e: int, i: int, m: int) -> float:
    """Boundary points beside the free points that the robot sees, once for each of those."""
    s, begin = env.simulation.tensors, env.bank.arrays["neighbour_begin"]
    listed = s["visible"][e, i, : int(s["visible_count"][e, i])].cpu().numpy() + env.bank.arrays["free_begin"][m]
    return float((begin[listed + 1] - begin[listed]).sum())


def count_plan(env: ExplorationEnv, cloud: Cloud, e: int, i: int, at: np.ndarray) -> dict[str, float]:
    """Boundary points that DWA looks at, known ones that it must avoid, and other robots that it must."""
    s, robot, settings = env.simulation.tensors, env.robot_configs[i], env.simulation.settings
    if settings.planner == "direct" or bool(s["collided"][e, i]):
        return {}
    time = settings.dt * settings.horizon
    speed = abs(float(s["pose"][e, i, 2])) + abs(float(s["slip"][e, i]))
    reach = time * (speed + 1.5 * robot.max_accel * time) + robot.length * (robot.kind == "ackermann")
    reach += env.planner_config.clearance_factor * robot.collision_threshold
    reach = min(reach + settings.footprint * (robot.length + robot.width), env.radar_configs[i].range)
    points, index = cloud.near("boundary", at, reach)
    known = (s["seen_boundary"][e].cpu().numpy()[:, index] != 0).any(0)
    inside = np.linalg.norm(points - at, axis=1) <= reach
    gaps = np.linalg.norm(s["center"][e].double().cpu().numpy() - at, axis=1)
    bodies = np.array([one.length + one.width for one in env.robot_configs])
    return {
        "mates": float((gaps <= np.minimum(reach + bodies, env.radar_configs[i].range)).sum() - 1),
        "plan_rows": float(len(cloud.rows(at, reach))),
        "plan_near": float(len(index)),
        "plan_known": float((known & inside).sum()),
    }
