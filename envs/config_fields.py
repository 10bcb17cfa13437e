"""Settings as fields of dataclasses: type, default, range, unit and one line of help, each said once.

From these come the check of a value and its message (`check_settings`), the comments of a run's `config.yaml`, the
types and defaults of the command line (`maexp.agents.config.schema`), and the manual's table of settings. Imports
neither torch nor Warp: whoever asks for help does not wait for them.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, field, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

WHOLE_LIMIT = 10**9  # beyond any sensible count, and far from overflowing a 64-bit integer
NUMBER_LIMIT = 1e12  # beyond anything measured; kernels count in 32 bits, which hold its third power
PRIMITIVES = (bool, int, float, str)


def setting(
    default: Any = MISSING,
    help: str = "",
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    infinite: bool = False,
    scenario: str | None = None,
) -> Any:
    """A field of a dataclass that is a setting.

    Args:
        help: what it means, in a line.
        unit: of the number, as "m/s".
        low, high: bounds that it may reach; above, below: that it may not. An upper bound goes with a lower one.
        infinite: whether it may be inf, too.
        scenario: the field of `Scenario` whose value it takes where it is None.
    """
    limits = {"low": low, "high": high, "above": above, "below": below, "infinite": infinite}
    metadata = {"help": help, "unit": unit, "limits": limits, "scenario": scenario}
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def same(cls: type[Any], name: str) -> Any:
    """The setting of another dataclass."""
    return replaced(cls, name, cls.__dataclass_fields__[name].default)


def replaced(cls: type[Any], name: str, default: Any) -> Any:
    """The setting of another dataclass, with another default."""
    return field(default=default, metadata=cls.__dataclass_fields__[name].metadata)


def explain(metadata: Mapping) -> str:
    """Help and unit of a field in one line: "radius of a round body [m]"."""
    unit = metadata.get("unit", "")
    return f"{metadata.get('help', '')} [{unit}]".strip() if unit else metadata.get("help", "")


def describe(cls: type) -> list[str]:
    """The settings of a dataclass as a list in reStructuredText: name, default, help; [] where there are none."""
    rows = []
    for setting in fields(cls) if is_dataclass(cls) else ():
        if setting.metadata.get("help"):
            default = f" = {setting.default}" if isinstance(setting.default, PRIMITIVES) else ""
            rows.append(f"- ``{setting.name}{default}``: {explain(setting.metadata)}")
    return ["", *rows, ""] if rows else []


def choices_of(cls: type, name: str) -> tuple[str, ...]:
    """The words that a setting may be, as its type names them."""
    return tuple(word for kind in kinds(cls)[name] if get_origin(kind) is Literal for word in get_args(kind))


@cache
def kinds(cls: type) -> dict[str, tuple]:
    """The types that each field of a dataclass may have."""
    unions = (Union, UnionType)
    hints = get_type_hints(cls)
    return {name: get_args(kind) if get_origin(kind) in unions else (kind,) for name, kind in hints.items()}


def check_settings(settings: Any, group: str = "", error: type[ValueError] = ValueError) -> None:
    """Raise ``error``, naming `group.name=value` and what it must be, for the first setting that is out of its range.

    Values of several numbers (a type that is neither a number, a bool nor a word) are left to whoever reads them.
    """
    allowed = kinds(settings.__class__)
    for setting in fields(settings):
        if "limits" in setting.metadata:
            name = f"{group}.{setting.name}" if group else setting.name
            check_value(name, getattr(settings, setting.name), allowed[setting.name], setting.metadata, error)


def check_value(name: str, value: Any, allowed: tuple, metadata: Mapping, error: type[Exception] = ValueError) -> None:
    """Raise ``error`` unless the value is of one of the types and in the range of a setting.

    Ranges without an end reach to `WHOLE_LIMIT` or `NUMBER_LIMIT`, which are told only to who leaves them.
    """
    for limits in (metadata["limits"], _closed(allowed, **metadata["limits"])):
        if not _fits(value, allowed, **limits):
            raise error(f"{name}={shown(value)} must be {_wanted(allowed, metadata['unit'], **limits)}.")


def plain_numbers(value: Any) -> Any:
    """Arrays and numbers of NumPy and torch as Python's, and sequences that hold them as lists."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain_numbers(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


def is_finite(value: Any) -> bool:
    """Whether it is a number, and a float can hold it."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def shown(value: Any) -> str:
    """A value as messages show it: a whole number that no float holds as a power of ten, not digit by digit."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        inside = ", ".join(map(shown, value))
        return f"({inside})" if isinstance(value, tuple) else f"[{inside}]"
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        return f"{'-' * (value < 0)}1e+{int(math.log10(abs(value)))}"
    return repr(value)


def _closed(allowed, low, high, above, below, infinite) -> dict[str, Any]:
    """The limits with ends where there are none: what overflows in a kernel, or is 0 there, would mean nothing."""
    if float in allowed:
        end = sys.float_info.max if infinite else NUMBER_LIMIT  # what may be infinite is as good as that beyond
        if below is None and high is None:
            high = end
        if low is None and above is None:
            low = -end
        if above == 0 and below is None:
            low, above = 1.0 / NUMBER_LIMIT, None
    elif low is not None and high is None:
        high = WHOLE_LIMIT
    return {"low": low, "high": high, "above": above, "below": below, "infinite": infinite}


def _fits(value, allowed, low, high, above, below, infinite) -> bool:
    words = [word for kind in allowed if get_origin(kind) is Literal for word in get_args(kind)]
    if any(get_origin(kind) is not Literal and kind not in (*PRIMITIVES, NoneType) for kind in allowed):
        return True  # several numbers: left to whoever reads them
    if value is None or isinstance(value, bool):
        return type(value) in allowed
    if isinstance(value, str):
        return str in allowed or value in words
    if not isinstance(value, Real if float in allowed else Integral if int in allowed else ()):
        return False
    if isinstance(value, Integral):
        value = int(value)
    elif not isinstance(value, float):  # a limit of fewer digits, as 0.99, is itself, and overflows nowhere
        value = float(str(value)) if hasattr(value, "dtype") else float(value)
    if infinite and value == math.inf:
        return True
    inside = (low is None or value >= low) and (high is None or value <= high)
    inside = inside and (above is None or value > above) and (below is None or value < below)
    return inside and (isinstance(value, int) or math.isfinite(value))


def _wanted(allowed, unit, low, high, above, below, infinite) -> str:
    """What a value must be: "a whole number from 1 to 64", "one of drawn, together"."""
    words = [word for kind in allowed if get_origin(kind) is Literal for word in get_args(kind)]
    told = ["true or false"] * (bool in allowed)
    told += [", ".join(words)] * bool(words)
    if words and len(allowed) - (NoneType in allowed) == 1:
        return f"one of {told[0]}"
    if int in allowed or float in allowed:
        kind = "number" if float in allowed else "whole number"
        if kind == "number" and not infinite and high is None and below is None:
            kind = "finite number"
        told.append(f"a {kind}{_between(low, high, above, below)}{f' [{unit}]' * bool(unit)}{', or inf' * infinite}")
    return " or ".join(told)


def _between(low, high, above, below) -> str:
    if low is not None and high is not None:
        return f" from {low:g} to {high if isinstance(high, int) else f'{high:g}'}"
    if above is not None and below is not None:
        return f" above {above:g} and below {below:g}"
    if low is not None:
        return f", {low:g} or more"
    if above is not None:
        return f" above {above:g}" + (f" and up to {high:g}" if high is not None else "")
    return ""
