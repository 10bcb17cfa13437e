"""`maexp benchmark`: policies x scenarios x seeds, cell by cell, to one table."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from maexp.agents.benchmarks.cell import finished
from maexp.agents.benchmarks.plan import (
    PLAN,
    Cell,
    as_list,
    cell_folder,
    check_lists,
    check_unchanged,
    list_cells,
    read_plan,
    write_plan,
)
from maexp.agents.benchmarks.pool import Outcome, WorkerPool, last_lines
from maexp.agents.benchmarks.report import SMOKE, Report
from maexp.agents.benchmarks.time_estimate import Estimate, estimate_cells
from maexp.agents.build import pick_device
from maexp.agents.cli import Command
from maexp.agents.cli.run_folder import check_writable
from maexp.agents.config.overrides import find_override, without
from maexp.agents.config.resolved import resolve
from maexp.agents.config.runs import Recipe
from maexp.agents.config.verbs import BenchmarkSettings
from maexp.agents.errors import STOPPED, UserError, stop_on_signals
from maexp.agents.files import command, lock, short
from maexp.agents.progress import Progress, duration
from maexp.agents.training.train import write_config

NOTE = "What is absent here each cell has from its scenario and its algorithm: see cells/*/*/*/config.yaml."
FAILED = 1
SHOWN = 2  # running cells in the line of progress
LONG = 24.0  # hours that need confirm=true


def prepare(overrides: list[str]) -> Recipe:
    """For resume=FOLDER: that benchmark's overrides, then the new ones."""
    place = find_override(overrides, "resume")
    if place is None:
        return Recipe(overrides)
    if find_override(overrides, "hydra.run.dir") is not None:
        raise UserError("resume and hydra.run.dir together are ambiguous: a benchmark goes on in its own folder.")
    return Recipe(read_plan(place)["overrides"] + overrides)


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path:
    """The folder that is resumed, or a new one."""
    place = find_override(overrides, "resume")
    if place is not None:
        check_writable(Path(place).absolute())
        return Path(place).absolute()
    try:
        return claim()
    except UserError as error:
        chosen = find_override(overrides, "hydra.run.dir")
        if chosen and (Path(chosen) / PLAN).is_file():
            again = command("benchmark", f"resume={chosen}")
            raise UserError(f"{chosen} holds a benchmark already: go on with it by {again}.") from error
        raise


def check(cfg: BenchmarkSettings) -> None:
    """Raise UserError for unknown names."""
    check_lists(cfg)


def run(cfg: BenchmarkSettings, where: Path, overrides: list[str]) -> int:
    """Run the cells that are not done, then write the tables and pictures."""
    with lock(where, "maexp benchmark"):
        return run_locked(cfg, where, overrides)


def run_locked(cfg: BenchmarkSettings, where: Path, overrides: list[str]) -> int:
    """The same, while no one else is at the folder."""
    suites = as_list(cfg.maps)
    cells = list_cells(cfg)
    todo = [cell for cell in cells if not all(finished(where, cell, suite) for suite in suites)]
    report = Report(cfg, where, cells, suites)
    check_unchanged(where, cfg)
    report.read_all()
    if cfg.report or not todo:
        return conclude(report, Outcome(done=[]), where, len(todo))
    gpus = count_gpus(cfg.device)
    workers = min(cfg.workers or gpus or len(os.sched_getaffinity(0)), len(todo))
    announce(cfg, cells, todo, workers)
    expected = estimate_cells(cfg, todo, len(suites), workers)
    confirm(cfg, expected)
    kept = without(overrides, "workers", "confirm", "report", "estimate")
    write_plan(where, cfg, kept)
    write_config(resolve(cfg), where, "benchmark", overrides, note=NOTE)
    pool = WorkerPool(where, kept, suites, workers, gpus)
    print(f"everything goes to {short(where)}", flush=True)
    with stop_on_signals() as stop, BenchmarkProgress(where, cells, todo, expected) as progress:
        outcome = pool.run(todo, stop, lambda pool: watch(pool, progress, report))
    return conclude(report, outcome, where, len(todo) - len(outcome.done))


def count_gpus(device: str) -> int:
    """GPUs to go round; 0 where the cells run on the CPU or on one named GPU."""
    import torch

    if pick_device(device).type == "cpu" or ":" in device:
        return 0
    return torch.cuda.device_count()


