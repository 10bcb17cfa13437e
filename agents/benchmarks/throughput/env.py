"""`maexp bench env`: throughput of the whole env, and of one env as in the paper's table."""

import statistics
import time
from pathlib import Path
from typing import Any

import torch

from maexp.agents.benchmarks.throughput.shared import LEAST_LAPS, describe_point, sweep_points, write_report
from maexp.agents.build import load_maps, make_env
from maexp.agents.config.verbs import BenchSettings
from maexp.agents.progress import Progress
from maexp.agents.tables import print_table
from maexp.envs import ExplorationEnv

TEAM_SIZES = [2, 4, 6, 8]
PAPER_SECONDS_PER_STEP = {
    "MAANS (paper)": {2: 0.4497, 4: 0.9319, 6: 1.3675, 8: 1.9354},
    "Explore-Bench (paper)": {2: 3.8586, 4: 6.6381, 6: 8.6575, 8: 10.9880},
    "MAexp 2024, GPU (paper)": {2: 0.0144, 4: 0.0254, 6: 0.0373, 8: 0.0477},
}
COLUMNS = [
    "scenario",
    "planner",
    "range [m]",
    "envs",
    "N",
    "robot-local-steps/s",
    "per thread",
    "macro/s",
    "MB/env",
    "start [s]",
]
WARM_LAPS = 4
"""Macro steps before the clock starts: the first few fill memory that the later ones use again (300 robots: twice the
time a step)."""


def run(cfg: BenchSettings, where: Path, overrides: list[str]) -> None:
    """Robot-local-steps and macro steps per second at every point; ``where/bench_env.json`` and tables.

    A robot-local-step holds planner, motion, collision, radar, merging and reward; the observation is drawn once
    a macro step, and envs that end are reset, all within the measured time. Steps of frozen envs do not count.
    """
    points = sweep_points(cfg, overrides, TEAM_SIZES)
    rows = []
    with Progress("measuring", len(points), 0) as progress:
        for point in points:
            maps = load_maps(point.scenario).train
            rows.append(measure_batch(point, make_env(point, maps, point.num_robots)))
            rows[-1]["seconds_per_step_one_env"] = measure_latency(point, maps)
            progress.show(len(rows), f"{point.num_envs} envs of {point.num_robots} robots")
    print_rows(f"throughput of the simulation, {rows[0]['threads']} CPU threads", rows)
    if len({(row["scenario"], row["radar_range"]) for row in rows}) == 1:
        print_latency(rows)
    write_report(where / "bench_env.json", "bench_env", cfg.device, {"rows": rows})


def print_rows(title: str, rows: list[dict]) -> None:
    """One line a point."""
    cells = [
        [
            row["scenario"],
            row["planner"],
            f"{row['radar_range']:g}",
            str(row["num_envs"]),
            str(row["num_robots"]),
            f"{row['robot_local_steps_per_second']:,.0f}",
            f"{row['robot_local_steps_per_second_and_thread']:,.0f}",
            f"{row['macro_steps_per_second']:,.1f}",
            f"{row['memory_per_env'] / 1e6:.2f}",
            f"{row['first_step_seconds']:.1f}",
        ]
        for row in rows
    ]
    print_table(title, COLUMNS, cells)


def print_latency(rows: list[dict]) -> None:
    """The paper's table III beside ours: seconds per local step of one env, by team size."""
    sizes = list(dict.fromkeys(row["num_robots"] for row in rows))
    cells = [
        [name, *("-" if size not in published else f"{published[size]:.4f}" for size in sizes)]
        for name, published in PAPER_SECONDS_PER_STEP.items()
    ]
    for planner in dict.fromkeys(row["planner"] for row in rows):
        ours = {row["num_robots"]: row["seconds_per_step_one_env"] for row in rows if row["planner"] == planner}
        cells.append([f"this machine, {planner}", *(f"{ours[size]:.6f}" for size in sizes)])
    title = "seconds per local step of one env, beside the paper's table"
    print_table(title, ["platform", *(f"N = {size}" for size in sizes)], cells)


