"""The env on volumes: its contract, repeats, what always holds, and what is refused."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs, step_mdp

from maexp.agents import make_policy
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    FaultsConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
    RobotConfig,
    make_map,
)
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.volume.map import VoxelMap, unpack_words

KINDS = ("cost_utility", "nearest_frontier", "multi_criteria", "hungarian", "voronoi", "potential_field", "random")


def small_map(index: int = 0) -> VoxelMap:
    """Two storeys of 12 x 10 m with a shaft between them, and pillars."""
    free = np.zeros((48, 40, 20), dtype=bool)
    free[1:-1, 1:-1, 1:9] = True
    free[1:-1, 1:-1, 11:19] = True
    free[20:28, 14:22, 8:12] = True
    rng = np.random.default_rng(index)
    for x, y in zip(rng.integers(4, 44, 6), rng.integers(4, 36, 6), strict=True):
        free[x : x + 2, y : y + 2] = False
    return VoxelMap(free, ~free, 0.25, (1.0, -2.0, 0.5), name=f"storeys_{index}", scenario="cave")


def make_env(num_envs: int = 2, num_robots: int = 3, maps=None, **settings) -> ExplorationEnv:
    settings = {"macro_steps": 12, "num_threads": 1} | settings
    return ExplorationEnv(maps or [small_map()], num_envs, num_robots, seed=3, **settings)


def play(env: ExplorationEnv, name: str = "cost_utility", steps: int = 6) -> list:
    """Steps of a policy from a reset on."""
    policy, td, found = make_policy(name, env), env.reset(), []
    for _ in range(steps):
        td = env.step(policy(td))
        found.append(td["next"].clone())
        td = step_mdp(td)
    return found


def voxels(env: ExplorationEnv, name: str, e: int, i: int | None = None) -> np.ndarray:
    words, m = env.simulation.tensors[name][e], env.maps[int(env.simulation.tensors["map_id"][e])]
    nx, ny, nz = m.shape
    return unpack_words((words if i is None else words[i])[: nx * ny].reshape(nx, ny, -1).numpy(), nz)


def test_a_generated_map_is_an_env_of_targets():
    env = ExplorationEnv([make_map("cave", 0)], num_envs=2, num_robots=3, num_threads=1)
    check_env_specs(env)
    td = env.rand_step(env.reset())
    assert td["agents", "observation", "targets"].shape[:3] == (2, 3, 24)
    assert "map" not in td["agents", "observation"].keys() and "team" not in td.keys()
    assert env.space.bytes_per_env(env.settings, env.bank) < 4e6
    assert {"coverage", "surface_coverage", "coverage_step_99", "collided", "path_length"} <= set(td["info"].keys())


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"observation": ObservationConfig(pictures=False)},
        {"comm": CommConfig(range=4.0, line_of_sight=True), "faults": FaultsConfig(probability=0.5)},
        {"radar": RadarConfig(range=3.0, fov=1.6, vertical_fov=1.0, every=3)},
    ],
    ids=["plain", "goals", "radios and faults", "camera"],
)
def test_specs(settings):
    check_env_specs(make_env(**settings))


def test_env_i_plays_the_same_in_any_batch():
    maps = [small_map(k) for k in range(3)]
    many, few = play(make_env(5, maps=maps)), play(make_env(2, maps=maps, num_threads=2))
    for a, b in zip(many, few, strict=True):
        for key in (("agents", "observation", "targets"), ("agents", "reward"), ("info", "coverage"), ("done",)):
            assert torch.equal(a[key][:2], b[key]), key


def test_a_state_goes_on_bit_for_bit():
    env = make_env()
    play(env, steps=3)
    state = {name: value.clone() for name, value in env.state_dict().items()}
    td = env.observe()
    again = make_env()
    again.load_state_dict(state)
    policies = [make_policy("random", made) for made in (env, again)]
    a, b = td.clone(), again.observe()
    for _ in range(3):
        a, b = (step_mdp(made.step(policy(t))) for made, policy, t in zip((env, again), policies, (a, b), strict=True))
        for name, value in env.simulation.tensors.items():
            if name in env.space.STATE:
                assert torch.equal(value, again.simulation.tensors[name]), name


@pytest.mark.parametrize("name", KINDS)
def test_what_always_holds(name):
    env = make_env(num_envs=3, maps=[small_map(k) for k in range(2)])
    seen = [torch.zeros(3)]

    def look(env):
        s = env.simulation.tensors
        coverage = s["covered"] / env.simulation.map_tensors["total_weight"][s["map_id"].long()]
        assert (coverage >= seen[-1]).all() or int(s["local_step"].max()) == 0
        seen.append(coverage)
        limit = env.robot_configs[0].max_speed + 1e-4
        assert float(s["velocity"].norm(dim=-1).max()) <= limit
        for e in range(3):
            m = env.maps[int(s["map_id"][e])]
            inside = m.indices(s["center"][e].numpy())
            assert m.free[tuple(inside.T)].all(), "a robot is in a wall"

    env.set_step_hook(look, every=5)
    last = play(env, name, 8)[-1]
    s = env.simulation.tensors
    for e in range(3):
        free, solid = voxels(env, "team_free", e), voxels(env, "team_surface", e)
        number = int(s["map_id"][e])
        assert not (free & ~env.maps[number].free).any() and not (solid & ~env.maps[number].occupied).any()
        assert int((free & env.bank.seeable[number]).sum()) == int(s["covered"][e])
        assert int((solid & env.bank.surface[number]).sum()) == int(s["covered_surface"][e])
        twice = sum(voxels(env, "seen_free", e, i).astype(int) for i in range(3)) >= 2
        assert int((twice & env.bank.seeable[number]).sum()) == int(s["shared"][e])
    assert not bool(last["info", "collided"].any())
    if name != "random":
        assert float(last["info", "coverage"].min()) > 0.35


def test_robots_explore_both_storeys():
    env = make_env(macro_steps=60)
    last = play(env, steps=40)[-1]
    assert float(last["info", "coverage"].min()) > 0.9
    assert (last["info", "coverage_step_85"] > 0).all()


def test_robots_that_do_not_hear_each_other_know_their_own():
    env = make_env(comm=CommConfig(range=0.1))
    play(env, steps=2)
    assert torch.equal(env.simulation.tensors["known_free"], env.simulation.tensors["seen_free"])
    env = make_env(comm=CommConfig(range=100.0))
    play(env, steps=2)
    known = env.simulation.tensors["known_weight"]
    assert (known >= known.amax(1, keepdim=True) - 400).all()  # news takes a step


def test_walls_part_radios():
    m, settings = small_map(), {"comm": CommConfig(range=100.0, line_of_sight=True)}
    env = make_env(1, 2, **settings)
    low, high = (m.origin[2] + 0.25 * z for z in (4.5, 14.5))
    env.set_starts(np.array([[3.0, 0.0, low, 0.0], [3.0, 0.0, high, 0.0]]))
    env.reset()
    assert not bool(env.simulation.tensors["comm"][0, 0, 1])
    env.set_starts(np.array([[7.0, 2.5, low, 0.0], [7.0, 2.5, high, 0.0]]))
    env.reset()
    assert bool(env.simulation.tensors["comm"][0, 0, 1])


def test_a_failed_robot_stays():
    env = make_env(1, faults=FaultsConfig(at=((1, 4.0),)))
    places = [td["info", "path_length"][0, 1] for td in play(env, steps=5)]
    assert places[0] > 0 and places[2] == places[4]


def test_a_camera_looks_where_it_is_told():
    radar = RadarConfig(range=4.0, fov=1.6, vertical_fov=1.0)
    env = make_env(1, 1, radar=radar, observation=ObservationConfig(pictures=False))
    td = env.reset()
    at = env.simulation.tensors["center"].clone()
    td["agents", "action"] = {"goal": at, "heading": torch.full((1, 1), 2.0)}
    for _ in range(2):
        td = step_mdp(env.step(td.clone().set(("agents", "action"), td["agents", "action"])))
        td["agents", "action"] = {"goal": at, "heading": torch.full((1, 1), 2.0)}
    assert float(env.simulation.tensors["pose"][0, 0, 3]) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"observation": ObservationConfig(targets=8)}, "observation.pictures=True"),
        ({"planner": PlannerConfig(name="dwa")}, "planner='dwa'"),
        ({"planner": PlannerConfig(name="direct")}, "planner='direct'"),
        ({"collision": "footprint"}, "collision='footprint'"),
        ({"comm": CommConfig(signal=True)}, "comm.signal=True"),
        ({"comm": CommConfig(base_station=True)}, "comm.base_station=True"),
        ({"odometry": OdometryConfig(drift=0.1)}, "odometry.drift=0.1"),
        ({"radar": RadarConfig(noise=0.1)}, "radar.noise=0.1"),
        ({"radar": RadarConfig(range=9.0)}, "radar.range=9"),
        ({"robot": RobotConfig(kind="ackermann")}, "robot.kind='ackermann'"),
        ({"robot": RobotConfig(collision_threshold=3.0)}, "robot.collision_threshold=3"),
    ],
)
def test_what_volumes_lack_is_refused_by_name(settings, told):
    with pytest.raises((ValueError, MapError), match=told.replace(".", r"\.")):
        make_env(**settings)


@pytest.mark.parametrize("policy", ["lookahead", "clairvoyant", "oracle", "rrt_frontiers"])
def test_planners_of_the_plane_are_refused(policy):
    with pytest.raises(ValueError, match=f"policy={policy} plans in the plane"):
        make_policy(policy, make_env())


def test_what_is_of_volumes_is_refused_in_the_plane():
    maze = make_map("maze_small", 0)
    for settings, told in (
        ({"robot": RobotConfig(kind="quadrotor")}, "robot.kind='quadrotor'"),
        ({"radar": RadarConfig(vertical_fov=1.0)}, "radar.vertical_fov=1"),
        ({"radar": RadarConfig(every=2)}, "radar.every=2"),
    ):
        with pytest.raises(ValueError, match=told.replace(".", r"\.")):
            ExplorationEnv(maze, **settings)
    with pytest.raises(ValueError, match="maps holds VoxelMaps and maps in the plane"):
        ExplorationEnv([maze, small_map()])


def test_odd_actions_are_refused():
    env = make_env(1, 1, observation=ObservationConfig(pictures=False))
    td = env.reset()
    td["agents", "action", "goal"] = torch.full((1, 1, 3), torch.nan)
    with pytest.raises(ValueError, match="NaN or infinite"):
        env.step(td)
    td["agents", "action", "goal"] = torch.zeros(1, 1, 3)
    td["agents", "action", "heading"] = torch.zeros(1, 1)
    with pytest.raises(ValueError, match="heading, and it sees all around"):
        env.step(td)


def test_starts():
    env = make_env(1, 2)
    good = np.array([[3.0, 0.0, 1.6, 0.5], [8.0, 2.0, 1.6, -0.5]])
    env.set_starts(good)
    env.reset()
    assert np.allclose(env.simulation.tensors["center"][0].numpy(), good[:, :3])
    for wrong, told in ((good + [[0, 0, 1.1, 0]], "is no place"), (good[[0, 0]], "collides"), (good[:, :3], "shape")):
        with pytest.raises(ValueError, match=told):
            env.set_starts(wrong)
    near = make_env(2, starts="together")
    near.reset()
    center = near.simulation.tensors["center"]
    assert float((center[:, 1:] - center[:, :1]).norm(dim=-1).max()) < 2.5
    fixed = make_env(2, starts="fixed")
    a, b = (fixed.reset() is not None and fixed.simulation.tensors["center"].clone() for _ in range(2))
    assert torch.equal(a, b)


def test_a_map_without_room_is_refused():
    free = np.zeros((20, 20, 20), dtype=bool)
    free[5:7, 5:15, 5:7] = True
    with pytest.raises(MapError, match="has no room"):
        make_env(maps=[VoxelMap(free, ~free, 0.25, scenario="cave")])


def test_a_picture():
    env = make_env(1)
    play(env, steps=1)
    picture = env.render(0, size=128)
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 8
