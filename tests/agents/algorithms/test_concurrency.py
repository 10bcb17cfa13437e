"""Threads: what one env does is not split, and policy and critic learn at once."""

import threading

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from maexp.agents import make_policy
from maexp.agents.algorithms.losses import NonFiniteLoss
from maexp.agents.algorithms.registry import find_algorithm
from maexp.agents.algorithms.updaters import Meter, at_once
from maexp.agents.config.model import ModelConfig
from maexp.agents.training.collectors import make_collector
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, make_map


class LargeOperations(TorchDispatchMode):
    """Names of the torch operations that work on so many numbers that torch splits them over its threads."""

    GRAIN = 32768  # numbers that a thread gets at least (at::internal::GRAIN_SIZE)

    def __init__(self):
        super().__init__()
        self.met = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        views = any(output.alias_info and not output.alias_info.is_write for output in func._schema.returns)
        tensors = [leaf for leaf in tree_flatten((args, kwargs, out))[0] if isinstance(leaf, torch.Tensor)]
        if not views and any(tensor.numel() > self.GRAIN for tensor in tensors):
            self.met.append(func.name())
        return out


@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_one_env_does_not_wait_for_threads_of_torch(planner):
    """Where another process has the other core, an operation split over both waits for a thread that is not running."""
    env = ExplorationEnv(make_map("maze_small", 0), 1, 3, planner=PlannerConfig(name=planner))
    assert env.simulation.threads.pool is None
    td = env.reset()
    with LargeOperations() as operations:
        for _ in range(3):
            _, td = env.step_and_maybe_reset(env.rand_action(td))
        env.reset()
        assert not operations.met
        torch.zeros(200, 200)  # and it would be noticed
    assert operations.met == ["aten::zeros"]


@pytest.fixture
def two_threads():
    """Torch with two threads, as in a training on two cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def learner(name: str):
    """An updater of targets and a batch."""
    torch.manual_seed(3)
    env = ExplorationEnv(
        make_map("maze_small", 0),
        num_envs=4,
        num_threads=1,
        macro_steps=3,
        seed=5,
        observation=ObservationConfig(targets=24),
        planner=PlannerConfig(name="wavefront"),
    )
    model, row = ModelConfig(action="targets", target_width=8), find_algorithm(name)
    policy = make_policy(env, model)
    settings = row.configure(minibatch_size=3)
    updater = row.make_updater(row.make_loss(policy, row.make_critic(env, model, settings), settings), settings)
    return updater, make_collector(env, policy, 3).next()


@pytest.mark.parametrize("name", ["ippo", "mappo", "vdppo", "vda2c"])
def test_policy_and_critic_learn_at_once_what_they_learn_in_turn(name, two_threads, monkeypatch):
    ran, learned = {}, []
    for threads in (2, 1):
        torch.set_num_threads(threads)
        updater, batch = learner(name)
        descend = type(updater).descend

        def noted(self, terms, parts, side, before=descend, threads=threads):
            ran.setdefault((threads, side), set()).add(threading.get_ident())
            return before(self, terms, parts, side)

        monkeypatch.setattr(type(updater), "descend", noted)
        logged = updater.update(batch)
        monkeypatch.setattr(type(updater), "descend", descend)
        learned.append((updater.state_dict()["loss"], {k: v for k, v in logged.items() if k not in TIMES}))
    torch.set_num_threads(2)
    here = {threading.get_ident()}
    assert ran[1, "policy"] == ran[1, "critic"] == ran[2, "policy"] == here and not ran[2, "critic"] & here
    (double, logs), (single, others) = learned
    assert logs == others and all(torch.equal(value, double[key]) for key, value in single.items())


TIMES = ("advantage", "update")


@pytest.mark.parametrize("side", ["actor", "critic"])
def test_what_goes_wrong_in_either_thread_is_told(side, two_threads):
    updater, batch = learner("mappo")
    steps = updater.prepare(batch)
    with torch.no_grad():
        next(iter(getattr(updater.loss, f"{side}_network_params").parameters())).fill_(torch.nan)
    with pytest.raises(NonFiniteLoss, match={"actor": "loss_objective", "critic": "loss_critic"}[side]):
        updater.learn([steps], Meter())
    assert torch.get_num_threads() == 2


def test_at_once_waits_for_both(two_threads):
    done = []

    def fail():
        raise ArithmeticError("first")

    with pytest.raises(ArithmeticError, match="first"), at_once(True) as both:
        both(fail, lambda: done.append(threading.get_ident()))
    assert done and done[0] != threading.get_ident()
    with at_once(False) as both:
        assert both(threading.get_ident, threading.get_ident) == (threading.get_ident(),) * 2
