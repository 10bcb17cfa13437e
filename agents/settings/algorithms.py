"""Settings of the seven algorithms: types, ranges, defaults and those of the original platform."""

from dataclasses import dataclass, fields, replace

from maexp.agents.settings.ranges import check_ranges, choice, flag, number, whole


@dataclass(frozen=True)
class Settings:
    """Settings that all algorithms share. A team step is one macro step of one team.

    ValueError where one is out of its range (all subclasses).

    Attributes:
        gamma: discount per macro step
        lmbda: trace decay of the generalised advantages
        finite_horizon: an episode that ran out of time is over: nothing that would come after it counts
        lr: learning rate of the policy
        critic_lr: learning rate of the critic
        final_lr_share: both decay linearly to this share at the end of the training
        entropy_coeff: weight of the summed entropy of the action's heads
        critic_coeff: weight of the critic's loss
        value_norm: measure the critic's error in units of the returns' running spread
        normalize_advantage: standardise advantages per minibatch
        mask_collided: leave the actions of robots that had collided out of what the policy learns from
        minibatch_size: team steps per gradient step
        max_grad_norm: bound on the gradient of the policy, and on the critic's
        anchor_coeff: after a warm start, weight of the divergence from its policy; falls linearly to 0
    """

    gamma: float = number(0.99, high=1.0)
    lmbda: float = number(0.95, high=1.0)
    finite_horizon: bool = flag(True)
    lr: float = number(7e-4, open_ends=True)
    critic_lr: float = number(1e-3, open_ends=True)
    final_lr_share: float = number(1.0, high=1.0)
    entropy_coeff: float = number(3e-3)
    critic_coeff: float = number(1.0)
    value_norm: bool = flag(True)
    normalize_advantage: bool = flag(True)
    mask_collided: bool = flag(True)
    minibatch_size: int = whole(128)
    max_grad_norm: float = number(1.0, open_ends=True)
    anchor_coeff: float = number(0.1)

    def __post_init__(self):
        check_ranges(self, "algorithm")

    def loss_arguments(self) -> dict:
        """What the loss's constructor takes from these settings."""
        names = ("gamma", "lmbda", "finite_horizon", "entropy_coeff", "critic_coeff", "normalize_advantage")
        names += ("mask_collided",)
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class ClippedSettings(Settings):
    """Settings of the clipped algorithms.

    Attributes:
        epochs: passes over each batch
        clip_epsilon: bound on each robot's probability ratio
        clip_value: bound on the change of a value, in the critic's units; 0 for none
        kl_coeff: first weight of the penalty on the divergence; 0 for none
        kl_target: divergence at which that weight stays
    """

    epochs: int = whole(3)
    clip_epsilon: float = number(0.2, high=1.0, open_ends=True)
    clip_value: float = number(0.0)
    kl_coeff: float = number(0.0)
    kl_target: float = number(0.01, open_ends=True)

    def loss_arguments(self) -> dict:
        names = ("clip_epsilon", "kl_coeff", "kl_target")
        own = {name: getattr(self, name) for name in names}
        return super().loss_arguments() | own | {"clip_value": self.clip_value or None}


@dataclass(frozen=True)
class MixedClippedSettings(ClippedSettings):
    """ClippedSettings and the `mixer` that makes the team's value: vdn or qmix.

    The advantage is the team's, with the noise of all robots in it: a shorter trace learned faster.
    """

    lmbda: float = number(0.8, high=1.0)
    mixer: str = choice("qmix", "vdn")


@dataclass(frozen=True)
class TrustRegionSettings(Settings):
    """Settings of the trust-region algorithms.

    Attributes:
        max_kl: bound on the mean divergence of a policy step
        accept_ratio: least share of the promised improvement
        damping: added to the Fisher matrix's diagonal
        cg_steps: conjugate-gradient steps
        backtracks: lengths tried
        backtrack_factor: each over the one before
        policy_minibatch_size: team steps per policy step
        fisher_size: team steps of these that make the Fisher matrix
        critic_epochs: passes of the critic over each batch
    """

    max_kl: float = number(0.03, open_ends=True)
    accept_ratio: float = number(0.1, high=1.0)
    damping: float = number(0.1)
    cg_steps: int = whole(10)
    backtracks: int = whole(15)
    backtrack_factor: float = number(0.8, high=1.0, open_ends=True)
    policy_minibatch_size: int = whole(512)
    fisher_size: int = whole(128)
    critic_epochs: int = whole(3)


