"""`maexp bench train`: where the time of a training iteration goes, over algorithms, networks and team sizes."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from maexp.agents.benchmarks.throughput.shared import describe_point, spread, sweep_points, write_report
from maexp.agents.build import Learner, load_maps, make_env, make_learner, set_steps
from maexp.agents.config.model import SIZES
from maexp.agents.config.verbs import BenchSettings, TrainSettings
from maexp.agents.memory import check_batch_memory
from maexp.agents.progress import Progress
from maexp.agents.tables import print_table
from maexp.agents.training.checkpoint import seed_everything
from maexp.agents.training.collectors import Stopwatch, TeamCollector, make_collector
from maexp.agents.training.prepare import make_actor
from maexp.envs import ExplorationEnv

TEAM_SIZES = [3]
LEAST_ITERATIONS = 3
PARTS = ("simulate", "policy", "advantage", "update")


@dataclass
class Trainee:
    """What is trained at one point, and the seconds of its iterations by part."""

    cfg: TrainSettings
    env: ExplorationEnv
    learner: Learner
    collector: TeamCollector
    laps: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def build(cls, cfg: TrainSettings) -> "Trainee":
        """Raises what `maexp train` would: a setting or map that cannot be used."""
        seed_everything(cfg.seed)
        env = make_env(cfg, load_maps(cfg.scenario).train, cfg.num_robots)
        check_batch_memory(env, set_steps(cfg, env))
        learner = make_learner(cfg, env)
        actor = make_actor(cfg, learner.policy, env)
        return cls(cfg, env, learner, make_collector(env, actor, cfg.collector.steps))

    def iterate(self) -> None:
        """Collect a batch and learn from it, as in training."""
        begin = time.perf_counter()
        with Stopwatch(self.learner.policy) as acting:
            batch = self.collector.next()
        collected = time.perf_counter() - begin
        logged = self.learner.updater.update(batch)
        self.collector.update_policy_weights_()
        if self.env.device.type == "cuda":
            torch.cuda.synchronize(self.env.device)
        self.laps.append(
            {"simulate": collected - acting.seconds, "policy": acting.seconds}
            | {name: logged[name] for name in ("advantage", "update")}
            | {"iteration": time.perf_counter() - begin}
        )

    def row(self) -> dict:
        """What was trained, and how long its parts took."""
        laps = self.laps[1:]  # the first one warms up
        seconds = {name: spread([lap[name] for lap in laps]) for name in laps[0]}
        cfg, networks = self.cfg, (self.learner.policy, self.learner.critic)
        steps = self.env.num_envs * cfg.collector.steps
        return describe_point(self.env, cfg) | {
            "algorithm": cfg.algorithm.name,
            "model": _model_name(cfg),
            "parameters": sum(parameter.numel() for network in networks for parameter in network.parameters()),
            "macro_steps": steps,
            "iterations": len(laps),
            "seconds": seconds,
            "robot_macro_steps_per_second": steps * self.env.num_robots / seconds["iteration"]["median"],
        }


def _model_name(cfg: TrainSettings) -> str:
    """The name of these sizes."""
    sizes = replace(cfg.model, action="regions")
    return next((name for name, size in SIZES.items() if size == sizes), "own")


def run(cfg: BenchSettings, where: Path, overrides: list[str]) -> None:
    """Seconds of an iteration by part at every point; ``where/bench_train.json`` and a table.

    The points take turns, one iteration each, so that what else the machine does meets all of them alike.
    """
    trainees = [Trainee.build(point) for point in sweep_points(cfg, overrides, TEAM_SIZES, verb="train")]
    end = time.perf_counter() + cfg.seconds * len(trainees)
    done = 0
    with Progress("iterations of each", LEAST_ITERATIONS + 1, 0) as progress:
        while done <= LEAST_ITERATIONS or time.perf_counter() < end:
            for trainee in trainees:
                trainee.iterate()
            done += 1
            progress.show(min(done, LEAST_ITERATIONS + 1))
    rows = [trainee.row() for trainee in trainees]
    slowest = min(row["robot_macro_steps_per_second"] for row in rows)
    for row in rows:
        row["times_the_slowest"] = row["robot_macro_steps_per_second"] / slowest
    print_rows(rows)
    write_report(where / "bench_train.json", "bench_train", trainees[0].env.device, {"rows": rows})


def print_rows(rows: list[dict]) -> None:
    """One line a point: median seconds of the parts and of the whole iteration."""
    first = rows[0]
    title = (
        f"seconds of a training iteration ({first['macro_steps']} macro steps of teams, scenario={first['scenario']}), "
        "robot-macro-steps/s"
    )
    columns = ["algorithm", "model", "N", "weights", *PARTS, "iteration", "robot-steps/s", "x slowest"]
    cells = [
        [
            row["algorithm"],
            row["model"],
            str(row["num_robots"]),
            f"{row['parameters']:,}",
            *(f"{row['seconds'][name]['median']:.3f}" for name in PARTS),
            f"{row['seconds']['iteration']['median']:.3f}",
            f"{row['robot_macro_steps_per_second']:,.0f}",
            f"{row['times_the_slowest']:.2f}",
        ]
        for row in rows
    ]
    print_table(title, columns, cells)
