"""`maexp export`: the policy of a run as a folder that robots plan with (`maexp.agents.runtime`)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maexp.agents.build import load_maps, make_env
from maexp.agents.checkpoint import find_checkpoint
from maexp.agents.commands.evaluate import load_policy
from maexp.agents.commands.run_folder import check_writable, remove_if_empty, short
from maexp.agents.errors import UserError, blame_input
from maexp.agents.export import export_policy, find_chooser
from maexp.agents.settings.checks import check_counts
from maexp.agents.settings.overrides import find_override
from maexp.agents.settings.runs import Recipe, continue_run

SHOWN = ("exploration_ratio", "coverage_auc", "coverage_step_85_censored", "success_rate", "collisions")


def prepare(overrides: list[str]) -> Recipe:
    """The settings of the run, then the new words."""
    place = find_override(overrides, "checkpoint")
    if place is None:
        raise UserError("Nothing to export: give a run, as in maexp export RUN out=FOLDER.")
    return continue_run(*find_checkpoint(place), overrides, "export")


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path:
    """A new folder, which stays empty: what is written goes to `out`."""
    return claim()


def check(cfg: Any) -> None:
    """Raise UserError for what cannot be written."""
    check_counts(cfg, "num_robots")
    if not cfg.out:
        raise UserError("out is missing: name the folder to write, as in maexp export RUN out=FOLDER.")
    check_writable(Path(cfg.out).absolute())


def run(cfg: Any, where: Path, overrides: list[str]) -> int:
    """Write the folder."""
    out = Path(cfg.out)
    with blame_input():
        env = make_env(cfg, load_maps(cfg.scenario, train=False).held_out[:1], cfg.num_robots, 1)
        policy = load_policy(cfg, env, [])  # it is not played: no map of its training need still be there
        find_chooser(policy)
        name = cfg.name or out.absolute().name
        export_policy(policy, env, out, name, write_card(cfg, name))
    remove_if_empty(where)
    sizes = ", ".join(f"{file.name} ({file.stat().st_size / 1024:.0f} kB)" for file in sorted(out.iterdir()))
    print(f"Written to {short(out.absolute())}: {sizes}")
    return 0


def write_card(cfg: Any, name: str) -> str:
    """What the policy was trained on and how well it does, in Markdown, as far as the run says it."""
    path, saved = find_checkpoint(cfg.checkpoint)
    lines = [
        f"# {name}", "",
        f"Chooses frontier targets for teams of {cfg.num_robots} robots. Trained on `{cfg.scenario.name}` with "
        f"`{cfg.algorithm.name}`, seed {cfg.seed}, up to iteration {saved['iteration']} ({path.name}).", "",
    ]  # fmt: skip
    lines += read_results(path.parent.parent / "summary.json")
    lines += [
        "Not for maps without a common frame, nor where people walk: it has seen neither.", "",
    ]  # fmt: skip
    return "\n".join(lines)


def read_results(file: Path) -> list[str]:
    """The run's evaluation on held-out maps as a table; a sentence where there is none."""
    try:
        summary = json.loads(file.read_text())
    except (OSError, ValueError):
        return ["It has not been evaluated.", ""]
    rows = [(policy, values) for policy, values in summary.items() if SHOWN[0] in values]
    lines = ["On held-out maps, mean and 95 % interval:", "", f"| policy | {' | '.join(SHOWN)} |"]
    lines.append("| --- " * (len(SHOWN) + 1) + "|")
    for policy, values in rows:
        cells = [_cell(values.get(metric)) for metric in SHOWN]
        lines.append(f"| {policy} | {' | '.join(cells)} |")
    return [*lines, ""]


def _cell(value: Any) -> str:
    if not isinstance(value, dict) or value.get("mean") is None:
        return ""
    low, high = (value.get("ci95") or [None, None])[:2]
    interval = "" if low is None or high is None else f" ({low:.3g} to {high:.3g})"
    return f"{value['mean']:.3g}{interval}"
