"""Imperfect conditions: robots that fail, and odometry that drifts."""

import math
from dataclasses import dataclass, replace

from maexp.envs.config.group import Group
from maexp.envs.config_fields import is_finite, plain_numbers, setting, shown
from maexp.kernels.constants import DT

LATEST = 1e8  # moment [s]; no episode is so long, and a step's number fits in 32 bits


@dataclass(frozen=True)
class FaultsConfig(Group):
    """Robots that fail (docs/conditions.md): they stop, see nothing, say nothing and stand in the way."""

    group = "faults"

    probability: float = setting(
        0.0, "that a robot fails in an episode, at a moment drawn evenly over it", low=0, high=1
    )
    at: tuple[tuple[int, float], ...] = setting(
        (), "failures at given moments: pairs of a robot and seconds, as [[0, 30], [2, 12.5]]"
    )
    duration: float = setting(math.inf, "how long a failure lasts; inf: for good", unit="s", low=0.1, infinite=True)

    @property
    def enabled(self) -> bool:
        """Whether any robot may fail."""
        return self.probability > 0.0 or bool(self.at)

    @property
    def steps(self) -> dict[int, int]:
        """The step before which each robot of ``at`` fails."""
        return {robot: round(min(seconds, LATEST) / DT) for robot, seconds in self.at}

    def checked(self) -> "FaultsConfig":
        """Moments must be pairs of a robot and seconds, of each robot one; they become tuples."""
        super().checked()
        pairs = plain_numbers(self.at)
        found: dict[int, float] = {}
        for pair in pairs if isinstance(pairs, list) else [pairs]:
            if not isinstance(pair, list) or len(pair) != 2:
                raise ValueError(
                    f"faults.at={shown(self.at)} must be pairs of a robot and seconds, as [[0, 30], [2, 12.5]]"
                )
            robot, seconds = pair
            if isinstance(robot, float) and robot.is_integer():  # an array of pairs has no whole numbers
                robot = int(robot)
            if isinstance(robot, bool) or not isinstance(robot, int) or robot < 0:
                raise ValueError(f"faults.at names robot {shown(robot)}: robots have numbers from 0 on")
            if robot in found:
                raise ValueError(f"faults.at names robot {shown(robot)} twice: it fails once in an episode")
            if not is_finite(seconds) or seconds < 0:
                raise ValueError(
                    f"faults.at: the moment of robot {shown(robot)}={shown(seconds)} must be 0 or more seconds, and "
                    "finite"
                )
            found[robot] = float(seconds)
        return replace(self, at=tuple(found.items()))


@dataclass(frozen=True)
class OdometryConfig(Group):
    """How far robots are from where they believe to be (docs/conditions.md): normal errors, whose spread grows with the
    root of the way driven, and jumps; and whether their maps are wrong by it."""

    group = "odometry"

    drift: float = setting(0.0, "spread of a robot's error along each axis after one metre", unit="m", low=0)
    turn: float = setting(0.0, "the same of its heading", unit="rad", low=0)
    jump: float = setting(0.0, "spread of a jump along each axis", unit="m", low=0)
    jump_rate: float = setting(0.0, "how often a robot jumps", unit="1/s", low=0, high=10)
    map_errors: bool = setting(False, "robots draw what they see where they believe it to be; else where it is")

    @property
    def enabled(self) -> bool:
        """Whether robots may be elsewhere than they believe."""
        return self.drift > 0.0 or self.turn > 0.0 or self.jump > 0.0

    def checked(self) -> "OdometryConfig":
        """Jumps need a spread and a rate, and errors of maps an odometry that drifts."""
        super().checked()
        if (self.jump > 0.0) != (self.jump_rate > 0.0):
            raise ValueError(
                f"odometry.jump={self.jump:g} m and odometry.jump_rate={self.jump_rate:g} 1/s: jumps need both, "
                "or neither"
            )
        if self.map_errors and not self.enabled:
            raise ValueError(
                "odometry.map_errors=true and robots know where they are, so their maps are true: add odometry.drift, "
                "odometry.turn or odometry.jump"
            )
        return self
