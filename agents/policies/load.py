"""Policies by name or folder: classical planners, and trained ones that ship or were exported, rebuilt in torch."""

from collections.abc import Iterable
from pathlib import Path

from torchrl.modules import ProbabilisticActor

from maexp.agents.errors import UserError
from maexp.agents.networks.actor import make_policy
from maexp.agents.networks.weights import mismatched
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.export import find_chooser
from maexp.agents.runtime.folder import AGAIN, WEIGHTS, Contract, read_checked, read_contract
from maexp.agents.runtime.shipped import CONTRACT, find_policy, shipped_names
from maexp.agents.settings.checks import check_distinct
from maexp.agents.settings.model import ModelConfig
from maexp.agents.settings.schema import CommonSettings
from maexp.envs import ExplorationEnv


def open_policy(
    word: str, setting: str = "policy", others: Iterable[str] = tuple(POLICIES)
) -> tuple[Path, Contract]:
    """Folder and contract of a trained policy, its files checked.

    Raises:
        UserError: there is none of that name, or it is damaged.
    """
    try:
        folder = find_policy(word, others, setting)
        contract = read_contract(folder)
        read_checked(folder, contract.content, WEIGHTS)
    except ValueError as error:
        raise UserError(f"{error}.".replace("?.", "?")) from error
    return folder, contract


def is_exported(word: str) -> bool:
    """Whether this is the name of a policy that ships, or a folder that `maexp export` wrote."""
    return word in shipped_names() or (Path(word) / CONTRACT).is_file()


def policy_name(word: str) -> str:
    """What tables and files call a policy: its own name, or that of its folder."""
    return word if word in POLICIES else Path(word).absolute().name


def check_policies(words: list[str], setting: str = "policy") -> None:
    """Raise UserError for a policy that is unknown or damaged, or two of one name."""
    for word in words:
        if word not in POLICIES:
            open_policy(word, setting)
    check_distinct(setting, [policy_name(word) for word in words])


def show_targets(cfg: CommonSettings, words: Iterable[str], setting: str = "policy") -> None:
    """Let the env of the settings show as many targets as the trained policies among `words` look at.

    Raises:
        UserError: they look at different numbers, or the settings show another one.
    """
    counts = {word: open_policy(word, setting)[1].candidates for word in words if word not in POLICIES}
    if counts:
        counts |= {"observation.targets": cfg.observation.targets} if cfg.observation.targets else {}
        if len(set(counts.values())) > 1:
            told = ", ".join(f"{word} {count}" for word, count in counts.items())
            raise UserError(f"Policies that look at different numbers of targets cannot play together: {told}.")
        cfg.observation.targets = next(iter(counts.values()))


def load_policy_folder(word: str, env: ExplorationEnv, setting: str = "policy") -> ProbabilisticActor:
    """The trained policy in torch, on the device of `env`, for teams of any size; it takes the likeliest target, as on
    a robot.

    Raises:
        UserError: it is unknown, damaged, or of another kind.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    folder, contract = open_policy(word, setting)
    try:
        config = ModelConfig(action="targets", **contract.content["model"])
        weights = load(read_checked(folder, contract.content, WEIGHTS))
    except (KeyError, TypeError, ValueError, SafetensorError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{folder} holds no network that its contract tells of ({reason}): {AGAIN}.") from error
    policy = make_policy(env, config)
    chooser = find_chooser(policy)
    wrong = mismatched(chooser.state_dict(), weights)
    if wrong:
        raise UserError(
            f"{folder / WEIGHTS} holds another network than its contract tells of ({len(wrong)} tensors differ, first "
            f"{wrong[0]}): {AGAIN}."
        )
    chooser.load_state_dict(weights)
    return policy.to(env.device)

