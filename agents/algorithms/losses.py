"""The losses of the six algorithms: TorchRL's, each with only what our teams need to differ.

All read a Collector batch [envs, T], or its flattened team steps once advantages are in it. They keep robots
apart (one probability ratio per robot, over its whole action) and write loss_objective, loss_entropy,
loss_critic (and loss_kl), plus what one likes to log. A robot that had collided decides nothing: its actions are
left out of all that concerns the policy, its values are learned like any other.

A loss has two sides, the policy's and the critic's. Once there are advantages neither needs the other, unless the
critic reads what the policy's encoder has just made: so each may be asked for by itself, in a thread of its own.
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import A2CLoss, PPOLoss, ValueEstimators
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.utils import distance_loss

from maexp.agents.algorithms.advantages import ADVANTAGE, REWARD, TARGET, TEAM_TARGET, estimator_for, write_advantages
from maexp.agents.networks.actor import ALIVE, PARAMS, SEEN
from maexp.agents.networks.critics import TEAM_VALUE, VALUE
from maexp.agents.networks.distributions import Heads

ANCHOR = ("agents", "anchor")


class NonFiniteLoss(ArithmeticError):
    """A loss term or gradient is NaN or infinite; the message names it."""


def check_finite(name: str, value: Tensor) -> None:
    """Raise NonFiniteLoss if `value` holds a NaN or an infinity."""
    if not torch.isfinite(value).all():
        raise NonFiniteLoss(
            f"{name} became {value.detach().sum().item()}; lower lr or max_grad_norm, or look for such values in "
            "the rewards and observations."
        )


def policy_divergence(batch: TensorDictBase, dist: Heads, key: tuple[str, ...] = PARAMS) -> Tensor:
    """KL(policy that acted || dist) over the whole action, shape [*, robots].

    Args:
        batch: holds the parameters of the policy that acted
        dist: of the policy that learns
        key: where these parameters are; ANCHOR for those of the policy that `dist` is kept near

    Raises:
        KeyError: they are not there.
    """
    params = batch.get(key, None)
    if params is None:
        raise KeyError(f"The batch lacks {key}; keep what the policy wrote while it acted.")
    return dist.divergence_from(params)


def select_living(values: Tensor, alive: Tensor) -> Tensor:
    """The rows of `values` [*, robots, k] whose robot is alive, [n, k]; one row of zeros where none is."""
    chosen = values[alive]
    return chosen if len(chosen) else 0 * values.flatten(0, alive.ndim - 1)[:1]


def standardise(values: Tensor, alive: Tensor, keep_robots: bool) -> Tensor:
    """`values` [*, robots, 1] less their mean over the living, over their spread.

    Args:
        values: of every robot
        alive: which count, bool [*, robots]
        keep_robots: standardise each robot of the team by itself
    """
    dims = [dim for dim in range(alive.ndim) if not (keep_robots and dim == alive.ndim - 1)]
    weight = alive.to(values.dtype)
    count = weight.sum(dims, keepdim=True)
    mean = (weight * values[..., 0]).sum(dims, keepdim=True) / count.clamp_min(1)
    rest = values[..., 0] - mean
    spread = ((weight * rest.square()).sum(dims, keepdim=True) / (count - 1).clamp_min(1)).sqrt()
    return (rest / spread.clamp_min(1e-6)).unsqueeze(-1)


class LivingRobots:
    """Leaves the actions of robots that had collided out of the objective, entropy, divergence and statistics.

    Args:
        mask_collided: false counts them like the others

    Attributes:
        anchor_coeff: weight of the divergence from the policy of a warm start
    """

    anchor_coeff = 0.0

    def __init__(self, *args, mask_collided: bool = True, **settings):
        super().__init__(*args, **settings)
        self.mask_collided = mask_collided
        self._has_critic = False  # for TorchRL's forward: `critic_terms` has what concerns the critic

    @property
    def is_shared(self) -> bool:
        """Whether the critic reads what the policy's encoder made."""
        return SEEN in self.critic_network.in_keys

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """All terms; advantages are estimated where there are none."""
        if self.tensor_keys.advantage not in batch.keys(True):
            batch = self.estimate(batch.copy())
        terms = self.policy_terms(batch)
        if self.is_shared:  # with its graph
            batch = batch.copy().set(SEEN, self.__dict__.pop("_seen"))
        return terms.update(self.critic_terms(batch))

    def estimate(self, batch: TensorDictBase) -> TensorDictBase:
        """Write advantages into the batch, of shape [envs, T] where the critic reads what the policy's encoder made."""
        if self.is_shared:  # TorchRL's estimator would not find that
            return write_advantages(self, batch)
        networks = dict(params=self.critic_network_params.detach(), target_params=self.target_critic_network_params)
        return self.value_estimator(batch, **networks)

    def policy_terms(self, batch: TensorDictBase) -> TensorDict:
        """What the policy learns from, and statistics; `batch` has advantages."""
        return super().forward(batch)

    def critic_terms(self, batch: TensorDictBase) -> TensorDict:
        """What the critic learns from, and how much of the returns it explains; `batch` has their targets."""
        loss, clipped, explained = self.loss_critic(batch.copy())
        weight = self.critic_coeff or 0.0  # TorchRL makes None of 0
        terms = {"loss_critic": (weight * loss).mean(), "value_clip_fraction": clipped, "explained_variance": explained}
        return TensorDict({name: value for name, value in terms.items() if value is not None})

    def find_living(self, batch: TensorDictBase) -> Tensor:
        """Whose actions count, bool [*, robots]."""
        alive = batch.get(ALIVE, None) if self.mask_collided else None
        if alive is None:
            alive = torch.ones(batch.get(self.tensor_keys.advantage).shape[:-1], dtype=torch.bool, device=batch.device)
        return alive

    def _maybe_normalize_advantage(self, advantage: Tensor, tensordict, *, update_norm: bool = False) -> Tensor:
        self.__dict__["_alive"] = alive = self.find_living(tensordict)
        if self.normalize_advantage:
            advantage = standardise(advantage, alive, bool(self.normalize_advantage_exclude_dims))
        return select_living(advantage, alive)

    def _log_weight(self, tensordict, adv_shape):
        alive = self._alive  # the shape given is that of the advantages selected
        acted = tensordict.copy()
        log_weight, dist, kl, behaviour = super()._log_weight(acted, alive.shape)
        self.keep_seen(acted)
        return select_living(log_weight, alive), dist, select_living(kl, alive), behaviour

    def keep_seen(self, acted: TensorDictBase) -> None:
        """Keep what the policy's encoder has just made, with its graph, for a critic that reads it."""
        if self.is_shared:
            self.__dict__["_seen"] = acted.get(SEEN)

    def _get_entropy(self, dist: Heads, adv_shape=None) -> Tensor:
        return select_living(dist.entropy().unsqueeze(-1), self._alive)

    def mean_divergence(self, batch: TensorDictBase, dist: Heads, key: tuple[str, ...] = PARAMS) -> Tensor:
        """Of `dist` from the policy that acted, over the living; arguments as in `policy_divergence`."""
        return select_living(policy_divergence(batch, dist, key).unsqueeze(-1), self.find_living(batch)).mean()

    def pull(self, batch: TensorDictBase, dist: Heads) -> dict[str, Tensor]:
        """The term that keeps `dist` near the policy of a warm start, where the batch tells what that one would do."""
        if ANCHOR not in batch.keys(True):
            return {}
        return {"loss_anchor": self.anchor_coeff * self.mean_divergence(batch, dist, ANCHOR)}


