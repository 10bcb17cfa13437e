"""What is wrong with the words of a command line, told before the libraries are loaded that take seconds."""

from typing import Any

from omegaconf import DictConfig, OmegaConf

from maexp.agents.errors import UserError, blame_input
from maexp.agents.policies.names import check_name
from maexp.agents.settings.algorithms import TUNINGS
from maexp.agents.settings.checks import team_sizes, words_of
from maexp.agents.settings.compose import compose_config
from maexp.agents.settings.overrides import POLICIES, find_override, find_sweeps
from maexp.agents.settings.resolved import resolve, without_hydra
from maexp.agents.settings.verbs.evaluate import NAMES
from maexp.envs.scenarios import SCENARIOS, VOLUMES

RUNS = ("resume", "checkpoint", "place")
"""Settings that may name a run, whose settings come before the words."""


def check_words(verb: str, overrides: list[str]) -> None:
    """Raise UserError for a name that is no setting, or a value that is none of it; `bench` moves its words first."""
    if verb == "bench":
        return
    alone = all(find_override(overrides, name) is None for name in RUNS)
    cfg = without_hydra(compose_config(verb, overrides, whole=alone))
    for setting in POLICIES.get(verb, ()):
        for word in words_of(cfg[setting]):
            check_name(word, setting)
    if verb == "benchmark":
        check_names(cfg)
    if cfg.get("num_robots") is not None:
        team_sizes(cfg.num_robots)
    if alone:
        with blame_input():
            resolve(cfg)


def check_sweep(verb: str, overrides: list[str]) -> None:
    """The same for every value of a sweep, before its first run."""
    swept = find_sweeps(overrides)
    names = [word.partition("=")[0] for word in overrides]
    firsts = [swept[name][0] if name in swept else word for name, word in zip(names, overrides, strict=True)]
    for k, name in enumerate(names):
        for value in swept.get(name, []):
            check_words(verb, [*firsts[:k], value, *firsts[k + 1 :]])
    if not swept:
        check_words(verb, firsts)


def check_names(cfg: DictConfig) -> None:
    """Raise UserError unless the scenarios and algorithms of a benchmark are those there are."""
    known = {"scenarios": [*SCENARIOS, *VOLUMES], "algorithms": [*TUNINGS]}
    for name, choices in known.items():
        allowed = [*choices, *NAMES] if name == "algorithms" else choices
        for value in as_list(cfg[name]):
            if value not in allowed:
                raise UserError(f"{name}={value} is unknown: choose of {', '.join(choices)}.")


def as_list(value: Any) -> list:
    """A setting of one value or several as a list."""
    if value is None:
        return []
    return list(value) if OmegaConf.is_list(value) or isinstance(value, list | tuple) else [value]
