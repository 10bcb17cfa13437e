"""The losses of the six algorithms: TorchRL's, each with only what our teams need to differ.

All read a Collector batch [envs, T], or its flattened team steps once advantages are in it. They keep robots
apart (one probability ratio per robot, over its two heads) and write loss_objective, loss_entropy,
loss_critic (and loss_kl), plus what one likes to log.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import A2CLoss, PPOLoss, ValueEstimators
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.utils import distance_loss

from maexp.agents.actor import PARAMS
from maexp.agents.advantages import ADVANTAGE, REWARD, TARGET, TEAM_TARGET, estimator_for
from maexp.agents.critics import TEAM_VALUE, VALUE
from maexp.agents.distributions import Heads


class NonFiniteLoss(ArithmeticError):
    """A loss term or gradient is NaN or infinite; the message names it."""


def check_finite(name: str, value: Tensor) -> None:
    """Raise NonFiniteLoss if `value` holds a NaN or an infinity."""
    if not torch.isfinite(value).all():
        raise NonFiniteLoss(
            f"{name} became {value.detach().sum().item()}; lower lr or max_grad_norm, or look for such values in "
            "the rewards and observations."
        )


def policy_divergence(batch: TensorDictBase, dist: Heads) -> Tensor:
    """KL(policy that acted || dist) over the whole action, shape [*, robots].

    Raises:
        KeyError: the batch holds no ("agents", "params") of the policy that acted.
    """
    params = batch.get(PARAMS)
    if params is None:
        raise KeyError(f"The batch lacks {PARAMS}; keep what the policy wrote while it acted.")
    return dist.divergence_from(params)


class RobotValues:
    """A value per robot: keys and estimator of a loss with a local or a team critic."""

    team_value = False

    def setup(self, gamma: float, lmbda: float, finite_horizon: bool) -> None:
        """Name the keys and build the estimators; the bare one is told the values instead of the network."""
        self.set_keys(
            advantage=ADVANTAGE,
            value_target=TEAM_TARGET if self.team_value else TARGET,
            value=TEAM_VALUE if self.team_value else VALUE,
            reward=REWARD,
        )
        self.make_value_estimator(estimator_for(self, gamma, lmbda, finite_horizon, self.critic_network))
        self.__dict__["bare_estimator"] = estimator_for(self, gamma, lmbda, finite_horizon, None)


class TeamValues(RobotValues):
    """One value for the team, from a mixed critic; every robot gets the team's advantage."""

    team_value = True


class KLPenalty:
    """Adds `loss_kl` = kl_coeff * KL(acting policy || policy) to a PPO loss; kl_coeff 0 leaves it out."""

    def __init__(self, *args, kl_coeff: float = 0.0, kl_target: float = 0.01, **settings):
        super().__init__(*args, **settings)
        self.register_buffer("kl_coeff", torch.tensor(float(kl_coeff)))
        self.kl_target = kl_target

    def _log_weight(self, tensordict, adv_shape):
        terms = super()._log_weight(tensordict.copy(), adv_shape)  # a copy: it overwrites the acting parameters
        check_finite("loss_objective", terms[0])  # here, for TorchRL would draw from the broken policy next
        self.__dict__["_divergence"] = policy_divergence(tensordict, terms[1]) if self.kl_coeff > 0 else None
        return terms

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().forward(tensordict)
        if self._divergence is not None:
            terms.set("loss_kl", self.kl_coeff * self._divergence.mean())
        return terms

    def adapt_penalty(self, divergence: float) -> None:
        """Raise the coefficient by half above twice the target, halve it below half the target (Schulman 2017)."""
        if divergence > 2 * self.kl_target:
            self.kl_coeff.mul_(1.5)
        elif divergence < 0.5 * self.kl_target:
            self.kl_coeff.mul_(0.5)


class IPPO(RobotValues, KLPenalty, IPPOLoss):
    """TorchRL's IPPO with the optional KL penalty."""


class MAPPO(RobotValues, KLPenalty, MAPPOLoss):
    """TorchRL's MAPPO with the optional KL penalty."""


class VDPPO(TeamValues, KLPenalty, MAPPOLoss):
    """Clipped policy steps on the advantage of the mixed team value (Ma et al. 2022)."""


