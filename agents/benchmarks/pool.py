"""The worker processes of a benchmark: each runs one cell at a time; one that dies takes no other with it."""

import gc
import json
import os
import queue
import selectors
import signal
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from maexp.agents.benchmarks.cell import finished
from maexp.agents.benchmarks.plan import Cell, cell_folder

STOP = 143
"""Exit status after a SIGTERM during training, when the checkpoint is written."""


def main(where: Path) -> int:
    """Run the cells that come in, until there is nothing more to come."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    inbox: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_listen, args=(inbox,), daemon=True).start()
    send_output_to(where / "cells" / "worker.txt")

    import torch

    from maexp.agents import progress
    from maexp.agents.benchmarks.cell import EnvShelf
    from maexp.agents.memory import keep_freed_memory

    torch.set_num_threads(1)
    keep_freed_memory()
    progress.LINE_EVERY = 1.0
    shelf = EnvShelf()
    while True:
        order = json.loads(inbox.get())
        status, message = work(where, order, shelf)
        answers.write(json.dumps({"status": status, "message": message}) + "\n")
        if status == "stopped":
            return STOP
        gc.collect()


def work(where: Path, order: dict, shelf) -> tuple[str, str]:
    """(done, stopped or failed, what went wrong) of one cell."""
    from maexp.agents.benchmarks.cell import run_cell
    from maexp.agents.benchmarks.plan import Cell, cell_folder, compose_settings
    from maexp.agents.errors import UserError, describe_disk_error

    warnings.filterwarnings("ignore", category=FutureWarning)  # of libraries, for their authors
    cell = Cell(**order["cell"])
    send_output_to(cell_folder(where, cell) / "log.txt")
    try:
        done = run_cell(compose_settings("benchmark", order["overrides"]), where, cell, shelf, order["suites"])
    except UserError as error:
        print(error, file=sys.stderr, flush=True)
        return "failed", str(error)
    except OSError as error:
        traceback.print_exc()
        return "failed", describe_disk_error(error) or f"{type(error).__name__}: {error}"
    except Exception as error:  # the other cells go on; the traceback is in the log
        traceback.print_exc()
        return "failed", f"{type(error).__name__}: {error}"
    return ("done" if done else "stopped"), ""


def send_output_to(path: Path) -> None:
    """Point standard output and error, of C code too, to the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    with open(path, "a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


def _listen(inbox: queue.Queue) -> None:
    """Hand on the orders; the end of the input is the end of the one who gives them, and of this process."""
    for line in sys.stdin:
        inbox.put(line)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))


POLL = 0.5  # seconds between two looks
GRACE = 120.0  # seconds that a training iteration has to end in after Ctrl-C
TAIL = 3  # lines of a dead worker's output that are shown


@dataclass
class Worker:
    """A process and the cell it is at."""

    process: subprocess.Popen
    gpu: int | None
    cell: Cell | None = None


@dataclass
class Outcome:
    """What came of the cells: those that are done, and those that failed with the reason."""

    done: list[Cell] = field(default_factory=list)
    failed: dict[Cell, str] = field(default_factory=dict)
    interrupted: bool = False


