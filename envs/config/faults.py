"""Robots that fail."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from maexp.envs.fields import setting

from .group import Group


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

    def checked(self) -> "FaultsConfig":
        """Moments must be pairs of a robot and seconds, of each robot one; they become tuples."""
        super().checked()
        pairs = self.at if isinstance(self.at, Sequence) and not isinstance(self.at, str) else [self.at]
        found: dict[int, float] = {}
        for pair in pairs:
            if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
                raise ValueError(f"faults.at={self.at!r} must be pairs of a robot and seconds, as [[0, 30], [2, 12.5]]")
            robot, seconds = pair
            if isinstance(robot, bool) or not isinstance(robot, int) or robot < 0:
                raise ValueError(f"faults.at names robot {robot!r}: robots have numbers from 0 on")
            if robot in found:
                raise ValueError(f"faults.at names robot {robot} twice: it fails once in an episode")
            if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0.0 <= seconds < math.inf:
                raise ValueError(f"faults.at: the moment of robot {robot}={seconds!r} must be 0 or more seconds")
            found[robot] = float(seconds)
        return replace(self, at=tuple(found.items()))
