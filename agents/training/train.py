"""The training loop: collect, learn, log, keep; then evaluate beside others."""

import math
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from maexp.agents.build import (
    Learner,
    MapSuite,
    load_maps,
)
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.model import ModelConfig
from maexp.agents.config.overrides import without
from maexp.agents.config.resolved import resolve, to_yaml
from maexp.agents.config.runs import PLAYED
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import UserError, blame_input, stop_on_signals
from maexp.agents.files import changed_maps, checksums, command, short, write_text
from maexp.agents.models.actor import load_matching
from maexp.agents.progress import Progress
from maexp.agents.tables import brackets
from maexp.agents.training.checkpoint import (
    check_action,
    find_checkpoint,
    random_state,
    save_checkpoint,
    seed_everything,
    set_random_state,
)
from maexp.agents.training.collectors import Experience, WorkerLost, batch_statistics
from maexp.agents.training.logs import MetricsLog
from maexp.agents.training.prepare import describe_teams, describe_workers, make_both
from maexp.agents.training.validation import COLUMNS, ENDS, Validation, judged
from maexp.agents.versions import find_commit

CONFIG = "config.yaml"


def train(run: "TrainingRun") -> None:
    """Train until `total_frames`, from where `run` is; every file goes to its folder. Ends the run's collectors.

    On the CPU a run that is stopped and resumed gives bit for bit what an uninterrupted one gives.
    """
    cfg, learner, experience = run.cfg, run.learner, run.experience
    log = MetricsLog(run.folder, cfg.logger, kept=run.iteration, frames=run.frames, config=run.settings)
    with (
        closing(log),
        ending(experience),
        stop_on_signals() as stop,
        Progress("training", cfg.total_frames, run.frames) as progress,
    ):
        if run.iteration == 0:
            if cfg.evaluate_every:
                log.begin(run.start())
            run.save()
        last = run.iteration >= run.iterations
        while not last:
            with name_iteration(run):
                begin = time.perf_counter()
                batches = experience.next()
                row = batch_statistics(*batches, success_coverage=cfg.scenario.success_coverage)
                row |= learner.updater.update(*batches, progress=run.iteration / run.iterations)
                experience.update_policy_weights_()
                run.iteration += 1
                row |= run.validate_if_due()
                log.write(run.timed(row, begin))
                run.smooth(row["coverage"])
                last = bool(stop) or run.iteration == run.iterations  # a signal after this waits: the last one is saved
                run.keep(row, log, last)
            progress.show(min(run.frames, cfg.total_frames), run.describe())
    run.stopped = bool(stop)


