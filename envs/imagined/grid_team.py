"""A team on an occupancy grid, as an env whose futures can be played: robots know no true map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from maexp.envs.config import EnvSettings, ObservationConfig, PlannerConfig, RadarConfig, RobotConfig
from maexp.envs.environment import ExplorationEnv
from maexp.envs.imagined.maps import AWAY, Beliefs, Guess
from maexp.envs.maps.map_batch import build_bank
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.settings import complete_settings
from maexp.envs.targets.tracker import TargetTracker
from maexp.kernels.constants import FREE, OBSTACLE

RIM = 1  # cells around the grid, which say what lies beyond its edge
ROOM = 1.25  # a grid may grow by so much before there has to be a larger env
LEAST_ROOM = 32  # [cells]
MACRO_STEPS = 1000  # no imagined episode is at its end


class GridTeam:
    """One team on a grid in metres from its lower left corner. All its robots hear each other.

    Args:
        shape: cells of the grid along y and x, at most.
        cell: edge of a cell [m].
        robots: one for each.
        radar_range: [m].
        local_steps: of a decision.
        clearance_factor: of the local planner `wavefront`.
        copies: branches that are played side by side.
        unknown: as for `Beliefs`.

    Attributes:
        env: holds the team, and has no true map.
        tracker: of the env's targets.
        branches: of the team, in the world of its grid.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        cell: float,
        robots: Sequence[RobotConfig],
        radar_range: float,
        local_steps: int,
        clearance_factor: float,
        copies: int,
        unknown: Guess | None = None,
    ):
        self.shape = (shape[0] + 2 * RIM, shape[1] + 2 * RIM)
        stand_in = outline_map(self.shape, cell, len(robots))
        settings = EnvSettings(
            num_envs=1,
            num_robots=len(robots),
            robot=robots,
            radar=RadarConfig(range=radar_range),
            planner=PlannerConfig(name="wavefront", clearance_factor=clearance_factor),
            observation=ObservationConfig(pictures=False),
            local_steps=local_steps,
            macro_steps=MACRO_STEPS,
        )
        settings = replace(complete_settings(settings, [stand_in]), num_threads=1)
        self.env = ExplorationEnv.__new__(ExplorationEnv)
        self.env._set_up(settings, build_bank([stand_in], settings.radar))
        self.tracker = TargetTracker(self.env)
        self.branches = GridBeliefs(self.env, 1, copies, self.tracker.nav, unknown)
        self.offset = np.array([RIM * cell] * 2)  # of the grid's corner from that of the env's cells
        self.cell = cell

    def fits(self, shape: tuple[int, int]) -> bool:
        """Whether there is room for a grid."""
        return all(size + 2 * RIM <= room for size, room in zip(shape, self.shape, strict=True))

    def put(
        self, known: np.ndarray, at: np.ndarray, heading: np.ndarray, speed: np.ndarray, drives: np.ndarray, edge: int
    ) -> None:
        """Take up what the team knows and where it is.

        Args:
            known: uint8 [H, W].
            at: where robots are, float [N, 2] [m]; NaN: nobody knows, and they are nowhere.
            heading, speed: float [N] [rad, m/s].
            drives: bool [N], who moves; the others stand where they are.
            edge: what lies beyond the grid, `UNKNOWN` or `OBSTACLE`.
        """
        grid = np.full(self.shape, edge, np.uint8)
        inner = (slice(RIM, RIM + known.shape[0]), slice(RIM, RIM + known.shape[1]))
        grid[inner] = known
        state, there = self.env.simulation.tensors, np.isfinite(at).all(-1)
        place = np.where(there[:, None], at + self.offset, AWAY)
        state["active"].fill_(1)
        state["collided"][0] = torch.from_numpy(~(drives & there)).int()
        pose = np.stack([*place.T, np.where(drives, speed, 0.0), heading], -1)
        state["pose"][0] = torch.from_numpy(pose).float()
        state["center"][0, :, :2] = torch.from_numpy(place).float()
        radius = self.env.simulation.robot_tensors["collision_threshold"][0].numpy()
        self.branches.grid = torch.from_numpy(_stand_free(grid, place, radius, self.cell))

    def blocks(self, points: np.ndarray) -> np.ndarray:
        """Blocks of the env's frontier cells in which points on the grid lie: float [..., 2] [m] -> int64 [...]."""
        side = int(self.branches.sizes.block[0])
        x, y = np.moveaxis(((points + self.offset) // (side * self.cell)).astype(np.int64), -1, 0)
        return y * -(-self.shape[1] // side) + x

    def centers(self, points: np.ndarray) -> torch.Tensor:
        """Points on the grid [m] as the env has them, float32."""
        return torch.from_numpy(points + self.offset).float()


class GridBeliefs(Beliefs):
    """Worlds of what a grid shows.

    Attributes:
        grid: uint8 [H, W], cells as large as those of the env; to be set before `look`.
    """

    grid: torch.Tensor

    def _take_up(self, teams: torch.Tensor) -> None:
        self.known[0] = self.grid.flatten()


def room_for(shape: tuple[int, int]) -> tuple[int, int]:
    """Cells along y and x for a grid that may still grow a little."""
    height, width = (max(LEAST_ROOM, round(ROOM * size)) for size in shape)
    return height, width


def outline_map(shape: tuple[int, int], cell: float, robots: int) -> PointCloudMap:
    """A map whose cells are those of a grid and which tells no more of it: a few points along its edges."""
    height, width = shape
    row = np.arange(max(2, min(width - 1, robots)))
    x = np.concatenate([row, [0, width - 1]])
    y = np.concatenate([np.zeros(len(row)), [height - 1] * 2])
    free = (np.stack([x, y, np.zeros(len(x))], -1) + [0.5, 0.5, 0.0]) * [cell, cell, 1.0]
    wall = (np.array([[width - 1, 0, 0]]) + [0.5, 0.5, 0.0]) * [cell, cell, 1.0]
    return PointCloudMap(free, wall, cell, name="grid", boundary=wall)


def _stand_free(grid: np.ndarray, at: np.ndarray, radius: np.ndarray, cell: float) -> np.ndarray:
    """The grid without walls where robots stand: a wall drawn there is off by a little, and would stop them for good.

    Args:
        grid: uint8 [H, W].
        at: float [N, 2] [m].
        radius: float [N] [m].
    """
    y, x = np.nonzero(grid == OBSTACLE)
    middle = (np.stack([x, y], -1) + 0.5) * cell
    for robot, reach in zip(at, radius, strict=True):
        inside = np.linalg.norm(middle - robot, axis=-1) <= reach * 1.001
        grid[y[inside], x[inside]] = FREE
    return grid
