"""What the measurements of `maexp bench` share: points of a sweep, spread of laps, clock, report, machine."""

import itertools
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from maexp.agents.config.checks import team_sizes
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.groups import CommonSettings
from maexp.agents.config.overrides import find_sweeps, without
from maexp.agents.config.verbs import BenchSettings
from maexp.agents.files import write_json
from maexp.agents.versions import PACKAGES, find_commit
from maexp.envs import ExplorationEnv
from maexp.envs.scenarios import find_scenario

OWN = ("task", "seconds", "baseline", "sweep", "axes")
"""Settings of `maexp bench` alone; the rest is that of the runs it measures."""
LEAST_LAPS = 5


def sweep_points(cfg: BenchSettings, overrides: list[str], sizes: list[int], verb: str = "bench") -> list[Any]:
    """The settings of every combination of the settings given several values, team sizes last.

    Args:
        cfg: the composed settings; `sweep` holds the settings with several values
        overrides: what they were composed from
        sizes: team sizes where none are given
        verb: whose settings to compose; those of `bench` alone are left out for another verb

    Raises:
        UserError: one of the values does not fit.
    """
    drop = ("sweep", "num_robots", *(OWN if verb != "bench" else ()))
    swept = find_sweeps(cfg.sweep or [])
    axes = [*swept.values()]
    fixed = without(overrides, *drop, *swept)
    axes.append([f"num_robots={n}" for n in (sizes if cfg.num_robots is None else team_sizes(cfg.num_robots))])
    points = [compose_settings(verb, [*fixed, *point]) for point in itertools.product(*axes)]
    there = [p for p in points if p.planner.name == "wavefront" or find_scenario(p.scenario.name).kind == "plane"]
    points = there or points  # in volumes one planner is enough
    return points


def spread(laps: list[float]) -> dict[str, float]:
    """Median and the tenth and ninetieth percentile."""
    tenths = statistics.quantiles(laps, n=10, method="inclusive") if len(laps) > 1 else [laps[0]] * 9
    return {"median": statistics.median(laps), "p10": tenths[0], "p90": tenths[-1]}


def time_call(call: Callable[[], Any], device: torch.device) -> float:
    """Seconds that a call takes on its device; on the CPU those of this thread, without waits for other programs."""
    if device.type == "cuda":
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        call()
        end.record()
        torch.cuda.synchronize(device)
        return 1e-3 * begin.elapsed_time(end)
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


def describe_point(env: ExplorationEnv, cfg: CommonSettings) -> dict[str, Any]:
    """What tells the points of a sweep apart."""
    return {
        "scenario": cfg.scenario.name,
        "planner": env.planner_config.name,
        "num_envs": env.num_envs,
        "num_robots": env.num_robots,
        "radar_range": max(radar.range for radar in env.radar_configs),
        "free_points": env.bank.max_free,
    }


def write_report(path: Path, kind: str, device: str, body: dict) -> None:
    """The report of a measurement, written at once: kind, machine, versions, then `body`."""
    report = {
        "kind": kind,
        "machine": {"cpu": cpu_name(), "cores": os.cpu_count(), "python": platform.python_version()},
        "device": str(device),
        "commit": find_commit(),
        "versions": {name: metadata.version(name) for name in PACKAGES},
    }
    if str(device).startswith("cuda"):
        report["machine"]["gpu"] = torch.cuda.get_device_name(device)
    write_json(path, report | body)
    Console().print(f"written to {path}", soft_wrap=True)


def cpu_name() -> str:
    """The processor's name as the system gives it."""
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
