"""What a run found: summary.json and results.json, and the table on the terminal."""

import json
import math
import os
import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from omegaconf import OmegaConf
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from maexp.agents.evaluate import EvaluationResult

PACKAGES = ("maexp", "torch", "torchrl", "tensordict", "warp-lang", "numpy")
COLUMNS = {
    "exploration_ratio": "coverage",
    "coverage_step_85": "85 % at step",
    "coverage_step_95": "95 % at step",
    "mutual_overlap_85": "overlap",
    "success_rate": "success",
    "collisions": "collisions",
    "path_length": "path [m]",
}


def plain(cfg: Any) -> dict:
    """Settings as plain containers."""
    return OmegaConf.to_container(cfg, resolve=True)


def describe_run(cfg: Any, maps: list, seconds: float) -> dict:
    """What was run: scenario, maps, seed, commit, versions."""
    return {
        "scenario": cfg.scenario.name,
        "algorithm": cfg.algorithm.name,
        "maps": [one.name for one in maps],
        "seed": cfg.seed,
        "episodes": cfg.episodes,
        "commit": find_commit(),
        "versions": {name: metadata.version(name) for name in PACKAGES},
        "seconds": round(seconds, 2),
    }


def find_commit() -> str | None:
    """The commit of the source folder, None for an installed package."""
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def result_names(results: list[EvaluationResult]) -> list[str]:
    """A name per result: the policy, with the team's size where several sizes were played."""
    sizes = {one.num_robots for one in results}
    return [one.policy if len(sizes) == 1 else f"{one.policy} N={one.num_robots}" for one in results]


def write_results(path: Path, results: list[EvaluationResult], run: dict) -> None:
    """{policy: {metric: {mean, std, ci95, n}}} and `run`: what was run."""
    named = {name: one.summary() for name, one in zip(result_names(results), results, strict=True)}
    named["run"] = run | {"num_robots": sorted({one.num_robots for one in results})}
    write_json(path, named)


def write_json(path: Path, content: Any) -> None:
    """A JSON file, null where a number is NaN."""
    write_text(path, json.dumps(_without_nan(content), indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all: a kill at any moment leaves the old one or the new one."""
    write_file(path, lambda file: file.write(text.encode()))


def write_file(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    """The same for a file that `fill` writes into."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".tmp")
    with open(aside, "wb") as file:
        fill(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(aside, path)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_results(results: list[EvaluationResult], title: str) -> None:
    """The table of the main metrics: mean, 95 % interval of coverage, how many episodes got there."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("policy", no_wrap=True)
    for column in COLUMNS.values():
        table.add_column(escape(column), justify="right", no_wrap=True)  # [m] is no style of rich's
    for name, result in zip(result_names(results), results, strict=True):
        summary = result.summary()
        total = summary["exploration_ratio"]["n"]
        table.add_row(name, *(_cell(metric, summary[metric], total) for metric in COLUMNS))
    natural = Measurement.get(Console(width=1000), Console(width=1000).options, table).maximum
    Console(width=max(natural, Console().width)).print(table)  # a narrower terminal wraps lines, but nothing is lost


def _cell(metric: str, value: dict, total: int) -> str:
    if not value["n"]:
        return f"- (0/{total})"
    digits = 0 if metric.startswith(("coverage_step", "path")) else 3
    text = f"{value['mean']:.{digits}f}"
    if metric == "exploration_ratio":
        low, high = value["ci95"]
        return f"{text} [{low:.3f}, {high:.3f}]"
    return text if value["n"] == total else f"{text} ({value['n']}/{total})"
