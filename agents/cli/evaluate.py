"""`maexp evaluate`: held-out episodes with a trained team or classical policies, for one team size or several."""

import copy
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from maexp.agents.build import MapSuite, load_maps, make_env
from maexp.agents.cli import Command
from maexp.agents.cli.run_folder import check_writable
from maexp.agents.config.checks import choices_of, team_sizes
from maexp.agents.config.overrides import find_override
from maexp.agents.config.resolved import resolve
from maexp.agents.config.runs import Recipe, continue_run
from maexp.agents.config.verbs import EpisodeSettings, EvaluateSettings, ExportSettings, ViewSettings
from maexp.agents.errors import STOPPED, UserError, blame_input
from maexp.agents.evaluation.baseline import (
    CHANGES_FILE,
    EPISODES_FILE,
    Baseline,
    describe_changes,
    load_baseline,
    write_episodes,
)
from maexp.agents.evaluation.cache import FOLDER, EpisodeCache, begin, continue_evaluation, identify, is_begun
from maexp.agents.evaluation.comparison import choose_best, describe_differences, describe_training, play_once
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate_recorded, play, pool
from maexp.agents.evaluation.results import describe_run, print_results, result_names, write_results
from maexp.agents.evaluation.video import EPISODES, check_render, play_teams, write_film
from maexp.agents.files import command, lock, short, write_json
from maexp.agents.policies.registry import NamedPolicy, check_planner, find_named_policies, suit_observation
from maexp.agents.progress import Progress
from maexp.agents.training.checkpoint import check_action, find_checkpoint, restore_policy
from maexp.agents.training.train import write_config
from maexp.envs import ExplorationEnv, PointCloudMap

PICTURES = 4


def prepare(overrides: list[str]) -> Recipe:
    """For checkpoint=RUN: the run's settings as far as they matter here, then the new ones. For resume=FOLDER: those of
    an evaluation that was stopped."""
    if find_override(overrides, "resume") is not None:
        return continue_evaluation(find_override(overrides, "resume"), overrides)
    place = find_override(overrides, "checkpoint")
    if place is None and find_override(overrides, "policy") is None:
        raise UserError("Nothing to evaluate: give checkpoint=RUN, policy=nearest_frontier, or both.")
    if place is None:
        return Recipe(overrides)
    return continue_run(*find_checkpoint(place), overrides, "evaluate")


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path:
    """Every evaluation has a new folder of its own; one that goes on stays in its."""
    place = find_override(overrides, "resume")
    if place is None:
        return claim()
    check_writable(Path(place).absolute())
    return Path(place).absolute()


def check(cfg: EvaluateSettings) -> None:
    """Raise UserError for team sizes that are none and unknown policies."""
    team_sizes(cfg.num_robots)
    check_planner(cfg.planner.name, find_named_policies(choices_of(cfg.policy)))
    check_render(cfg)


def run(cfg: EvaluateSettings, where: Path, overrides: list[str]) -> int:
    """Evaluate, print the table, write results.json, a picture and the films that are asked for."""
    with lock(where, "maexp evaluate"):
        try:
            return run_locked(cfg, where, overrides)
        except KeyboardInterrupt:
            if not is_begun(where):
                raise
            print(f"Stopped. Go on with: {command('evaluate', f'resume={short(where)}')}")
            return STOPPED


