"""ExplorationEnv: the contract of docs/concepts.md."""

import warnings

import numpy as np
import pytest
import torch
from episodes import actions, play, step
from oracle.metrics import mean_coverage
from torchrl.envs.utils import check_env_specs, step_mdp

from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    MapError,
    ObservationConfig,
    PlannerConfig,
    PointCloudMap,
    RadarConfig,
    RewardConfig,
    RobotConfig,
    make_map,
)
from maexp.envs.maps.nav_grid import stands_free
from maexp.envs.settings import complete_settings
from maexp.envs.specs import INFO_ENV, INFO_ROBOT, REWARD_TERMS
from maexp.kernels.types import PICTURE_CHANNELS


@pytest.mark.parametrize("robots", [1, 3])
def test_specs(maps, robots):
    check_env_specs(ExplorationEnv(maps, num_envs=2, num_robots=robots))


def test_specs_direct_planner(maps):
    env = ExplorationEnv(maps[0], num_envs=2, planner=PlannerConfig(name="direct"))
    check_env_specs(env)
    assert env.rollout(2)["agents", "action", "control"].shape == (2, 2, 3, 2)


def test_keys_shapes_and_types(maps):
    td = ExplorationEnv(maps, num_envs=5, num_robots=2).rollout(3)
    expected = {
        ("agents", "observation", "map"): ((5, 3, 2, PICTURE_CHANNELS, 125, 125), torch.uint8),
        ("team", "map"): ((5, 3, 3, 125, 125), torch.uint8),
        ("agents", "observation", "pose"): ((5, 3, 2, 4), torch.float32),
        ("agents", "observation", "grid"): ((5, 3, 2, 4, 8, 8), torch.float32),
        ("agents", "observation", "comm"): ((5, 3, 2, 2), torch.bool),
        ("agents", "observation", "time_left"): ((5, 3, 2, 1), torch.float32),
        ("agents", "observation", "alive"): ((5, 3, 2), torch.bool),
        ("agents", "action", "region"): ((5, 3, 2), torch.int64),
        ("agents", "action", "offset"): ((5, 3, 2, 2), torch.float32),
        ("next", "agents", "reward"): ((5, 3, 2, 1), torch.float32),
        ("next", "done"): ((5, 3, 1), torch.bool),
        ("next", "terminated"): ((5, 3, 1), torch.bool),
        ("next", "truncated"): ((5, 3, 1), torch.bool),
    }
    expected |= {("next", "info", n): ((5, 3, 1), t) for n, t in INFO_ENV.items()}
    expected |= {("next", "info", n): ((5, 3, 2), t) for n, t in INFO_ROBOT.items()}
    for key, (shape, dtype) in expected.items():
        assert tuple(td[key].shape) == shape and td[key].dtype == dtype, key


def test_info_is_blank_after_reset(maps):
    td = ExplorationEnv(maps, num_envs=3).reset()
    for name in INFO_ENV | INFO_ROBOT:
        want = -1 if name.startswith("coverage_step") else 0
        assert (td["info", name] == want).all(), name


def test_history_is_not_aliased(maps):
    env = ExplorationEnv(maps[0], num_envs=2)
    td = env.rollout(4)
    for key in ("map", "pose", "grid", "time_left", "alive"):
        now, then = td["agents", "observation", key], td["next", "agents", "observation", key]
        assert torch.equal(now[:, 1:], then[:, :-1]), key
        assert key == "alive" or not torch.equal(now[:, 0], now[:, 1]), key
    assert not torch.equal(td["next", "agents", "reward"][:, 0], td["next", "agents", "reward"][:, 1])


def test_rewards_are_the_sum_of_their_terms_and_coverage_grows(maps):
    out = play(ExplorationEnv(maps, num_envs=4, macro_steps=8), actions(4, 3, 8))
    before = torch.zeros(4, 1)
    for td in out:
        info = td["next", "info"]
        total = sum(info[f"reward_{term}"] for term in REWARD_TERMS)
        torch.testing.assert_close(td["next", "agents", "reward"][..., 0], total)
        assert (info["coverage"] >= before).all() and (info["coverage"] <= 1).all()
        before = info["coverage"]
        assert all(torch.isfinite(v.float()).all() for v in td.values(True, True))


