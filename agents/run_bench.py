"""`maexp bench`: throughput, as a table and JSON."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from maexp.agents.checks import check_counts, team_sizes
from maexp.agents.errors import blame_input


def prepare(overrides: list[str]) -> list[str]:
    return overrides


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path:
    """Every measurement has a new folder of its own."""
    return claim()


def check(cfg: Any) -> None:
    """Raise UserError for counts out of range."""
    check_counts(cfg, "num_envs")
    if cfg.num_robots is not None:
        team_sizes(cfg.num_robots)


def run(cfg: Any, where: Path, overrides: list[str]) -> int:
    """Measure what `action` names; the measuring is in `bench`."""
    from maexp.agents import bench

    with blame_input():
        getattr(bench, f"bench_{cfg.action}")(cfg, where)
    return 0
