"""Files that are whole or not there: written aside, synced, renamed."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any


def write_json(path: Path, content: Any) -> None:
    """A JSON file, null where a number is NaN."""
    write_text(path, json.dumps(_without_nan(content), indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all: a kill at any moment leaves the old one or the new one.

    Raises:
        OSError: the disk is full or cannot be written; the old file stays.
    """
    write_file(path, lambda file: file.write(text.encode()))


def write_file(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    """The same for a file that `fill` writes into."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".tmp")
    try:
        with open(aside, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:  # a full disk is not made fuller
        aside.unlink(missing_ok=True)
        raise
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)  # the new name, too, is on the disk
    finally:
        os.close(handle)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
