"""Maps, scenarios and the TorchRL env.

Names are looked up on first use, so that a command line or a robot's computer need not wait for TorchRL and Warp.
"""

from maexp.kernels.lazy import lazy_names

_HOMES = {
    "SCENARIOS": "scenarios",
    "CommConfig": "config",
    "FaultsConfig": "config",
    "EnvSettings": "config",
    "ExplorationEnv": "environment",
    "MapError": "map",
    "ObservationConfig": "config",
    "OdometryConfig": "config",
    "PlannerConfig": "config",
    "PointCloudMap": "map",
    "RadarConfig": "config",
    "RewardConfig": "config",
    "RobotConfig": "config",
    "LookaheadConfig": "config",
    "TargetsConfig": "config",
    "check_map": "checker",
    "import_map": "importing",
    "make_map": "scenarios",
    "parallel_env": "apis",
    "split": "scenarios",
    "team_env": "apis",
    "vector_env": "apis",
}
__all__ = [
    "SCENARIOS",
    "CommConfig",
    "FaultsConfig",
    "EnvSettings",
    "ExplorationEnv",
    "MapError",
    "ObservationConfig",
    "OdometryConfig",
    "PlannerConfig",
    "PointCloudMap",
    "RadarConfig",
    "RewardConfig",
    "RobotConfig",
    "LookaheadConfig",
    "TargetsConfig",
    "check_map",
    "import_map",
    "make_map",
    "parallel_env",
    "split",
    "team_env",
    "vector_env",
]

__getattr__ = lazy_names(__name__, _HOMES)
