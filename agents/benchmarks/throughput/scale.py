"""`maexp bench scale`: how the cost of a local step grows with envs, robots, map size and radar range.

The cost is the time of one local step of the whole batch, a share of drawing the observation and of resets included;
on the CPU it is the processor's time, summed over threads.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from maexp.agents.benchmarks.throughput.env import MeasuredBatch
from maexp.agents.benchmarks.throughput.shared import LEAST_LAPS, write_report
from maexp.agents.build import load_maps, make_env
from maexp.agents.config.checks import check_distinct, team_sizes
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import without
from maexp.agents.config.verbs import BenchSettings
from maexp.agents.errors import UserError
from maexp.agents.evaluation.plots import COLOURS, LOOK, save
from maexp.agents.progress import Progress
from maexp.agents.tables import print_table
from maexp.envs import PointCloudMap
from maexp.envs.scenarios.maze import build_maze

TOLERANCE = 1.25
"""The cost is called linear at most while no value costs this much more than its share of a smaller one's cost."""

ROUNDS = 5
INCHES = 3.6  # width of a plot


@dataclass(frozen=True)
class Axis:
    """What is varied, over which values, and what else is set meanwhile where the user did not set it."""

    title: str
    values: tuple[int, ...]
    setting: Callable[[int], str]
    meanwhile: dict[str, str]
    size: str  # column of a row that the cost should be linear in


# A large team soon covers 95 %: without full coverage asked for, its episodes would be mostly reset and observation.
AXES = {
    "envs": Axis(
        "teams in the batch",
        (1, 8, 64, 512, 2048),
        lambda v: f"num_envs={v}",
        {"num_robots": "3"},
        "num_envs",
    ),
    "robots": Axis(
        "robots in a team",
        (2, 4, 8, 16, 32, 64, 128, 300),
        lambda v: f"num_robots={v}",
        {"num_envs": "4", "scenario.success_coverage": "1.0"},
        "num_robots",
    ),
    "map": Axis(
        "free points of the map",
        (6, 12, 24, 48, 96),
        lambda v: "scenario=maze_small",
        {"num_envs": "32", "num_robots": "3"},
        "free_points",
    ),
    "radar": Axis(
        "radar range [m]",
        (5, 10, 20, 40, 80),
        lambda v: f"radar.range={v}",
        {"num_envs": "32", "num_robots": "3"},
        "radar_range",
    ),
}
COLUMNS = ["ms / local step", "x smallest", "size x", "robot-local-steps/s", "MB/env", "build [s]", "start [s]"]


def run(cfg: BenchSettings, where: Path, overrides: list[str]) -> None:
    """Costs along every axis asked for; ``where/bench_scale.json``, a table and a plot for each."""
    chosen = pick_axes(cfg.axes)
    plans = {name: plan_axis(AXES[name], cfg, overrides) for name in chosen}
    rows: dict[str, list[dict]] = {}
    with Progress("measuring", (1 + ROUNDS) * sum(map(len, plans.values())), 0) as progress:
        for name, plan in plans.items():
            rows[name] = measure_axis(name, plan, lambda note: progress.show(progress.done + 1, note))
    report = {}
    for name in chosen:
        worst, base = worst_over_linear(rows[name], AXES[name].size)
        report[name] = {"rows": rows[name], "worst_over_linear": worst, "worst_from": base["value"]}
        print_axis(name, report[name])
        draw_axis(AXES[name], rows[name], where / f"scale_{name}.png")
    write_report(where / "bench_scale.json", "bench_scale", cfg.device, {"tolerance": TOLERANCE, "axes": report})


def pick_axes(wanted: str | Sequence[str] | None) -> list[str]:
    """The axes to go along.

    Raises:
        UserError: there is no such axis, or one is named twice.
    """
    names = list(AXES) if wanted is None else [wanted] if isinstance(wanted, str) else list(wanted)
    for name in names:
        if name not in AXES:
            raise UserError(f"axes={name} is unknown: choose some of {','.join(AXES)}.")
    check_distinct("axes", names)
    return names


def plan_axis(axis: Axis, cfg: BenchSettings, overrides: list[str]) -> list[tuple[int, BenchSettings]]:
    """The values and settings of an axis; what the user set stays, but for the setting that is varied.

    Raises:
        UserError: a setting was given several values, or no value is left.
    """
    if cfg.sweep:
        raise UserError("maexp bench scale varies one setting after another itself: give every setting one value.")
    values = [value for value in axis.values if cfg.largest is None or value <= cfg.largest]
    if not values:
        raise UserError(f"largest={cfg.largest} leaves no value for {axis.title}: the smallest is {axis.values[0]}.")
    varied = axis.setting(0).partition("=")[0]
    kept = without(overrides, varied)
    given = {word.partition("=")[0] for word in kept}
    meanwhile = [f"{name}={value}" for name, value in axis.meanwhile.items() if name not in given]
    points = [compose_settings("bench", [*meanwhile, *kept, axis.setting(value)]) for value in values]
    for point in points:
        team_sizes(point.num_robots)
    return list(zip(values, points, strict=True))


