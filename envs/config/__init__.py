"""Settings of an env as dataclasses, a file for each group; what a scenario fixes comes from its row of the table.

Imports neither torch nor Warp.
"""

from maexp.envs.config.comm import CELL_BYTES, CELLS_OF_RADAR, STRATEGIES, CommConfig
from maexp.envs.config.conditions import FaultsConfig, OdometryConfig
from maexp.envs.config.env import DONE, GROUPS, STARTS, EnvSettings
from maexp.envs.config.group import Group, supplied
from maexp.envs.config.lookahead import LookaheadConfig
from maexp.envs.config.observation import ObservationConfig
from maexp.envs.config.planner import PlannerConfig
from maexp.envs.config.radar import RadarConfig
from maexp.envs.config.reward import TIME_ON, RewardConfig
from maexp.envs.config.robot import BODY, ROBOT_KINDS, VOLUME_KINDS, RobotConfig
from maexp.envs.config.targets import TargetsConfig

__all__ = [
    "BODY",
    "CELLS_OF_RADAR",
    "CELL_BYTES",
    "DONE",
    "GROUPS",
    "ROBOT_KINDS",
    "STARTS",
    "STRATEGIES",
    "TIME_ON",
    "VOLUME_KINDS",
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
