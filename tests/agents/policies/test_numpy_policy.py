"""Foreign policies: what they are told is what the env holds, their goals are driven to, what they do wrong is told."""

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env

from maexp.agents.errors import UserError
from maexp.agents.policies import POLICIES
from maexp.agents.policies.remote.numpy_policy import NumpyPolicy, TeamSight, as_policy, read_goals
from maexp.envs import CommConfig, RobotConfig, make_map
from maexp.envs.targets.navigation import Navigation

pytestmark = pytest.mark.slow  # processes


def drive(env, steps: int) -> None:
    """A planner's first decisions."""
    planner, td = POLICIES["cost_utility"](env), env.reset()
    for _ in range(steps):
        td = env.step(planner(td))["next"]


@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=6.0)])
def test_grids_are_what_the_planners_plan_on(comm):
    maps = [make_map("maze_small", 0), make_map("random_obstacles", 1)]
    env = make_env(3, maps=maps, num_robots=2, comm=comm)
    sight, nav = TeamSight(env), Navigation(env)
    drive(env, 2)
    sight.look()
    nav.update()
    for team in range(3):
        seen, m = sight.observation(team), int(env.simulation.tensors["map_id"][team])
        width, height = int(nav.width[m]), int(nav.height[m])
        known = nav.known[team, :, : width * height].numpy().reshape(-1, height, width)
        assert seen["grid"].dtype == np.int8 and seen["grid"].shape == (2, height, width)
        assert np.array_equal(seen["grid"], np.broadcast_to(np.array([-1, 0, 100])[known], (2, height, width)))
        assert seen["resolution"] == float(nav.cell_size[m]) and seen["origin"] == tuple(nav.origin[m].tolist())
        y, x = np.argwhere(seen["grid"][0] == 0)[0]
        gap = np.array(seen["origin"]) + (np.array([x, y]) + 0.5) * seen["resolution"] - env.maps[m].free[:, :2]
        assert np.abs(gap).max(1).min() <= seen["resolution"]
    assert comm.limited == (not np.array_equal(seen["grid"][0], seen["grid"][1]))


def test_poses_and_velocities_are_those_that_the_robots_last_heard():
    env = make_env(4, num_robots=3, comm=CommConfig(range=9.0), robot=RobotConfig(kind="omnidirectional"))
    sight, planner, td = TeamSight(env), POLICIES["random"](env), env.reset()
    last = np.full((4, 3, 3, 3), np.nan)
    kept = 0
    for step in range(6):
        now = env.simulation.tensors
        pose = torch.cat([now["center"][..., :2], now["pose"][..., 3:]], -1).numpy()
        for e, i, j in np.ndindex(4, 3, 3):
            if np.linalg.norm(pose[e, i, :2] - pose[e, j, :2]) <= 9.0:
                last[e, i, j] = pose[e, j]
        sight.look()
        for e in np.flatnonzero(sight.active):
            seen = sight.observation(e)
            assert np.array_equal(seen["poses"], last[e], equal_nan=True)
            kept += (np.isfinite(seen["poses"][..., 0]) & ~seen["heard"]).sum()
            assert seen["heard"].diagonal().all()
            assert np.array_equal(np.isnan(seen["velocities"]), np.isnan(last[e, ..., :2]))
            assert np.array_equal(seen["alive"], now["collided"][e].numpy() == 0)
            assert seen["time"] == pytest.approx(step * env.local_steps * 0.1)
            assert seen["time_left"] == pytest.approx(1 - step / env.macro_steps)
        td = env.step(planner(td))["next"]
    assert kept > 0, "no robot went out of reach"
    env.reset()
    sight.look()
    heard = sight.now["comm"]
    assert np.isnan(sight.poses[~heard]).all() and not heard.all(), "an episode began and nothing was forgotten"


def test_velocities_are_those_of_the_way_driven():
    env = make_env(4, num_robots=2, robot=RobotConfig(kind="omnidirectional"))
    sight, planner, td = TeamSight(env), POLICIES["cost_utility"](env), env.reset()
    places, driving = [], 0
    env.set_step_hook(lambda env: places.append(env.simulation.tensors["center"][..., :2].numpy().copy()))
    for _ in range(3):
        td = env.step(planner(td))["next"]
        sight.look()
        moved = (places[-1] - places[-2]) / 0.1
        for e in np.flatnonzero(sight.active):
            seen = sight.observation(e)
            for i in np.flatnonzero(seen["alive"]):  # speeds change once a way is driven, by 2 m/s^2 in 0.1 s
                assert np.allclose(seen["velocities"][:, i], moved[e, i], atol=0.3)
                driving += (np.abs(moved[e, i]) > 1.0).all()
    assert driving > 2, "nobody drove askew"


