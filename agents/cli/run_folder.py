"""A run's folder: new, writable, never that of an earlier run."""

import os
import tempfile
from pathlib import Path

from maexp.agents.errors import UserError

ADVICE = "choose another with hydra.run.dir=FOLDER"


def claim_folder(wanted: str, chosen: bool) -> Path:
    """Create a run's folder exclusively and return it.

    Args:
        wanted: where it should be
        chosen: the user named it, so a folder with files in it is refused; else `-2`, `-3`, ... is appended

    Raises:
        UserError: it cannot be created or written, or holds files.
    """
    folder = Path(wanted).expanduser().absolute()
    check_writable(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if not chosen:
            return _create_new(folder)
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"The folder {folder} cannot be created ({error.strerror}): {ADVICE}.") from error
    if any(folder.iterdir()):
        raise UserError(f"The folder {folder} already holds files, which are left alone: {ADVICE}.")
    return folder


def remove_if_empty(folder: Path | None) -> None:
    """A run that failed before it wrote anything leaves no folder behind."""
    if folder is not None and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _create_new(folder: Path) -> Path:
    number = 1
    while True:
        candidate = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            candidate.mkdir()
            return candidate
        except FileExistsError:
            number += 1


def check_writable(folder: Path) -> None:
    """Raise UserError unless files can be created in `folder`, or in the nearest folder above that exists."""
    place = next(path for path in (folder, *folder.parents) if path.exists())
    if not place.is_dir():
        raise UserError(f"{place} is a file, so {folder} cannot be a folder: {ADVICE}.")
    try:
        if not os.stat(place).st_mode & 0o222:  # root may write even there, but it was not meant to
            raise PermissionError
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise UserError(f"The folder {place} is read-only: {ADVICE}.") from error
