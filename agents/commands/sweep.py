"""`maexp train -m`: every combination of the listed values, through Hydra's sweeper and launchers."""

import os
import sys
from pathlib import Path
from unittest import mock

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from maexp.agents.commands import train
from maexp.agents.commands.run_folder import claim_folder
from maexp.agents.errors import UserError
from maexp.agents.settings.checks import check_seed
from maexp.agents.settings.compose import compose_config, explain
from maexp.agents.settings.overrides import find_override, without
from maexp.agents.settings.schema import TrainSettings, register_schema


def run_sweep(verb: str, overrides: list[str]) -> int:
    """Run all jobs, each in its own folder under one new folder; a job that fails ends the sweep after its batch."""
    if find_override(overrides, "resume") is not None:
        raise UserError("resume continues one run: leave out -m.")
    register_schema(verb)
    chosen = find_override(overrides, "hydra.sweep.dir")
    folder = claim_folder(chosen or _default_folder(verb), chosen is not None)
    words = [*without(overrides, "hydra.sweep.dir"), f"hydra.sweep.dir='{folder}'"]
    job = hydra.main(version_base="1.3", config_path="pkg://maexp.conf", config_name=verb)(_run_job)
    with mock.patch.object(sys, "argv", [f"maexp {verb}", "-m", *words]), _raise_errors():
        try:
            job()
        except (HydraException, OmegaConfBaseException) as error:
            raise UserError(explain(error, verb)) from error
    combine_curves(folder)
    print(f"All runs are in {folder}, their curves together in curves.png")
    return 0


def combine_curves(folder: Path) -> None:
    """curves.png of all runs below `folder`: one line per setting, the seeds averaged."""
    from maexp.agents.evaluation.plots import draw_curves

    settings: dict[str, list[Path]] = {}
    for config in sorted(folder.glob("*/config.yaml")):
        words = config.read_text().splitlines()[0].split()[3:]
        swept = " ".join(word for word in words if not word.startswith("seed="))
        settings.setdefault(swept or "all", []).append(config.parent)
    common = set.intersection(*(set(name.split()) for name in settings)) if len(settings) > 1 else set()
    named = {" ".join(w for w in name.split() if w not in common): runs for name, runs in settings.items()}
    draw_curves(named, folder / "curves.png")


def _raise_errors():
    """Hydra prints tracebacks and exits unless it is told to raise."""
    return mock.patch.dict(os.environ, HYDRA_FULL_ERROR="1")


def _default_folder(verb: str) -> str:
    return OmegaConf.select(compose_config(verb, []), "hydra.sweep.dir")


def _run_job(cfg: TrainSettings) -> None:
    settings = HydraConfig.get()
    overrides = list(settings.overrides.task)
    print(f"Run {settings.job.num}: {' '.join(overrides)}")
    check_seed(cfg.seed)  # Hydra composed these settings, not compose_config
    train.check(cfg)
    status = train.run(cfg, Path(settings.runtime.output_dir), overrides)
    if status:
        raise KeyboardInterrupt
