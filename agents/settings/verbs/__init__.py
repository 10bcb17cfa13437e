"""Settings of the verbs, a file for each.

Hydra hands on a `DictConfig` of these types. A function that reads settings by attribute names the dataclass, so that
one sees what there is; one that looks settings up by name, or takes any verb's, says `DictConfig`.
"""

from .bench import BenchSettings
from .benchmark import BenchmarkSettings
from .evaluate import EvaluateSettings
from .export import ExportSettings
from .irsim import IrsimSettings
from .leaderboard import LeaderboardSettings
from .maps import MapsSettings
from .policies import PoliciesSettings
from .ros2 import Ros2Settings
from .suite import SuiteSettings
from .train import TrainSettings
from .view import ViewSettings

SCHEMAS = {
    "train": TrainSettings,
    "evaluate": EvaluateSettings,
    "view": ViewSettings,
    "export": ExportSettings,
    "policies": PoliciesSettings,
    "maps": MapsSettings,
    "irsim": IrsimSettings,
    "suite": SuiteSettings,
    "ros2": Ros2Settings,
    "leaderboard": LeaderboardSettings,
    "bench": BenchSettings,
    "benchmark": BenchmarkSettings,
}
"""The dataclass of each verb's settings."""
EpisodeSettings = TrainSettings | EvaluateSettings
"""Of the verbs that play evaluation episodes with several policies."""

__all__ = [
    "SCHEMAS",
    "BenchSettings",
    "BenchmarkSettings",
    "EpisodeSettings",
    "EvaluateSettings",
    "ExportSettings",
    "IrsimSettings",
    "LeaderboardSettings",
    "MapsSettings",
    "PoliciesSettings",
    "Ros2Settings",
    "SuiteSettings",
    "TrainSettings",
    "ViewSettings",
]
