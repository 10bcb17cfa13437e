"""Ranges of settings, written beside their defaults in the dataclasses that hold them."""

import math
from dataclasses import Field, field, fields
from typing import Any

WHOLE_LIMIT = 10**9  # beyond any sensible count, and far from overflowing a 64-bit integer


def number(default: float, low: float = 0.0, high: float = math.inf, *, open_ends: bool = False) -> Any:
    """A field for a finite number from `low` to `high`; `open_ends` leaves the two bounds themselves out."""
    if high == math.inf:
        wanted = f"a finite number above {low:g}" if open_ends else f"a finite number, {low:g} or more"
    else:
        wanted = f"a number above {low:g} and below {high:g}" if open_ends else f"a number from {low:g} to {high:g}"

    def fits(value: Any) -> bool:
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return good and (low < value < high if open_ends else low <= value <= high)

    return field(default=default, metadata={"range": (fits, wanted)})


def whole(default: int, least: int = 1, most: int = WHOLE_LIMIT) -> Any:
    """A field for a whole number from `least` to `most`."""
    wanted = f"a whole number, {least} or more" if most == WHOLE_LIMIT else f"a whole number from {least} to {most}"

    def fits(value: Any) -> bool:
        return type(value) is int and least <= value <= most

    return field(default=default, metadata={"range": (fits, wanted)})


def flag(default: bool) -> Any:
    """A field that is true or false."""
    return field(default=default, metadata={"range": (lambda value: isinstance(value, bool), "true or false")})


def choice(default: str, *others: str) -> Any:
    """A field for one of several words."""
    words = (default, *others)
    return field(default=default, metadata={"range": (lambda value: value in words, f"one of {', '.join(words)}")})


def check_ranges(settings: Any, group: str) -> None:
    """Raise ValueError, naming `group.name=value` and the range, for the first field that is out of its own."""
    for one in fields(settings):
        if "range" in one.metadata:
            _check(one, getattr(settings, one.name), group)


def _check(one: Field, value: Any, group: str) -> None:
    fits, wanted = one.metadata["range"]
    if not fits(value):
        raise ValueError(f"{group}.{one.name}={value!r} must be {wanted}.")
