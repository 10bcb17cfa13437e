"""Frontier targets of all teams, shared by the classical planners and by a learned choice: what there is to choose
from, which targets are given up, and how a chosen one is approached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from maexp.envs.navigation import Navigation
from maexp.kernels.types import DT

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

DWELL = 3  # decisions beside a target that does not go away, or stuck on the way to it, before it is given up
STUCK = 0.25  # a robot that has moved less than so many clearances since the last decision is stuck
BETA = 0.03  # weight of a radar range of travel against a whole disc of unknown cells
LEAST_GAIN = 0.3  # targets with less to see, as a share of the radar's disc, are hardly worth a way of their own
SIGHT = 3.0  # goals for plain DWA lie at most so many radar ranges away


@dataclass(frozen=True)
class Scene:
    """What targets are chosen from. K targets per robot; those that are absent are infinitely far.

    Attributes:
        travel: float32 [E, N, K], way from robot to target [m].
        points: float32 [E, N, K, 2], where the targets are [m].
        size: float32 [E, N, K], frontier cells behind each.
        gain: float32 [E, N, K], unknown cells in radar range and sight of each, as a share of the radar's disc.
        middle: float32 [E, N, K, 2], the middle of those, from the target [m].
        alive: bool [E, N], robots that still move.
        nav: the env's grids.
        block: int64 [E, N, K], the blocks of frontier cells that they stand for, 0 for absent ones; None: K is the
            number of blocks, in order.
    """

    travel: torch.Tensor
    points: torch.Tensor
    size: torch.Tensor
    gain: torch.Tensor
    middle: torch.Tensor
    alive: torch.Tensor
    nav: Navigation
    block: torch.Tensor | None = None

    def spread(self, per_row: torch.Tensor) -> torch.Tensor:
        """[E, R, K] of what is known -> [E, N, K] of the robots."""
        return per_row.expand(-1, self.travel.shape[1], -1)

    def cells(self) -> torch.Tensor:
        """Cells of the targets, int64 [E, N, K]; -1 for absent ones."""
        return self.spread(self.nav.target if self.block is None else self.nav.cell)

    def of_blocks(self, per_block: torch.Tensor) -> torch.Tensor:
        """[E, N, blocks] -> [E, N, K]: what belongs to these targets."""
        return per_block if self.block is None else per_block.gather(2, self.block)

    def to_blocks(self, values: torch.Tensor) -> torch.Tensor:
        """[E, N, K, ...] -> [E, N, blocks, ...], 0 for blocks without a target.

        A sum over all blocks adds up in another order than one over the targets: here the former is kept.
        """
        if self.block is None:
            return values
        there = self.travel.isfinite().view(*self.block.shape, *[1] * (values.dim() - 3))
        index = self.block.view(there.shape).expand(values.shape)
        blocks = values.new_zeros((*values.shape[:2], self.nav.num_blocks, *values.shape[3:]))
        return blocks.scatter_add_(2, index, torch.where(there, values, 0.0))


def value_targets(scene: Scene) -> torch.Tensor:
    """What every target is worth to every robot by itself, in radar discs, float32 [E, N, K]; -inf: out of reach.

    Unknown area against the way there (Burgard et al. 2005).
    """
    return torch.where(
        scene.travel.isfinite(), scene.gain - BETA * scene.travel / scene.nav.radar_range, -torch.inf
    )


def plan_in_turn(
    gain: torch.Tensor, value: torch.Tensor, point: torch.Tensor, hears: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Robots choose one after the other, the one with the most to win first; a target taken lowers the gain of others
    that can be seen from there (Burgard et al. 2005). One round per robot, all envs together.

    Args:
        gain: float32 [E, N, M], what is to be seen from a candidate.
        value: float32 [E, N, M], what it is worth as long as nobody has claimed any of that; -inf: there is none.
        point: float32 [E, N, M, 2], where they are [radar ranges].
        hears: bool [E, N, N], robots whose choices a robot gets to know.

    Returns:
        each candidate's value when it is its robot's turn, float32 [E, N, M]; the candidate taken, int64 [E, N] (0 for
        robots without any); the share of the gain that was claimed before, float32 [E, N, M].
    """
    env = torch.arange(len(gain), device=gain.device)
    taken = torch.zeros(gain.shape[:2], dtype=torch.int64, device=gain.device)
    score, claimed, left = torch.zeros_like(gain), torch.zeros_like(gain), torch.ones_like(gain)
    some = value > -torch.inf
    waiting = some.any(-1)
    rest = torch.where(some, value, 0.0) - gain
    for _ in range(gain.shape[1]):
        value = gain * left + rest
        best, index = torch.where(some, value, -torch.inf).max(-1)
        robot = torch.where(waiting, best, -torch.inf).argmax(1)
        acts = waiting[env, robot]
        k = index[env, robot]
        score[env, robot] = torch.where(acts.unsqueeze(-1), value[env, robot], score[env, robot])
        claimed[env, robot] = torch.where(acts.unsqueeze(-1), 1.0 - left[env, robot], claimed[env, robot])
        taken[env, robot] = torch.where(acts, k, taken[env, robot])
        waiting[env, robot] = False
        gap = (point - point[env, robot, k].view(-1, 1, 1, 2)).norm(dim=-1)
        told = (acts.unsqueeze(-1) & hears[env, :, robot]).unsqueeze(-1)
        left = torch.where(told, left * gap.clamp(max=1.0), left)
    return score, taken, claimed


