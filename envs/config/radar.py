"""A robot's radar."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import setting
from maexp.envs.scenarios import Scenario

MOST_MISSED = 0.99  # of a radar's returns
MOST_FALSE = 0.4  # of a free point's returns: walls that are none must be found out
MOST_EVIDENCE = 100  # returns that a robot may ask for before it knows a point


@dataclass(frozen=True)
class RadarConfig(Group):
    """A robot's range sensor."""

    group = "radar"

    range: float | None = setting(None, "how far it sees", unit="m", above=0, scenario="radar_range")
    fov: float = setting(2.0 * math.pi, "field of view", unit="rad", above=0)
    vertical_fov: float | None = setting(
        None, "field of view up and down, half of it each, in volumes", unit="rad", above=0, high=math.pi
    )
    every: int | None = setting(None, "local steps from one scan to the next, in volumes", low=1)
    alpha1: float = setting(1e-3, "1 - cos of a beam's half width; 1e-3: 2.56 degrees", low=0, high=2)
    alpha2: float = setting(
        1e-6, "an obstacle point hides what is behind it, and before it what is nearer by less than this", unit="m"
    )
    obstacle_radius: float | Literal["auto"] = setting(
        "auto", "of an obstacle point; auto: its spacing / sqrt(2)", unit="m", low=0
    )
    missed: float = setting(
        0.0, "probability that a point in view gives no return in a step of 0.1 s", low=0, high=MOST_MISSED
    )
    noise: float = setting(
        0.0, "standard deviation of a range; returns off by half the points' spacing are dropped", unit="m", low=0
    )
    false_alarm: float = setting(
        0.0,
        "probability that a free point in view looks like a wall in a step of 0.1 s",
        low=0,
        high=MOST_FALSE,
    )
    evidence: int = setting(1, "returns of a point after which a robot knows it", low=1, high=MOST_EVIDENCE)

    def completed(self, scenario: Scenario) -> "RadarConfig":
        """With the scenario's range, and in volumes its view up and down and how often it scans."""
        config = super().completed(scenario)
        up, every = config.vertical_fov or scenario.vertical_fov, config.every or scenario.scan_every
        return replace(config, vertical_fov=up, every=every)

    @property
    def perfect(self) -> bool:
        """Whether a robot knows at once all that is in view."""
        return self.missed == 0.0 and self.noise == 0.0 and self.false_alarm == 0.0 and self.evidence == 1
