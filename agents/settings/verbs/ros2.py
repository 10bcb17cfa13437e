"""Settings of `maexp ros2`."""

from dataclasses import dataclass, field, fields, make_dataclass
from typing import Any

from omegaconf import MISSING

from maexp.agents.deploy.planner.team_driver import DriverSettings
from maexp.agents.settings.groups import LAST_SEED
from maexp.agents.settings.storable import storable
from maexp.envs.config.comm import CommConfig
from maexp.envs.config_fields import explain, setting

CommSettings = storable(CommConfig)

DriveSettings = make_dataclass(
    "DriveSettings",
    [
        (row.name, Any, setting(None if row.default == () else row.default, f"team: {explain(row.metadata)}"))
        for row in fields(DriverSettings)
        if row.name != "comm"
    ],
)


@dataclass
class Ros2Settings(DriveSettings):
    """`maexp ros2`."""

    task: str = MISSING
    comm: CommSettings = field(default_factory=CommSettings)
    place: str | None = setting(None, "serve: the suite, or the .yaml file of one")
    domain: int | None = setting(None, "number of DDS's domain; default: ROS_DOMAIN_ID, or 0")
    answer: float = setting(60.0, "how long the other side may be silent before this ends", unit="s", above=0)
    robots: Any = setting(None, "namespaces, a,b,c; serve: default robot1,robot2,...")
    goals: str = setting("goal_pose", "team: sends goals by this topic, or by the action navigate_to_pose")
    name: str = setting("ros2", "serve: what results call those who play")
    seed: int | None = setting(
        None, "serve: plays other maps and starts than the frozen ones, those of this seed", low=0, high=LAST_SEED
    )
    resume: str | None = setting(None, "serve: folder of a run to go on with")
    tf: str = setting("shared", "serve: /tf with frames NAME/base_link; own: /NAME/tf with base_link")
    wait_for: str = setting("all", "serve: the clock waits until all robots have a new goal; idle: those without one")
    stands: float = setting(5.0, "serve: how long the clock stands still for goals", unit="s", above=0)
    limit: float = setting(
        10.0, "serve: how long it runs on then, before robots without a goal stay", unit="s", above=0
    )
