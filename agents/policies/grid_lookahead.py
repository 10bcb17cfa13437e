"""`lookahead` for robots: what comes of targets in a simulated future of what an occupancy grid shows."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import torch

from maexp.agents.deploy.planner.arena_policy import go_beyond
from maexp.agents.deploy.planner.assignment import DistinctTargets
from maexp.agents.deploy.planner.features import Motion
from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.grid_search import coarsen
from maexp.agents.deploy.planner.scene import ArrayScene
from maexp.agents.deploy.planner.team import Team
from maexp.agents.policies.lookahead import list_candidates, value_in_turn
from maexp.agents.policies.rollouts import GUESSES, Rollouts, check_rollout_policy, search_in_turn
from maexp.envs.config import LookaheadConfig, RobotConfig
from maexp.envs.imagined.grid_team import GridTeam, room_for
from maexp.envs.targets.features import drive_until_next
from maexp.kernels.constants import DT, OBSTACLE, UNKNOWN

AHEAD = 1.6  # radar ranges that a robot could drive in an imagined decision, at least: nearer, nothing new is seen
MOST_STEPS = 300  # local steps of such a decision, unless more are asked for
SIGHT = 32.0  # cells that imagined radars reach, at most: cells are made larger for it where robots' bodies allow
MOST_CELLS = 10_000_000  # of the known ground in all branches: bounds the memory, about 1 GiB
WHEELBASE = 1.4  # of a car, in its radii


class Foresight:
    """The search for one team, call by call.

    Args:
        config: how; without ``local_steps`` an imagined decision lasts as long as one of the team, or as a drive of
            `AHEAD` radar ranges where that takes longer.
        drive: how robots move, a `RobotConfig.kind`.
        clearance_factor: radii that robots keep from walls where there is room.
        distinct: robots go to different targets.
        bounded: nothing lies beyond the grid's edge.
        deadline: after so many seconds the robots that have not had their turn keep to the rollout policy.

    Raises:
        ValueError: the rollout policy is none.
    """

    def __init__(
        self,
        config: LookaheadConfig,
        drive: str = "differential",
        clearance_factor: float = 2.0,
        distinct: bool = True,
        bounded: bool = False,
        deadline: float = math.inf,
    ):
        check_rollout_policy(config)
        self.config, self.drive, self.clearance_factor = config, drive, clearance_factor
        self.distinct, self.bounded, self.deadline = distinct, bounded, deadline
        self._key: tuple | None = None

    def improve(
        self,
        scene: ArrayScene,
        preference: np.ndarray,
        team: Team,
        motion: Motion,
        in_discs: bool,
        notes: list[str],
    ) -> np.ndarray:
        """What robots think of targets, those first for which the search speaks: float [n, K].

        Args:
            scene: n robots of the team's N, K targets.
            preference: float [n, K], of the rollout policy; -inf: out of reach.
            team: all robots.
            motion: how the robots move.
            in_discs: `preference` counts in radar discs, and is what targets are worth; else `cost_utility` says that.
            notes: why there is no search is added, in a sentence.
        """
        start = time.monotonic()
        shares = DistinctTargets(preference, scene.travel, scene.points, team.radius[scene.robots], self.distinct)
        own = shares.settle()
        if self.config.candidates < 2 or np.isfinite(scene.travel).sum(-1).max(initial=0) < 2:
            return preference
        world = imagined_grid(scene, team.radius.min(), self.bounded)
        if world.known.size * self.config.candidates > MOST_CELLS:
            notes.append(
                f"{world.known.size:,} known cells are too many to look ahead on with {self.config.candidates} "
                f"candidates: {self.config.rollout_policy} decides alone"
            )
            return preference
        with torch.no_grad():
            self._prepare(world, scene.radar_range, team.radius, motion)
            drives = np.isin(np.arange(len(team.names)), scene.robots[shares.reached.any(-1)])
            at, edge = world.from_map(team.at), OBSTACLE if self.bounded else UNKNOWN
            self.team.put(world.known, at, team.yaw - world.yaw, team.speed, drives, edge)
            chosen = search_in_turn(
                self.rollouts,
                torch.zeros(1, dtype=torch.int64),
                offers := self._offer(scene, world, preference, own, team, motion, in_discs),
                self.distinct,
                go_on=lambda: time.monotonic() - start < self.deadline,
            )
        chosen = chosen[0, scene.robots].numpy()
        if not chosen.any():
            return preference
        index = offers["index"][0, scene.robots].numpy()
        wanted, rows = preference.copy(), np.flatnonzero(own >= 0)
        wanted[rows, index[rows, chosen[rows]]] = np.inf
        return wanted

    def _prepare(self, world: KnownGrid, radar_range: float, radius: np.ndarray, motion: Motion) -> None:
        """Have an env for the team's futures: a new one when what it depends on changes or the grid outgrows it."""
        key = (world.cell, radar_range, motion, tuple(radius.tolist()))
        if key == self._key and self.team.fits(world.known.shape):
            return
        reach = min(radar_range, SIGHT * world.cell)
        self.team = GridTeam(
            room_for(world.known.shape),
            world.cell,
            [self._robot(float(body_radius), motion) for body_radius in radius],
            reach,
            self.config.local_steps or imagined_steps(reach, motion),
            self.clearance_factor,
            self.config.candidates,
            GUESSES[self.config.unknown],
        )
        self.rollouts = Rollouts(self.team.branches, self.config, self.team.tracker)
        self._key, self.discs = key, (radar_range / reach) ** 2

    def _robot(self, radius: float, motion: Motion) -> RobotConfig:
        wheelbase = WHEELBASE * radius if self.drive == "ackermann" else None
        limits = {"max_speed": motion.max_speed, "max_accel": motion.max_accel}
        return RobotConfig(self.drive, radius=radius, wheelbase=wheelbase, **limits)

    def _offer(
        self,
        scene: ArrayScene,
        world: KnownGrid,
        preference: np.ndarray,
        own: np.ndarray,
        team: Team,
        motion: Motion,
        in_discs: bool,
    ) -> dict[str, torch.Tensor]:
        """What each robot of the team may try, as `search_in_turn` takes it; nothing for those that take no part."""
        robots, count, steps = scene.robots, self.config.candidates, self.team.env.local_steps
        index = list_candidates(torch.from_numpy(preference)[None], torch.from_numpy(own)[None], count)[0].numpy()
        there, place = index >= 0, index.clip(0)
        value = np.take_along_axis(preference if in_discs else value_in_turn(scene), place, 1)
        counts = there & there[:, :1]
        value = np.where(counts, value, 0.0)
        value = np.where(counts, value - value[:, :1], 0.0) * self.discs
        shift = world.from_map(scene.grid.to_map((0.0, 0.0)))  # both have the same axes
        at = scene.at + shift
        point = np.where(there[..., None], scene.points[place] + shift, at[:, None])
        middle = np.where(there[..., None], scene.middle[place], 0.0)
        drive = drive_until_next(np, team.speed[robots], motion.max_accel, motion.max_speed, steps * DT)
        wanted = there.copy()
        wanted[:, 1:] &= (index[:, 1:] != own[:, None]) & (own >= 0)[:, None]

        def spread(rows: np.ndarray, blank: np.ndarray | float, kind: torch.dtype) -> torch.Tensor:
            """Rows of the scene's robots -> of the whole team."""
            whole = np.broadcast_to(blank, (len(team.names), *rows.shape[1:])).copy()
            whole[robots] = rows
            return torch.from_numpy(whole).to(kind)[None]

        still = np.nan_to_num(world.from_map(team.at))[:, None]
        goals = spread(go_beyond(point, middle, at[:, None], drive[:, None]), still, torch.float64)[0].numpy()
        return {
            "index": spread(place, 0, torch.int64),
            "block": spread(np.where(there, self.team.blocks(point), -1), -1, torch.int64),
            "goal": self.team.centers(goals[None]),
            "point": spread(point, still, torch.float32),
            "value": spread(value, 0.0, torch.float32),
            "wanted": spread(wanted, False, torch.bool),
            "body": torch.from_numpy(team.radius).float()[None],
            "hears": torch.ones((1, len(team.names), len(team.names)), dtype=torch.bool),
        }


def imagined_grid(scene: ArrayScene, radius: float, bounded: bool) -> KnownGrid:
    """What is known, in cells in which a radar reaches `SIGHT` of them where robots of ``radius`` [m] fit through
    passages of such cells; without the unknown around it, unless the grid is ``bounded``."""
    grid = scene.grid
    if not bounded:
        rows, columns = (np.flatnonzero((grid.known != UNKNOWN).any(axis)) for axis in (1, 0))
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        x, y = grid.to_map((columns[0] * grid.cell, rows[0] * grid.cell))
        grid = replace(grid, known=grid.known[part], corner=(float(x), float(y)))
    wider = scene.radar_range / (SIGHT * grid.cell)
    return coarsen(grid, radius, max(1, round(grid.known.size / wider**2)))


def imagined_steps(radar_range: float, motion: Motion) -> int:
    """Local steps of an imagined decision."""
    seconds = max(motion.seconds, min(AHEAD * radar_range / motion.max_speed, MOST_STEPS * DT))
    return max(1, round(seconds / DT))
