"""Settings of a verb's dataclass: their names and defaults, as Hydra composes over them, and back to an object.

A setting is declared once, as a field of a dataclass (`maexp.envs.config_fields`): its type, range and help are read
there.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from types import NoneType
from typing import Any, Literal, get_origin

from maexp.agents.config.algorithms import TUNINGS, AlgorithmSettings, find_tunings
from maexp.agents.config.groups import UNSET
from maexp.agents.config.verbs import SCHEMAS
from maexp.agents.errors import UserError
from maexp.envs.config_fields import check_value, explain, kinds

NO_LIMITS = dict.fromkeys(("low", "high", "above", "below"), None) | {"infinite": False}
TRUE, FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


def settings_of(cls: type) -> list[Field]:
    """The fields of a dataclass that are settings."""
    return [setting for setting in fields(cls) if setting.init and not setting.metadata.get("internal")]


def group_of(cls: type, name: str) -> type | None:
    """The dataclass of a group of settings; None where the setting is a single one."""
    kind: type = kinds(cls)[name][0]
    return kind if is_dataclass(kind) else None


@cache
def algorithm_names() -> dict[str, type[AlgorithmSettings]]:
    """Every setting of any algorithm, with the first class that has it."""
    classes = dict.fromkeys(type(row.default) for row in TUNINGS.values())
    return {setting.name: cls for cls in reversed(classes) for setting in fields(cls) if setting.name != "name"}


def default_values(cls: type) -> dict[str, Any]:
    """The settings of a dataclass with their defaults, plain; of an algorithm, null: each has its own."""
    if cls is AlgorithmSettings:
        return {"name": UNSET} | dict.fromkeys(algorithm_names())
    values: dict[str, Any] = {}
    for setting in settings_of(cls):
        if (kind := group_of(cls, setting.name)) is not None:
            values[setting.name] = default_values(kind) | dict(setting.metadata.get("references", {}))
        elif setting.name == "algorithm":
            values[setting.name] = dict.fromkeys(algorithm_names())
        elif setting.default_factory is not MISSING:
            values[setting.name] = setting.default_factory()
        else:
            values[setting.name] = UNSET if setting.default is MISSING else setting.default
    return values


# From values to an object


def make_settings(cls: type, values: Mapping[str, Any], prefix: str = "") -> Any:
    """The object of a dataclass from plain values, its groups included.

    Raises:
        UserError: a setting that is none, is not set, or has a value of another type or out of its range.
    """
    names = {setting.name for setting in settings_of(cls)}
    if unknown := next((name for name in values if name not in names), None):
        raise UserError(f"{prefix}{unknown} is not a setting: choose one of {', '.join(sorted(names))}.")
    given: dict[str, Any] = {}
    for setting in settings_of(cls):
        name, value = prefix + setting.name, values.get(setting.name, UNSET)
        kind = group_of(cls, setting.name)
        if kind is AlgorithmSettings:
            given[setting.name] = make_algorithm(value)
        elif kind is not None:
            given[setting.name] = make_settings(kind, value, f"{name}.")
        elif setting.name == "algorithm":
            given[setting.name] = {key: _shared_value(key, value[key]) for key in algorithm_names()}
        else:
            given[setting.name] = make_value(name, value, kinds(cls)[setting.name], setting.metadata)
    return cls(**given)


def make_algorithm(values: Mapping[str, Any]) -> AlgorithmSettings:
    """The settings of an algorithm: what is null has the algorithm's own default.

    Raises:
        UserError: it is unknown, has no such setting, or the value is out of range.
    """
    try:
        tunings = find_tunings(values["name"])
        cls: type = type(tunings.default)
        metadata = {setting.name: setting.metadata for setting in fields(cls)}
        given = {name: value for name, value in values.items() if name != "name" and value is not None}
        for name in metadata.keys() & given.keys():
            given[name] = make_value(f"algorithm.{name}", given[name], kinds(cls)[name], metadata[name])
        return tunings.configure(**given)
    except ValueError as error:
        raise UserError(str(error)) from error


def _shared_value(name: str, value: Any) -> Any:
    cls: type = algorithm_names()[name]
    found = next(setting for setting in fields(cls) if setting.name == name)
    return None if value is None else make_value(f"algorithm.{name}", value, kinds(cls)[name], found.metadata)


def make_value(name: str, value: Any, allowed: tuple, metadata: Mapping) -> Any:
    """A value in the type of its setting; whole numbers stand for numbers, and text for what it spells.

    Raises:
        UserError: it is not set, or none of the setting's type and range.
    """
    if isinstance(value, str) and value == UNSET:
        raise UserError(f"{name} is not set: add {name}=VALUE.")
    plain = {str if get_origin(kind) is Literal else kind for kind in allowed if kind is not NoneType}
    if not plain <= {bool, int, float, str}:
        return value
    if value is None and NoneType not in allowed:
        raise UserError(f"{name}=null has no meaning: give it a value.")
    value = _converted(value, plain)
    limits = metadata.get("limits", NO_LIMITS)
    check_value(name, value, allowed, {"limits": limits, "unit": metadata.get("unit", "")}, UserError)
    return value


def _converted(value: Any, plain: set[type]) -> Any:
    if plain == {str} and isinstance(value, bool | int | float):
        return str(value)
    if plain == {bool} and str(value).lower() in (*TRUE, *FALSE) and value is not None:
        return str(value).lower() in TRUE
    try:
        if plain == {float} and type(value) in (int, str):
            return float(value)
        return int(value) if plain == {int} and isinstance(value, str) else value
    except (ValueError, OverflowError):  # the check says what it must be
        return value


# Names


def check_name(name: str, verb: str) -> None:
    """Raise UserError unless a verb has a setting or a group of that full name."""
    values, path = default_values(SCHEMAS[verb]), ""
    for part in name.split("."):
        path = f"{path}.{part}".lstrip(".")
        if not isinstance(values, dict) and _is_open(name, verb):
            return
        if not isinstance(values, dict) or part not in values:
            raise UserError(f"{path} is not a setting of maexp {verb}{_suggest(path, verb)}.")
        values = values[part]


def _is_open(name: str, verb: str) -> bool:
    """Whether a setting holds values under names of its own, as policy_per_map.maze=4."""
    cls: type | None = SCHEMAS[verb]
    for part in name.split("."):
        if cls is None or part not in kinds(cls):
            return False
        if Any in kinds(cls)[part]:
            return True
        cls = group_of(cls, part)
    return False


def _suggest(name: str, verb: str) -> str:
    """The settings that hold the name as a word, or a close one among the verb's, or the settings beside it."""
    names = list(flat_names(default_values(SCHEMAS[verb])))
    holding = [candidate for candidate in names if name in re.split(r"[._]", candidate)]
    nearest = [candidate for candidate in holding if candidate.count(".") == min(other.count(".") for other in holding)]
    if meant := nearest or difflib.get_close_matches(name, names, 1, 0.7):
        return f": did you mean {' or '.join(meant[:3])}"
    parent = name.rpartition(".")[0]
    beside = [candidate for candidate in names if candidate.rpartition(".")[0] == parent]
    return f": choose one of {', '.join(beside)}" if beside else f" (see maexp {verb} --help)"


