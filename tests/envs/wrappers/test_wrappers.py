"""The env as PettingZoo's ParallelEnv and as Gymnasium's VectorEnv."""

import sys
import warnings

import numpy as np
import pytest
import torch
from episodes import SHORT
from worlds import room

from maexp.envs import ExplorationEnv, PlannerConfig, RobotConfig, parallel_env, vector_env

pytest.importorskip("pettingzoo", reason="THE EXTRA maexp[pettingzoo] IS NOT INSTALLED: its interface is not tested")
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo.test import parallel_api_test, parallel_seed_test

DIRECT = PlannerConfig(name="direct")


@pytest.fixture(autouse=True)
def strict():
    """PettingZoo warns where we break its rules."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture(scope="module")
def world():
    return room(30, 21)


def sampled(env) -> dict:
    return {name: env.action_space(name).sample() for name in env.agents}


def crash(world, collided: str):
    """A team whose first robot drives into a wall while the others stand; steps until it has."""
    wide = RobotConfig(collision_threshold=0.75)  # cannot slip through between points 1 m apart
    settings = {"planner": DIRECT, "robot": wide, "local_steps": 5, "macro_steps": 40, "num_threads": 1}
    env = parallel_env(world, 3, collided=collided, **settings)
    env.reset(seed=2)
    for _ in range(30):
        actions = {name: np.array([float(name == "robot_0"), 0.0], np.float32) for name in env.agents}
        result = env.step(actions)
        if result[4]["robot_0"]["collided"]:
            return env, result
    raise AssertionError("the robot met no wall")


@pytest.mark.parametrize("collided", ["stay", "leave"])
@pytest.mark.parametrize("settings", [{}, {"action": "region"}, {"action": "goal"}, {"planner": DIRECT}])
def test_pettingzoos_own_tests(world, settings, collided):
    settings = SHORT | settings | {"collided": collided}
    parallel_api_test(parallel_env(world, 3, **settings), num_cycles=30)
    parallel_seed_test(lambda: parallel_env(world, 3, **settings), num_cycles=30)


def test_agents_live_what_the_env_computes(world):
    env, twin = parallel_env(world, 3, **SHORT), ExplorationEnv(world, 1, 3, **SHORT)
    twin._set_seed(5)
    seen, _ = env.reset(seed=5)
    expected = twin.reset()
    for _ in range(SHORT["macro_steps"]):
        actions = sampled(env)
        for i, name in enumerate(env.possible_agents):
            assert env.observation_space(name).contains(seen[name])
            for key in ("map", "pose", "grid", "comm"):
                assert np.array_equal(seen[name][key], expected["agents", "observation", key][0, i].numpy())
        expected["agents", "action", "region"] = torch.tensor([[int(a["region"]) for a in actions.values()]])
        expected["agents", "action", "offset"] = torch.tensor(np.stack([a["offset"] for a in actions.values()]))[None]
        seen, rewards, ended, cut, infos = env.step(actions)
        expected = twin.step(expected)["next"]
        assert list(rewards.values()) == expected["agents", "reward"].flatten().tolist()
        assert infos["robot_1"]["path_length"] == expected["info", "path_length"][0, 1].item()
        assert infos["robot_2"]["coverage"] == expected["info", "coverage"].item() > 0
        assert np.array_equal(env.state(), expected["team", "map"][0]) and env.state_space.contains(env.state())
    assert all(cut.values()) and not any(ended.values()) and env.agents == []


def test_seeds_name_episodes(world):
    env = parallel_env(world, 2, **SHORT)
    first, second = (env.reset(seed=3)[0]["robot_0"]["pose"], env.reset()[0]["robot_0"]["pose"])
    assert not np.array_equal(first, second)
    assert np.array_equal(env.reset(seed=3)[0]["robot_0"]["pose"], first)
    assert np.array_equal(env.reset()[0]["robot_0"]["pose"], second)
    assert not np.array_equal(env.reset(seed=4)[0]["robot_0"]["pose"], first)


def test_a_robot_that_collided_stays_and_pays(world):
    env, (_, _, ended, cut, _) = crash(world, "stay")
    assert env.agents == env.possible_agents and not any(ended.values()) and not any(cut.values())
    before = env.env.snapshot()["center"]
    _, rewards, _, _, infos = env.step({name: np.ones(2, np.float32) for name in env.agents})
    assert infos["robot_0"]["collided"] and rewards["robot_0"] < 0
    moved = np.linalg.norm(env.env.snapshot()["center"] - before, axis=1)
    assert moved[0] == 0 and moved[1] > 0


def test_a_robot_that_collided_leaves(world):
    env, (seen, rewards, ended, cut, infos) = crash(world, "leave")
    assert env.agents == ["robot_1", "robot_2"] and not any(cut.values())
    assert ended == {"robot_0": True, "robot_1": False, "robot_2": False}
    assert set(seen) == set(rewards) == set(infos) == set(env.possible_agents)
    later = env.step(sampled(env))
    assert all(set(part) == {"robot_1", "robot_2"} for part in later)
    assert env.reset(seed=2)[0].keys() == set(env.possible_agents)


def test_success_terminates_all(world):
    env = parallel_env(world, 3, success_coverage=0.05, **SHORT)
    env.reset(seed=0)
    _, _, ended, cut, _ = env.step(sampled(env))
    assert all(ended.values()) and not any(cut.values()) and env.agents == []


@pytest.mark.parametrize("share", [(-1.0, -1.0), (0.0, 0.0), (0.3, -0.77), (1.0, 1.0)])
def test_a_goal_is_a_place_of_the_extent(world, share):
    env = parallel_env(world, 2, action="goal", **SHORT)
    env.reset(seed=0)
    env.step({name: np.array(share, np.float32) for name in env.agents})
    low, high = (np.array(corner) for corner in world.extent)
    wanted = (low + high) / 2 + np.array(share) * (high - low) / 2
    assert np.allclose(env.env.snapshot()["goal"], wanted, atol=1e-4)


def test_a_region_is_its_centre(world):
    env = parallel_env(world, 2, action="region", **SHORT)
    env.reset(seed=0)
    env.step({"robot_0": 8 * 2 + 5, "robot_1": np.int64(0)})
    low, high = (np.array(corner) for corner in world.extent)
    assert np.allclose(env.env.snapshot()["goal"][0], low + (high - low) * np.array([2.5, 5.5]) / 8, atol=1e-4)


def test_pictures(world):
    env = parallel_env(world, 2, render_mode="rgb_array", **SHORT)
    env.reset(seed=0)
    frame = env.render()
    assert frame.dtype == np.uint8 and frame.shape[1:] == (512, 3) and frame.std() > 10
    batch = vector_env(world, 2, 2, render_mode="rgb_array", **SHORT)
    batch.reset(seed=0)
    frames = batch.render()
    assert len(frames) == 2 and not np.array_equal(*frames)
    env.close(), env.close(), batch.close(), batch.close()


@pytest.mark.parametrize("settings", [{}, {"action": "region"}, {"action": "goal"}, {"planner": DIRECT}])
def test_spaces_of_the_batch(world, settings):
    batch = vector_env(world, 3, 2, **SHORT | settings)
    seen, _ = batch.reset(seed=1)
    for _ in range(2):
        assert batch.observation_space.contains(seen)
        actions = batch.action_space.sample()
        assert batch.action_space.contains(actions)
        seen, reward, ended, cut, info = batch.step(actions)
        assert reward.shape == ended.shape == cut.shape == info["coverage"].shape == (3,)
        assert reward.dtype == np.float64 and ended.dtype == cut.dtype == bool
        assert np.allclose(reward, info["robot_reward"].sum(1)) and info["collided"].shape == (3, 2)


def play(batch, steps: int, seed: int = 7) -> list[tuple]:
    batch.reset(seed=seed)
    batch.action_space.seed(0)
    return [batch.step(batch.action_space.sample()) for _ in range(steps)]


def test_next_step_autoreset(world):
    batch = vector_env(world, 3, 2, **SHORT)
    assert batch.metadata["autoreset_mode"].value == "NextStep"
    steps = play(batch, 6)
    assert steps[3][3].all() and (steps[3][4]["local_steps"] == 12).all()
    seen, reward, ended, cut, info = steps[4]
    assert not reward.any() and not ended.any() and not cut.any() and not info["local_steps"].any()
    assert (steps[5][4]["local_steps"] == 3).all() and steps[5][1].any()
    batch.reset(seed=7)
    assert np.array_equal(batch.reset()[0]["pose"], seen["pose"])  # the seed's second episodes


def test_same_step_autoreset(world):
    batch = vector_env(world, 3, 2, autoreset_mode="SameStep", **SHORT)
    steps, expected = play(batch, 5), play(vector_env(world, 3, 2, **SHORT), 5)
    seen, reward, _, cut, info = steps[3]
    assert cut.all() and np.array_equal(reward, expected[3][1]) and reward.any()
    assert info["_final_obs"].all() and not info["local_steps"].any()
    assert np.array_equal(info["final_obs"][1]["map"], expected[3][0]["map"][1])
    assert (info["final_info"]["local_steps"] == 12).all()
    assert np.array_equal(seen["pose"], expected[4][0]["pose"])
    assert (steps[4][4]["local_steps"] == 3).all() and "final_obs" not in steps[4][4]


def test_without_autoreset(world):
    batch = vector_env(world, 3, 2, autoreset_mode="Disabled", **SHORT)
    last = play(batch, 4)[3]
    assert last[3].all()
    with pytest.raises(RuntimeError, match=r"teams \[0, 1, 2\] are done"):
        batch.step(batch.action_space.sample())
    seen, info = batch.reset(options={"reset_mask": np.array([True, False, True])})
    assert info["local_steps"].tolist() == [0, 12, 0]
    for name in ("map", "team_map"):
        assert np.array_equal(seen[name][1], last[0][name][1]) and seen[name][1].any(), "the others go on seeing"
        assert not np.array_equal(seen[name][0], last[0][name][0])
    with pytest.raises(RuntimeError, match=r"teams \[1\] are done"):
        batch.step(batch.action_space.sample())
    batch.reset(options={"reset_mask": np.array([False, True, False])})
    assert batch.step(batch.action_space.sample())[4]["local_steps"].tolist() == [3, 3, 3]


def test_teams_that_end_at_different_times(world):
    """Only those that were done start anew; the others' step counts."""
    batch = vector_env(world, 4, 2, success_coverage=0.25, **SHORT | {"macro_steps": 9})
    steps = play(batch, 30)
    ended = np.stack([step[2] | step[3] for step in steps])
    after = np.stack([step[4]["local_steps"] for step in steps])[1:]
    assert 1 < len({*np.argmax(ended, axis=0)}) and ended.any(0).all()
    assert np.array_equal(after == 0, ended[:-1])


