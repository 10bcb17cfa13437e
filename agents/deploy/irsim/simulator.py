"""ir-sim, headless: a floor, robots with a lidar each, and people who walk."""

from __future__ import annotations

import contextlib
import io
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from PIL import Image
from scipy import ndimage
from skimage.graph import MCP_Geometric

from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.envs import PointCloudMap
from maexp.kernels.constants import DT


@dataclass(frozen=True)
class FloorCells:
    """Free cells of a map, one a point of it.

    Attributes:
        free: bool [nx, ny]; a margin of one cell around is not.
        cell: side of a cell [m].
        low: outer corner of cell (0, 0) [m].
    """

    free: np.ndarray
    cell: float
    low: np.ndarray

    def centre(self, index: np.ndarray) -> np.ndarray:
        """Places [m] of cells, both [..., 2]."""
        return self.low + (np.asarray(index) + 0.5) * self.cell

    def index(self, places: np.ndarray) -> np.ndarray:
        """Cells of places [m], both [..., 2]; those outside count as the edge."""
        index = np.floor((np.asarray(places) - self.low) / self.cell).astype(int)
        return index.clip(0, np.array(self.free.shape) - 1)

    def roomy(self, radius: float) -> np.ndarray:
        """Cells whose centre lies at least `radius` [m] from all walls; bool [nx, ny]."""
        return (ndimage.distance_transform_edt(self.free) - 0.5) * self.cell >= radius


def make_floor(world: PointCloudMap) -> FloorCells:
    """The cells of a map on a lattice, as imported floors are."""
    cell, points = world.resolution, world.free[:, :2].astype(np.float64)
    if np.ptp(world.free_spacing):
        raise ValueError(f"map {world.name} has points of different spacing: import it anew, or take a floor plan")
    low = points.min(axis=0) - 1.5 * cell
    index = np.floor((points - low) / cell + 1e-4).astype(int)
    free = np.zeros(index.max(axis=0) + 2, dtype=bool)
    free[index[:, 0], index[:, 1]] = True
    if free.sum() < 0.99 * len(points):
        raise ValueError(f"the points of map {world.name} stand on no lattice along x and y: import it unturned")
    return FloorCells(free, cell, low)


PERSON_RADIUS, PERSON_SPEED = 0.25, 0.8  # [m], [m/s]
POLITE = 0.8  # [m] to the edge of another before a person stops
PATIENCE = 2.0  # [s] until a person who waits goes elsewhere
CHOICES = 4  # ways that a person thinks of
FAR = 6.0  # [m] from robots at the start


class Walkers:
    """Places of people [m], [count, 2], and the ways they are on.

    Args:
        floor: where they walk.
        count: how many.
        robots: starts [m], [N, 2], that they keep away from.
        rng: chooses where they start and where they go.
    """

    def __init__(self, floor: FloorCells, count: int, robots: np.ndarray, rng: np.random.Generator):
        self.floor, self.rng = floor, rng
        self.roomy = floor.roomy(PERSON_RADIUS + 0.1)
        cells = np.argwhere(self.roomy)
        away = np.linalg.norm(floor.centre(cells)[:, None] - robots, axis=-1).min(axis=1)
        cells = cells[away >= min(FAR, 0.5 * away.max())] if count else cells[:0]
        if count > len(cells):
            raise ValueError(f"people={count} find no room on this floor: ask for fewer")
        self.places = floor.centre(cells[rng.choice(len(cells), count, replace=False)]) if count else np.empty((0, 2))
        self.ways: list[np.ndarray] = [np.empty((0, 2))] * count
        self.waited = np.zeros(count)

    def step(self, robots: np.ndarray, dt: float) -> np.ndarray:
        """Velocities [m/s] of all for the next `dt` [s], [count, 2]."""
        walks = np.zeros_like(self.places)
        for i, place in enumerate(self.places):
            if not len(self.ways[i]) or self.waited[i] > PATIENCE:
                self.ways[i], self.waited[i] = self._way_out(place, robots), 0.0
            while len(self.ways[i]) and np.linalg.norm(self.ways[i][0] - place) < 0.15:
                self.ways[i] = self.ways[i][1:]
            if not len(self.ways[i]):
                continue
            ahead = self.ways[i][0] - place
            ahead /= np.linalg.norm(ahead)
            others = np.concatenate([robots, np.delete(self.places, i, axis=0)]) - place
            distance = np.linalg.norm(others, axis=1)
            blocked = ((others @ ahead > 0.3 * distance) & (distance < POLITE + PERSON_RADIUS)).any()
            self.waited[i] = self.waited[i] + dt if blocked else 0.0
            walks[i] = 0.0 if blocked else PERSON_SPEED * ahead
        return walks

    def _way_out(self, place: np.ndarray, robots: np.ndarray) -> np.ndarray:
        """Of some ways the one that begins most away from the nearest robot."""
        ways = [way for way in (self._way(place) for _ in range(CHOICES)) if len(way)]
        away = place - robots[np.linalg.norm(robots - place, axis=1).argmin()]
        return max(ways, key=lambda way: (way[min(len(way), 3) - 1] - place) @ away, default=np.empty((0, 2)))

    def _way(self, place: np.ndarray) -> np.ndarray:
        """Corners [m] of the shortest way to somewhere else."""
        cells = np.argwhere(self.roomy)
        goal = cells[self.rng.integers(len(cells))]
        costs = np.where(self.roomy, 1.0, np.where(self.floor.free, 20.0, -1.0))
        start = self.floor.index(place)
        search = MCP_Geometric(costs)
        search.find_costs([tuple(start)], [tuple(goal)])
        try:
            return self.floor.centre(np.array(search.traceback(tuple(goal)))[1:])
        except ValueError:  # not to be reached
            return np.empty((0, 2))


