"""Small worlds for kernel tests: clouds on a lattice, jittered or rotated, and what an env holds of a moment."""

import math
import pickle
from types import SimpleNamespace

import numpy as np
import torch
from tensordict import TensorDict

from maexp.envs import ExplorationEnv, PointCloudMap
from maexp.kernels import unpack_flags


def room(width: int, height: int, kind: str = "lattice", seed: int = 0, spacing: float = 1.0) -> PointCloudMap:
    """A walled room of `width` x `height` points with a wall across and pillars; free points unless in a wall.

    kind: "lattice", "jittered", "rotated" (jittered and turned), or "mixed" (the left half at half spacing).
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(width + 2.0), np.arange(height + 2.0), indexing="ij")
    wall = (x == 0) | (y == 0) | (x == width + 1) | (y == height + 1)
    wall |= (x == width // 2) & (np.abs(y - height / 2) > 2.6)
    wall |= ((x == 4) | (x == width - 3)) & ((y == 5) | (y == height - 4))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * spacing
    wall = wall.ravel()
    free, spacings = points[~wall], np.full((~wall).sum(), spacing)
    if kind == "mixed":
        left = free[:, 0] < 0.3 * width * spacing
        fine = np.concatenate([free[left] + 0.25 * spacing * np.array([a, b, 0]) for a in (-1, 1) for b in (-1, 1)])
        free = np.concatenate([free[~left], fine])
        spacings = np.concatenate([np.full((~left).sum(), spacing), np.full(len(fine), 0.5 * spacing)])
    obstacles = points[wall]
    if kind in ("jittered", "rotated"):
        free[:, :2] += rng.uniform(-0.12, 0.12, (len(free), 2)) * spacing
        obstacles[:, :2] += rng.uniform(-0.06, 0.06, (len(obstacles), 2)) * spacing
    if kind == "rotated":
        free, obstacles = (turned(a, 0.41, (13.0, -7.0)) for a in (free, obstacles))
    return PointCloudMap(free, obstacles, spacing, name=f"{kind}-{width}", free_spacing=spacings)


def turned(points, angle: float, shift=(0.0, 0.0)) -> np.ndarray:
    """Points turned about the origin, then moved."""
    c, s = math.cos(angle), math.sin(angle)
    result = np.asarray(points).astype(np.float64)
    result[:, :2] = result[:, :2] @ np.array([[c, s], [-s, c]]) + np.asarray(shift)
    return result


def inputs(env: ExplorationEnv, index: int) -> SimpleNamespace:
    """Everything env `index` holds now, copied; flags in the order of its map."""
    state = env.simulation.tensors
    fields = {
        name: state[name][index].cpu().numpy().copy()
        for name in (
            "pose",
            "slip",
            "control",
            "waypoint",
            "collided",
            "crashed",
            "discovered",
            "overlap",
            "terms",
            "unscaled",
            "covered",
            "shared",
            "local_step",
            "active",
            "terminated",
            "milestone_step",
            "milestone_overlap",
            "milestone_path",
            "path_length",
            "map_id",
        )
    }
    now = SimpleNamespace(**env.snapshot(index) | fields | {"step": int(fields["local_step"])})
    m = int(fields["map_id"])
    for what, order in (("free", env.bank.order_free[m]), ("boundary", env.bank.order_boundary[m])):
        source = f"known_{what}" if env.comm_config.limited else f"seen_{what}"
        words = state[source][index : index + 1, :, : len(order)]
        flags = np.zeros((env.num_robots, len(order)), bool)
        flags[:, order] = unpack_flags(words, env.num_robots)[0].cpu().numpy()
        if not env.comm_config.limited:
            flags[:] = flags.any(0)
        setattr(now, f"known_{what}", flags)
    return now


def act(env: ExplorationEnv, generator: torch.Generator):
    """A random action for every robot."""
    e, n = env.num_envs, env.num_robots
    td = env.fake_tensordict().select(("agents", "action")).clone()
    if env.planner_config.name == "direct":
        td["agents", "action", "control"] = torch.rand(e, n, 2, generator=generator) * 2.4 - 1.2
        return td
    td["agents", "action", "region"] = torch.randint(64, (e, n), generator=generator)
    td["agents", "action", "offset"] = torch.rand(e, n, 2, generator=generator) * 2.0 - 1.0
    return td


def play_alike(small: ExplorationEnv, large: ExplorationEnv, steps: int, names: tuple[str, ...]):
    """Episode 4 of a batch of one and of a larger batch with the same random actions; yields the small env after every
    step, once `names` of its state are found to be the same bits. Halfway it is replaced by a pickled copy with its
    saved state."""
    for env in (small, large):
        env.set_episodes(torch.arange(4, 4 + env.num_envs))
        env.reset()
    generator = torch.Generator().manual_seed(1)
    for k in range(steps):
        if k == steps // 2:
            saved = small.state_dict()
            small = pickle.loads(pickle.dumps(small))
            small.load_state_dict(saved)
        action = act(large, generator)
        small.step(TensorDict({"agents": action["agents"][:1]}, [1]))
        large.step(action)
        for name in names:
            assert torch.equal(small.simulation.tensors[name][0], large.simulation.tensors[name][0]), name
        yield small


def ways_to_blocks(nav) -> torch.Tensor:
    """Way from every robot of a `Navigation` to the target of every block [m]: float32 [E, N, K], infinite: none."""
    ways = torch.full((*nav.way.shape[:2], nav.num_blocks + 1), torch.inf)
    ways.scatter_(2, (nav.block + 1).expand(nav.way.shape), nav.way)  # entry 0 takes what fills up
    return ways[..., 1:]


def drive(env: ExplorationEnv, steps: int, seed: int = 0) -> list[TensorDict]:
    """Tensordicts after each macro step of random actions, from where the env is."""
    generator = torch.Generator().manual_seed(seed)
    return [env.step(act(env, generator))["next"] for _ in range(steps)]


def index_of(points: np.ndarray, position) -> int:
    """The point [n, 2 or 3] nearest to a position."""
    return int(np.argmin(np.linalg.norm(points[:, :2] - position, axis=1)))
