"""Experience: TorchRL's collector, made to continue where a checkpoint left it, one for each team size."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from maexp.agents.errors import UserError
from maexp.envs.metrics import succeeded
from maexp.envs.specs import REWARD_TERMS

_SEPARATOR = "/"


class WorkerLost(RuntimeError):
    """A worker process ended in the middle of the training. The message names it and says how it ended."""


class TeamCollector(Collector):
    """A Collector whose state holds the simulator and the observation the policy will see next.

    TorchRL's own leaves both out, so a run resumed from it starts new episodes.

    Attributes:
        seconds: what the latest batch took, and what of it the policy took
    """

    seconds = (0.0, 0.0)

    def rollout(self) -> TensorDictBase:
        """A batch, timed."""
        begin = time.perf_counter()
        with Stopwatch(self.policy) as acting:
            batch = super().rollout()
        self.seconds = (time.perf_counter() - begin, acting.seconds)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Counts, the simulator, and the observation at hand, as containers of tensors."""
        seen = {_SEPARATOR.join(key): self._carrier.get(key).clone() for key in self._seen_keys()}
        return {"frames": self._frames, "iter": self._iter, "env": self.env.state_dict(), "seen": seen}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs) -> None:
        """Go on where `state_dict` was called; ValueError if the simulator's state does not fit."""
        self.env.load_state_dict(state_dict["env"])
        self._frames, self._iter = state_dict["frames"], state_dict["iter"]
        for key in self._seen_keys():
            self._carrier.set(key, state_dict["seen"][_SEPARATOR.join(key)].to(self.env.device))

    def _seen_keys(self) -> list[tuple[str, ...]]:
        """What a reset returns: observation and done flags."""
        specs = (self.env.full_observation_spec, self.env.full_done_spec)
        keys = [key for spec in specs for key in spec.keys(True, True)]
        return [key if isinstance(key, tuple) else (key,) for key in keys]


def make_collector(env, policy, steps: int, storing_device: torch.device | None = None) -> TeamCollector:
    """An endless collector of batches [envs, steps], which end up on `storing_device` (default: the env's)."""
    return TeamCollector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        env_device=env.device,
        policy_device=env.device,
        storing_device=storing_device or env.device,
        auto_register_policy_transforms=False,
    )


@dataclass(frozen=True)
class Teams:
    """Teams of one size among those of a run: teams `first_env` to `first_env + num_envs` - 1."""

    num_robots: int
    num_envs: int
    first_env: int

    def split(self, parts: int) -> list["Teams"]:
        """Equal shares, one for each worker."""
        size = self.num_envs // parts
        return [Teams(self.num_robots, size, self.first_env + k * size) for k in range(parts)]


