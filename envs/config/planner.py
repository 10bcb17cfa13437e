"""Local planners: how robots drive to their goals."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from maexp.conf import list_choices, read_choice
from maexp.envs.config.group import Group
from maexp.envs.config_fields import setting
from maexp.envs.scenarios import Scenario


@cache
def clearance_factors() -> dict[str, float]:
    """The clearance factors of the planners that have one of their own."""
    choices = [read_choice("planner", name) for name in list_choices("planner")]
    return {values["name"]: factor for values in choices if (factor := values.get("clearance_factor"))}


@dataclass(frozen=True)
class PlannerConfig(Group):
    """How a robot drives to its goal (docs/planners.md)."""

    group = "planner"

    name: Literal["dwa", "wavefront", "direct"] = setting(
        "wavefront", "dwa: straight to the goal; wavefront: on a way through the known map; direct: the policy steers"
    )
    num_accel: int = setting(3, "DWA's candidates of the acceleration", low=1)
    num_steering: int | None = setting(None, "DWA's candidates of the steering angle", low=1, scenario="num_steering")
    horizon: int = setting(3, "local steps that DWA looks ahead", low=1)
    clearance_factor: float | None = setting(
        None, "nearer than so many collision thresholds costs DWA; wavefront's paths keep as clear of walls", above=0
    )
    clearance_weight: float = setting(100.0, "how much that costs", above=0)
    replan_steps: int = setting(5, "local steps between two looks of wavefront for a path", low=1)

    def completed(self, scenario: Scenario) -> "PlannerConfig":
        """With the scenario's candidates and the planner's clearance."""
        if self.clearance_factor is not None:
            return super().completed(scenario)
        factor = clearance_factors().get(self.name, scenario.clearance_factor)
        return replace(self, clearance_factor=factor).completed(scenario)
