"""Classical planners, batched on the env's device: the yardstick for what is learned.

A policy is a `TensorDictModule` that writes ("agents", "action", "region") and ("agents", "action", "offset"), in
volumes ("agents", "action", "goal") and ("agents", "action", "heading").
All but `random` look into the env: what the team knows as a grid, its frontiers gathered in targets, and the way from
every robot to every target. They differ in which targets each robot likes best (`envs/targets/heuristics.py`). That the
robots of a team go to different ones, and how a target is approached, they share (`envs/targets/tracker.py`).

Sources: docs/planners.md. Tuning: docs/reports/planners.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from tensordict.nn import TensorDictModule

from maexp.envs import ExplorationEnv
from maexp.envs.maps.nav_grid import build_nav_grid, open_cells
from maexp.envs.targets.heuristics import CLASSICAL, rank_by_utility
from maexp.envs.targets.observation import gather_points
from maexp.envs.targets.tracker import TensorScene, keyed_uniform, make_tracker
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN


class FrontierPlanner:
    """A choice of targets as a policy; calling it plans for all envs.

    Args:
        env: the env to plan for.
        rank: `TensorScene` -> float32 [E, N, K], what each robot thinks of each target; it wants the one with the
            highest number, and takes the next one that is free where another robot has that; -inf: out of reach.
    """

    def __init__(self, env: ExplorationEnv, rank: Callable[[TensorScene], torch.Tensor]):
        self.rank, self.tracker = rank, make_tracker(env)

    def look(self) -> TensorScene:
        """What there is to choose from."""
        return self.tracker.look()

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`goals` as an action: region [E, N] and offset [E, N, 2], in volumes goal [E, N, 3] and heading [E, N]; the
        argument only ties the policy to an observation."""
        return self.tracker.env.space.to_action(self.tracker.env, self.goals())

    @torch.no_grad()
    def goals(self) -> torch.Tensor:
        """Where each robot goes, as `TargetTracker.take` gives it."""
        scene = self.look()
        chosen, waits = self.choose(scene)
        index = chosen.clamp_min(0).unsqueeze(-1)
        cell, block = scene.cells().gather(2, index), scene.block.gather(2, index).squeeze(-1)
        toward = gather_points(scene.middle, index).squeeze(2)
        return self.tracker.take(torch.where(chosen >= 0, block, -1), cell.squeeze(-1), toward, waits)

    def choose(self, scene: TensorScene) -> tuple[torch.Tensor, torch.Tensor]:
        """The target of each robot, and which robots wait, as `TargetTracker.share` shares them out."""
        return self.tracker.share(self.rank(scene), scene.travel, scene.points)


class OraclePlanner(FrontierPlanner):
    """`cost_utility` that is told how much of the true map each target would show: a reference, no competitor."""

    def __init__(self, env: ExplorationEnv):
        super().__init__(env, rank_by_utility)
        grids = [open_cells(build_nav_grid(world)) for world in env.maps]
        shape = (len(grids), self.tracker.nav.known.shape[-1])
        self.open = torch.zeros(shape, dtype=torch.bool, device=env.device)
        for row, grid in zip(self.open, grids, strict=True):
            row[: len(grid)] = torch.from_numpy(grid).to(env.device)

    def look(self) -> TensorScene:
        scene, nav = super().look(), self.tracker.nav
        seen = torch.where(nav.known == UNKNOWN, UNKNOWN, FREE)
        truth = torch.where(self.open[nav.state["map_id"].long()].unsqueeze(1), seen, OBSTACLE).to(torch.uint8)
        gain, middle = self.tracker.outlook(truth)
        return replace(scene, gain=gain, middle=middle)


class RandomPolicy:
    """A region and an offset, in volumes a goal, drawn evenly for every robot."""

    def __init__(self, env: ExplorationEnv):
        self.env = env

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.env.space.anywhere(self.env, keyed_uniform(self.env, 3))


def as_module(make: Callable, env: ExplorationEnv) -> TensorDictModule:
    """`make(env)`, which gives regions and offsets, in volumes goals and headings, as a policy on tensordicts."""
    if env.planner_config.name == "direct":
        raise ValueError("planner=direct takes controls, and this policy picks goals: use planner=dwa or wavefront")
    return TensorDictModule(
        make(env),
        in_keys=[("agents", "observation", "pose")],
        out_keys=[("agents", "action", name) for name in env.space.ACTION],
    )


def in_the_plane(name: str, make: Callable) -> Callable[[ExplorationEnv], TensorDictModule]:
    """`as_module` for what searches the plane; ValueError in volumes."""

    def build(env: ExplorationEnv) -> TensorDictModule:
        if env.space.DIMENSIONS > 2:
            others = ", ".join(word for word in POLICIES if word not in PLANAR)
            raise ValueError(f"policy={name} plans in the plane: choose one of {others} for volumes")
        return as_module(make, env)

    return build


def _plan_ahead(env: ExplorationEnv, true_world: bool = False) -> Callable:
    from maexp.agents.policies.lookahead import LookaheadPlanner  # builds on the planners of this file

    return LookaheadPlanner(env, true_world=true_world)


POLICIES: dict[str, Callable[[ExplorationEnv], TensorDictModule]] = {
    "random": partial(as_module, RandomPolicy),
    **{name: partial(as_module, partial(FrontierPlanner, rank=rank)) for name, rank in CLASSICAL.items()},
    "lookahead": in_the_plane("lookahead", _plan_ahead),
    "oracle": in_the_plane("oracle", OraclePlanner),
    "clairvoyant": in_the_plane("clairvoyant", partial(_plan_ahead, true_world=True)),
}
POLICIES["rrt_frontiers"] = in_the_plane("rrt_frontiers", partial(FrontierPlanner, rank=CLASSICAL["rrt_frontiers"]))
"""Name -> callable(env) -> policy."""

PLANAR = ("rrt_frontiers", "lookahead", "oracle", "clairvoyant")
"""Those that there are in the plane alone."""

REFERENCES = ("random", "oracle", "clairvoyant")
"""None is a classical planner that a learned policy competes with: one knows nothing, the others the true map."""
