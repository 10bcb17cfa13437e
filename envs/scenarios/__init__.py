"""Generated maps: one file per family, and the table of what belongs to each scenario."""

from maexp.envs.scenarios.table import (
    GENERATED,
    SCENARIOS,
    VOLUMES,
    Scenario,
    cut_last_fifth,
    default_macro_steps,
    find_scenario,
    make_map,
    split,
)

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
