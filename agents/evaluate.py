"""Evaluation: any policy over numbered episodes, whose maps and starts depend on (seed, number) alone."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from maexp.envs.metrics import episode_metrics, summarise


@dataclass
class EvaluationResult:
    """What came of a policy's episodes.

    Attributes:
        policy: its name
        num_robots: team size
        episodes: each metric's value in each episode; NaN where an episode has none
        seconds: wall time
    """

    policy: str
    num_robots: int
    episodes: dict
    seconds: float

    def summary(self) -> dict[str, dict]:
        """{metric: {mean, std, ci95: [lo, hi], n}}."""
        return {name: summarise(values) for name, values in self.episodes.items()}


def pool(name: str, parts: list[EvaluationResult]) -> EvaluationResult:
    """The episodes of several results of one policy as one result."""
    together = {metric: np.concatenate([one.episodes[metric] for one in parts]) for metric in parts[0].episodes}
    return EvaluationResult(name, parts[0].num_robots, together, sum(one.seconds for one in parts))


@torch.no_grad()
def evaluate(
    policy: Callable,
    env,
    episodes: int,
    *,
    name: str = "trained",
    seed: int = 0,
    advance: Callable[[int], None] = lambda count: None,
) -> EvaluationResult:
    """Play episodes 0 .. `episodes` - 1, each to its end, `env.num_envs` at once.

    Torch's random numbers are the same in every call with the same seed, and go on afterwards as if nothing
    had happened. `advance(count)` is called as episodes end.
    """
    begin = time.perf_counter()
    finals = []
    devices = [env.device] if env.device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        for first in range(0, episodes, env.num_envs):
            numbers = torch.arange(first, first + env.num_envs, device=env.device)
            count = min(env.num_envs, episodes - first)
            finals.append(play(policy, env, numbers.clamp(max=episodes - 1))[:count])
            advance(count)
    metrics = episode_metrics(torch.cat(finals), env.local_steps * env.macro_steps, env.success_coverage)
    return EvaluationResult(name, env.num_robots, metrics, time.perf_counter() - begin)


@torch.no_grad()
def play(policy: Callable, env, numbers: torch.Tensor) -> TensorDict:
    """One episode in each env, to the end: env i plays number `numbers[i]`. Returns the last step's info [envs]."""
    env.set_episodes(numbers)
    state = env.reset()
    final = state["info"].clone()
    running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    while bool(running.any()):
        state = env.step(policy(state))
        after = state["next"]
        final = torch.where(running, after["info"], final)
        running = running & ~after["done"].squeeze(-1)
        state = step_mdp(state)
    return final