class TargetTracker:
    """The targets of an env's teams, with a memory of those that led nowhere.

    Args:
        env: gives the grids; only read.

    Attributes:
        state: tensors that later decisions depend on: ``dwell`` [E, N, K], ``chosen`` [E, N, 1] (-1 = none),
            ``stood`` [E, N, 2] [m], ``counted`` [E], the macro step that `dwell` was last counted in.
    """

    def __init__(self, env: ExplorationEnv):
        self.env, self.nav = env, Navigation(env)
        self.seconds = DT * env.local_steps
        shape, device = (env.num_envs, env.num_robots), env.device
        self.state = {
            "dwell": torch.zeros((*shape, self.nav.num_blocks), dtype=torch.int32, device=device),
            "chosen": torch.full((*shape, 1), -1, device=device),
            "stood": torch.zeros((*shape, 2), device=device),
            "counted": torch.full((env.num_envs,), -1, dtype=torch.int32, device=device),
        }

    def look(self, compact: bool = False) -> Scene:
        """Bring everything up to date with the env, and give up what led nowhere (once a macro step).

        Args:
            compact: list the targets that there are (`Scene.block`), not one for every block of frontier cells.
        """
        nav, robots = self.nav, self.env.num_robots
        nav.update()
        cells = nav.cell if compact else nav.target
        block = nav.block.clamp_min(0).expand(-1, robots, -1) if compact else None
        points = nav.points(cells.clamp_min(0)).expand(-1, robots, -1, -1)
        travel = self._give_up(nav.travel(cells), points, block)
        gain, middle = self.outlook(cells if compact else None)
        size = nav.size.expand(-1, robots, -1)
        return Scene(
            travel=travel,
            points=points,
            size=(size.gather(2, block) if compact else size).float(),
            gain=gain,
            middle=middle,
            alive=nav.alive(),
            nav=nav,
            block=block,
        )

    def outlook(
        self, cells: torch.Tensor | None = None, known: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`Scene.gain` and `Scene.middle`; arguments as in `Navigation.look_around`."""
        nav, robots = self.nav, self.env.num_robots
        disc = torch.pi * (nav.radar_range / nav.cell_of_env()) ** 2
        area, middle = nav.look_around(nav.radar_range, cells, known)
        return (area / disc.view(-1, 1, 1)).expand(-1, robots, -1), middle.expand(-1, robots, -1, -1)

    def take(
        self, chosen: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Remember a choice and turn it into goals.

        Args:
            chosen: int64 [E, N], the target of each robot; -1 = none: it drives anywhere.
            cell: int64 [E, N], where that is; any where there is none.
            toward: float32 [E, N, 2], the middle of what is to be seen from there, from the target [m].

        Returns:
            region int64 [E, N] and offset float32 [E, N, 2].
        """
        nav, found = self.nav, chosen >= 0
        self.state["chosen"] = chosen.unsqueeze(-1).clone()
        cell = torch.where(found, cell, -1)
        target = torch.where(found.unsqueeze(-1), nav.points(cell.clamp_min(0)), self._roam())
        return nav.to_action(self._approach(cell, target, torch.where(found.unsqueeze(-1), toward, 0.0)))

    def drive(self, speed: torch.Tensor) -> torch.Tensor:
        """How far robots get in a macro step [m], from their speeds [m/s]."""
        accel, limit = (self.nav.pick(self.env.simulation.robot_tensors[one]) for one in ("max_accel", "max_speed"))
        return torch.minimum(speed * self.seconds + 0.5 * accel * self.seconds**2, limit * self.seconds)

    def speed(self) -> torch.Tensor:
        """Of every robot [m/s], float32 [E, N]."""
        return torch.hypot(self.nav.state["pose"][..., 2], self.nav.state["slip"])

    def _approach(self, goal_cell: torch.Tensor, target: torch.Tensor, toward: torch.Tensor) -> torch.Tensor:
        """Goals [m] on the way to `target` (of cell `goal_cell`, -1 = none), float32 [E, N, 2].

        A robot that stopped at its target would stand there until the next decision. So goals lie beyond targets that
        are near, `toward` what is to be seen from there, as far as the robot still gets. Plain DWA sees no way around
        walls and brakes too late between them: it gets a point in sight, and off open ground one near enough to brake
        for.
        """
        nav = self.nav
        drive = self.drive(self.speed())
        gap = (target - nav.centers()).norm(dim=-1)
        left = (drive - gap).clamp_min(0.0) / toward.norm(dim=-1).clamp_min(1e-6)
        beyond = target + toward * left.unsqueeze(-1)
        if self.env.planner_config.name == "wavefront":
            return beyond
        threshold = self.env.simulation.robot_tensors["collision_threshold"]
        far = nav.waypoints(goal_cell, target, (drive + threshold).clamp(max=SIGHT * nav.radar_range))
        near = (self.drive(torch.zeros_like(drive)) + threshold).clamp(max=nav.radar_range)
        near = nav.waypoints(goal_cell, target, near)
        is_open = nav.leads_through_open_ground(far)
        at_target = (far - target).norm(dim=-1) <= nav.cell_of_env().view(-1, 1)
        far = torch.where(at_target.unsqueeze(-1), beyond, far)
        return torch.where(is_open.unsqueeze(-1), far, near)

    def _give_up(
        self, travel: torch.Tensor, points: torch.Tensor, block: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Drop targets that robots stood beside in vain (what is unknown there cannot be seen from there), and for
        each robot those that it got stuck on the way to. ``block`` as in `Scene`."""
        nav = self.nav
        s = {name: nav.pick(value) for name, value in self.state.items()}
        step = nav.state["macro_step"]
        begun, due = step == 0, step != s["counted"]
        s["dwell"][begun], s["chosen"][begun] = 0, -1
        due = (due | begun).view(-1, 1, 1)
        near = torch.clamp(1.5 * nav.cell_of_env(), min=nav.clearance).view(-1, 1, 1)
        beside = travel.isfinite() & ((points - nav.centers().unsqueeze(2)).norm(dim=-1) <= near) & due
        beside = beside.any(1, keepdim=True).expand_as(beside) if nav.rows == 1 else beside
        if block is None:
            s["dwell"] += beside
        else:
            s["dwell"].scatter_add_(2, block, beside.to(torch.int32))
        stuck = (nav.centers() - s["stood"]).norm(dim=-1, keepdim=True) < STUCK * nav.clearance
        stuck = stuck & (s["chosen"] >= 0) & nav.alive().unsqueeze(-1) & due
        s["dwell"].scatter_add_(2, s["chosen"].clamp_min(0), stuck.to(torch.int32))
        s["stood"] = torch.where(due, nav.centers(), s["stood"])
        s["counted"] = step.clone()
        dwell = s["dwell"] if block is None else s["dwell"].gather(2, block)
        kept = travel.masked_fill(dwell >= DWELL, torch.inf)
        # Nothing else left: try them all once more.
        again = ~kept.isfinite().flatten(1).any(1)
        s["dwell"][again] = 0
        self.state.update({name: nav.put(value, s[name]) for name, value in self.state.items()})
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
