"""Branches of running episodes: copies of teams that try what comes of a decision, in the true world or another.

A batch of branches holds `copies` of some teams of an env side by side: branch b of the t-th team is env
``t * copies + b``. Nothing that happens in a branch reaches the env.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from maexp.envs.config import CommConfig, FaultsConfig, OdometryConfig, RadarConfig
from maexp.envs.maps.map_batch import MapBank
from maexp.kernels.state import STATE

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv
    from maexp.envs.targets.tracker import TargetTracker

OF_POINTS = ("seen_free", "seen_boundary", "viewers_free", "viewers_boundary", "known_free", "known_boundary")
"""State about the points of maps: another world has its own."""
NOT_COPIED = (
    "track",
    "starts",
    "seed",
    "map_id",
    "milestone_step",
    "milestone_overlap",
    "milestone_path",
    "path_length",
    "terms",
    "unscaled",
    "episode_reward",
    "base_sum",
    "worst_sum",
    "told_step",
    "connected",
    "learned",
    "learned_count",
    "offered",
    "underway",
    "cells_sent",
    "evidence_free",
    "evidence_boundary",
    "false_walls",
    "drawn",
    "place_free",
    "place_boundary",
    "odometry_error",
    "pose_estimate",
    "center_estimate",
)
"""State that no branch needs, for nobody asks it for metrics, or that is its own."""


def branch_env(
    env: ExplorationEnv, count: int, bank: MapBank, comm: CommConfig | None = None, local_steps: int | None = None
) -> ExplorationEnv:
    """An env of `count` branches of teams of `env`, on other maps perhaps, that draws no pictures."""
    from maexp.envs.environment import ExplorationEnv

    limited = env.settings.limited if comm is None else comm.limited
    comm = comm or env.settings.comm
    # Branches do what they are told, and messages there need neither room nor time.
    comm = replace(comm, strategy="opportunistic", bandwidth=math.inf, delay=0.0)
    settings = replace(
        env.settings,
        num_envs=count,
        decide="together",
        comm=comm,
        limited=limited,
        local_steps=local_steps or env.local_steps,
        faults=FaultsConfig(),
        odometry=OdometryConfig(),  # nobody foresees what chance does
        radar=tuple(map(perfect, env.settings.radar)),
        observation=replace(env.settings.observation, pictures=False),
    )
    made = ExplorationEnv.__new__(ExplorationEnv)
    made._set_up(settings, bank)
    return made


def perfect(radar: RadarConfig) -> RadarConfig:
    """A radar that misses nothing, alike in all else."""
    return replace(radar, missed=0.0, noise=0.0, false_alarm=0.0, evidence=1)


class Branches:
    """Copies of teams in the true world: what comes of a decision there is what would have come of it.

    Args:
        env: whose teams; only read.
        teams: how many at once, T.
        copies: branches of each.
        local_steps: of a decision in a branch; None: as in the env.

    Attributes:
        env: the env of the branches, T * `copies` teams.
        one_world: all robots of a team decide in the same world.
    """

    def __init__(self, env: ExplorationEnv, teams: int, copies: int, local_steps: int | None = None):
        self.origin, self.teams, self.copies, self.local_steps = env, teams, copies, local_steps
        self.one_world = True
        self.env = self._make_env(teams * copies)
        names = [name for name in STATE if name not in NOT_COPIED and name not in self._own]
        self._copied = {name: (self._source()[name], self.env.simulation.tensors[name]) for name in names}
        self.env.simulation.tensors["seed"].copy_(env.simulation.tensors["seed"])

    _own: tuple[str, ...] = ()
    """State that is not copied, for the branches live in another world."""

    def _make_env(self, count: int) -> ExplorationEnv:
        return branch_env(self.origin, count, self.origin.bank, local_steps=self.local_steps)

    def _source(self) -> dict[str, torch.Tensor]:
        """State of the teams that branches take up."""
        return self.origin.simulation.tensors

    def look(self, teams: torch.Tensor) -> None:
        """Take up what the teams know now: before `branch`."""
        self.listed = teams

    def branch(self, robot: int, wanted: torch.Tensor) -> None:
        """Put all branches where their teams are, for a decision of one robot.

        Args:
            robot: its number.
            wanted: bool [T', copies], the branches that are played at all.
        """
        rows = self.listed.repeat_interleave(self.copies)
        for theirs, ours in self._copied.values():
            ours[: len(rows)] = theirs[rows]
        state = self.env.simulation.tensors
        state["collided"][: len(rows)] |= state["failed"][: len(rows)]  # who has failed stands as a wreck does
        self._place(rows, robot)
        active = self.env.simulation.tensors["active"]
        active[: len(rows)] *= wanted.flatten().int()
        active[len(rows) :] = 0

    def _place(self, rows: torch.Tensor, robot: int) -> None:
        tensors = self.env.simulation.tensors
        tensors["map_id"][: len(rows)] = self.origin.simulation.tensors["map_id"][rows]

    def disc(self) -> torch.Tensor:
        """What a radar's disc of free ground weighs in each branch, float32 [T * copies]."""
        tensors = self.env.simulation.map_tensors
        area = torch.tensor([world.free_area for world in self.env.maps], dtype=torch.float32, device=self.env.device)
        reach = max(radar.range for radar in self.env.radar_configs)
        weight = tensors["total_weight"] / area * torch.pi * reach**2
        return weight[self.env.simulation.tensors["map_id"].long()]

    def attach(self, tracker: TargetTracker) -> None:
        """Let targets of the branches follow their worlds; here they do by themselves."""

    def spread_blocks(self, values: torch.Tensor) -> torch.Tensor:
        """What the env keeps for every block, [E, N, blocks], for the branches: [T * copies, N, their blocks]."""
        return values[self.listed].repeat_interleave(self.copies, 0)

    def blocks(self, block: torch.Tensor) -> torch.Tensor:
        """Numbers of blocks of frontier cells in the branches' world, for those of the teams listed: int64 [T, ...]."""
        return block
