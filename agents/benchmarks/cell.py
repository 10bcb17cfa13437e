"""One cell of a benchmark: train where there is something to train, play the episodes, keep all their numbers."""

import json
import shutil
import time
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.benchmarks.plan import (
    Cell,
    cell_config,
    cell_folder,
    find_cell_policy,
    is_learned,
    training_cell,
    word_names,
)
from maexp.agents.build import load_maps, make_env
from maexp.agents.config.resolved import resolve
from maexp.agents.config.runs import PLAYED
from maexp.agents.config.verbs import BenchmarkSettings, TrainSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.evaluation.cache import FOLDER, EpisodeCache, identify
from maexp.agents.evaluation.comparison import CHOOSING
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate_recorded
from maexp.agents.evaluation.results import FORMAT, describe_run
from maexp.agents.files import command, lock, short, write_file, write_json
from maexp.agents.policies.classical import CLASSICAL
from maexp.agents.policies.registry import NamedPolicy, suit_observation
from maexp.agents.progress import Progress
from maexp.agents.training.checkpoint import find_checkpoint, list_checkpoints, restore_policy
from maexp.agents.training.train import CONFIG, TrainingRun, train, write_config

RUN = ("maps", "commit", "seconds")  # what the report says of how a cell was run
CURVE = ("curve_seconds", "curve_coverage")
TRAINED = "training.json"
"""Written last where a training has come to its end."""
VALIDATION = "validation"
"""Maps that a classical planner plays first: they say which one is the best."""


class EnvShelf:
    """The last env for each set of maps: building one takes longer than many an evaluation."""

    def __init__(self):
        self.kept: dict[str, tuple[str, Any]] = {}

    def find(self, suite: str, key: str, build: Callable[[], Any]) -> Any:
        """The env kept for `key`, or a new one in place of the one kept."""
        if self.kept.get(suite, ("", None))[0] != key:
            self.kept.pop(suite, None)
            self.kept[suite] = (key, build())
        return self.kept[suite][1]


def finished(where: Path, cell: Cell, suite: str) -> bool:
    """Whether a cell has its result; it is written last."""
    return (cell_folder(where, cell) / f"{suite}.json").is_file()


def run_cell(cfg: BenchmarkSettings, where: Path, cell: Cell, shelf: EnvShelf, suites: list[str]) -> bool:
    """Bring a cell to its end, from wherever it was left; False if it was told to stop.

    Raises:
        UserError: settings or maps that cannot be used.
    """
    folder = cell_folder(where, cell)
    folder.mkdir(parents=True, exist_ok=True)
    settings, _ = cell_config(cfg, cell)
    team = train_cell(cfg, where, training_cell(cfg, cell)) if cell.trains else None
    if cell.trains and team is None:
        return False
    for suite in [VALIDATION] * (cell.policy in CLASSICAL) + suites:
        if not finished(where, cell, suite):
            play_suite(cfg, settings, cell, suite, team, folder, shelf)
    return True


def train_cell(cfg: BenchmarkSettings, where: Path, cell: Cell) -> dict | None:
    """The last checkpoint of what a cell trains, from wherever it was left; None if it was told to stop.

    Another worker that is at the same training is waited for.
    """
    folder = cell_folder(where, cell)
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder, "maexp benchmark", wait=True):
        if not (folder / TRAINED).is_file():
            settings, words = cell_config(cfg, cell)
            saved = find_checkpoint(folder)[1] if list_checkpoints(folder / "checkpoints") else None
            run = TrainingRun.build(settings, folder, words, saved)
            write_config(run.settings, folder, "train", words)
            train(run)
            if run.stopped:
                return None
            write_json(folder / TRAINED, {"training_seconds": round(run.seconds, 2)})
        return find_checkpoint(folder)[1] | json.loads((folder / TRAINED).read_text())