@dataclass(frozen=True)
class Scan:
    """What a lidar measured: ranges [m] [beams], their angles [rad] in the robot's frame, and which met something."""

    angles: np.ndarray
    ranges: np.ndarray
    hit: np.ndarray


class Simulator:
    """A team on a floor.

    Args:
        floor: free cells; all others are walls.
        starts: x, y [m] and heading [rad] of each robot, [N, 3].
        config: the robots, their noise, how many people.

    Raises:
        ImportError: ir-sim is not installed.
    """

    def __init__(self, floor: FloorCells, starts: np.ndarray, config: TrialConfig):
        self.count, self.config = len(starts), config
        rng = np.random.default_rng([config.seed, 7])
        self.walkers = Walkers(floor, config.people, starts[:, :2], rng)
        with tempfile.TemporaryDirectory() as folder:
            image = Path(folder) / "floor.png"
            Image.fromarray(np.ascontiguousarray(np.where(floor.free, 255, 0).astype(np.uint8).T[::-1])).save(image)
            world = Path(folder) / "world.yaml"
            world.write_text(yaml.safe_dump(self._describe(floor, image, starts)))
            self.env = _import_irsim().make(str(world), headless=True, log_level="CRITICAL", seed=config.seed)
        objects = sorted(self.env.objects, key=lambda thing: thing.id)
        self.robots = [thing for thing in objects if thing.role == "robot"]
        self.people = [thing for thing in objects if thing.role == "obstacle" and thing.shape == "circle"]
        self.ids = [thing.id for thing in (*self.robots, *self.people)]

    def _describe(self, floor: FloorCells, image: Path, starts: np.ndarray) -> dict:
        c, size = self.config, np.array(floor.free.shape) * floor.cell
        lidar = {
            "name": "lidar2d",
            "range_min": 0.0,
            "range_max": c.radar_range,
            "number": c.beams,
            "angle_range": 2 * math.pi * (1 - 1 / c.beams),
            "noise": c.range_noise > 0,
            "std": c.range_noise,
        }
        robot = {
            "number": len(starts),
            "distribution": {"name": "manual"},
            "kinematics": {"name": "diff"},
            "shape": {"name": "circle", "radius": c.body_radius},
            "state": np.asarray(starts, float).tolist(),
            "vel_min": [-c.max_speed, -c.max_yaw_rate],
            "vel_max": [c.max_speed, c.max_yaw_rate],
            "acce": [c.max_accel, 4 * c.max_yaw_rate],
            "sensors": [lidar],
        }
        described = {
            "world": {
                "width": float(size[0]),
                "height": float(size[1]),
                "offset": floor.low.tolist(),
                "step_time": DT,
                "sample_time": DT,
                "collision_mode": "stop",
                "obstacle_map": str(image),
            },
            "robot": [robot],
        }
        if len(self.walkers.places):
            described["obstacle"] = [
                {
                    "number": len(self.walkers.places),
                    "distribution": {"name": "manual"},
                    "kinematics": {"name": "omni"},
                    "shape": {"name": "circle", "radius": PERSON_RADIUS},
                    "state": [[*place, 0.0] for place in self.walkers.places.tolist()],
                    "vel_min": [-PERSON_SPEED] * 2,
                    "vel_max": [PERSON_SPEED] * 2,
                }
            ]
        return described

    @property
    def poses(self) -> np.ndarray:
        """x, y [m] and heading [rad] of each robot, [N, 3]."""
        return np.array([robot.state[:3, 0] for robot in self.robots])

    @property
    def crashed(self) -> np.ndarray:
        """Robots that touch a wall, each other or somebody now; they stand still. bool [N]."""
        return np.array([bool(robot.collision_flag) for robot in self.robots])

    def scans(self) -> list[Scan]:
        """What the lidars measure now."""
        return [
            Scan(robot.lidar.angle_list, robot.lidar.range_data.copy(), robot.lidar.valid.copy())
            for robot in self.robots
        ]

    def step(self, commands: np.ndarray) -> None:
        """0.1 s with the speeds [m/s] and yaw rates [rad/s] of each robot, [N, 2]."""
        walks = self.walkers.step(self.poses[:, :2], DT)
        actions = [command.reshape(2, 1) for command in (*np.asarray(commands, float), *walks)]
        self.env.step(actions, self.ids)
        self.walkers.places = np.array([person.state[:2, 0] for person in self.people]).reshape(-1, 2)


def _import_irsim():
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it lists the windows that this machine cannot open
            import irsim
    except ImportError as error:
        raise ImportError('trials in ir-sim need it: pip install "maexp[irsim]"') from error
    return irsim
