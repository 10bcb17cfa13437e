"""Weights of the reward."""

from dataclasses import dataclass
from typing import Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import choices_of, setting


@dataclass(frozen=True)
class RewardConfig(Group):
    """Weights of the reward (docs/concepts.md).

    ``points`` / |free| scales explore and overlap, ``events`` the other terms; ``events`` 0 takes
    ``points`` / |free| there too, as the paper does. ``time_on`` "uncovered" pays -(1 - coverage), "covered" pays
    -coverage as the paper prints. "gained" pays at once, for all the steps left, what is newly covered: over an
    episode that is the sum of "uncovered" and a constant, and a critic has less to explain. ``charge_rest``: when the
    last robot of a team has collided, the steps left in the episode are charged at once, as if it went on; else the
    team is spared them. ``unfinished`` adds to what is charged for time in every local step until the team is done:
    the last corners count then, too.
    """

    group = "reward"

    explore: float = setting(0.3, "for a point that no robot of the team had seen before", low=0)
    overlap: float = setting(0.0, "subtracted for a point that another robot sees at the same time", low=0)
    time: float = setting(1.0, "subtracted in every local step, times the share that is still unexplored", low=0)
    unfinished: float = setting(0.0, "added to that share until the team is done", low=0)
    success: float = setting(100.0, "once, when the coverage reaches scenario.success_coverage", low=0)
    collision: float = setting(200.0, "subtracted once, from the robot that collides", low=0)
    points: float = setting(60.0, "explore and overlap are multiplied by points / free points of the map", low=0)
    events: float = setting(
        60.0 / 7000.0, "what multiplies time, success and collision (60 / 7000); 0: points / free points", low=0
    )
    time_on: Literal["uncovered", "covered", "gained"] = setting(
        "uncovered", "covered: the time term grows with what is explored, as the paper prints; gained: paid at once"
    )
    charge_rest: bool = setting(True, "a team that has crashed pays the time that was left, as if the episode went on")

    def checked(self) -> "RewardConfig":
        """Signs are fixed by the meaning of the terms; what is paid at once must be charged."""
        super().checked()
        if self.time_on == "gained" and not self.charge_rest:
            raise ValueError(
                "reward.charge_rest=False with reward.time_on='gained': nothing is charged, "
                "use true or reward.time_on=uncovered"
            )
        return self


TIME_ON = choices_of(RewardConfig, "time_on")  # numbered as in kernels/reward.py
