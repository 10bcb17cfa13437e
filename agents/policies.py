"""Classical planners, batched on the env's device: the yardstick for what is learned.

A policy is a `TensorDictModule` that writes ("agents", "action", "region") and ("agents", "action", "offset").
All but `random` look into the env: what the team knows as a grid, its frontiers gathered in targets, and the way
from every robot to every target. They differ in which target each robot takes. How it is approached they share
(`FrontierPlanner._approach`): as fast as the env's planner can be trusted with, and on into the unknown where the
robot would be there before its next decision.

Sources and tuning: docs/planners.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from tensordict.nn import TensorDictModule

from maexp.envs import ExplorationEnv
from maexp.envs.navigation import Navigation
from maexp.kernels.assignment import FORBIDDEN, assign_targets

DWELL = 3  # decisions beside a target that does not go away, or stuck on the way to it, before it is given up
STUCK = 0.25  # a robot that has moved less than so many clearances since the last decision is stuck
SIGHT = 3.0  # goals for plain DWA lie at most so many radar ranges away
REGION_COUNT = 64
BETA = 0.03  # weight of a radar range of travel against a whole disc of unknown cells
LEAST_GAIN = 0.3  # targets with less to see, as a share of the radar's disc, wait until no others are left
RRT_SAMPLES = 512
RRT_HYSTERESIS = 1.5  # rrt_frontiers: gain of targets within a radar range counts this much more
DECAY = 1.0  # potential_field: a target pulls with its frontier cells over its way to this power
REPULSION = 1.0  # potential_field: push of a robot one radar range away, in pulls of a target there


@dataclass(frozen=True)
class Scene:
    """What targets are chosen from. K targets per robot; those that are absent are infinitely far.

    Attributes:
        travel: float32 [E, N, K], way from robot to target [m].
        points: float32 [E, N, K, 2], where the targets are [m].
        size: float32 [E, N, K], frontier cells behind each.
        gain: float32 [E, N, K], unknown cells in radar range and sight of each, as a share of the radar's disc.
        alive: bool [E, N], robots that still move.
        nav: the env's grids.
    """

    travel: torch.Tensor
    points: torch.Tensor
    size: torch.Tensor
    gain: torch.Tensor
    alive: torch.Tensor
    nav: Navigation

    def spread(self, per_row: torch.Tensor) -> torch.Tensor:
        """[E, R, K] of what is known -> [E, N, K] of the robots."""
        return per_row.expand(-1, self.travel.shape[1], -1)


def choose_nearest(scene: Scene) -> torch.Tensor:
    """Each robot its nearest target (Yamauchi 1997)."""
    return scene.travel.argmin(-1)


def choose_in_turn(scene: Scene, gain: torch.Tensor, cost: torch.Tensor) -> torch.Tensor:
    """Pairs in order of gain - cost; a target taken lowers the gain of others that can be seen from there.

    One round per robot: it depends on the rounds before, all envs take it together (Burgard et al. 2005). Robots
    without a way to any target (those that have collided) are left over, and get target 0.
    """
    robots = scene.travel.shape[1]
    chosen = torch.zeros_like(scene.travel[..., 0], dtype=torch.long)
    waiting = torch.ones_like(scene.alive)
    env = torch.arange(len(chosen), device=chosen.device)
    for _ in range(robots):
        value = torch.where(waiting.unsqueeze(-1), gain - cost, -torch.inf)
        most, best = value.flatten(1).max(1)
        robot, target = best // value.shape[2], best % value.shape[2]
        some = most > -torch.inf  # else only those are left, and `robot` is any
        chosen[env, robot] = torch.where(some, target, chosen[env, robot])
        waiting[env, robot] &= ~some
        here = scene.points[env, robot, target]
        far = (scene.points - here.view(-1, 1, 1, 2)).norm(dim=-1) / scene.nav.radar_range
        gain = gain * far.clamp(max=1.0)
    return chosen


def choose_by_utility(scene: Scene) -> torch.Tensor:
    """Unknown area around the target against the way there."""
    return choose_in_turn(scene, scene.gain, BETA * scene.travel / scene.nav.radar_range)


def choose_by_tree(scene: Scene) -> torch.Tensor:
    """Of the frontiers that random trees come upon, the best revenue (Umari and Mukhopadhyay 2017)."""
    nav = scene.nav
    found = scene.spread(nav.grow_trees(RRT_SAMPLES, 0.5 * nav.radar_range)) & scene.travel.isfinite()
    found = found | ~found.any(-1, keepdim=True)  # no tree of the team found any: all frontiers count
    near = (scene.points - nav.centers().unsqueeze(2)).norm(dim=-1) <= nav.radar_range
    gain = scene.gain * torch.where(near, RRT_HYSTERESIS, 1.0)
    cost = torch.where(found, BETA * scene.travel / nav.radar_range, torch.inf)
    return choose_in_turn(scene, gain, cost)


def choose_by_area(scene: Scene) -> torch.Tensor:
    """The nearest target that no other robot is nearer to; the nearest of all for robots without one (Voronoi)."""
    travel = torch.where(scene.alive.unsqueeze(-1), scene.travel, torch.inf)
    own = travel.argmin(1, keepdim=True) == torch.arange(travel.shape[1], device=travel.device).view(1, -1, 1)
    mine = torch.where(own, travel, torch.inf)
    has_own = mine.isfinite().any(-1)
    return torch.where(has_own, mine.argmin(-1), travel.argmin(-1))


def choose_by_assignment(scene: Scene) -> torch.Tensor:
    """All robots different targets with the least total way (Hungarian method); surplus robots the nearest."""
    finite = scene.travel.isfinite()
    scale = 100.0 / scene.nav.cell_of_env().view(-1, 1, 1)  # hundredths of a cell
    cost = torch.where(finite, (scene.travel * scale).clamp(max=FORBIDDEN - 1), FORBIDDEN).to(torch.int32)
    match = assign_targets(cost)
    return torch.where(match >= 0, match, scene.travel.argmin(-1))


def choose_by_force(scene: Scene) -> torch.Tensor:
    """The target whose way starts off closest to the force: pulls along the ways, pushes between robots.

    As in MMPF (Yu et al. 2021) a target pulls with its frontier cells over the way to it, around the walls.
    """
    nav = scene.nav
    at = nav.centers()
    ways = nav.first_points(3.0) - at.unsqueeze(2)
    ways = ways / ways.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    cell = nav.cell_of_env().view(-1, 1, 1)
    pull = torch.where(scene.travel.isfinite(), scene.size / (scene.travel / cell).clamp_min(1.0) ** DECAY, 0.0)
    force = (pull.unsqueeze(-1) * ways).sum(2)
    apart = at.unsqueeze(2) - at.unsqueeze(1)
    gap = apart.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    push = REPULSION * (1.0 - gap / nav.radar_range).clamp_min(0.0) * scene.alive[:, None, :, None]
    force = force + pull.sum(-1, keepdim=True) * (push * apart / gap).sum(2)
    along = (ways * force.unsqueeze(2)).sum(-1) / force.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return torch.where(scene.travel.isfinite(), pull * (1.0 + along), -torch.inf).argmax(-1)


class FrontierPlanner:
    """A choice of targets as a policy; calling it plans for all envs.

    Args:
        env: the env to plan for.
        choose: `Scene` -> int64 [E, N], the target of each robot.
    """

    def __init__(self, env: ExplorationEnv, choose: Callable[[Scene], torch.Tensor]):
        self.env, self.choose, self.nav = env, choose, Navigation(env)
        self.seconds = 0.1 * env.local_steps
        shape = (env.num_envs, env.num_robots)
        self.dwell = torch.zeros((*shape, self.nav.num_blocks), dtype=torch.int32, device=env.device)
        self.chosen = torch.full((*shape, 1), -1, device=env.device)
        self.stood = torch.zeros((*shape, 2), device=env.device)

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Region [E, N] and offset [E, N, 2]; the argument only ties the policy to an observation."""
        nav = self.nav
        nav.update()
        cells = nav.target.expand(-1, self.env.num_robots, -1)
        points = nav.points(cells.clamp_min(0))
        travel = self._give_up(nav.travel(), points)
        gain, middle = self._look_around()
        travel = _prefer(travel, gain >= LEAST_GAIN)
        scene = Scene(
            travel=travel,
            points=points,
            size=nav.size.expand(-1, self.env.num_robots, -1).float(),
            gain=gain,
            alive=nav.alive(),
            nav=nav,
        )
        chosen = self.choose(scene).unsqueeze(-1)
        found = travel.gather(2, chosen).squeeze(-1).isfinite()
        self.chosen = torch.where(found.unsqueeze(-1), chosen, -1)
        self.stood = nav.centers().clone()
        goal_cell = torch.where(found, cells.gather(2, chosen).squeeze(-1), -1)
        target = torch.where(found.unsqueeze(-1), nav.points(goal_cell.clamp_min(0)), self._roam())
        toward = middle.gather(2, chosen.unsqueeze(-1).expand(-1, -1, -1, 2)).squeeze(2)
        return nav.to_action(self._approach(goal_cell, target, torch.where(found.unsqueeze(-1), toward, 0.0)))

    def _approach(self, goal_cell: torch.Tensor, target: torch.Tensor, toward: torch.Tensor) -> torch.Tensor:
        """Goals [m] on the way to `target` (of cell `goal_cell`, -1 = none), float32 [E, N, 2].

        A robot that stopped at its target would stand there until the next decision. So goals lie beyond targets that
        are near, `toward` what is to be seen from there, as far as the robot still gets. Plain DWA sees no way around
        walls and brakes too late between them: it gets a point in sight, and off open ground one near enough to brake
        for.
        """
        nav = self.nav
        drive = self._drive(torch.hypot(nav.state["pose"][..., 2], nav.state["slip"]))
        gap = (target - nav.centers()).norm(dim=-1)
        left = (drive - gap).clamp_min(0.0) / toward.norm(dim=-1).clamp_min(1e-6)
        beyond = target + toward * left.unsqueeze(-1)
        if self.env.planner_config.name == "wavefront":
            return beyond
        threshold = self.env.simulation.robot_tensors["threshold"]
        far = nav.waypoints(goal_cell, target, (drive + threshold).clamp(max=SIGHT * nav.radar_range))
        near = (self._drive(torch.zeros_like(drive)) + threshold).clamp(max=nav.radar_range)
        near = nav.waypoints(goal_cell, target, near)
        is_open = nav.leads_through_open_ground(far)
        at_target = (far - target).norm(dim=-1) <= nav.cell_of_env().view(-1, 1)
        far = torch.where(at_target.unsqueeze(-1), beyond, far)
        return torch.where(is_open.unsqueeze(-1), far, near)

    def _drive(self, speed: torch.Tensor) -> torch.Tensor:
        """How far robots get in a macro step [m], from their speeds [m/s]."""
        robots = self.env.simulation.robot_tensors
        drive = speed * self.seconds + 0.5 * robots["max_accel"] * self.seconds**2
        return torch.minimum(drive, robots["max_speed"] * self.seconds)

    def _look_around(self) -> tuple[torch.Tensor, torch.Tensor]:
        """What is to be seen from every target, as a share of the radar's disc, float32 [E, N, K], and the middle of
        it, from the target [m], float32 [E, N, K, 2]."""
        nav, robots = self.nav, self.env.num_robots
        disc = torch.pi * (nav.radar_range / nav.cell_of_env()) ** 2
        area, middle = nav.look_around(nav.radar_range)
        return (area / disc.view(-1, 1, 1)).expand(-1, robots, -1), middle.expand(-1, robots, -1, -1)

    def _give_up(self, travel: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Drop targets that robots stood beside in vain (what is unknown there cannot be seen from there), and for
        each robot those that it got stuck on the way to."""
        nav = self.nav
        near = torch.clamp(1.5 * nav.cell_of_env(), min=nav.clearance).view(-1, 1, 1)
        fresh = nav.state["macro_step"] == 0
        self.dwell[fresh], self.chosen[fresh] = 0, -1
        beside = travel.isfinite() & ((points - nav.centers().unsqueeze(2)).norm(dim=-1) <= near)
        self.dwell += beside.any(1, keepdim=True) if nav.rows == 1 else beside
        stuck = (nav.centers() - self.stood).norm(dim=-1, keepdim=True) < STUCK * nav.clearance
        stuck = stuck & (self.chosen >= 0) & nav.alive().unsqueeze(-1)
        self.dwell.scatter_add_(2, self.chosen.clamp_min(0), stuck.to(torch.int32))
        kept = travel.masked_fill(self.dwell >= DWELL, torch.inf)
        # Nothing else left: try them all once more.
        again = ~kept.isfinite().flatten(1).any(1)
        self.dwell[again] = 0
        return torch.where(again.view(-1, 1, 1), travel, kept)

    def _roam(self) -> torch.Tensor:
        """Where robots without a target go [m]: anywhere, [E, N, 2]."""
        m = self.nav.state["map_id"].long()
        lower, upper = self.nav.lower[m].unsqueeze(1), self.nav.upper[m].unsqueeze(1)
        return lower + keyed_uniform(self.env, 2) * (upper - lower)


def keyed_uniform(env: ExplorationEnv, count: int) -> torch.Tensor:
    """Numbers in [0, 1), float32 [E, N, count], from (seed, env, episode, macro step) alone: no generator's
    state, and the same for env i in any batch."""
    state = env.simulation.tensors
    robots = torch.arange(env.num_robots * count, device=env.device).view(1, env.num_robots, count)
    key = torch.zeros((env.num_envs, 1, 1), dtype=torch.int64, device=env.device)
    for part in (*(state[name].view(-1, 1, 1) for name in ("seed", "env_id", "episode", "macro_step")), robots):
        key = _mix(key + part)
    return ((key >> 40) & 0xFFFFFF).float() / float(1 << 24)


def _mix(x: torch.Tensor) -> torch.Tensor:
    """Finaliser of splitmix64 (Steele et al. 2014) on int64, which wraps as uint64 does."""
    x = x + (0x9E3779B97F4A7C15 - (1 << 64))
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))) * (0xBF58476D1CE4E5B9 - (1 << 64))
    x = (x ^ ((x >> 27) & ((1 << 37) - 1))) * (0x94D049BB133111EB - (1 << 64))
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def _prefer(travel: torch.Tensor, worth: torch.Tensor) -> torch.Tensor:
    """`travel` without the targets that are not `worth` it, for robots that can get to one that is."""
    kept = travel.masked_fill(~worth, torch.inf)
    return torch.where(kept.isfinite().any(-1, keepdim=True), kept, travel)


class RandomPolicy:
    """A region and an offset drawn evenly for every robot."""

    def __init__(self, env: ExplorationEnv):
        self.env = env

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        draw = keyed_uniform(self.env, 3)
        region = (draw[..., 0] * REGION_COUNT).long()
        return region, 2.0 * draw[..., 1:] - 1.0


def _as_module(make: Callable, env: ExplorationEnv) -> TensorDictModule:
    if env.planner_config.name == "direct":
        raise ValueError("planner=direct takes controls, and this policy picks goals: use planner=dwa or wavefront")
    return TensorDictModule(
        make(env),
        in_keys=[("agents", "observation", "pose")],
        out_keys=[("agents", "action", "region"), ("agents", "action", "offset")],
    )


CHOICES: dict[str, Callable[[Scene], torch.Tensor]] = {
    "nearest_frontier": choose_nearest,
    "cost_utility": choose_by_utility,
    "potential_field": choose_by_force,
    "rrt_frontiers": choose_by_tree,
    "voronoi": choose_by_area,
    "hungarian": choose_by_assignment,
}
"""Choice of targets of every planner."""

POLICIES: dict[str, Callable[[ExplorationEnv], TensorDictModule]] = {
    "random": partial(_as_module, RandomPolicy),
    **{name: partial(_as_module, partial(FrontierPlanner, choose=choose)) for name, choose in CHOICES.items()},
}
"""Name -> callable(env) -> policy."""
