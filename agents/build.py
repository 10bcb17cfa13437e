"""From settings to maps, environments and learners."""

import copy
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor

from maexp.agents.algorithms.registry import TRAININGS, find_algorithm
from maexp.agents.algorithms.updaters import Updater
from maexp.agents.config.checks import check_distinct
from maexp.agents.config.env import algorithm_settings, env_settings, map_indices
from maexp.agents.config.groups import SUPPLIED, CommonSettings, LearnerSettings, ScenarioSettings
from maexp.agents.config.overrides import split_paths
from maexp.agents.config.schema import make_value
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import UserError
from maexp.agents.models.actor import make_policy
from maexp.conf import groups_of_choice
from maexp.envs import ExplorationEnv, PointCloudMap, VoxelMap, make_map
from maexp.envs.config import GROUPS, STARTS
from maexp.envs.config_fields import kinds
from maexp.envs.scenarios import GENERATED, SCENARIOS, VOLUMES, find_scenario
from maexp.envs.spawn import read_starts

if TYPE_CHECKING:
    from maexp.envs.io import ImportOptions


@dataclass
class MapSuite:
    """The maps trained on, those that choose (checkpoints, the best planner) and those of the evaluation.

    Attributes:
        is_held_out: those of the evaluation are used for nothing else; a user's own maps are used for all
        build_validation: builds `validation` when that is first asked for
    """

    train: list[PointCloudMap]
    held_out: list[PointCloudMap]
    is_held_out: bool
    build_validation: Callable[[], list[PointCloudMap]]

    @cached_property
    def validation(self) -> list[PointCloudMap]:
        """The maps that choose; never trained on, but where a user's own maps or no others are there."""
        return self.build_validation()


