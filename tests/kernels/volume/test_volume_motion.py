"""Flying in volumes: limits at every step, known free ground, stopping, collisions, and where ways end."""

import numpy as np
import pytest
import torch
from oracle import volume_motion
from voxel_worlds import grid, map_of, place, run, volume_env

from maexp.envs import CommConfig, RadarConfig, RobotConfig
from maexp.envs.volume.map import VoxelMap
from maexp.kernels.constants import DT
from maexp.kernels.volume.motion import SLACK, _detect_collisions

pytestmark = pytest.mark.kernels

KINDS = [RobotConfig(max_speed=2.0), RobotConfig(max_speed=1.0, max_accel=1.5, max_yaw_rate=0.8)]


def fly(env, decisions: int, steps: int, rng):
    """Fly to random goals, in the map and beyond, and give what holds before and after every local step."""
    s, sim = env.simulation.tensors, env.simulation
    names = ("center", "velocity", "pose", "collided", "path_length")
    for _ in range(decisions):
        for e in range(s["center"].shape[0]):
            m = map_of(env, e)
            low, high = (np.array(corner) for corner in m.extent)
            goals = rng.uniform(low - 0.5, high + 0.5, (s["center"].shape[1], 3))
            s["wanted"][e, :, :3] = torch.from_numpy(goals)
            s["wanted"][e, :, 3] = torch.from_numpy(rng.uniform(-3.0, 3.0, len(goals)))
        sim.set_goals()
        for k in range(steps):
            before = {name: s[name].double().numpy().copy() for name in names}
            sim.step(k, 1)
            yield before, {name: s[name].double().numpy().copy() for name in names}


@pytest.mark.parametrize("limited", [False, True])
def test_limits_hold_and_no_robot_leaves_known_ground(limited):
    comm = CommConfig(range=2.0) if limited else CommConfig()
    radars = [RadarConfig(range=2.5), RadarConfig(range=2.5, fov=2.0)]
    env = volume_env(3, 2, robot=KINDS, comm=comm, radar=radars, macro_steps=50)
    robots, rng, far = env.robot_configs, np.random.default_rng(0), 0.0
    for before, after in fly(env, 6, 15, rng):
        for e in range(3):
            m = map_of(env, e)
            known = [grid(env, "known_free", e, r) for r in range(2 if limited else 1)]
            for i, robot in enumerate(robots):
                hit = after["collided"][e, i] != 0
                old, new = before["velocity"][e, i], after["velocity"][e, i]
                assert np.linalg.norm(new) <= robot.max_speed + 1e-5
                assert hit or np.linalg.norm(new - old) <= robot.max_accel * DT + 1e-5
                turn = volume_motion.turned(before["pose"][e, i, 3], after["pose"][e, i, 3])
                assert turn <= robot.max_yaw_rate * DT + 1e-5
                step = after["center"][e, i] - before["center"][e, i]
                assert hit or np.allclose(step, 0.5 * DT * (old + new), atol=1e-5)
                way = after["path_length"][e, i] - before["path_length"][e, i]
                assert way == pytest.approx(np.linalg.norm(step), abs=1e-5)
                points = volume_motion.stopping_points(after["center"][e, i], new, robot.max_accel, DT)
                index = np.floor((points - m.origin) / m.resolution).astype(int)
                assert known[i if limited else 0][tuple(index.T)].all(), (e, i)
                far = max(far, np.linalg.norm(new))
    assert far > 1.0  # they do fly


def test_no_robot_touches_a_wall():
    env = volume_env(4, 3, radar=RadarConfig(range=2.5), macro_steps=100)
    rng = np.random.default_rng(1)
    for before, after in fly(env, 12, 15, rng):
        for e, i in np.argwhere((after["collided"] != 0) & (before["collided"] == 0)):
            gaps = np.linalg.norm(after["center"][e] - after["center"][e, i], axis=1)
            assert (np.delete(gaps, i) < env.robot_configs[i].collision_threshold).any(), "a wall"


