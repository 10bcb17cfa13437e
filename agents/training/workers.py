"""Experience from worker processes: on this machine, or on several through Ray, by TorchRL's own collectors."""

import copy
import os
import pickle
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch.utils._pytree import tree_map_only
from torchrl.collectors import BaseCollector, MultiSyncCollector

from maexp.agents.build import choose_device, choose_starts, make_env
from maexp.agents.config.groups import CollectorSettings
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import UserError
from maexp.agents.memory import keep_freed_memory
from maexp.agents.training.collectors import Experience, TeamCollector, Teams, WorkerLost
from maexp.envs import PointCloudMap

if TYPE_CHECKING:  # needs Ray
    from torchrl.collectors.distributed import RayCollector

LOOK_EVERY = 0.2  # seconds between two looks whether the workers are alive
SHOWS_WITHIN = 5.0  # seconds from a broken connection to the end of the process behind it
ENDLESS = 2**62
GRACE = 1.0  # seconds for the workers to end by themselves; they have nothing to save


@dataclass(frozen=True)
class WorkerEnv:
    """Makes the env of one worker, in its process.

    Attributes:
        settings: those of the run
        maps: trained on, or the file that holds them
        teams: of this worker; the number of the first keys its random numbers
        device: of the simulation and the policy
        num_threads: CPU threads of its simulation
        starts: drawn, fixed or poses (their file may be on another machine)
    """

    settings: TrainSettings
    maps: list[PointCloudMap] | Path
    teams: Teams
    device: torch.device
    num_threads: int
    starts: str | np.ndarray

    def __call__(self):
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that trains; it ends the workers
        keep_freed_memory()
        cfg = self.settings
        maps = pickle.loads(self.maps.read_bytes()) if isinstance(self.maps, Path) else self.maps
        key = np.random.SeedSequence([cfg.seed % 2**32, self.teams.first_env]).generate_state(1)
        torch.manual_seed(int(key[0]))
        return make_env(
            cfg,
            maps,
            self.teams.num_robots,
            self.teams.num_envs,
            device=self.device,
            first_env=self.teams.first_env,
            num_threads=self.num_threads,
            starts=self.starts,
        )


class WorkerCollector(TeamCollector):
    """A TeamCollector in a process of its own: the random numbers of its policy are part of its state."""

    @property
    def place(self) -> str:
        """The process, for messages."""
        return f"process {os.getpid()} on {socket.gethostname()}"

    def state_dict(self) -> dict[str, Any]:
        """Everything the next batch depends on but the policy, on the CPU."""
        state = tree_map_only(torch.Tensor, lambda value: value.cpu(), super().state_dict())
        cuda = torch.cuda.get_rng_state(self.env.device) if self.env.device.type == "cuda" else torch.empty(0)
        return state | {"random": torch.get_rng_state(), "random_cuda": cuda}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs) -> None:
        """Go on where `state_dict` was called."""
        super().load_state_dict(state_dict)
        torch.set_rng_state(state_dict["random"])
        if self.env.device.type == "cuda" and len(state_dict["random_cuda"]):
            torch.cuda.set_rng_state(state_dict["random_cuda"], self.env.device)


class Call(threading.Thread):
    """A function at work in a thread of its own, which does not keep the program from ending."""

    def __init__(self, function: Callable, *arguments):
        super().__init__(daemon=True)
        self.function, self.arguments = function, arguments
        self.result, self.error, self.over = None, None, threading.Event()
        self.start()

    def run(self) -> None:
        try:
            self.result = self.function(*self.arguments)
        except BaseException as error:  # raised again where the result is asked for
            self.error = error
        finally:
            self.over.set()


