"""Checks of settings that their types cannot express."""

from typing import Any

from maexp.agents.errors import UserError


def check_counts(node: Any, *names: str, least: int = 1, prefix: str = "") -> None:
    """Raise UserError unless each setting is a whole number of at least `least`."""
    for name in names:
        value = node[name]
        if type(value) is not int or value < least:
            raise UserError(f"{prefix}{name}={value} must be a whole number, {least} or more.")


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
    if not sizes or not all(type(one) is int and one >= 1 for one in sizes):
        raise UserError(f"num_robots={value} must be a whole number, 1 or more, or several as num_robots=1,2,6.")
    return sizes
