"""Trained policies out of torch: the same logits on recorded observations, and the same team in closed loop.

The observations are those of whole episodes that the trained team plays: untrained weights and zeros hide errors.
"""

import contextlib
import copy

import numpy as np
import pytest
import torch
from runtime_cases import inputs

from maexp.agents.deploy.planner.bundle import SHIPPED
from maexp.agents.policies.export import find_chooser
from maexp.agents.policies.pretrained import load_policy_folder
from maexp.agents.runtime import TeamPlanner, shipped_names
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, TargetsConfig, make_map
from maexp.envs.targets.navigation import Navigation

INPUTS = ("features", "mask", "comm")
SHOWN = [("agents", "observation", name) for name in ("targets", "targets_mask", "comm")]


def make_env(scenario: str, num_robots: int, num_envs: int = 1, index: int = 70, **others) -> ExplorationEnv:
    return ExplorationEnv(
        [make_map(scenario, index)],
        num_envs,
        num_robots,
        seed=5,
        num_threads=1,
        planner=PlannerConfig(name="wavefront"),
        observation=ObservationConfig(pictures=False, targets=24),
        **others,
    )


def record(policy, env: ExplorationEnv) -> list[torch.Tensor]:
    """Features, mask and comm of the moments of an episode of all teams, until they are done: [T, ...] each."""
    seen, now = [], env.reset()
    running = torch.ones(env.num_envs, dtype=torch.bool)
    while running.any():
        seen.append([now[name][running] for name in SHOWN])
        with torch.no_grad():
            now = env.step(policy(now))["next"]
        running = running & ~now["done"].squeeze(-1)
    return [torch.cat(parts) for parts in zip(*seen, strict=True)]


@contextlib.contextmanager
def doubles():
    """New tensors are float64."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("name", shipped_names())
def test_logits_on_recorded_observations(name):
    """As near to float64 as torch in float32, twice its error on the whole episode at most or 1e-5; the same choice."""
    onnxruntime = pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    session = onnxruntime.InferenceSession(SHIPPED / name / "policy.onnx", providers=["CPUExecutionProvider"])
    for num_robots in (1, 2, 3, 6, 8):
        env = make_env("maze_small", num_robots, num_envs=3, macro_steps=8)
        policy = load_policy_folder(name, env)
        chooser, seen = find_chooser(policy), record(policy, env)
        exact = copy.deepcopy(chooser).double()
        assert (seen[1].sum(-1) > 1).float().mean() > 0.5, "hardly anything to choose from"
        with torch.no_grad(), doubles():
            true = exact(seen[0].double(), *seen[1:])[0].numpy()
        with torch.no_grad():
            torchs = np.abs(chooser(*seen)[0].numpy() - true)[seen[1].numpy()].max()
        for size in (1, 5, len(seen[0])):
            inputs = [part[:size] for part in seen]
            with torch.no_grad():
                wanted = chooser(*inputs)[0].numpy()
            fed = dict(zip(INPUTS, (tensor.numpy() for tensor in inputs), strict=True))
            given, there = session.run(["logits"], fed)[0], inputs[1].numpy()
            error = np.abs(given - true[:size])[there].max()
            print(f"{name}, {num_robots} robots, batch of {size}: {error:.1e}, torch's {torchs:.1e}")
            assert error < max(1e-5, 2 * torchs) and np.abs(wanted[there]).max() > 1
            assert np.array_equal(given.argmax(-1), wanted.argmax(-1))


def play_torch(policy, env: ExplorationEnv) -> tuple[float, np.ndarray]:
    """Coverage after an episode, and where the robots were sent at every moment [T, N, 2]."""
    now, goals, done = env.reset(), [], False
    while not done:
        with torch.no_grad():
            now = policy(now)
        index = now["agents", "action", "target"][0]
        goals.append(env.target_view.state["point"][0, torch.arange(env.num_robots), index].numpy().copy())
        now = env.step(now)["next"]
        done = bool(now["done"])
    return float(now["info", "coverage"]), np.stack(goals)


def play_runtime(planner: TeamPlanner, env: ExplorationEnv) -> tuple[float, np.ndarray]:
    """The same where the runtime chooses, from the grid and the poses alone; the env drives to the candidate that
    lies where the runtime's goal does.
    """
    nav, now, goals, done = Navigation(env), env.reset(), [], False
    view = env.target_view
    while not done:
        nav.update()
        left = 1 - len(goals) / env.macro_steps
        speeds = view.tracker.speed(view.tracker.nav)[0].numpy()
        seconds = 0.1 * env.local_steps * len(goals)
        plan = planner.plan(**inputs(env, nav).call, velocities=speeds, time_left=left, now=seconds)
        goals.append(plan.goals.copy())
        gap = np.linalg.norm(view.state["point"][0].numpy() - plan.goals[:, None], axis=-1)
        index = np.where(view.state["mask"][0].numpy(), gap, np.inf).argmin(-1)
        now["agents", "action", "target"] = torch.as_tensor(index)[None]
        now = env.step(now)["next"]
        done = bool(now["done"])
    return float(now["info", "coverage"]), np.stack(goals)


@pytest.mark.parametrize(
    ("scenario", "num_robots", "index"),
    [
        ("maze_small", 1, 70),
        ("maze_small", 6, 72),
        ("indoor_small", 3, 70),
    ],
)
def test_the_runtime_plays_the_episode_that_torch_plays(scenario, num_robots, index):
    """Whole episodes: the same goals at every moment, so the same coverage.

    Without sharing targets out, for `play_torch` tells what robots wish; that is compared in test_runtime_sharing.py.
    """
    pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    alone = TargetsConfig(distinct=False)
    envs = [make_env(scenario, num_robots, index=index, targets=alone) for _ in range(2)]
    robots = envs[0].simulation.robot_tensors
    limits = {name: float(robots[name].max()) for name in ("max_speed", "max_accel")}
    settings = inputs(envs[0], Navigation(envs[0])).settings | limits | {"seconds": 0.1 * envs[0].local_steps}
    coverage, goals = play_runtime(TeamPlanner("universal", distinct=False, **settings), envs[0])
    wanted, there = play_torch(load_policy_folder("universal", envs[1]), envs[1])
    assert len(there) >= 4 and wanted > 0.5
    np.testing.assert_allclose(goals, there, atol=1e-4)
    assert coverage == pytest.approx(wanted, abs=1e-6)
