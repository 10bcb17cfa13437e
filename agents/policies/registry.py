"""Any policy by its spec, with one meaning wherever a policy is named.

A classical name, a policy that ships, a folder of `maexp export`, a run of `maexp train` or one of its checkpoints,
module:function, or a plug-in by the name of its entry point: in this order, where a spec could be several.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from maexp.agents.config.checks import check_distinct
from maexp.agents.config.groups import CommonSettings
from maexp.agents.config.model import ModelConfig
from maexp.agents.config.resolved import flatten
from maexp.agents.errors import UserError
from maexp.agents.evaluation.comparison import STARTS
from maexp.agents.files import warn_of_changed_maps
from maexp.agents.policies.classical import CLASSICAL, POLICIES, REFERENCES
from maexp.agents.policies.names import describe_unknown_policy, policy_plugins
from maexp.agents.policies.pretrained import is_exported, load_policy_folder, open_policy, read_model
from maexp.agents.policies.remote.user_policy import (
    find_user_policy,
    is_module_reference,
    is_numpy_policy,
    make_user_policy,
    read_source,
)
from maexp.agents.training.checkpoint import (
    BEST,
    NAME,
    find_checkpoint,
    is_run,
    looks_at_radios,
    model_of,
    restore_policy,
)
from maexp.envs import ExplorationEnv, PointCloudMap

Kind = Literal["classical", "exported", "checkpoint", "start", "own"]
RESERVED_NAMES = ("run", "difference", "headroom_share", "trained", *STARTS, "best_classical")
"""What results call something else."""


@dataclass(frozen=True)
class NamedPolicy:
    """A policy that can be played in any env that shows what it looks at.

    Attributes:
        name: in tables and file names.
        build: env -> policy on tensordicts.
        kind: what its spec named.
        targets: frontier targets that it is shown; None: it takes what there is.
        radio: it looks at what these tell of radios.
        pictures: whether it looks, or may look, at pictures; `map` is what these show, None: as set.
        direct: whether it gives controls (planner=direct) and no goals; None: not known.
        source: text that changes with the policy itself, "" for what comes with the package.
        saved: the checkpoint that it comes from.
        model: sizes of its network, of a trained one.
        found: the user's class or function.
    """

    name: str
    build: Callable[[ExplorationEnv], Callable]
    kind: Kind
    targets: int | None = None
    radio: bool = False
    pictures: bool = False
    map: str | None = None
    direct: bool | None = False
    source: str = ""
    saved: dict[str, Any] | None = field(default=None, repr=False)
    found: Callable | None = None
    model: ModelConfig | None = None

    @property
    def learned(self) -> bool:
        """Whether it competes with the classical planners, which differences are told to."""
        if self.kind == "start":
            return False
        return self.kind != "classical" or self.name not in (*CLASSICAL, *REFERENCES)

    def make(self, env: ExplorationEnv) -> Callable:
        """The policy for an env.

        Raises:
            UserError: the env does not show what it looks at, takes another action, or making it fails.
            ValueError: as UserError.
        """
        shown = env.observation_config
        if self.targets not in (None, shown.targets):
            raise UserError(
                f"policy {self.name} looks at {self.targets} targets, and the env shows {shown.targets}: "
                f"make it with observation=ObservationConfig(targets={self.targets}), on the command line as "
                f"observation.targets={self.targets}."
            )
        if self.radio and not shown.radio:
            raise UserError(
                f"policy {self.name} was trained with observation.radio=true, and the env shows nothing of radios: "
                "add observation.radio=true."
            )
        check_planner(env.planner_config.name, [self])
        return self.build(env)

    def check_maps(self, maps: list[PointCloudMap]) -> None:
        """Say which maps of its training have changed since."""
        if self.saved is not None:
            warn_of_changed_maps(self.saved, maps)


def find_named_policy(spec: str, setting: str = "policy", name: str | None = None) -> NamedPolicy:
    """The policy of a spec.

    Args:
        setting: the setting that messages name.
        name: in tables; None: from the spec.

    Raises:
        UserError: there is none, or it is damaged.
    """
    name = name or policy_label(spec)
    if spec in POLICIES:
        return NamedPolicy(name, POLICIES[spec], "classical")
    if not is_exported(spec) and spec in policy_plugins():
        return _own(spec, setting, name)
    if not is_exported(spec) and is_run(Path(spec)):
        return _from_checkpoint(spec, name)
    if is_module_reference(spec) and not os.path.exists(spec):
        return _own(spec, setting, name)
    if not is_exported(spec):
        raise UserError(describe_unknown_policy(spec, setting))
    _, contract = open_policy(spec, setting)
    return NamedPolicy(
        name,
        lambda env: load_policy_folder(spec, env, setting),
        "exported",
        targets=contract.candidates,
        radio=contract.radio,
        source=str(contract.content["sha256"]),
        model=read_model(spec, setting),
    )


def _from_checkpoint(spec: str, name: str) -> NamedPolicy:
    path, saved = find_checkpoint(spec)
    settings, model = flatten(saved["settings"]), model_of(saved)
    regions, direct = model.action == "regions", settings["planner.name"] == "direct"
    return NamedPolicy(
        name,
        lambda env: restore_policy(env, model, saved).to(env.device),
        "checkpoint",
        targets=None if regions else settings["observation.targets"],
        radio=not regions and looks_at_radios(saved),
        pictures=regions,
        map=settings.get("observation.map") if regions else None,
        direct=direct,
        source=f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}",
        saved=saved,
        model=model,
    )


def _own(spec: str, setting: str, name: str) -> NamedPolicy:
    found = find_user_policy(spec, setting)
    foreign = is_numpy_policy(found)
    return NamedPolicy(
        name,
        lambda env: make_user_policy(found, env, name),
        "own",
        pictures=not foreign,
        direct=False if foreign else None,
        source=f"{spec} {read_source(found)}",
        found=found,
    )


def find_named_policies(specs: Sequence[str], setting: str = "policy", taken: Iterable[str] = ()) -> list[NamedPolicy]:
    """The policies of several specs, with names of their own.

    Raises:
        UserError: as `find_named_policy`; or a policy is named twice.
    """
    return [find_named_policy(spec, setting, name) for spec, name in name_policies(specs, setting, taken).items()]


def name_policies(specs: Sequence[str], setting: str = "policy", taken: Iterable[str] = ()) -> dict[str, str]:
    """word -> its name in tables: the short one, with the folders above it where that is another's.

    Raises:
        UserError: a policy is named twice.
    """
    check_distinct(setting, [str(Path(spec).absolute()) if os.path.exists(spec) else spec for spec in specs])
    names, used = {}, {*RESERVED_NAMES, *taken, *(spec for spec in specs if spec in POLICIES)}
    for spec in specs:
        name, above = policy_label(spec), list(Path(spec).absolute().parents)
        while name in used and spec not in POLICIES:
            if not above or not above[0].name:
                raise UserError(f"{setting}={spec} cannot be told from {name}: rename its folder.")
            name = f"{above.pop(0).name}-{name}"
        names[spec] = name
        used.add(name)
    return names


def policy_label(spec: str) -> str:
    """What tables and files call a policy: its own name, that of its folder, or module.function."""
    path = Path(spec)
    is_path = os.sep in spec or path.suffix == ".pt" or os.path.exists(spec)
    if spec in POLICIES or spec in policy_plugins() or not is_path:
        name = spec.replace(":", ".") if is_module_reference(spec) else spec
    elif path.suffix == ".pt":
        run = path.absolute().parent
        run = run.parent if run.name == "checkpoints" else run
        number = NAME.fullmatch(path.name)
        mark = "best" if path.name == BEST else f"iteration_{int(number[1])}" if number else path.stem
        name = f"{run.name}_{mark}"
    else:
        name = path.absolute().name
    return re.sub(r"[^\w.+-]", "_", name)


def check_planner(planner: str, policies: Sequence[NamedPolicy]) -> None:
    """Raise UserError where policies that pick goals meet a planner that takes controls, or the other way round."""
    goals = [policy.name for policy in policies if policy.direct is False]
    if goals and planner == "direct":
        raise UserError(
            f"planner=direct takes controls, and {', '.join(goals)} pick{'s' if len(goals) == 1 else ''} goals: "
            "use planner=dwa or wavefront."
        )
    controls = [policy.name for policy in policies if policy.direct]
    if controls and planner != "direct":
        raise UserError(
            f"{', '.join(controls)} {'was' if len(controls) == 1 else 'were'} trained with planner=direct, and "
            f"planner={planner} takes another action: add planner=direct."
        )


def suit_observation(cfg: CommonSettings, policies: Sequence[NamedPolicy]) -> None:
    """Let the env of the settings show what the policies look at, and nothing that nobody does.

    Raises:
        UserError: they look at different things, or the settings show another number of targets.
    """
    counts = {policy.name: policy.targets for policy in policies if policy.targets is not None}
    if counts:
        counts |= {"observation.targets": cfg.observation.targets} if cfg.observation.targets else {}
        if len(set(counts.values())) > 1:
            told = ", ".join(f"{spec} {count}" for spec, count in counts.items())
            raise UserError(f"Policies that look at different numbers of targets cannot play together: {told}.")
        cfg.observation = replace(cfg.observation, targets=next(iter(counts.values())))
    cfg.observation = replace(cfg.observation, radio=cfg.observation.radio or any(policy.radio for policy in policies))
    shown = {policy.name: policy.map for policy in policies if policy.map is not None}
    if len(set(shown.values())) > 1:
        told = ", ".join(f"{spec} {what}" for spec, what in shown.items())
        raise UserError(f"Policies whose pictures show different things cannot play together: {told}.")
    if shown:
        cfg.observation = replace(cfg.observation, map=next(iter(shown.values())), pictures=True)
    elif not any(policy.pictures for policy in policies):
        cfg.observation = replace(cfg.observation, pictures=False)