def divide_teams(num_envs: int, sizes: Sequence[int], workers: int = 1) -> list[Teams]:
    """Share `num_envs` teams among the team sizes as evenly as `workers` equal shares of each allow.

    Raises:
        UserError: there are too few, or they cannot be shared evenly.
    """
    units, rest = divmod(num_envs, workers)
    if rest:
        raise UserError(f"num_envs={num_envs} cannot be shared evenly by collector.workers={workers}.")
    if units < len(sizes):
        raise UserError(
            f"num_envs={num_envs} is too few for {len(sizes)} team sizes with collector.workers={workers} each: "
            f"choose {len(sizes) * workers} or more."
        )
    result, first = [], 0
    for k, size in enumerate(sizes):
        count = workers * (units * (k + 1) // len(sizes) - units * k // len(sizes))
        result.append(Teams(size, count, first))
        first += count
    return result


class Experience:
    """The batches that each iteration learns from: one per team size, collected in this process.

    Attributes:
        lag: by how many batches the policy that acts is older than the one that learns
        seconds: of the latest batches, in all (`wait`) and what of it the policy took
    """

    lag = 0

    def __init__(self, collectors: Sequence[TeamCollector]):
        self.collectors = list(collectors)
        self.seconds = {"wait": 0.0, "policy": 0.0, "simulate": 0.0}

    def next(self) -> list[TensorDictBase]:
        """A batch [envs, steps] of every team size."""
        begin = time.perf_counter()
        batches = [collector.next() for collector in self.collectors]
        self.time(begin, [collector.seconds for collector in self.collectors])
        return batches

    def time(self, begin: float, spent: Sequence[tuple[float, float]]) -> None:
        """Note where the time since `begin` went; `spent` holds seconds of batches and their policies."""
        policy = sum(seconds for _, seconds in spent)
        simulate = sum(seconds for seconds, _ in spent) - policy
        self.seconds = {"wait": time.perf_counter() - begin, "policy": policy, "simulate": simulate}

    def update_policy_weights_(self) -> None:
        """Act with what was learned."""
        for collector in self.collectors:
            collector.update_policy_weights_()

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on, but for the policy and the random numbers."""
        return {str(k): collector.state_dict() for k, collector in enumerate(self.collectors)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was called; ValueError where the state does not fit."""
        for k, collector in enumerate(self.collectors):
            collector.load_state_dict(state[str(k)])
        self.update_policy_weights_()

    def shutdown(self) -> None:
        """Free what the collectors hold."""
        for collector in self.collectors:
            collector.shutdown()


class Stopwatch:
    """Context that counts the seconds inside a module's forward passes."""

    def __init__(self, module: torch.nn.Module):
        self.module = module
        self.seconds = 0.0

    def __enter__(self) -> "Stopwatch":
        self._hooks = (
            self.module.register_forward_pre_hook(self._begin),
            self.module.register_forward_hook(self._end),
        )
        return self

    def __exit__(self, *error) -> None:
        for hook in self._hooks:
            hook.remove()

    def _begin(self, module, args) -> None:
        self._begun = time.perf_counter()

    def _end(self, module, args, output) -> None:
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.seconds += time.perf_counter() - self._begun


def batch_statistics(*batches: TensorDictBase, success_coverage: float = 0.95) -> dict[str, float]:
    """What the log says about batches [envs, steps]: rewards per decision, and how the episodes in them ended.

    A robot that has collided decides nothing, yet goes on paying: what it earns counts, over the decisions of the
    robots that drive. Several batches, of teams of several sizes, count as one: every decision, every episode alike.
    Means over ended episodes are NaN where none ended.
    """
    decisions = sum(int(batch["agents", "observation", "alive"].sum()) for batch in batches)
    earned = [_earned(batch) for batch in batches]
    ends = [_ends(batch, success_coverage) for batch in batches]
    return {
        **{name: sum(sums[name] for sums in earned) / max(decisions, 1) for name in earned[0]},
        "episodes": sum(len(end["coverage"]) for end in ends),
        **{name: torch.cat([end[name] for end in ends]).mean().item() for name in ends[0]},
    }


def _earned(batch: TensorDictBase) -> dict[str, float]:
    """Reward and its terms, summed over all robots and steps."""
    info = batch["next", "info"]
    rewards = {"reward": batch["next", "agents", "reward"]}
    rewards |= {f"reward_{term}": info[f"reward_{term}"] for term in REWARD_TERMS}
    return {name: value.sum(dtype=torch.float64).item() for name, value in rewards.items()}


def _ends(batch: TensorDictBase, success_coverage: float) -> dict[str, torch.Tensor]:
    """What became of every episode that ended, [m]."""
    after, info = batch["next"], batch["next", "info"]
    ends = {
        "coverage": info["coverage"].squeeze(-1),
        "success_rate": succeeded(info, success_coverage).squeeze(-1),
        "collisions": info["collided"].sum(-1),
        "path_length": info["path_length"].mean(-1),
    }
    done = after["done"].squeeze(-1)
    return {name: value[done].float() for name, value in ends.items()}
