"""`maexp train`: settings, a fresh or a resumed run, then the evaluation and the pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from maexp.agents.build import choose_device, make_env
from maexp.agents.checkpoint import find_checkpoint
from maexp.agents.commands.evaluate import draw_results, evaluate_all, report
from maexp.agents.commands.run_folder import check_writable, short
from maexp.agents.errors import UserError
from maexp.agents.logs import check_logger
from maexp.agents.settings.checks import check_counts, team_sizes
from maexp.agents.settings.overrides import find_override
from maexp.agents.settings.runs import Recipe, continue_run
from maexp.agents.train import TrainingRun, check_collector, describe_workers, train, write_config

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


def check(cfg: Any) -> None:
    """Raise UserError for counts out of range."""
    check_counts(cfg, "num_envs", "total_frames", "checkpoint_every", "checkpoint_keep")
    check_counts(cfg, "episodes", "evaluate_every", least=0)
    team_sizes(cfg.num_robots)
    check_collector(cfg.collector)
    check_logger(cfg.logger)


def run(cfg: Any, where: Path, overrides: list[str]) -> int:
    """Train, evaluate, draw; says where everything is."""
    saved = _resumable(cfg.resume)[1] if cfg.resume else None
    training = TrainingRun.build(cfg, where, overrides, saved)
    write_config(training.settings, where, "train", overrides)
    print(f"{cfg.algorithm.name} on {cfg.scenario.name} ({len(training.suite.train)} maps), {cfg.num_envs} teams of "
          f"{_list(training.sizes)} robots{_describe(cfg)}; everything goes to {short(where)}", flush=True)  # fmt: skip
    train(training)
    if training.stopped:
        print(f"Stopped after {training.frames:,} macro steps. Go on with: maexp train resume={short(where)}")
        return STOPPED
    finish(training)
    return 0


def _list(sizes: list[int]) -> str:
    """2, 3 and 4."""
    return " and ".join(filter(None, (", ".join(map(str, sizes[:-1])), str(sizes[-1]))))


def _describe(cfg: Any) -> str:
    """Who simulates, where that is not this process; and whether what is learned from is one batch old."""
    if cfg.collector.backend == "single":
        return ""
    late = "; the policy that acts is one batch older than the one that learns" * cfg.collector.overlap
    return f", simulated by {describe_workers(cfg)} on {choose_device(cfg, 'sample_device')}{late}"


def finish(done: TrainingRun) -> None:
    """Evaluate the trained team and the random policy on the same episodes; write the summary and the pictures."""
    cfg, where = done.cfg, done.folder
    written = ["config.yaml", "metrics.csv", "checkpoints/"]
    draw_curves(where)
    written.append("curves.png")
    if cfg.episodes:
        policies = {"trained": done.learner.policy, "random": "random"}
        device = choose_device(cfg, "train_device")
        envs = (make_env(cfg, done.suite.held_out, size, device=device) for size in done.sizes)
        results = [one for env in envs for one in evaluate_all(cfg, env, policies)]
        report(cfg, results, done.suite, where / "summary.json", training_seconds=round(done.seconds, 2))
        written += ["summary.json", *draw_results(results, where)]
    draw_rollout(cfg, done, where / "rollout.gif")
    written.append("rollout.gif")
    print(f"Written to {short(where)}: {', '.join(written)}")
    print(f"Next: maexp evaluate checkpoint={short(where)} num_robots=1,2,6,8, or maexp view {short(where)}")


def draw_curves(where: Path) -> None:
    """curves.png from metrics.csv."""
    from maexp.agents.plots import draw_curves as draw

    draw(where / "metrics.csv", where / "curves.png")


def draw_rollout(cfg: Any, done: TrainingRun, path: Path) -> None:
    """A film of the trained team in the first held-out episode."""
    import torch

    from maexp.envs.film import write_gif
    from maexp.envs.render import record_episode

    env = make_env(cfg, done.suite.held_out[:1], done.sizes[0], 1, device=choose_device(cfg, "train_device"))
    with torch.random.fork_rng([]), torch.no_grad():
        torch.manual_seed(cfg.seed)
        env.set_episodes(torch.zeros(1, dtype=torch.int64, device=env.device))
        write_gif(record_episode(env, done.learner.policy, every=None), path)
