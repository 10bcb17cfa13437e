"""What is wrong with the words of a command line, told before the libraries are loaded that take seconds."""

from maexp.agents.config.checks import check_names, choices_of, team_sizes
from maexp.agents.config.compose import Composition, check_overrides, compose
from maexp.agents.config.overrides import POLICIES, find_override, find_sweeps, parse
from maexp.agents.config.resolved import resolve
from maexp.agents.errors import blame_input
from maexp.agents.policies.names import check_name

RUNS = ("resume", "checkpoint", "place")
"""Settings that may name a run, whose settings come before the words."""


def check_words(verb: str, overrides: list[str]) -> Composition | None:
    """What the words come to; None where they belong to a run or, of `bench`, hold several values: then only the names
    are checked.

    Raises:
        UserError: a name that is no setting, or a value that is none of it.
    """
    if verb == "bench":
        return None
    if any(find_override(overrides, name) is not None for name in RUNS):
        check_overrides(verb, overrides)
        return None
    composed = compose(verb, overrides)
    cfg = composed.settings
    for setting in POLICIES.get(verb, ()):
        for word in choices_of(getattr(cfg, setting)):
            check_name(word, setting)
    if verb == "benchmark":
        check_names(cfg)
    if getattr(cfg, "num_robots", None) is not None:
        team_sizes(cfg.num_robots)
    with blame_input():
        resolve(cfg)
    return composed


def check_sweep(verb: str, overrides: list[str]) -> None:
    """The same for every value of a sweep, before its first run."""
    swept = find_sweeps(overrides)
    names = [parse(word).key_or_group for word in overrides]
    firsts = [swept[name][0] if name in swept else word for name, word in zip(names, overrides, strict=True)]
    for k, name in enumerate(names):
        for value in swept.get(name, []):
            check_words(verb, [*firsts[:k], value, *firsts[k + 1 :]])
    if not swept:
        check_words(verb, firsts)
