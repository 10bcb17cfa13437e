"""Maps, scenarios and the TorchRL env.

Names are looked up on first use, so that a command line or a robot's computer need not wait for TorchRL and Warp.
"""

from maexp.kernels.lazy import lazy_names
from maexp.kernels.moved import redirect_modules

_HOMES = {
    "SCENARIOS": "scenarios",
    "CommConfig": "config",
    "FaultsConfig": "config",
    "EnvSettings": "config",
    "ExplorationEnv": "environment",
    "MapError": "maps.point_cloud",
    "ObservationConfig": "config",
    "OdometryConfig": "config",
    "PlannerConfig": "config",
    "PointCloudMap": "maps.point_cloud",
    "RadarConfig": "config",
    "RewardConfig": "config",
    "RobotConfig": "config",
    "LookaheadConfig": "config",
    "TargetsConfig": "config",
    "VoxelMap": "volume",
    "check_map": "maps.checker",
    "import_map": "io",
    "make_map": "scenarios",
    "parallel_env": "wrappers",
    "split": "scenarios",
    "team_env": "wrappers",
    "vector_env": "wrappers",
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
    "VoxelMap",
    "check_map",
    "import_map",
    "make_map",
    "parallel_env",
    "split",
    "team_env",
    "vector_env",
]

__getattr__ = lazy_names(__name__, _HOMES)

redirect_modules(
    __name__,
    {
        "apis": "wrappers",
        "checker": "maps.checker",
        "choices": "targets.heuristics",
        "contacts": "comm.radio_features",
        "features": "targets.features",
        "fields": "config_fields",
        "film": "render.video",
        "importing": "io",
        "map": "maps.point_cloud",
        "starts": "spawn",
        "viewing": "render",
    },
)