def flat_names(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Full names of settings and groups: robot, robot.kind, ..."""
    for name, value in values.items():
        yield prefix + name
        if isinstance(value, dict):
            yield from flat_names(value, f"{prefix}{name}.")


# Help


def describe(cls: type) -> list[tuple[str, str]]:
    """(name, line of help) of the top-level settings of a verb, its own before those it shares."""
    documented = [setting for setting in fields(cls) if setting.metadata.get("help")]
    own = vars(cls)["__annotations__"]
    documented.sort(key=lambda setting: setting.name not in own)
    return [(row.name, _help(cls, row)) for row in documented]


def _help(cls: type, row: Field) -> str:
    shared = cls is SCHEMAS["ros2"] and row.name not in vars(cls)["__annotations__"]  # with the robots' driver
    return "team: " * shared + explain(row.metadata)


def helps(cls: type, values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """{"radar.range": "how far it sees [m]"} of all settings of a verb's dataclass, those of groups included."""
    found = {prefix + row.name: _help(cls, row) for row in fields(cls) if row.metadata.get("help")}
    for setting in settings_of(cls):
        kind, held = group_of(cls, setting.name), values.get(setting.name)
        if kind is None and setting.name == "algorithm":  # of a benchmark
            for name, first in algorithm_names().items():
                found[f"algorithm.{name}"] = explain(first.__dataclass_fields__[name].metadata)
        if kind is not None and isinstance(held, Mapping):
            if kind is AlgorithmSettings and "name" in held:
                kind = type(find_tunings(held["name"]).default)
            found |= helps(kind, held, f"{prefix}{setting.name}.")
            found |= {f"{prefix}{setting.name}.{name}": "does nothing here" for name in getattr(kind, "unused", ())}
    return found