class NormalisedValues:
    """Critic error in units of the returns' running spread, as TorchRL's MAPPO has it."""

    def __init__(self, *args, value_norm=None, **settings):
        super().__init__(*args, **settings)
        self.value_norm = value_norm

    def _critic_loss_inputs(self, target: Tensor, value: Tensor, old: Tensor | None):
        norm = self.value_norm
        if norm is None:
            return target, value, old
        norm.update(target)
        return norm.normalize(target), norm.normalize(value), None if old is None else norm.normalize(old)


class TRPOLoss(RobotValues, NormalisedValues, PPOLoss):
    """Unclipped surrogate with its divergence from the acting policy, for a trust-region step.

    `surrogate` gives the two terms a trust-region step needs and leaves its parts in `terms`, to be logged;
    `forward` adds the critic's, so that any loop may use the loss.
    """

    default_value_estimator = ValueEstimators.MAGAE

    def __init__(self, *args, normalize_advantage_exclude_dims: tuple[int, ...] = (-2,), **settings):
        exclude = normalize_advantage_exclude_dims  # each robot by itself, as in TorchRL's MAPPO
        super().__init__(*args, normalize_advantage_exclude_dims=exclude, **settings)

    def surrogate(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Mean loss to lower (objective and entropy bonus) and mean divergence, each a scalar with its graph."""
        advantage = batch.get(self.tensor_keys.advantage)
        advantage = self._maybe_normalize_advantage(advantage, batch, update_norm=False)
        log_weight, dist, _, _ = self._log_weight(batch.copy(), adv_shape=advantage.shape[:-1])
        entropy = dist.entropy().unsqueeze(-1)
        objective, entropy = -(log_weight.exp() * advantage).mean(), entropy.mean()
        self.__dict__["terms"] = {"loss_objective": objective.item(), "entropy": entropy.item()}
        return objective - self.entropy_coeff * entropy, policy_divergence(batch, dist).mean()

    def divergence(self, batch: TensorDictBase) -> Tensor:
        """Mean divergence from the acting policy, a scalar with its graph."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        return policy_divergence(batch, dist).mean()


class VDA2C(TeamValues, NormalisedValues, A2CLoss):
    """Advantage actor-critic on the mixed team value (Su et al. 2021), for actions of two heads."""

    def __init__(self, *args, normalize_advantage: bool = True, **settings):
        super().__init__(*args, **settings)
        self.normalize_advantage = normalize_advantage

    @property
    def in_keys(self) -> list:
        """A2CLoss expects one action key; here each head has its own."""
        ends = [("next", *self.tensor_keys.reward), ("next", "done"), ("next", "terminated")]
        seen = {*self.actor_network.in_keys, *self.critic_network.in_keys}
        following = [("next", *key) for key in self.critic_network.in_keys]
        return [*self.tensor_keys.action, *ends, *seen, *following]

    def get_entropy_bonus(self, dist: Heads) -> Tensor:
        return dist.entropy().unsqueeze(-1)

    def _log_probs(self, tensordict: TensorDictBase):
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(tensordict.select(*self.actor_network.in_keys))
        log_probs = dist.log_prob(tensordict.select(*self.tensor_keys.action))
        with torch.no_grad():
            self.__dict__["_divergence"] = policy_divergence(tensordict, dist).mean()
        return sum(log_probs.values(True, True)).unsqueeze(-1), dist

    def loss_critic(self, tensordict: TensorDictBase):
        with self.critic_network_params.to_module(self.critic_network, preserve_module_state=False):
            value = self.critic_network(tensordict.select(*self.critic_network.in_keys))
        target = tensordict.get(self.tensor_keys.value_target)
        value = value.get(self.tensor_keys.value)
        self.__dict__["_explained"] = 1 - (target - value.detach()).var() / target.var().clamp_min(1e-8)
        target, value, _ = self._critic_loss_inputs(target, value, None)
        return self.critic_coeff * distance_loss(target, value, loss_function=self.loss_critic_type), None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.copy()
        if self.tensor_keys.advantage not in tensordict.keys(True):
            self.value_estimator(
                tensordict,
                params=self.critic_network_params.detach(),
                target_params=self.target_critic_network_params,
            )
        advantage = tensordict.get(self.tensor_keys.advantage)
        if self.normalize_advantage:
            advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-4)
        tensordict.set(self.tensor_keys.advantage, advantage)
        terms = super().forward(tensordict).set("kl", self._divergence)
        return terms.set("explained_variance", self._explained)
