"""Generated maps: one file per family, and the table of what belongs to each scenario."""

from maexp.envs.scenarios.table import Scenario, cut_last_fifth, default_macro_steps, find_scenario, make_map, split
from maexp.kernels.lazy import lazy_names

__all__ = [
    "GENERATED",
    "SCENARIOS",
    "VOLUMES",
    "Scenario",
    "cut_last_fifth",
    "default_macro_steps",
    "find_scenario",
    "make_map",
    "split",
]

__getattr__ = lazy_names(__name__, dict.fromkeys(("GENERATED", "SCENARIOS", "VOLUMES"), "table"))
