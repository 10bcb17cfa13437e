"""`maexp bench kernels`: every kernel alone and in place.

In place: the launches of a macro step follow each other as in a run, each timed by itself. Alone: one launch
again and again, its outputs put back in between, so that its data lie as near as they can. Both start from the same
moment of the same episodes, so that two measurements differ by the machine and the code only. On the CPU times are
those of the thread, without waits for other programs; caches that those emptied still show.
"""

import importlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp

from maexp.agents.benchmarks.throughput.env import advance
from maexp.agents.benchmarks.throughput.shared import (
    LEAST_LAPS,
    describe_point,
    spread,
    sweep_points,
    time_call,
    write_report,
)
from maexp.agents.build import load_maps, make_env, pick_device
from maexp.agents.config.verbs import BenchSettings
from maexp.agents.errors import UserError
from maexp.agents.progress import Progress
from maexp.agents.tables import TableCell, print_table
from maexp.envs import ExplorationEnv
from maexp.kernels.launches import RecordedLaunch, current_stream
from maexp.kernels.observe import picture_shapes
from maexp.kernels.planner import find_paths, pick_waypoints, set_goals
from maexp.kernels.shards import Shard
from maexp.kernels.step import local_step, observe, reset
from maexp.kernels.types import REGIONS

TEAM_SIZES = [4]
WARM = 3  # macro steps before the moment that is measured
NOISE = 1.5
"""Medians this far apart, with no overlap from the tenth to the ninetieth percentile, are called a change.

Two runs of the same code on a busy machine differ by up to 1.25 in kernels above a microsecond.
"""
STAGES = ("goal", "plan path", "local step", "observe", "reset")
COPY_BYTES = 2**28
MATRIX = 1536
MODULES = (
    "braking",
    "collision",
    "dwa",
    "dynamics",
    "geodesic",
    "merge",
    "neighbours",
    "observe",
    "occupancy_grid",
    "planner",
    "reset",
    "reward",
    "speed_limits",
    "traversability",
    "visibility",
    "wavefront",
)
KEY = ("scenario", "planner", "num_envs", "num_robots", "radar_range", "stage", "kernel")


@dataclass
class Step:
    """A recorded launch and the arrays that it takes."""

    stage: str
    kernel: str
    command: RecordedLaunch
    arrays: list[wp.array]


