"""One trial in ir-sim: sense, map, decide, drive; coverage over time and a film's frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.agents.deploy.irsim.policies import NumpyTeam
from maexp.agents.deploy.irsim.robot import Follower, Odometry, TeamGrid
from maexp.agents.deploy.irsim.simulator import Scan, Simulator, make_floor
from maexp.agents.deploy.planner import TeamPlanner
from maexp.envs import PointCloudMap
from maexp.kernels.constants import DT


class Coverage:
    """Free points of a map that beams have passed.

    Args:
        world: whose points count.
    """

    def __init__(self, world: PointCloudMap):
        self.points = world.free[:, :2].astype(np.float64)
        self.weight = world.free_spacing.astype(np.float64) ** 2
        self.seen = np.zeros(len(self.points), bool)

    def add(self, pose: np.ndarray, scan: Scan, reach: float) -> None:
        """Points within `reach` [m] that the nearest beam of a robot at `pose` went past."""
        left = np.flatnonzero(~self.seen)
        offset = self.points[left] - pose[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        near = distance <= reach
        left, offset, distance = left[near], offset[near], distance[near]
        angle = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2] - scan.angles[0]
        beam = np.rint((angle % (2 * np.pi)) / (scan.angles[1] - scan.angles[0])).astype(int) % len(scan.angles)
        self.seen[left[distance <= scan.ranges[beam]]] = True

    @property
    def share(self) -> float:
        """Weight of what was seen / weight of all, as in our simulator."""
        return float(self.weight[self.seen].sum() / self.weight.sum())


def map_errors(grid: TeamGrid, world: PointCloudMap) -> float:
    """Share of the map's free points in known cells that the team's grid calls occupied."""
    cells = np.floor((world.free[:, :2] - grid.low) / grid.cell).astype(int)
    height, width = grid.touched.shape
    cells = cells[((cells >= 0) & (cells < (width, height))).all(axis=1)]
    values = grid.values()[cells[:, 1], cells[:, 0]]
    known = values >= 0
    return float((values[known] >= 50).mean()) if known.any() else 0.0


BORDER = 3.0  # [m] of the team's grid around the floor, for beliefs that drift


@dataclass
class Trial:
    """What happened; T entries, one each DT, the first at the start.

    Attributes:
        coverage: share of the free points seen, [T].
        collided: robots that have hit something, bool [N]; they stand still from then on.
        path: way of each robot [m], [N].
        errors: share of free points in the team's grid that it calls occupied, at the end.
        drift: largest distance of belief and truth at the end [m].
        done_at: when the planner said that nothing is left [s], or None.
        notes: what the planner said, each once.
        poses: where robots were, [T, N, 3].
    """

    coverage: list[float] = field(default_factory=list)
    collided: np.ndarray | None = None
    path: np.ndarray | None = None
    errors: float = 0.0
    drift: float = 0.0
    done_at: float | None = None
    notes: list[str] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)


@dataclass(frozen=True)
class FilmFrame:
    """What a frame of the film shows."""

    time: float
    grid: TeamGrid
    believed: np.ndarray
    poses: np.ndarray
    goals: np.ndarray
    people: np.ndarray
    coverage: float


def run_trial(
    world: PointCloudMap,
    planner: TeamPlanner | NumpyTeam,
    starts: np.ndarray,
    config: TrialConfig,
    watch: Callable[[FilmFrame], None] | None = None,
) -> Trial:
    """A team from `starts` [N, 3] until the time is up, all robots have collided or nothing is left to see.

    Args:
        world: a floor.
        planner: who plans for the team, `maexp.agents.deploy.irsim.policies.make_planner`.
        starts: x, y [m] and heading [rad].
        config: the team and what disturbs it.
        watch: called at every decision.
    """
    floor = make_floor(world)
    simulator = Simulator(floor, starts, config)
    rng = np.random.default_rng([config.seed, 11])
    alive = np.ones(len(starts), bool)  # a bumper tells who has collided: the others take it for an obstacle
    odometry = Odometry(simulator.poses, config.pose_noise, config.pose_drift, rng)
    high = floor.low + np.array(floor.free.shape) * floor.cell
    grid, judge = TeamGrid(floor.low - BORDER, high + BORDER, config.cell), Coverage(world)
    drivers = [Follower(config, hurry=1.0 * i) for i in range(len(starts))]
    trial = Trial(collided=np.zeros(len(starts), bool), path=np.zeros(len(starts)))
    speeds = np.zeros(len(starts))
    every = max(1, round(config.decide / DT))
    for step in range(round(config.seconds / DT) + 1):
        poses, scans = simulator.poses, simulator.scans()
        believed = odometry.update(poses) if step else odometry.believed
        for i, scan in enumerate(scans):
            grid.add(believed[i], scan, believed[_others(alive, i), :2])
            judge.add(poses[i], scan, config.radar_range)
        trial.coverage.append(judge.share)
        trial.poses.append(poses)
        trial.collided |= simulator.crashed
        alive = ~trial.collided
        if step % every == 0:
            time = step * DT
            plan = planner.plan(
                grid.values(),
                grid.cell,
                grid.low,
                {i: pose if alive[i] else None for i, pose in enumerate(believed)},
                velocities=speeds,
                time_left=1 - time / config.seconds,
                now=time,
            )
            for driver, way in zip(drivers, plan.ways, strict=True):
                driver.set_way(way)
            trial.notes += [note for note in plan.notes if note not in trial.notes]
            if watch is not None:
                people = simulator.walkers.places.copy()
                watch(FilmFrame(time, grid, believed.copy(), poses, plan.goals.copy(), people, judge.share))
            if plan.done:
                trial.done_at = time
                break
        if trial.collided.all():
            break
        commands = np.array(
            [
                driver.drive(believed[i], speeds[i], scans[i], believed[_others(alive, i), :2])
                for i, driver in enumerate(drivers)
            ]
        )
        commands[~alive] = 0.0
        commands[:, 0] = commands[:, 0].clip(speeds - config.max_accel * DT, speeds + config.max_accel * DT)
        simulator.step(commands)
        moved = simulator.poses - poses
        speeds = moved[:, 0] * np.cos(poses[:, 2]) + moved[:, 1] * np.sin(poses[:, 2])
        speeds /= DT
        trial.path += np.linalg.norm(moved[:, :2], axis=1)
    trial.errors = map_errors(grid, world)
    trial.drift = float(np.linalg.norm(believed[:, :2] - poses[:, :2], axis=1).max())
    return trial


def _others(alive: np.ndarray, robot: int) -> np.ndarray:
    """Which robots but this one have not collided; bool [N]."""
    return alive & (np.arange(len(alive)) != robot)
