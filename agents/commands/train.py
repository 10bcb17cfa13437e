"""`maexp train`: settings, a new or a resumed run, then the evaluation and the pictures."""

import copy
import shutil
from collections.abc import Callable
from pathlib import Path

from maexp.agents.build import choose_device, make_env, model_settings
from maexp.agents.commands.evaluate import draw_results, evaluate_all, report
from maexp.agents.commands.run_folder import check_writable
from maexp.agents.errors import UserError
from maexp.agents.evaluation.kept import FOLDER
from maexp.agents.files import command, short
from maexp.agents.locking import lock
from maexp.agents.settings.checks import check_counts, check_seed, team_sizes, words_of
from maexp.agents.settings.overrides import find_override
from maexp.agents.settings.runs import Recipe, continue_run
from maexp.agents.settings.schema import TrainSettings
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.agents.training.imitation import check_warm_start, warm_start
from maexp.agents.training.logs import check_logger, log_results
from maexp.agents.training.named import Player, find_players, suit_observation
from maexp.agents.training.train import (
    TrainingRun,
    check_collector,
    check_expert,
    describe_workers,
    train,
    write_config,
)
from maexp.agents.training.validation import judged

STOPPED = 130
NEEDED = ("best", "average", "seconds", "updater", "collector", "random")


def prepare(overrides: list[str]) -> Recipe:
    """For resume=RUN: that run's settings, then the new ones."""
    place = find_override(overrides, "resume")
    if place is None:
        return Recipe(overrides)
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
    """Raise UserError for counts out of range."""
    check_counts(cfg, "num_envs", "total_frames", "checkpoint_every", "checkpoint_keep", "evaluate_episodes")
    check_counts(cfg, "episodes", "evaluate_every", least=0)
    team_sizes(cfg.num_robots)
    check_seed(judged(cfg).seed, "evaluation_seed")
    check_collector(cfg.collector)
    check_expert(cfg)
    check_logger(cfg.logger)
    if not cfg.resume:
        check_warm_start(cfg)
    suit_observation(copy.deepcopy(cfg), find_others(cfg))


def find_others(cfg: TrainSettings) -> list[Player]:
    """The policies played at the end beside the trained one."""
    words = list(dict.fromkeys(["random", *words_of(cfg.classical)]))
    others = find_players(words, "classical")
    return [one for one in others if one.direct] if cfg.planner.name == "direct" else others  # the rest pick goals


def run(cfg: TrainSettings, where: Path, overrides: list[str]) -> int:
    """Train, evaluate, draw; says where everything is."""
    with lock(where, "maexp train"):
        return run_locked(cfg, where, overrides)


def run_locked(cfg: TrainSettings, where: Path, overrides: list[str]) -> int:
    """The same, while no one else is at the folder."""
    saved = _resumable(cfg.resume)[1] if cfg.resume else None
    training = TrainingRun.build(cfg, where, overrides, saved)
    write_config(training.settings, where, "train", overrides, map_checksums=training.checksums)
    print(f"{cfg.algorithm.name} on {cfg.scenario.name} ({len(training.suite.train)} maps), {cfg.num_envs} teams of "
          f"{_list(training.sizes)} robots{_describe(cfg)}; everything goes to {short(where)}", flush=True)  # fmt: skip
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
    """Evaluate the trained team beside random goals and classical planners; write the summary and the pictures."""
    cfg, where = judged(done.cfg), done.folder
    written = ["config.yaml", "metrics.csv", "checkpoints/"]
    draw_curves(where)
    written.append("curves.png")
    best: dict[int, str] = {}
    if cfg.episodes:
        device = choose_device(cfg, "train_device")
        others = find_others(cfg)
        best = done.validation.best
        shown = copy.deepcopy(cfg)
        players = [trained_player(done), *others]
        suit_observation(shown, players)
        envs = (make_env(shown, done.suite.held_out, size, device=device) for size in done.sizes)
        results = [one for env in envs for one in evaluate_all(cfg, env, players, where / FOLDER)]
        report(cfg, results, done.suite, best, where / "summary.json", training_seconds=round(done.seconds, 2))
        written += ["summary.json", *draw_results(results, where)]
    draw_rollout(cfg, done, best.get(done.sizes[0]), where / "rollout.gif")
    written.append("rollout.gif")
    log_results(where, done.cfg.logger, done.frames, done.settings)
    shutil.rmtree(where / FOLDER, ignore_errors=True)
    print(f"Written to {short(where)}: {', '.join(written)}")
    evaluate = command("evaluate", f"checkpoint={short(where)}", "num_robots=1,2,6,8")
    print(f"Next: {evaluate}, or {command('view', short(where))}")


def trained_player(done: TrainingRun) -> Player:
    """The team that was trained."""
    looks, direct = model_settings(done.cfg).action == "regions", done.cfg.planner.name == "direct"
    return Player("trained", lambda env: done.learner.policy, "checkpoint", pictures=looks, direct=direct)


def draw_curves(where: Path) -> None:
    """curves.png from metrics.csv."""
    from maexp.agents.evaluation.plots import draw_curves as draw

    draw(where / "metrics.csv", where / "curves.png")


def draw_rollout(cfg: TrainSettings, done: TrainingRun, best: str | None, path: Path) -> None:
    """A film of the trained team in the first held-out episode, beside the best classical planner if there is one."""
    from maexp.agents.evaluation.films import draw_film, play_teams
    from maexp.envs.film import write_gif

    env = make_env(cfg, done.suite.held_out[:1], done.sizes[0], 1, device=choose_device(cfg, "train_device"))
    teams = [trained_player(done), *([] if best is None else find_players([best]))]
    episodes = [play_teams(env, one.make(env), one.name, seed=cfg.seed)[0] for one in teams]
    write_gif(draw_film(episodes), path)
