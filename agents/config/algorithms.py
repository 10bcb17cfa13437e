"""Settings of the seven algorithms: types, ranges, defaults and those of the original platform."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Self

from maexp.conf import list_choices, read_choice
from maexp.envs.config.env import Knower
from maexp.envs.config_fields import check_settings, replaced, setting

BRANCH_SHARE = 0.5


@dataclass(frozen=True)
class AlgorithmSettings:
    """Settings that all algorithms share. A team step is one macro step of one team.

    Horizons are in seconds, so that they do not depend on how often robots decide; `at_pace` turns them into discounts
    per decision. ValueError where one is out of its range (all subclasses). `conf/algorithm/NAME.yaml` holds what an
    algorithm has other defaults for, `conf/_tuning/reference_NAME.yaml` what the original platform has.
    """

    name: str = ""
    horizon_seconds: float = setting(200.0, "rewards so much later count 1 / e [s]", above=0)
    trace_seconds: float = setting(40.0, "generalised advantages trust rewards, not values, about so long [s]", above=0)
    gamma: float | None = setting(None, "discount per macro step; default: from horizon_seconds", low=0, high=1)
    lmbda: float | None = setting(
        None, "trace decay of the generalised advantages per macro step; default: from trace_seconds", low=0, high=1
    )
    learn_share: float | None = setting(
        None,
        "share of the batch, drawn anew for each pass, that is learned from; default: less where decisions come faster "
        "than in the scenario's own protocol, so that gradient steps per simulated second stay the same",
        above=0,
        high=1,
    )
    finite_horizon: bool = setting(
        True, "an episode that ran out of time is over: nothing that would come after it counts"
    )
    lr: float = setting(7e-4, "learning rate of the policy", above=0)
    critic_lr: float = setting(1e-3, "learning rate of the critic", above=0)
    final_lr_share: float = setting(
        1.0, "learning rates decay linearly to this share at the end of the training", low=0, high=1
    )
    entropy_coeff: float = setting(3e-3, "weight of the summed entropy of the action's heads", low=0)
    critic_coeff: float = setting(1.0, "weight of the critic's loss", low=0)
    value_norm: bool = setting(True, "measure the critic's error in units of the returns' running spread")
    normalize_advantage: bool = setting(True, "standardise advantages per minibatch")
    mask_collided: bool = setting(
        True, "leave the actions of robots that had collided out of what the policy learns from"
    )
    minibatch_size: int = setting(128, "team steps per gradient step", low=1)
    max_grad_norm: float = setting(1.0, "bound on the gradient of the policy, and on the critic's", above=0)
    anchor_coeff: float = setting(
        0.1, "after a warm start, weight of the divergence from its policy; falls linearly to 0", low=0
    )

    unused: ClassVar[tuple[str, ...]] = ()
    """Settings that do nothing with this algorithm."""

    def __post_init__(self):
        check_settings(self, "algorithm")

    def at_pace(self, seconds: float = 1.0, protocol_seconds: float | None = None) -> Self:
        """With discounts and the share that is learned from, where none are set, for one pace.

        Args:
            seconds: from decision to decision [s]
            protocol_seconds: the same in the scenario's own protocol [s]; None: as here
        """
        share = min(1.0, seconds / (protocol_seconds or seconds))
        found = {
            "gamma": math.exp(-seconds / self.horizon_seconds),
            "lmbda": math.exp(-seconds / self.trace_seconds),
            "learn_share": share,
        }
        missing: dict[str, Any] = {name: value for name, value in found.items() if getattr(self, name) is None}
        return replace(self, **missing)

    def loss_arguments(self) -> dict:
        """What the loss's constructor takes from these settings (`at_pace`)."""
        names = ["gamma", "lmbda", "finite_horizon", "entropy_coeff", "critic_coeff", "normalize_advantage"]
        names += ["mask_collided"]
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class ClippedSettings(AlgorithmSettings):
    """Settings of the clipped algorithms."""

    epochs: int = setting(3, "passes over each batch", low=1)
    clip_epsilon: float = setting(0.2, "bound on each robot's probability ratio", above=0, below=1)
    clip_value: float = setting(0.0, "bound on the change of a value, in the critic's units; 0 for none", low=0)
    kl_coeff: float = setting(0.0, "first weight of the penalty on the divergence; 0 for none", low=0)
    kl_target: float = setting(0.01, "divergence at which that weight stays", above=0)

    def loss_arguments(self) -> dict:
        names = ("clip_epsilon", "kl_coeff", "kl_target")
        own = {name: getattr(self, name) for name in names}
        return super().loss_arguments() | own | {"clip_value": self.clip_value or None}


@dataclass(frozen=True)
class MixedClippedSettings(ClippedSettings):
    """ClippedSettings of an algorithm that mixes the robots' values."""

    mixer: Literal["qmix", "vdn"] = setting("qmix", "how the robots' values make the team's, vdn or qmix")