class WorkerExperience(Experience):
    """The batches of each iteration, from worker processes.

    Args:
        groups: the workers of each team size
        policy: the one that learns
        overlap: collect the next batches while these are learned from; the policy that acts is then one batch old
    """

    def __init__(self, groups: Sequence["WorkerGroup"], policy: torch.nn.Module, overlap: bool):
        super().__init__([group.collector for group in groups])
        self.groups, self.policy, self.lag = list(groups), policy, int(overlap)
        self.device = next(policy.parameters()).device
        self.pending: list[Call] = []
        self.before: dict[str, Any] = {}  # the state that the pending batches began in

    def next(self) -> list[TensorDictBase]:
        begin = time.perf_counter()
        if not self.pending:
            self._begin()
        done, self.pending = self.pending, []
        results = self._wait(done)
        if self.lag:
            self._push(self.policy)
            self.before = self.state_dict()
            self._begin()
        slowest = [max(seconds) for _, seconds in results]
        self.time(begin, slowest)
        return [batch.to(self.device) for batch, _ in results]

    def _begin(self) -> None:
        self.pending = [Call(group.collect) for group in self.groups]

    def _push(self, policy: torch.nn.Module | TensorDictBase) -> None:
        self._wait([Call(collector.update_policy_weights_, policy) for collector in self.collectors])

    def _wait(self, calls: list[Call]) -> list[Any]:
        """The results, in the end; WorkerLost as soon as a worker is gone."""
        for call in calls:
            while not call.over.wait(LOOK_EVERY):
                self._check_alive()
            if call.error is not None:
                self._blame_lost(call.error)
                raise call.error
        return [call.result for call in calls]

    def _blame_lost(self, error: BaseException) -> None:
        """WorkerLost if the error came of a worker's end, which shows a moment after its connection broke."""
        limit = time.monotonic() + (SHOWS_WITHIN if isinstance(error, OSError | EOFError) else 0.0)
        while True:
            self._check_alive(error)
            if time.monotonic() > limit:
                return
            time.sleep(0.05)

    def _check_alive(self, error: BaseException | None = None) -> None:
        for group in self.groups:
            if lost := group.find_lost(error):
                raise WorkerLost(f"{lost}.") from error

    def update_policy_weights_(self) -> None:
        """Act with the new weights: now, or, where workers are busy, from their next batch on."""
        if not self.pending:
            self._push(self.policy)

    def state_dict(self) -> dict[str, Any]:
        """As for one process; while workers gather a batch, also the weights that they act with."""
        if self.pending:
            return self.before
        states = self._wait([Call(group.state_dict) for group in self.groups])
        acting = tree_map_only(torch.Tensor, lambda value: value.detach().cpu().clone(), self.policy.state_dict())
        return {str(k): state for k, state in enumerate(states)} | ({"acting": dict(acting)} if self.lag else {})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        done, self.pending = self.pending, []
        self._wait(done)  # nobody needs these batches, but a worker must not be asked while it answers
        self._wait([Call(group.load_state_dict, state[str(k)]) for k, group in enumerate(self.groups)])
        self._push(self.policy)
        if self.lag:
            acting = copy.deepcopy(self.policy)
            acting.load_state_dict(state["acting"])
            self._push(acting)
            self.before = state
            self._begin()

    def shutdown(self) -> None:
        """End the workers."""
        with suppress(Exception):  # a worker was lost: the others have nobody to work for
            self._wait(self.pending)
        for group in self.groups:
            with suppress(Exception):  # what cannot be ended any more must not hide why the run ended
                group.collector.shutdown(timeout=GRACE)
        self.groups[0].leave()


