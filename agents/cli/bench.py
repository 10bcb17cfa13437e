"""`maexp bench`: throughput, as a table and JSON."""

import importlib
from pathlib import Path

from maexp.agents.cli import Command
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.overrides import find_override, move_sweeps
from maexp.agents.config.runs import Recipe
from maexp.agents.config.verbs import BenchSettings
from maexp.agents.errors import UserError, blame_input

ONE_VALUE = ("task", "seconds", "baseline", "largest", "device", "hydra")


def prepare(overrides: list[str]) -> Recipe:
    """Settings given several values go to `sweep`; their first value stands in their place.

    `bench env` measures both planners unless one is chosen.
    """
    names = [word.partition("=")[0] for word in overrides]
    if find_override(overrides, "task") == "env" and not {"planner", "planner.name"} & set(names):
        overrides = [*overrides, "planner=wavefront,dwa"]
    return Recipe(move_sweeps(overrides, ONE_VALUE))


def check(cfg: BenchSettings) -> None:
    """Raise UserError for team sizes that are none, and for settings that another measurement has."""
    if cfg.num_robots is not None:
        team_sizes(cfg.num_robots)
    for name, action in (("baseline", "kernels"), ("axes", "scale"), ("largest", "scale")):
        value = getattr(cfg, name)
        if value is not None and cfg.task != action:
            raise UserError(f"{name}={value} belongs to maexp bench {action}, not to maexp bench {cfg.task}.")


def run(cfg: BenchSettings, where: Path, overrides: list[str]) -> int:
    """Measure what `action` names; each has a module of its own."""
    home = importlib.import_module(f"maexp.agents.benchmarks.throughput.{cfg.task}")
    with blame_input():
        home.run(cfg, where, overrides)
    return 0


COMMAND = Command(run, check, prepare=prepare)