@dataclass
class TrainingRun:
    """The parts of a run and how far it is.

    Attributes:
        best: highest value of `scored_by` so far
        average: running mean of the training's coverage, for the progress bar
        gains: the first and the latest of `Validation.row`
        seconds: training time so far, over all resumptions
    """

    cfg: TrainSettings
    folder: Path
    overrides: list[str]
    suite: MapSuite
    learner: Learner
    experience: Experience
    iteration: int = 0
    best: float = -math.inf
    average: float = math.nan
    gains: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0
    stopped: bool = False

    @classmethod
    def build(cls, cfg: TrainSettings, folder: Path, overrides: list[str], saved: dict | None = None) -> "TrainingRun":
        """Everything a run needs, at its start or as `saved` left it; nothing is written yet.

        Raises:
            UserError: a setting, map or checkpoint that cannot be used.
        """
        seed_everything(cfg.seed)
        with blame_input():
            suite = load_maps(cfg.scenario)
            learner, experience = make_both(cfg, suite.train)
            run = cls(cfg, folder, overrides, suite, learner, experience)
            if saved is not None:
                run.restore(saved)
            elif getattr(cfg.algorithm, "begin_from", None):
                run.begin_from(cfg.algorithm.begin_from)
        return run

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings with the values that they come to; the same however often the run was interrupted."""
        settings = resolve(self.cfg, self.suite.train)
        return {name: value for name, value in settings.items() if name != "resume"}

    @cached_property
    def validation(self) -> Validation:
        """The validation episodes of the run."""
        return Validation(judged(self.cfg), self.suite)

    @cached_property
    def checksums(self) -> dict[str, str]:
        """Of the maps trained on and held out, by their names."""
        return checksums(self.suite.train) | checksums(self.suite.held_out)

    @property
    def sizes(self) -> list[int]:
        """The team sizes, one or several."""
        return team_sizes(self.cfg.num_robots)

    @property
    def scored_by(self) -> str:
        """The column of metrics.csv that tells which checkpoint is the best."""
        return "validation_coverage_auc" if self.cfg.evaluate_every else "coverage"

    @property
    def batch_frames(self) -> int:
        """Macro steps of teams in one iteration."""
        if self.cfg.scenario.also:  # whose episodes differ in length
            return sum(collector.requested_frames_per_batch for collector in self.experience.collectors)
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
            "settings": self.settings,
            "followers": [name for name in self.cfg.followers if not name.startswith("collector.")],
            "commit": find_commit(),
            "maps": self.checksums,
            "iteration": self.iteration,
            "best": self.best,
            "scored_by": self.scored_by,
            "average": self.average,
            "gains": self.gains,
            "validation": self.validation.state_dict(),
            "seconds": self.seconds,
            "updater": self.learner.updater.state_dict(),
            "policy": self.learner.policy.state_dict(),
            "collector": self.experience.state_dict(),
            "teams": describe_teams(self.cfg),
            "workers": describe_workers(self.cfg),
            "random": random_state(),
        }
        return save_checkpoint(self.folder / "checkpoints", state, self.iteration, self.cfg.checkpoint_keep, best)

    def restore(self, saved: dict) -> None:
        """Go on where `save` was called."""
        check_action(saved, self.cfg)
        self.check_maps(saved)
        load_matching(self.learner.policy, saved["policy"])
        self.learner.updater.load_state_dict(saved["updater"])
        self.restore_experience(saved)
        self.iteration = saved["iteration"]
        self.best = saved["best"] if saved.get("scored_by") == self.scored_by else -math.inf
        self.average, self.seconds = saved["average"], saved["seconds"]
        self.restore_validation(saved)
        set_random_state(saved["random"])

    def begin_from(self, place: str) -> None:
        """Start with the policy and the branched decisions of another run; its optimizer and clock stay behind."""
        _, saved = find_checkpoint(place)
        if "memory" not in saved["updater"]:
            raise UserError(f"algorithm.begin_from={place} was not trained by expert iteration: it holds no branches.")
        check_action(saved, self.cfg)
        theirs = saved["settings"]["model"].get("starts_from", ModelConfig().starts_from)
        if theirs != (ours := self.cfg.model.starts_from):
            raise UserError(
                f"algorithm.begin_from={place} starts from {theirs}, and model.starts_from={ours}: leave that out."
            )
        load_matching(self.learner.policy, saved["policy"])
        self.learner.updater.load_memory(saved["updater"]["memory"])
        self.experience.update_policy_weights_()

    def restore_validation(self, saved: dict) -> None:
        """Go on with what the planners of `saved` did, where they would do the same."""
        self.gains = saved.get("gains", [])
        names = (*PLAYED, "classical", "evaluate_episodes")
        alike = all(saved["settings"].get(name) == self.settings.get(name) for name in names)
        if alike and saved["maps"] == self.checksums:
            self.validation.load_state_dict(saved.get("validation", {}))

    def check_maps(self, saved: dict) -> None:
        """Raise UserError where a map of the training is not what it was: what is known of it fits no more."""
        if changed := changed_maps(saved, self.suite.train):
            words = without(self.overrides, "warm_start", "resume")
            anew = command("train", *words, f"warm_start={short(self.folder)}")
            raise UserError(
                f"{changed} changed since the run was started, so that it cannot go on: put back what was there, or "
                f"begin a new run with what it has learned: {anew}"
            )

    def restore_experience(self, saved: dict) -> None:
        """Go on with the episodes of `saved`, or with new ones where other workers ran them."""
        before, now = saved["teams"], describe_teams(self.cfg)
        if before != now:
            raise UserError(f"The checkpoint was trained with {before}, not {now}: leave these settings as they were.")
        if saved["workers"] == describe_workers(self.cfg):
            self.experience.load_state_dict(saved["collector"])
            return
        warnings.warn(
            f"the checkpoint was written by {saved['workers']}, not by {describe_workers(self.cfg)}: new episodes "
            "begin, and the result differs from that of a run in one go",
            stacklevel=2,
        )
        self.experience.update_policy_weights_()

    def start(self) -> dict[str, float]:
        """The row of a run that has not begun."""
        row = self.validate_if_due()
        self.seconds += row["time_validation"]
        return {"iteration": 0, "frames": 0} | row | {"seconds": round(self.seconds, 3)}

    def validate_if_due(self) -> dict[str, float]:
        """`Validation.row` every `evaluate_every` iterations, else NaN."""
        every = self.cfg.evaluate_every
        if not every or self.iteration % every:
            return dict.fromkeys(COLUMNS, math.nan) | {"time_validation": 0.0}
        begin = time.perf_counter()
        row = self.validation.row(self.learner.policy)
        self.gains = [*self.gains[:1], row]
        return row | {"time_validation": round(time.perf_counter() - begin, 4)}

    def keep(self, row: dict[str, float], log: MetricsLog, last: bool) -> None:
        """Save when it is time to, or when the validation is the best so far."""
        score, due = row[self.scored_by], self.iteration % self.cfg.checkpoint_every == 0
        validated = bool(self.cfg.evaluate_every)
        best = (validated or due) and score > self.best  # never where a run happens to stop; false for NaN
        if last or due or (best and validated):
            log.sync()
            self.best = score if best else self.best
            self.save(best)

    def smooth(self, coverage: float) -> None:
        """Running mean of the coverage; iterations where no episode ended do not count."""
        if not math.isnan(coverage):
            self.average = coverage if math.isnan(self.average) else 0.9 * self.average + 0.1 * coverage

    def describe(self) -> str:
        """What has been learned so far, for the progress bar."""
        if not self.gains or not self.validation.rival:
            return f"coverage {self.average:.3f}"
        (first, *_), last = self.gains, self.gains[-1]
        now, *ends = (last[f"validation_gain{end}"] for end in ENDS)
        interval = brackets({"ci95": ends}, "{:+.1f}".format)
        so_far = f"{now:+.1f} points{interval}, at the start {first['validation_gain']:+.1f}"
        return f"gain over {self.validation.rival} {so_far}"

    def timed(self, row: dict[str, float], begin: float) -> dict[str, float]:
        """The row with its place in the run in front, and where the time since `begin` went at the end."""
        spent = time.perf_counter() - begin
        self.seconds += spent
        times = self.experience.seconds | {name: row.pop(name) for name in ("advantage", "update")}
        validating = row.pop("time_validation")
        return (
            {"iteration": self.iteration, "frames": self.frames}
            | row
            | {"policy_lag": self.experience.lag}
            | {f"time_{name}": round(seconds, 4) for name, seconds in times.items()}
            | {"time_validation": validating}
            | {"frames_per_second": round(self.batch_frames / (spent - validating), 2)}
            | {"seconds": round(self.seconds, 3)}
        )


@contextmanager
def name_iteration(run: TrainingRun) -> Iterator[None]:
    """A loss that became NaN or infinite, or a lost worker, ends the run with its name; the checkpoints stay."""
    number = run.iteration + 1
    try:
        yield
    except (ArithmeticError, WorkerLost) as error:
        raise UserError(
            f"Training stopped in iteration {number}: {error} The last good checkpoint is kept in "
            f"{run.folder / 'checkpoints'}."
        ) from error


@contextmanager
def ending(experience: Experience) -> Iterator[None]:
    """Ends the collectors, however the training ends."""
    try:
        yield
    finally:
        experience.shutdown()


def write_config(settings: dict, folder: Path, verb: str, overrides: list[str], note: str = "", **others: Any) -> None:
    """config.yaml: command, commit and a note as comments, then all settings with their values, then `others`."""
    command = f"# maexp {verb} {' '.join(overrides)}".rstrip()
    commit = f"# commit {find_commit()}\n" if find_commit() else ""
    note = f"# {note}\n" if note else ""
    write_text(folder / CONFIG, f"{command}\n{commit}{note}{to_yaml(settings | others, verb)}")
