"""Odometry that drifts."""

from dataclasses import dataclass

from maexp.envs.fields import setting

from .group import Group


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
    def some(self) -> bool:
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
        if self.map_errors and not self.some:
            raise ValueError(
                "odometry.map_errors=true and robots know where they are, so their maps are true: add odometry.drift, "
                "odometry.turn or odometry.jump"
            )
        return self
