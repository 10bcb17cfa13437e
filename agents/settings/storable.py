"""Dataclasses of settings as Hydra checks them: a misspelt name or a word in a number's place is refused.

A setting is declared once, as a field of a dataclass (`maexp.envs.config_fields`). Where settings belong to a class of
the layers below (`RobotConfig`, `ModelConfig`, ...), their names, types and help are read from that class.
"""

from dataclasses import MISSING as NO_DEFAULT
from dataclasses import Field, field, fields, is_dataclass, make_dataclass
from types import NoneType
from typing import Any, Literal, get_origin

from omegaconf import MISSING, DictConfig

from maexp.agents.settings.algorithms import find_tunings
from maexp.envs.config_fields import explain, kinds

PRIMITIVES = (int, float, bool, str)  # in the order of the unions below


def storable(cls: type, **extra: Any) -> type:
    """Dataclass with the settings of `cls`, their defaults and types that OmegaConf can check.

    What a scenario supplies refers to it: `radar.range` is `${scenario.radar_range}`.

    Args:
        extra: further fields, name=type, null by default.
    """
    entries = [
        (setting.name, _storable(kinds(cls)[setting.name]), _supplied(setting))
        for setting in fields(cls)
        if setting.init
    ]
    return make_dataclass(cls.__name__, entries + [(name, kind, field(default=None)) for name, kind in extra.items()])


def _supplied(setting: Field) -> Any:
    """A copy of the field; its default refers to the scenario where that says it."""
    source, default = setting.metadata.get("scenario"), setting.default
    if default is NO_DEFAULT and setting.default_factory is not NO_DEFAULT:
        return field(default_factory=setting.default_factory, metadata=setting.metadata)
    return field(default=f"${{scenario.{source}}}" if source else default, metadata=setting.metadata)


def _storable(members: tuple, optional: bool = False) -> Any:
    """The nearest type that OmegaConf can check: Literal becomes str, a mixture with tuples, or of numbers and words,
    Any."""
    if get_origin(members[0]) is list:
        return members[0]
    plain = {str if get_origin(member) is Literal else member for member in members if member is not NoneType}
    if not plain.issubset(PRIMITIVES) or (str in plain and len(plain) > 1):  # it would take no 1 for a float
        return Any
    union = None
    for primitive in sorted(plain, key=PRIMITIVES.index):
        union = primitive if union is None else union | primitive
    return union | None if optional or NoneType in members else union


def optional_settings(*classes: type) -> type:
    """Dataclass with a name and the settings of all of `classes`, each optional and null by default."""
    entries = {
        setting.name: (
            setting.name,
            _storable(kinds(cls)[setting.name], True),
            field(default=None, metadata=setting.metadata),
        )
        for cls in classes
        for setting in fields(cls)
        if setting.metadata.get("help")
    }
    return make_dataclass(f"{classes[0].__name__}Settings", [("name", str, MISSING), *entries.values()])


def read(kind: type, node: DictConfig, /, **others: Any) -> Any:
    """The settings of a group as the object that declares them; `others` stand for values of the group."""
    return kind(**{setting.name: node[setting.name] for setting in fields(kind) if setting.name not in others} | others)


def describe(cls: type) -> list[tuple[str, Any, str]]:
    """(name, default, line of help) of the top-level settings of a verb, its own before those it shares."""
    documented = [setting for setting in fields(cls) if setting.metadata.get("help")]
    documented.sort(key=lambda setting: setting.name not in vars(cls)["__annotations__"])
    return [
        (setting.name, None if setting.default is NO_DEFAULT else setting.default, explain(setting.metadata))
        for setting in documented
    ]


def helps(cls: type, settings: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """{"radar.range": "how far it sees [m]"} of all settings of a verb's dataclass, those of groups included."""
    found = {
        prefix + setting.name: explain(setting.metadata) for setting in fields(cls) if setting.metadata.get("help")
    }
    for setting in fields(cls):
        kind, values = kinds(cls)[setting.name][0], settings.get(setting.name)
        if is_dataclass(kind) and isinstance(values, dict):
            kind = (
                type(find_tunings(values["name"]).default) if setting.name == "algorithm" and "name" in values else kind
            )
            found |= helps(kind, values, f"{prefix}{setting.name}.")
            found |= {f"{prefix}{setting.name}.{name}": "does nothing here" for name in getattr(kind, "unused", ())}
    return found
