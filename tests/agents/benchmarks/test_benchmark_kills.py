"""What a kill leaves of a benchmark: cells that count, and the rest to go on with."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_benchmark import CELLS, TINY

from maexp.agents.benchmarks.cell import read_result
from maexp.agents.benchmarks.plan import cell_folder
from maexp.agents.benchmarks.pool import WorkerPool
from maexp.agents.cli import main


def start(folder: Path, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-c", "import sys; from maexp.agents.cli import main; sys.exit(main())", "benchmark"]
    return subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path, process: subprocess.Popen, lines: int = 1) -> None:
    while process.poll() is None and (not path.is_file() or len(path.read_text().splitlines()) < lines):
        time.sleep(0.02)
    assert process.poll() is None


def workers_of(process: subprocess.Popen) -> list[int]:
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if "benchmark.worker" in Path(f"/proc/{child}/cmdline").read_text()]


@contextlib.contextmanager
def held(workers: list[int]):
    """Processes stand still until each has been sent SIGTERM."""
    for worker in workers:
        os.kill(worker, signal.SIGSTOP)
    yield
    end = time.monotonic() + 60
    while not all(asked_to_end(worker) for worker in workers) and time.monotonic() < end:
        time.sleep(0.02)
    for worker in workers:
        os.kill(worker, signal.SIGCONT)
    assert time.monotonic() < end, "the workers were not told to stop"


def asked_to_end(process: int) -> bool:
    status = Path(f"/proc/{process}/status").read_text()
    pending = [int(line.split()[1], 16) for line in status.splitlines() if line.startswith(("SigPnd", "ShdPnd"))]
    return any(mask >> (signal.SIGTERM - 1) & 1 for mask in pending)


def assert_same_cells(first: Path, second: Path) -> None:
    for cell in CELLS:
        ours, theirs = (read_result(folder, cell, "held_out") for folder in (first, second))
        assert ours.episodes.keys() == theirs.episodes.keys()
        for name, values in ours.episodes.items():
            np.testing.assert_array_equal(values, theirs.episodes[name], err_msg=f"{cell.name} {name}")
        np.testing.assert_array_equal(ours.coverage, theirs.coverage)
    assert (first / "table.csv").read_text() == (second / "table.csv").read_text()


@pytest.mark.slow
def test_killed_and_resumed_is_uninterrupted(whole_run, tmp_path, capsys):
    folder = tmp_path / "killed"
    log = cell_folder(folder, CELLS[2]) / "metrics.csv"
    process = start(folder, *TINY, f"hydra.run.dir={folder}")
    wait_for(log, process, lines=3)
    process.kill()
    process.wait()
    time.sleep(1.0)
    left, first = len(log.read_text().splitlines()), log.read_text().splitlines()[1]
    time.sleep(1.0)
    assert len(log.read_text().splitlines()) == left < 5  # its worker went with it
    process = start(folder, f"resume={folder}")
    wait_for(cell_folder(folder, CELLS[5]) / "metrics.csv", process, lines=2)
    with held(workers_of(process)):  # however long it is at a picture, no cell ends before the signal
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130 and "maexp benchmark resume=" in out and "Traceback" not in err
    assert "maze_small: 6 episodes" in out  # what was done is in the table already
    assert main(["benchmark", f"resume={folder}"]) == 0
    assert log.read_text().splitlines()[1] == first  # clocks and all: it went on, it did not start again
    assert_same_cells(whole_run, folder)


@pytest.mark.slow
def test_a_cell_that_ends_while_stopping_counts(run_copy):
    """Ctrl-C while the last worker is about to say that it is done: nothing is left, nothing was interrupted."""
    (cell_folder(run_copy, CELLS[0]) / "held_out.json").unlink()
    words = json.loads((run_copy / "benchmark.json").read_text())["overrides"]
    stop = []

    def ask(pool: WorkerPool) -> None:
        while not (cell_folder(run_copy, CELLS[0]) / "held_out.json").is_file():
            time.sleep(0.02)
        time.sleep(0.5)  # its answer is in the pipe
        stop.append(signal.SIGINT)

    outcome = WorkerPool(run_copy, words, ["held_out"], workers=1).run(CELLS[:1], stop, ask)
    assert outcome.done == CELLS[:1] and not outcome.interrupted


@pytest.mark.slow
def test_a_worker_that_dies_is_named_and_the_rest_goes_on(run_copy):
    for cell in CELLS[:3]:
        (cell_folder(run_copy, cell) / "held_out.json").unlink()
    words = json.loads((run_copy / "benchmark.json").read_text())["overrides"]
    killed = []

    def kill_first(pool: WorkerPool) -> None:
        if not killed and pool.running():
            killed.append(pool.workers[0].process.pid)
            os.kill(killed[0], signal.SIGKILL)

    outcome = WorkerPool(run_copy, words, ["held_out"], workers=1).run(CELLS[:3], [], kill_first)
    assert list(outcome.failed) == CELLS[:1] and outcome.done == CELLS[1:3]
    assert "SIGKILL" in outcome.failed[CELLS[0]] and "evaluating on held_out" in outcome.failed[CELLS[0]]
