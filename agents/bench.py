"""Throughput: of the whole env, of one env as in the paper's table, and of every kernel."""

import json
import os
import platform
import statistics
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from maexp.agents.build import load_maps, make_env
from maexp.agents.checks import team_sizes
from maexp.agents.progress import Progress
from maexp.agents.results import PACKAGES, find_commit
from maexp.envs import ExplorationEnv
from maexp.kernels.state import memory_per_env

TEAM_SIZES = [2, 4, 6, 8]
PAPER_SECONDS_PER_STEP = {
    "MAANS (paper)": {2: 0.4497, 4: 0.9319, 6: 1.3675, 8: 1.9354},
    "Explore-Bench (paper)": {2: 3.8586, 4: 6.6381, 6: 8.6575, 8: 10.9880},
    "MAexp 2024, GPU (paper)": {2: 0.0144, 4: 0.0254, 6: 0.0373, 8: 0.0477},
}


def bench_env(cfg: Any, where: Path) -> None:
    """Robot-local-steps and macro steps per second by team size; ``where/bench_env.json`` and a table.

    A robot-local-step holds planner, motion, collision, radar, merging and reward; the observation is drawn once
    a macro step, and envs that end are reset, all within the measured time. Steps of frozen envs do not count.
    """
    sizes = team_sizes(cfg.num_robots) if cfg.num_robots is not None else TEAM_SIZES
    maps = load_maps(cfg.scenario).train
    rows = []
    with Progress("measuring", 2 * len(sizes), 0) as progress:
        for k, size in enumerate(sizes):
            rows.append(measure_batch(cfg, maps, size))
            progress.show(2 * k + 1, f"{size} robots")
            rows[-1]["seconds_per_step_one_env"] = measure_latency(cfg, maps, size)
            progress.show(2 * k + 2, f"{size} robots")
    _write(where / "bench_env.json", cfg, rows)
    console = Console()
    console.print(f"throughput: scenario={cfg.scenario.name}, {cfg.num_envs} envs, {rows[0]['threads']} CPU threads")
    table = Table()
    for name in ("N", "robot-local-steps/s", "per thread", "macro/s", "MB/env", "start [s]"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            str(row["num_robots"]),
            f"{row['robot_local_steps_per_second']:,.0f}",
            f"{row['robot_local_steps_per_second_and_thread']:,.0f}",
            f"{row['macro_steps_per_second']:,.0f}",
            f"{row['memory_per_env'] / 1e6:.2f}",
            f"{row['first_step_seconds']:.1f}",
        )
    console.print(table)
    console.print("seconds per local step of one env, beside the paper's table")
    console.print(latency_table(rows))
    console.print(f"written to {where / 'bench_env.json'}")


def latency_table(rows: list[dict]) -> Table:
    """The paper's table II: seconds per local step of one env."""
    table = Table()
    table.add_column("platform")
    for row in rows:
        table.add_column(f"N = {row['num_robots']}", justify="right")
    for name, published in PAPER_SECONDS_PER_STEP.items():
        cells = [published.get(row["num_robots"]) for row in rows]
        table.add_row(name, *("-" if cell is None else f"{cell:.4f}" for cell in cells))
    table.add_row("this machine", *(f"{r['seconds_per_step_one_env']:.6f}" for r in rows))
    return table


def measure_batch(cfg: Any, maps: list, num_robots: int) -> dict:
    """Throughput of one team size, compile time apart, over at least ``cfg.seconds``."""
    begin = time.perf_counter()
    env = make_env(cfg, maps, num_robots)
    built = time.perf_counter() - begin
    begin = time.perf_counter()
    state = env.reset()
    actions = [env.rand_action(state.clone())["agents", "action"] for _ in range(8)]
    state = _advance(env, state, actions[0])
    first = time.perf_counter() - begin
    done, seconds, rates = 0, 0.0, []
    while seconds < cfg.seconds or len(rates) < 5:
        begin = time.perf_counter()
        steps, state = _advance_counted(env, state, actions[len(rates) % 8])
        lap = time.perf_counter() - begin
        done, seconds = done + steps, seconds + lap
        rates.append(steps * num_robots / lap)
    threads = len(env.simulation.shards)
    rate = done * num_robots / seconds
    return {
        "num_robots": num_robots,
        "num_envs": cfg.num_envs,
        "threads": threads,
        "robot_local_steps_per_second": rate,
        "robot_local_steps_per_second_and_thread": rate / threads,
        "median_of_laps": statistics.median(rates),
        "macro_steps_per_second": cfg.num_envs * len(rates) / seconds,
        "laps": len(rates),
        "seconds": seconds,
        "build_seconds": built,
        "first_step_seconds": first,
        "memory_per_env": sum(memory_per_env(env.simulation.sizes).values()),
        "collided_at_end": env.simulation.tensors["collided"].float().mean().item(),
    }


