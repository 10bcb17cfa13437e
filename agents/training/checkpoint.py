"""Checkpoints: written whole or not at all, the newest few and the best kept, loaded without unpickling."""

import errno
import os
import random
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.modules import ProbabilisticActor

from maexp.agents.config.groups import LearnerSettings
from maexp.agents.config.model import SIZES, ModelConfig
from maexp.agents.config.resolved import flatten
from maexp.agents.errors import UserError, advise_on_disk
from maexp.agents.files import command, short, write_file
from maexp.agents.models.actor import load_matching, make_policy
from maexp.envs import ExplorationEnv

NAME = re.compile(r"iteration_(\d+)\.pt")
BEST = "best.pt"
START = "iteration_000000.pt"
"""What the training started from; it stays."""
FORMAT = "maexp-checkpoint-1"
KINDS = {"overrides": list, "settings": dict, "followers": list, "maps": dict, "iteration": int, "policy": dict}
"""What every reader of a checkpoint relies on."""


def save_checkpoint(folder: Path, state: dict, iteration: int, keep: int, best: bool = False) -> Path:
    """Write `state` as the checkpoint of `iteration` and delete all but the newest `keep` and the start.

    Args:
        folder: the run's `checkpoints/`
        state: tensors, numbers, text and containers of these
        best: write it as `best.pt` too
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, state = folder / f"iteration_{iteration:06d}.pt", {"format": FORMAT} | state
    for target in [path] + [folder / BEST] * best:
        _write_atomically(target, state)
    for old in list_checkpoints(folder)[keep:]:
        if old.name != START:
            old.unlink()
    for leftover in folder.glob(".*.part"):
        leftover.unlink()
    return path


def _write_atomically(path: Path, state: dict) -> None:
    """A kill at any moment leaves the old file or the new one."""
    try:
        write_file(path, lambda file: torch.save(state, file))
    except (OSError, RuntimeError) as error:  # torch raises the latter when a write fails
        reason = getattr(error, "strerror", None) or "the disk is full or the file too large"
        advice = advise_on_disk(getattr(error, "errno", None) or errno.ENOSPC)
        if list_checkpoints(path.parent):
            again = command("train", f"resume={short(path.parent.parent)}")
            after = f"go on with {again}; the checkpoints before this one are whole"
        else:
            after = "start again: there is no checkpoint yet"
        raise UserError(f"The checkpoint {path} could not be written ({reason}): {advice}, then {after}.") from error


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run by iteration, newest first, without the best."""
    found = [path for path in folder.glob("iteration_*.pt") if NAME.fullmatch(path.name)]
    return sorted(found, key=lambda path: int(NAME.fullmatch(path.name)[1]), reverse=True)


def load_checkpoint(path: Path) -> dict:
    """The state in one file, on the CPU.

    Raises:
        UserError: no such file, or not a whole checkpoint.
    """
    if not path.is_file():
        raise UserError(f"{path} is not a file: give a run's folder or a checkpoint in it.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file fails anywhere inside zip and pickle
        raise UserError(
            f"{path} is not a whole checkpoint of maexp train: it is damaged or something else. "
            "A model of another library plays as policy=module:function (docs/extending.md)."
        ) from error
    if not _is_ours(state):
        raise UserError(f"{path} is no checkpoint of the kind {FORMAT}: train again, or use the version that wrote it.")
    return state


def _is_ours(state: object) -> bool:
    """Whether a file holds the kinds of values that `maexp train` puts there."""
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        return False
    if any(not isinstance(state.get(key), kind) for key, kind in KINDS.items()):
        return False
    words, weights = [*state["overrides"], *state["followers"]], state["policy"].values()
    if not all(isinstance(spec, str) for spec in words) or not all(torch.is_tensor(weight) for weight in weights):
        return False
    groups = [state["settings"].get(name) for name in ("scenario", "planner")]
    return all(isinstance(group, dict) and isinstance(group.get("name"), str) for group in groups)


def find_checkpoint(place: str | Path) -> tuple[Path, dict]:
    """(file, state) of a checkpoint file, or of the newest whole checkpoint of a run's folder.

    A damaged one is passed over with a warning.

    Raises:
        UserError: there is none.
    """
    place = Path(place)
    if place.is_file():
        return place, load_checkpoint(place)
    if not place.is_dir():
        raise UserError(f"{place} does not exist: give a run's folder or a checkpoint in it.")
    folder = place / "checkpoints" if (place / "checkpoints").is_dir() else place
    for path in list_checkpoints(folder):
        try:
            return path, load_checkpoint(path)
        except UserError as error:
            warnings.warn(f"{error} Falling back to the one before.", stacklevel=2)
    raise UserError(f"{place} holds no whole checkpoint: give the folder of a run of maexp train.")


def is_run(place: Path) -> bool:
    """Whether this is a checkpoint or the folder of a run of `maexp train`."""
    if place.suffix == ".pt":
        return True
    return os.path.isdir(place) and (os.path.isdir(place / "checkpoints") or any(place.glob("iteration_*.pt")))


def model_of(saved: dict) -> ModelConfig:
    """The sizes of the networks in a checkpoint."""
    values = {
        name.removeprefix("model."): value
        for name, value in flatten(saved["settings"]).items()
        if name.startswith("model.") and value is not None
    }
    return replace(SIZES[values.pop("preset", "small")], **values)


def looks_at_radios(saved: dict) -> bool:
    """Whether the policy of a checkpoint looks at what targets tell of radios."""
    return bool(flatten(saved["settings"]).get("observation.radio", False))


def check_action(saved: dict, cfg: LearnerSettings) -> None:
    """Refuse weights trained for the other kind of action: goals and controls have tensors of the same shapes.

    Raises:
        UserError: one of the two planners is `direct`, the other not.
    """
    trained = saved["settings"]["planner"]["name"]
    if (trained == "direct") != (cfg.planner.name == "direct"):
        raise UserError(
            f"The checkpoint was trained with planner={trained} and planner={cfg.planner.name} takes another action: "
            f"leave planner={cfg.planner.name} out, or train a policy with it."
        )


def restore_policy(env: ExplorationEnv, model: str | ModelConfig, saved: dict) -> ProbabilisticActor:
    """The policy of a checkpoint, for the teams of `env`.

    Raises:
        UserError: its weights belong to another network.
    """
    policy = make_policy(env, model, looks_at_radios(saved))
    load_matching(policy, saved["policy"])
    return policy


def random_state() -> dict[str, Any]:
    """The states of the random generators of torch, NumPy and Python, as tensors and numbers."""
    kind, keys, *rest = np.random.get_state()
    version, words, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [kind, torch.from_numpy(keys.astype(np.int64)), *rest],
        "python": [version, list(words), gauss],
    }


def set_random_state(state: dict[str, Any]) -> None:
    """Go on with the random numbers where `random_state` was taken."""
    torch.set_rng_state(state["torch"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])
    kind, keys, *rest = state["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))


def seed_everything(seed: int) -> None:
    """Seed torch, NumPy and Python."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)