def test_an_episode_is_told_with_its_units_and_a_seed_of_its_own():
    env = make_env(3, num_robots=2, robot=[RobotConfig(), RobotConfig(collision_threshold=0.9, max_speed=2.0)])
    sight = TeamSight(env)
    env.reset()
    told = [sight.episode(team) for team in range(3)]
    assert told[0] == {
        "num_robots": 2,
        "radar_range": 10.0,
        "robot_radius": 0.9,
        "max_speed": 8.0,
        "max_accel": 2.0,
        "drive": "ackermann",
        "seconds": 160.0,
        "decision_seconds": 2.0,
        "seed": told[0]["seed"],
    }
    env.reset()
    seeds = {episode["seed"] for episode in told} | {sight.episode(team)["seed"] for team in range(3)}
    assert len(seeds) == 6 and all(0 <= seed < 2**31 for seed in seeds)
    larger = make_env(5, num_robots=2)
    larger.reset()
    assert [TeamSight(larger).episode(team)["seed"] for team in range(3)] == [episode["seed"] for episode in told]


def test_goals_in_metres_are_where_the_robots_are_sent():
    env = make_env(2, num_robots=3)
    sight, td = TeamSight(env), env.reset()
    goals = np.random.default_rng(0).uniform(1.0, 35.0, (2, 3, 2))
    goals[0, 1], goals[1, 2] = np.nan, (1e6, -1e6)
    own = env.simulation.tensors["center"][0, 1, :2].clone().numpy()
    td[REGION], td[OFFSET] = sight.to_action(goals)
    env.step(td)
    goals[0, 1] = own
    low, high = (np.array(corner) for corner in env.maps[0].extent)
    goals[1, 2] = (high[0], low[1])
    assert np.allclose(env.simulation.tensors["goal"].numpy(), goals, atol=1e-4)


class Greedy:
    """Goes to the nearest free cell beside unknown ones."""

    def reset(self, episode):
        self.episode, self.calls = episode, 0

    def act(self, observation):
        self.calls += 1
        grid, n = observation["grid"], self.episode["num_robots"]
        goals = np.full((n, 2), np.nan)
        for i in np.flatnonzero(observation["alive"]):
            unknown = np.pad(grid[i] == -1, 1)
            beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
            y, x = np.nonzero((grid[i] == 0) & beside)
            points = np.stack([x, y], 1) * observation["resolution"] + np.array(observation["origin"])
            if len(points):
                goals[i] = points[np.linalg.norm(points - observation["poses"][i, i, :2], axis=1).argmin()]
        return goals


def test_a_foreign_policy_plays_every_team_of_an_env_with_an_object_of_its_own():
    env = make_env(4)
    policy = as_policy(env, Greedy)
    agents = policy.module.agents
    td = env.reset()
    for _ in range(10):
        td = env.step(policy(td))["next"]
    coverage = td["info", "coverage"][:, 0]
    assert coverage.mean() > 0.5 and len({id(agent) for agent in agents}) == 4
    assert {agent.episode["seed"] for agent in agents} == {TeamSight(env).episode(e)["seed"] for e in range(4)}
    before = [agent.calls for agent in agents]
    env.reset()
    policy(env.observe())
    assert max(before) == 10 and [agent.calls for agent in agents] == [1] * 4


class Bad:
    def __init__(self, answer):
        self.answer = answer

    def act(self, observation):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (None, r"act\(\) returned nothing: goals must be numbers \[3, 2\]"),
        ("north", r"act\(\) returned a str"),
        ([[1, 2], [3]], r"act\(\) returned a list"),
        (np.zeros((2, 2)), r"act\(\) returned numbers of shape \[2, 2\]"),
        (np.full((3, 2), np.inf), r"act\(\) returned a goal that is infinite"),
        (np.full((3, 2), 1j), r"act\(\) returned a ndarray"),
        (KeyError("grids"), r"policy mine: act\(\) raised KeyError in test_numpy_policy.py, line \d+: 'grids'\."),
    ],
)
def test_what_is_no_goal_is_told_in_a_sentence(answer, told):
    env = make_env(1)
    policy = NumpyPolicy(env, lambda: Bad(answer), "mine")
    env.reset()
    with pytest.raises(UserError, match=told) as error:
        policy(None)
    assert str(error.value).startswith("policy mine: ") and "\n" not in str(error.value)


def test_goals_are_read_as_numbers_of_any_kind():
    assert np.array_equal(read_goals([[1, 2], [3, 4]], 2), [[1.0, 2.0], [3.0, 4.0]])
    assert np.isnan(read_goals([[np.nan, 1.0]], 1)[0, 0])
    with pytest.raises(UserError, match=r"mine: its constructor raised TypeError"):
        NumpyPolicy(make_env(1), lambda: Bad(), "mine")
    with pytest.raises(ValueError, match="planner=direct"):
        as_policy(make_env(1, planner="direct"), Greedy)
