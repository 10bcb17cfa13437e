"""What a learned choice among targets sees: the candidates of every robot, as `maexp.envs.target_view` lists them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .grid import UNKNOWN
from .scene import Scene
from .values import LEAST_GAIN, plan_in_turn, value_targets
from .ways import cells_ahead

FAR = 4.0  # lengths between targets and robots count up to so many radar ranges
WAY_AHEAD = 3.0  # cells from a robot to the point that tells where its way begins
FEATURES = (
    "score", "value", "planned", "claimed", "plan_gap", "travel", "nearness", "distance", "detour", "gain", "size",
    "worth", "gain_near", "gain_around", "ahead", "aside", "way_ahead", "way_aside", "unknown_ahead", "unknown_aside",
    "unknown_far", "rival", "lead", "nearest", "own_last", "mates_last", "count", "speed", "drive", "time_left",
    "known", "mates",
)  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """How the robots move that a policy was trained with.

    Attributes:
        max_speed: [m/s].
        max_accel: [m/s^2].
        seconds: time between two decisions [s].
    """

    max_speed: float
    max_accel: float
    seconds: float

    def drive(self, speed: np.ndarray) -> np.ndarray:
        """How far robots get until the next decision [m], from their speeds [m/s]."""
        far = speed * self.seconds + 0.5 * self.max_accel * self.seconds**2
        return np.minimum(far, self.max_speed * self.seconds)


@dataclass(frozen=True)
class Candidates:
    """The best targets of every robot, at most M, those of the highest value first.

    Attributes:
        features: float32 [n, M, F], in the order of `FEATURES`; 0 where there is no candidate.
        mask: bool [n, M], which there are.
        target: int64 [n, M], their numbers among the targets.
    """

    features: np.ndarray
    mask: np.ndarray
    target: np.ndarray


def list_candidates(scene: Scene, count: int, heading, speed, last, time_left: float, motion: Motion) -> Candidates:
    """The candidates of every robot of a scene with at least one target.

    Args:
        count: M.
        heading, speed: of the robots on the grid, [n] [rad, m/s].
        last: where each robot's latest target was on the grid, [n, 2] [m]; NaN = it had none.
        time_left: share of the time for the whole exploration.
        motion: how the robots move.
    """
    value = value_targets(scene.gain, scene.travel, scene.radar_range)
    best = np.argsort(-value, axis=1, kind="stable")[:, :count]
    target = np.pad(best, ((0, 0), (0, count - best.shape[1])))
    mask = np.isfinite(np.take_along_axis(scene.travel, target, 1))
    mask[:, best.shape[1] :] = False
    near = _Near(scene, target, mask)
    columns = near.plan() | near.way() | near.worth() | near.bearings(heading) | near.others(last)
    columns |= near.team(speed, time_left, motion)
    features = np.stack([np.broadcast_to(columns[name], target.shape) for name in FEATURES], -1)
    return Candidates(np.where(mask[..., None], features, 0.0).astype(np.float32), mask, target)


class _Near:
    """The features of the candidates, group by group; what they are is said in `maexp.envs.target_view`."""

    def __init__(self, scene: Scene, target: np.ndarray, mask: np.ndarray):
        self.scene, self.target, self.mask, self.reach = scene, target, mask, scene.radar_range
        travel = np.take_along_axis(scene.travel, target, 1)
        self.travel = np.where(mask, travel, 0.0) / self.reach
        self.point = scene.points[target]
        self.to = self.point - scene.at[:, None]
        self.distance = np.linalg.norm(self.to, axis=-1) / self.reach
        self.gain = scene.gain[target]
        self.own = np.eye(len(target), dtype=bool)[:, None]

    def plan(self) -> dict[str, np.ndarray]:
        value = value_targets(self.gain, np.take_along_axis(self.scene.travel, self.target, 1), self.reach)
        score, taken, claimed = plan_in_turn(self.gain, np.where(self.mask, value, -np.inf), self.point / self.reach)
        where = self.point[np.arange(len(taken)), taken]
        return {
            "score": score,
            "value": np.maximum(value, -FAR),
            "planned": np.arange(self.mask.shape[1]) == taken[:, None],
            "claimed": claimed,
            "plan_gap": self._nearest_of(where, ~self.own & self.mask.any(-1)),
        }

    def way(self) -> dict[str, np.ndarray]:
        return {
            "travel": np.log1p(self.travel),
            "nearness": 1.0 / (1.0 + self.travel),
            "distance": self.distance,
            "detour": np.minimum(self.travel / np.maximum(self.distance, 0.1), FAR) - 1.0,
        }

    def worth(self) -> dict[str, np.ndarray]:
        gain = np.where(self.mask, self.gain, 0.0)[:, None]
        gap = np.linalg.norm(self.point[:, :, None] - self.point[:, None], axis=-1) / self.reach
        return {
            "gain": self.gain,
            "size": self.scene.targets.size[self.target] / 10.0,
            "worth": self.gain >= LEAST_GAIN,
            "gain_near": ((gap < 1.0) * gain).sum(-1),
            "gain_around": ((gap < 2.5) * gain).sum(-1) / 4.0,
        }

    def bearings(self, heading: np.ndarray) -> dict[str, np.ndarray]:
        scene = self.scene
        ahead = np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
        first = cells_ahead(scene.passable, scene.distance, scene.targets.cell[self.target], WAY_AHEAD)
        way = scene.grid.centers(np.maximum(first, 0)) - scene.at[:, None]
        toward = scene.middle[self.target]
        columns = {"unknown_far": np.linalg.norm(toward, axis=-1) / self.reach}
        for name, vector in (("", self.to), ("way_", way), ("unknown_", toward)):
            unit = vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-6)
            columns[f"{name}ahead"] = (unit * ahead).sum(-1)
            columns[f"{name}aside"] = unit[..., 1] * ahead[..., 0] - unit[..., 0] * ahead[..., 1]
        return columns

    def others(self, last: np.ndarray) -> dict[str, np.ndarray]:
        theirs = (self.scene.way / self.reach)[:, self.target].transpose(1, 2, 0)
        rival = np.where(self.own, np.inf, theirs).min(-1)
        has_last = np.isfinite(last).all(-1)
        return {
            "rival": np.minimum(rival, 2 * FAR),
            "lead": np.clip(rival - self.travel, -FAR, FAR),
            "nearest": self.travel <= rival,
            "own_last": self._nearest_of(last, self.own & has_last),
            "mates_last": self._nearest_of(last, ~self.own & has_last),
        }

    def team(self, speed: np.ndarray, time_left: float, motion: Motion) -> dict[str, np.ndarray]:
        grid = self.scene.grid
        area = np.count_nonzero(grid.known != UNKNOWN) * grid.cell**2
        columns = {
            "count": self.mask.sum(-1) / 10.0,
            "speed": speed / motion.max_speed,
            "drive": motion.drive(speed) / self.reach,
            "time_left": np.full(len(speed), time_left),
            "known": np.full(len(speed), math.log(1.0 + area / (math.pi * self.reach**2))),
            "mates": np.full(len(speed), (len(speed) - 1) / 4.0),
        }
        return {name: value[:, None] for name, value in columns.items()}

    def _nearest_of(self, where: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Distance [ranges], at most `FAR`, from every candidate to the nearest of `where` [n, 2] that counts."""
        gap = np.linalg.norm(self.point[:, :, None] - where, axis=-1) / self.reach
        return np.minimum(np.where(counts, gap, FAR).min(-1), FAR)