def run_locked(cfg: EvaluateSettings, where: Path, overrides: list[str]) -> int:
    """The same, while no one else is at the folder."""
    asked = copy.deepcopy(cfg)
    with blame_input():
        baseline = None if cfg.baseline is None else load_baseline(cfg.baseline)
        suite = load_maps(cfg.scenario, train=False)
        maps = suite.held_out
        places = [[world] for world in maps] if cfg.scenario.path is not None else [maps]
        count = min(cfg.num_envs, cfg.episodes)
        players = find_teams(cfg)
        suit_observation(cfg, players)
        envs = [[make_env(cfg, place, size, count) for place in places] for size in team_sizes(cfg.num_robots)]
        for player in players:
            player.check_maps(maps)
            player.make(envs[0][0])
        steps = [env.local_steps * env.macro_steps for env in envs[0]]
        names = [player.name for player in players]
        if baseline is not None:
            run_here = describe_run(cfg, maps, 0.0) | {"steps": steps}
            baseline.check(run_here, [(name, size) for name in names for size in team_sizes(cfg.num_robots)])
        best = {}
        if any(player.learned for player in players):
            best = {size: choose_best(cfg, suite, names, size) for size in team_sizes(cfg.num_robots)}
    write_config(resolve(cfg, maps), where, "evaluate", overrides)
    begin(where, asked, overrides)
    results = [result for team in envs for result in evaluate_places(cfg, team, players, where / FOLDER)]
    report(cfg, results, suite, best, where / "results.json", steps=steps)
    write_episodes(where / EPISODES_FILE, results)
    draw_ends(cfg, maps, players[0], where / "picture.png")
    written = ["results.json", EPISODES_FILE, *draw_results(results, where), "picture.png", "config.yaml"]
    if baseline is not None:
        written += [compare_with(baseline, results, where)]
    if cfg.render:
        films = [film for team in envs for film in film_all(cfg, team[0], maps, players, where)]
        written += [film.name for film in films] + [f"{EPISODES}/"]
    shutil.rmtree(where / FOLDER)
    print(f"Written to {short(where)}: {', '.join(written)}")
    if cfg.render:
        print(f"Next: {command('view', short(where), 'browser=true')}")
    return 0


def find_teams(cfg: EvaluateSettings) -> list[NamedPolicy]:
    """Who is evaluated: the policy of `checkpoint`, then those of `policy`."""
    trained = [] if cfg.checkpoint is None else [find_trained(cfg)]
    return trained + find_named_policies(choices_of(cfg.policy))


def find_trained(cfg: EvaluateSettings | ViewSettings | ExportSettings) -> NamedPolicy:
    """The policy of `checkpoint`, for the settings that go with it and any team size."""
    saved = find_checkpoint(cfg.checkpoint)[1]
    check_action(saved, cfg)
    model, direct = cfg.model, cfg.planner.name == "direct"
    looks = model.action == "regions"
    kind = {"kind": "checkpoint", "pictures": looks, "direct": direct, "saved": saved}
    return NamedPolicy("trained", lambda env: restore_policy(env, model, saved), **kind)


def evaluate_all(
    cfg: EpisodeSettings, env: ExplorationEnv, players: list[NamedPolicy], where: Path
) -> list[EvaluationResult]:
    """Each policy on the same episodes; those that were played before are taken from `where`, and more left there."""
    results = []
    for player in players:
        policy = player.make(env)
        identity = identify(cfg, env, cfg.episodes, policy, player.name, player.source)
        kept = EpisodeCache(where / f"{player.name}_N{env.num_robots}", identity)
        with Progress(f"{player.name}, {env.num_robots} robot{'s' * (env.num_robots > 1)}", cfg.episodes) as progress:
            settings = {"name": player.name, "seed": cfg.seed, "advance": progress.advance, "kept": kept}

            def play(policy: Callable = policy, settings: dict = settings) -> EvaluationResult:
                return evaluate_recorded(policy, env, cfg.episodes, **settings)

            known = player.kind == "classical"
            played = play_once(player.name, env, play, cfg.episodes, cfg.seed, "recorded") if known else play()
            results.append(replace(played, learned=player.learned))
    return results


def evaluate_places(
    cfg: EvaluateSettings, envs: list, players: list[NamedPolicy], where: Path
) -> list[EvaluationResult]:
    """Each policy on the same episodes in each of several places, and in all of them together."""
    parts = [evaluate_all(cfg, env, players, where / str(number)) for number, env in enumerate(envs)]
    if len(envs) == 1:
        return parts[0]
    results = [pool(list(those)) for those in zip(*parts, strict=True)]
    for env, those in zip(envs, parts, strict=True):
        results += [replace(result, place=env.maps[0].name) for result in those]
    return results


