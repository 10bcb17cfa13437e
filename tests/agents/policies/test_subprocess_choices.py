"""Policies in processes of their own are told, and choose, the same as inside."""

import shutil
import subprocess

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env
from subprocess_episodes import EXAMPLES, TESTS

from maexp.agents.deploy.planner.arena_policy import TeamAgent
from maexp.agents.policies import POLICIES
from maexp.agents.policies.pretrained import load_policy_folder
from maexp.agents.policies.remote import protocol
from maexp.agents.policies.remote.numpy_policy import TeamSight, as_policy
from maexp.agents.policies.remote.process import Process, ask_all, command_of
from maexp.agents.policies.remote.subprocess_policy import HostedPolicy, guest_of
from maexp.envs import ObservationConfig, make_map
from maexp.envs.targets.region_action import from_regions
from maexp.envs.targets.tracker import TargetTracker

pytestmark = pytest.mark.slow  # processes


@pytest.fixture(autouse=True)
def beside_the_hostile_ones(monkeypatch):
    monkeypatch.chdir(TESTS)


def note_goals(monkeypatch) -> list[torch.Tensor]:
    """Where planners inside send robots from now on, float32 [E, N, 2] [m] each time."""
    points, goals = [], TargetTracker.goals

    def note(*arguments):
        points.append(goals(*arguments))
        return points[-1]

    monkeypatch.setattr(TargetTracker, "goals", note)
    return points


