"""Classical planners, batched on the env's device: the yardstick for what is learned.

A policy is a `TensorDictModule` that writes ("agents", "action", "region") and ("agents", "action", "offset").
All but `random` look into the env: what the team knows as a grid, its frontiers gathered in targets, and the way
from every robot to every target. They differ in which target each robot takes. How it is approached they share
(`envs/targets.py`).

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


def choose_nearest(scene: Scene) -> torch.Tensor:
    """Each robot its nearest target (Yamauchi 1997)."""
    return _prefer(scene).travel.argmin(-1)


def choose_by_utility(scene: Scene) -> torch.Tensor:
    """Unknown area around the target against the way there; a target taken lowers what others near it offer."""
    return _choose_in_turn(scene, scene.gain, value_targets(scene))


def choose_by_tree(scene: Scene) -> torch.Tensor:
    """Of the frontiers that random trees come upon, the best revenue (Umari and Mukhopadhyay 2017)."""
    nav = scene.nav
    found = scene.of_blocks(scene.spread(nav.grow_trees(RRT_SAMPLES, 0.5 * nav.radar_range)))
    found = found & scene.travel.isfinite()
    found = found | ~found.any(-1, keepdim=True)  # no tree of the team found any: all frontiers count
    near = (scene.points - nav.centers().unsqueeze(2)).norm(dim=-1) <= nav.radar_range
    gain = scene.gain * torch.where(near, RRT_HYSTERESIS, 1.0)
    value = value_targets(scene) + gain - scene.gain
    return _choose_in_turn(scene, gain, torch.where(found, value, -torch.inf))


def _choose_in_turn(scene: Scene, gain: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """`plan_in_turn` of a team in which everyone knows what the others choose."""
    hears = torch.ones((*scene.alive.shape, scene.alive.shape[1]), dtype=torch.bool, device=gain.device)
    return plan_in_turn(gain, value, scene.points / scene.nav.radar_range, hears)[1]


def choose_by_area(scene: Scene) -> torch.Tensor:
    """The nearest target that no other robot is nearer to; the nearest of all for robots without one (Voronoi)."""
    scene = _prefer(scene)
    travel = torch.where(scene.alive.unsqueeze(-1), scene.travel, torch.inf)
    own = travel.argmin(1, keepdim=True) == torch.arange(travel.shape[1], device=travel.device).view(1, -1, 1)
    mine = torch.where(own, travel, torch.inf)
    has_own = mine.isfinite().any(-1)
    return torch.where(has_own, mine.argmin(-1), travel.argmin(-1))


def choose_by_assignment(scene: Scene) -> torch.Tensor:
    """All robots different targets with the least total way (Hungarian method); surplus robots the nearest."""
    scene = _prefer(scene)
    finite = scene.travel.isfinite()
    scale = 100.0 / scene.nav.cell_of_env().view(-1, 1, 1)  # hundredths of a cell
    cost = torch.where(finite, (scene.travel * scale).clamp(max=FORBIDDEN - 1), FORBIDDEN).to(torch.int32)
    match = assign_targets(cost)
    return torch.where(match >= 0, match, scene.travel.argmin(-1))


def choose_by_force(scene: Scene) -> torch.Tensor:
    """The target whose way starts off closest to the force: pulls along the ways, pushes between robots.

    As in MMPF (Yu et al. 2021) a target pulls with its frontier cells over the way to it, around the walls.
    """
    scene, nav = _prefer(scene), scene.nav
    at = nav.centers()
    ways = nav.points_on_way(scene.cells(), 3.0) - at.unsqueeze(2)
    ways = ways / ways.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    cell = nav.cell_of_env().view(-1, 1, 1)
    pull = torch.where(scene.travel.isfinite(), scene.size / (scene.travel / cell).clamp_min(1.0) ** DECAY, 0.0)
    force = scene.to_blocks(pull.unsqueeze(-1) * ways).sum(2)
    apart = at.unsqueeze(2) - at.unsqueeze(1)
    gap = apart.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    push = REPULSION * (1.0 - gap / nav.radar_range).clamp_min(0.0) * scene.alive[:, None, :, None]
    force = force + scene.to_blocks(pull).sum(-1, keepdim=True) * (push * apart / gap).sum(2)
    along = (ways * force.unsqueeze(2)).sum(-1) / force.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return torch.where(scene.travel.isfinite(), pull * (1.0 + along), -torch.inf).argmax(-1)


class FrontierPlanner:
    """A choice of targets as a policy; calling it plans for all envs.

    Args:
        env: the env to plan for.
        choose: `Scene` -> int64 [E, N], the target of each robot.
    """

    def __init__(self, env: ExplorationEnv, choose: Callable[[Scene], torch.Tensor]):
        self.choose, self.tracker = choose, TargetTracker(env)

    def look(self) -> Scene:
        """What there is to choose from."""
        return self.tracker.look()

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Region [E, N] and offset [E, N, 2]; the argument only ties the policy to an observation."""
        scene = self.look()
        chosen = self.choose(scene).unsqueeze(-1)
        found = scene.travel.gather(2, chosen).isfinite()
        cell, block = scene.cells().gather(2, chosen), scene.block.gather(2, chosen)
        toward = scene.middle.gather(2, chosen.unsqueeze(-1).expand(-1, -1, -1, 2)).squeeze(2)
        return self.tracker.take(torch.where(found, block, -1).squeeze(-1), cell.squeeze(-1), toward)


