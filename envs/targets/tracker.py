"""Frontier targets of all teams, shared by the classical planners and by a learned choice: what there is to choose
from, which targets are given up, and how a chosen one is approached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
import warp as wp

from maexp.envs.targets.features import drive_until_next
from maexp.envs.targets.heuristics import of_each
from maexp.envs.targets.navigation import Navigation
from maexp.kernels import goals, targets
from maexp.kernels.constants import DT
from maexp.kernels.distinct_targets import share_targets
from maexp.kernels.greedy_assignment import choose_in_turn
from maexp.kernels.hungarian import FORBIDDEN, assign_targets
from maexp.kernels.launches import launch_named, launch_on, view

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

DWELL = 3  # decisions beside a target that does not go away, or stuck on the way to it, before it is given up
STUCK = 0.25  # a robot that has moved less than so many clearances since the last decision is stuck
SIGHT = 3.0  # goals for plain DWA lie at most so many radar ranges away


@dataclass(frozen=True)
class TensorScene:
    """What targets are chosen from, a `maexp.envs.targets.heuristics.Scene`. K targets per robot; those that are absent
    are infinitely far.

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
    xp: ClassVar[Any] = torch

    @property
    def radar_range(self) -> float:
        return self.nav.radar_range

    @property
    def cell(self) -> torch.Tensor:
        return self.nav.cell_of_env().view(-1, 1, 1)

    @property
    def at(self) -> torch.Tensor:
        return self.nav.centers()

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

    def ways_ahead(self, cells: float) -> torch.Tensor:
        return self.nav.points_on_way(self.cells(), cells) - self.at.unsqueeze(2)

    def total(self, values: torch.Tensor) -> torch.Tensor:
        return self.to_blocks(values).sum(2)

    def in_turn(self, gain: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        return plan_in_turn(gain, value, self.points / self.radar_range, self.nav.state["comm"])[0]

    def match(self, among: torch.Tensor) -> torch.Tensor:
        cost = (self.travel * (100.0 / self.cell)).clamp(max=FORBIDDEN - 1)  # hundredths of a cell
        teams = self.heard(torch.where(among, cost, FORBIDDEN).to(torch.int32), FORBIDDEN)
        match = assign_targets(teams.flatten(0, 1)).view(*teams.shape[:3], 1)
        return of_each(torch, torch.arange(cost.shape[-1], device=cost.device) == match)

    def heard(self, values: torch.Tensor, blank: float) -> torch.Tensor:
        if self.nav.rows == 1:
            return values.unsqueeze(1)
        hears = self.nav.state["comm"].view(*self.alive.shape, -1, *[1] * (values.dim() - 2))
        return torch.where(hears, values.unsqueeze(1), blank)

    def found_by_trees(self, samples: int, branch: float) -> torch.Tensor:
        return self.of_blocks(self.spread(self.nav.grow_trees(samples, branch)))


def plan_in_turn(
    gain: torch.Tensor, value: torch.Tensor, point: torch.Tensor, hears: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Robots choose one after the other, the one with the most to win first; a target taken lowers the gain of others
    that can be seen from there (Burgard et al. 2005).

    Args:
        gain: float32 [E, N, M], what is to be seen from a candidate.
        value: float32 [E, N, M], what it is worth as long as nobody has claimed any of that; -inf: there is none.
        point: float32 [E, N, M, 2], where they are [radar ranges].
        hears: bool [E, N, N], robots whose choices a robot gets to know.

    Returns:
        each candidate's value when it is its robot's turn, float32 [E, N, M]; the candidate taken, int64 [E, N] (0 for
        robots without any); the share of the gain that was claimed before, float32 [E, N, M].
    """
    return choose_in_turn(gain, value, point, hears)


class TargetTracker:
    """The targets of an env's teams, with a memory of those that led nowhere.

    Args:
        env: gives the grids; only read.

    Attributes:
        state: tensors that later decisions depend on: ``dwell`` [E, N, K], ``chosen`` [E, N, 1] (-1 = none),
            ``stood`` [E, N, 2] [m], ``counted`` [E], the macro step that `dwell` was last counted in, ``home``
            [E, N, 2], where robots started [m]; NaN before the first look.
        body: float32 [E, N], radius of a circle around a robot [m]: what it takes up, whichever way it stands.
        dims: coordinates of a point.
    """

    dims = 2

    def __init__(self, env: ExplorationEnv):
        self.env, self.nav = env, Navigation(env)
        self.seconds = DT * env.local_steps
        self.disc = torch.pi * (self.nav.radar_range / self.nav.cell_size) ** 2  # cells in it, on each map
        shape, device = (env.num_envs, env.num_robots), env.device
        self.state = {
            "dwell": torch.zeros((*shape, self.nav.num_blocks), dtype=torch.int32, device=device),
            "chosen": torch.full((*shape, 1), -1, dtype=torch.int64, device=device),
            "stood": torch.zeros((*shape, 2), dtype=torch.float32, device=device),
            "counted": torch.full((env.num_envs,), -1, dtype=torch.int32, device=device),
            "home": torch.full((*shape, 2), torch.nan, dtype=torch.float32, device=device),
        }
        robots = env.simulation.robot_tensors
        half = 0.5 * torch.hypot(robots["length"], robots["width"])
        self.body = torch.maximum(half, robots["collision_threshold"])

    def look(self, envs: torch.Tensor | None = None) -> TensorScene:
        """Bring everything up to date with the env, and give up what led nowhere (once a macro step).

        Args:
            envs: int64 [S], the scene is of these, and the others stay as they are; None: all.
        """
        nav, robots = self.nav if envs is None else self.nav.some(envs), self.env.num_robots
        nav.update()
        self._note_home(nav)
        area, middle = nav.look_from_targets()
        return TensorScene(
            travel=self._give_up(nav, nav.way, nav.point, nav.block),
            points=nav.point,
            size=nav.around,
            gain=self._share(nav, area),
            middle=middle.expand(-1, robots, -1, -1),
            alive=nav.alive(),
            nav=nav,
            block=nav.block.clamp_min(0).expand(-1, robots, -1),
        )

    def outlook(self, known: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`gain` and `middle` of a `TensorScene` if ``known``, as in `Navigation.look_around`, were what is known."""
        area, middle = self.nav.look_around(self.nav.radar_range, self.nav.cell, known)
        return self._share(self.nav, area), middle.expand(-1, self.env.num_robots, -1, -1)

    def _share(self, nav: Navigation, area: torch.Tensor) -> torch.Tensor:
        """Unknown cells, [E, R, T], as a share of the radar's disc, for every robot: [E, N, T]."""
        disc = self.disc[nav.state["map_id"]].view(-1, 1, 1)
        return (area / disc).expand(-1, self.env.num_robots, -1)

    def share(
        self, preference: torch.Tensor, travel: torch.Tensor, points: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The target of each robot: what it likes best; with `targets.distinct` as far as the robots that it hears
        leave it that (`maexp.kernels.distinct_targets`).

        Args:
            preference: float32 [E, N, K], the highest first, the first of equals; -inf: out of reach.
            travel: float32 [E, N, K], way there [m].
            points: float32 [E, N, K, 2], where they are [m].

        Returns:
            int64 [E, N], -1 = none; bool [E, N], robots that get to targets and have none, for others take those.
        """
        some = (preference > -torch.inf).any(-1)
        if not self.env.targets_config.distinct:
            return torch.where(some, preference.argmax(-1), -1), torch.zeros_like(some)
        chosen = share_targets(preference, travel, points, self.nav.state["comm"], self.body)
        return chosen, some & (chosen < 0)

    def take(
        self, chosen: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor, waits: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Remember a choice and turn it into goals.

        Args:
            chosen: int64 [E, N], the target of each robot; -1 = none: it drives anywhere.
            cell: int64 [E, N], where that is; any where there is none.
            toward: float32 [E, N, 2], the middle of what is to be seen from there, from the target [m].
            waits: bool [E, N], robots that do not drive anywhere, but as `targets.spare` says; None: none does.

        Returns:
            float32 [E, N, 2] [m].
        """
        before, self.state["chosen"] = self.state["chosen"], chosen.long().unsqueeze(-1).clone()
        if (arrivals := self.env.arrivals) is not None:
            deciding = arrivals.state["deciding"].unsqueeze(-1)
            self.state["chosen"] = torch.where(deciding, self.state["chosen"], before)
            arrivals.propose(self.nav.points(cell.long().clamp_min(0)), chosen >= 0)
        return self.goals(chosen, cell, toward, waits)

    def goals(
        self, chosen: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor, waits: torch.Tensor | None = None
    ) -> torch.Tensor:
        """What `take` returns, without remembering the choice."""
        chosen, cell, toward = chosen.long().contiguous(), cell.long().clone(), toward.float().clone()
        target = self.nav.aim(chosen, cell, toward)
        goal = self._approach(cell, target, toward)
        if waits is not None and self.env.targets_config.distinct:
            goal = torch.where(waits.unsqueeze(-1), self._rest(), goal)
        return goal

    def _rest(self) -> torch.Tensor:
        """Where robots wait for which no target is left [m], float32 [E, N, 2].

        Who stands on the way of another to a target is nearer to it, and has got it (`maexp.kernels.distinct_targets`):
        a robot that waits where it is stands in nobody's way.
        """
        return self.state["home"] if self.env.targets_config.spare == "home" else self.nav.centers()

    def _note_home(self, nav: Navigation) -> None:
        """Remember where the robots stand whose episode begins, or that are seen for the first time."""
        home, at = nav.pick(self.state["home"]), nav.centers()
        begins = (nav.state["macro_step"] == 0).view(-1, 1, 1) | home.isnan()
        self.state["home"] = nav.put(self.state["home"], torch.where(begins, at, home))

    def drive(self, nav: Navigation, speed: torch.Tensor) -> torch.Tensor:
        """How far robots get in a macro step [m], from their speeds [m/s]."""
        accel, limit = (nav.pick(self.env.simulation.robot_tensors[name]) for name in ("max_accel", "max_speed"))
        return drive_until_next(torch, speed, accel, limit, self.seconds)

    def speed(self, nav: Navigation) -> torch.Tensor:
        """Of every robot [m/s], float32 [E, N]."""
        return torch.hypot(nav.state["pose"][..., 2], nav.state["slip"])

    def _approach(self, goal_cell: torch.Tensor, target: torch.Tensor, toward: torch.Tensor) -> torch.Tensor:
        """Goals [m] on the way to `target` (of cell `goal_cell`, -1 = none), float32 [E, N, 2].

        A robot that stopped at its target would stand there until the next decision. So goals lie beyond targets that
        are near, `toward` what is to be seen from there, as far as the robot still gets. Plain DWA sees no way around
        walls and brakes too late between them: it gets a point in sight, and off open ground one near enough to brake
        for.
        """
        nav = self.nav
        drive = self.drive(nav, self.speed(nav))
        gap = (target - nav.centers()).norm(dim=-1)
        left = (drive - gap).clamp_min(0.0) / toward.norm(dim=-1).clamp_min(1e-6)
        beyond = target + toward * left.unsqueeze(-1)
        if self.env.planner_config.name == "wavefront":
            return beyond
        threshold = self.env.simulation.robot_tensors["collision_threshold"]
        far = nav.waypoints(goal_cell, target, (drive + threshold).clamp(max=SIGHT * nav.radar_range))
        near = (self.drive(nav, torch.zeros_like(drive)) + threshold).clamp(max=nav.radar_range)
        near = nav.waypoints(goal_cell, target, near)
        is_open = nav.leads_through_open_ground(far)
        at_target = (far - target).norm(dim=-1) <= nav.cell_of_env().view(-1, 1)
        far = torch.where(at_target.unsqueeze(-1), beyond, far)
        return torch.where(is_open.unsqueeze(-1), far, near)

    def _give_up(self, nav: Navigation, way: torch.Tensor, point: torch.Tensor, block: torch.Tensor) -> torch.Tensor:
        """Drop targets that robots stood beside in vain (what is unknown there cannot be seen from there), and for
        each robot those that it got stuck on the way to; if nothing else is left, try them all once more.

        Args:
            way, point: as `Navigation.way` and `point`.
            block: int64 [E, 1, T], the blocks they stand for; -1 = none.

        Returns:
            float32 [E, N, T], `way`, infinite for targets given up.
        """
        s = self.state
        idle = self.env.simulation.tensors["failed"] != 0  # who has failed, or was sent elsewhere, has tried no target
        if self.env.strategy is not None:
            idle = idle | self.env.strategy.state["duty"]
        s["chosen"] = s["chosen"].masked_fill(idle.unsqueeze(-1), -1)
        left, kept = torch.zeros(len(way), dtype=torch.int32, device=way.device), torch.empty_like(way)
        values = (
            nav.values()
            | {name: view(value) for name, value in s.items() if name != "stood"}
            | {
                "stood": view(s["stood"], wp.vec2),
                "block": view(block),
                "way": view(way),
                "kept": view(kept),
                "point": view(point, wp.vec2),
                "left": view(left),
                "clearance": nav.clearance,
                "least": STUCK * nav.clearance,
                "shared": int(nav.rows == 1),
                "most": DWELL,
            }
        )
        robots, slots = (len(way), way.shape[1]), (len(way), way.shape[2])
        launch_named(nav.launch, targets._note_stuck, robots, values)
        launch_named(nav.launch, targets._count_visits, slots, values)
        launch_named(nav.launch, targets._drop_targets, robots, values)
        launch_named(nav.launch, targets._try_again, robots, values)
        return kept


def make_tracker(env: ExplorationEnv) -> TargetTracker:
    """The tracker of an env's targets, in the plane or in a volume."""
    return env.space.make_tracker(env)


def keyed_uniform(env: ExplorationEnv, count: int) -> torch.Tensor:
    """Numbers in [0, 1), float32 [E, N, count], from (seed, env, episode, macro step) alone (`kernels.goals`)."""
    state = env.simulation.tensors
    draw = torch.empty((env.num_envs, env.num_robots, count), dtype=torch.float32, device=env.device)
    keys = [view(state[name]) for name in ("seed", "env_id", "episode", "macro_step")]
    launch_on(env.device)(goals._draw_uniform, tuple(draw.shape), [*keys, view(draw)])
    return draw