def test_time_left_falls_from_one_to_zero_and_partial_resets_give_it_back(maps):
    env = ExplorationEnv(maps[0], num_envs=3, num_robots=2, local_steps=4, macro_steps=4)
    left, td = ("agents", "observation", "time_left"), env.reset()
    assert (td[left] == 1.0).all()
    for want in (0.75, 0.5):
        td = env.step(env.rand_action(td))["next"]
        assert (td[left] == want).all()
    td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False]])))
    assert td[left][:, 0, 0].tolist() == [0.5, 1.0, 0.5]
    for want in ([0.25, 0.75, 0.25], [0.0, 0.5, 0.0], [0.0, 0.25, 0.0]):
        td = env.step(env.rand_action(td))["next"]
        assert td[left][:, 1, 0].tolist() == want
    assert td["truncated"][:, 0].tolist() == [True, False, True]


def test_alive_robots_are_those_that_have_not_collided(maps):
    env = ExplorationEnv(maps[0], num_envs=4, planner=PlannerConfig(name="direct"))
    alive, td = ("agents", "observation", "alive"), env.reset()
    assert td[alive].all()
    mixed = False
    for _ in range(3):
        td["agents", "action", "control"] = torch.tensor([1.0, 0.0]).expand(4, 3, 2).clone()
        td = env.step(td)["next"]
        assert torch.equal(td[alive], ~td["info", "collided"])
        mixed |= bool((td[alive].any(-1) & ~td[alive].all(-1)).any())
    assert mixed, "no team of which some robots had collided was looked at"
    before = td[alive].clone()
    td = env.reset(td.set("_reset", torch.tensor([[True], [False], [True], [False]])))
    assert td[alive][[0, 2]].all() and torch.equal(td[alive][[1, 3]], before[[1, 3]])
    assert not before[[1, 3]].all()


def test_truncation_apart_from_termination(maps):
    env = ExplorationEnv(maps[0], num_envs=2, macro_steps=2)
    td = env.rollout(2, break_when_any_done=False)
    assert td["next", "truncated"][:, 1].all() and not td["next", "terminated"].any()
    assert not td["next", "done"][:, 0].any()


def test_success_terminates_once_and_the_rest_of_the_macro_step_is_frozen():
    env = ExplorationEnv(
        open_room(15.0),
        num_envs=4,
        num_robots=2,
        radar=RadarConfig(range=7.0),
        local_steps=30,
        robot=RobotConfig(collision_threshold=0.2),
        macro_steps=40,
    )
    torch.manual_seed(0)
    td = env.reset()
    for _ in range(40):
        td = env.rand_action(td)
        td = env.step(td)["next"]
        done = (td["info", "coverage"] >= 0.95)[:, 0]
        assert not (done & ~td["terminated"][:, 0]).any()
        if done.any():
            break
    assert done.any(), "no team explored an open room in 40 macro steps"
    i = int(done.int().argmax())
    torch.testing.assert_close(td["info", "reward_success"][i], torch.full((2,), 100.0 * 60.0 / 7000.0))
    assert td["info", "local_steps"][i] == td["info", "coverage_step_95"][i]
    assert not td["truncated"][i]


def test_an_episode_that_goes_on_to_99_percent_pays_for_it_there():
    """The marks come one after another; the reward of success comes with the end, not at 95 %."""
    env = ExplorationEnv(
        open_room(15.0),
        num_envs=6,
        num_robots=2,
        radar=RadarConfig(range=7.0),
        local_steps=4,
        robot=RobotConfig(collision_threshold=0.2),
        macro_steps=200,
        success_coverage=0.99,
    )
    torch.manual_seed(0)
    td, paid, passed = env.reset(), torch.zeros(6, 2), torch.zeros(6, dtype=torch.bool)
    for _ in range(200):
        td = env.step(env.rand_action(td))["next"]
        paid += td["info", "reward_success"]
        passed |= (td["info", "coverage_step_95"] > 0).squeeze(-1) & ~td["done"].squeeze(-1)
        assert not paid[~td["terminated"].squeeze(-1)].any(), "paid before the end"
        if td["done"].all():
            break
    info = td["info"]
    done = (info["coverage"] >= 0.99).squeeze(-1)
    assert (done & passed).any(), "nobody went on from 95 to 99 %"
    torch.testing.assert_close(paid[done], torch.full((int(done.sum()), 2), 100.0 * 60.0 / 7000.0))
    steps = torch.cat([info[f"coverage_step_{mark}"] for mark in (85, 95, 99)], dim=1)[done & passed]
    assert (steps.diff(dim=1) >= 0).all() and (steps[:, 1] < steps[:, 2]).all()
    assert torch.equal(info["coverage_step_99"][done], info["local_steps"][done])
    assert torch.equal(info["path_length_99"][done], info["path_length"][done])
    assert (info["coverage_step_99"][~done] == -1).all()


