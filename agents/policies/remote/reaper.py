"""What ends policies in processes of their own, with all that they started: when a run has done with one, and from a
process that watches the run, when it was killed outright.

`python warden.py RUN MARK` waits until process RUN has ended, then ends all that MARK is in the environment of. It is
told by the number of its parent, not by a signal: so it does not matter which thread started a policy, nor what that
started in turn. Only the standard library, for it starts with every run.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from uuid import uuid4

MARK = "MAEXP_GUEST"  # variable of the environment by which a process and all that it started are known
ROUNDS = 100
LOOK = 0.5  # seconds between two looks at the run
SURE = 3.0  # seconds for which nothing may be left: a process that was just being started has no mark yet
_WARDENS: list[subprocess.Popen] = []  # kept: they outlive us


@cache
def watch(run: int) -> str:
    """Start what watches this process, number `run`; returns what the marks of its policies begin with."""
    mark = uuid4().hex
    others = {name: value for name, value in os.environ.items() if name != MARK}  # the run may be a policy's own
    if Path("/proc/self/environ").exists():
        command = [sys.executable, "-E", "-S", str(Path(__file__).resolve()), str(run), mark]
        files = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        _WARDENS.append(subprocess.Popen(command, cwd="/", env=others, start_new_session=True, **files))
    return mark


def end_marked(mark: str) -> bool:
    """End all processes whose mark begins so; whether there were any."""
    for number in range(ROUNDS):  # some may start others meanwhile
        left = [path for path in Path("/proc").glob("[0-9]*") if _has_mark(path, f"{MARK}={mark}".encode())]
        for path in left:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(int(path.name), signal.SIGKILL)
        if not left:
            return number > 0
    return True


def _has_mark(process: Path, mark: bytes) -> bool:
    try:
        return any(variable.startswith(mark) for variable in (process / "environ").read_bytes().split(b"\0"))
    except OSError:  # it has ended, or is somebody else's
        return False


def main(run: int, mark: str) -> None:
    """Wait until the run has ended, and end what is left of it."""
    while os.getppid() == run:
        time.sleep(LOOK)
    end = time.monotonic() + SURE
    while time.monotonic() < end:
        if end_marked(mark):
            end = time.monotonic() + SURE
        time.sleep(LOOK)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
