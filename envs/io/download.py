"""One file from the web: whole and as it is pinned, or not there. What was cut off goes on where it stopped."""

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

PATIENCE = 30.0  # without a byte [s]
PAUSES = (0.0, 1.0, 4.0)  # before each try [s]
CHUNK = 2**16


class DownloadError(ValueError):
    """A file cannot be had; the message says which, why and what to do.

    Attributes:
        passing: another try may help
    """

    def __init__(self, told: str, passing: bool = False):
        super().__init__(told)
        self.passing = passing


def download(
    address: str, path: Path, size: int, sha256: str, advance: Callable[[int], None] = lambda count: None
) -> None:
    """Have the file at `path`; one that is there and whole is left alone.

    Args:
        address: http://... or https://...
        size: [bytes]; sha256: of the file, in hexadecimal digits
        advance: called with the number of bytes that came, or were there

    Raises:
        DownloadError: it cannot be reached, is not there or is another file.
        OSError: the disk is full or cannot be written; nothing is left of this file.
    """
    if path.is_file() and checksum(path) == sha256:
        advance(size)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    _fetch(address, part, size, advance)
    if (found := checksum(part)) != sha256:
        part.unlink()
        raise DownloadError(
            f"{address} is not the file that is pinned here (SHA-256 {found[:16]}..., not {sha256[:16]}...): nothing "
            "of it was kept. It has changed there, or something on the way changes it."
        )
    os.replace(part, path)


def checksum(path: Path) -> str:
    """SHA-256 in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fetch(address: str, part: Path, size: int, advance: Callable[[int], None]) -> None:
    """Try until `part` has `size` bytes, each time from where the last one ended."""
    advance(_size(part))
    for number, pause in enumerate(PAUSES, 1):
        time.sleep(pause)
        try:
            _append(address, part, size, advance)
            return
        except DownloadError as error:
            if not error.passing or number == len(PAUSES):
                raise
        except OSError:
            part.unlink(missing_ok=True)
            raise


def _size(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _append(address: str, part: Path, size: int, advance: Callable[[int], None]) -> None:
    """The bytes that are missing; at most a chunk more than the size, should the server send without end."""
    have = _size(part)
    if have >= size:
        return
    request = Request(address, headers={"Range": f"bytes={have}-"} if have else {})
    with _named(address):
        answer = urlopen(request, timeout=PATIENCE)
    with answer, open(part, "ab") as file:
        if have and answer.status != 206:  # the server sends all of it again
            file.truncate(0)
            advance(-have)
            have = 0
        while have < size:
            with _named(address):
                piece = answer.read(CHUNK)
            if not piece:
                raise DownloadError(f"{address} was cut off after {have} of {size} bytes: {ADVICE}", passing=True)
            file.write(piece)
            have += len(piece)
            advance(len(piece))


ADVICE = "fetch again to go on from there."


@contextmanager
def _named(address: str) -> Iterator[None]:
    """What goes wrong on the network, as `DownloadError`."""
    try:
        yield
    except HTTPError as error:
        told = f"{address} answered {error.code} ({error.reason}): it may have moved."
        raise DownloadError(told, passing=error.code >= 500) from error
    except (URLError, HTTPException, OSError) as error:
        why = getattr(error, "reason", None) or error
        told = f"{address} cannot be reached ({why}): check the network, or give mirror=ADDRESS; {ADVICE}"
        raise DownloadError(told, passing=True) from error