class WorkerPool:
    """Runs cells in `workers` processes, one thread each.

    Args:
        where: the benchmark's folder
        overrides: of maexp benchmark
        suites: the sets of maps to be played
        workers: processes at once
        gpus: how many GPUs share them, 0 on the CPU
    """

    def __init__(self, where: Path, overrides: list[str], suites: list[str], workers: int, gpus: int = 0):
        self.where, self.overrides, self.suites = where, overrides, suites
        self.count, self.gpus = workers, gpus
        self.waiting: deque[Cell] = deque()
        self.workers: list[Worker] = []
        self.outcome = Outcome()
        self.selector = selectors.DefaultSelector()

    def run(self, cells: list[Cell], stop: list, watch: Callable[["WorkerPool"], None]) -> Outcome:
        """Run the cells in order until all are done or `stop` fills; `watch` is called twice a second.

        Raises:
            KeyboardInterrupt: a second Ctrl-C; workers end with this process.
        """
        self.waiting.extend(cells)
        try:
            while (self.waiting or self.running()) and not stop:
                self._employ()
                self._listen()
                watch(self)
            if stop:
                self._stop_running()
                self.outcome.interrupted = len(self.outcome.done) + len(self.outcome.failed) < len(cells)
        finally:
            self._dismiss()
        return self.outcome

    def running(self) -> list[Cell]:
        """The cells being run."""
        return [worker.cell for worker in self.workers if worker.cell is not None]

    def _employ(self) -> None:
        """Give every idle worker a cell; start workers while there are too few."""
        while self.waiting:
            idle = next((worker for worker in self.workers if worker.cell is None), None)
            if idle is None and len(self.workers) < self.count:
                idle = self._start()
            if idle is None:
                return
            idle.cell = self.waiting.popleft()
            order = {"cell": asdict(idle.cell), "overrides": self.overrides, "suites": self.suites}
            try:
                idle.process.stdin.write(json.dumps(order) + "\n")
                idle.process.stdin.flush()
            except OSError:  # it died in between: _listen sees the end of its output
                pass

    def _start(self) -> Worker:
        env = dict(os.environ, OMP_NUM_THREADS="1", MKL_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        gpu = None
        if self.gpus:
            taken = [other.gpu for other in self.workers]
            gpu = min(range(self.gpus), key=taken.count)
            shown = os.environ.get("CUDA_VISIBLE_DEVICES")
            env["CUDA_VISIBLE_DEVICES"] = shown.split(",")[gpu] if shown else str(gpu)
        process = subprocess.Popen(
            [sys.executable, "-m", "maexp.agents.benchmarks.pool", str(self.where)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=env,
            start_new_session=True,  # Ctrl-C reaches this process alone, which tells the workers
        )
        worker = Worker(process, gpu)
        self.workers.append(worker)
        self.selector.register(process.stdout, selectors.EVENT_READ, worker)
        return worker

    def _listen(self) -> None:
        for key, _ in self.selector.select(POLL):
            worker, line = key.data, key.fileobj.readline()
            if line:
                self._note(worker, json.loads(line))
            else:
                self._bury(worker)

    def _note(self, worker: Worker, answer: dict) -> None:
        cell, worker.cell = worker.cell, None
        if answer["status"] == "done":
            self.outcome.done.append(cell)
        elif answer["status"] == "failed":
            self.outcome.failed[cell] = answer["message"]

    def _bury(self, worker: Worker) -> None:
        """A worker whose output ended: its cell failed, unless it had none."""
        status = worker.process.wait()
        self.selector.unregister(worker.process.stdout)
        self.workers.remove(worker)
        if worker.cell is not None:
            how = signal.Signals(-status).name if status < 0 else f"status {status}"
            lines = last_lines(cell_folder(self.where, worker.cell) / "log.txt", TAIL)
            self.outcome.failed[worker.cell] = f"its worker died ({how}). Last lines: " + " / ".join(lines)
        elif not self.outcome.done and status:
            raise RuntimeError(f"a worker ended with status {status} before its first cell")

    def _stop_running(self) -> None:
        """Let trainings write their checkpoint; evaluations are short and start again. A cell that ends now counts."""
        for worker in self.workers:
            worker.process.terminate()
        end = time.monotonic() + GRACE
        for worker in self.workers:
            try:
                worker.process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                worker.process.kill()
            if worker.cell is not None and all(finished(self.where, worker.cell, suite) for suite in self.suites):
                self.outcome.done.append(worker.cell)

    def _dismiss(self) -> None:
        """The end of their input ends the workers."""
        for worker in self.workers:
            try:
                worker.process.stdin.close()
            except OSError:
                pass
            worker.process.stdout.close()
            worker.process.wait()
        self.selector.close()


def last_lines(path: Path, count: int) -> list[str]:
    """The last lines of a log that are not empty."""
    if not path.is_file():
        return ["(no output)"]
    with open(path, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - 4096))
        text = file.read().decode(errors="replace")
    return [line.strip() for line in text.splitlines() if line.strip()][-count:] or ["(no output)"]