@dataclass(frozen=True)
class TrustRegionSettings(AlgorithmSettings):
    """Settings of the trust-region algorithms."""

    max_kl: float = setting(0.03, "bound on the mean divergence of a policy step", above=0)
    accept_ratio: float = setting(0.1, "least share of the promised improvement", low=0, high=1)
    damping: float = setting(0.1, "added to the Fisher matrix's diagonal", low=0)
    cg_steps: int = setting(10, "conjugate-gradient steps", low=1)
    backtracks: int = setting(15, "lengths tried", low=1)
    backtrack_factor: float = setting(0.8, "each over the one before", above=0, below=1)
    policy_minibatch_size: int = setting(512, "team steps per policy step", low=1)
    fisher_size: int = setting(128, "team steps of these that make the Fisher matrix", low=1)
    critic_epochs: int = setting(3, "passes of the critic over each batch", low=1)


@dataclass(frozen=True)
class ActorCriticSettings(AlgorithmSettings):
    """Settings of advantage actor-critic: one pass, for its gradient is that of the acting policy.

    The pass is cut in minibatches, whose steps stay close to the policy that acted (logged as `kl`).
    """

    epochs: int = replaced(ClippedSettings, "epochs", 1)
    mixer: Literal["qmix", "vdn"] = replaced(MixedClippedSettings, "mixer", "qmix")


@dataclass(frozen=True)
class ExpertSettings(AlgorithmSettings):
    """Settings of expert iteration, which has neither returns nor a critic."""

    minibatch_size: int = setting(64, "decisions of teams per gradient step", low=1)
    candidates: int = setting(
        5, "targets that a robot tries where it is branched at, its own choice among them", low=2, high=24
    )
    branch_horizon: int = setting(
        4, "decisions that are played in a branch; `lookahead` says what they are worth", low=1, high=100
    )
    branch_share: float | None = setting(
        None,
        "share of the teams' decisions that are branched at; default: 0.5 at the pace of the scenario's protocol, less "
        "where decisions come faster",
        low=0.01,
        high=1,
    )
    learn_from: Knower = setting(
        "union",
        "whose knowledge a branch is worth: the team's, the base station's, or that of the robot that knows least",
    )
    epochs: int = setting(2, "how often a branched decision is learned from, on average", low=1)
    memory: int = setting(20_000, "decisions kept to learn from, of every team size", low=1)
    weight_decay: float = setting(0.1, "of the weights, as in AdamW", low=0)
    begin_from: str | None = setting(
        None, "run of expert iteration whose policy and branched decisions this one begins with, on whatever scenarios"
    )

    def at_pace(self, seconds: float = 1.0, protocol_seconds: float | None = None) -> Self:
        found = super().at_pace(seconds, protocol_seconds)
        share = BRANCH_SHARE * min(1.0, seconds / (protocol_seconds or seconds))
        return found if found.branch_share is not None else replace(found, branch_share=max(0.01, share))

    unused: ClassVar[tuple[str, ...]] = (
        "horizon_seconds",
        "trace_seconds",
        "gamma",
        "lmbda",
        "learn_share",
        "finite_horizon",
        "critic_lr",
        "entropy_coeff",
        "critic_coeff",
        "value_norm",
        "normalize_advantage",
        "mask_collided",
        "anchor_coeff",
    )


@dataclass(frozen=True)
class Tunings:
    """The settings of one algorithm.

    Attributes:
        name: as on the command line
        default: what learns best here
        reference: what the original platform has; of an algorithm that it lacks, the same
    """

    name: str
    default: AlgorithmSettings
    reference: AlgorithmSettings

    def configure(self, tuning: str = "default", **overrides) -> AlgorithmSettings:
        """The settings of a tuning ("default" or "reference") with some replaced.

        Raises:
            ValueError: unknown tuning or setting, or a value out of its range.
        """
        if tuning not in ("default", "reference"):
            raise ValueError(f"tuning={tuning!r} is unknown; choose default or reference.")
        known = [field.name for field in fields(self.default) if field.name != "name"]
        unknown = [name for name in overrides if name not in known]
        if unknown:
            raise ValueError(f"{self.name} has no setting {unknown[0]!r}; choose one of {', '.join(known)}.")
        return replace(getattr(self, tuning), **overrides)


KINDS: dict[str, type[AlgorithmSettings]] = {
    "ippo": ClippedSettings,
    "mappo": ClippedSettings,
    "itrpo": TrustRegionSettings,
    "matrpo": TrustRegionSettings,
    "vdppo": MixedClippedSettings,
    "vda2c": ActorCriticSettings,
    "expert_iteration": ExpertSettings,
}
"""The class of each algorithm's settings."""


def _read_tunings(name: str, kind: type[AlgorithmSettings]) -> Tunings:
    default, reference = kind(**read_choice("algorithm", name)), f"reference_{name}"
    known = reference in list_choices("_tuning")
    return Tunings(name, default, replace(default, **read_choice("_tuning", reference)) if known else default)


TUNINGS = {name: _read_tunings(name, kind) for name, kind in KINDS.items()}


def find_tunings(algorithm: str) -> Tunings:
    """The row of the table.

    Raises:
        ValueError: unknown name.
    """
    if algorithm not in TUNINGS:
        raise ValueError(f"algorithm={algorithm!r} is unknown; choose one of {', '.join(TUNINGS)}.")
    return TUNINGS[algorithm]
