"""Settings of `maexp maps`."""

from dataclasses import dataclass, field

from omegaconf import MISSING

from maexp.agents.settings.groups import ImportSettings, import_settings
from maexp.envs.config_fields import setting


@dataclass
class RoundSettings:
    """Of the robots a map is for."""

    radius: float | None = setting(None, "of a round body; default: the robot of the map's scenario", unit="m")


@dataclass
class MapsSettings:
    """`maexp maps`."""

    task: str = MISSING
    file: str | None = setting(
        None, "a map's file, for import also a folder of them, for make and show a scenario, for fetch a set"
    )
    index: int = setting(0, "which map of the scenario", low=0)
    out: str | None = setting(
        None, "file to write, .npz or for nav2 .yaml; default: in the run's folder; fetch: folder of sets, the cache"
    )
    mirror: str | None = setting(None, "fetch: address in place of the one where the set is published")
    num_robots: int = setting(3, "the team that must find room", low=1)
    volume: bool = setting(False, "import: keep a cloud, mesh or octree in three dimensions, as voxels")
    repair: bool = setting(False, "check: mend what can be mended and write the mended map")
    robot: RoundSettings = field(default_factory=RoundSettings)
    importing: ImportSettings = import_settings(robot_radius="${robot.radius}", num_robots="${num_robots}")