@pytest.mark.parametrize("every", [None, 7])
def test_mean_coverage_over_the_full_episode(every):
    """Some teams are done within a macro step, and points of a map have several weights; with and without a hook."""
    maps = [open_room(9.0), make_map("random_obstacles_adaptive", 0)]
    env, watched = (
        ExplorationEnv(
            maps,
            num_envs=6,
            num_robots=2,
            radar=RadarConfig(range=5.0),
            local_steps=10,
            robot=RobotConfig(collision_threshold=0.2),
            macro_steps=12,
            seed=3,
        )
        for _ in range(2)
    )
    lines = [[] for _ in range(6)]

    def look(env) -> None:
        state, totals = env.simulation.tensors, env.simulation.map_tensors["total_weight"]
        for e, line in enumerate(lines):
            if len(line) == int(state["local_step"][e]):  # a team that is done stands still
                line.append(int(state["covered"][e]) / int(totals[state["map_id"][e]]))

    watched.set_step_hook(look)
    if every is not None:
        env.set_step_hook(lambda env: None, every=every)
    td, other, final = env.reset(), watched.reset(), torch.zeros(6)
    for action in actions(6, 2, 12):
        running = ~td["done"][:, 0]
        td, other = step(env, td, action), step(watched, other, action)
        final = torch.where(running, td["info", "coverage_auc"][:, 0], final)
    want = [mean_coverage(line, 120) for line in lines]
    torch.testing.assert_close(final, torch.tensor(want), atol=1e-6, rtol=0)
    assert torch.equal(td["info", "coverage_auc"], other["info", "coverage_auc"])
    assert min(len(line) for line in lines) < 120, "no team was done early"
    assert any((len(line) - 1) % 10 for line in lines), "no team was done within a macro step"


def open_room(side: float) -> PointCloudMap:
    ticks = np.arange(0.0, side + 2.0)
    x, y = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    wall = (x == 0) | (y == 0) | (x == side + 1) | (y == side + 1)
    points = np.stack([x, y, 0 * x], axis=1).astype(np.float32)
    return PointCloudMap(points[~wall], points[wall], 1.0, name="room", scenario="maze_small")


def test_collided_robots_stay_and_pay_once():
    env = ExplorationEnv(
        open_room(20.0),
        num_envs=8,
        num_robots=2,
        planner=PlannerConfig(name="direct"),
        radar=RadarConfig(range=4.0),
        macro_steps=20,
    )
    td = env.reset()
    td["agents", "action", "control"] = torch.tensor([1.0, 0.0]).expand(8, 2, 2).clone()
    paid = torch.zeros(8, 2)
    stopped = None
    for _ in range(4):
        out = env.step(td.clone())
        paid += out["next", "info", "reward_collision"]
        hit = out["next", "info", "collided"]
        if stopped is not None:
            was, poses = stopped
            assert torch.equal(poses[was], env.simulation.tensors["pose"][was])
        stopped = hit.clone(), env.simulation.tensors["pose"].clone()
        td = step_mdp(out)
        td["agents", "action", "control"] = torch.tensor([1.0, 0.0]).expand(8, 2, 2).clone()
    assert hit.any()
    assert (env.simulation.tensors["pose"][..., 2][hit] == 0).all()
    torch.testing.assert_close(paid, hit.float() * -200.0 * 60.0 / 7000.0)


def test_bad_actions(maps):
    env = ExplorationEnv(maps[0], num_envs=3)
    td = env.reset()
    td["agents", "action", "region"] = torch.full((3, 3), 63)
    td["agents", "action", "offset"] = torch.full((3, 3, 2), 7.0)
    env.step(td.clone())
    (_, _), upper = maps[0].extent
    assert torch.allclose(env.simulation.tensors["goal"], torch.tensor(upper)), "out of bounds is clamped"
    td["agents", "action", "offset"][1, 0, 1] = float("nan")
    with pytest.raises(ValueError, match="env 1 is NaN"):
        env.step(td)


