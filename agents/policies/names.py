"""What a word that names a policy can be, told without the libraries that play one."""

import os
import re
from importlib import metadata

from maexp.agents.config.verbs import NAMES
from maexp.agents.deploy.planner.bundle import CONTRACT, advise, shipped_names
from maexp.agents.errors import UserError
from maexp.agents.policies.remote.worker import GROUP


def policy_plugins() -> dict[str, metadata.EntryPoint]:
    """The policies that installed packages offer, by their names."""
    return {entry_point.name: entry_point for entry_point in metadata.entry_points(group=GROUP)}


def check_name(spec: str, setting: str) -> None:
    """Raise UserError for a plain name that is none of a policy; files and module:function are read later."""
    known = spec in NAMES or spec in shipped_names() or spec in policy_plugins()
    if not known and re.fullmatch(r"[\w-]*", spec) and not os.path.exists(spec[:250]):
        raise UserError(describe_unknown_policy(spec, setting))


def describe_unknown_policy(spec: str, setting: str) -> str:
    """What is wrong with a word that names no policy."""
    if os.path.isdir(spec):
        return (
            f"{setting}={spec} is a folder without a policy: it holds neither the {CONTRACT} of maexp export nor the "
            "checkpoints of maexp train."
        )
    if module := _module_of(spec):
        return f"{setting}={spec} is a module: name its class or function, as {setting}={module}:NAME."
    if os.path.exists(spec):
        return f"{setting}={spec} is a file and no checkpoint: give a run's folder, or that of an exported policy."
    advice = advise(spec[:100], [*NAMES, *policy_plugins(), *shipped_names()])
    more = "" if advice.endswith("?") else ", a run, or module:function of your own."
    return f"{setting}={spec[:100]} is unknown: {advice}{more}"


def _module_of(spec: str) -> str:
    """The module in this folder that a word without a class means; "" for none."""
    name = spec.removesuffix(".py")
    return name if name.isidentifier() and os.path.isfile(f"{name}.py") else ""