def test_collisions():
    env = volume_env(4, 5)
    s, rng = env.simulation.tensors, np.random.default_rng(3)
    thresholds = [robot.collision_threshold for robot in env.robot_configs]
    hits = 0
    for _ in range(6):
        place(env, rng, spread=1.5)
        s["collided"].zero_()
        s["velocity"].fill_(1.0)
        s["collided"][0, 1] = 1
        run(env, lambda launch, shard: shard.call(launch, _detect_collisions))
        assert s["collided"][0, 1] == 1 and s["crashed"][0, 1] == 0
        for e in range(4):
            m = map_of(env, e)
            points = (s["center"][e].double().numpy() - m.origin) / m.resolution
            for i in range(5):
                if (e, i) == (0, 1):
                    continue
                hit, margin = volume_motion.collides(m.free, m.occupied, points, i, thresholds, m.resolution, SLACK)
                if margin > 1e-5:
                    assert bool(s["crashed"][e, i]) == bool(s["collided"][e, i]) == hit
                    assert bool(s["velocity"][e, i].any()) != hit
                    hits += hit
    assert 20 < hits < 100


def test_robots_get_where_they_are_sent():
    """To a goal in room that they know; one that is lost, or has failed, stays."""
    free = np.zeros((27, 18, 14), dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    free[13, 1:12] = False
    m = VoxelMap(free, ~free, 0.25, (2.0, 3.0, -1.0), name="corner", scenario="cave")
    env = volume_env(1, 3, maps=[m], radar=RadarConfig(range=1.0), macro_steps=100)
    s, sim = env.simulation.tensors, env.simulation
    s["known_free"][0, 0] = torch.from_numpy(env.bank.columns("free"))
    s["known_surface"][0, 0] = torch.from_numpy(env.bank.columns("occupied"))
    sim.stale.fill_(True)
    s["center"][0] = torch.tensor([[5.0, 6.0, 3.0], [20.0, 4.0, 9.0], [24.0, 15.0, 4.0]]) * 0.25 + torch.tensor(
        m.origin
    )
    goals = torch.tensor([[21.3, 5.2, 8.4], [9.1, 14.0, 3.2], [9.1, 14.0, 6.2]]) * 0.25 + torch.tensor(m.origin)
    s["wanted"][0, :, :3] = goals
    s["wanted"][0, :, 3] = torch.tensor([1.0, -2.0, float("nan")])
    s["collided"][0, 2] = 1
    lost = s["center"][0, 2].clone()
    sim.set_goals()
    sim.step(0, 150)
    assert (s["center"][0, :2] - goals[:2]).norm(dim=-1).max() < 0.05
    assert torch.equal(s["center"][0, 2], lost) and not s["collided"][0, :2].any()


@pytest.mark.parametrize("axis", range(3))
def test_goals_beyond_the_box_end_ways_inside(axis):
    """The last cell may reach over the edge of the box."""
    free = np.zeros((11, 15, 19), dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    m = VoxelMap(free, ~free, 0.125, name="box", scenario="cave")
    env = volume_env(1, 1, maps=[m], robot=RobotConfig(radius=0.1), radar=RadarConfig(range=2.0))
    assert env.bank.side == 4
    s, sim = env.simulation.tensors, env.simulation
    s["known_free"][0, 0] = torch.from_numpy(env.bank.columns("free"))
    sim.stale.fill_(True)
    goal = torch.tensor([0.5, 0.5, 0.5])
    goal[axis] = 0.125 * m.shape[axis] + 0.06
    s["wanted"][0, 0] = torch.tensor([*goal.tolist(), 0.0])
    sim.set_goals()
    last = s["way"][0, 0, int(s["way_count"][0, 0]) - 1].numpy()
    assert grid(env, "room", 0, 0)[tuple(np.floor(last / 0.125).astype(int))], last
