"""Generalised advantages for teams: per robot, or one for the whole team, from one look at each state."""

import torch
from tensordict import TensorDictBase
from torchrl.objectives.value import GAE, MultiAgentGAE

from maexp.agents.models.actor import SEEN
from maexp.agents.models.critics import TEAM_VALUE, VALUE

REWARD = ("agents", "reward")
ADVANTAGE = ("agents", "advantage")
TARGET = ("agents", "value_target")
TEAM_TARGET = ("team", "value_target")
TEAM_ADVANTAGE = ("team", "advantage")
TEAM_REWARD = ("team", "reward")


class TeamGAE(GAE):
    """GAE of the team's value on the sum of the robots' rewards, given to every robot as its advantage.

    The advantage is written per robot, [*, T, robots, 1]: with one of shape [*, T, 1] TorchRL's losses would
    form the probability ratio of the joint action without a word.
    """

    def set_keys(self, **keys) -> None:
        """The keys of advantage and reward are the robots'; the team's own are kept beside its value."""
        if "advantage" in keys:
            self.robot_advantage = keys["advantage"]
            keys = keys | {"advantage": TEAM_ADVANTAGE}
        if "reward" in keys:
            self.robot_reward = keys["reward"]
            keys = keys | {"reward": TEAM_REWARD}
        super().set_keys(**keys)

    def forward(self, tensordict: TensorDictBase, **kwargs) -> TensorDictBase:
        reward = tensordict.get(("next", self.robot_reward))
        tensordict.set(("next", TEAM_REWARD), reward.sum(-2))
        tensordict = super().forward(tensordict, **kwargs)
        robots = reward.shape[-2]
        advantage = tensordict.get(self.tensor_keys.advantage).unsqueeze(-2)
        return tensordict.set(self.robot_advantage, advantage.expand(*advantage.shape[:-2], robots, 1))


def estimator_for(loss, gamma: float, lmbda: float, finite_horizon: bool, critic) -> GAE:
    """The estimator that fits a loss: TeamGAE where its critic values the team, else MultiAgentGAE.

    Args:
        loss: names the keys
        gamma: discount per macro step
        lmbda: trace decay
        finite_horizon: nothing follows a truncated episode either; its key of terminations is then "done"
        critic: network to call, or None to read the values from the batch
    """
    kind = TeamGAE if loss.team_value else MultiAgentGAE
    estimator = kind(gamma=gamma, lmbda=lmbda, value_network=critic, deactivate_vmap=True)
    names = ("advantage", "value", "value_target", "reward")
    estimator.set_keys(**{name: getattr(loss.tensor_keys, name) for name in names})
    if finite_horizon:
        estimator.set_keys(terminated="done")
    return estimator


@torch.no_grad()
def look(loss, states: TensorDictBase, chunk: int) -> torch.Tensor:
    """What the policy makes of `states` [n], for a critic that shares its encoder."""
    actor = loss.actor_network
    with loss.actor_network_params.to_module(actor):
        parts = states.select(*actor.in_keys).split(chunk)
        return torch.cat([actor.get_dist_params(part)[SEEN] for part in parts])


@torch.no_grad()
def write_advantages(loss, batch: TensorDictBase, chunk: int = 256) -> TensorDictBase:
    """Write values, advantages and value targets into a Collector batch.

    The state after step t is the state before step t + 1 unless the episode ended there, so each state is
    valued once; only the last step, and truncated ends unless the horizon is finite, need another look. (TorchRL
    values every state twice.)

    Args:
        loss: holds the critic and the discount
        batch: shape [envs, T] with "next"
        chunk: team steps valued at a time; bounds the memory

    Returns:
        the batch itself
    """
    team = loss.team_value
    key = TEAM_VALUE if team else VALUE

    def values(states: TensorDictBase) -> torch.Tensor:
        with loss.critic_network_params.to_module(loss.critic_network):
            return torch.cat([loss.critic_network(part.copy()).get(key) for part in states.split(chunk)])

    inputs = loss.critic_network.in_keys
    if loss.is_shared and SEEN not in batch.keys(True):
        batch.set(SEEN, look(loss, batch.flatten(), chunk).unflatten(0, batch.shape))
    value = values(batch.select(*inputs).flatten()).unflatten(0, batch.shape)
    estimator = loss.make_estimator()
    last = estimator.tensor_keys.terminated  # "done" where the horizon is finite
    done, final = (batch["next", name].squeeze(-1) for name in ("done", last))
    ends = done.clone()
    ends[:, -1] = True
    ends &= ~final  # what follows is worth 0 and never read
    following = torch.cat((value[:, 1:], torch.zeros_like(value[:, :1])), dim=1)
    if ends.any():
        after = batch["next"].select(*inputs, *loss.actor_network.in_keys, strict=False)[ends]
        if loss.is_shared:
            after.set(SEEN, look(loss, after, chunk))
        following[ends] = values(after.select(*inputs))
    batch.set(key, value)
    batch.set(("next", *key), following)
    return estimator(batch) if loss.decision_steps is None else discount_by_time(loss, batch, value, following, final)


def discount_by_time(
    loss, batch: TensorDictBase, value: torch.Tensor, following: torch.Tensor, final: torch.Tensor
) -> TensorDictBase:
    """Write advantages and value targets where decisions differ in length: what comes later counts less by the time
    that has passed, not by the decisions.

    Args:
        value, following: before and after each decision, [envs, T, 1], or [envs, T, robots, 1] where robots are valued
        final: after which nothing counts, bool [envs, T]
    """
    reward, done = batch["next", REWARD[0], REWARD[1]], batch["next", "done"].squeeze(-1)
    robots = reward.shape[-2]
    reward = reward.sum(-2) if loss.team_value else reward
    lead = (..., *[None] * (value.ndim - 2))
    length = (batch["next", "info", "local_steps"] - batch["info", "local_steps"]).squeeze(-1) / loss.decision_steps
    discount, trace = ((base**length)[lead] for base in (loss.gamma, loss.gamma * loss.lmbda))
    error = reward + discount * following * ~final[lead] - value
    trace, advantage = trace * ~done[lead], torch.zeros_like(error)
    last = advantage[:, -1]
    for t in reversed(range(error.shape[1])):
        last = error[:, t] + trace[:, t] * last
        advantage[:, t] = last
    batch.set(loss.tensor_keys.value_target, advantage + value)
    if loss.team_value:
        advantage = advantage.unsqueeze(-2).expand(*advantage.shape[:-1], robots, 1)
    return batch.set(loss.tensor_keys.advantage, advantage)
