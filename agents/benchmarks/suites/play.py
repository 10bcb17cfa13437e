"""The episodes of a part of a suite: its policies and envs, played with every action recorded, and replayed."""

import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from tensordict import TensorDictBase

from maexp.agents.benchmarks.suites.suite import Part, Suite
from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import play
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.names import policy_plugins
from maexp.agents.policies.pretrained import is_exported
from maexp.agents.policies.registry import NamedPolicy, find_named_policy
from maexp.agents.policies.registry import policy_label as name_of
from maexp.agents.policies.remote.process import APART, EXEC, PolicyProcess, command_of
from maexp.agents.policies.remote.server import SOCKET
from maexp.agents.policies.remote.subprocess_policy import HostedPolicy, greet, guest_of
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


class SuitePolicy:
    """A policy by its spec.

    Args:
        spec: what `policy=` takes everywhere; `exec:COMMAND`, a program that speaks
            `maexp.agents.policies.remote.protocol`; `socket:HOST:PORT`, where one listens; or `process:NAME`, one of
            ours as if it were a stranger's. A class with `act` always plays in processes.
        limit: processor time that a decision may take a policy in processes of its own, or time elsewhere [s].
        patience: how long an answer of such a one may take otherwise [s].
        name: what tables call it; None: by its word.

    Raises:
        UserError: there is none of that name, it is damaged, does not start, or gives controls.
    """

    def __init__(self, spec: str, limit: float = 60.0, patience: float = 120.0, name: str | None = None):
        self.spec, self.limit, self.patience = spec, limit, patience
        self.start_process = self._find_guest()
        self.name = name or policy_label(spec)
        self.found: NamedPolicy | None = None if self.hosted else find_named_policy(spec, name=self.name)
        if self.found is not None and self.found.direct:
            raise UserError(f"policy={spec} gives controls (planner=direct), and the robots of a suite drive to goals.")

    def _find_guest(self) -> Callable[[], PolicyProcess] | None:
        """What plays a team in a process of its own or elsewhere; None: it plays in this one."""
        if not self.spec.startswith((EXEC, APART, SOCKET)) and not is_own(self.spec):
            return None
        try:
            start_process = guest_of(self.spec)
        except ValueError as error:
            raise UserError(f"policy={self.spec} cannot be played: {error}.") from error
        if greet(start_process, self.spec):
            return start_process
        if self.spec.startswith(APART):
            raise UserError(f"policy={self.spec} is no class with act(observation): see docs/arena.md.")
        return None

    @property
    def hosted(self) -> bool:
        """Whether each team has a process or connection of its own."""
        return self.start_process is not None

    @property
    def most_teams(self) -> int:
        """How many a hosted one plays at once unless told: who listens at a socket may serve one after another."""
        return 1 if self.spec.startswith(SOCKET) else os.cpu_count() or 1

    def observation(self) -> ObservationConfig:
        """What its env shows."""
        found = self.found
        if found is None:
            return ObservationConfig(pictures=False)
        shown = {"map": found.map or "seen", "pictures": found.pictures, "targets": found.targets or 0}
        return ObservationConfig(**shown, radio=found.radio)

    def open(self, env: ExplorationEnv) -> AbstractContextManager[Callable]:
        """The policy for an env; at the end of the context it has done with its guests."""
        if self.found is None:
            return HostedPolicy(env, self.start_process, self.name, self.limit, self.patience)
        return nullcontext(self.found.make(env))


def is_own(spec: str) -> bool:
    """Whether this is module:Class or the name of a plug-in: told without running anything of it."""
    if spec in POLICIES or is_exported(spec):
        return False
    return spec in policy_plugins() or (":" in spec and not os.path.exists(spec))


def policy_label(spec: str) -> str:
    """What tables call a policy: its name, that of its folder, or that of its program."""
    if spec.startswith(EXEC):
        return os.path.basename(command_of(spec)[0])
    return spec if ":" in spec else name_of(spec)


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
