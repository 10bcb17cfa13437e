"""The training loop: collect, learn, log, keep; then evaluate beside the random policy."""

import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from maexp.agents.build import Learner, MapSuite, load_maps, make_env, make_learner
from maexp.agents.checkpoint import random_state, save_checkpoint, seed_everything, set_random_state
from maexp.agents.collect import Stopwatch, TeamCollector, batch_statistics, make_collector
from maexp.agents.compose import compose_config
from maexp.agents.errors import UserError, blame_input
from maexp.agents.evaluate import evaluate
from maexp.agents.logs import MetricsLog
from maexp.agents.memory import check_batch_memory
from maexp.agents.progress import Progress
from maexp.agents.results import plain


def train(run: "TrainingRun") -> None:
    """Train until `total_frames`, from where `run` is; every file goes to its folder.

    On the CPU a run that is stopped and resumed gives bit for bit what an uninterrupted one gives.
    """
    cfg = run.cfg
    log = MetricsLog(run.folder, cfg.logger, kept=run.iteration, config=plain(cfg))
    with stop_on_signals() as stop, Progress("training", cfg.total_frames, run.frames) as progress:
        if run.iteration == 0:
            run.save()
        while run.iteration < run.iterations and not stop:
            begin = time.perf_counter()
            with Stopwatch(run.learner.policy) as acting:
                batch = run.collector.next()
            collected = time.perf_counter() - begin
            row = batch_statistics(batch)
            with name_iteration(run):
                row |= run.learner.updater.update(batch, progress=run.iteration / run.iterations)
            run.collector.update_policy_weights_()
            run.iteration += 1
            row |= run.evaluate_if_due()
            log.write(run.timed(row, collected, acting.seconds, begin))
            average = run.smooth(row["coverage"])
            run.keep(row, log, last=bool(stop) or run.iteration == run.iterations)
            progress.show(min(run.frames, cfg.total_frames), f"coverage {average:.3f}")
    log.close()
    run.stopped = bool(stop)


@dataclass
class TrainingRun:
    """The parts of a run and how far it is.

    Attributes:
        best: highest coverage so far, of training episodes or of the evaluations in between
        average: running mean of the training's coverage, for the progress bar
        seconds: training time so far, over all resumptions
    """

    cfg: Any
    folder: Path
    overrides: list[str]
    suite: MapSuite
    learner: Learner
    collector: TeamCollector
    iteration: int = 0
    best: float = -math.inf
    average: float = math.nan
    seconds: float = 0.0
    stopped: bool = False

    @classmethod
    def build(cls, cfg: Any, folder: Path, overrides: list[str], saved: dict | None = None) -> "TrainingRun":
        """Everything a run needs, at its start or as `saved` left it; nothing is written yet.

        Raises:
            UserError: a setting, map or checkpoint that cannot be used.
        """
        seed_everything(cfg.seed)
        with blame_input():
            suite = load_maps(cfg.scenario)
            env = make_env(cfg, suite.train, cfg.num_robots)
            check_batch_memory(env, cfg.collector.steps)
            learner = make_learner(cfg, env)
            collector = make_collector(env, learner.policy, cfg.collector.steps)
            run = cls(cfg, folder, overrides, suite, learner, collector)
            if saved is not None:
                run.restore(saved)
        return run

    @property
    def batch_frames(self) -> int:
        """Macro steps of teams in one iteration."""
        return self.cfg.num_envs * self.cfg.collector.steps

    @property
    def frames(self) -> int:
        return self.iteration * self.batch_frames

    @property
    def iterations(self) -> int:
        return math.ceil(self.cfg.total_frames / self.batch_frames)

    def save(self, best: bool = False) -> Path:
        """Write a checkpoint of this moment."""
        state = {
            "overrides": self.overrides,
            "iteration": self.iteration,
            "best": self.best,
            "average": self.average,
            "seconds": self.seconds,
            "updater": self.learner.updater.state_dict(),
            "policy": self.learner.policy.state_dict(),
            "collector": self.collector.state_dict(),
            "random": random_state(),
        }
        return save_checkpoint(self.folder / "checkpoints", state, self.iteration, self.cfg.checkpoint_keep, best)

    def restore(self, saved: dict) -> None:
        """Go on where `save` was called."""
        check_action(saved, self.cfg)
        load_matching(self.learner.policy, saved["policy"])
        self.collector.load_state_dict(saved["collector"])
        self.learner.updater.load_state_dict(saved["updater"])
        self.iteration, self.best = saved["iteration"], saved["best"]
        self.average, self.seconds = saved["average"], saved["seconds"]
        set_random_state(saved["random"])

    def evaluate_if_due(self) -> dict[str, float]:
        """Coverage on held-out maps, every `evaluate_every` iterations; else NaN."""
        every = self.cfg.evaluate_every
        if not every or self.iteration % every:
            return {"held_out_coverage": math.nan}
        if not hasattr(self, "_held_out_env"):
            self._held_out_env = make_env(self.cfg, self.suite.held_out, self.cfg.num_robots)
        result = evaluate(self.learner.policy, self._held_out_env, self._held_out_env.num_envs, seed=self.cfg.seed)
        return {"held_out_coverage": result.summary()["exploration_ratio"]["mean"]}

    def keep(self, row: dict[str, float], log: MetricsLog, last: bool) -> None:
        """Save when it is time to, or when the coverage is the best so far."""
        score = row["held_out_coverage"] if self.cfg.evaluate_every else row["coverage"]
        due = last or self.iteration % self.cfg.checkpoint_every == 0
        if due:
            log.sync()
            best = score > self.best  # false where the score is NaN
            self.best = score if best else self.best
            self.save(best)

    def smooth(self, coverage: float) -> float:
        """Running mean of the coverage; iterations where no episode ended do not count."""
        if not math.isnan(coverage):
            self.average = coverage if math.isnan(self.average) else 0.9 * self.average + 0.1 * coverage
        return self.average

    def timed(self, row: dict[str, float], collected: float, policy: float, begin: float) -> dict[str, float]:
        """The row with its place in the run in front, and where the time went at the end."""
        spent = time.perf_counter() - begin
        self.seconds += spent
        times = {"simulate": collected - policy, "policy": policy}
        times |= {name: row.pop(name) for name in ("advantage", "update")}
        return (
            {"iteration": self.iteration, "frames": self.frames}
            | row
            | {f"time_{name}": round(seconds, 4) for name, seconds in times.items()}
            | {"frames_per_second": round(self.batch_frames / spent, 2), "seconds": round(self.seconds, 3)}
        )


