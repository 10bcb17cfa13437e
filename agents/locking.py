"""One process at a time in the folder of a run."""

import errno
import fcntl
import json
import os
import socket
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from maexp.agents.errors import UserError
from maexp.agents.files import short

LOCK = ".lock"
CANNOT_LOCK = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of file systems without locks, some of clusters among them."""


@contextmanager
def lock(where: Path, who: str, wait: bool = False) -> Iterator[None]:
    """Hold a folder, in which `.lock` says who does; the lock ends with this process, however it ends.

    Args:
        who: holds it, as `maexp train`
        wait: until a process that is at it has ended

    Raises:
        UserError: another process is at it.
    """
    handle = _take(where / LOCK, who, wait)
    _HELD.add(handle)
    try:
        with suppress(OSError):  # on a full disk the lock holds all the same, but has no name
            os.ftruncate(handle, 0)
            me = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
            os.pwrite(handle, json.dumps({"who": who} | me).encode(), 0)
        yield
    finally:
        with suppress(OSError):
            (where / LOCK).unlink()
        _HELD.discard(handle)
        os.close(handle)


def _take(path: Path, who: str, wait: bool) -> int:
    """The file, open and locked."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.exists(path) and os.path.samestat(os.fstat(handle), os.stat(path)):
                return handle
            os.close(handle)  # whoever held it has removed it in the meantime
        except BlockingIOError as error:
            told = _describe(handle, path.parent, who)
            os.close(handle)
            raise UserError(told) from error
        except OSError as error:
            if error.errno not in CANNOT_LOCK:
                os.close(handle)
                raise
            told = f"{short(path.parent)} cannot be locked ({error.strerror}): run nothing else there"
            warnings.warn(told, stacklevel=2)
            return handle


def _describe(handle: int, where: Path, who: str) -> str:
    """Who holds a folder, and what to do."""
    try:
        found = json.loads(os.pread(handle, 4096, 0))
        holder = f"{found['who']}, process {int(found['pid'])} on {found['host']} since {found['since']}"
    except (ValueError, KeyError, TypeError):
        holder = f"another {who}"
    return f"{short(where)} is in use by {holder}: wait until that has ended, or stop it."


_HELD: set[int] = set()


def _let_go() -> None:
    """A child that outlives this process does not hold its folders."""
    for handle in _HELD:
        with suppress(OSError):
            os.close(handle)
    _HELD.clear()


os.register_at_fork(after_in_child=_let_go)
