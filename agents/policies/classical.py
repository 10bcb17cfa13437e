"""Classical planners, batched on the env's device: the yardstick for what is learned.

A policy is a `TensorDictModule` that writes ("agents", "action", "region") and ("agents", "action", "offset").
All but `random` look into the env: what the team knows as a grid, its frontiers gathered in targets, and the way
from every robot to every target. They differ in which targets each robot likes best. That the robots of a team go to
different ones, and how a target is approached, they share (`envs/targets.py`).

Sources: docs/planners.md. Tuning: docs/notes.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from tensordict.nn import TensorDictModule

from maexp.agents.runtime.choices import DECAY, REPULSION, RRT_HYSTERESIS, RRT_SAMPLES
from maexp.envs import ExplorationEnv
from maexp.envs.nav_grid import build_nav_grid, open_cells
from maexp.envs.targets import LEAST_GAIN, Scene, TargetTracker, keyed_uniform, plan_in_turn, value_targets
from maexp.kernels.assignment import FORBIDDEN, assign_targets
from maexp.kernels.frontier import FREE, OBSTACLE, UNKNOWN
from maexp.kernels.types import REGIONS

FAR = 1e5  # longer than any way [m]: puts targets that a robot takes for want of better ones behind all others


def rank_nearest(scene: Scene) -> torch.Tensor:
    """Each robot its nearest target (Yamauchi 1997)."""
    return _rank(scene, -scene.travel, _worthwhile(scene))


def rank_by_utility(scene: Scene) -> torch.Tensor:
    """Unknown area around the target against the way there; a target taken lowers what others near it offer."""
    return _rank_in_turn(scene, scene.gain, value_targets(scene), scene.travel.isfinite())


def rank_by_tree(scene: Scene) -> torch.Tensor:
    """Of the frontiers that random trees come upon, the best revenue (Umari and Mukhopadhyay 2017)."""
    nav = scene.nav
    found = scene.of_blocks(scene.spread(nav.grow_trees(RRT_SAMPLES, 0.5 * nav.radar_range)))
    found = found & scene.travel.isfinite()
    found = found | ~found.any(-1, keepdim=True)  # no tree of the team found any: all frontiers count
    near = (scene.points - nav.centers().unsqueeze(2)).norm(dim=-1) <= nav.radar_range
    gain = scene.gain * torch.where(near, RRT_HYSTERESIS, 1.0)
    return _rank_in_turn(scene, gain, value_targets(scene) + gain - scene.gain, found)


def _rank_in_turn(scene: Scene, gain: torch.Tensor, value: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """The values of the targets `among` all when it is their robot's turn, in a team in which everyone knows what the
    others choose (`plan_in_turn`)."""
    hears = torch.ones((*scene.alive.shape, scene.alive.shape[1]), dtype=torch.bool, device=gain.device)
    value = torch.where(among, value, -torch.inf)
    return _rank(scene, plan_in_turn(gain, value, scene.points / scene.nav.radar_range, hears)[0], among)


def rank_by_area(scene: Scene) -> torch.Tensor:
    """The nearest target that no other robot is nearer to; the nearest of all for robots without one (Voronoi)."""
    worth = _worthwhile(scene)
    travel = torch.where(worth & scene.alive.unsqueeze(-1), scene.travel, torch.inf)
    own = travel.argmin(1, keepdim=True) == torch.arange(travel.shape[1], device=travel.device).view(1, -1, 1)
    mine = own & travel.isfinite()
    mine = mine | ~mine.any(-1, keepdim=True)
    return _rank(scene, torch.where(mine, -travel, -FAR - travel), worth)


def rank_by_assignment(scene: Scene) -> torch.Tensor:
    """All robots different targets with the least total way (Hungarian method); surplus robots the nearest."""
    worth = _worthwhile(scene)
    scale = 100.0 / scene.nav.cell_of_env().view(-1, 1, 1)  # hundredths of a cell
    cost = torch.where(worth, (scene.travel * scale).clamp(max=FORBIDDEN - 1), FORBIDDEN).to(torch.int32)
    match = assign_targets(cost).unsqueeze(-1)
    matched = torch.arange(cost.shape[-1], device=cost.device) == match
    return _rank(scene, torch.where(matched, FAR, -scene.travel), worth)


def rank_by_force(scene: Scene) -> torch.Tensor:
    """The target whose way starts off closest to the force: pulls along the ways, pushes between robots.

    As in MMPF (Yu et al. 2021) a target pulls with its frontier cells over the way to it, around the walls.
    """
    nav, worth = scene.nav, _worthwhile(scene)
    at = nav.centers()
    ways = nav.points_on_way(scene.cells(), 3.0) - at.unsqueeze(2)
    ways = ways / ways.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    cell = nav.cell_of_env().view(-1, 1, 1)
    pull = torch.where(worth, scene.size / (scene.travel / cell).clamp_min(1.0) ** DECAY, 0.0)
    force = scene.to_blocks(pull.unsqueeze(-1) * ways).sum(2)
    apart = at.unsqueeze(2) - at.unsqueeze(1)
    gap = apart.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    push = REPULSION * (1.0 - gap / nav.radar_range).clamp_min(0.0) * scene.alive[:, None, :, None]
    force = force + scene.to_blocks(pull).sum(-1, keepdim=True) * (push * apart / gap).sum(2)
    along = (ways * force.unsqueeze(2)).sum(-1) / force.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return _rank(scene, pull * (1.0 + along), worth)


def _worthwhile(scene: Scene) -> torch.Tensor:
    """Targets in reach, bool [E, N, K]; those that offer little only for robots that get to none that offers more."""
    reached = scene.travel.isfinite()
    worth = reached & (scene.gain >= LEAST_GAIN)
    return torch.where(worth.any(-1, keepdim=True), worth, reached)


def _rank(scene: Scene, score: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """Targets by their `score` where they are `among` those that count, the others in reach behind, -inf the rest."""
    reached = scene.travel.isfinite()
    return torch.where(among & reached, score, torch.where(reached, -2.0 * FAR - scene.travel, -torch.inf))


class FrontierPlanner:
    """A choice of targets as a policy; calling it plans for all envs.

    Args:
        env: the env to plan for.
        rank: `Scene` -> float32 [E, N, K], what each robot thinks of each target; it wants the one with the highest
            number, and takes the next one that is free where another robot has that; -inf: out of reach.
    """

    def __init__(self, env: ExplorationEnv, rank: Callable[[Scene], torch.Tensor]):
        self.rank, self.tracker = rank, TargetTracker(env)

    def look(self) -> Scene:
        """What there is to choose from."""
        return self.tracker.look()

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Region [E, N] and offset [E, N, 2]; the argument only ties the policy to an observation."""
        scene = self.look()
        chosen, waits = self.choose(scene)
        index = chosen.clamp_min(0).unsqueeze(-1)
        cell, block = scene.cells().gather(2, index), scene.block.gather(2, index).squeeze(-1)
        toward = scene.middle.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, 2)).squeeze(2)
        return self.tracker.take(torch.where(chosen >= 0, block, -1), cell.squeeze(-1), toward, waits)

    def choose(self, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
        """The target of each robot, and which robots wait, as `TargetTracker.share` shares them out."""
        return self.tracker.share(self.rank(scene), scene.travel, scene.points)


class OraclePlanner(FrontierPlanner):
    """`cost_utility` that is told how much of the true map each target would show: a reference, no competitor."""

    def __init__(self, env: ExplorationEnv):
        super().__init__(env, rank_by_utility)
        grids = [open_cells(build_nav_grid(one)) for one in env.maps]
        shape = (len(grids), self.tracker.nav.known.shape[-1])
        self.open = torch.zeros(shape, dtype=torch.bool, device=env.device)
        for row, one in zip(self.open, grids, strict=True):
            row[: len(one)] = torch.from_numpy(one).to(env.device)

    def look(self) -> Scene:
        scene, nav = super().look(), self.tracker.nav
        seen = torch.where(nav.known == UNKNOWN, UNKNOWN, FREE)
        truth = torch.where(self.open[nav.state["map_id"].long()].unsqueeze(1), seen, OBSTACLE).to(torch.uint8)
        gain, middle = self.tracker.outlook(truth)
        return replace(scene, gain=gain, middle=middle)


class RandomPolicy:
    """A region and an offset drawn evenly for every robot."""

    def __init__(self, env: ExplorationEnv):
        self.env = env

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        draw = keyed_uniform(self.env, 3)
        region = (draw[..., 0] * REGIONS**2).long()
        return region, 2.0 * draw[..., 1:] - 1.0


def as_module(make: Callable, env: ExplorationEnv) -> TensorDictModule:
    """`make(env)`, which gives regions and offsets, as a policy on tensordicts."""
    if env.planner_config.name == "direct":
        raise ValueError("planner=direct takes controls, and this policy picks goals: use planner=dwa or wavefront")
    return TensorDictModule(
        make(env),
        in_keys=[("agents", "observation", "pose")],
        out_keys=[("agents", "action", "region"), ("agents", "action", "offset")],
    )


def _plan_ahead(env: ExplorationEnv, true_world: bool = False) -> Callable:
    from maexp.agents.policies.lookahead import LookaheadPlanner  # builds on the planners of this file

    return LookaheadPlanner(env, true_world=true_world)


CLASSICAL: dict[str, Callable[[Scene], torch.Tensor]] = {
    "nearest_frontier": rank_nearest,
    "cost_utility": rank_by_utility,
    "potential_field": rank_by_force,
    "rrt_frontiers": rank_by_tree,
    "voronoi": rank_by_area,
    "hungarian": rank_by_assignment,
}
"""The classical planners: name -> what robots think of targets, for many teams at once;
`maexp.agents.runtime.CHOICES` are the same for one team in NumPy."""

POLICIES: dict[str, Callable[[ExplorationEnv], TensorDictModule]] = {
    "random": partial(as_module, RandomPolicy),
    **{name: partial(as_module, partial(FrontierPlanner, rank=rank)) for name, rank in CLASSICAL.items()},
    "lookahead": partial(as_module, _plan_ahead),
    "oracle": partial(as_module, OraclePlanner),
    "clairvoyant": partial(as_module, partial(_plan_ahead, true_world=True)),
}
"""Name -> callable(env) -> policy."""

REFERENCES = ("random", "oracle", "clairvoyant")
"""None is a classical planner that a learned policy competes with: one knows nothing, the others the true map."""