@pytest.mark.parametrize(
    "settings, words",
    [
        (dict(num_robots=0), "num_robots=0"),
        (dict(num_envs=2.5), "num_envs=2.5"),
        (dict(collision="soft"), "collision='soft'"),
        (dict(success_coverage=0.0), "success_coverage=0.0"),
        (dict(radar=RadarConfig(range=-1.0)), "radar.range=-1.0"),
        (dict(robot=RobotConfig(kind="tank")), "robot.kind='tank'"),
        (dict(robot=[RobotConfig()] * 2), "num_robots=3"),
        (dict(planner="dwa"), "planner=.dwa.: give a PlannerConfig"),
        (dict(planner=PlannerConfig(name="teleport")), "planner.name='teleport'"),
        (dict(reward=RewardConfig(success=float("nan"))), "reward.success=nan"),
        (dict(observation=ObservationConfig(map="all")), "observation.map='all'"),
        (dict(comm=CommConfig(range=-1.0)), "comm.range=-1.0"),
        (dict(comm=CommConfig(range=float("nan"))), "comm.range=nan"),
        (dict(comm=CommConfig(signal="yes")), "comm.signal='yes' must be true or false"),
        (dict(comm=CommConfig(signal=True, cell=0.0)), "comm.cell=0.0"),
        (dict(comm=CommConfig(signal=True, noise=-1.0)), "comm.noise=-1.0"),
        (dict(comm=CommConfig(signal=True, threshold=-40.0)), "comm.threshold=-40 dBm is out of reach"),
        (dict(comm=CommConfig(loss=1.5)), "comm.loss=1.5 must be a number from 0 to 1"),
        (dict(comm=CommConfig(base_station="home")), "comm.base_station='home'"),
        (dict(comm=CommConfig(base_station=(1.0, 2.0, 3.0))), "comm.base_station="),
        (dict(comm=CommConfig(base_station=(-900.0, 0.0))), "-900.0, 0.0. is no free ground of map maze"),
        (dict(comm=CommConfig(base_station=(1e300, 0.0))), r"\[1e.300, 0.0\] is no free ground of map maze"),
        (
            dict(comm=CommConfig(base_station=[10**400, 0])),
            r"comm.base_station=\[1e.400, 0\] must be true .* or a place",
        ),
        (dict(comm=CommConfig(base_station=[True, True])), r"comm.base_station=\[True, True\] must be true"),
        (dict(comm=CommConfig(base_station=np.array([1.0]))), r"comm.base_station=array\(\[1.\]\) must be true"),
        (dict(comm=CommConfig(base_station=(np.nan, 1.0))), r"comm.base_station=\(nan, 1.0\) must be true"),
        (dict(done="base"), "done='base' needs a base station"),
        (dict(done="nobody"), "done='nobody' must be one of union"),
        (dict(num_envs=10**7), "lower num_envs"),
        (dict(maps=[]), "maps=\\[\\]"),
        (dict(maps=["maze"]), "maze"),
        (dict(seed="x"), "seed='x'"),
        (dict(macro_steps=0), "macro_steps=0"),
        (dict(num_robots=10**9), "num_robots=1000000000"),
    ],
)
def test_bad_settings_are_named(maps, settings, words):
    with pytest.raises(ValueError, match=words):
        ExplorationEnv(**{"maps": maps[0], **settings})


