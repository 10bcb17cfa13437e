"""Generated maps: one file per family, and the table of what belongs to each scenario."""

from .table import SCENARIOS, Scenario, find_scenario, make_map, split

__all__ = ["SCENARIOS", "Scenario", "find_scenario", "make_map", "split"]
