"""Policies by name or folder: classical planners, and trained ones that ship or were exported, rebuilt in torch."""

import os
from collections.abc import Iterable
from pathlib import Path

from torch import Tensor
from torchrl.modules import ProbabilisticActor

from maexp.agents.config.model import ModelConfig
from maexp.agents.deploy.planner.bundle import (
    AGAIN,
    CONTRACT,
    WEIGHTS,
    Contract,
    find_policy,
    read_checked,
    read_contract,
    shipped_names,
)
from maexp.agents.errors import UserError
from maexp.agents.models.actor import make_policy, mismatched
from maexp.agents.models.precision import float32_modules
from maexp.agents.models.target_chooser import TargetChooser
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.export import find_chooser
from maexp.envs import ExplorationEnv


def open_policy(spec: str, setting: str = "policy", others: Iterable[str] = tuple(POLICIES)) -> tuple[Path, Contract]:
    """Folder and contract of a trained policy, its files checked.

    Raises:
        UserError: there is none of that name, or it is damaged.
    """
    try:
        folder = find_policy(spec, others, setting)
        contract = read_contract(folder)
        read_checked(folder, contract.content, WEIGHTS)
    except ValueError as error:
        raise UserError(f"{error}.".replace("?.", "?")) from error
    return folder, contract


def is_exported(spec: str) -> bool:
    """Whether this is the name of a policy that ships, or a folder that `maexp export` wrote."""
    return spec in shipped_names() or os.path.isfile(Path(spec) / CONTRACT)


def load_policy_folder(spec: str, env: ExplorationEnv, setting: str = "policy") -> ProbabilisticActor:
    """The trained policy in torch, on the device of `env`, for teams of any size; it takes the likeliest target, as on
    a robot.

    Raises:
        UserError: it is unknown, damaged, or of another kind.
    """
    folder, contract = open_policy(spec, setting)
    config, weights = _read_network(folder, contract)
    policy = make_policy(env, config, contract.radio)
    find_chooser(policy).load_state_dict(weights)
    return policy.to(env.device)


@float32_modules()
def load_chooser(spec: str, setting: str = "policy") -> tuple[TargetChooser, int]:
    """The network of a trained policy, on the CPU, and how many candidates it is shown.

    Raises:
        UserError: it is unknown, damaged, or of another kind.
    """
    folder, contract = open_policy(spec, setting)
    config, weights = _read_network(folder, contract)
    chooser = TargetChooser(config, contract.radio).eval()
    chooser.load_state_dict(weights)
    return chooser, contract.candidates


def read_model(spec: str, setting: str = "policy") -> ModelConfig:
    """Sizes of a trained policy's network.

    Raises:
        UserError: it is unknown, damaged, or of another kind.
    """
    return _read_network(*open_policy(spec, setting))[0]


@float32_modules()
def _read_network(folder: Path, contract: Contract) -> tuple[ModelConfig, dict[str, Tensor]]:
    """Settings and weights of a policy's network; UserError where they do not fit each other."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        config = ModelConfig(action="targets", **contract.content["model"])
        weights = load(read_checked(folder, contract.content, WEIGHTS))
    except (KeyError, TypeError, ValueError, SafetensorError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{folder} holds no network that its contract tells of ({reason}): {AGAIN}.") from error
    wrong = mismatched(TargetChooser(config, contract.radio).state_dict(), weights)
    if wrong:
        raise UserError(
            f"{folder / WEIGHTS} holds another network than its contract tells of ({len(wrong)} tensors differ, first "
            f"{wrong[0]}): {AGAIN}."
        )
    return config, weights
