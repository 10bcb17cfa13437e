"""The trained policies that come with the package, and the folder that a policy's name or path stands for."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

CONTRACT = "contract.json"
SHIPPED = Path(__file__).resolve().parents[1] / "shipped"


def shipped_names() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONTRACT}"))


def find_policy(policy: str | Path, others: Iterable[str] = (), setting: str = "policy") -> Path:
    """The folder of a trained policy: of one that ships, by its name, or the one that is named itself.

    Args:
        others: further names that could have been meant, for the message.
        setting: what the message calls it.

    Raises:
        ValueError: it is neither.
    """
    if str(policy) in shipped_names():
        return SHIPPED / str(policy)
    place = Path(policy) if isinstance(policy, str | Path) and policy != "" else None
    if place is not None and os.path.isdir(place):  # unlike Path.is_dir it takes names that are too long for any file
        return place
    if place is not None and os.path.exists(place):
        raise ValueError(f"{setting}={policy} is a file: give the folder that maexp export wrote")
    word = str(policy)[:100]
    raise ValueError(f"{setting}={word} is unknown: {advise(word, [*others, *shipped_names()])}")


def advise(word: str, names: list[str]) -> str:
    """What to give instead of a name that is unknown: those near it, or all."""
    if near := difflib.get_close_matches(word, names, 3, 0.7):
        return f"did you mean {' or '.join(near)}?"
    return f"choose one of {', '.join(names)}, or the folder of a trained policy"
