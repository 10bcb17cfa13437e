"""`maexp VERB --help`: examples, settings and the choices of each group."""

from typing import Any

from omegaconf import OmegaConf

from maexp.agents.config.compose import compose_values
from maexp.agents.config.schema import describe
from maexp.agents.config.verbs import SCHEMAS
from maexp.conf import groups, list_choices


def verb_help(name: str, summary: str, examples: tuple[str, ...]) -> str:
    """The help of a verb: its settings and choices with what is taken without a word; the choices are the files of
    `conf/` with the comment on their first line."""
    kind, defaults = SCHEMAS[name], compose_values(name, [])
    lines = [f"maexp {name}: {summary}", ""]
    lines += [f"  {example}" for example in examples]
    lines += ["", "Settings (name=value)"]
    for setting, text in describe(kind):
        lines += _row(_assign(setting, OmegaConf.select(defaults, setting)), text)
    for group in groups():
        if group in defaults:
            one_value = f", and {group}.NAME=VALUE for one value of it" * OmegaConf.is_dict(defaults[group])
            lines += ["", f"{group}=CHOICE{one_value}"]
            chosen = defaults.hydra.runtime.choices.get(group)
            for choice, text in list_choices(group).items():
                lines += _row(choice + " (default)" * (choice == chosen), text)
    lines += ["", f"maexp {name} --cfg job ... prints all settings; hydra.run.dir=FOLDER moves the output."]
    if name == "train":
        lines += ["maexp train -m name=a,b runs a sweep: every combination, one after another."]
    return "\n".join(lines)


def _row(name: str, text: str) -> list[str]:
    """Two columns; below each other where the first is too wide."""
    return [f"  {name:<25} {text}"] if len(name) <= 25 else [f"  {name}", f"{'':<28}{text}"]


def _assign(name: str, default: Any) -> str:
    if isinstance(default, bool):
        default = str(default).lower()
    if OmegaConf.is_list(default):
        default = ",".join(map(str, default))
    return f"{name}={'' if default is None else default}"
