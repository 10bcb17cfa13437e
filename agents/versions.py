"""Which code ran: the versions of the packages and the commit."""

import subprocess
from functools import cache
from pathlib import Path

PACKAGES = ("maexp", "torch", "torchrl", "tensordict", "warp-lang", "numpy")


@cache
def find_commit() -> str | None:
    """The commit of the source folder, None for an installed package."""
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
