"""`maexp VERB --help`: examples, settings and the choices of each group."""

from typing import TYPE_CHECKING, Any

from maexp.agents.settings.compose import group_choices, groups

if TYPE_CHECKING:
    from maexp.agents.cli import Verb


def verb_help(name: str, verb: "Verb") -> str:
    """The help of a verb; the choices are the files of `conf/` with the comment on their first line."""
    from maexp.agents.settings.schema import describe, schema

    kind = schema(name)
    lines = [f"maexp {name}: {verb.summary}", ""]
    lines += [f"  {example}" for example in verb.examples]
    lines += ["", "Settings (name=value)"]
    lines += [f"  {_assign(setting, default):<26}{text}" for setting, default, text in describe(kind)]
    for group in groups():
        if group in kind.__dataclass_fields__:
            one_value = "" if group == "preset" else f", and {group}.NAME=VALUE for one value of it"
            lines += ["", f"{group}=CHOICE{one_value}"]
            lines += [f"  {choice:<26}{text}" for choice, text in group_choices(group).items()]
    lines += ["", f"maexp {name} --cfg job ... prints all settings; hydra.run.dir=FOLDER moves the output."]
    if name == "train":
        lines += ["maexp train -m name=a,b runs a sweep: every combination, one after another."]
    return "\n".join(lines)


def _assign(name: str, default: Any) -> str:
    if isinstance(default, bool):
        default = str(default).lower()
    return f"{name}={'' if default is None else default}"
