"""Policy bundles: folders with `policy.onnx`, `weights.safetensors` and `contract.json`; those that ship, by name."""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from maexp.agents.deploy.planner.features import Candidates, Motion
from maexp.agents.deploy.planner.scene import ArrayScene
from maexp.envs.targets.features import FEATURES, feature_names
from maexp.envs.targets.heuristics import rank

CONTRACT = "contract.json"
SHIPPED = Path(__file__).resolve().parents[2] / "shipped"


def shipped_names() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONTRACT}"))


def find_policy(policy: str | Path, others: Iterable[str] = (), setting: str = "policy") -> Path:
    """The folder of a trained policy: of one that ships, by its name, or the one that is named itself.

    Args:
        others: further names that could have been meant, for the message.
        setting: what the message calls it.

    Raises:
        ValueError: it is neither.
    """
    if str(policy) in shipped_names():
        return SHIPPED / str(policy)
    place = Path(policy) if isinstance(policy, str | Path) and policy != "" else None
    if place is not None and os.path.isdir(place):  # unlike Path.is_dir it takes names that are too long for any file
        return place
    if place is not None and os.path.exists(place):
        raise ValueError(f"{setting}={policy} is a file: give the folder that maexp export wrote")
    word = str(policy)[:100]
    raise ValueError(f"{setting}={word} is unknown: {advise(word, [*others, *shipped_names()])}")


def advise(word: str, names: list[str]) -> str:
    """What to give instead of a name that is unknown: those near it, or all."""
    if near := difflib.get_close_matches(word, names, 3, 0.7):
        return f"did you mean {' or '.join(near)}?"
    return f"choose one of {', '.join(names)}, or the folder of a trained policy"


FORMAT = "maexp-policy-2"
NETWORK, WEIGHTS, CARD = "policy.onnx", "weights.safetensors", "card.md"
AGAIN = "export the policy again"
INPUTS = ("features", "mask", "comm")
NUMBERS = ("radar_range", "robot_radius", "max_speed", "max_accel", "seconds")


@dataclass(frozen=True)
class Contract:
    """What a policy was trained for.

    Attributes:
        name: of the policy.
        candidates: targets that each robot is shown.
        radar_range, robot_radius: [m].
        motion: how its robots moved.
        radio: it looks at what targets tell of radios (``observation.radio``).
        content: all that the file says.
    """

    name: str
    candidates: int
    radar_range: float
    robot_radius: float
    motion: Motion
    radio: bool = False
    content: dict[str, Any] = field(default_factory=dict, repr=False)


class LearnedChoice:
    """Thinks of targets as a trained policy does, the likeliest first.

    Args:
        folder: where it lies.

    Raises:
        ValueError: it is not such a folder, damaged, or of another version; or onnxruntime is not installed.
    """

    def __init__(self, folder: str | Path):
        folder = Path(folder)
        self.contract = read_contract(folder)
        try:
            import onnxruntime
        except ImportError:
            raise ValueError(f"{folder} is a trained policy and needs onnxruntime: pip install onnxruntime") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(
                (folder / NETWORK).read_bytes(), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime raises classes of its own
            reason = " ".join(str(error).split())[:200]
            raise ValueError(f"{folder / NETWORK} is not a network that onnxruntime runs ({reason})") from None
        taken = {tensor.name: tensor.shape for tensor in self.session.get_inputs()}
        width = len(feature_names(self.contract.radio))
        if tuple(taken) != INPUTS or taken["features"][3:] != [width]:
            raise ValueError(f"{folder / NETWORK} takes {taken}, not {width} features a candidate: {AGAIN}")
        if "logits" not in (given := [tensor.name for tensor in self.session.get_outputs()]):
            raise ValueError(f"{folder / NETWORK} gives {', '.join(given)}, and no logits: {AGAIN}")

    def logits(self, candidates: Candidates) -> np.ndarray:
        """What speaks for every candidate, float32 [n, M]."""
        count = len(candidates.mask)
        inputs = {
            "features": candidates.features[None],
            "mask": candidates.mask[None],
            "comm": np.ones((1, count, count), bool),
        }
        return self.session.run(["logits"], inputs)[0][0]

    def rank(self, scene: ArrayScene, candidates: Candidates) -> tuple[np.ndarray, np.ndarray]:
        """What every robot of a scene thinks of every target, float [n, K], and of going to tell the base station,
        float [n], -inf where that is no choice, by the candidates that it is shown.

        Targets that the policy was not shown come behind the others.
        """
        logits, shown = np.zeros(scene.travel.shape), np.zeros(scene.travel.shape, bool)
        count, found = candidates.target.shape[1], self.logits(candidates)
        robot, place = np.nonzero(candidates.mask[:, :count])
        target = candidates.target[robot, place]
        logits[robot, target], shown[robot, target] = found[robot, place], True
        tell = np.full(len(found), -np.inf)
        if candidates.mask.shape[1] > count:
            tell = np.where(candidates.mask[:, count], found[:, count], -np.inf)
        return rank(cast(Any, scene), logits, shown), tell  # a frozen dataclass is no Protocol with settable members


def read_contract(folder: Path) -> Contract:
    """The contract of a folder, its network checked against it.

    Raises:
        ValueError: what is wrong with it.
    """
    try:
        content = json.loads(_read(folder, CONTRACT))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
        raise ValueError(f"{folder / CONTRACT} is not JSON: {AGAIN}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{folder / CONTRACT} is not a contract of the kind {FORMAT}: {AGAIN}")
    radio = content.get("features") == list(feature_names(radio=True))
    if not radio and content.get("features") != list(FEATURES):
        raise ValueError(f"{folder} was made for other features than this version of maexp has: {AGAIN}")
    numbers: list[Any] = [content.get(name) for name in NUMBERS]
    count: Any = content.get("candidates")
    right = all(type(number) in (int, float) and 0 < number < 1e6 for number in numbers)
    if not right or type(count) is not int or not 0 < count <= 1024:
        raise ValueError(f"{folder / CONTRACT} lacks one of {', '.join(NUMBERS)}, candidates: {AGAIN}")
    read_checked(folder, content, NETWORK)
    radar_range, robot_radius, *motion = map(float, numbers)
    name = str(content.get("name", folder.name))
    return Contract(name, count, radar_range, robot_radius, Motion(*motion), radio, content)


def read_checked(folder: Path, content: dict[str, Any], file: str) -> bytes:
    """A file of the folder, if it is the one that the contract names.

    Raises:
        ValueError: it is missing or another one.
    """
    data, sums = _read(folder, file), content.get("sha256")
    if not isinstance(sums, dict) or sums.get(file) != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{folder / file} is not the file that its contract names: {AGAIN}")
    return data


def _read(folder: Path, file: str) -> bytes:
    try:
        return (folder / file).read_bytes()
    except OSError as error:
        raise ValueError(f"{folder} is not the folder of a policy: {error.strerror} ({error.filename})") from None
