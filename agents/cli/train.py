"""`maexp train`: settings, a new or a resumed run, then the evaluation and the pictures."""

import copy
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from maexp.agents.build import choose_device, make_env
from maexp.agents.cli import Command
from maexp.agents.cli.evaluate import draw_results, evaluate_all, report
from maexp.agents.cli.run_folder import check_writable
from maexp.agents.config.checks import choices_of, team_sizes
from maexp.agents.config.overrides import find_override
from maexp.agents.config.runs import Recipe, continue_run
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import STOPPED, UserError
from maexp.agents.evaluation.cache import FOLDER
from maexp.agents.evaluation.comparison import find_typical
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.files import command, lock, short
from maexp.agents.policies.classical import PLANAR
from maexp.agents.policies.registry import NamedPolicy, find_named_policies, suit_observation
from maexp.agents.training.checkpoint import START, find_checkpoint, load_checkpoint, restore_policy
from maexp.agents.training.imitation import check_warm_start, starts_as, warm_start
from maexp.agents.training.logs import check_logger, log_results
from maexp.agents.training.prepare import check_collector, check_expert, describe_workers
from maexp.agents.training.train import (
    TrainingRun,
    train,
    write_config,
)
from maexp.agents.training.validation import judged
from maexp.envs import ExplorationEnv
from maexp.envs.scenarios import find_scenario

NEEDED = ("best", "average", "seconds", "updater", "collector", "random")


def prepare(overrides: list[str]) -> Recipe:
    """For resume=RUN: that run's settings, then the new ones; for policies to begin with: what they start from."""
    place = find_override(overrides, "resume")
    if place is None:
        begins = [find_override(overrides, name) for name in ("warm_start", "algorithm.begin_from")]
        return Recipe(overrides, [word for start in begins for word in starts_as(start)])
    if find_override(overrides, "hydra.run.dir") is not None:
        raise UserError("resume and hydra.run.dir together are ambiguous: a resumed run goes on in its own folder.")
    return continue_run(*_resumable(place), overrides, "train")


def _resumable(place: str) -> tuple[Path, dict]:
    """The checkpoint and the state to go on with; UserError where something a run needs is missing."""
    path, saved = find_checkpoint(place)
    missing = [name for name in NEEDED if name not in saved]
    if missing:
        raise UserError(f"{path} holds no {missing[0]}: no run can go on from it, maexp evaluate may play its policy.")
    return path, saved


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path:
    """The folder of the run that is resumed, or a new one."""
    place = find_override(overrides, "resume")
    if place is None:
        return claim()
    found = Path(place).absolute()
    found = found.parent if found.is_file() else found
    found = found.parent if found.name == "checkpoints" else found
    check_writable(found)
    return found


def check(cfg: TrainSettings) -> None:
    """Raise UserError for settings that do not go together."""
    team_sizes(cfg.num_robots)
    check_collector(cfg.collector)
    check_expert(cfg)
    check_logger(cfg.logger)
    if not cfg.resume:
        check_warm_start(cfg)
    suit_observation(copy.deepcopy(cfg), find_others(cfg))


def find_others(cfg: TrainSettings) -> list[NamedPolicy]:
    """The policies played at the end beside the trained one."""
    beside = choices_of(cfg.classical)
    if find_scenario(cfg.scenario.name).kind == "volume":
        beside = [name for name in beside if name not in PLANAR]
    others = find_named_policies(list(dict.fromkeys(["random", *beside])), "classical")
    return (
        [player for player in others if player.direct] if cfg.planner.name == "direct" else others
    )  # the rest pick goals


def run(cfg: TrainSettings, where: Path, overrides: list[str]) -> int:
    """Train, evaluate, draw; says where everything is."""
    with lock(where, "maexp train"):
        return run_locked(cfg, where, overrides)


def run_locked(cfg: TrainSettings, where: Path, overrides: list[str]) -> int:
    """The same, while no one else is at the folder."""
    saved = _resumable(cfg.resume)[1] if cfg.resume else None
    training = TrainingRun.build(cfg, where, overrides, saved)
    write_config(training.settings, where, "train", overrides, map_checksums=training.checksums)
    print(
        f"{cfg.algorithm.name} on {cfg.scenario.name} ({len(training.suite.train)} maps), {cfg.num_envs} teams of "
        f"{_list(training.sizes)} robots{_describe(cfg)}; everything goes to {short(where)}",
        flush=True,
    )
    if cfg.warm_start and saved is None:
        warm_start(training)
    train(training)
    if training.stopped:
        print(f"Stopped after {training.frames:,} macro steps. Go on with: {go_on(where)}")
        return STOPPED
    try:
        finish(training)
    except KeyboardInterrupt:
        print(f"The training is done, its evaluation was stopped. Finish it with: {go_on(where)}")
        return STOPPED
    return 0


def go_on(where: Path) -> str:
    """The command that goes on with a run."""
    return command("train", f"resume={short(where)}")


