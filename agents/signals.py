"""What ends a program from outside."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

STOPPED = 130
"""Exit status of a command that was interrupted."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """A cluster or a terminal that ends the program stops it as Ctrl-C does: no process of a policy stays behind."""

    def stop(*_) -> None:
        raise KeyboardInterrupt

    wanted = [
        number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) != signal.SIG_IGN
    ]  # nohup
    before = {number: signal.signal(number, stop) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """A list that fills on Ctrl-C or SIGTERM, so that the loop can end cleanly; a second one ends at once."""
    received: list[int] = []

    def handle(number, frame):
        if received:
            raise KeyboardInterrupt
        received.append(number)
        print("\nEnding after this iteration, with a checkpoint to go on from; once more ends at once.", flush=True)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
