"""`maexp train -m`: every combination of the listed values, through Hydra's sweeper and launchers."""

import json
import sys
from pathlib import Path

from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from maexp.agents.cli import train
from maexp.agents.cli.run_folder import claim_folder
from maexp.agents.config.compose import compose, compose_settings, explain, make_object, register_schema
from maexp.agents.config.overrides import find_override, find_sweeps, quote, set_names, without
from maexp.agents.config.runs import Recipe
from maexp.agents.errors import STOPPED, UserError
from maexp.agents.evaluation.comparison import keeping_episodes
from maexp.agents.evaluation.sweep_table import tell_runs
from maexp.agents.files import command, lock, short, write_json
from maexp.agents.training.checkpoint import list_checkpoints

SWEEP, FORMAT = "sweep.json", "maexp-sweep-1"
DONE = "done"
"""In the folder of a run that has come to its end."""


def run_sweep(verb: str, overrides: list[str]) -> int:
    """Run all jobs, each in its own folder under one new folder, or those that `resume` finds undone in an old one; a
    job that fails ends the sweep after its batch."""
    place = find_override(overrides, "resume")
    if place is not None:
        folder, words = Path(place).expanduser().absolute(), read_words(place, overrides)
    else:
        chosen = find_override(overrides, "hydra.sweep.dir")
        folder = claim_folder(chosen or compose(verb, []).sweep_dir, chosen is not None)
        words = without(overrides, "hydra.sweep.dir")
    swept = find_sweeps(words)
    if "seed" in swept and find_override(words, "evaluation_seed") is None:  # the same episodes judge all teams
        words.append(f"evaluation_{swept['seed'][0]}")
    with lock(folder, f"maexp {verb} -m"):
        write_json(folder / SWEEP, {"format": FORMAT, "words": words})
        try:
            _run_jobs(verb, [*words, f"hydra.sweep.dir={quote(str(folder))}"])
        except (KeyboardInterrupt, UserError) as error:
            again = command(verb, "-m", f"resume={short(folder)}")
            print(f"Runs that are done stay. Go on with: {again}", file=sys.stderr)
            if isinstance(error, UserError):
                raise
            return STOPPED
        runs = swept_words(folder, [*swept])
        combine_curves(runs, folder / "curves.png")
        evaluated = tell_runs({" ".join(words) or path.name: path for path, words in runs.items()}, folder / "runs.csv")
    table = ", their table in runs.csv" * evaluated
    print(f"All runs are in {short(folder)}, their curves together in curves.png{table}")
    return 0


def read_words(place: str, overrides: list[str]) -> list[str]:
    """The words of the sweep in a folder.

    Raises:
        UserError: there is none, or something else is set beside it.
    """
    if others := [name for name in set_names(overrides) if name != "resume"]:
        raise UserError(f"resume={place} with -m keeps all settings of a sweep: leave {others[0]} out.")
    try:
        content = json.loads((Path(place).expanduser() / SWEEP).read_text())
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        return [str(word) for word in content["words"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        told = f"resume={place} with -m: there is no {SWEEP} of a sweep that could be read ({type(error).__name__})"
        raise UserError(f"{told}. For a single run leave out -m.") from error


def _run_jobs(verb: str, words: list[str]) -> None:
    register_schema(verb)
    GlobalHydra.instance().clear()
    with initialize_config_module("maexp.conf", version_base="1.3"), keeping_episodes():
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None  # of the line above
        try:
            hydra.multirun(verb, _run_job, words)
        except (HydraException, OmegaConfBaseException) as error:
            raise UserError(explain(error, verb)) from error


def swept_words(folder: Path, names: list[str]) -> dict[Path, list[str]]:
    """The runs below `folder`, with the words of each that set one of `names`."""
    runs = {}
    for config in sorted(folder.glob("*/config.yaml"), key=lambda path: (len(path.parent.name), path.parent.name)):
        words = config.read_text().splitlines()[0].split()[3:]
        runs[config.parent] = [word for word in words if word.partition("=")[0] in names]
    return runs


def combine_curves(runs: dict[Path, list[str]], path: Path) -> None:
    """The learning curves of all runs: one line per setting, the seeds averaged."""
    from maexp.agents.evaluation.learning_curves import draw_curves

    settings: dict[str, list[Path]] = {}
    for folder, words in runs.items():
        settings.setdefault(" ".join(word for word in words if not word.startswith("seed=")), []).append(folder)
    draw_curves(settings, path)


def _run_job(composed: DictConfig) -> None:
    """Train from the start, go on with what was stopped, or pass over what is done."""
    settings = HydraConfig.get()
    overrides, where = list(settings.overrides.task), Path(settings.runtime.output_dir)
    title = f"Run {settings.job.num}: {' '.join(overrides)}"
    if (where / DONE).is_file():
        print(f"{title} (done before)")
        return
    print(title)
    if list_checkpoints(where / "checkpoints"):
        recipe = train.prepare([f"resume={quote(str(where))}"])
        cfg, overrides = compose_settings("train", recipe), without(recipe.words, "hydra", "resume")
    elif (recipe := train.prepare(overrides)).defaults:
        cfg = compose_settings("train", recipe)
    else:
        cfg = make_object("train", composed, Recipe(overrides))
    train.check(cfg)
    if train.run(cfg, where, overrides):
        raise KeyboardInterrupt
    (where / DONE).touch()
