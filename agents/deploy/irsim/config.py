"""What a trial in ir-sim is made of."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

TOLERANCE = 0.05  # [m] that a body is smaller than the clearance that is planned with: no driver is perfect


@dataclass(frozen=True)
class TrialConfig:
    """A team, its sensors, and what disturbs them; lengths in metres, angles in radians, times in seconds.

    Attributes:
        seconds: length of the trial.
        decide: time between two decisions of the planner.
        beams: of a lidar, all around.
        radar_range: of a lidar.
        cell: of the grid that the team maps with.
        range_noise: standard deviation of a range.
        pose_noise: standard deviation of x and y in what a robot believes, anew every step; of its heading, a fifth
            in rad.
        pose_drift: of the random walk of x and y in that, after 1 m of way; of its heading, a fifth in rad.
        people: who walk about.
        body_radius, max_speed, max_accel, max_yaw_rate: of a robot, a round differential drive.
        clearance: distance of a robot's centre to walls that the planner keeps.
        seed: of all of these.
    """

    seconds: float
    radar_range: float
    max_speed: float
    max_accel: float
    body_radius: float
    clearance: float
    decide: float = 2.0
    beams: int = 180
    cell: float = 0.1
    range_noise: float = 0.0
    pose_noise: float = 0.0
    pose_drift: float = 0.0
    people: int = 0
    max_yaw_rate: float = math.pi / 2
    seed: int = 0

    def __post_init__(self):
        zero = ("range_noise", "pose_noise", "pose_drift", "people", "seed")
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and field.name in zero))):
                least = "0 or more" if field.name in zero else "above 0"
                raise ValueError(f"{field.name}={value!r} must be a finite number, {least}")
        if self.beams < 8 or self.beams > 3600:
            raise ValueError(f"beams={self.beams} must be 8 to 3600")