class MeasuredBatch:
    """A batch of teams whose throughput is measured, compile time apart.

    Args:
        cfg: the settings of the point
        env: an env with those settings
    """

    def __init__(self, cfg: BenchSettings, env: ExplorationEnv):
        self.cfg, self.env = cfg, env
        begin = time.perf_counter()
        torch.manual_seed(cfg.seed)
        self.state = env.reset()
        self.actions = [env.rand_action(self.state.clone())["agents", "action"] for _ in range(8)]
        self.state = advance(env, self.state, self.actions[0])
        self.first = time.perf_counter() - begin
        for lap in range(WARM_LAPS):
            self.state = advance(env, self.state, self.actions[lap + 1])
        self.done, self.seconds = 0, 0.0
        self.rates: list[float] = []
        self.costs: list[float] = []

    def run(self, seconds: float, laps: int) -> None:
        """Macro steps until that many seconds were measured in all, and that many laps."""
        while self.seconds < seconds or len(self.rates) < laps:
            begin, used = time.perf_counter(), time.process_time()
            steps, self.state = advance_counted(self.env, self.state, self.actions[len(self.rates) % 8])
            lap, used = time.perf_counter() - begin, time.process_time() - used
            self.done, self.seconds = self.done + steps, self.seconds + lap
            self.rates.append(steps * self.env.num_robots / lap)
            self.costs.append((used if self.env.device.type == "cpu" else lap) / max(steps, 1))

    def summary(self) -> dict:
        """What was measured.

        ``seconds_per_local_step`` of the whole batch is processor time on the CPU, summed over its threads: unlike
        the rates it does not depend on what else runs on the machine.
        """
        env, threads = self.env, len(self.env.simulation.shards)
        rate = self.done * env.num_robots / self.seconds
        return describe_point(env, self.cfg) | {
            "threads": threads,
            "robot_local_steps_per_second": rate,
            "robot_local_steps_per_second_and_thread": rate / threads,
            "median_of_laps": statistics.median(self.rates),
            "seconds_per_local_step": statistics.median(self.costs) * env.num_envs,
            "macro_steps_per_second": env.num_envs * len(self.rates) / self.seconds,
            "laps": len(self.rates),
            "seconds": self.seconds,
            "first_step_seconds": self.first,
            "memory_per_env": env.space.bytes_per_env(env.settings, env.bank),
            "collided_at_end": env.simulation.tensors["collided"].float().mean().item(),
        }


def measure_batch(cfg: BenchSettings, env: ExplorationEnv) -> dict:
    """Throughput of a batch over at least ``cfg.seconds``."""
    batch = MeasuredBatch(cfg, env)
    batch.run(cfg.seconds, LEAST_LAPS)
    return batch.summary()


def measure_latency(cfg: BenchSettings, maps: list, macro_steps: int = 10) -> float:
    """Seconds per local step of a single env: the paper's measure."""
    env = make_env(cfg, maps[:1], cfg.num_robots, num_envs=1)
    state = env.reset()
    action = env.rand_action(state.clone())["agents", "action"]
    state = advance(env, state, action)
    laps = []
    for _ in range(macro_steps):
        begin = time.perf_counter()
        steps, state = advance_counted(env, state, action)
        laps.append((time.perf_counter() - begin) / max(steps, 1))
    return statistics.median(laps)


def advance(env: ExplorationEnv, state, action):
    """One macro step; envs that end are reset."""
    return env.step_and_maybe_reset(state.set(("agents", "action"), action))[1]


def advance_counted(env: ExplorationEnv, state, action) -> tuple[int, Any]:
    """One macro step with resets; also the local steps that envs ran in it (frozen ones run none)."""
    before = env.simulation.tensors["local_step"].clone()
    stepped, state = env.step_and_maybe_reset(state.set(("agents", "action"), action))
    steps = int((stepped["next", "info", "local_steps"].squeeze(-1) - before).sum())
    if env.device.type == "cuda":
        torch.cuda.synchronize(env.device)
    return steps, state
