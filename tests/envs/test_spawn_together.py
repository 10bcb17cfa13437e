"""Teams that start together: one place, beside each other, clear of walls and of each other, the same in any batch."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from worlds import room

from maexp.agents.benchmarks.cell import EnvShelf, read_result, run_cell
from maexp.agents.benchmarks.plan import Cell
from maexp.agents.build import choose_starts, load_maps, make_env
from maexp.agents.cli.benchmark import prepare
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides
from maexp.envs import ExplorationEnv, MapError, RobotConfig, make_map
from maexp.envs.spawn import check_gathering

SCENARIOS = ("maze_small", "indoor_small", "random_obstacles")


def starts_of(env: ExplorationEnv) -> np.ndarray:
    env.reset()
    return env.simulation.tensors["center"][..., :2].numpy().astype(float)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_robots_stand_beside_each_other_and_clear_of_walls(scenario, count):
    env = ExplorationEnv([make_map(scenario, k) for k in (0, 1)], 6, count, seed=4, num_threads=1, starts="together")
    need = 3.0 * env.robot_configs[0].collision_threshold
    places = []
    for _ in range(2):
        starts = starts_of(env)
        for e, team in enumerate(starts):
            m = env.maps[int(env.simulation.tensors["map_id"][e])]
            assert (cKDTree(m.boundary[:, :2]).query(team)[0] >= need - 1e-4).all()
            gaps = np.linalg.norm(team[:, None] - team, axis=-1) + 1e9 * np.eye(count)
            assert (gaps >= need - 1e-4).all() and (count == 1 or (gaps.min(-1) <= 1.5 * need + 1e-4).all())
            for i in range(1, count):  # no wall in between
                mate = team[:i][np.linalg.norm(team[:i] - team[i], axis=-1).argmin()]
                line = mate + np.linspace(0.0, 1.0, 9)[:, None] * (team[i] - mate)
                assert cKDTree(m.boundary[:, :2]).query(line)[0].min() > 0.4 * need
        places.append(starts[:, 0])
    assert len(np.unique(np.concatenate(places).round(3), axis=0)) > 6, "one place over and over"


def test_a_start_depends_on_seed_env_and_episode_alone():
    maps = [make_map("maze_small", k) for k in (0, 1)]
    small, large, again, other = (
        ExplorationEnv(maps, n, 3, seed=s, num_threads=1, starts="together")
        for n, s in ((2, 7), (5, 7), (2, 7), (2, 8))
    )
    for _ in range(2):
        a, b, c, d = (starts_of(env) for env in (small, large, again, other))
        assert np.array_equal(a, b[:2]) and np.array_equal(a, c) and not np.array_equal(a, d)
    for env, ids in ((small, [3, 4]), (large, [0, 3, 4, 1, 2])):
        env.set_episodes(torch.tensor(ids, dtype=torch.int32))
    a, b = starts_of(small), starts_of(large)
    assert np.array_equal(a, b[1:3])


def test_the_first_robots_of_a_larger_team_stand_where_a_smaller_one_does():
    m = make_map("outdoor", 0)
    three, six = (starts_of(ExplorationEnv(m, 2, n, seed=1, num_threads=1, starts="together")) for n in (3, 6))
    assert np.array_equal(three, six[:, :3])


def test_robots_of_two_sizes():
    robots = [RobotConfig(), RobotConfig(collision_threshold=0.4), RobotConfig()]
    env = ExplorationEnv(make_map("maze_small", 0), 4, 3, robot=robots, num_threads=1, starts="together")
    gaps = np.linalg.norm(np.diff(starts_of(env), axis=1), axis=-1)
    assert (gaps >= 2.25 - 1e-4).all() and gaps.max() < 10.0


def test_given_poses_go_before_and_none_draws_a_place_again():
    env = ExplorationEnv(make_map("maze_small", 0), 2, 3, seed=2, num_threads=1, starts="together")
    first = starts_of(env)
    env.set_starts(np.concatenate([first[1], np.zeros((3, 1))], 1))
    assert np.allclose(starts_of(env), first[1], atol=1e-5)
    env.set_starts(None)
    team = starts_of(env)
    assert np.linalg.norm(team[:, 0] - team[:, 1], axis=-1).max() <= 1.5 * 2.25 + 1e-4


def test_no_room_is_said_clearly():
    with pytest.raises(MapError, match=r"room for \d+ of num_robots=40 robots that start together, 2.25 m from walls"):
        check_gathering(room(14, 13), [0.75] * 40)
    with pytest.raises(ValueError, match="starts='beside' is unknown: choose drawn, together, fixed or poses"):
        ExplorationEnv(make_map("maze_small", 0), 1, 2, num_threads=1, starts="beside")


def test_the_setting_reaches_the_env():
    cfg = compose_settings("evaluate", ["scenario.starts=together", "scenario.held_out=[70]"])
    assert choose_starts(cfg, 3) == "together"
    env = make_env(cfg, load_maps(cfg.scenario, train=False).held_out, 3, num_envs=2)
    team = starts_of(env)
    assert np.linalg.norm(team[:, 0] - team[:, 1], axis=-1).max() <= 1.5 * 2.25 + 1e-4


def test_a_benchmark_plays_them_beside_drawn_ones(tmp_path):
    words = ["preset=smoke", "scenarios=maze_small", "policies=random", "algorithms=[]", "seeds=0", "episodes=3"]
    words += ["num_envs=3", "scenario.local_steps=4", "scenario.macro_steps=2", "maps=held_out,held_out_together"]
    cfg = compose_settings("benchmark", prepare(make_overrides("benchmark", words)).words)
    cell, shelf = Cell("maze_small", "random", 0), EnvShelf()
    assert run_cell(cfg, tmp_path, cell, shelf, list(cfg.maps))
    drawn, together = (read_result(tmp_path, cell, suite) for suite in cfg.maps)
    assert np.array_equal(drawn.maps, together.maps) and len(drawn.maps) == 3
    assert (drawn.episodes["coverage_auc"] > together.episodes["coverage_auc"]).any(), "they see the same at first"
    env = shelf.kept["held_out_together"][1]
    assert env.starts == "together" and shelf.kept["held_out"][1].starts == "drawn"
