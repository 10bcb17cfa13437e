"""A training run that goes on and on: memory and the work an iteration takes stay what they were.

MAEXP_SOAK_SECONDS is how long (30); an hour: `MAEXP_SOAK_SECONDS=3600 pytest tests/envs/test_soak.py -s`.
"""

import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
from metrics_file import read_metrics

from maexp.agents.training.checkpoint import find_checkpoint

SECONDS = float(os.environ.get("MAEXP_SOAK_SECONDS", 30))
WORDS = [
    "scenario=maze_small",
    "num_envs=8",
    "num_robots=3",
    "collector.steps=5",
    "total_frames=1000000000",
    "episodes=0",
    "checkpoint_every=5",
    "evaluate_every=20",
    "evaluate_episodes=8",
]
GROWTH_MIB, GROWTH = 16.0, 1.03  # memory may grow by so much after the first quarter: allocators keep some
SLOWER = 1.15  # processor time of an iteration


def used(pid: int) -> tuple[float, float]:
    """Memory [MiB] and processor time [s] of a process so far."""
    status = Path(f"/proc/{pid}/status").read_text()
    memory = next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS"))
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return memory, (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_soak(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "import sys; from maexp.agents.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", code, "train", *WORDS, "hydra.run.dir=run"])
    path = Path("run/metrics.csv")
    while process.poll() is None and not (path.is_file() and len(path.read_text().splitlines()) > 3):
        time.sleep(0.1)
    begin, samples = time.monotonic(), []  # (seconds, iterations, memory, processor time)
    while time.monotonic() - begin < SECONDS and process.poll() is None:
        time.sleep(SECONDS / 40)
        samples.append((time.monotonic() - begin, len(path.read_text().splitlines()) - 1, *used(process.pid)))
    assert process.poll() is None, "the run ended by itself"
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130 and find_checkpoint("run")[1]["iteration"] > 0

    quarter = len(samples) // 4
    second, last = samples[quarter : 2 * quarter], samples[-quarter:]
    memory = [statistics.median(sample[2] for sample in part) for part in (second, last)]
    rates = []
    for part in (samples[quarter : 2 * quarter + 1], samples[-quarter - 1 :]):
        count = part[-1][1] - part[0][1]
        assert count > 0, "not one iteration in a quarter of the time: soak for longer"
        rates.append((count, (part[-1][3] - part[0][3]) / count, count / (part[-1][0] - part[0][0])))
    rows = read_metrics(path)
    (_, work, rate), (_, work_last, rate_last) = rates
    print(
        f"\nsoak: {samples[-1][0]:.0f} s, {len(rows):,} iterations, {rows[-1]['frames']:,.0f} macro steps of teams; "
        f"from the second to the last quarter: memory {memory[0]:.0f} -> {memory[1]:.0f} MiB, processor time of an "
        f"iteration {work:.3f} -> {work_last:.3f} s, iterations a second {rate:.2f} -> {rate_last:.2f}"
    )
    assert memory[1] < GROWTH * memory[0] + GROWTH_MIB, "memory grows"
    if min(rates[0][0], rates[1][0]) >= 20:  # fewer tell nothing: evaluations and checkpoints come now and then
        assert work_last < SLOWER * work, "an iteration takes ever more work"
