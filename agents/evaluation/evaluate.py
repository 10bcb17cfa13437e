"""Evaluation: any policy over numbered episodes, whose maps and starts depend on (seed, number) alone."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from maexp.agents.evaluation.cache import EpisodeCache, go_on_with_random_numbers, random_numbers
from maexp.agents.evaluation.metric_format import Evidence
from maexp.envs.metrics import episode_metrics, label_copies, resample_weights, summarise
from maexp.envs.recorder import CoverageRecorder

RECORD_EVERY = 10  # local steps between two points of a coverage curve


@dataclass
class EvaluationResult:
    """What came of a policy's episodes.

    Attributes:
        policy: its name
        num_robots: team size
        episodes: each metric's value in each episode; NaN where an episode has none
        seconds: wall time
        maps: the map of each episode, names [episodes]
        learned: whether the policy was trained
        place: the map, where several were played one by one; "": all of them
        times, coverage: coverage over time, [records] [s] and [episodes, records] in [0, 1]; None: not recorded
        shares: of each robot in what its team discovered, [episodes, robots]; None: not recorded
        success_coverage: share at which an episode was over: later marks tell nothing (`metrics.in_reach`)
        trainings: the seed of the policy's training in each episode [episodes], where several are pooled: intervals
            resample them as they do maps; None: one policy
        run: what was run, as it is written
    """

    policy: str
    num_robots: int
    episodes: dict
    seconds: float
    maps: np.ndarray
    learned: bool = False
    place: str = ""
    times: np.ndarray | None = None
    coverage: np.ndarray | None = None
    shares: np.ndarray | None = None
    success_coverage: float = 0.95
    trainings: np.ndarray | None = None
    run: dict = field(default_factory=dict)

    def copies(self, *others: "EvaluationResult") -> np.ndarray:
        """A number for each episode, the same for copies (`label_copies`); `others` played the same episodes."""
        return label_copies(self.maps, *(result.episodes for result in (self, *others)))

    @property
    def evidence(self) -> Evidence:
        """What its figures rest on."""
        return Evidence(self.policy, len(self.maps), len(np.unique(self.copies())), len(np.unique(self.maps)))

    def summary(self) -> dict[str, dict]:
        """{metric: {mean, std, ci95: [lo, hi], n}}."""
        return self._summary

    @cached_property
    def _summary(self) -> dict[str, dict]:
        return self._summarise(self.episodes, self.copies())

    def minus(self, other: "EvaluationResult") -> dict[str, dict]:
        """The same of the paired differences to another result on the same episodes, of the metrics that both have."""
        both = [name for name in self.episodes if name in other.episodes]
        apart = {name: self.episodes[name] - other.episodes[name] for name in both}
        return self._summarise(apart, self.copies(other))

    def _summarise(self, values: dict[str, np.ndarray], copies: np.ndarray) -> dict[str, dict]:
        trainings = [] if self.trainings is None else [self.trainings]
        weights = resample_weights(self.maps, *trainings, copies=copies)
        return {name: summarise(value, weights, copies) for name, value in values.items()}


def join(parts: list[EvaluationResult]) -> EvaluationResult:
    """The episodes of several results as those of one, without what was recorded."""
    return replace(
        parts[0],
        episodes={metric: np.concatenate([part.episodes[metric] for part in parts]) for metric in parts[0].episodes},
        seconds=sum(part.seconds for part in parts),
        maps=np.concatenate([part.maps for part in parts]),
        place="",
        times=None,
        coverage=None,
        shares=None,
        trainings=None if parts[0].trainings is None else np.concatenate([part.trainings for part in parts]),
        run={},
    )


def pool(parts: list[EvaluationResult]) -> EvaluationResult:
    """The episodes of several recorded results of one policy as one result."""
    recorded = [(part.times, part.coverage) for part in parts if part.times is not None and part.coverage is not None]
    times = np.unique(np.concatenate([its for its, _ in recorded]))
    lines = [np.interp(times, its, line) for its, coverage in recorded for line in coverage]
    shares = None if parts[0].shares is None else np.concatenate([part.shares for part in parts])
    return replace(join(parts), times=times, coverage=np.stack(lines), shares=shares)


def evaluate_recorded(policy: Callable, env, episodes: int, **settings) -> EvaluationResult:
    """`evaluate`, with the coverage over time and the share of each robot."""
    with CoverageRecorder(env, every=min(RECORD_EVERY, env.local_steps)) as recorder:
        result = evaluate(policy, env, episodes, recorder=recorder, **settings)
    times, coverage = recorder.curves(episodes)
    return replace(result, times=times, coverage=coverage, shares=recorder.contributions(episodes))


@torch.no_grad()
def evaluate(
    policy: Callable,
    env,
    episodes: int,
    *,
    name: str = "trained",
    seed: int = 0,
    advance: Callable[[int], None] = lambda count: None,
    recorder: CoverageRecorder | None = None,
    kept: EpisodeCache | None = None,
) -> EvaluationResult:
    """Play episodes 0 .. `episodes` - 1, each to its end, `env.num_envs` at once.

    Torch's random numbers are the same in every call with the same seed, and go on afterwards as if nothing
    had happened.

    Args:
        advance: called with a count as episodes end
        recorder: of the env, if there is one
        kept: batches that were played before are taken from there, and the others left there; the result has the same
            bits, unless the policy draws from other random numbers than torch's or remembers earlier episodes
    """
    begin = time.perf_counter()
    finals, maps = [], []
    devices = [env.device] if env.device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        for first in range(0, episodes, env.num_envs):
            numbers = torch.arange(first, first + env.num_envs, device=env.device).clamp(max=episodes - 1)
            count = min(env.num_envs, episodes - first)
            final, map_id = _play_or_read(policy, env, numbers, recorder, kept)
            finals.append(final[:count])
            maps += [env.maps[index].name for index in map_id[:count]]
            advance(count)
    metrics = episode_metrics(torch.cat(finals), env.local_steps * env.macro_steps, env.success_coverage)
    seconds, goal = time.perf_counter() - begin, env.success_coverage
    return EvaluationResult(name, env.num_robots, metrics, seconds, np.array(maps), success_coverage=goal)


def _play_or_read(
    policy: Callable, env, numbers: torch.Tensor, recorder: CoverageRecorder | None, kept: EpisodeCache | None
) -> tuple[TensorDict, list[int]]:
    """The last step's info of a batch of episodes and the numbers of their maps, from `kept` where it is there."""
    first = int(numbers[0])
    arrays = None if kept is None else kept.read(first)
    if arrays is None:
        final = play(policy, env, numbers)
        map_id = env.simulation.tensors["map_id"].cpu().numpy()
        if kept is not None:
            arrays = {f"info_{name}": value.cpu().numpy() for name, value in final.items()} | {"map_id": map_id}
            arrays |= {f"recorded_{name}": array for name, array in (recorder.batch() if recorder else {}).items()}
            kept.write(first, arrays | random_numbers(env.device))
        return final, map_id.tolist()
    go_on_with_random_numbers(arrays, env.device)
    if recorder is not None:
        recorder.add(_part(arrays, "recorded_"))
    info = {name: torch.from_numpy(array).to(env.device) for name, array in _part(arrays, "info_").items()}
    return TensorDict(info, batch_size=numbers.shape), arrays["map_id"].tolist()


def _part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


@torch.no_grad()
def play(policy: Callable, env, numbers: torch.Tensor) -> TensorDict:
    """One episode in each env, to the end: env i plays number `numbers[i]`. Returns the last step's info [envs].

    A policy that cannot go on with a team says so under ``lost``, bool [E, 1]: the episode ends there, as it was
    before that decision.
    """
    env.set_episodes(numbers)
    state = env.reset()
    final = state["info"].clone()
    running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    while bool(running.any()):
        state = policy(state)
        if "lost" in state.keys():
            running = running & ~state["lost"].squeeze(-1)
        state = env.step(state)
        after = state["next"]
        final = torch.where(running, after["info"], final)
        running = running & ~after["done"].squeeze(-1)
        state = step_mdp(state)
    return final
