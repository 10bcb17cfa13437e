"""Checks of settings that their types cannot express."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from omegaconf import DictConfig

from maexp.agents.errors import UserError
from maexp.agents.settings.groups import LAST_SEED, CollectorSettings
from maexp.agents.settings.verbs import SCHEMAS
from maexp.envs.config_fields import WHOLE_LIMIT, check_value, kinds, shown


def check_counts(node: DictConfig, *names: str, least: int = 1, prefix: str = "") -> None:
    """Raise UserError unless each setting is a whole number of at least `least`."""
    for name in names:
        value = node[name]
        if type(value) is not int or value < least:
            raise UserError(f"{prefix}{name}={value} must be a whole number, {least} or more.")


def check_ranges(cfg: DictConfig, verb: str) -> None:
    """Raise UserError for the first setting of a verb, or of its collector, that is out of the range of its field.

    What belongs to an env, an algorithm or a network is checked where that is made. A verb checks what it is run with:
    settings that only tell it of a run may hold what another verb needs, as episodes=0.
    """
    for kind, node, prefix in ((SCHEMAS[verb], cfg, ""), (CollectorSettings, cfg.get("collector"), "collector.")):
        for setting in fields(kind) if node is not None else ():
            limits = setting.metadata.get("limits", {})
            if limits.get("low") is not None or limits.get("above") is not None:
                check_value(
                    prefix + setting.name, node[setting.name], kinds(kind)[setting.name], setting.metadata, UserError
                )


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
    if value is None:
        return []
    return [value] if isinstance(value, str) else [str(item) for item in value]


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