def test_a_base_in_a_wall_is_refused(maps):
    x, y = maps[0].obstacles[len(maps[0].obstacles) // 2, :2].tolist()
    with pytest.raises(ValueError, match="comm.base_station=.* is no free ground of map"):
        ExplorationEnv(maps[0], comm=CommConfig(base_station=(x, y)))


def test_a_place_far_from_a_map_is_outside_of_it(maps):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of numbers that no whole number holds
        assert not stands_free(maps[0], (1e300, 0.0)) and not stands_free(maps[0], (0.0, -1e300))


def test_an_env_is_made_of_its_settings(maps):
    team = [RobotConfig(), RobotConfig(kind="differential"), RobotConfig(max_speed=1.0)]
    env = ExplorationEnv(maps[0], 2, robot=team)
    again = ExplorationEnv(maps[0], **vars(env.settings))
    assert again.settings == env.settings == complete_settings(env.settings, env.maps)
    assert env.settings.local_steps == env.scenario.decision_steps() and len(env.settings.radar) == 3
    with pytest.raises(TypeError, match="num_robot"):
        ExplorationEnv(maps[0], num_robot=3)


def test_no_room_for_the_team():
    with pytest.raises(MapError, match="num_robots=40"):
        ExplorationEnv(open_room(9.0), num_robots=40)


def test_limited_communication(maps):
    env = ExplorationEnv(
        maps[0], num_envs=2, num_robots=3, comm=CommConfig(range=1.0), observation=ObservationConfig(map="known")
    )
    full = ExplorationEnv(maps[0], num_envs=2, num_robots=3, observation=ObservationConfig(map="known"))
    a, b = env.rollout(3), full.rollout(3)
    eye = torch.eye(3, dtype=torch.bool)
    assert torch.equal(a["agents", "observation", "comm"], eye.expand(2, 3, 3, 3))
    assert b["agents", "observation", "comm"].all()
    explored = b["agents", "observation", "map"][:, :, :, 0]
    assert torch.equal(explored[:, :, 0], explored[:, :, 2])
    assert torch.equal(explored[:, :, 0], b["team", "map"][:, :, 0])
    assert not (a["agents", "observation", "map"][:, :, :, 2] == 128).any(), "an unheard robot must not be drawn"
    assert (b["agents", "observation", "map"][:, :, :, 2] == 128).any()
    alone = a["agents", "observation", "map"][:, :, :, 0]
    assert not torch.equal(alone[:, :, 0], alone[:, :, 2])


@pytest.mark.parametrize("radius", [0.0, "auto"])
def test_walls_block_what_must_be_in_sight(radius):
    env = ExplorationEnv(
        make_map("maze", 0),
        num_envs=16,
        num_robots=3,
        comm=CommConfig(line_of_sight=True),
        radar=RadarConfig(obstacle_radius=radius),
        local_steps=1,
    )
    comm = env.reset()["agents", "observation", "comm"]
    assert comm.diagonal(dim1=1, dim2=2).all() and torch.equal(comm, comm.transpose(1, 2))
    apart = comm.sum() - 16 * 3
    assert apart < 16, "robots at random places of a maze hardly ever see each other"


@pytest.mark.parametrize("robots", [1, 40])
def test_team_sizes(robots):
    env = ExplorationEnv(make_map("maze", 0), num_envs=2, num_robots=robots, local_steps=3)
    td = env.rollout(2)
    assert td["next", "agents", "reward"].shape == (2, 2, robots, 1)
    viewers = td["team", "map"][:, -1, 2]
    seen = (td["agents", "observation", "map"][:, -1, :, 0] > 0).sum(1)
    assert torch.equal(viewers.long(), seen.long()), "every pixel of a maze shows at most one free point"


def test_heterogeneous_team(maps):
    kinds = ["ackermann", "differential", "omnidirectional"]
    team = [RobotConfig(kind=k, max_speed=2.0 + i) for i, k in enumerate(kinds)]
    radars = [RadarConfig(range=4.0), RadarConfig(range=8.0), RadarConfig(range=6.0, fov=1.5)]
    env = ExplorationEnv(maps[0], num_envs=3, robot=team, radar=radars)
    td = env.rollout(4)
    assert (td["next", "info", "path_length"][:, -1] > 0).any(0).all()
    shot = env.snapshot(0)
    for i, radar in enumerate(radars):
        far = np.linalg.norm(shot["map"].free[shot["visible"][i], :2] - shot["center"][i], axis=1)
        assert far.max() <= radar.range + 1e-3


def test_snapshot_agrees_with_the_observation(maps):
    env = ExplorationEnv(maps, num_envs=2, num_robots=2, seed=1)
    td = env.rollout(3)
    for e in range(2):
        shot = env.snapshot(e)
        coverage = shot["seen_free"].any(0).mean()
        assert coverage == pytest.approx(td["next", "info", "coverage"][e, -1, 0].item(), abs=1e-6)
        assert shot["coverage"] == pytest.approx(coverage)
        for i in range(2):  # what is visible now lies in range and has been seen
            points = shot["map"].free[shot["visible"][i], :2]
            assert (np.linalg.norm(points - shot["center"][i], axis=1) <= 10.0 + 1e-4).all()
            assert (shot["seen_free"][i] | ~shot["visible"][i]).all()
        assert shot["trail"].shape[1:] == (2, 2) and len(shot["trail"]) == shot["local_step"] + 1


def test_step_hook_sees_every_local_step(maps):
    env = ExplorationEnv(maps[0], num_envs=1, local_steps=10)
    seen = []
    env.set_step_hook(lambda e: seen.append(int(e.simulation.tensors["local_step"][0])), every=4)
    env.rollout(2)
    assert seen == [0, 4, 8, 10, 14, 18, 20]
    env.set_step_hook(None)
    env.rollout(1)
    assert len(seen) == 7


def test_an_open_field_without_obstacles():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0), indexing="ij")
    free = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    field = PointCloudMap(free, np.zeros((0, 3)), 1.0, name="field")
    for planner in ("dwa", "wavefront"):
        env = ExplorationEnv([field], num_envs=2, local_steps=5, planner=PlannerConfig(name=planner))
        td = env.rollout(2)
        assert bool((td["next", "info", "coverage"] > 0).all())
        assert not bool(td["next", "agents", "observation", "map"][..., 1, :, :].any())