def measure_latency(cfg: Any, maps: list, num_robots: int, macro_steps: int = 10) -> float:
    """Seconds per local step of a single env: the paper's measure."""
    env = make_env(cfg, maps[:1], num_robots, num_envs=1)
    state = env.reset()
    action = env.rand_action(state.clone())["agents", "action"]
    state = _advance(env, state, action)
    laps = []
    for _ in range(macro_steps):
        begin = time.perf_counter()
        steps, state = _advance_counted(env, state, action)
        laps.append((time.perf_counter() - begin) / max(steps, 1))
    return statistics.median(laps)


def _advance(env: ExplorationEnv, state, action):
    return env.step_and_maybe_reset(state.set(("agents", "action"), action))[1]


def _advance_counted(env: ExplorationEnv, state, action) -> tuple[int, Any]:
    """One macro step with resets; also the local steps that envs ran in it (frozen ones run none)."""
    before = env.simulation.tensors["local_step"].clone()
    stepped, state = env.step_and_maybe_reset(state.set(("agents", "action"), action))
    steps = int((stepped["next", "info", "local_steps"].squeeze(-1) - before).sum())
    if env.device.type == "cuda":
        torch.cuda.synchronize(env.device)
    return steps, state


def bench_kernels(cfg: Any, where: Path) -> None:
    """Time of every kernel of a local step, in place, by team size; ``where/bench_kernels.json`` and a table."""
    sizes = team_sizes(cfg.num_robots) if cfg.num_robots is not None else TEAM_SIZES
    maps = load_maps(cfg.scenario).train
    columns = {size: kernel_times(cfg, maps, size) for size in sizes}
    rows = [{"num_robots": size, "microseconds_per_robot": times} for size, times in columns.items()]
    _write(where / "bench_kernels.json", cfg, rows)
    Console().print(f"us per robot and launch: scenario={cfg.scenario.name}, {cfg.num_envs} envs, one thread")
    table = Table()
    table.add_column("kernel")
    for size in sizes:
        table.add_column(f"N = {size}", justify="right")
    for name in columns[sizes[0]]:
        table.add_row(name, *(f"{columns[size][name]:.3f}" for size in sizes))
    table.add_row("sum", *(f"{sum(columns[size].values()):.3f}" for size in sizes), style="bold")
    Console().print(table)
    Console().print(f"written to {where / 'bench_kernels.json'}")


def kernel_times(cfg: Any, maps: list, num_robots: int, warm: int = 3) -> dict[str, float]:
    """Median time of every launch of a local step over ``cfg.seconds`` [us per robot], after ``warm`` macro steps."""
    env = make_env(cfg, maps, num_robots)
    shard = env.simulation.shards[0]
    state = env.reset()
    for _ in range(warm):
        state = _advance(env, state, env.rand_action(state.clone())["agents", "action"])
    laps: dict[str, list[float]] = {}
    end = time.perf_counter() + cfg.seconds / 2
    while time.perf_counter() < end:
        for command in shard.step_launches:
            begin = time.perf_counter()
            command.launch()
            if env.device.type == "cuda":
                torch.cuda.synchronize(env.device)
            laps.setdefault(command.kernel.key.lstrip("_"), []).append(time.perf_counter() - begin)
    robots = (shard.last - shard.first) * num_robots
    return {name: 1e6 * statistics.median(times) / robots for name, times in laps.items()}


def _write(path: Path, cfg: Any, rows: list[dict]) -> None:
    report = {
        "machine": {"cpu": _cpu_name(), "cores": os.cpu_count(), "python": platform.python_version()},
        "device": str(cfg.device),
        "scenario": cfg.scenario.name,
        "commit": find_commit(),
        "versions": {name: metadata.version(name) for name in PACKAGES},
        "rows": rows,
    }
    aside = path.with_suffix(".tmp")
    aside.write_text(json.dumps(report, indent=2) + "\n")
    os.replace(aside, path)


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
