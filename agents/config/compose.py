"""Hydra's composition, once for each command, to the object of a verb's settings; with errors that people can read."""

from dataclasses import dataclass, replace
from typing import Any

from hydra import compose as compose_hydra
from hydra import initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from maexp.agents.config.env import follower_names
from maexp.agents.config.overrides import parse, set_names
from maexp.agents.config.runs import Recipe
from maexp.agents.config.schema import check_name, default_values, make_settings
from maexp.agents.config.verbs import SCHEMAS
from maexp.agents.errors import UserError
from maexp.conf import groups, list_choices

SWEEPING = ("train",)
"""Verbs that run values of a setting one after another, with -m."""


@dataclass(frozen=True)
class Composition:
    """What the words of a command come to.

    Attributes:
        settings: the verb's settings, an object of its dataclass
        run_dir, sweep_dir: where the run, or the sweep, is to write
    """

    settings: Any
    run_dir: str
    sweep_dir: str


def compose(verb: str, recipe: Recipe | list[str]) -> Composition:
    """The settings of a verb, with the values of a run in their places.

    Raises:
        UserError: an override that does not fit, a setting that is left open or out of its range, a value of the run
            that this version does not know.
    """
    recipe = recipe if isinstance(recipe, Recipe) else Recipe(recipe)
    cfg = compose_values(verb, [*recipe.defaults, *recipe.words])
    try:
        folders = cfg.hydra.run.dir, cfg.hydra.sweep.dir
    except OmegaConfBaseException as error:
        raise UserError(explain(error, verb)) from error
    return Composition(make_object(verb, cfg, recipe), *folders)


def compose_settings(verb: str, recipe: Recipe | list[str]) -> Any:
    """The settings alone: an object of the verb's dataclass."""
    return compose(verb, recipe).settings


def compose_values(verb: str, words: list[str]) -> DictConfig:
    """What Hydra composes: the settings as plain values, and Hydra's own under `hydra`."""
    check_overrides(verb, words)
    register_schema(verb)
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module("maexp.conf", version_base="1.3"):
            cfg = compose_hydra(verb, words, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise UserError(explain(error, verb)) from error
    return cfg


def register_schema(verb: str) -> None:
    """Make the settings and their defaults known to Hydra as `<verb>_schema`, the first entry of the verb's primary
    config; and `algorithm: each`, which sets nothing, for a benchmark."""
    store = ConfigStore.instance().store
    store(name=f"{verb}_schema", node=default_values(SCHEMAS[verb]))
    store(group="algorithm", name="each", node={})


def make_object(verb: str, cfg: DictConfig, recipe: Recipe) -> Any:
    """The object of composed settings, with the values of a run in place of those that the words come to."""
    cfg = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    OmegaConf.set_struct(cfg, False)
    followers: list[str] = []
    if "scenario" in cfg:
        cfg.scenario.pop("row", None)  # what the table of scenarios holds
        followers = [name for name in follower_names() if name.partition(".")[0] in cfg and _follows(cfg, name)]
    _put_values(cfg, recipe)
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise UserError(explain(error, verb)) from error
    settings = make_settings(SCHEMAS[verb], values)  # type: ignore[arg-type]
    return replace(settings, followers=tuple(followers)) if followers else settings


def _follows(cfg: DictConfig, name: str) -> bool:
    """Whether a setting follows the scenario: null, or a reference to what that says."""
    group, _, setting = name.partition(".")
    if name == "robot.team":
        return bool(cfg.robot.team)
    return OmegaConf.is_interpolation(cfg[group], setting) or cfg[group][setting] is None


def _put_values(cfg: DictConfig, recipe: Recipe) -> None:
    names, chosen = set_names(recipe.words), recipe.values.get("algorithm.name")
    if chosen is not None and chosen != cfg.algorithm.name:  # nothing stays of the algorithm that is the default here
        cfg.algorithm.update({name: None for name in cfg.algorithm if f"algorithm.{name}" not in names})
    OmegaConf.set_struct(cfg, True)
    for name, value in recipe.values.items():
        try:
            OmegaConf.update(cfg, name, value)
        except OmegaConfBaseException as error:
            raise UserError(
                f"{recipe.source} holds {name}={value}, which this version of MAexp does not know: "
                "use the version that wrote it, as its config.yaml names it."
            ) from error


# Errors


def check_overrides(verb: str, words: list[str]) -> None:
    """Raise UserError for a word that names no setting and no choice, or gives a single value several."""
    choices, settings = groups(), default_values(SCHEMAS[verb])
    own_folders = "hydra.searchpath" in set_names(words)  # of choices: Hydra says what is not there
    for word in words:
        override = parse(word)
        name, value = override.key_or_group, override.value()
        if name.split(".")[0].split("/")[0] == "hydra":
            continue
        if override.is_sweep_override():
            raise UserError(_describe_several(word, verb))
        if name in choices and name in settings and isinstance(value, str):
            if value not in list_choices(name) and not own_folders:
                raise UserError(f"{name}={value} is unknown: choose one of {', '.join(list_choices(name))}.")
        else:
            check_name(name, verb)


def _describe_several(word: str, verb: str) -> str:
    name, _, values = word.partition("=")
    sweep = "add -m to run one after another, " * (verb in SWEEPING)
    brackets = f"or, if it takes several, {name}=[{values}]"
    return f"{word} gives several values: {sweep}write one value, {brackets}."


def explain(error: Exception, verb: str) -> str:
    """One sentence for an error of Hydra or OmegaConf."""
    lines = [line.strip() for line in f"{error}\n{error.__cause__ or ''}".splitlines()]
    lines = [line for line in lines if line and "hydra.cc/docs" not in line]
    return " ".join(dict.fromkeys(lines[:3])) + f" (see maexp {verb} --help)."
