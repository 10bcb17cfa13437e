"""Checks of settings that their types cannot express."""

from collections.abc import Sequence
from typing import Any

from maexp.agents.config.algorithms import TUNINGS
from maexp.agents.config.groups import LAST_SEED
from maexp.agents.config.verbs import NAMES, BenchmarkSettings
from maexp.agents.errors import UserError
from maexp.envs.config_fields import WHOLE_LIMIT, shown
from maexp.envs.scenarios import SCENARIOS, VOLUMES


def check_seed(value: Any, name: str = "seed") -> None:
    """Raise UserError unless random numbers can start from it: other numbers would share those of a smaller one."""
    if type(value) is not int or not 0 <= value <= LAST_SEED:
        given = shown(value) if isinstance(value, int) else value
        raise UserError(f"{name}={given} must be a whole number from 0 to {LAST_SEED}.")


def check_distinct(name: str, values: Sequence) -> None:
    """Raise UserError where a list names something twice."""
    twice = next((value for k, value in enumerate(values) if value in values[:k]), None)
    if twice is not None:
        raise UserError(f"{name}={','.join(map(str, values))} names {twice} twice: give each once.")


def choices_of(value: Any) -> list[str]:
    """The words of a setting that names one policy or several."""
    return [str(item) for item in as_list(value)]


def team_sizes(value: Any) -> list[int]:
    """The team sizes of num_robots=3 or num_robots=1,2,6.

    Raises:
        UserError: something else was given.
    """
    sizes = [value] if isinstance(value, int) and not isinstance(value, bool) else value
    try:
        sizes = list(sizes)
    except TypeError:
        sizes = []
    whole = all(type(size) is int for size in sizes)
    if whole and (large := max(sizes, default=0)) > WHOLE_LIMIT:
        raise UserError(f"num_robots={shown(large)} must be a whole number from 1 to {WHOLE_LIMIT}.")
    if not sizes or not whole or min(sizes) < 1:
        raise UserError(f"num_robots={value} must be a whole number, 1 or more, or several as num_robots=1,2,6.")
    check_distinct("num_robots", sizes)
    return sizes


def check_names(cfg: BenchmarkSettings) -> None:
    """Raise UserError unless the scenarios and algorithms of a benchmark are those there are."""
    known = {"scenarios": [*SCENARIOS, *VOLUMES], "algorithms": [*TUNINGS]}
    for name, choices in known.items():
        allowed = [*choices, *NAMES] if name == "algorithms" else choices
        for value in as_list(getattr(cfg, name)):
            if value not in allowed:
                raise UserError(f"{name}={value} is unknown: choose of {', '.join(choices)}.")


def as_list(value: Any) -> list:
    """A setting of one value or several as a list."""
    if value is None:
        return []
    return list(value) if isinstance(value, list | tuple) else [value]
