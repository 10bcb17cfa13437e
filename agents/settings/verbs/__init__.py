"""Settings of the verbs, a file for each.

Hydra hands on a `DictConfig` of these types. A function that reads settings by attribute names the dataclass, so that
one sees what there is; one that looks settings up by name, or takes any verb's, says `DictConfig`.
"""

from maexp.agents.settings.verbs.bench import BenchSettings
from maexp.agents.settings.verbs.benchmark import BenchmarkSettings
from maexp.agents.settings.verbs.evaluate import EvaluateSettings
from maexp.agents.settings.verbs.export import ExportSettings
from maexp.agents.settings.verbs.irsim import IrsimSettings
from maexp.agents.settings.verbs.leaderboard import LeaderboardSettings
from maexp.agents.settings.verbs.maps import MapsSettings
from maexp.agents.settings.verbs.policies import PoliciesSettings
from maexp.agents.settings.verbs.ros2 import Ros2Settings
from maexp.agents.settings.verbs.suite import SuiteSettings
from maexp.agents.settings.verbs.train import TrainSettings
from maexp.agents.settings.verbs.view import ViewSettings

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
