"""Settings of `maexp irsim`."""

from dataclasses import dataclass

from maexp.agents.settings.groups import LAST_SEED, ImportSettings, import_settings
from maexp.envs.config_fields import setting


@dataclass
class IrsimSettings:
    """`maexp irsim`."""

    floor: str | None = setting(None, "a floor's file, as for maexp maps import")
    policy: str = setting("cost_utility", "a classical one, a trained one or its folder, a run, module:Class")
    num_robots: int = setting(3, "robots in the team", low=1)
    seconds: float | None = setting(None, "length of the trial [s]; default: an episode of our simulator on this floor")
    episode: int = setting(0, "the robots start where they do in this evaluation episode of our simulator", low=0)
    seed: int = setting(0, "of starts, noise and people", low=0, high=LAST_SEED)
    ours: bool = setting(True, "play the same team in our simulator, too")
    radar_range: float | None = setting(None, "of the lidars [m]; default: of the floor's scenario")
    beams: int = setting(180, "of a lidar, all around")
    cell: float = setting(0.1, "of the grid the team maps with [m]")
    clearance: float | None = setting(None, "of a robot's centre from walls [m]; default: as in our simulator")
    body_radius: float | None = setting(None, "of a robot [m]; default: 0.05 m less than the clearance")
    range_noise: float = setting(0.0, "standard deviation of a range [m]")
    pose_noise: float = setting(0.0, "of x and y a robot believes, anew every 0.1 s [m]; of its heading, a fifth [rad]")
    pose_drift: float = setting(0.0, "the same, of an error that walks at random with the way, after 1 m [m]")
    people: int = setting(0, "people who walk about", low=0)
    importing: ImportSettings = import_settings(num_robots="${num_robots}")
