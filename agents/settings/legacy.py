"""Defaults that were others once: a checkpoint that does not hold a value keeps the one it was written with.

**Change a default, and write its old value here**, at the end of `OLD_DEFAULTS`: as an override, or as a function
that makes one from the row of the scenario (`maexp.envs.scenarios.Scenario`) and the words of the run, where the old
default depended on these. A new setting goes here too unless its default is what the code did before.

What `action=targets` sets (its reward, `lmbda`) is not here: checkpoints that can have it hold every value.

The list is used for two kinds of checkpoints:

- those of commit 7bfb560 and before, which hold the words of their command line and nothing else: the list stands in
  front of these words, so whatever the run had set itself wins;
- later ones, which hold every value: of the list they take the settings that they do not know yet.
"""

from collections.abc import Callable

from maexp.agents.settings.overrides import find_override
from maexp.envs.scenarios import Scenario, find_scenario

OLD_SCENARIO = "maze_small"


def _wheelbase(row: Scenario, words: list[str]) -> str:
    """The body's length [m]."""
    return f"robot.wheelbase={find_override(words, 'robot.length') or row.body_length}"


def _clearance(row: Scenario, words: list[str]) -> str:
    """That of DWA, in collision thresholds; it alone had the scenario's."""
    if (find_override(words, "planner") or "dwa") != "dwa":
        return "planner=dwa"
    factor = row.clearance_factor if row.build else "null"  # null: that of the map's own scenario
    return f"planner.clearance_factor={factor}"


OLD_DEFAULTS: list[str | Callable[[Scenario, list[str]], str]] = [
    f"scenario={OLD_SCENARIO}",
    "algorithm=mappo",
    "planner=dwa",
    "action=regions",
    "reward.overlap=0.01",
    _wheelbase,
    _clearance,
    "collector.steps=15",
    "scenario.validation=[]",
    "reward.charge_rest=false",
    "algorithm.finite_horizon=false",
    "model.offsets=shared",
    "model.sees_time=false",
    "algorithm.mask_collided=false",
]


def old_defaults(words: list[str]) -> list[str]:
    """The overrides to put in front of the words of a run that was started when these were the defaults."""
    row = find_scenario(find_override(words, "scenario") or OLD_SCENARIO)
    return [one if isinstance(one, str) else one(row, words) for one in OLD_DEFAULTS]