def measure_axis(axis: str, plan: list[tuple[int, BenchSettings]], show: Callable[[str], None]) -> list[dict]:
    """Throughput at every point, and what a local step of the batch costs.

    The points take turns, `ROUNDS` times: what else the machine does, and how fast it is just now, meets all alike.
    """
    batches = []
    for value, cfg in plan:
        maps = [large_maze(value)] if axis == "map" else load_maps(cfg.scenario).train
        begin = time.perf_counter()
        env = make_env(cfg, maps, cfg.num_robots)
        built = time.perf_counter() - begin
        batches.append((value, built, MeasuredBatch(cfg, env)))
        show(f"{axis} {value}: built")
    for k in range(1, ROUNDS + 1):
        for value, _, batch in batches:
            batch.run(batch.cfg.seconds * k / ROUNDS, LEAST_LAPS * k // ROUNDS)
            show(f"{axis} {value}")
    return [{"value": value} | batch.summary() | {"build_seconds": built} for value, built, batch in batches]


def large_maze(cells: int) -> PointCloudMap:
    """A maze like those of `maze_small`, with so many cells a side."""
    return build_maze(0, scenario="maze_small", cells=cells, corridor=5, wall=1, resolution=1.0)


def worst_over_linear(rows: list[dict], size: str) -> tuple[float, dict]:
    """The largest (cost ratio) / (size ratio) of any value over a smaller one: 1 is linear, less is better; and the
    row of the smaller one."""
    pairs = [(small, large) for k, large in enumerate(rows) for small in rows[:k]]
    shares = [
        (ratio(large, small, "seconds_per_local_step") / ratio(large, small, size), small) for small, large in pairs
    ]
    return max(shares, key=lambda pair: pair[0], default=(1.0, rows[0]))


def ratio(large: dict, small: dict, name: str) -> float:
    return large[name] / small[name]


def print_axis(name: str, measured: dict) -> None:
    """The table of an axis, and whether the cost is linear at most."""
    rows, axis = measured["rows"], AXES[name]
    cells = [
        [
            f"{row[axis.size]:g}",
            f"{1e3 * row['seconds_per_local_step']:.3f}",
            f"{ratio(row, rows[0], 'seconds_per_local_step'):.2f}",
            f"{ratio(row, rows[0], axis.size):.2f}",
            f"{row['robot_local_steps_per_second']:,.0f}",
            f"{row['memory_per_env'] / 1e6:.2f}",
            f"{row['build_seconds']:.1f}",
            f"{row['first_step_seconds']:.1f}",
        ]
        for row in rows
    ]
    print_table(describe_growth(axis, measured), [name, *COLUMNS], cells)


def describe_growth(axis: Axis, measured: dict) -> str:
    """From end to end, and from the value on which a larger one costs most beside its share."""
    rows, worst = measured["rows"], measured["worst_over_linear"]
    cost, size = ratio(rows[-1], rows[0], "seconds_per_local_step"), ratio(rows[-1], rows[0], axis.size)
    verdict = "linear at most" if worst <= TOLERANCE else f"FASTER THAN LINEAR from {measured['worst_from']} on"
    return (
        f"{axis.title}: {size:,.{size < 10:d}f} times the size costs {cost:,.{cost < 10:d}f} times as much; "
        f"{verdict} (at worst {worst:.2f} times its share of a smaller one)"
    )


def draw_axis(axis: Axis, rows: list[dict], path: Path) -> None:
    """Cost against size, both logarithmic, with a straight line for what grows linearly."""
    sizes = [row[axis.size] for row in rows]
    costs = [1e3 * row["seconds_per_local_step"] for row in rows]
    with rc_context(LOOK):
        figure = Figure(figsize=(INCHES, 0.8 * INCHES), layout="constrained")
        axes = figure.add_subplot(xscale="log", yscale="log")
        axes.set_xlabel(axis.title)
        axes.set_ylabel("ms per local step of the batch")
        axes.plot(sizes, [costs[-1] * size / sizes[-1] for size in sizes], "--", color="#808080", label="linear")
        axes.plot(sizes, costs, "o-", color=COLOURS[0], label="measured")
        axes.set_title(f"{rows[0]['scenario']}, {rows[0]['planner']}")
        axes.minorticks_off()
        axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if max(costs) < 50 * min(costs) else (1.0,)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.legend()
        save(figure, path)
