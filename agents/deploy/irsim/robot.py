"""A robot of a trial in ir-sim: noisy odometry, an occupancy grid in log-odds, and a path follower."""

from __future__ import annotations

import math

import numpy as np

from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.agents.deploy.irsim.simulator import Scan
from maexp.kernels.constants import DT

TURN = 0.2  # [rad] of heading for each metre of noise or drift


class Odometry:
    """Beliefs of a team that began in the right place.

    Args:
        poses: where they are, [N, 3] [m, rad].
        noise, drift: see `TrialConfig`.
        rng: draws the errors.
    """

    def __init__(self, poses: np.ndarray, noise: float, drift: float, rng: np.random.Generator):
        self.noise, self.drift, self.rng = noise, drift, rng
        self.believed, self._walked, self._last = poses.copy(), poses.copy(), poses.copy()

    def update(self, poses: np.ndarray) -> np.ndarray:
        """What they believe now that they are at `poses`, [N, 3]."""
        scale = np.array([1.0, 1.0, TURN])
        moved = poses - self._last
        turned = wrapped(moved[:, 2])
        angle = self._walked[:, 2] - self._last[:, 2]  # steps count in the frame of the belief
        c, s = np.cos(angle), np.sin(angle)
        step = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1], turned], axis=1)
        length = np.sqrt(np.linalg.norm(moved[:, :2], axis=1))[:, None]
        self._walked = self._walked + step + self.drift * length * scale * self.rng.normal(size=poses.shape)
        self._last = poses.copy()
        self.believed = self._walked + self.noise * scale * self.rng.normal(size=poses.shape)
        return self.believed


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] from -pi to pi."""
    return (np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi


MISS, HIT = -0.5, 0.9  # evidence of one beam
LEAST, MOST = -2.5, 3.5  # so that people who have left are soon forgotten
DEEP = 0.3  # cells behind a measured surface that stand for it
MATE = 0.4  # [m]; a surface this near a team mate's centre is the mate


class TeamGrid:
    """Cells [rows along y, columns along x] that all robots write into.

    Args:
        low, high: corners of the area [m]; what lies outside is not mapped.
        cell: side of a cell [m].
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, cell: float):
        self.low, self.cell = np.asarray(low, float), cell
        width, height = np.ceil((np.asarray(high) - low) / cell).astype(int)
        self.evidence = np.zeros((height, width), np.float32)
        self.touched = np.zeros((height, width), bool)

    def add(self, pose: np.ndarray, scan: Scan, mates: np.ndarray) -> None:
        """Write a scan from where the robot believes to be; x, y [m], heading [rad]; `mates` [m] [k, 2]."""
        turn = pose[2] + scan.angles
        way = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        ends = pose[:2] + scan.ranges[:, None] * way
        mate = np.zeros(len(ends), bool)
        if len(mates):
            mate = (np.linalg.norm(ends[:, None] - mates, axis=-1) < MATE).any(axis=1)
        along = np.arange(0.0, scan.ranges.max(), 0.5 * self.cell)
        before = along < (scan.ranges - np.where(scan.hit, 0.25 * self.cell, 0.0))[:, None]
        clear = pose[:2] + along[:, None] * way[:, None]
        misses = self._cells(clear[before])
        hits = self._cells((ends + DEEP * self.cell * way)[scan.hit & ~mate])
        misses = np.setdiff1d(misses, hits, assume_unique=True)
        flat, touched = self.evidence.reshape(-1), self.touched.reshape(-1)
        for cells, evidence in ((misses, MISS), (hits, HIT)):
            flat[cells] = (flat[cells] + evidence).clip(LEAST, MOST)
            touched[cells] = True

    def _cells(self, places: np.ndarray) -> np.ndarray:
        """Numbers of the cells of places [m], each once."""
        height, width = self.evidence.shape
        index = np.floor((places - self.low) / self.cell).astype(int)
        index = index[((index >= 0) & (index < (width, height))).all(axis=1)]
        return np.unique(index[:, 1] * width + index[:, 0])

    def values(self) -> np.ndarray:
        """As ROS has it: -1 unknown, 0 free to 100 occupied; int8 [H, W]."""
        chance = np.rint(100 / (1 + np.exp(-self.evidence)))
        return np.where(self.touched, chance, -1).astype(np.int8)


AHEAD = 0.3  # [s] at the present speed, and half a metre, that a robot looks ahead on its way
TURN_FIRST = math.radians(50)  # a goal farther aside than this is turned to before driving
GAIN = 3.0  # yaw rate for each rad that the heading is off [1/s]
SKIN = 0.04  # [m] around the body that nothing may touch
SHARES = (1.0, 0.7, 0.4, 0.2, 0.1)  # of the wanted speed, tried in turn
REACT = 0.2  # [s] on the way before a robot brakes
MATE_GAP = 0.15  # [m] between two robots of the team, whose brakes share what is left
WAIT, BACK, BACKWARDS = 1.5, 1.2, 0.3  # blocked so long [s], it drives back so long [s], so fast [m/s]


