"""`maexp export`: the policy of a run as a folder that robots plan with (`maexp.agents.runtime`)."""

from pathlib import Path
from typing import Any

from maexp.agents.build import load_maps, make_env, title_scenario
from maexp.agents.cli import Command
from maexp.agents.cli.evaluate import find_trained
from maexp.agents.cli.run_folder import check_writable, remove_if_empty
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.overrides import find_override
from maexp.agents.config.runs import Recipe, continue_run
from maexp.agents.config.verbs import ExportSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import short
from maexp.agents.policies.export import export_policy, find_chooser
from maexp.agents.policies.model_card import RESULTS, find_results, write_card
from maexp.agents.training.checkpoint import find_checkpoint


def prepare(overrides: list[str]) -> Recipe:
    """The settings of the run, then the new words."""
    place = find_override(overrides, "checkpoint")
    if place is None:
        raise UserError("Nothing to export: give a run, as in maexp export RUN out=FOLDER.")
    return continue_run(*find_checkpoint(place), overrides, "export")


def check(cfg: ExportSettings) -> None:
    """Raise UserError for what cannot be written."""
    team_sizes(cfg.num_robots)
    if not cfg.out:
        raise UserError("out is missing: name the folder to write, as in maexp export RUN out=FOLDER.")
    check_writable(Path(cfg.out).absolute())


def run(cfg: ExportSettings, where: Path, overrides: list[str]) -> int:
    """Write the folder."""
    out = Path(cfg.out)
    sizes = team_sizes(cfg.num_robots)
    path, saved = find_checkpoint(cfg.checkpoint)
    with blame_input():
        env = make_env(cfg, load_maps(cfg.scenario, train=False).held_out[:1], sizes[0], 1)
        policy = find_trained(cfg).make(env)
        starts_from = find_chooser(policy).starts_from
        name, trained = cfg.name or out.absolute().name, describe_training(cfg, saved)
        card = write_card(name, trained, starts_from, result_files(cfg, path), cfg.note)
        export_policy(policy, env, out, name, card, trained)
    remove_if_empty(where)
    files = ", ".join(f"{file.name} ({file.stat().st_size / 1024:.0f} kB)" for file in sorted(out.iterdir()))
    print(f"Written to {short(out.absolute())}: {files}")
    return 0


def describe_training(cfg: ExportSettings, saved: dict) -> dict[str, Any]:
    """How the policy of a checkpoint was trained."""
    return {
        "scenarios": [cfg.scenario.name, *map(title_scenario, cfg.scenario.also or [])],
        "num_robots": team_sizes(cfg.num_robots),
        "algorithm": cfg.algorithm.name,
        "seed": cfg.seed,
        "iteration": saved["iteration"],
        "frames": saved["settings"]["total_frames"],
        "commit": saved.get("commit"),
    }


def result_files(cfg: ExportSettings, checkpoint: Path) -> list[Path]:
    """Results of the evaluations that are named, or else of the run's own."""
    if cfg.results:
        return [find_results(Path(folder)) for folder in split_folders(cfg.results)]
    own = checkpoint.parent.parent / RESULTS[1]
    return [own] if own.is_file() else []


def split_folders(text: str) -> list[str]:
    """`a,b` as two folders, where there is none of that name."""
    return [text] if Path(text).exists() else [part.strip() for part in text.split(",") if part.strip()]


COMMAND = Command(run, check, prepare=prepare)
