"""The episode cache: what an evaluation was asked for and the batches that it has played, so that it resumes."""

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from maexp.agents.config.groups import CommonSettings
from maexp.agents.config.overrides import from_root, set_names
from maexp.agents.config.resolved import flatten, plain, resolve
from maexp.agents.config.runs import PLAYED, Recipe
from maexp.agents.config.verbs import EvaluateSettings
from maexp.agents.errors import UserError
from maexp.agents.files import checksums, short, write_file, write_text
from maexp.agents.versions import find_commit
from maexp.envs import ExplorationEnv
from maexp.envs.maps.point_cloud import MapError, read_npz

FOLDER = "batches"
"""Of a run; gone when its results are written."""


class EpisodeCache:
    """The batches of one policy in one env.

    Args:
        folder: their own
        identity: what their bits follow from (`identify`); those of another are removed, with a warning
    """

    def __init__(self, folder: Path, identity: dict[str, Any]):
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:16]
        self.folder = folder / digest
        for other in folder.glob("*"):
            if other != self.folder:
                told = f"what {folder.name} was played with has changed since: its episodes are played again"
                warnings.warn(told, stacklevel=2)
                shutil.rmtree(other)

    def read(self, first: int) -> dict[str, np.ndarray] | None:
        """The batch that begins with an episode; None where it is missing or damaged."""
        try:
            return read_npz(self._file(first)) if self._file(first).is_file() else None
        except MapError:
            return None

    def write(self, first: int, arrays: dict[str, np.ndarray]) -> None:
        """Keep a batch; it is whole or not there, wherever this process ends."""
        write_file(self._file(first), lambda file: np.savez(file, **arrays))

    def _file(self, first: int) -> Path:
        return self.folder / f"{first:06d}.npz"


def identify(
    cfg: CommonSettings, env: ExplorationEnv, episodes: int, policy: Callable, name: str, source: str = ""
) -> dict[str, Any]:
    """What the bits of a policy's episodes follow from.

    Args:
        cfg: the settings of the env
        policy: as it plays; name, source: what it is called, and text that changes with it
    """
    settings = resolve(cfg, env.maps)
    return {
        "settings": {name: settings[name] for name in PLAYED if name in settings and name != "num_threads"},
        "maps": checksums(env.maps),
        "teams": [env.num_envs, env.num_robots, str(env.device)],
        "episodes": episodes,
        "policy": [name, source, digest_weights(policy)],
        "code": [metadata.version("maexp"), find_commit()],
    }


def digest_weights(policy: Callable) -> str:
    """Changes with the weights of a network; "" for what has none."""
    digest = hashlib.sha256()
    weights = policy.state_dict() if isinstance(policy, torch.nn.Module) else {}
    for name, weight in weights.items():
        digest.update(
            name.encode() + (weight.cpu().numpy().tobytes() if torch.is_tensor(weight) else repr(weight).encode())
        )
    return digest.hexdigest()[:16] if weights else ""


def random_numbers(device: torch.device) -> dict[str, np.ndarray]:
    """Where torch's random numbers are."""
    found = {"cpu": torch.get_rng_state()}
    found |= {"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {}
    return {f"random_{name}": state.numpy() for name, state in found.items()}


def go_on_with_random_numbers(arrays: dict[str, np.ndarray], device: torch.device) -> None:
    """Go on from `random_numbers`."""
    torch.set_rng_state(torch.from_numpy(arrays["random_cpu"]))
    if device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(arrays["random_cuda"]), device)


ASKED, FORMAT = "evaluation.json", "maexp-evaluation-1"
PATHS = ("checkpoint", "baseline")


def begin(where: Path, cfg: EvaluateSettings, overrides: list[str]) -> None:
    """Keep the settings of an evaluation, folders as such from the root.

    Args:
        cfg: as they were composed
        overrides: the words of the command line, for its config.yaml
    """
    settings = {name: value for name, value in flatten(plain(cfg)).items() if name != "resume"}
    settings |= {name: str(Path(settings[name]).absolute()) for name in PATHS if settings[name] is not None}
    words = settings["policy"]
    settings["policy"] = [from_root(spec) for spec in words] if isinstance(words, list) else words and from_root(words)
    content = {"format": FORMAT, "overrides": overrides, "settings": settings}
    write_text(where / FOLDER / ASKED, json.dumps(content, indent=2) + "\n")  # inf stays inf


def is_begun(where: Path) -> bool:
    """Whether an evaluation in this folder can go on."""
    return (where / FOLDER / ASKED).is_file()


def continue_evaluation(place: str, overrides: list[str]) -> Recipe:
    """The settings of the evaluation in a folder.

    Raises:
        UserError: there is none that was stopped, or the words set something anew.
    """
    if others := [name for name in set_names(overrides) if name != "resume"]:
        raise UserError(f"resume={place} keeps what was played and where: leave {others[0]} out.")
    where = Path(place).expanduser()
    if not is_begun(where):
        found = "is finished" if (where / "results.json").is_file() else "holds no evaluation that was stopped"
        raise UserError(f"resume={place} {found}: give the folder of a maexp evaluate that did not come to its end.")
    path = where / FOLDER / ASKED
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        words, values = [str(spec) for spec in content["overrides"]], dict(content["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{short(path)} is damaged, or not of the kind {FORMAT}: evaluate anew.") from error
    return Recipe([*words, *overrides], values=values, source=str(path))
