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

from maexp.kernels.constants import DT

from .config import TrialConfig
from .floor import FloorCells
from .people import PERSON_RADIUS, PERSON_SPEED, Walkers


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