def test_gymnasiums_wrappers_take_it(world):
    batch = RecordEpisodeStatistics(vector_env(world, 3, 2, **SHORT))
    batch.reset(seed=1)
    total, last = np.zeros(3), {}
    for _ in range(4):
        _, reward, _, _, last = batch.step(batch.action_space.sample())
        total += reward
    assert np.allclose(last["episode"]["r"], total) and (last["episode"]["l"] == 4).all()


BAD = [
    (lambda m: parallel_env(m, action="jump"), "action='jump'"),
    (lambda m: parallel_env(m, collided="vanish"), "collided='vanish'"),
    (lambda m: parallel_env(m, render_mode="human"), "render_mode='human'"),
    (lambda m: parallel_env("maze"), "PointCloudMap"),
    (lambda m: parallel_env(m, 0), "num_robots=0"),
    (lambda m: vector_env(m, autoreset_mode="Never"), "autoreset_mode='Never'"),
    (lambda m: vector_env(m).reset(seed=[1]), r"seed=\[1\]"),
    (lambda m: vector_env(m, 2).reset(options={"reset_mask": [True]}), "reset_mask"),
]


@pytest.mark.parametrize(("make", "told"), BAD, ids=[told for _, told in BAD])
def test_bad_settings(world, make, told):
    with pytest.raises(ValueError, match=told):
        make(world)