def announce(cfg: BenchmarkSettings, cells: list[Cell], todo: list[Cell], workers: int) -> None:
    """Say what is about to happen."""
    done = len(cells) - len(todo)
    print(
        f"preset {cfg.preset}: {len(cells)} cells ({len(set(c.policy for c in cells))} policies, "
        f"{len(as_list(cfg.scenarios))} scenarios, seeds {', '.join(map(str, as_list(cfg.seeds)))}, {cfg.episodes} "
        f"episodes each){f', {done} of them done before' if done else ''}; {workers} at once"
    )
    if cfg.preset == "smoke":
        print(SMOKE)
    if cfg.estimate:
        print("measuring a few steps to say how long it will take", flush=True)


def confirm(cfg: BenchmarkSettings, expected: Estimate) -> None:
    """Say how long it will take; refuse what nobody may have meant."""
    print(expected.text, flush=True)
    if expected.hours > LONG and not cfg.confirm:
        raise UserError(
            f"This would take about {expected.describe()}: add confirm=true to run it all the same (it can be stopped "
            "and resumed at any time), or lower total_frames, seeds, scenarios or algorithms."
        )


def watch(pool: WorkerPool, progress: "BenchmarkProgress", report: Report) -> None:
    """Show how far it is; write the tables whenever a scenario has been through all policies."""
    progress.look(pool)
    report.update(pool.outcome.done)


def conclude(report: Report, outcome: Outcome, where: Path, left: int) -> int:
    """Tables, pictures, what failed, how to go on."""
    try:
        report.finish()
    finally:  # on a full disk, too
        for cell, reason in outcome.failed.items():
            print(f"{cell.name} failed: {reason}\n  its output: {short(cell_folder(where, cell) / 'log.txt')}")
        if left:
            again = command("benchmark", f"resume={short(where)}")
            print(f"{left} cells are not done. Go on with: {again}", flush=True)
    if outcome.interrupted:
        return STOPPED
    return FAILED if outcome.failed else 0


class BenchmarkProgress(Progress):
    """One line: cells done, time left, what the running ones are at.

    Args:
        where: the benchmark's folder
        cells, todo: all cells, and those not done yet
        expected: weights of the cells
    """

    def __init__(self, where: Path, cells: list[Cell], todo: list[Cell], expected: Estimate):
        super().__init__("benchmark", len(cells), len(cells) - len(todo))
        self.where, self.todo, self.expected = where, todo, expected
        self.spent_weight = 0.0

    def look(self, pool: WorkerPool) -> None:
        """Read how far the running cells are from the last lines of their logs."""
        ended = [*pool.outcome.done, *pool.outcome.failed]
        shares = {cell: read_share(cell_folder(self.where, cell) / "log.txt") for cell in pool.running()}
        weight = self.expected.weight
        self.spent_weight = sum(weight(cell) for cell in ended)
        self.spent_weight += sum(weight(cell) * share for cell, (share, _) in shares.items())
        note = describe_running([(cell.scenario, cell.policy, text) for cell, (_, text) in shares.items()])
        self.show(self.first + len(ended), note)

    def describe(self, note: str = "") -> str:
        """Cells done, time left, the running ones."""
        spent = time.monotonic() - self.begin
        whole = sum(self.expected.weight(cell) for cell in self.todo)
        left = spent * (whole - self.spent_weight) / self.spent_weight if self.spent_weight > 0 else float("inf")
        return "  ".join(part for part in (f"{self.done}/{self.total} cells", f"{duration(left)} left", note) if part)


def describe_running(running: list[tuple[str, str, str]]) -> str:
    """maze: mappo 40%, ippo starts; short, for it shares its line with the bar."""
    parts, place = [], None
    for scenario, policy, text in running[:SHOWN]:
        parts.append(f"{policy} {text}" if scenario == place else f"{scenario}: {policy} {text}")
        place = scenario
    return ", ".join(parts) + (f" +{len(running) - SHOWN}" if len(running) > SHOWN else "")


def read_share(log: Path) -> tuple[float, str]:
    """(share done in [0, 1], in words) from the last line of a log that a Progress wrote."""
    for line in reversed(last_lines(log, 3)):
        title, _, rest = line.partition(": ")
        done, _, total = rest.split("  ")[0].replace(",", "").partition("/")
        if done.isdigit() and total.isdigit() and int(total):
            part = int(done) / int(total)
            training = title == "training"
            return (0.9 * part if training else 0.9 + 0.1 * part), f"{part:.0%}" if training else "plays"
    return 0.0, "starts"


COMMAND = Command(run, check, prepare=prepare, folder=folder)
