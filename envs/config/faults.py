"""Robots that fail."""

import math
from dataclasses import dataclass, replace

from maexp.envs.fields import is_finite, plain_numbers, setting, shown
from maexp.kernels.constants import DT

from .group import Group

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
    def some(self) -> bool:
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
