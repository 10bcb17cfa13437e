"""What a learned choice among targets sees: the candidates of every robot, as `maexp.envs.targets.observation` lists
them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maexp.agents.deploy.planner.assignment import plan_in_turn
from maexp.agents.deploy.planner.scene import ArrayScene
from maexp.envs.targets.features import AROUND, EDGE, NEAR, FeatureInputs, drive_until_next
from maexp.envs.targets.heuristics import WAY_AHEAD, value_targets
from maexp.kernels.constants import UNKNOWN


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
        return drive_until_next(np, speed, self.max_accel, self.max_speed, self.seconds)


@dataclass(frozen=True)
class Candidates:
    """The best targets of every robot, at most M, those of the highest value first.

    Attributes:
        features: float32 [n, M, F], in the order of `FEATURES`; 0 where there is no candidate.
        mask: bool [n, M], which there are.
        target: int64 [n, M], their numbers among the targets. Where radios are told of, features and mask have one
            candidate more, the last: to go and tell the base station.
    """

    features: np.ndarray
    mask: np.ndarray
    target: np.ndarray


def list_candidates(
    scene: ArrayScene,
    count: int,
    heading,
    speed,
    last,
    time_left: float,
    motion: Motion,
    telling: Callable[[FeatureInputs], FeatureInputs] | None = None,
) -> Candidates:
    """The candidates of every robot of a scene with at least one target.

    Args:
        count: M.
        heading, speed: of the robots on the grid, [n] [rad, m/s].
        last: where each robot's latest target was on the grid, [n, 2] [m]; NaN = it had none.
        time_left: share of the time for the whole exploration.
        motion: how the robots move.
        telling: adds what is known of radios (`maexp.agents.deploy.planner.radio_features.ContactBook.add_to`); None:
            nothing.
    """
    value = value_targets(scene).astype(np.float32)
    best = np.argsort(-value, axis=1, kind="stable")[:, :count]
    target = np.pad(best, ((0, 0), (0, count - best.shape[1])))
    mask = np.isfinite(np.take_along_axis(scene.travel, target, 1))
    mask[:, best.shape[1] :] = False
    inputs = _moment(scene, target, mask, np.take_along_axis(value, target, 1), heading, speed, last, time_left, motion)
    inputs = inputs if telling is None else telling(inputs)
    return Candidates(inputs.features().astype(np.float32), inputs.mask, target)


def _moment(
    scene: ArrayScene, target, mask, value, heading, speed, last, time_left: float, motion: Motion
) -> FeatureInputs:
    """What features are made of; everyone hears everyone."""
    reach, point, gain, robots = scene.radar_range, scene.points[target], scene.gain[target], np.arange(len(target))
    own = np.eye(len(target), dtype=bool)
    score, taken, claimed = plan_in_turn(gain, np.where(mask, value, -np.inf), point / reach)
    theirs = (scene.way / reach)[:, target].transpose(1, 2, 0)
    apart = np.linalg.norm(point[:, :, None] - point[:, None], axis=-1) / reach
    shown, has_last = np.where(mask, gain, 0.0)[:, None], np.isfinite(last).all(-1)

    def to_nearest(where: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Distance from every candidate to the nearest of `where` [n, 2] that counts [ranges]."""
        gap = np.linalg.norm(point[:, :, None] - where, axis=-1) / reach
        return np.where(counts[:, None], gap, np.inf).min(-1)

    def of_robots(values) -> np.ndarray:
        return np.reshape(values, (len(target), 1))

    return FeatureInputs(
        xp=np,
        reach=reach,
        mask=mask,
        travel=np.where(mask, np.take_along_axis(scene.travel, target, 1), 0.0) / reach,
        to=point - scene.at[:, None],
        way=scene.ways_to(scene.targets.cell[target], WAY_AHEAD),
        toward=scene.middle[target],
        gain=gain,
        gain_near=((apart < NEAR + EDGE) * shown).sum(-1),
        gain_around=((apart < AROUND + EDGE) * shown).sum(-1),
        size=scene.size[target],
        value=value,
        score=score,
        claimed=claimed,
        planned=np.arange(mask.shape[1]) == taken[:, None],
        plan_gap=to_nearest(point[robots, taken], ~own & mask.any(-1)),
        own_last=to_nearest(last, own & has_last),
        mates_last=to_nearest(last, ~own & has_last),
        rival=np.where(own[:, None], np.inf, theirs).min(-1),
        at=scene.at,
        heading=of_robots(heading),
        speed=of_robots(speed),
        max_speed=motion.max_speed,
        drive=of_robots(motion.drive(np.asarray(speed))),
        mates=~own,
        time_left=time_left,
        area=np.count_nonzero(scene.grid.known != UNKNOWN) * scene.grid.cell**2,
    )