def play_suite(
    cfg: BenchmarkSettings,
    settings: TrainSettings,
    cell: Cell,
    suite: str,
    team: dict | None,
    folder: Path,
    shelf: EnvShelf,
) -> None:
    """Play the episodes of one set of maps; writes the arrays, then the summary that marks the end.

    Args:
        team: checkpoint of a trained one
    """
    with blame_input():
        maps = getattr(load_maps(settings.scenario, train=suite == "trained"), _ATTRIBUTE[suite])
        player = find_cell_policy(cfg, cell) if team is None else None
        if player is not None:
            show_what_it_looks_at(settings, player, maps)
        key = f"{cell.scenario} {cell.seed} {cell.map} {suite} {settings.observation}"
        episodes = min(CHOOSING, cfg.episodes) if suite == VALIDATION else cfg.episodes
        size = min(cfg.num_envs, episodes)
        starts = {"starts": "together"} if suite == "held_out_together" else {}
        env = shelf.find(suite, key, lambda: make_env(settings, maps, cfg.num_robots, size, **starts))
        policy = restore_policy(env, settings.model, team) if player is None else player.make(env)
        if suite != VALIDATION and not (folder / CONFIG).is_file():  # where a policy was trained, that has written it
            write_config(played_settings(settings, maps), folder, "benchmark", [], **who_played(cfg, cell, episodes))
    source = "" if player is None else player.source
    kept = EpisodeCache(folder / FOLDER / suite, identify(settings, env, episodes, policy, cell.policy, source))
    begin = time.perf_counter()
    with Progress(f"evaluating on {suite}", episodes) as progress:
        how = {"name": cell.policy, "seed": cell.seed, "advance": progress.advance, "kept": kept}
        result = evaluate_recorded(policy, env, episodes, **how)
    arrays = dict(zip(CURVE, (result.times, result.coverage.astype(np.float32)), strict=True)) | result.episodes
    arrays["maps"] = result.maps
    described = describe_run(settings, maps, time.perf_counter() - begin)
    described |= {} if team is None else {"training_seconds": team["training_seconds"]}
    described |= {"algorithm": cell.policy} if cell.trains else {}
    described |= {} if player is None or not player.source else {"policy": player.source}
    described |= {"episodes": episodes, "maps_are": suite}
    described |= {"num_robots": env.num_robots, "device": str(env.device)}
    described |= {"limit": env.local_steps * env.macro_steps}
    write_result(folder, suite, arrays, {cell.policy: result.summary(), "run": described})
    shutil.rmtree(folder / FOLDER)


def show_what_it_looks_at(settings: TrainSettings, player: NamedPolicy, maps: list) -> None:
    """Let the env of a cell show what its policy looks at; say which maps of its training have changed."""
    if player.targets is not None:  # the cell has an env of its own
        settings.observation = replace(settings.observation, targets=0)
    suit_observation(settings, [player])
    player.check_maps(maps)


def played_settings(settings: TrainSettings, maps: list) -> dict:
    """The settings of a cell's env with all their values."""
    values = resolve(settings, maps)
    return {name: values[name] for name in PLAYED if name in values}


def who_played(cfg: BenchmarkSettings, cell: Cell, episodes: int) -> dict:
    """The policy of a cell, and where it was trained."""
    trained = {"checkpoint": f"cells/{training_cell(cfg, cell).name}"} if cell.trains else {}
    word = next((word for word, name in word_names(cfg).items() if name == cell.policy), cell.policy)
    return {"policy": word, "episodes": episodes} | trained


_ATTRIBUTE = {"held_out": "held_out", "trained": "train", "held_out_together": "held_out", VALIDATION: "validation"}


def write_result(folder: Path, suite: str, arrays: dict[str, np.ndarray], summary: dict) -> None:
    """The arrays, then the summary, which marks the end: a cell that was killed in between is played again."""
    write_file(folder / f"{suite}.npz", lambda file: np.savez_compressed(file, **arrays))
    write_json(folder / f"{suite}.json", summary)


def read_result(where: Path, cell: Cell, suite: str) -> EvaluationResult:
    """The result of a finished cell.

    Raises:
        UserError: its files are damaged, or hold something else.
    """
    folder = cell_folder(where, cell)
    try:
        summary = json.loads((folder / f"{suite}.json").read_text())
        if summary["run"]["format"] != FORMAT:
            raise ValueError(summary["run"]["format"])
        with np.load(folder / f"{suite}.npz", allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        times, coverage = (arrays.pop(name) for name in CURVE)
        run = {name: summary["run"][name] for name in RUN} | summary["run"]
        maps = arrays.pop("maps")
        episodes = {name: arrays[name] for name in summary[cell.policy]} | arrays
        team, wall, goal = (run[name] for name in ("num_robots", "seconds", "success_coverage"))
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(
            f"{short(folder / suite)}.json and .npz cannot be read ({type(error).__name__}): remove the .json, and "
            f"{command('benchmark', f'resume={short(where)}')} plays {cell.name} again."
        ) from error
    return EvaluationResult(
        cell.policy,
        team,
        episodes,
        wall,
        maps,
        learned=is_learned(cell.policy),
        times=times,
        coverage=coverage,
        success_coverage=goal,
        trainings=np.full(len(maps), cell.seed) if cell.trains else None,
        run=run,
    )