class RobotValues:
    """A value per robot: keys and estimator of a loss with a local or a team critic."""

    team_value = False

    def setup(self, gamma: float, lmbda: float, finite_horizon: bool) -> None:
        """Name the keys and build the estimators; the bare one is told the values instead of the network."""
        heads = list(self.actor_network.dist_sample_keys)  # lists, of one head too: TorchRL then selects by key
        self.set_keys(
            action=heads,
            sample_log_prob=list(self.actor_network.log_prob_keys),
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


class KLPenalty(LivingRobots):
    """Adds `loss_kl` = kl_coeff * KL(acting policy || policy) to a PPO loss; kl_coeff 0 leaves it out."""

    def __init__(self, *args, kl_coeff: float = 0.0, kl_target: float = 0.01, **settings):
        super().__init__(*args, **settings)
        self.register_buffer("kl_coeff", torch.tensor(float(kl_coeff)))
        self.kl_target = kl_target

    def _log_weight(self, tensordict, adv_shape):
        terms = super()._log_weight(tensordict, adv_shape)
        check_finite("loss_objective", terms[0])  # here, for TorchRL would draw from the broken policy next
        self.__dict__["_extra"] = extra = self.pull(tensordict, terms[1])
        if self.kl_coeff > 0:
            extra["loss_kl"] = self.kl_coeff * self.mean_divergence(tensordict, terms[1])
        return terms

    def policy_terms(self, batch: TensorDictBase) -> TensorDict:
        return super().policy_terms(batch).update(self._extra)

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


class TRPOLoss(RobotValues, NormalisedValues, LivingRobots, PPOLoss):
    """Unclipped surrogate with its divergence from the acting policy, for a trust-region step.

    `surrogate` gives the two terms a trust-region step needs and leaves its parts in `terms`, to be logged.
    """

    default_value_estimator = ValueEstimators.MAGAE

    def __init__(self, *args, normalize_advantage_exclude_dims: tuple[int, ...] = (-2,), **settings):
        exclude = normalize_advantage_exclude_dims  # each robot by itself, as in TorchRL's MAPPO
        super().__init__(*args, normalize_advantage_exclude_dims=exclude, **settings)

    def surrogate(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Mean loss to lower (objective and entropy bonus) and mean divergence, each a scalar with its graph."""
        advantage = batch.get(self.tensor_keys.advantage)
        advantage = self._maybe_normalize_advantage(advantage, batch, update_norm=False)
        log_weight, dist, _, _ = self._log_weight(batch, adv_shape=advantage.shape[:-1])
        objective, entropy = -(log_weight.exp() * advantage).mean(), self._get_entropy(dist).mean()
        terms = {"loss_objective": objective} | self.pull(batch, dist)
        self.__dict__["terms"] = {name: value.item() for name, value in terms.items()} | {"entropy": entropy.item()}
        return sum(terms.values()) - self.entropy_coeff * entropy, self.mean_divergence(batch, dist)

    def divergence(self, batch: TensorDictBase) -> Tensor:
        """Mean divergence from the acting policy, a scalar with its graph."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        return self.mean_divergence(batch, dist)


class VDA2C(TeamValues, NormalisedValues, LivingRobots, A2CLoss):
    """Advantage actor-critic on the mixed team value (Su et al. 2021), for actions of several heads."""

    normalize_advantage_exclude_dims = ()  # all robots have the same advantage

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

    def _log_probs(self, tensordict: TensorDictBase):
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(acted := tensordict.select(*self.actor_network.in_keys))
        self.keep_seen(acted)
        log_probs = dist.log_prob(tensordict.select(*self.tensor_keys.action))
        return sum(log_probs.values(True, True)).unsqueeze(-1), dist

    def loss_critic(self, tensordict: TensorDictBase):
        with self.critic_network_params.to_module(self.critic_network, preserve_module_state=False):
            value = self.critic_network(tensordict.select(*self.critic_network.in_keys))
        target = tensordict.get(self.tensor_keys.value_target)
        value = value.get(self.tensor_keys.value)
        explained = 1 - (target - value.detach()).var() / target.var().clamp_min(1e-8)
        target, value, _ = self._critic_loss_inputs(target, value, None)
        return distance_loss(target, value, loss_function=self.loss_critic_type), None, explained

    def policy_terms(self, batch: TensorDictBase) -> TensorDict:
        advantage = self._maybe_normalize_advantage(batch.get(self.tensor_keys.advantage), batch)
        log_prob, dist = self._log_probs(batch)
        entropy = self._get_entropy(dist).mean()
        terms = {
            "loss_objective": -(select_living(log_prob, self._alive) * advantage).mean(),
            "loss_entropy": -self.entropy_coeff * entropy,
            "entropy": entropy.detach(),
            "kl": self.mean_divergence(batch, dist).detach(),
        }
        return TensorDict(terms | self.pull(batch, dist))
