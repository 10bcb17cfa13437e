"""The runs of a sweep in one table: what each team does, how far it is ahead, and what the planners do there."""

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

from maexp.agents.evaluation.comparison import DECIDES, STARTS
from maexp.agents.evaluation.results import find_columns, print_summaries
from maexp.agents.files import write_text
from maexp.agents.tables import POINTS, estimate

TRAINED = re.compile(r"trained( N=\d+)?")
LEAD = "ahead [points]"


def tell_runs(runs: dict[str, Path], path: Path) -> bool:
    """Print the table of the runs that were evaluated, and write its means as CSV; whether there were any.

    Args:
        runs: what a run is called -> its folder.
        path: of the CSV.
    """
    files = {name: folder / "summary.json" for name, folder in runs.items()}
    found = {name: json.loads(file.read_text()) for name, file in files.items() if file.is_file()}
    if not found:
        return False
    rows = [row for name, summary in found.items() for row in _teams(name, summary)]
    rows += _planners(found)
    goal = max(summary["run"]["success_coverage"] for summary in found.values())
    episodes = max(summary["run"]["episodes"] for summary in found.values())
    print_summaries(f"{len(found)} runs, {episodes} held-out episodes each", rows, goal, {LEAD: _lead})
    columns = find_columns(rows, goal)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *columns, "ahead_coverage_auc"])
    for name, row in rows:
        writer.writerow([name, *(row[column]["mean"] for column in columns), row.get(LEAD, {}).get("mean")])
    write_text(path, text.getvalue())
    return True


def _teams(run: str, summary: dict[str, Any]) -> list[tuple[str, dict]]:
    """The trained teams of a run, one of each size, with their lead over the best classical planner."""
    rows, best = [], summary["run"].get("best_classical", {})
    for name, figures in summary.items():
        if not TRAINED.fullmatch(name):
            continue
        size = name.removeprefix("trained")
        rival = best.get(size.removeprefix(" N=") or str(summary["run"]["num_robots"][0]), "") + size
        lead = summary.get("difference", {}).get(name, {}).get(rival, {}).get(DECIDES)
        rows.append((run + size, figures | ({LEAD: lead} if lead else {})))
    return rows


def _planners(found: dict[str, dict]) -> list[tuple[str, dict]]:
    """The policies beside them: once where all runs have the same episodes, else with the run's name. What each team
    started from is in its own run's table."""
    rows: dict[str, dict] = {}
    for run, summary in found.items():
        for name in summary["run"]["distinct_episodes"]:
            if TRAINED.fullmatch(name) or name.partition(" ")[0] in STARTS or summary[name] in rows.values():
                continue
            rows[f"{name}, {run}" if name in rows else name] = summary[name]
    return list(rows.items())


def _lead(row: dict[str, Any]) -> str:
    """In points of coverage over time, with its interval."""
    if LEAD not in row or row[LEAD]["mean"] is None:
        return ""
    return estimate(row[LEAD], POINTS)
