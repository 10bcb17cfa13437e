"""The losses of the six algorithms: clipped, trust region and actor-critic, on one base for teams.

Each is a LossModule of TorchRL that reads a Collector batch [envs, T], or its flattened team steps once advantages are
in it. They keep robots apart (one probability ratio per robot, over its whole action) and write terms that are named
loss_*, to be added up, beside what one likes to log. A robot that had collided decides nothing: its actions are left
out of all that concerns the policy, its values are learned like any other.

A loss has two sides, the policy's and the critic's. Once there are advantages neither needs the other, unless the
critic reads what the policy's encoder has just made: so each may be asked for by itself, in a thread of its own.
"""

from dataclasses import dataclass, field

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value import GAE

from maexp.agents.algorithms.gae import ADVANTAGE, REWARD, TARGET, TEAM_TARGET, estimator_for, write_advantages
from maexp.agents.models.actor import ALIVE, DECIDING, PARAMS, SEEN
from maexp.agents.models.critics import TEAM_VALUE, VALUE
from maexp.agents.models.distributions import Heads

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


class TeamLoss(LossModule):
    """What all losses share: the networks, the robots that count, advantages, and the critic's side.

    A critic that writes the team's value gives every robot the team's advantage, another each robot its own.

    Args:
        actor: the policy, from make_policy
        critic: from make_critic
        gamma, lmbda, finite_horizon: of the advantages (`config/algorithms.py`)
        entropy_coeff: weight of the entropy of a robot's whole action
        critic_coeff: weight of the critic's error, a smooth L1
        clip_value: bound on the change of a value; None: none
        normalize_advantage: standardise advantages over the robots that count
        mask_collided: false counts the actions of robots that had collided like the others
        value_norm: running spread of the returns: the critic's error is measured in units of it

    Attributes:
        anchor_coeff: weight of the divergence from the policy of a warm start
        decision_steps: local steps that `gamma` and `lmbda` are for, where decisions differ in length
    """

    out_keys = ["loss_objective", "loss_entropy", "loss_critic", "entropy", "explained_variance"]
    standardises_each_robot = True
    anchor_coeff = 0.0
    decision_steps: int | None = None

    @dataclass
    class _AcceptedKeys:
        """Where the batch has what, as TorchRL's losses name it."""

        advantage: NestedKey = ADVANTAGE
        value_target: NestedKey = TARGET
        value: NestedKey = VALUE
        reward: NestedKey = REWARD
        action: list = field(default_factory=list)
        sample_log_prob: list = field(default_factory=list)

    def __init__(
        self,
        actor,
        critic,
        *,
        gamma: float,
        lmbda: float,
        finite_horizon: bool,
        entropy_coeff: float,
        critic_coeff: float,
        normalize_advantage: bool,
        mask_collided: bool,
        clip_value: float | None = None,
        value_norm=None,
    ):
        super().__init__()
        self.convert_to_functional(actor, "actor_network", create_target_params=False)
        self.convert_to_functional(critic, "critic_network", create_target_params=False)
        self.register_coeff_buffer("entropy_coeff", entropy_coeff)
        self.register_coeff_buffer("critic_coeff", critic_coeff)
        self.register_coeff_buffer("clip_value", clip_value)
        self.normalize_advantage, self.mask_collided, self.value_norm = normalize_advantage, mask_collided, value_norm
        self.gamma, self.lmbda, self.finite_horizon = gamma, lmbda, finite_horizon
        self.team_value = TEAM_VALUE in critic.out_keys
        self.set_keys(action=list(actor.dist_sample_keys), sample_log_prob=list(actor.log_prob_keys))
        if self.team_value:
            self.set_keys(value=TEAM_VALUE, value_target=TEAM_TARGET)
        self.make_value_estimator(self.make_estimator(self.critic_network))

    @property
    def in_keys(self) -> list[NestedKey]:
        """What a batch without advantages must hold."""
        ends = [("next", *REWARD), ("next", "done"), ("next", "terminated")]
        seen = {*self.actor_network.in_keys, *self.critic_network.in_keys}
        following = [("next", *key) for key in self.critic_network.in_keys]
        return [*self.tensor_keys.action, *self.tensor_keys.sample_log_prob, *ends, *seen, *following]

    @property
    def is_shared(self) -> bool:
        """Whether the critic reads what the policy's encoder made."""
        return SEEN in self.critic_network.in_keys

    def make_estimator(self, critic=None) -> GAE:
        """The estimator of advantages that calls `critic`; None: it reads the values from the batch."""
        return estimator_for(self, self.gamma, self.lmbda, self.finite_horizon, critic)

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """All terms; advantages are estimated where there are none."""
        if self.tensor_keys.advantage not in batch.keys(True):
            batch = self.estimate(batch.copy())
        dist, made = self.act(batch)
        terms = self.policy_terms(batch, dist)
        if self.is_shared:  # with its graph
            batch = batch.copy().set(SEEN, made.get(SEEN))
        return terms.update(self.critic_terms(batch))

    def estimate(self, batch: TensorDictBase) -> TensorDictBase:
        """Write advantages into the batch, of shape [envs, T] where the critic reads what the policy's encoder made."""
        if self.is_shared:  # TorchRL's estimator would not find that
            return write_advantages(self, batch)
        params = self.critic_network_params.detach()
        return self.value_estimator(batch, params=params, target_params=params)

    def act(self, batch: TensorDictBase) -> tuple[Heads, TensorDictBase]:
        """The policy's distribution in the states of `batch`, and all that its network wrote, with their graphs."""
        made = batch.select(*self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network.get_dist(made), made

    def policy_terms(self, batch: TensorDictBase, dist: Heads | None = None) -> TensorDict:
        """What the policy learns from, and statistics; `batch` has advantages, and `dist` is what the policy would do
        in it, if that is known."""
        raise NotImplementedError

    def critic_terms(self, batch: TensorDictBase) -> TensorDict:
        """What the critic learns from, and how much of the returns it explains; `batch` has their targets."""
        target, old = batch.get(self.tensor_keys.value_target), None
        with self.critic_network_params.to_module(self.critic_network, preserve_module_state=False):
            value = self.critic_network(batch.select(*self.critic_network.in_keys)).get(self.tensor_keys.value)
        if self.clip_value is not None:
            old = batch.get(self.tensor_keys.value)
        if self.value_norm is not None:
            self.value_norm.update(target)
            target, value = self.value_norm.normalize(target), self.value_norm.normalize(value)
            old = None if old is None else self.value_norm.normalize(old)
        error = distance_loss(target, value, loss_function="smooth_l1")
        if old is not None:
            clipped = old + (value - old).clamp(-self.clip_value, self.clip_value)
            error = torch.maximum(error, distance_loss(target, clipped, loss_function="smooth_l1"))
        left = (target - value.detach()).var(dim=0, correction=0)
        spread = target.var(dim=0, correction=0) + torch.finfo(target.dtype).eps
        return TensorDict({"loss_critic": (self.critic_coeff * error).mean(), "explained_variance": 1 - left / spread})

    def find_living(self, batch: TensorDictBase) -> Tensor:
        """Whose actions count, bool [*, robots]."""
        alive = batch.get(ALIVE, None) if self.mask_collided else None
        if alive is None:
            alive = torch.ones(batch.get(self.tensor_keys.advantage).shape[:-1], dtype=torch.bool, device=batch.device)
        deciding = batch.get(DECIDING, None)
        return alive if deciding is None else alive & deciding

    def advantage(self, batch: TensorDictBase, alive: Tensor) -> Tensor:
        """Of the robots that count, [n, 1]."""
        advantage = batch.get(self.tensor_keys.advantage)
        if self.normalize_advantage:
            advantage = standardise(advantage, alive, self.standardises_each_robot)
        return select_living(advantage, alive)

    def log_prob(self, batch: TensorDictBase, dist: Heads) -> TensorDictBase:
        """Of each head of the actions in the batch."""
        return dist.log_prob(batch.select(*self.tensor_keys.action))

    def log_ratio(self, batch: TensorDictBase, dist: Heads, alive: Tensor) -> Tensor:
        """Of the probabilities of the whole action, now to then, of the robots that count, [n, 1]."""
        now = self.log_prob(batch, dist)
        log_ratio = sum(now[key] - batch[key] for key in self.tensor_keys.sample_log_prob)
        return select_living(log_ratio.unsqueeze(-1), alive)

    def mean_divergence(self, batch: TensorDictBase, dist: Heads, key: tuple[str, ...] = PARAMS) -> Tensor:
        """Of `dist` from the policy that acted, over the living; arguments as in `policy_divergence`."""
        return select_living(policy_divergence(batch, dist, key).unsqueeze(-1), self.find_living(batch)).mean()

    def pull(self, batch: TensorDictBase, dist: Heads) -> dict[str, Tensor]:
        """The term that keeps `dist` near the policy of a warm start, where the batch tells what that one would do."""
        if ANCHOR not in batch.keys(True):
            return {}
        return {"loss_anchor": self.anchor_coeff * self.mean_divergence(batch, dist, ANCHOR)}


class ClippedLoss(TeamLoss):
    """PPO with a clipped ratio per robot (Schulman et al. 2017), and optionally loss_kl, a penalty on the divergence.

    Args:
        clip_epsilon: bound on each robot's probability ratio
        kl_coeff: first weight of the penalty; 0 leaves it out
        kl_target: divergence at which that weight stays
    """

    def __init__(self, *args, clip_epsilon: float, kl_coeff: float = 0.0, kl_target: float = 0.01, **settings):
        super().__init__(*args, **settings)
        self.register_buffer("clip_epsilon", torch.tensor(clip_epsilon, dtype=torch.float32))
        self.register_buffer("kl_coeff", torch.tensor(float(kl_coeff), dtype=torch.float32))
        self.kl_target = kl_target

    def policy_terms(self, batch: TensorDictBase, dist: Heads | None = None) -> TensorDict:
        dist = self.act(batch)[0] if dist is None else dist
        alive = self.find_living(batch)
        advantage, log_ratio = self.advantage(batch, alive), self.log_ratio(batch, dist, alive)
        near = self.pull(batch, dist)
        if self.kl_coeff > 0:
            near["loss_kl"] = self.kl_coeff * self.mean_divergence(batch, dist)
        clipped = log_ratio.clamp((-self.clip_epsilon).log1p(), self.clip_epsilon.log1p())
        gain = torch.stack([log_ratio.exp() * advantage, clipped.exp() * advantage], -1).min(dim=-1).values
        entropy = select_living(dist.entropy().unsqueeze(-1), alive)
        then = log_ratio.detach().squeeze(-1)
        sample_size = (2 * then.logsumexp(0) - (2 * then).logsumexp(0)).exp() / len(then)
        return TensorDict(
            {
                "loss_objective": (-gain).mean(),
                "clip_fraction": (clipped != log_ratio).to(log_ratio.dtype).mean(),
                "kl": (-log_ratio).detach().mean(),
                "entropy": entropy.detach().mean(),
                "loss_entropy": (-self.entropy_coeff * entropy).mean(),
                "ESS": sample_size,
            }
            | near
        )

    def adapt_penalty(self, divergence: float) -> None:
        """Raise the coefficient by half above twice the target, halve it below half the target (Schulman 2017)."""
        if divergence > 2 * self.kl_target:
            self.kl_coeff.mul_(1.5)
        elif divergence < 0.5 * self.kl_target:
            self.kl_coeff.mul_(0.5)


class TrustRegionLoss(TeamLoss):
    """Unclipped surrogate with its divergence from the acting policy, for a trust-region step."""

    def policy_terms(self, batch: TensorDictBase, dist: Heads | None = None) -> TensorDict:
        dist = self.act(batch)[0] if dist is None else dist
        alive = self.find_living(batch)
        advantage, log_ratio = self.advantage(batch, alive), self.log_ratio(batch, dist, alive)
        objective = -(log_ratio.exp() * advantage).mean()
        entropy = select_living(dist.entropy().unsqueeze(-1), alive).mean()
        terms = {"loss_objective": objective} | self.pull(batch, dist)
        return TensorDict(terms | {"loss_entropy": -self.entropy_coeff * entropy, "entropy": entropy.detach()})

    def surrogate(self, batch: TensorDictBase) -> tuple[Tensor, Tensor, TensorDict]:
        """Mean loss to lower and mean divergence, each a scalar with its graph, and the terms of the loss."""
        dist, _ = self.act(batch)
        terms = self.policy_terms(batch, dist)
        loss = sum(value for name, value in terms.items() if name.startswith("loss_"))
        return loss, self.mean_divergence(batch, dist), terms.detach()

    def divergence(self, batch: TensorDictBase) -> Tensor:
        """Mean divergence from the acting policy, a scalar with its graph."""
        return self.mean_divergence(batch, self.act(batch)[0])


class ActorCriticLoss(TeamLoss):
    """Advantage actor-critic (Su et al. 2021), for actions of several heads."""

    standardises_each_robot = False  # all robots of a team have the same advantage

    def policy_terms(self, batch: TensorDictBase, dist: Heads | None = None) -> TensorDict:
        dist = self.act(batch)[0] if dist is None else dist
        alive = self.find_living(batch)
        advantage = self.advantage(batch, alive)
        log_prob = sum(self.log_prob(batch, dist).values(True, True)).unsqueeze(-1)
        entropy = select_living(dist.entropy().unsqueeze(-1), alive).mean()
        terms = {
            "loss_objective": -(select_living(log_prob, alive) * advantage).mean(),
            "loss_entropy": -self.entropy_coeff * entropy,
            "entropy": entropy.detach(),
            "kl": self.mean_divergence(batch, dist).detach(),
        }
        return TensorDict(terms | self.pull(batch, dist))