def run(cfg: BenchSettings, where: Path, overrides: list[str]) -> None:
    """Times of every kernel at every point; ``where/bench_kernels.json`` and tables."""
    points = sweep_points(cfg, overrides, TEAM_SIZES)
    before = load_baseline(cfg.baseline) if cfg.baseline else None
    device = pick_device(cfg.device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # kernels are timed on one thread
    ceilings = measure_ceilings(device)
    loading = load_modules(device)
    rows = []
    with Progress("measuring", len(points), 0) as progress:
        for point in points:
            env = make_env(point, load_maps(point.scenario).train, point.num_robots)
            rows.append(measure_kernels(env, point))
            progress.show(len(rows), f"{point.num_envs} envs of {point.num_robots} robots")
    torch.set_num_threads(threads)
    flat = [row for group in rows for row in group]
    if before is not None:
        compare(flat, before)
    print_ceilings(ceilings, loading, before)
    for group in rows:
        print_kernels(group, before is not None)
    report = {"ceilings": ceilings, "load_seconds": loading, "noise": NOISE, "baseline": cfg.baseline, "rows": flat}
    write_report(where / "bench_kernels.json", "bench_kernels", cfg.device, report)


def measure_ceilings(device: torch.device, laps: int = 9) -> dict[str, float]:
    """What one thread (or the GPU) copies and multiplies: the median over a few laps [bytes/s, operations/s]."""
    source = torch.ones(COPY_BYTES // 4, device=device)
    target = torch.zeros_like(source)
    left = torch.rand(MATRIX, MATRIX, device=device)
    out = torch.zeros_like(left)
    copy = lambda: target.copy_(source)  # noqa: E731
    product = lambda: torch.mm(left, left, out=out)  # noqa: E731
    seconds = {}
    for name, call in (("copy", copy), ("product", product)):
        call()
        seconds[name] = spread([time_call(call, device) for _ in range(laps)])["median"]
    return {
        "copy_bytes_per_second": 2 * COPY_BYTES / seconds["copy"],
        "fma_operations_per_second": 2 * MATRIX**3 / seconds["product"],
    }


def load_modules(device: torch.device) -> dict[str, float]:
    """Seconds to compile each module of kernels, or to load it from the cache, before anything is timed."""
    where = wp.device_from_torch(device)
    seconds = {}
    for name in MODULES:
        module = importlib.import_module(f"maexp.kernels.{name}")
        begin = time.perf_counter()
        wp.load_module(module, device=where)
        seconds[name] = time.perf_counter() - begin
    return seconds


def measure_kernels(env: ExplorationEnv, cfg: BenchSettings) -> list[dict]:
    """One row per kernel and stage of the first shard, at a moment some macro steps into the first episodes.

    A launch takes all envs of the shard at once; a run goes through them block by block, with warmer caches.
    """
    torch.manual_seed(cfg.seed)
    state = env.reset()
    for _ in range(WARM):
        state = advance(env, state, env.rand_action(state.clone())["agents", "action"])
    shard = env.simulation.shards[0]
    steps = record_steps(env, shard)
    stream = current_stream(shard.device)
    run = Runner(env.device, stream)
    in_place, alone = run.in_place(steps, cfg.seconds / 2), run.alone(steps, cfg.seconds / 2)
    robots = (shard.last - shard.first) * env.num_robots
    rows = []
    for stage, kernel in dict.fromkeys((step.stage, step.kernel) for step in steps):
        mine = [k for k, step in enumerate(steps) if (step.stage, step.kernel) == (stage, kernel)]
        row = describe_point(env, cfg) | {"stage": stage, "kernel": kernel.lstrip("_"), "launches": len(mine)}
        for name, laps in (("in_place", in_place), ("alone", alone)):
            summed = [sum(together) for together in zip(*(laps[k] for k in mine), strict=False)]
            row[f"{name}_us"] = {figure: 1e6 * seconds for figure, seconds in spread(summed).items()}
        rows.append(row | {"robots": robots})
    return rows


def record_steps(env: ExplorationEnv, shard: Shard) -> list[Step]:
    """Every launch of a macro step with one local step in it, then those of an observation and of a reset."""
    steps: list[Step] = []
    stage = STAGES[0]

    def launch(kernel, dim, arguments):
        arrays = [argument for argument in arguments if isinstance(argument, wp.array) and argument.ptr]
        steps.append(Step(stage, kernel.key, RecordedLaunch(kernel, dim, arguments, shard.device), arrays))

    set_goals(launch, shard)
    stage = STAGES[1]
    find_paths(launch, shard)
    pick_waypoints(launch, shard)
    stage = STAGES[2]
    local_step(launch, shard)
    stage = STAGES[3]
    e, n, r = env.num_envs, env.num_robots, REGIONS
    pictures = [torch.zeros(s, dtype=torch.uint8, device=env.device) for s in picture_shapes(e, n)]
    poses = [torch.empty(s, device=env.device) for s in ((e, n, 4), (e, n, 4, r, r))]
    observe(launch, shard, *pictures, *poses)
    stage = STAGES[4]
    env.simulation.tensors["mask"].fill_(1)
    reset(launch, shard)
    return steps


class Runner:
    """Times launches on a device."""

    def __init__(self, device: torch.device, stream: Any):
        self.device, self.stream = device, stream

    def time(self, step: Step) -> float:
        return time_call(lambda: step.command.launch(self.stream), self.device)

    def in_place(self, steps: list[Step], seconds: float) -> list[list[float]]:
        """Laps over all launches in their order, from the same state."""
        saved = self.save(steps)
        laps: list[list[float]] = [[] for _ in steps]
        end = time.perf_counter() + seconds
        while time.perf_counter() < end or len(laps[0]) <= LEAST_LAPS:
            for k, step in enumerate(steps):
                laps[k].append(self.time(step))
            restore(saved)
        return [lap[1:] for lap in laps]  # the first lap warms up

    def alone(self, steps: list[Step], seconds: float) -> list[list[float]]:
        """Laps of every launch by itself, its outputs put back after each."""
        saved = self.save(steps)
        laps = []
        for step in steps:
            outputs = self.save([step])
            mine: list[float] = []
            end = time.perf_counter() + seconds / len(steps)
            while time.perf_counter() < end or len(mine) <= LEAST_LAPS:
                mine.append(self.time(step))
                restore(outputs)
            laps.append(mine[1:])
            step.command.launch(self.stream)
        restore(saved)
        return laps

    def save(self, steps: list[Step]) -> list[tuple[wp.array, wp.array]]:
        """Every array that the launches change, and a copy of it; the arrays are as they were."""
        arrays = {array.ptr: array for step in steps for array in step.arrays}
        copies = [(array, wp.clone(array)) for array in arrays.values()]
        for step in steps:
            step.command.launch(self.stream)
        changed = [(array, copy) for array, copy in copies if array.numpy().tobytes() != copy.numpy().tobytes()]
        restore(changed)
        return changed


def restore(saved: list[tuple[wp.array, wp.array]]) -> None:
    for array, copy in saved:
        wp.copy(array, copy)


def load_baseline(path: str) -> dict:
    """An earlier report.

    Raises:
        UserError: no such file, or another kind of file.
    """
    try:
        report = json.loads(Path(path).expanduser().read_text())
        rows = {tuple(row[name] for name in KEY): row["in_place_us"] for row in report["rows"]}
        good = report["kind"] == "bench_kernels" and all({"median", "p10", "p90"} <= set(row) for row in rows.values())
    except OSError as error:
        raise UserError(f"baseline={path} cannot be read ({error.strerror}): give a bench_kernels.json.") from error
    except (ValueError, KeyError, TypeError):
        good = False
    if not good:
        raise UserError(f"baseline={path} is no report of maexp bench kernels: give a bench_kernels.json.")
    return report | {"by_key": rows}


def compare(rows: list[dict], before: dict) -> None:
    """Write the ratio to the earlier time into every row that it has too, and whether it is a change.

    Raises:
        UserError: the two have no row in common.
    """
    shared = 0
    for row in rows:
        old, now = before["by_key"].get(tuple(row[name] for name in KEY)), row["in_place_us"]
        row["ratio"], row["changed"] = None, False
        if old is not None:
            shared += 1
            row["ratio"] = now["median"] / old["median"]
            apart = now["p10"] > old["p90"] or now["p90"] < old["p10"]
            row["changed"] = apart and not 1 / NOISE < row["ratio"] < NOISE
    if not shared:
        raise UserError("The baseline has no row in common with this run: measure the same scenario, team and batch.")


def print_ceilings(ceilings: dict[str, float], loading: dict[str, float], before: dict | None) -> None:
    """The machine's ceilings, beside those of the baseline, and the time to compile or load."""
    rows = [
        ["copy [GB/s]", f"{ceilings['copy_bytes_per_second'] / 1e9:.1f}"],
        ["multiply-add [GFLOP/s]", f"{ceilings['fma_operations_per_second'] / 1e9:.1f}"],
        ["compile or load kernels [s]", f"{sum(loading.values()):.1f}"],
    ]
    if before is not None:
        rows[0].append(f"{before['ceilings']['copy_bytes_per_second'] / 1e9:.1f}")
        rows[1].append(f"{before['ceilings']['fma_operations_per_second'] / 1e9:.1f}")
        rows[2].append(f"{sum(before['load_seconds'].values()):.1f}")
    print_table("one thread of this machine", ["", "now"] + ["baseline"] * (before is not None), rows)


def print_kernels(rows: list[dict], compared: bool) -> None:
    """The table of one point; times are per robot."""
    row = rows[0]
    title = (
        f"us per robot: scenario={row['scenario']}, {row['planner']}, {row['num_envs']} envs of {row['num_robots']} "
        f"robots, radar {row['radar_range']:g} m"
    )
    columns = ["kernel", "in place", "p10..p90", "alone"]
    cells = []
    for stage in dict.fromkeys(row["stage"] for row in rows):
        mine = [row for row in rows if row["stage"] == stage]
        cells += [kernel_cells(row, compared) for row in mine]
        total = sum(row["in_place_us"]["median"] / row["robots"] for row in mine)
        cells.append([TableCell(text, bold=True).terminal() for text in (f"= {stage}", f"{total:.3f}")])
    if compared:
        columns.append("ratio")
        title += f"; ratio to the baseline, ! beyond {NOISE} and the spread"
    print_table(title, columns, cells)


def kernel_cells(row: dict, compared: bool) -> list[str]:
    robots, place = row["robots"], row["in_place_us"]
    cells = [
        row["kernel"],
        f"{place['median'] / robots:.3f}",
        f"{place['p10'] / robots:.3f}..{place['p90'] / robots:.3f}",
        f"{row['alone_us']['median'] / robots:.3f}",
    ]
    if compared:
        ratio = row["ratio"]
        cells.append("-" if ratio is None else f"{'! ' if row['changed'] else ''}{ratio:.2f}")
    return cells
