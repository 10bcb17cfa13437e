"""The card of an exported policy: what it was trained on, how well it does, what it is not good for, in Markdown."""

import json
from pathlib import Path
from typing import Any

from maexp.agents.errors import UserError
from maexp.agents.evaluation.metric_format import MEASURES
from maexp.agents.tables import estimate, markdown_table

SHOWN = (
    "exploration_ratio",
    "coverage_auc",
    "coverage_step_85_censored",
    "coverage_step_95_censored",
    "success_rate",
    "collisions",
)
RESULTS = ("results.json", "summary.json")  # of maexp evaluate, of maexp train
NEXT = "coverage_auc"  # differences are told in it


def write_card(name: str, trained: dict[str, Any], starts_from: str, files: list[Path], note: str | None = None) -> str:
    """The card.

    Args:
        trained: how it was trained, as in the contract, with the names of its scenarios.
        starts_from: the planner, as of `ModelConfig`.
        files: results of its evaluations.
        note: what else is to be known of the training.
    """
    places = ", ".join(f"`{scenario}`" for scenario in trained["scenarios"])
    teams = ", ".join(map(str, trained["num_robots"]))
    lines = [
        f"# {name}",
        "",
        "Chooses which frontier target each robot of a team goes to next. It starts from what the classical planner "
        f"`{starts_from}` thinks of a target, and has learned where to differ.",
        "",
        "## Training",
        "",
        f"`{trained['algorithm']}` on {places}, teams of {teams}, {trained['frames']:,} macro steps of teams, seed "
        f"{trained['seed']}, commit {trained['commit']}.",
        "",
        *([note, ""] if note else []),
        "## Results",
        "",
    ]
    for file in files:
        lines += describe_results(file)
    if not files:
        lines += ["It has not been evaluated.", ""]
    lines += [
        "## Not good for",
        "",
        "- maps without a common frame, and robots that do not hear each other: it has seen neither;",
        "- places where people walk: it knows nothing of what moves;",
        "- robots that see less than all around.",
        "",
    ]
    return "\n".join(lines)


def find_results(place: Path) -> Path:
    """The results in the folder of a run or an evaluation.

    Raises:
        UserError: there are none.
    """
    found = [place / name for name in RESULTS if (place / name).is_file()]
    if not found:
        raise UserError(f"results={place} holds no results.json: give the folder of an evaluation of the policy.")
    return found[0]


def describe_results(file: Path) -> list[str]:
    """An evaluation as a table, with its differences to the best classical planner.

    Raises:
        UserError: it is none.
    """
    try:
        content = json.loads(file.read_text())
        run = content["run"]
        rows = {name: values for name, values in content.items() if SHOWN[0] in values}
        teams = f"teams of {run['num_robots'][0]}, " if len(run["num_robots"]) == 1 else ""
        lines = [
            f"`{run['scenario']}`, {describe_maps(run)}, {run['episodes']} episodes, {teams}mean and 95 % interval:",
            "",
        ]
        cells = [[name, *(_cell(values.get(metric)) for metric in SHOWN)] for name, values in rows.items()]
        return [
            *lines,
            *markdown_table(["policy", *(MEASURES[metric].column for metric in SHOWN)], cells),
            "",
            *_differences(content),
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{file} is not the results of an evaluation ({type(error).__name__}: {reason}).") from error


def describe_maps(run: dict[str, Any]) -> str:
    """How many maps there were, or which."""
    maps = run["maps"]
    count = f"{len(maps)} {'held-out ' * bool(run.get('held_out'))}maps"
    return count if run.get("held_out") or len(maps) > 5 else ", ".join(maps)


def _differences(content: dict[str, Any]) -> list[str]:
    """A sentence a learned team: how far it is ahead of the best classical planner on the same episodes."""
    sentences = []
    for size, best in content["run"].get("best_classical", {}).items():
        for name, rivals in content.get("difference", {}).items():
            label = next((name for name in (f"{best} N={size}", best) if name in rivals), None)
            if label is not None:
                apart = MEASURES[NEXT].describe_difference(rivals[label][NEXT], digits=2)
                sentences += [
                    f"{name} less {label}, the best classical planner on the validation maps, on the same episodes: "
                    f"{apart}.",
                    "",
                ]
    return sentences


def _cell(value: Any) -> str:
    if not isinstance(value, dict) or value.get("mean") is None:
        return ""
    return estimate(value, _short)


def _short(value: float) -> str:
    """Three digits, and 0 for what rounding left of it."""
    return f"{round(value, 6) + 0.0:.3g}"