def film_all(
    cfg: EvaluateSettings, env: ExplorationEnv, maps: list[PointCloudMap], players: list[NamedPolicy], where: Path
) -> list[Path]:
    """A film of each policy in the first `render_envs` of the episodes, and the episodes as files."""
    films = []
    env = make_env(cfg, maps, env.num_robots, min(cfg.render_envs, cfg.episodes))
    for player in players:
        name = player.name if len(team_sizes(cfg.num_robots)) == 1 else f"{player.name}_N{env.num_robots}"
        print(f"filming {name}", file=sys.stderr, flush=True)
        episodes = play_teams(env, player.make(env), name, seed=cfg.seed)
        films.append(write_film(episodes, where, name, cfg.render_format)[0])
    return films


def report(
    cfg: EpisodeSettings,
    results: list[EvaluationResult],
    suite: MapSuite,
    best: dict[int, str | None],
    path: Path,
    **extra: Any,
) -> None:
    """The table on the terminal, how far the learned team is ahead of the best classical planner, and the JSON.

    Args:
        best: team size -> the classical planner that is the best on the validation maps, if that was asked
    """
    seconds = sum(result.seconds for result in results)
    known = {str(size): name for size, name in best.items() if name is not None}
    extra |= {"held_out": suite.is_held_out} | ({"best_classical": known} if known else {})
    extra |= {"algorithm": cfg.algorithm.name} if getattr(cfg, "checkpoint", "") is not None else {}
    write_results(path, results, describe_run(cfg, suite.held_out, seconds) | extra)
    print_results(results, f"{cfg.scenario.name}: {describe_episodes(cfg.episodes, results, suite)}")
    for sentence in [*describe_differences(results, best), *describe_training(results)]:
        print(sentence)


def compare_with(baseline: Baseline, results: list[EvaluationResult], where: Path) -> str:
    """Print and write how far the results are from an earlier evaluation; the file's name."""
    changes = baseline.changes(results)
    write_json(where / CHANGES_FILE, changes | {"baseline": {"folder": str(baseline.folder), "run": baseline.run}})
    for sentence in describe_changes(changes, baseline.folder, results[0].success_coverage):
        print(sentence)
    return CHANGES_FILE


def draw_results(results: list[EvaluationResult], where: Path) -> list[str]:
    """Pictures of what came of all maps together: coverage over time, the metrics, the robots' shares; their names."""
    from maexp.agents.evaluation.plots import draw_contributions, draw_coverage, draw_summary

    whole = [result for result in results if not result.place]
    named = dict(zip(result_names(whole), whole, strict=True))
    draw_coverage(
        {name: (result.times, result.coverage, result.maps) for name, result in named.items()}, where / "coverage.png"
    )
    summaries = {name: result.summary() for name, result in named.items()}
    goal = {"success_coverage": max(result.success_coverage for result in whole)}
    draw_summary(summaries | {"run": goal}, where / "metrics.png")
    draw_contributions({name: result.shares for name, result in named.items()}, where / "shares.png")
    return ["coverage.png", "metrics.png", "shares.png"]


def describe_episodes(count: int, results: list[EvaluationResult], suite: MapSuite) -> str:
    """What was played: `count` episodes, or as many on each of several maps, and again for each team size."""
    words = f"{count} {'held-out ' * suite.is_held_out}episode{'s' * (count != 1)}"
    if len(results[0].episodes["exploration_ratio"]) > count:
        words += f" on each of {len(suite.held_out)} maps"
    return words + ", for each team size" * (len({result.num_robots for result in results}) > 1)


def draw_ends(cfg: EvaluateSettings, maps: list, player: NamedPolicy, path: Path) -> None:
    """The last moment of the first few episodes of a policy, side by side."""
    from maexp.envs.render.frames import draw_teams
    from maexp.envs.render.show import write_picture

    count = min(PICTURES, cfg.episodes)
    env = make_env(cfg, maps, team_sizes(cfg.num_robots)[0], count)
    with torch.random.fork_rng([]):
        torch.manual_seed(cfg.seed)
        play(player.make(env), env, torch.arange(count, device=env.device))
    write_picture(draw_teams([env.snapshot(index) | {"policy": player.name} for index in range(count)]), path)


COMMAND = Command(run, check, prepare=prepare, folder=folder)