class WorkerGroup:
    """The workers of one team size, behind one collector of TorchRL.

    Args:
        collector: of TorchRL, with several workers
        name: of the group, for messages: "collector worker", or with the team size where there are several
    """

    def __init__(self, collector: BaseCollector, name: str):
        self.collector, self.name = collector, name

    def collect(self) -> tuple[TensorDictBase, list[tuple[float, float]]]:
        """A batch [envs, steps], and what it took each worker."""
        batch = self.collector.next()
        if batch.ndim > 2:  # Ray stacks its workers' batches
            batch = batch.flatten(0, 1)
        return batch, self.collector.get_distant_attr("seconds")

    def state_dict(self) -> dict[str, Any]:
        """The state of every worker, in memory of this process."""
        states = tree_map_only(torch.Tensor, torch.clone, self.collector.map_fn("state_dict"))
        return {str(k): state for k, state in enumerate(states)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Every worker goes on where `state_dict` was called."""
        self.collector.map_fn("load_state_dict", [(state[str(k)],) for k in range(len(state))])

    def find_lost(self, error: BaseException | None = None) -> str | None:
        """Which worker has ended, and how; None if all are at work. `error` is what the collector raised, if it did."""
        raise NotImplementedError

    def leave(self) -> None:
        """Free what all groups shared."""


class ProcessGroup(WorkerGroup):
    """Workers in processes of this machine."""

    def __init__(self, collector: MultiSyncCollector, name: str):
        super().__init__(collector, name)
        self.pids = [process.pid for process in collector.procs]

    def find_lost(self, error: BaseException | None = None) -> str | None:
        for k, process in enumerate(self.collector.procs):
            code = None if process._closed else process.exitcode
            if code is not None:
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
                return f"{self.name} {k + 1} of {len(self.pids)} (process {self.pids[k]}) {how}"
        return None


class RayGroup(WorkerGroup):
    """Workers in actors of a Ray cluster."""

    def __init__(self, collector: "RayCollector", name: str):
        super().__init__(collector, name)
        self.places = collector.get_distant_attr("place")
        self.actors = [remote_collector._actor_id.hex() for remote_collector in collector.remote_collectors]

    def find_lost(self, error: BaseException | None = None) -> str | None:
        from ray.exceptions import RayActorError

        if not isinstance(error, RayActorError):
            return None
        if error.actor_id not in self.actors:
            return f"a {self.name} was lost to Ray"
        k = self.actors.index(error.actor_id)
        return f"{self.name} {k + 1} of {len(self.actors)} ({self.places[k]}) was lost to Ray"

    def leave(self) -> None:
        import ray

        ray.shutdown()


def make_workers(
    cfg: TrainSettings, maps: list[PointCloudMap], teams: list[Teams], policy: torch.nn.Module
) -> WorkerExperience:
    """The workers that the settings ask for, `collector.workers` for each of `teams`."""
    settings = cfg.collector
    device = choose_device(cfg, "sample_device")
    policy_there = copy.deepcopy(policy).to(device)  # never the learner's own memory: workers must not see it change
    share = len(os.sched_getaffinity(0)) // (settings.workers * len(teams))
    threads = cfg.num_threads or (1 if settings.backend == "ray" else max(1, share))
    if settings.backend == "ray":
        connect_ray(settings, threads * settings.workers * len(teams))
    with tempfile.TemporaryDirectory() as folder:
        start, given = start_actors, maps
        if settings.backend == "processes":
            start, given = start_processes, Path(folder, "maps")
            given.write_bytes(pickle.dumps(maps))
        groups = []
        for team in teams:
            shares = team.split(settings.workers)
            rest = device, threads, choose_starts(cfg, team.num_robots)
            factories = [WorkerEnv(cfg, given, part, *rest) for part in shares]
            name = "collector worker" if len(teams) == 1 else f"for teams of {team.num_robots}: collector worker"
            groups.append(start(factories, policy_there, team.num_envs * settings.steps, name))
    return WorkerExperience(groups, policy, settings.overlap)


def start_processes(factories: list[WorkerEnv], policy: torch.nn.Module, frames: int, name: str) -> ProcessGroup:
    """Worker processes on this machine that together gather `frames` macro steps a batch.

    What is handed to a process as it starts must stay below 64 KiB: Python writes it into a pipe and would wait for
    ever on a process that ended before it had read all. Hence the file of maps.

    Raises:
        UserError: a worker ended before it could begin.
    """
    device, threads = factories[0].device, factories[0].num_threads
    try:
        collector = MultiSyncCollector(
            factories,
            policy,
            frames_per_batch=frames,
            total_frames=-1,
            env_device=device,
            policy_device=device,
            storing_device=device,
            collector_class=WorkerCollector,
            cat_results=0,
            use_buffers=True,
            num_threads=torch.get_num_threads(),
            num_sub_threads=threads,
            auto_register_policy_transforms=False,
        )
    except (RuntimeError, EOFError, ConnectionError) as error:
        why = str(error).splitlines()[0]
        raise UserError(f"a {name} ended while it started ({why}): see its own message above.") from error
    return ProcessGroup(collector, name)


def start_actors(factories: list[WorkerEnv], policy: torch.nn.Module, frames: int, name: str) -> RayGroup:
    """Workers in actors of the Ray cluster that together gather `frames` macro steps a batch."""
    from torchrl.collectors.distributed import RayCollector

    device, threads = factories[0].device, factories[0].num_threads
    collector = RayCollector(
        factories,
        policy,
        frames_per_batch=frames,
        total_frames=ENDLESS,
        env_device=device,
        policy_device=device,
        storing_device=torch.device("cpu"),
        collector_class=WorkerCollector,
        collector_kwargs={"auto_register_policy_transforms": False},
        remote_configs={"num_cpus": threads, "num_gpus": int(device.type == "cuda")},
        sync=True,
    )
    return RayGroup(collector, name)


def connect_ray(settings: CollectorSettings, cpus: int) -> None:
    """Join the cluster at `collector.ray_address`, or start one of this machine alone.

    Raises:
        UserError: Ray is not installed, there is no such cluster, or it has too few CPUs for the workers.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError("collector=ray needs Ray: run pip install 'maexp[ray]'.") from error
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    if settings.ray_address is None:
        ray.init(address="local", num_cpus=max(cpus, os.cpu_count()), include_dashboard=False, **quiet)
        return
    try:
        ray.init(address=settings.ray_address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(
            f"collector.ray_address={settings.ray_address} is no Ray cluster that can be reached from here: "
            "start one with ray start --head and give its address, or auto on its machines."
        ) from error
    have = int(ray.cluster_resources().get("CPU", 0))
    if have < cpus:
        raise UserError(
            f"The Ray cluster has {have} CPUs and collector.workers={settings.workers} need {cpus}: "
            "lower collector.workers or num_threads, or add machines with ray start --address=HEAD:6379."
        )
