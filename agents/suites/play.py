"""The episodes of a part: built, played with every action noted, and played again from those."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from tensordict import TensorDictBase

from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import play
from maexp.agents.suites.suite import Part, Suite
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    ObservationConfig,
    PlannerConfig,
    PointCloudMap,
    RadarConfig,
    RobotConfig,
    make_map,
)
from maexp.envs.metrics import RADIO, episode_metrics


@dataclass
class Batch:
    """Episodes of a part that were played at once, K of them, at most T decisions each.

    Attributes:
        first: number of the first
        decisions: int32 [K], made in each
        sent: where the robots were sent, 0 after the last decision: "goal" float32 [K, T, N, 2] [m]; or, of a run from
            before that was noted, "region" uint8 [K, T, N] and "offset" float32 [K, T, N, 2]
        seconds: float32 [K, T], processor time of the policy [s]
        maps: of each episode, names [K]
        metrics: each metric's value in each episode, float64 [K]
        reasons: why the policy's episode ended early, "" where it did not, [K]
    """

    first: int
    decisions: np.ndarray
    sent: dict[str, np.ndarray]
    seconds: np.ndarray
    maps: np.ndarray
    metrics: dict[str, np.ndarray]
    reasons: np.ndarray


def build_maps(part: Part, seed: int | None = None) -> list[PointCloudMap]:
    """The maps of a part; of another seed: others, unless they are of a published set.

    Raises:
        MapsError: the set has not been fetched.
    """
    if part.fetched:
        return _load_maps(part)
    return list(_make_maps(part.scenario, tuple(part.indices(seed))))


def _load_maps(part: Part) -> list[PointCloudMap]:
    part.check_fetched()
    return [PointCloudMap.load(part.map_set.kept / floor.map_place) for floor in part.floors]


@lru_cache(maxsize=16)
def _make_maps(scenario: str, indices: tuple[int, ...]) -> tuple[PointCloudMap, ...]:
    """Kept: a leaderboard plays many runs of the same suites."""
    return tuple(make_map(scenario, index) for index in indices)


def build_env(
    part: Part, maps: list[PointCloudMap], num_envs: int, seed: int, observation: ObservationConfig, **others
) -> ExplorationEnv:
    """The env of a part; `others` are further arguments of `ExplorationEnv`, such as `device`.

    Raises:
        ValueError: the file of the suite has a value out of range; MapError: no room for the team.
    """
    return ExplorationEnv(
        maps,
        num_envs,
        part.num_robots,
        seed=seed,
        robot=RobotConfig(**part.robot),
        radar=RadarConfig(**part.radar),
        planner=PlannerConfig(**part.planner),
        comm=CommConfig(**part.comm),
        observation=observation,
        local_steps=part.local_steps,
        macro_steps=part.macro_steps,
        collision=part.collision,
        success_coverage=part.success_coverage,
        done=part.done,
        starts=part.starts,
        **others,
    )


def build_replay(part: Part, maps: list[PointCloudMap], num_envs: int, seed: int) -> ExplorationEnv:
    """The env of a part for actions that were noted: the strategy of its radios has had its say in them."""
    undirected = replace(part, comm=part.comm | {"strategy": "opportunistic"})
    return build_env(undirected, maps, num_envs, seed, ObservationConfig(pictures=False), device="cpu")


class Recorder:
    """A policy that notes where the robots were sent and what each decision took."""

    def __init__(self, policy: Callable, env: ExplorationEnv):
        self.policy, self.env = policy, env
        self.goals: list[np.ndarray] = []
        self.seconds: list[np.ndarray] = []
        self.reasons = np.full(env.num_envs, "", dtype=object)

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        self._note()
        playing = max(int((self.env.simulation.tensors["active"] != 0).sum()), 1)
        begin = time.process_time()
        acted = self.policy(state)
        share = (time.process_time() - begin) / playing
        own = acted.get("decision_seconds", None)
        self.seconds.append(np.full(self.env.num_envs, share) if own is None else own.reshape(-1).cpu().numpy().copy())
        return acted

    def _note(self) -> None:
        """What the env made of the last decision: all that policies may name has become goals there."""
        if len(self.goals) < len(self.seconds):
            self.goals.append(self.env.simulation.tensors["wanted"].cpu().numpy().copy())

    def batch(self, first: int, count: int, decisions: np.ndarray, metrics: dict, maps: np.ndarray) -> Batch:
        """What was noted of the first `count` envs."""
        self._note()
        decisions, most = decisions[:count].astype(np.int32), max(int(decisions[:count].max()), 1)
        goal = np.stack(self.goals[:most], 1)[:count]
        seconds = np.stack(self.seconds[:most], 1)[:count]
        made = np.arange(most) < decisions[:, None]
        reasons = getattr(self.policy, "reasons", [""] * self.env.num_envs)
        return Batch(
            first,
            decisions,
            {"goal": np.where(made[..., None, None], goal, 0.0).astype(np.float32)},
            np.where(made, seconds, 0.0).astype(np.float32),
            maps,
            metrics,
            np.array(list(reasons)[:count], dtype=str),
        )


class Replay:
    """A policy that does what was noted; a team whose notes end before its episode is lost there."""

    def __init__(self, batch: Batch, num_envs: int, device: torch.device):
        rows = np.minimum(np.arange(num_envs), len(batch.decisions) - 1)
        self.sent = {name: torch.from_numpy(array[rows]).to(device) for name, array in batch.sent.items()}
        self.decisions = torch.from_numpy(batch.decisions[rows].astype(np.int64)).to(device)
        self.step = 0

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        for name, array in self.sent.items():
            state["agents", "action", name] = array[:, min(self.step, array.shape[1] - 1)]
        state["lost"] = (self.step >= self.decisions).unsqueeze(-1)
        self.step += 1
        return state


def play_batch(suite: Suite, env: ExplorationEnv, policy: Callable, first: int) -> Batch:
    """Episodes `first` and following, as many as the env has teams or the suite has left."""
    count = min(env.num_envs, suite.episodes - first)
    numbers = torch.arange(first, first + env.num_envs, device=env.device).clamp(max=suite.episodes - 1)
    recorder = Recorder(policy, env)
    with torch.random.fork_rng([env.device] if env.device.type == "cuda" else []):
        torch.manual_seed(int(env.simulation.tensors["seed"]) + first)
        final = play(recorder, env, numbers)[:count]
    decisions = -(-final["local_steps"][:, 0].cpu().numpy() // env.local_steps)
    metrics = episode_metrics(final, env.local_steps * env.macro_steps, env.success_coverage)
    maps = np.array([env.maps[index].name for index in env.simulation.tensors["map_id"][:count].tolist()])
    metrics |= {name: np.full(count, np.nan) for name in RADIO if name not in metrics}  # radios without limits
    if unknown := [name for name in suite.metrics if name not in metrics]:
        raise UserError(f"{suite.path}: metrics has {unknown[0]}, which is none: choose among {', '.join(metrics)}.")
    return recorder.batch(first, count, decisions, {name: metrics[name] for name in suite.metrics}, maps)


def replay_batch(suite: Suite, env: ExplorationEnv, noted: Batch) -> Batch:
    """The same episodes from their actions, in the env of `build_replay`."""
    return play_batch(suite, env, Replay(noted, env.num_envs, env.device), noted.first)