class OraclePlanner(FrontierPlanner):
    """`cost_utility` that is told how much of the true map each target would show: a reference, no competitor."""

    def __init__(self, env: ExplorationEnv):
        super().__init__(env, choose_by_utility)
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


def _prefer(scene: Scene) -> Scene:
    """`scene` without the targets that offer little, for robots that can get to one that offers more."""
    kept = scene.travel.masked_fill(scene.gain < LEAST_GAIN, torch.inf)
    return replace(scene, travel=torch.where(kept.isfinite().any(-1, keepdim=True), kept, scene.travel))


class RandomPolicy:
    """A region and an offset drawn evenly for every robot."""

    def __init__(self, env: ExplorationEnv):
        self.env = env

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        draw = keyed_uniform(self.env, 3)
        region = (draw[..., 0] * REGIONS**2).long()
        return region, 2.0 * draw[..., 1:] - 1.0


def _as_module(make: Callable, env: ExplorationEnv) -> TensorDictModule:
    if env.planner_config.name == "direct":
        raise ValueError("planner=direct takes controls, and this policy picks goals: use planner=dwa or wavefront")
    return TensorDictModule(
        make(env),
        in_keys=[("agents", "observation", "pose")],
        out_keys=[("agents", "action", "region"), ("agents", "action", "offset")],
    )


CLASSICAL: dict[str, Callable[[Scene], torch.Tensor]] = {
    "nearest_frontier": choose_nearest,
    "cost_utility": choose_by_utility,
    "potential_field": choose_by_force,
    "rrt_frontiers": choose_by_tree,
    "voronoi": choose_by_area,
    "hungarian": choose_by_assignment,
}
"""The classical planners: name -> choice of targets, for many teams at once; `maexp.agents.runtime.CHOICES` are the
same for one team in NumPy."""

POLICIES: dict[str, Callable[[ExplorationEnv], TensorDictModule]] = {
    "random": partial(_as_module, RandomPolicy),
    **{name: partial(_as_module, partial(FrontierPlanner, choose=choose)) for name, choose in CLASSICAL.items()},
    "oracle": partial(_as_module, OraclePlanner),
}
"""Name -> callable(env) -> policy."""

REFERENCES = ("random", "oracle")
"""Neither is a classical planner that a learned policy competes with: one knows nothing, the other the true map."""