GOOD = {"region": 3, "offset": np.zeros(2)}
ACTIONS = [
    ({"robot_0": GOOD}, "no action for robot_1"),
    ({"robot_0": GOOD, "robot_1": GOOD, "me": GOOD}, "'me', which is no agent"),
    ({"robot_0": GOOD, "robot_1": 3}, "the action of robot_1 is 3"),
    ({"robot_0": GOOD, "robot_1": GOOD | {"region": 64}}, r"region=\[\[3, 64\]\]"),
    ({"robot_0": GOOD, "robot_1": GOOD | {"region": 1.5}}, "whole numbers"),
    ({"robot_0": GOOD, "robot_1": GOOD | {"offset": np.zeros(3)}}, "offset has a different shape"),
    ({"robot_0": GOOD, "robot_1": GOOD | {"offset": np.full(2, np.nan)}}, "NaN"),
    (3, "actions is a int"),
]


@pytest.mark.parametrize(("actions", "told"), ACTIONS, ids=[told for _, told in ACTIONS])
def test_bad_actions(world, actions, told):
    env = parallel_env(world, 2, **SHORT)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=told):
        env.step(actions)


def test_nothing_before_reset(world):
    env, batch = parallel_env(world, 2, **SHORT), vector_env(world, 2, 2, **SHORT)
    for call in (lambda: env.step({}), env.state, lambda: batch.step(batch.action_space.sample())):
        with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
            call()


@pytest.mark.parametrize("package", ["pettingzoo", "gymnasium"])
def test_the_extra_is_named(world, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"maexp.envs.wrappers.{package}", raising=False)
    with pytest.raises(ImportError, match=rf'pip install "maexp\[{package}\]"'):
        parallel_env(world) if package == "pettingzoo" else vector_env(world)
