"""Experience: TorchRL's collector, made to continue where a checkpoint left it."""

import time
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from maexp.envs.specs import REWARD_TERMS

_SEPARATOR = "/"


class TeamCollector(Collector):
    """A Collector whose state holds the simulator and the observation the policy will see next.

    TorchRL's own leaves both out, so a run resumed from it starts new episodes.
    """

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


def make_collector(env, policy, steps: int) -> TeamCollector:
    """An endless collector of batches [envs, steps]."""
    return TeamCollector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        env_device=env.device,
        policy_device=env.device,
        storing_device=env.device,
    )


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


def batch_statistics(batch: TensorDictBase) -> dict[str, float]:
    """What the log says about a batch [envs, steps]: rewards per step, and how the episodes in it ended.

    Means over ended episodes are NaN where none ended.
    """
    after, info = batch["next"], batch["next", "info"]
    done = after["done"].squeeze(-1)
    success = after["terminated"].squeeze(-1) & ~info["collided"].all(-1)
    at_the_end = {
        "coverage": info["coverage"].squeeze(-1),
        "success_rate": success,
        "collisions": info["collided"].sum(-1),
        "path_length": info["path_length"].mean(-1),
    }
    return {
        "reward": after["agents", "reward"].mean().item(),
        **{f"reward_{term}": info[f"reward_{term}"].mean().item() for term in REWARD_TERMS},
        "episodes": int(done.sum()),
        **{name: value[done].float().mean().item() for name, value in at_the_end.items()},
    }
