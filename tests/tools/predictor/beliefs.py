"""What teams know in the middle of episodes, beside what is there: labelled beliefs for the map predictor.

`python -m tests.tools.predictor.beliefs out=FOLDER split=train` plays `cost_utility`, which takes some targets at
random, on the maps
of every scenario and writes a file for each batch of episodes. A file that is there already is kept, so a run that was
stopped goes on.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torchrl.envs.utils import step_mdp

from maexp.agents.errors import UserError
from maexp.agents.files import write_file
from maexp.agents.policies.classical import FrontierPlanner, as_module, rank_by_utility
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, PointCloudMap, make_map
from maexp.envs.config_fields import check_settings, setting
from maexp.envs.io.occupancy import read_occupancy
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.postprocess import crop_grid, finish_map
from maexp.envs.io.report import ImportReport
from maexp.envs.io.sources import GridSource
from maexp.envs.maps.nav_grid import build_nav_grid, open_cells
from maexp.envs.scenarios import GENERATED, cut_last_fifth, default_macro_steps, find_scenario, split
from maexp.envs.targets.tracker import TensorScene, keyed_uniform
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN

from .command import run

NEVER = 255  # a cell that does not get known
LONGER = 2.0  # episodes go on for so many times the scenario's decisions: late beliefs count too
TEAMS = (3, 1, 4, 2)  # robots, round by round
PLANS = "plans"
COVERED = 0.99  # share of the free ground that ends an episode
EXTRA_MAPS = 1_000_000  # further maps to train on are numbered from here: in no table, no validation, no held-out set


@dataclass(frozen=True)
class BeliefConfig:
    """Which beliefs are written."""

    out: str = setting("beliefs", "folder for the files")
    split: Literal["train", "validation"] = setting(
        "train", "maps that are played, `train` or `validation`; held-out ones never are"
    )
    scenarios: list[str] = setting(list(GENERATED), "those played; `plans` is the folder `plans`")
    plans: str = setting(
        "",
        "folder of map_server files, imported as users' maps are; empty: none. The last fifth in sorted order is held "
        "out, the last fifth of the others is for validation",
    )
    limit: int = setting(0, "maps of each scenario at most, spread evenly; 0: all", low=0)
    extra: int = setting(0, "maps of each scenario beyond those of its table, for `train` alone", low=0)
    batch: int = setting(8, "maps played at once", low=1, high=1024)
    rounds: int = setting(2, "episodes on each map", low=1)
    departures: float = setting(0.3, "share of decisions in which a robot takes any target", low=0, high=1)
    seed: int = setting(0, "of starts and departures", low=0)


@dataclass(frozen=True)
class BeliefEpisode:
    """When a team got to know each cell of a map.

    Attributes:
        free_at: uint8 [H, W], the decision at which a cell was known to be free; `NEVER` = at none.
        wall_at: uint8 [H, W], the same for obstacles; they win.
        truth: bool [H, W], cells that the map leaves free.
        decisions: how many there were.
        reach: radar range [cells].
    """

    free_at: np.ndarray
    wall_at: np.ndarray
    truth: np.ndarray
    decisions: int
    reach: float

    def known(self, decision: int) -> np.ndarray:
        """What was known at a decision, uint8 [H, W]: `UNKNOWN`, `FREE` or `OBSTACLE`."""
        seen = np.where(self.free_at <= decision, FREE, UNKNOWN)
        return np.where(self.wall_at <= decision, OBSTACLE, seen).astype(np.uint8)


def map_numbers(scenario: str, split_name: str) -> list[int]:
    """Indices of the maps that are trained on, or of those for validation, as in `settings/indices.py`."""
    trained_on, validation = cut_last_fifth(split(scenario)[0])
    return list(validation if split_name == "validation" else trained_on)


def plan_files(folder: str, split_name: str) -> list[Path]:
    """The plans of a folder that are trained on, or those for validation.

    Raises:
        UserError: there are none.
    """
    groups: dict[Path, list[Path]] = {}
    for path in sorted(Path(folder).rglob("*.yaml")):
        groups.setdefault(path.parent, []).append(path)
    if not groups:
        raise UserError(f"plans={folder} holds no map_server yaml: give a folder of plans, or leave it out.")
    chosen = []
    for files in groups.values():
        trained_on, validation = cut_last_fifth(cut_last_fifth(range(len(files)))[0])
        chosen += [files[k] for k in (trained_on if split_name == "train" else validation)]
    return chosen


def import_plan(path: Path) -> PointCloudMap:
    """A plan as `import_map` makes it, but for the checker, which would take longer than playing on it."""
    options, report = ImportOptions(), ImportReport(str(path))
    grid = crop_grid(read_occupancy(path, options, report), options, report)
    return finish_map(GridSource(grid), find_scenario("pointcloud"), path.stem, options, report)


def depart_at_random(env: ExplorationEnv, share: float) -> FrontierPlanner:
    """`cost_utility` as a policy that takes, in a share of its decisions, any target that can be reached."""

    def rank(scene: TensorScene) -> torch.Tensor:
        own, draw = rank_by_utility(scene), keyed_uniform(env, scene.travel.shape[-1] + 1)
        others = torch.where(scene.travel.isfinite(), draw[..., 1:], -torch.inf)
        return torch.where(draw[..., :1] < share, others, own)

    return FrontierPlanner(env, rank)


@torch.no_grad()
def play_maps(maps: list[PointCloudMap], robots: int, seed: int, departures: float) -> list[BeliefEpisode]:
    """As many episodes as there are maps, each on one that is drawn."""
    row = find_scenario(maps[0].scenario)
    steps = int(LONGER * row.macro_steps) if row.macro_steps else default_macro_steps(maps, row)
    env = ExplorationEnv(
        maps,
        num_envs=len(maps),
        num_robots=robots,
        seed=seed,
        macro_steps=min(steps, NEVER),
        success_coverage=1.0,
        decision_seconds="protocol",
        num_threads=1,
        planner=PlannerConfig(name="wavefront"),
        observation=ObservationConfig(pictures=False),
    )
    planner = depart_at_random(env, departures)
    nav, policy = planner.tracker.nav, as_module(lambda _: planner, env)
    td = env.reset()
    place = env.simulation.tensors["map_id"].tolist()
    shape = (len(maps), nav._known.shape[-1])
    free_at, wall_at = (torch.full(shape, NEVER, dtype=torch.uint8) for _ in range(2))
    decision, done = 0, False
    while not done:
        td = policy(td)
        known = nav.known[:, 0].cpu()
        for when, state in ((free_at, FREE), (wall_at, OBSTACLE)):
            when[(known == state) & (when == NEVER)] = decision
        td = step_mdp(env.step(td))
        decision, done = decision + 1, bool(td["done"].all())
    grids = [build_nav_grid(world) for world in env.maps]
    episodes = []
    for k, grid in enumerate(grids[m] for m in place):
        size, cells = (grid.height, grid.width), grid.height * grid.width
        when = [steps[k, :cells].numpy().reshape(size).copy() for steps in (free_at, wall_at)]
        episodes.append(BeliefEpisode(*when, open_cells(grid).reshape(size), decision, row.radar_range / grid.cell))
    return episodes


def save_episodes(path: Path, episodes: list[BeliefEpisode]) -> None:
    """One compressed file, whole or not there."""
    arrays = {
        f"{k}/{field.name}": getattr(episode, field.name)
        for k, episode in enumerate(episodes)
        for field in fields(BeliefEpisode)
    }
    write_file(path, lambda file: np.savez_compressed(file, **arrays))


def load_episodes(path: Path) -> list[BeliefEpisode]:
    """What `save_episodes` wrote."""
    with np.load(path, allow_pickle=False) as file:
        count = 1 + max(int(name.split("/")[0]) for name in file.files)
        names = [field.name for field in fields(BeliefEpisode)]
        values = [{name: file[f"{k}/{name}"] for name in names} for k in range(count)]
    return [
        until_covered(
            BeliefEpisode(**{name: value[name] if value[name].ndim else value[name].item() for name in names})
        )
        for value in values
    ]


def until_covered(episode: BeliefEpisode, share: float = COVERED) -> BeliefEpisode:
    """The episode up to the decision at which a share of what is free was known: there is nothing to decide after."""
    when = np.sort(episode.free_at[episode.truth])
    last = int(when[min(len(when) - 1, int(share * len(when)))])
    return replace(episode, decisions=max(1, min(episode.decisions, last)))


def load_groups(folder: Path) -> dict[str, list[BeliefEpisode]]:
    """Episodes by scenario.

    Raises:
        UserError: there are none.
    """
    groups: dict[str, list[BeliefEpisode]] = {}
    for path in sorted(folder.glob("*.npz")):
        groups.setdefault(path.stem.split("-")[0], []).extend(load_episodes(path))
    if not groups:
        raise UserError(f"data={folder} holds no beliefs: write some with python -m tests.tools.predictor.beliefs.")
    return groups


def write_beliefs(config: BeliefConfig) -> None:
    """Play and write what is not there yet."""
    check_settings(config)
    for name in config.scenarios:
        write_maps(config, name, list_sources(config, name))
        if config.extra and name != PLANS and config.split == "train":
            write_maps(config, f"{name}-extra", list(range(EXTRA_MAPS, EXTRA_MAPS + config.extra)))


def list_sources(config: BeliefConfig, name: str) -> list:
    """Files of plans, or indices of a scenario's maps."""
    sources = plan_files(config.plans, config.split) if name == PLANS else map_numbers(name, config.split)
    return sources[:: max(1, len(sources) // config.limit)][: config.limit] if config.limit else sources


def write_maps(config: BeliefConfig, name: str, sources: list) -> None:
    """A few maps after the other."""
    for first in range(0, len(sources), config.batch):
        write_batch(config, name, sources[first : first + config.batch], first)


def write_batch(config: BeliefConfig, name: str, sources: list, first: int) -> None:
    """All rounds on a few maps, a file each."""
    names = [Path(config.out) / config.split / f"{name}-{first:05d}-{k}.npz" for k in range(config.rounds)]
    scenario = name.split("-")[0]
    missing = [k for k, name in enumerate(names) if not name.exists()]
    if not missing:
        return
    maps = [import_plan(source) if scenario == PLANS else make_map(scenario, source) for source in sources]
    for k in missing:
        begin = time.perf_counter()
        episodes = play_maps(maps, TEAMS[k % len(TEAMS)], config.seed + first + 10_007 * k, config.departures)
        save_episodes(names[k], episodes)
        decisions = sum(episode.decisions for episode in episodes)
        print(f"{names[k].name}: {decisions} beliefs in {time.perf_counter() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    sys.exit(run(BeliefConfig, write_beliefs))
