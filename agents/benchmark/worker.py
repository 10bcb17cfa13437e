"""A worker of a benchmark: a process that runs one cell after another, told which through its standard input.

`python -m maexp.agents.benchmark.worker FOLDER`. Answers are JSON lines on what was standard output; everything else
that is printed goes to `log.txt` of the cell. It ends with the process that started it, however that ended.
"""

import gc
import json
import os
import queue
import sys
import threading
import traceback
import warnings
from pathlib import Path

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
    from maexp.agents.benchmark.cell import EnvShelf
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
    from maexp.agents.benchmark.cell import run_cell
    from maexp.agents.benchmark.plan import Cell, cell_folder, compose_settings
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
