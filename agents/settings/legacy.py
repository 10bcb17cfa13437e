"""Defaults that were others once: a checkpoint that does not hold a value keeps the one it was written with.

**Change a default, and write its old value here**, at the end of `OLD_DEFAULTS`: as an override, or as a function
that makes one from the row of the scenario (`maexp.envs.scenarios.Scenario`) and the words of the run, where the old
default depended on these ("" where there was none). A new setting goes here too unless its default is what
the code did before.

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
PRESETS = {"paper": "reference"}
"""Tunings that a preset chooses."""
THREE_PASSES = {"epochs": 3, "minibatch_size": 128, "lr": 0.0007, "critic_lr": 0.001}
"""What the clipped algorithms had."""


def _wheelbase(row: Scenario, words: list[str]) -> str:
    """The body's length [m]."""
    return f"robot.wheelbase={find_override(words, 'robot.length') or row.body_length}"


def _clearance(row: Scenario, words: list[str]) -> str:
    """That of DWA, in collision thresholds; it alone had the scenario's."""
    if (find_override(words, "planner") or "dwa") != "dwa":
        return "planner=dwa"
    factor = row.clearance_factor if row.build else "null"  # null: that of the map's own scenario
    return f"planner.clearance_factor={factor}"


def _clipped(name: str, value: float) -> Callable[[Scenario, list[str]], str]:
    """A setting of the algorithms that pass over a batch several times, which had three passes then."""

    def word(row: Scenario, words: list[str]) -> str:
        own = "reference" in (find_override(words, "tuning"), PRESETS.get(find_override(words, "preset")))
        clipped = (find_override(words, "algorithm") or "mappo") in ("ippo", "mappo", "vdppo")
        return f"algorithm.{name}={value}" if clipped and not own else ""

    return word


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
    "model.critic_attends=true",
    *(_clipped(name, value) for name, value in THREE_PASSES.items()),
]


def old_defaults(words: list[str]) -> list[str]:
    """The overrides to put in front of the words of a run that was started when these were the defaults."""
    row = find_scenario(find_override(words, "scenario") or OLD_SCENARIO)
    found = [one if isinstance(one, str) else one(row, words) for one in OLD_DEFAULTS]
    return [one for one in found if one]
