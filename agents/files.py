"""Files of a run: written atomically, locked by one process at a time, maps identified by checksums."""

import errno
import fcntl
import hashlib
import json
import math
import os
import shlex
import socket
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from maexp.agents.errors import UserError
from maexp.envs import PointCloudMap, VoxelMap
from maexp.envs.atomic_write import whole_file


def write_json(path: Path, content: Any) -> None:
    """A JSON file, null where a number is NaN."""
    write_text(path, json.dumps(without_nan(content), indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all: a kill at any moment leaves the old one or the new one.

    Raises:
        OSError: the disk is full or cannot be written; the old file stays.
    """
    write_file(path, lambda file: file.write(text.encode()))


def write_file(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    """The same for a file that `fill` writes into."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part, open(part, "wb") as file:
        fill(file)


def short(path: Path) -> str:
    """The path as one would type it here."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # somebody has removed the folder that we are in
        return str(path)
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def command(verb: str, *words: str) -> str:
    """A command of ours as one types it in a shell, whatever is in the words."""
    return shlex.join(["maexp", verb, *words])


def without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {name: without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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


def checksum(world: PointCloudMap | VoxelMap) -> str:
    """Sixteen hexadecimal digits that follow from the points or voxels of a map."""
    digest = hashlib.sha256()
    voxels = isinstance(world, VoxelMap)
    for array in (world.free, world.occupied) if voxels else (world.free, world.obstacles, world.boundary):
        digest.update(str(array.shape).encode() + array.tobytes())
    if voxels:
        digest.update(repr((world.resolution, world.origin)).encode())
    return digest.hexdigest()[:16]


def checksums(maps: list[PointCloudMap] | list[VoxelMap]) -> dict[str, str]:
    """Name and checksum of every map."""
    return {world.name: checksum(world) for world in maps}


def changed_maps(saved: dict, maps: list[PointCloudMap]) -> str:
    """Which of `maps` are not what they were when the checkpoint `saved` was written: "a and b have", "" for none."""
    before = saved["maps"]
    changed = [name for name, digest in checksums(maps).items() if before.get(name, digest) != digest]
    more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
    return f"{', '.join(changed[:3])}{more} {'has' if len(changed) == 1 else 'have'}" if changed else ""


def warn_of_changed_maps(saved: dict, maps: list[PointCloudMap]) -> None:
    """Warn of those."""
    if changed := changed_maps(saved, maps):
        warnings.warn(f"{changed} changed since the run was started: its results are of other maps", stacklevel=2)
