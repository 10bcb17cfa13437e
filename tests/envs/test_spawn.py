"""Where robots start: drawn, fixed for each map, given to the env, or read from a file."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from worlds import room

from maexp.agents.build import make_env
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides
from maexp.envs import ExplorationEnv, MapError, RobotConfig, make_map
from maexp.envs.spawn import fixed_starts, read_starts

POSES = [[4.0, 8.0, 0.5], [7.0, 3.0, -2.0]]


@pytest.fixture(scope="module")
def maps():
    return [make_map("maze_small", 0), make_map("maze_small", 1)]


def make(place, envs: int = 2, robots: int = 2, **settings) -> ExplorationEnv:
    return ExplorationEnv(place, envs, robots, num_threads=1, local_steps=5, **settings)


def where(env: ExplorationEnv) -> np.ndarray:
    """Centre and heading of every robot, [E, N, 3]."""
    state = env.simulation.tensors
    return torch.cat([state["center"][..., :2], state["pose"][..., 3:]], dim=-1).numpy().copy()


def drive(env: ExplorationEnv, td, steps: int, seed: int = 0):
    """Random steps, finished envs reset; what each step gave."""
    generator, out = torch.Generator().manual_seed(seed), []
    for _ in range(steps):
        e, n = env.num_envs, env.num_robots
        td["agents", "action", "region"] = torch.randint(64, (e, n), generator=generator)
        td["agents", "action", "offset"] = torch.rand(e, n, 2, generator=generator) * 2 - 1
        stepped, td = env.step_and_maybe_reset(td)
        out.append(torch.cat([stepped["next", "agents", "observation", "pose"], td["agents", "observation", "pose"]]))
    return out, td


def test_every_following_reset_starts_there(maps):
    env = make(maps, macro_steps=2)
    env.set_starts(torch.tensor(POSES))
    td = env.reset()
    np.testing.assert_allclose(where(env), np.broadcast_to(POSES, (2, 2, 3)), atol=1e-6)
    state = env.simulation.tensors
    back = 0.5 * env.robot_configs[0].length
    np.testing.assert_allclose(state["pose"][0, 0, :2], [4 - back * math.cos(0.5), 8 - back * math.sin(0.5)], atol=1e-5)
    assert not state["pose"][..., 2].any() and (td["agents", "observation", "map"][:, :, 0] > 0).any()
    drive(env, td, 4)  # two episodes
    np.testing.assert_allclose(where(env), np.broadcast_to(POSES, (2, 2, 3)), atol=1e-6)
    assert (state["episode"] == 2).all()
    env.set_starts(None)
    env.reset()
    assert np.abs(where(env)[..., :2] - np.array(POSES)[:, :2]).max() > 1.0


def test_each_env_has_its_own_and_only_reset_ones_move(maps):
    env = make(maps[0])
    env.reset()
    before = where(env)
    other = np.array([POSES, [[7.0, 3.0, 9.0], [4.0, 8.0, -9.0]]])
    env.set_starts(other)
    np.testing.assert_array_equal(where(env), before)
    td = env.fake_tensordict().select("_reset", strict=False)
    td["_reset"] = torch.tensor([[False], [True]])
    env.reset(td)
    np.testing.assert_array_equal(where(env)[0], before[0])
    np.testing.assert_allclose(where(env)[1], [[7.0, 3.0, 9.0 - 2 * math.pi], [4.0, 8.0, 2 * math.pi - 9.0]], atol=1e-5)


def test_drawn_starts_are_as_without_and_given_ones_leave_the_maps_as_drawn(maps):
    plain, given = make(maps, 6, seed=4), make(maps, 6, seed=4)
    given.set_starts(POSES)
    for _ in range(3):
        plain.reset(), given.reset()
        assert torch.equal(plain.simulation.tensors["map_id"], given.simulation.tensors["map_id"])
    given.set_starts(None)
    plain.reset(), given.reset()
    np.testing.assert_array_equal(where(plain), where(given))


@pytest.mark.parametrize("starts", ["fixed", POSES])
def test_a_resumed_env_goes_on_bit_for_bit(maps, starts):
    env = make(maps, 3, seed=2, starts=starts, macro_steps=2)
    _, td = drive(env, env.reset(), 3)
    saved, held = env.state_dict(), td.clone()
    want, _ = drive(env, td, 5, seed=1)
    again = make(maps, 3, seed=0, starts="fixed" if starts == "fixed" else "drawn", macro_steps=2)
    again.reset()
    again.load_state_dict(saved)
    got, _ = drive(again, held, 5, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(want, got, strict=True))


@pytest.mark.parametrize(
    "poses, words",
    [
        ([[4.0, 8.0]], r"starts has shape \(1, 2\): give x, y, heading as \[2, 3\]"),
        (np.zeros((3, 2, 3)), r"shape \(3, 2, 3\).*\[2, 2, 3\]"),
        ("here", "starts='here' is unknown: choose drawn, together, fixed or poses"),
        ([["a", "b", "c"]] * 2, "must be numbers"),
        ([POSES[0], [7.0, math.nan, 0.0]], r"env 0, robot 1 .*not finite"),
        ([POSES[0], [0.0, 0.0, 0.0]], r"env 0, robot 1 \(x=0 m, y=0 m.*in a wall of map maze_small_0"),
        ([POSES[0], [400.0, 3.0, 0.0]], r"in a wall of map maze_small_0 or outside"),
        ([[4.0, 8.0, 0.0], [4.5, 8.0, 0.0]], r"env 0, robot 0 .*collides with robot 1: move them apart"),
        ([POSES, [POSES[0], [7.0, 0.5, 0.0]]], r"env 1, robot 1 .*at least 0.75 m from obstacle points"),
    ],
)
def test_poses_that_cannot_be_are_named(maps, poses, words):
    with pytest.raises(ValueError, match=words):
        make(maps[0], starts=poses)


def test_poses_must_fit_every_map_of_the_env(maps):
    free = [{tuple(p) for p in m.free[:, :2].round(3).tolist()} for m in maps]
    x, y = min(free[0] - free[1])
    place = [[x, y, 0.0]]
    make(maps[0], robots=1, robot=RobotConfig(collision_threshold=0.1), starts=place).reset()
    with pytest.raises(ValueError, match="map maze_small_1"):
        make(maps, robots=1, robot=RobotConfig(collision_threshold=0.1), starts=place)


@pytest.mark.parametrize("collision", ["centre", "footprint"])
def test_what_is_let_through_does_not_collide_and_what_is_not_does(collision):
    """Against the kernel: teams at random poses, let through or not, then one local step without moving."""
    world = room(17, 13, "jittered")
    body = RobotConfig(length=2.4, width=0.8, collision_threshold=0.6, max_accel=1e-6)
    settings = dict(robot=body, collision=collision, macro_steps=1)
    env, rng = make(world, 1, 2, **settings), np.random.default_rng(0)
    verdicts = []
    for _ in range(300):
        place = world.free[rng.integers(len(world.free)), :2]
        shift = rng.uniform(-0.3, 0.3, 2), rng.uniform(-2.0, 2.0, 2)
        poses = np.array([[*(place + shift[0]), 0.0], [*(place + shift[1]), 0.0]])
        poses[:, 2] = rng.uniform(-3.0, 3.0, 2)
        try:
            env.set_starts(poses)
            fits = True
        except ValueError as error:
            fits = "wall" in str(error) and None  # may be off free space, without touching anything
        env.simulation.tensors["starts"].copy_(torch.from_numpy(poses).float().expand(1, 2, 3))
        td = env.reset()
        td["agents", "action", "region"] = torch.zeros(1, 2, dtype=torch.int64)
        td["agents", "action", "offset"] = torch.zeros(1, 2, 2)
        hit = bool(env.step(td)["next", "info", "collided"].any())
        assert fits is None or hit == (not fits), poses
        verdicts.append((fits, hit))
    assert min(verdicts.count((True, False)), verdicts.count((False, True))) > 20, "both verdicts are met"
    assert verdicts.count((None, True)) > 3 * verdicts.count((None, False))


def test_fixed_starts_belong_to_seed_and_map(maps):
    first, second = (
        make(maps, 8, 3, seed=5, starts="fixed"),
        make(maps[::-1], 4, 3, seed=5, starts="fixed", first_env=9),
    )
    poses: dict[str, set] = {"maze_small_0": set(), "maze_small_1": set()}
    for env in (first, second):
        env.set_episodes(torch.arange(env.num_envs)) if env is second else None
        for _ in range(3):
            env.reset()
            for e, m in enumerate(env.simulation.tensors["map_id"].tolist()):
                poses[env.maps[m].name].add(where(env)[e].tobytes())
    assert [len(p) for p in poses.values()] == [1, 1] and len(set.union(*poses.values())) == 2
    env = make(maps, 8, 2, seed=5, starts="fixed")
    env.reset()
    for e, m in enumerate(env.simulation.tensors["map_id"].tolist()):
        assert where(env)[e].tobytes() == first.simulation.map_starts[m, :2].numpy().tobytes(), "a part of the team"
    assert (first.simulation.map_starts != make(maps, 8, 3, seed=6, starts="fixed").simulation.map_starts).any()
    env.set_seed(6)
    assert not torch.equal(env.simulation.map_starts, first.simulation.map_starts[:, :2])


def test_fixed_starts_keep_clear():
    world = room(21, 17)
    env = make(world, 1, 6, starts="fixed", robot=[RobotConfig(collision_threshold=t) for t in (0.5, 0.9) * 3])
    env.reset()
    at, need = where(env)[0, :, :2], 3 * np.array([0.5, 0.9] * 3)
    walls = np.linalg.norm(at[:, None] - world.boundary[:, :2], axis=-1).min(1)
    gap = np.linalg.norm(at[:, None] - at, axis=-1) + 99 * np.eye(6)
    assert (walls >= need - 1e-5).all() and (gap >= np.maximum(need[:, None], need) - 1e-5).all()
    crowd = SimpleNamespace(maps=[world], robot_configs=[RobotConfig(collision_threshold=0.9)] * 99)
    with pytest.raises(MapError, match=r"room for \d+ of num_robots=99 robots at fixed starts"):
        fixed_starts(crowd, 0)


@pytest.mark.parametrize("suffix, header", [("csv", ""), ("csv", "x,y,heading\n"), ("npy", "")])
def test_a_file_of_starts(tmp_path, monkeypatch, suffix, header):
    rows = [*POSES, [20.0, 20.0, 0.0]]
    path = tmp_path / f"my starts.{suffix}"
    if suffix == "npy":
        np.save(path, np.array(rows))
    else:
        path.write_text(header + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    monkeypatch.chdir(tmp_path)
    words = make_overrides("evaluate", ["scenario=maze_small", f"scenario.starts={path.name}", "device=cpu"])
    monkeypatch.chdir("/")
    cfg = compose_settings("evaluate", words)
    env = make_env(cfg, [make_map("maze_small", 0)], 2, 3)
    env.reset()
    np.testing.assert_allclose(where(env), np.broadcast_to(POSES, (3, 2, 3)), atol=1e-6)
    with pytest.raises(ValueError, match="holds 3 x 3 numbers: 4 robots need 4 rows"):
        make_env(cfg, [make_map("maze_small", 0)], 4, 3)


def test_files_that_are_none(tmp_path):
    for name, content in (("a.npy", b"none"), ("b.csv", b"\xff\xfe\x00"), ("c.csv", b"1,2,3\n1,2\n"), ("d.csv", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"scenario.starts=.*{name}"):
            read_starts(tmp_path / name, 1)
    with pytest.raises(ValueError, match="scenario.starts=nowhere.csv cannot be read"):
        read_starts("nowhere.csv", 1)


def test_the_setting_takes_drawn_and_fixed():
    for word, fixed in (("drawn", False), ("fixed", True)):
        cfg = compose_settings("train", make_overrides("train", [f"scenario.starts={word}", "device=cpu"]))
        env = make_env(cfg, [make_map("maze_small", 0)], 2, 2)
        assert bool(env.simulation.map_starts.isfinite().all()) == fixed
