"""`make_env`: from Python the env that a command has."""

from typing import Literal

from maexp.agents import build
from maexp.agents.cli.evaluate import find_teams
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import find_override, make_overrides
from maexp.agents.config.runs import Recipe, continue_run
from maexp.agents.errors import UserError, blame_input
from maexp.agents.policies.registry import suit_observation
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.envs import ExplorationEnv

RUNS = {"train": "resume", "evaluate": "checkpoint"}
"""What each verb calls the run whose settings it takes."""


def make_env(
    *words: str,
    verb: Literal["train", "evaluate"] = "train",
    split: Literal["train", "validation", "held_out"] | None = None,
) -> ExplorationEnv:
    """The env as `maexp train` or `maexp evaluate` has it: robots, reward, observation, maps, starts and seeds.

    Args:
        words: settings as on the command line, "scenario=maze_small", "num_envs=64"; with "resume=RUN" (evaluate:
            "checkpoint=RUN") those of a run come first; evaluate: with "policy=NAME" it shows what that looks at.
        verb: whose defaults.
        split: maps that are trained on, that choose between checkpoints and planners, or that are held out; None: those
            that the verb plays first, "train" or "held_out".

    Raises:
        UserError: a word that is no setting, several team sizes or scenarios at once, or a map that cannot be used.
    """
    if verb not in RUNS:
        raise UserError(f"verb={verb} has no env of its own: give {' or '.join(RUNS)}.")
    split = split or ("train" if verb == "train" else "held_out")
    overrides = make_overrides(verb, list(words))
    place = find_override(overrides, RUNS[verb])
    recipe = Recipe(overrides) if place is None else continue_run(*find_checkpoint(place), overrides, verb)
    cfg = compose_settings(verb, recipe)
    sizes = team_sizes(cfg.num_robots)
    if len(sizes) > 1 or cfg.scenario.also:
        several = f"num_robots={cfg.num_robots}" if len(sizes) > 1 else f"scenario.also={list(cfg.scenario.also)}"
        raise UserError(f"{several} makes several envs: make one for each.")
    with blame_input():
        suite = build.load_maps(cfg.scenario, train=split == "train")
        if split not in ("train", "validation", "held_out"):
            raise UserError(f"split={split} is unknown: choose train, validation or held_out.")
        others = {}
        if verb == "evaluate" and (teams := find_teams(cfg)):
            suit_observation(cfg, teams)
        if verb == "train":
            others["device"] = build.choose_device(cfg, "sample_device" if split == "train" else "train_device")
        return build.make_env(cfg, getattr(suite, split), sizes[0], **others)
