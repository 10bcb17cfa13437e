"""Files that are whole or not there: written aside, synced, renamed."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[str]:
    """Yields a temporary path beside `path` that replaces it at the end, or vanishes on an error.

    A kill at any moment leaves the old file or the new one, and at worst the temporary one, `.NAME.*.part`.
    """
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    os.close(handle)
    try:
        yield part
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(part, 0o666 & ~mask)
        _sync(Path(part))
        os.replace(part, path)
    except BaseException as error:
        os.unlink(part)
        if (
            isinstance(error, OSError) and error.errno is not None and error.filename is None
        ):  # a full disk does not say which file it was
            error.filename = str(path)
        raise
    _sync(path.parent)  # the new name, too, is on the disk


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