def test_a_process_chooses_as_its_class_does_inside(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(EXAMPLES)
    from nearest import Nearest

    envs = [make_env(3, macro_steps=8) for _ in range(2)]
    inside = as_policy(envs[0], Nearest)
    with HostedPolicy(envs[1], guest_of("nearest:Nearest"), "nearest", 20.0, 20.0) as outside:
        states = [env.reset() for env in envs]
        for _ in range(8):
            states = [policy(state) for policy, state in zip((inside, outside), states, strict=True)]
            for name in (REGION, OFFSET):
                assert torch.equal(states[0][name], states[1][name])
            asked = outside.sight.active
            assert not states[1]["lost"].any() and (states[1]["decision_seconds"][:, 0].numpy() > 0)[asked].all()
            states = [env.step(state)["next"] for env, state in zip(envs, states, strict=True)]
    assert float(states[0]["info", "coverage"].mean()) > 0.4


@pytest.mark.parametrize("policy", ["cost_utility", "hungarian", "small_mazes"])
def test_goals_over_the_wire_are_those_of_planners_inside(policy, monkeypatch):
    """As float64 metres: to the bit where a planner names regions and offsets, to their rounding where it names
    targets."""
    points = note_goals(monkeypatch)
    shown = ObservationConfig(pictures=False, targets=24 if policy == "small_mazes" else 0)
    env = make_env(3, observation=shown)
    play_inside = POLICIES[policy](env) if policy in POLICIES else load_policy_folder(policy, env)
    sight, state = TeamSight(env), env.reset()
    for _ in range(6):
        sight.look()
        before = env.simulation.tensors["center"].clone()
        acted = env.step(play_inside(state))
        sent = env.simulation.tensors["wanted"].clone()
        wired = protocol.unpack(protocol.pack({"type": "goals", "goals": points[-1].numpy().astype(np.float64)})[4:])[
            "goals"
        ]
        goals = from_regions(env.simulation, *sight.to_action(wired))
        assert torch.equal(goals, sent) or (policy == "small_mazes" and torch.allclose(goals, sent, rtol=0, atol=1e-5))
        state = acted["next"]
    assert not torch.equal(before, env.simulation.tensors["center"])


@pytest.mark.parametrize("policy", ["nearest_frontier", "cost_utility", "multi_criteria", "voronoi", "potential_field"])
def test_our_planners_through_a_process_take_the_targets_that_they_take_inside(policy, monkeypatch):
    """At every moment of an episode: the runtime's planner, through observation, wire and process, sends each robot
    where the env's planner sends it. (`hungarian`: of assignments alike, any.)"""
    apart, sent = 0.0, note_goals(monkeypatch)
    env = make_env(1, maps=[make_map("maze_small", 1)])
    inside, sight, state = POLICIES[policy](env), TeamSight(env), env.reset()
    worker = Process(command_of(f"process:{policy}"))
    try:
        ask_all([(worker, {"type": "hello", "version": 1})], 60.0, 60.0)
        for _ in range(5):
            sight.look()
            ask_all([(worker, {"type": "reset", "episode": sight.episode(0)})], 60.0, 60.0)
            (answer,) = ask_all([(worker, {"type": "act", "observation": sight.observation(0)})], 60.0, 60.0)
            state = env.step(inside(state))["next"]
            apart = max(apart, np.abs(answer["goals"] - sent[-1][0].numpy()).max())
    finally:
        worker.kill()
    print(f"{policy}: goals differ by at most {apart:.1e} m")
    assert apart < 1e-4


def test_a_trained_policy_through_a_process_takes_the_targets_that_it_takes_inside(monkeypatch):
    """Over an episode, for it looks back at where robots went last."""
    pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    shown, apart, sent = ObservationConfig(pictures=False, targets=24), [], note_goals(monkeypatch)
    env = make_env(1, observation=shown)
    inside, sight, state = load_policy_folder("universal", env), TeamSight(env), env.reset()
    worker = Process(command_of("process:universal"))
    try:
        ask_all([(worker, {"type": "hello", "version": 1})], 60.0, 60.0)
        for step in range(6):
            sight.look()
            if step == 0:
                ask_all([(worker, {"type": "reset", "episode": sight.episode(0)})], 60.0, 60.0)
            (answer,) = ask_all([(worker, {"type": "act", "observation": sight.observation(0)})], 60.0, 60.0)
            with torch.no_grad():
                state = inside(state)
            state = env.step(state)["next"]
            apart.append(np.abs(answer["goals"] - sent[-1][0].numpy()).max())
    finally:
        worker.kill()
    print(f"universal: goals differ by at most {max(apart):.1e} m")
    assert max(apart) < 1e-4


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is absent: the example in C++ is not compiled")
def test_the_example_in_another_language_chooses_as_its_twin_in_python(tmp_path):
    """Both go to the nearest free cell beside unknown ground."""
    done = subprocess.run(
        ["g++", "-O1", "-o", tmp_path / "nearest", EXAMPLES / "nearest.cpp"], capture_output=True, text=True
    )
    if "nlohmann/json.hpp: No such file" in done.stderr:
        pytest.skip("nlohmann/json IS ABSENT: the example in C++ is not compiled")
    assert done.returncode == 0, done.stderr
    env = make_env(2, macro_steps=4)
    with HostedPolicy(env, guest_of(f"exec:{tmp_path / 'nearest'}"), "nearest", 60.0, 60.0) as policy:
        state = env.reset()
        for _ in range(4):
            state = policy(state)
            assert not state["lost"].any(), policy.reasons
            for team in range(2):
                seen = policy.sight.observation(team)
                for robot in range(3):
                    grid, own = seen["grid"][robot], seen["poses"][robot, robot, :2]
                    unknown = np.pad(grid == -1, 1)
                    beside = unknown[2:, 1:-1] | unknown[:-2, 1:-1] | unknown[1:-1, 2:] | unknown[1:-1, :-2]
                    cells = np.argwhere((grid == 0) & beside)[:, ::-1]
                    points = seen["origin"] + (cells + 0.5) * seen["resolution"]
                    goal = points[np.hypot(*(points - own).T).argmin()]
                    wanted = policy.sight.to_action(np.broadcast_to(goal, (2, 3, 2)))
                    sent = [state[name][team, robot] for name in (REGION, OFFSET)]
                    assert all(
                        torch.equal(choice[team, robot], choice_sent)
                        for choice, choice_sent in zip(wanted, sent, strict=True)
                    )
            state = env.step(state)["next"]


def test_a_team_that_does_not_hear_each_other_plans_robot_by_robot():
    env = make_env(1, num_robots=3)
    sight, agent = TeamSight(env), TeamAgent("nearest_frontier")
    env.reset()
    sight.look()
    seen = sight.observation(0)
    agent.reset(sight.episode(0))
    together = agent.act(seen)
    blank = seen["grid"].copy()
    blank[1] = -1  # robot 1 knows nothing
    alone = agent.act(seen | {"grid": blank, "heard": np.eye(3, dtype=bool)})
    assert np.isnan(alone[1]).all() and np.isfinite(alone[[0, 2]]).all() and np.isfinite(together).all()
    dead = agent.act(seen | {"alive": np.array([True, False, True])})
    assert np.isnan(dead[1]).all() and np.isfinite(dead[[0, 2]]).all()