def _list(sizes: list[int]) -> str:
    """2, 3 and 4."""
    return " and ".join(filter(None, (", ".join(map(str, sizes[:-1])), str(sizes[-1]))))


def _describe(cfg: TrainSettings) -> str:
    """Who simulates, where that is not this process; and whether what is learned from is one batch old."""
    if cfg.collector.backend == "single":
        return ""
    late = "; the policy that acts is one batch older than the one that learns" * cfg.collector.overlap
    return f", simulated by {describe_workers(cfg)} on {choose_device(cfg, 'sample_device')}{late}"


def finish(done: TrainingRun) -> None:
    """Evaluate the trained team beside what it started from and others; write the summary and the pictures."""
    cfg, where = judged(done.cfg), done.folder
    written, results = ["config.yaml", "metrics.csv", "checkpoints/"], []
    players = [trained_policy(done), *starting_policies(done), *find_others(cfg)]
    best = done.validation.best if cfg.episodes or cfg.evaluate_every else {}
    shown = copy.deepcopy(cfg)
    suit_observation(shown, players)
    device, held_out = choose_device(cfg, "train_device"), done.suite.held_out
    if cfg.episodes:
        envs = [make_env(shown, held_out, size, device=device) for size in done.sizes]
        results = [result for env in envs for result in evaluate_all(cfg, env, players, where / FOLDER)]
        report(cfg, results, done.suite, best, where / "summary.json", training_seconds=round(done.seconds, 2))
        written += ["summary.json", *draw_results(results, where)]
    size = done.sizes[0]
    beside = [player for player in players if player.kind in ("checkpoint", "start") or player.name == best.get(size)]
    draw_curves(where, done.validation.rival, [result for result in results if result.num_robots == size], beside)
    env = envs[0] if results else make_env(shown, held_out[:1], size, 1, device=device)
    draw_rollout(cfg, env, beside, results, where / "rollout.gif")
    written += ["curves.png", "rollout.gif"]
    log_results(where, done.cfg.logger, done.frames, done.settings)
    shutil.rmtree(where / FOLDER, ignore_errors=True)
    print(f"Written to {short(where)}: {', '.join(written)}")
    evaluate = command("evaluate", f"checkpoint={short(where)}", "num_robots=1,2,6,8")
    print(f"Next: {evaluate}, or {command('view', short(where))}")


def trained_policy(done: TrainingRun) -> NamedPolicy:
    """The team that was trained."""
    looks, direct = done.cfg.model.action == "regions", done.cfg.planner.name == "direct"
    return NamedPolicy("trained", lambda env: done.learner.policy, "checkpoint", pictures=looks, direct=direct)


def starting_policies(done: TrainingRun) -> list[NamedPolicy]:
    """The team as it was before its training; none where that checkpoint is gone."""
    try:
        saved = load_checkpoint(done.folder / "checkpoints" / START)
    except UserError as error:
        warnings.warn(f"what the training started from is left out: {error}", stacklevel=2)
        return []
    model, like = done.cfg.model, trained_policy(done)
    name = "warm_start" if done.cfg.warm_start else "untrained"
    return [replace(like, name=name, kind="start", build=lambda env: restore_policy(env, model, saved))]


def draw_curves(where: Path, rival: str, results: list[EvaluationResult], beside: list[NamedPolicy]) -> None:
    """curves.png from metrics.csv, and from what the players `beside` the trained one did in the end."""
    from maexp.agents.evaluation.learning_curves import draw_curves as draw

    names = [player.name for player in beside]
    ends = {result.policy: (result.times, result.coverage, result.maps) for result in results if result.policy in names}
    draw(where / "metrics.csv", where / "curves.png", rival=rival, ends=ends)


def draw_rollout(
    cfg: TrainSettings, env: ExplorationEnv, teams: list[NamedPolicy], results: list[EvaluationResult], path: Path
) -> None:
    """A film of the teams side by side in the held-out episode that stands for the mean difference of the first to the
    last; in the first episode where there are no results.

    All teams of `env` play, as in the evaluation: so whoever draws actions draws the same ones.
    """
    from maexp.agents.evaluation.video import draw_film, play_teams
    from maexp.envs.render.video import write_gif

    known = {result.policy: result for result in results if result.num_robots == env.num_robots}
    number, caption = 0, []
    if known:
        rival = known[teams[-1].name] if len(teams) > 1 else None
        count = min(env.num_envs, cfg.episodes)
        number, apart, mean = find_typical(known["trained"], rival, count)
        pair = "trained" if rival is None else f"trained - {rival.policy}"
        caption = [
            f"{pair}: {100 * apart:+.1f} points of coverage over time, of {count} episodes the closest to the mean "
            f"({100 * mean:+.1f})"
        ]
    episodes = [play_teams(env, player.make(env), player.name, teams=[number], seed=cfg.seed)[0] for player in teams]
    caption.insert(0, f"{episodes[0].map.name}, episode {number} of seed {cfg.seed}")
    write_gif(draw_film(episodes, caption, columns=len(episodes)), path)


COMMAND = Command(run, check, prepare=prepare, folder=folder)
