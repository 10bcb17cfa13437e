"""User errors, one sentence without a traceback, and signals that end the program from outside."""

import errno
import signal
from collections.abc import Iterator
from contextlib import contextmanager

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


class UserError(Exception):
    """A setting, file or folder that cannot be used. The message names it, says what was found and what to do."""


@contextmanager
def blame_input() -> Iterator[None]:
    """Turn the errors that bad input raises in the layers below into `UserError`.

    Wrap only the steps that read what the user gave (maps, settings, checkpoints): a ValueError in the middle
    of training is a defect of ours and keeps its traceback.
    """
    try:
        yield
    except UserError:
        raise
    except OSError as error:
        if error.errno != errno.EIO and (told := describe_disk_error(error)) is not None:
            raise UserError(told) from error
        where = f" ({error.filename})" if error.filename else ""
        raise UserError(f"{error.strerror or error}{where}.") from error
    except (ValueError, ImportError) as error:
        raise UserError(str(error)) from error


def describe_disk_error(error: OSError) -> str | None:
    """A sentence for an error of the disk (full, read-only, broken); None for any other."""
    if error.errno not in DISK_ERRORS:
        return None
    where = f" of {error.filename}" if error.filename else ""
    advice = advise_on_disk(error.errno)
    return f"Writing{where} failed ({error.strerror}): {advice}; files that were there before are whole."


def advise_on_disk(number: int) -> str:
    """What to do about an error while writing."""
    if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "free some space"
    return "check that the disk works" if number == errno.EIO else "check that the folder is there and can be written"


def printable(words: str, most: int = 300) -> str:
    """The first `most` characters of what others wrote, which do nothing to a terminal."""
    return "".join(character if character.isprintable() else "?" for character in words[:most])


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
