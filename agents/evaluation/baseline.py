"""An earlier evaluation as a baseline: what a change of settings or code changed, in the same episodes."""

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.metric_format import compared
from maexp.agents.evaluation.results import FORMAT, result_names
from maexp.agents.files import short, write_text

EPISODES_FILE, CHANGES_FILE = "episodes.csv", "changes.json"
KEY = ("policy", "num_robots", "map")  # columns before those of the metrics
ALIKE = ("scenario", "maps", "seed", "episodes", "steps")
"""Of `run` in results.json: two runs with the same can be paired."""


@dataclass
class Baseline:
    """An earlier evaluation.

    Attributes:
        folder: where it is
        run: what was run, as in its results.json
        results: (policy, team size) -> its episodes on all maps
    """

    folder: Path
    run: dict
    results: dict[tuple[str, int], EvaluationResult]

    def check(self, run: dict, pairs: list[tuple[str, int]]) -> None:
        """Raise UserError unless a run plays the same episodes, and a policy in a team's size that is here too.

        Args:
            run: its values of `ALIKE`
            pairs: (policy, team size) of what it plays
        """
        for name in ALIKE:
            if self.run.get(name) != run[name]:
                raise UserError(
                    f"baseline={short(self.folder)} played other episodes ({name}: {_brief(self.run.get(name))} there, "
                    f"{_brief(run[name])} here): evaluate both with the same."
                )
        if not set(pairs) & set(self.results):
            there = ", ".join(f"{policy} with num_robots={size}" for policy, size in self.results)
            raise UserError(f"baseline={short(self.folder)} holds {there}: evaluate one of these.")

    def changes(self, results: list[EvaluationResult]) -> dict[str, dict]:
        """{name: {metric: {mean, std, ci95, n}}} of each result less the earlier one, where there is one; maps that
        were played one by one have their own."""
        found = {}
        for name, result in zip(result_names(results), results, strict=True):
            before = self.results.get((result.policy, result.num_robots))
            if before is not None:
                found[name] = result.minus(_on(before, result.place))
        return found


def write_episodes(path: Path, results: list[EvaluationResult]) -> None:
    """A line for each episode of each policy and team size: every metric, nothing where the episode has none."""
    whole = [result for result in results if not result.place]
    metrics = list(whole[0].episodes)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*KEY, *metrics])
    for result in whole:
        for k, place in enumerate(result.maps):
            values = (float(result.episodes[metric][k]) for metric in metrics)
            numbers = ("" if np.isnan(value) else value for value in values)
            writer.writerow([result.policy, result.num_robots, place, *numbers])
    write_text(path, text.getvalue())


def load_baseline(path: str) -> Baseline:
    """An earlier evaluation's folder.

    Raises:
        UserError: no such folder, or another kind.
    """
    folder = Path(path).expanduser().absolute()
    try:
        run = json.loads((folder / "results.json").read_text())["run"]
        if run["format"] != FORMAT:
            raise ValueError(run["format"])
        with open(folder / EPISODES_FILE, newline="") as file:
            rows = list(csv.DictReader(file))
        metrics = [name for name in rows[0] if name not in KEY]
        teams = list(dict.fromkeys((row["policy"], int(row["num_robots"])) for row in rows))
        results = {team: _read_result(*team, rows, metrics) for team in teams}
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError(
            f"baseline={path} is no folder of maexp evaluate with {EPISODES_FILE} and results.json of kind {FORMAT} "
            f"({type(error).__name__}): give one, or evaluate again what it was."
        ) from error
    return Baseline(folder, run, results)


def describe_changes(changes: dict[str, dict], folder: Path, goal: float) -> list[str]:
    """A sentence for each result of episodes that end at the coverage `goal`: how far it is from the baseline."""
    told = compared(goal)
    amounts = {
        name: [measure.describe_difference(found[measure.metric]) for measure in told]
        for name, found in changes.items()
    }
    return [f"{name} less {short(folder)}: {', '.join(amount)}." for name, amount in amounts.items()]


def _on(result: EvaluationResult, place: str) -> EvaluationResult:
    """The episodes on one map; "": on all."""
    if not place:
        return result
    here = result.maps == place
    episodes = {metric: values[here] for metric, values in result.episodes.items()}
    return EvaluationResult(result.policy, result.num_robots, episodes, 0.0, result.maps[here], place=place)


def _read_result(policy: str, size: int, rows: list[dict], metrics: list[str]) -> EvaluationResult:
    mine = [row for row in rows if (row["policy"], int(row["num_robots"])) == (policy, size)]
    episodes = {metric: np.array([float(row[metric] or "nan") for row in mine]) for metric in metrics}
    return EvaluationResult(policy, size, episodes, 0.0, np.array([row["map"] for row in mine]))


def _brief(value: Any) -> str:
    words = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    return words if len(words) <= 60 else f"{words[:57]}..."
