"""The algorithms: for each its loss, critic and updater; their settings stand in `config/algorithms.py`."""

from dataclasses import dataclass, replace

from torchrl.modules import PopArtValueNorm

from maexp.agents.algorithms.expert_iteration import ExpertUpdater
from maexp.agents.algorithms.losses import ActorCriticLoss, ClippedLoss, TrustRegionLoss
from maexp.agents.algorithms.updaters import GradientUpdater, TrustRegionUpdater, Updater
from maexp.agents.config.algorithms import TUNINGS, AlgorithmSettings, Tunings
from maexp.agents.config.model import ModelConfig, model_config
from maexp.agents.models.critics import build_critic
from maexp.agents.models.precision import float32_modules


@dataclass(frozen=True)
class Algorithm:
    """One row of the table.

    Attributes:
        name: as on the command line
        critic: local, team or mixed (`critics.py`)
        loss: class of the loss
        updater: class of the updater
        tunings: its settings
    """

    name: str
    critic: str
    loss: type
    updater: type[Updater]
    tunings: Tunings

    @property
    def settings(self) -> AlgorithmSettings:
        """The defaults."""
        return self.tunings.default

    @property
    def reference(self) -> AlgorithmSettings:
        """Those of the original platform."""
        return self.tunings.reference

    def configure(self, tuning: str = "default", **overrides) -> AlgorithmSettings:
        """The settings of a tuning ("default" or "reference") with some replaced.

        Raises:
            ValueError: unknown tuning or setting, or a value out of its range.
        """
        return self.tunings.configure(tuning, **overrides)

    def make_critic(self, env, model: "str | ModelConfig", settings: AlgorithmSettings | None = None):
        """The critic of this algorithm for the specs of `env`; beside a trust region it has an encoder of its own."""
        if self.updater is TrustRegionUpdater:
            model = replace(model_config(model), critic_encoder="own")
        mixer = getattr(settings or self.settings, "mixer", "qmix")
        return build_critic(self.critic, env, model, mixer)

    @float32_modules()
    def make_loss(self, policy, critic, settings: AlgorithmSettings | None = None):
        """The loss for a policy and critic, with its estimator of advantages."""
        settings = (settings or self.settings).at_pace()
        norm = PopArtValueNorm(shape=1, beta=0.99) if settings.value_norm else None
        loss = self.loss(policy, critic, value_norm=norm, **settings.loss_arguments())
        return loss.to(next(policy.parameters()).device)

    def make_updater(self, loss, settings: AlgorithmSettings | None = None) -> Updater:
        """The updater that trains the networks behind `loss`."""
        return self.updater(loss, (settings or self.settings).at_pace())


ALGORITHMS = {
    row.name: row
    for row in (
        Algorithm("ippo", "local", ClippedLoss, GradientUpdater, TUNINGS["ippo"]),
        Algorithm("mappo", "team", ClippedLoss, GradientUpdater, TUNINGS["mappo"]),
        Algorithm("itrpo", "local", TrustRegionLoss, TrustRegionUpdater, TUNINGS["itrpo"]),
        Algorithm("matrpo", "team", TrustRegionLoss, TrustRegionUpdater, TUNINGS["matrpo"]),
        Algorithm("vdppo", "mixed", ClippedLoss, GradientUpdater, TUNINGS["vdppo"]),
        Algorithm("vda2c", "mixed", ActorCriticLoss, GradientUpdater, TUNINGS["vda2c"]),
    )
}
"""The actor-critic algorithms: they learn from Collector batches alone."""

TRAININGS = ALGORITHMS | {
    "expert_iteration": Algorithm(
        "expert_iteration", "local", ActorCriticLoss, ExpertUpdater, TUNINGS["expert_iteration"]
    )  # its loss only holds the networks: it learns from branches
}
"""All that `maexp train` can train with."""


def find_algorithm(name: str, among: dict[str, Algorithm] = ALGORITHMS) -> Algorithm:
    """The row of the table.

    Raises:
        ValueError: unknown name.
    """
    if name not in among:
        raise ValueError(f"algorithm={name!r} is unknown; choose one of {', '.join(among)}.")
    return among[name]


def make_critic(algorithm: str, env, model: "str | ModelConfig" = "small", **settings):
    """The critic that an algorithm trains, writing ("agents", "state_value") [*, robots, 1].

    Args:
        algorithm: a name of the table
        env: gives the specs and the device; not kept
        model: a name (small, paper) or a ModelConfig
        settings: of the algorithm; only `mixer` matters here
    """
    row = find_algorithm(algorithm)
    return row.make_critic(env, model, row.configure(**settings))


def make_loss(algorithm: str, policy, critic, tuning: str = "default", **settings):
    """A TorchRL LossModule fed by one Collector batch [envs, T]; estimates advantages that are absent.

    Args:
        algorithm: a name of the table
        policy: from make_policy
        critic: from make_critic with the same name
        tuning: default or reference
        settings: replace those of the tuning
    """
    row = find_algorithm(algorithm)
    return row.make_loss(policy, critic, row.configure(tuning, **settings))