def pick_device(name: str, setting: str = "device") -> torch.device:
    """The torch device of the setting `device`, or of another setting of that kind.

    Raises:
        UserError: not a device, or not one of this machine.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(1, dtype=torch.float32, device=device)
    except (RuntimeError, AssertionError) as error:
        why = str(error).splitlines()[0]
        raise UserError(f"{setting}={name} cannot be used here ({why}): try {setting}=cpu.") from error
    return device


def choose_device(cfg: TrainSettings, name: str) -> torch.device:
    """The device of `collector.sample_device` or `collector.train_device`: what is set there, else `device`."""
    own = getattr(cfg.collector, name)
    return pick_device(cfg.device) if own is None else pick_device(own, f"collector.{name}")


def load_maps(scenario: ScenarioSettings, train: bool = True) -> MapSuite:
    """The maps of a scenario's settings; those trained on are left out unless `train`.

    Raises:
        ValueError: an index that is none; MapError: a file that is no usable map.
    """
    row = find_scenario(scenario.name)
    if row.build is None:
        maps = import_files(scenario)
        return MapSuite(maps, maps, False, lambda: maps)
    if scenario.path is not None:
        raise UserError(
            f"scenario.path={scenario.path} needs scenario=pointcloud or scenario=ir2; scenario={scenario.name} builds "
            "its own maps."
        )
    indices, validation, held_out = map_indices(scenario)

    def build(chosen: list[int]) -> list[PointCloudMap]:
        return [make_map(scenario.name, index) for index in chosen]

    unseen = set(held_out).isdisjoint([*indices, *validation])
    return MapSuite(build(indices) if train else [], build(held_out), unseen, lambda: build(validation or indices))


TOLD: set[str] = set()
"""Warnings of imports in this process: a file that is read again is told of once."""


def import_file(path: str | Path, options: "ImportOptions", volume: bool = False) -> PointCloudMap | VoxelMap:
    """The map of a file; what its import left out is told."""
    from maexp.envs.io import import_map_with_report

    world, report = import_map_with_report(path, options, volume=volume)
    for text in (f"map {world.name}: {text}" for text in report.warnings):
        if text not in TOLD:
            TOLD.add(text)
            warnings.warn(text, stacklevel=2)
    return world


def import_files(scenario: ScenarioSettings) -> list[PointCloudMap] | list[VoxelMap]:
    """The maps of a scenario that builds none: `scenario.path` names a file, or several with commas between them."""
    if not scenario.path:
        raise UserError(f"scenario={scenario.name} needs a map: add scenario.path=FILE.")
    volume = find_scenario(scenario.name).kind == "volume"
    maps = [import_file(path, scenario.importing, volume) for path in split_paths(scenario.path)]
    names = [world.name for world in maps]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UserError(f"scenario.path={scenario.path} names two maps called {twice}: rename one of the files.")
    kinds = sorted({world.scenario for world in maps})
    protocol = bool(groups_of_choice("scenario", scenario.name))  # of pictures
    if protocol and (other := next((world for world in maps if world.scenario != scenario.name), None)):
        raise UserError(
            f"scenario={scenario.name} counts in the pixels of a picture, and {other.name} is a saved map of "
            f"scenario={other.scenario}: give its picture, or use scenario=pointcloud."
        )
    if len(kinds) > 1:
        raise UserError(
            f"scenario.path={scenario.path} names maps of the scenarios {' and '.join(kinds)}, which have robots of "
            "their own: give the maps of each scenario a run of their own."
        )
    return maps


def make_env(
    cfg: CommonSettings, maps: list[PointCloudMap], num_robots: int, num_envs: int | None = None, **others: Any
) -> ExplorationEnv:
    """The environment that the settings describe, on `maps`; `others` are arguments of `ExplorationEnv`.

    Raises:
        ValueError: a setting out of range; MapError: no room for the team.
    """
    settings = env_settings(cfg, find_scenario(maps[0].scenario), num_robots)
    here = {"num_envs": num_envs or cfg.num_envs, "device": pick_device(cfg.device)}
    others = {"starts": choose_starts(cfg, num_robots)} | others
    return ExplorationEnv(maps, **(vars(settings) | here | others))


def choose_starts(cfg: CommonSettings, num_robots: int) -> str | np.ndarray:
    """`scenario.starts` for an env: drawn, together, fixed, or the poses that its file holds.

    Raises:
        ValueError: the file holds no such poses.
    """
    starts = cfg.scenario.starts
    return starts if starts in STARTS else read_starts(starts, num_robots)


def other_scenarios(cfg: CommonSettings) -> list[CommonSettings]:
    """The settings once more for each entry of `scenario.also`, with what a scenario supplies left to it.

    An entry is a scenario's name, or settings of `scenario` with the name among them.

    Raises:
        UserError: an entry that is unknown or given twice, or a scenario without maps of its own and without a path.
    """
    entries = [{"name": entry} if isinstance(entry, str) else entry for entry in cfg.scenario.also or []]
    for entry in entries:
        _check_entry(entry)
    names = [entry["name"] if len(entry) == 1 else str(entry) for entry in entries]
    check_distinct("scenario.also", [cfg.scenario.name, *names])
    return [_with_scenario(cfg, entry) for entry in entries]


def title_scenario(entry: str | Mapping[str, Any]) -> str:
    """An entry of `scenario.also` in words: `maze`, or `maze local_steps=5`; of files their number."""
    if isinstance(entry, str):
        return entry
    others = {name: value for name, value in entry.items() if name != "name"}
    if "path" in others:
        count = len(split_paths(others["path"]))
        others["path"] = f"{count} file{'s' * (count > 1)}"
    return " ".join([entry["name"], *(f"{name}={value}" for name, value in others.items())])


def _check_entry(entry: Any) -> None:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise UserError(
            f"scenario.also: {entry} is neither a scenario's name nor settings of one, as "
            "{name: maze, local_steps: 5}."
        )
    name, path = entry["name"], entry.get("path")
    rows = SCENARIOS | VOLUMES
    if name not in rows or (rows[name].build is None and path is None):
        known = ", ".join(GENERATED)
        raise UserError(
            f"scenario.also={name} is no scenario with maps of its own: choose among {known}, or give "
            "{name: pointcloud, path: FILES}."
        )
    settings = [field.name for field in fields(ScenarioSettings) if field.name not in ("also", "importing")]
    if unknown := [key for key in entry if key not in settings]:
        raise UserError(f"scenario.also has no setting {unknown[0]}: choose among {', '.join(settings)}.")


def _with_scenario(cfg: CommonSettings, entry: dict[str, Any]) -> CommonSettings:
    other = copy.deepcopy(cfg)
    supplied = [name for name in SUPPLIED if name != "decision_seconds"]  # one pace for all, where it is set
    left = ("also", "path", "maps", "validation", "held_out", "held_out_count", *supplied)
    metadata = {field.name: field.metadata for field in fields(ScenarioSettings)}
    try:
        given = {
            name: make_value(name, value, kinds(ScenarioSettings)[name], metadata[name])
            for name, value in entry.items()
        }
    except UserError as error:
        raise UserError(f"scenario.also: of {entry['name']}, {error}") from error
    other.scenario = replace(cfg.scenario, **(dict.fromkeys(left) | given))
    for group in GROUPS:
        followers = [name.partition(".")[2] for name in cfg.followers if name.startswith(f"{group}.")]
        changed = dict.fromkeys(name for name in followers if name != "team")
        setattr(other, group, replace(getattr(cfg, group), **changed))
    return other


def set_steps(cfg: TrainSettings, env: ExplorationEnv) -> int:
    """Write down the macro steps of every team in a batch; unless set, those of an episode.

    Batches in step with the episodes hold all parts of an episode alike; others would alternate between them.
    """
    cfg.collector.steps = cfg.collector.steps or env.macro_steps
    return cfg.collector.steps


@dataclass
class Learner:
    """The networks of a run and what trains them."""

    policy: ProbabilisticActor
    critic: TensorDictModule
    updater: Updater


def make_learner(cfg: LearnerSettings, env: ExplorationEnv) -> Learner:
    """Policy, critic and updater of the settings, for the specs of `env`."""
    row = find_algorithm(cfg.algorithm.name, TRAININGS)
    settings, model = algorithm_settings(cfg), cfg.model
    policy, critic = make_policy(env, model), row.make_critic(env, model, settings)
    loss = row.make_loss(policy, critic, settings)
    if env.settings.decide == "arrival":
        loss.decision_steps = env.local_steps
    return Learner(policy, critic, row.make_updater(loss, settings))
