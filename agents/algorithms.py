"""The six algorithms: for each its loss, critic, updater and settings."""

from dataclasses import dataclass, fields, replace

from torchrl.modules import PopArtValueNorm

from maexp.agents import losses
from maexp.agents.critics import build_critic
from maexp.agents.model import ModelConfig
from maexp.agents.settings.ranges import check_ranges, choice, flag, number, whole
from maexp.agents.updaters import GradientUpdater, TrustRegionUpdater, Updater


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
        names = ("entropy_coeff", "critic_coeff", "normalize_advantage", "mask_collided")
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
class Algorithm:
    """One row of the table.

    Attributes:
        name: as on the command line
        critic: local, team or mixed (`critics.py`)
        loss: class of the loss
        updater: class of the updater
        settings: defaults
        reference: the settings of the original platform
    """

    name: str
    critic: str
    loss: type
    updater: type[Updater]
    settings: Settings
    reference: Settings

    def configure(self, preset: str = "default", **overrides) -> Settings:
        """The settings of a preset ("default" or "reference") with some replaced.

        Raises:
            ValueError: unknown preset or setting.
        """
        presets = {"default": self.settings, "reference": self.reference}
        if preset not in presets:
            raise ValueError(f"algorithm.preset={preset!r} is unknown; choose default or reference.")
        known = [field.name for field in fields(self.settings)]
        unknown = [name for name in overrides if name not in known]
        if unknown:
            raise ValueError(f"{self.name} has no setting {unknown[0]!r}; choose one of {', '.join(known)}.")
        return replace(presets[preset], **overrides)

    def make_critic(self, env, model: "str | ModelConfig", settings: Settings | None = None):
        """The critic of this algorithm for the specs of `env`."""
        mixer = getattr(settings or self.settings, "mixer", "qmix")
        return build_critic(self.critic, env, model, mixer)

    def make_loss(self, policy, critic, settings: Settings | None = None):
        """The loss for a policy and critic, with its estimator of advantages."""
        settings = settings or self.settings
        norm = PopArtValueNorm(shape=1, beta=0.99) if settings.value_norm else None
        loss = self.loss(policy, critic, value_norm=norm, **settings.loss_arguments())
        loss.setup(settings.gamma, settings.lmbda, settings.finite_horizon)
        return loss.to(next(policy.parameters()).device)

    def make_updater(self, loss, settings: Settings | None = None) -> Updater:
        """The updater that trains the networks behind `loss`."""
        return self.updater(loss, settings or self.settings)


def _reference(settings: Settings, **others) -> Settings:
    """The original platform's settings (MARLlib's), where they differ from `settings`."""
    shared = dict(lmbda=1.0, entropy_coeff=1e-3, value_norm=False, final_lr_share=1.0)
    shared |= dict(finite_horizon=False, mask_collided=False)
    return replace(settings, **shared, **others)


_CLIPPED = dict(lr=1e-4, critic_lr=1e-4, epochs=2, clip_value=10.0, kl_coeff=0.2)
_TRUST = dict(max_kl=0.06, accept_ratio=0.5, max_grad_norm=10.0)


def _row(name: str, critic: str, loss: type, updater: type[Updater], settings: Settings, **reference) -> Algorithm:
    return Algorithm(name, critic, loss, updater, settings, _reference(settings, **reference))


ALGORITHMS = {
    row.name: row
    for row in (
        _row("ippo", "local", losses.IPPO, GradientUpdater, ClippedSettings(), **_CLIPPED),
        _row("mappo", "team", losses.MAPPO, GradientUpdater, ClippedSettings(), **_CLIPPED),
        _row("itrpo", "local", losses.TRPOLoss, TrustRegionUpdater, TrustRegionSettings(), **_TRUST),
        _row("matrpo", "team", losses.TRPOLoss, TrustRegionUpdater, TrustRegionSettings(), **_TRUST),
        _row("vdppo", "mixed", losses.VDPPO, GradientUpdater, MixedClippedSettings(), **_CLIPPED),
        _row("vda2c", "mixed", losses.VDA2C, GradientUpdater, ActorCriticSettings(), lr=1e-4, critic_lr=1e-4),
    )
}


def find_algorithm(name: str) -> Algorithm:
    """The row of the table.

    Raises:
        ValueError: unknown name.
    """
    if name not in ALGORITHMS:
        raise ValueError(f"algorithm={name!r} is unknown; choose one of {', '.join(ALGORITHMS)}.")
    return ALGORITHMS[name]


def make_critic(algorithm: str, env, model: "str | ModelConfig" = "small", **settings):
    """The critic that an algorithm trains, writing ("agents", "state_value") [*, robots, 1].

    Args:
        algorithm: a name of the table
        env: gives the specs and the device; not kept
        model: a preset's name or a ModelConfig
        settings: of the algorithm; only `mixer` matters here
    """
    row = find_algorithm(algorithm)
    return row.make_critic(env, model, row.configure(**settings))


def make_loss(algorithm: str, policy, critic, preset: str = "default", **settings):
    """A TorchRL LossModule fed by one Collector batch [envs, T]; estimates advantages that are absent.

    Args:
        algorithm: a name of the table
        policy: from make_policy
        critic: from make_critic with the same name
        preset: default or reference
        settings: replace the preset's
    """
    row = find_algorithm(algorithm)
    return row.make_loss(policy, critic, row.configure(preset, **settings))