@dataclass(frozen=True)
class ActorCriticSettings(Settings):
    """Settings of advantage actor-critic: one pass, for its gradient is that of the acting policy.

    The pass is cut in minibatches, whose steps stay close to the policy that acted (logged as `kl`). Nothing bounds a
    step, so the learning rate must fall: at a constant one steps grow as the policy narrows.

    Attributes:
        epochs: passes over each batch
        mixer: how the robots' values make the team's, vdn or qmix
    """

    lmbda: float = number(0.8, high=1.0)
    lr: float = number(2e-3, open_ends=True)
    final_lr_share: float = number(0.1, high=1.0)
    entropy_coeff: float = number(5e-4)
    epochs: int = whole(1)
    mixer: str = choice("qmix", "vdn")


@dataclass(frozen=True)
class ExpertSettings(Settings):
    """Settings of expert iteration. It has neither returns nor a critic: of those above only `lr`, `final_lr_share`,
    `minibatch_size` (decisions of teams) and `max_grad_norm` do anything.

    Attributes:
        candidates: targets that a robot tries where it is branched at, its own choice among them
        branch_horizon: decisions that are played in a branch; `lookahead` says what they are worth
        branch_share: share of the teams' decisions that are branched at
        epochs: how often a branched decision is learned from, on average; few: what is to be learned is small beside
            what chance adds
        memory: decisions kept to learn from, of every team size
        weight_decay: of the weights, as in AdamW
    """

    minibatch_size: int = whole(64)
    candidates: int = whole(5, 2, 24)
    branch_horizon: int = whole(4, 1, 100)
    branch_share: float = number(0.5, 0.01, 1.0)
    epochs: int = whole(2)
    memory: int = whole(20_000)
    weight_decay: float = number(0.1)


def _reference(settings: Settings, **others) -> Settings:
    """The original platform's settings (MARLlib's), where they differ from `settings`."""
    shared = dict(lmbda=1.0, entropy_coeff=1e-3, value_norm=False, final_lr_share=1.0)
    shared |= dict(finite_horizon=False, mask_collided=False)
    return replace(settings, **shared, **others)


_CLIPPED = dict(lr=1e-4, critic_lr=1e-4, epochs=2, clip_value=10.0, kl_coeff=0.2)
_TRUST = dict(max_kl=0.06, accept_ratio=0.5, max_grad_norm=10.0)


@dataclass(frozen=True)
class Tunings:
    """The settings of one algorithm.

    Attributes:
        name: as on the command line
        default: what learns best here
        reference: what the original platform has
    """

    name: str
    default: Settings
    reference: Settings

    def configure(self, tuning: str = "default", **overrides) -> Settings:
        """The settings of a tuning ("default" or "reference") with some replaced.

        Raises:
            ValueError: unknown tuning or setting, or a value out of its range.
        """
        if tuning not in ("default", "reference"):
            raise ValueError(f"tuning={tuning!r} is unknown; choose default or reference.")
        known = [field.name for field in fields(self.default)]
        unknown = [name for name in overrides if name not in known]
        if unknown:
            raise ValueError(f"{self.name} has no setting {unknown[0]!r}; choose one of {', '.join(known)}.")
        return replace(getattr(self, tuning), **overrides)


def _tunings(name: str, settings: Settings, **reference) -> Tunings:
    return Tunings(name, settings, _reference(settings, **reference))


TUNINGS = {
    one.name: one
    for one in (
        _tunings("ippo", ClippedSettings(), **_CLIPPED),
        _tunings("mappo", ClippedSettings(), **_CLIPPED),
        _tunings("itrpo", TrustRegionSettings(), **_TRUST),
        _tunings("matrpo", TrustRegionSettings(), **_TRUST),
        _tunings("vdppo", MixedClippedSettings(), **_CLIPPED),
        _tunings("vda2c", ActorCriticSettings(), lr=1e-4, critic_lr=1e-4),
        Tunings("expert_iteration", ExpertSettings(), ExpertSettings()),  # the original has none
    )
}


def find_tunings(algorithm: str) -> Tunings:
    """The row of the table.

    Raises:
        ValueError: unknown name.
    """
    if algorithm not in TUNINGS:
        raise ValueError(f"algorithm={algorithm!r} is unknown; choose one of {', '.join(TUNINGS)}.")
    return TUNINGS[algorithm]
