"""Settings of an env as dataclasses, a file for each group; what a scenario fixes comes from its row of the table.

Imports neither torch nor Warp.
"""

from .comm import CELL_BYTES, CELLS_OF_RADAR, STRATEGIES, CommConfig
from .env import DONE, GROUPS, STARTS, EnvSettings
from .faults import FaultsConfig
from .group import Group, supplied
from .lookahead import LookaheadConfig
from .observation import ObservationConfig
from .odometry import OdometryConfig
from .planner import CLEARANCE, PLANNERS, PlannerConfig
from .radar import RadarConfig
from .reward import TIME_ON, RewardConfig
from .robot import BODY, ROBOT_KINDS, RobotConfig
from .targets import TargetsConfig

__all__ = [
    "BODY",
    "CELLS_OF_RADAR",
    "CELL_BYTES",
    "CLEARANCE",
    "DONE",
    "GROUPS",
    "PLANNERS",
    "ROBOT_KINDS",
    "STARTS",
    "STRATEGIES",
    "TIME_ON",
    "CommConfig",
    "EnvSettings",
    "FaultsConfig",
    "Group",
    "LookaheadConfig",
    "ObservationConfig",
    "OdometryConfig",
    "PlannerConfig",
    "RadarConfig",
    "RewardConfig",
    "RobotConfig",
    "TargetsConfig",
    "supplied",
]
