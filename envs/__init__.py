"""Maps, scenarios and the TorchRL env."""

from maexp.envs.apis import parallel_env, vector_env
from maexp.envs.checker import check_map
from maexp.envs.config import (
    CommConfig,
    ObservationConfig,
    PlannerConfig,
    RadarConfig,
    RewardConfig,
    RobotConfig,
)
from maexp.envs.environment import ExplorationEnv
from maexp.envs.importing import import_map
from maexp.envs.map import MapError, PointCloudMap
from maexp.envs.scenarios import SCENARIOS, make_map, split

__all__ = [
    "SCENARIOS",
    "CommConfig",
    "ExplorationEnv",
    "MapError",
    "ObservationConfig",
    "PlannerConfig",
    "PointCloudMap",
    "RadarConfig",
    "RewardConfig",
    "RobotConfig",
    "check_map",
    "import_map",
    "make_map",
    "parallel_env",
    "split",
    "vector_env",
]
