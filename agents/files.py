"""JSON, text and other files of a run, whole or not there."""

import json
import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from maexp.envs.whole_file import whole_file


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
