"""A robot's body and limits."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

from maexp.envs.config.group import Group
from maexp.envs.config_fields import check_value, kinds, setting
from maexp.envs.scenarios import Scenario

RobotKind = Literal["ackermann", "differential", "omnidirectional"]

BODY = ("length", "width", "collision_threshold")
"""What a radius decides of a robot."""
VolumeKind = Literal["quadrotor", "climber"]


@dataclass(frozen=True)
class RobotConfig(Group):
    """One robot; None takes the scenario's value. ``radius`` makes the body round: length, width and collision
    threshold follow from it (`Scenario.with_radius`)."""

    group = "robot"

    kind: Literal[RobotKind, VolumeKind] | None = setting(
        None, "how it drives; in volumes quadrotor or climber, which drives on the ground and climbs steps"
    )
    length: float | None = setting(None, "of the body", unit="m", above=0, scenario="body_length")
    width: float | None = setting(None, "of the body", unit="m", above=0, scenario="body_width")
    wheelbase: float | Literal["width", "length"] | None = setting(
        None, "of a car, or width or length: that of the body; default: its width", unit="m", above=0
    )
    max_speed: float | None = setting(None, "greatest speed", unit="m/s", above=0, scenario="max_speed")
    max_accel: float | None = setting(None, "greatest acceleration", unit="m/s^2", above=0, scenario="max_accel")
    max_steer: float | None = setting(None, "steering limit of a car", unit="rad", above=0, scenario="max_steer")
    max_yaw_rate: float = setting(math.pi / 2, "turn limit of a differential drive", unit="rad/s", above=0)
    collision_threshold: float | None = setting(
        None, "centre to a wall or another centre", unit="m", above=0, scenario="collision_threshold"
    )
    radius: float | None = setting(
        None, "of a round body, which says length, width and collision_threshold", unit="m", above=0
    )
    step_height: float = setting(0.25, "highest step of a climber, rounded up to whole voxels", unit="m", low=0)

    def completed(self, scenario: Scenario) -> "RobotConfig":
        """With what the radius or the scenario fixes."""
        if self.radius is not None:
            self._check_radius(self.radius)
            scenario = scenario.with_radius(self.radius)
        config = super().completed(scenario)
        if config.kind is None:
            kind: Any = scenario.robot_kind
            config = replace(config, kind=kind)
        if config.wheelbase in (None, "width", "length"):
            config = replace(config, wheelbase=getattr(config, config.wheelbase or "width"))
        if config.max_steer is not None and config.max_steer >= math.pi / 2:
            raise ValueError(f"robot.max_steer={config.max_steer} must stay below pi/2 = 1.5708 rad")
        return config

    def _check_radius(self, radius: float) -> None:
        """It is one, and agrees with what else is said of the body."""
        metadata = {field.name: field.metadata for field in fields(self)}["radius"]
        check_value("robot.radius", radius, kinds(RobotConfig)["radius"], metadata)
        for name in BODY:
            value, round_one = getattr(self, name), radius if name == "collision_threshold" else 2 * radius
            if value is not None and value != round_one:
                raise ValueError(
                    f"robot.radius={radius:g} makes robot.{name} {round_one:g} m, and {value} is given: leave one of "
                    "the two out"
                )


ROBOT_KINDS, VOLUME_KINDS = get_args(RobotKind), get_args(VolumeKind)
"""Those that drive in the plane, and those that move in volumes."""