class Follower:
    """One robot's driver.

    Args:
        config: limits of the robot.
        hurry: [s] more that it waits before it backs off: of two robots face to face one gives way first.
    """

    def __init__(self, config: TrialConfig, hurry: float = 0.0):
        self.config, self.hurry = config, hurry
        self.way = np.empty((0, 2))
        self.blocked = self.backing = 0.0

    def set_way(self, way: np.ndarray) -> None:
        """Corners [m] from here to the goal, [k, 2]; none: stand."""
        self.way = np.asarray(way, float).reshape(-1, 2)

    def drive(self, pose: np.ndarray, speed: float, scan: Scan, mates: np.ndarray) -> tuple[float, float]:
        """Speed [m/s] and yaw rate [rad/s] at a pose [m, rad], for the next step; `mates` are at [k, 2] [m]."""
        if not len(self.way):
            return 0.0, 0.0
        c = self.config
        if self.backing > 0:
            self.backing -= DT
            return self._safest(-min(BACKWARDS, c.max_speed), 0.0, 0.0, pose, speed, scan, mates)
        target, left = self._look_ahead(pose[:2], 0.5 + AHEAD * abs(speed))
        if left < 0.1:
            return 0.0, 0.0
        aside = float(wrapped(math.atan2(target[1] - pose[1], target[0] - pose[0]) - pose[2]))
        yaw = float(np.clip(GAIN * aside, -c.max_yaw_rate, c.max_yaw_rate))
        wanted = min(c.max_speed * math.cos(aside) ** 2, self._brake(left)) if abs(aside) < TURN_FIRST else 0.0
        fast, yaw = self._safest(wanted, yaw, aside, pose, speed, scan, mates)
        self.blocked = self.blocked + DT if fast < 0.03 < wanted else 0.0
        if self.blocked > WAIT + self.hurry:
            self.blocked, self.backing = 0.0, BACK
        return fast, yaw

    def _brake(self, distance: float) -> float:
        """The speed from which the robot still stops within `distance` [m]."""
        step = self.config.max_accel * DT
        return max(math.sqrt(step * step / 4 + 1.6 * self.config.max_accel * max(distance, 0.0)) - step, 0.0)

    def _safest(self, wanted, yaw, aside, pose, speed, scan: Scan, mates: np.ndarray) -> tuple[float, float]:
        """The greatest share of a speed at which the robot can turn by `aside` and stop without touching anything.

        None is: it brakes, turning or straight, whatever keeps more room.
        """
        ends = np.stack([scan.ranges * np.cos(scan.angles), scan.ranges * np.sin(scan.angles)], axis=1)[scan.hit]
        heading = np.sign(wanted) * np.array([math.cos(pose[2]), math.sin(pose[2])])
        for away in mates - pose[:2]:
            distance = float(np.linalg.norm(away))
            if away @ heading > 0.3 * distance:  # ahead, and comes nearer itself
                most = self._brake((distance - 2 * self.config.body_radius - MATE_GAP) / 2)
                wanted = float(np.clip(wanted, -most, most))
        if not len(ends):
            return wanted, yaw

        def room(fast: float, yaw: float) -> float:
            track = self._track(fast, speed, yaw, aside)
            return float(np.linalg.norm(ends - track[:, None], axis=-1).min())

        keep = min(self.config.body_radius + SKIN, float(np.linalg.norm(ends, axis=1).min()) - 1e-6)
        for share in SHARES if wanted else ():
            if room(share * wanted, yaw) >= keep:
                return share * wanted, yaw
        return 0.0, max((yaw, 0.0), key=lambda turn: min(room(0.0, turn), keep))

    def _track(self, wanted: float, speed: float, yaw: float, aside: float) -> np.ndarray:
        """Places in the robot's frame [m] until it stands again, [k, 2]."""
        accel = self.config.max_accel
        begin = max(speed, wanted, key=abs)
        times = np.arange(0.0, REACT + abs(begin) / accel + DT, DT)
        fast = np.sign(begin) * (abs(begin) - accel * (times - (REACT if wanted else 0.0)).clip(0)).clip(0)
        turn = np.sign(aside) * np.minimum(abs(yaw) * times, abs(aside))
        return np.cumsum(DT * fast[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)

    def _look_ahead(self, at: np.ndarray, ahead: float) -> tuple[np.ndarray, float]:
        """The place `ahead` [m] along the way, from where it is nearest, and how long the way still is [m]."""
        if len(self.way) == 1:
            return self.way[0], float(np.linalg.norm(self.way[0] - at))
        begin, step = self.way[:-1], np.diff(self.way, axis=0)
        length = np.linalg.norm(step, axis=1)
        share = (((at - begin) * step).sum(axis=1) / np.maximum(length, 1e-9) ** 2).clip(0, 1)
        off = np.linalg.norm(begin + share[:, None] * step - at, axis=1)
        nearest = int(off.argmin())
        passed = np.concatenate([[0.0], np.cumsum(length)])
        here = passed[nearest] + share[nearest] * length[nearest]
        target = [np.interp(here + ahead, passed, self.way[:, axis]) for axis in range(2)]
        return np.array(target), float(passed[-1] - here)