def check_action(saved: dict, cfg: Any) -> None:
    """Refuse weights trained for the other kind of action: goals and controls have tensors of the same shapes.

    Raises:
        UserError: one of the two planners is `direct`, the other not.
    """
    trained = compose_config("train", saved["overrides"]).planner.name
    if (trained == "direct") != (cfg.planner.name == "direct"):
        raise UserError(
            f"The checkpoint was trained with planner={trained} and planner={cfg.planner.name} takes another action: "
            f"leave planner={cfg.planner.name} out, or train a policy with it."
        )


def load_matching(policy: Any, state: dict) -> None:
    """Load a policy's weights.

    Raises:
        UserError: they belong to another network.
    """
    own = policy.state_dict()
    wrong = [name for name in own if name not in state or state[name].shape != own[name].shape]
    wrong += [name for name in state if name not in own]
    if wrong:
        raise UserError(
            f"The checkpoint holds another network ({len(wrong)} tensors differ, first {wrong[0]}): "
            "use the model and planner settings it was trained with."
        )
    policy.load_state_dict(state)


@contextmanager
def name_iteration(run: TrainingRun) -> Iterator[None]:
    """A loss that became NaN or infinite ends the run with its name; the checkpoints stay as they are."""
    try:
        yield
    except ArithmeticError as error:
        raise UserError(
            f"Training stopped in iteration {run.iteration + 1}: {error} The last good checkpoint is kept in "
            f"{run.folder / 'checkpoints'}."
        ) from error


@contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """A list that fills on Ctrl-C or SIGTERM, so that the loop can end cleanly; a second Ctrl-C ends at once."""
    received: list[int] = []

    def handle(number, frame):
        if received:
            raise KeyboardInterrupt
        received.append(number)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def write_config(cfg: Any, folder: Path, verb: str, overrides: list[str]) -> None:
    """config.yaml: the command as a comment, then all settings that it came to."""
    command = f"# maexp {verb} {' '.join(overrides)}".rstrip()
    (folder / "config.yaml").write_text(f"{command}\n{OmegaConf.to_yaml(cfg)}")
