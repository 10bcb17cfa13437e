"""Laws of the whole local step: order of robots, place in the world, masked reset, frozen envs, starts."""

import math

import numpy as np
import pytest
import torch
from oracle import motion, radar
from worlds import act, inputs, room, turned

from maexp.envs import CommConfig, ExplorationEnv, PlannerConfig, PointCloudMap, RadarConfig, RobotConfig
from maexp.kernels import unpack_flags
from maexp.kernels.state import STATE

pytestmark = pytest.mark.kernels

BODY = {"length": 0.6, "width": 0.4, "max_speed": 3.0, "max_accel": 4.0, "max_steer": 1.0, "collision_threshold": 0.3}


def team_env(maps, envs: int, robots: int, order=None, **settings) -> ExplorationEnv:
    """Robots of three kinds with ranges of their own, in the given order."""
    kinds = ("ackermann", "differential", "omnidirectional")
    order = list(range(robots)) if order is None else order
    bodies = [RobotConfig(kind=kinds[i % 3], **BODY | {"length": 0.6 + 0.01 * i}) for i in order]
    sensors = [RadarConfig(range=3.0 + 0.05 * i, fov=2.0 if i % 5 == 4 else 2.0 * math.pi) for i in order]
    defaults = {
        "planner": PlannerConfig(name="dwa", num_steering=5, clearance_factor=3.0),
        "local_steps": 3,
        "macro_steps": 50,
        "num_threads": 1,
    }
    return ExplorationEnv(
        maps,
        envs,
        robots,
        seed=3,
        robot=bodies,
        radar=sensors,
        success_coverage=1.0,
        **defaults | settings,
    )


def place(env: ExplorationEnv, pose: torch.Tensor, target: torch.Tensor) -> None:
    """Put the teams at `pose` [E, N, 4] with nothing seen yet, and send them to `target` [E, N, 2]."""
    env.reset()
    s = env.simulation.tensors
    s["pose"].copy_(pose)
    offset = env.simulation.robot_tensors["center_offset"]
    s["center"][..., 0] = pose[..., 0] + offset * torch.cos(pose[..., 3])
    s["center"][..., 1] = pose[..., 1] + offset * torch.sin(pose[..., 3])
    for name in (
        "seen_free",
        "seen_boundary",
        "known_free",
        "known_boundary",
        "covered",
        "covered_before",
        "shared",
        "viewers_free",
        "viewers_boundary",
    ):
        s[name].zero_()
    s["goal"].copy_(target)
    s["waypoint"].copy_(target)


PER_ROBOT = (
    "pose",
    "control",
    "collided",
    "crashed",
    "discovered",
    "overlap",
    "terms",
    "seen_free",
    "seen_boundary",
    "known_free",
    "known_boundary",
    "visible",
    "path_length",
)


@pytest.mark.parametrize("robots", [1, 3, 40])
@pytest.mark.parametrize("limited", [False, True])
def test_permuting_robots_permutes_results(robots, limited):
    settings = {"comm": CommConfig(range=6.0), "collision": "footprint"} if limited else {}
    world = room(34, 27, "jittered", 4)
    order = np.random.default_rng(robots).permutation(robots)
    first = team_env(world, 2, robots, **settings)
    second = team_env(world, 2, robots, order, **settings)
    first.reset()
    pose = first.simulation.tensors["pose"].clone()
    pose[..., 2] = torch.rand(pose.shape[:2], generator=torch.Generator().manual_seed(1)) * 2.0 - 0.5
    target = pose[..., :2].flip(1) + 0.1
    place(first, pose, target)
    place(second, pose[:, order], target[:, order])
    for _ in range(4):
        first.simulation.step(0, 1)
        second.simulation.step(0, 1)
    for e in range(2):
        a, b = inputs(first, e), inputs(second, e)
        for name in PER_ROBOT:
            np.testing.assert_array_equal(getattr(b, name), getattr(a, name)[order], err_msg=name)
        assert a.covered == b.covered > 0 and a.shared == b.shared
        assert a.seen_free.any(1).all() and (robots < 40 or a.shared > 0)


@pytest.mark.parametrize("angle, shift", [(0.0, (120.0, -75.0)), (0.83, (0.0, 0.0)), (-2.2, (31.0, 58.0))])
@pytest.mark.parametrize("collision", ["centre", "footprint"])
def test_moving_the_world_changes_nothing_but_the_pose(angle, shift, collision):
    world = room(17, 13, "jittered", 6)
    moved = PointCloudMap(
        turned(world.free, angle, shift),
        turned(world.obstacles, angle, shift),
        world.resolution,
        boundary=turned(world.boundary, angle, shift),
    )
    here, there = (team_env(m, 5, 3, collision=collision) for m in (world, moved))
    here.reset()
    pose = here.simulation.tensors["pose"].clone()
    pose[..., 2] = 1.3
    pose2 = torch.from_numpy(turned(pose.reshape(-1, 4), angle, shift)).reshape(pose.shape)
    pose2[..., 3] += angle
    target = pose[..., :2].flip(1) + torch.tensor([0.31, -0.17])
    target2 = torch.from_numpy(turned(target.reshape(-1, 2), angle, shift)).reshape(target.shape)
    place(here, pose, target)
    place(there, pose2.float(), target2.float())
    for _ in range(3):
        here.simulation.step(0, 1)
        there.simulation.step(0, 1)
    for e in range(5):
        a, b = inputs(here, e), inputs(there, e)
        np.testing.assert_allclose(turned(a.center, angle, shift), b.center, atol=2e-4)
        np.testing.assert_allclose(a.control, b.control, atol=1e-6)
        np.testing.assert_allclose(a.pose[:, 2], b.pose[:, 2], atol=1e-5)
        for was, now in zip(a.pose, b.pose, strict=True):
            assert abs(radar.wrap(float(now[3]) - float(was[3]) - angle)) < 1e-4
        np.testing.assert_array_equal(a.collided, b.collided)
        assert (a.visible != b.visible).sum() <= 1 and (a.seen_free != b.seen_free).sum() <= 2
        np.testing.assert_allclose(a.terms, b.terms, atol=2e-3)


@pytest.mark.parametrize("limited", [False, True])
def test_masked_reset_leaves_other_envs_alone(limited):
    comm = CommConfig(range=5.0) if limited else None
    env = team_env([room(13, 11, "jittered", 1), room(17, 15, "mixed", 2)], 5, 3, comm=comm)
    generator = torch.Generator().manual_seed(2)
    env.reset()
    for _ in range(3):
        env.step(act(env, generator))
    before = env.state_dict()
    mask = torch.tensor([[False], [True], [False], [True], [False]])
    td = act(env, generator).set("_reset", mask)
    env.reset(td)
    after = env.state_dict()
    kept = ~mask[:, 0]
    for name in STATE:
        if before[name].shape[:1] == (5,):
            assert torch.equal(before[name][kept], after[name][kept]), name
    for name in ("pose", "seen_free", "covered", "local_step", "episode"):
        for e in (1, 3):
            assert not torch.equal(before[name][e], after[name][e]), name
    assert (after["local_step"][~kept] == 0).all() and (after["path_length"][~kept] == 0).all()
    scanned = [inputs(env, e) for e in (1, 3)]
    for now in scanned:  # of the old episode nothing is left but what the first scan saw
        np.testing.assert_array_equal(now.seen_free, now.visible)


@pytest.mark.parametrize("robots", [12, 40])
def test_viewers_are_the_robots_that_have_seen_a_point(robots):
    env = team_env(room(34, 27, "jittered", 4), 2, robots)
    env.reset()
    generator = torch.Generator().manual_seed(4)
    for _ in range(2):
        env.step(act(env, generator))
        state = env.simulation.tensors
        for what in ("free", "boundary"):
            robots_seen = unpack_flags(state[f"seen_{what}"], robots).sum(1)
            assert torch.equal(state[f"viewers_{what}"][:, 0].long(), robots_seen) and robots_seen.max() > 1


def test_an_env_that_ended_stays_frozen():
    env = team_env(room(13, 11, "jittered", 1), 3, 3, planner=PlannerConfig(name="direct"))
    env.reset()
    state = env.simulation.tensors
    state["command"].fill_(1.0)
    env.simulation.step(0, 2)
    state["active"][1] = 0
    before = env.state_dict()
    env.simulation.step(2, 4)
    after = env.state_dict()
    for name in STATE:
        if before[name].shape[:1] == (3,):
            assert torch.equal(before[name][1], after[name][1]), name
    assert (after["local_step"] - before["local_step"]).tolist() == [4, 0, 4]
    assert not torch.equal(before["pose"][0], after["pose"][0])


def test_all_collided_ends_the_episode_and_pays_once():
    wide = RobotConfig(**BODY | {"collision_threshold": 0.6})  # no gap between points 1 m apart to slip through
    planner = PlannerConfig(name="direct")
    env = ExplorationEnv(room(13, 11), 4, 2, robot=wide, radar=RadarConfig(range=3.0), planner=planner)
    env.reset()
    env.simulation.tensors["command"][..., 0] = 1.0
    for _ in range(90):
        env.simulation.step(0, 1)
    s = env.simulation.tensors
    assert (s["collided"] != 0).all() and (s["terminated"] != 0).all() and (s["active"] == 0).all()
    paid = s["unscaled"][..., 4]
    assert torch.equal(paid, torch.full_like(paid, -200.0))


@pytest.mark.parametrize("robots", [1, 3, 40])
def test_starts(robots):
    """Clear of walls and of each other by three thresholds, at rest, on free points, any heading, anew each time."""
    env = team_env([room(34, 27, "jittered", 4), room(31, 25, "rotated", 5)], 3, robots)
    headings, maps, poses = [], set(), []
    for _ in range(5):
        env.reset()
        for e in range(3):
            now = inputs(env, e)
            need = 3.0 * BODY["collision_threshold"]
            maps.add(now.map.name)
            headings += now.pose[:, 3].tolist()
            poses.append(now.pose)
            for i in range(robots):
                config = env.robot_configs[i]
                middle = motion.center(motion.rear_state(now.pose[i], config.length, config.kind), config.length)
                assert np.linalg.norm(now.map.boundary[:, :2] - middle, axis=1).min() >= need - 1e-4
                assert np.linalg.norm(now.map.free[:, :2] - middle, axis=1).min() < 1e-4
                assert now.pose[i][2] == 0.0
                others = np.delete(now.center, i, axis=0)
                assert robots == 1 or np.linalg.norm(others - middle, axis=1).min() >= need - 1e-4
    assert len(maps) == 2 and min(headings) < -1.0 and max(headings) > 1.0
    assert len({p.tobytes() for p in poses}) == len(poses)


def test_results_depend_on_neither_threads_nor_the_batch():
    maps = [room(13, 11, "jittered", 1), room(17, 15, "mixed", 2)]
    runs = []
    for envs, threads in ((5, 1), (5, 3), (2, 1)):
        env = team_env(maps, envs, 3, num_threads=threads)
        generator = torch.Generator().manual_seed(2)
        env.reset()
        for _ in range(3):
            action = torch.randint(64, (5, 3), generator=generator), torch.rand(5, 3, 2, generator=generator)
            td = act(env, torch.Generator())
            td["agents", "action", "region"], td["agents", "action", "offset"] = (a[:envs] for a in action)
            out = env.step(td)["next"]
        runs.append((env.state_dict(), out))
    for state, out in runs[1:]:
        count = state["pose"].shape[0]
        for name in STATE:
            if state[name].shape[:1] == (count,):
                assert torch.equal(state[name], runs[0][0][name][:count]), name
        assert torch.equal(out["agents", "observation", "map"], runs[0][1]["agents", "observation", "map"][:count])


def test_dwa_takes_the_first_of_equal_candidates():
    """At rest on its goal a car scores the same for every steering angle without throttle: the first wins."""
    env = ExplorationEnv(
        room(21, 21, "lattice"),
        1,
        1,
        robot=RobotConfig(**BODY),
        radar=RadarConfig(range=2.0),
        local_steps=1,
        planner=PlannerConfig(name="dwa", num_steering=5, clearance_factor=1.0),
    )
    pose = torch.tensor([[[16.0, 11.0, 0.0, 0.0]]])
    place(env, pose, pose[..., :2] + torch.tensor([0.3, 0.0]))
    env.simulation.step(0, 1)
    assert env.simulation.tensors["control"].tolist() == [[[0.0, -1.0]]]


def test_shards_may_launch_one_kernel_from_several_threads():
    """Warp's tiles in stack memory share a static pointer between threads; the debug pass crashes with them on."""
    import warp as wp

    assert wp.config.enable_tiles_in_stack_memory is False
    env = team_env(room(13, 11, "jittered", 1), 6, 2, num_threads=3, local_steps=2)
    generator = torch.Generator().manual_seed(4)
    env.reset()
    for _ in range(40):
        env.step(act(env, generator))
    assert torch.isfinite(env.simulation.tensors["pose"]).all()


@pytest.mark.parametrize("mode", ["centre", "footprint"])
def test_collisions_of_robots_close_together(mode):
    """Many crowds of three at random, near each other and near a wall, against the oracle."""
    world = room(21, 21, "jittered", 3)
    env = team_env(world, 150, 3, collision=mode, planner=PlannerConfig(name="direct"))
    generator = torch.Generator().manual_seed(6)
    pose = torch.zeros(150, 3, 4)
    pose[..., :2] = 16.0 + torch.rand(150, 3, 2, generator=generator) * 1.6
    pose[75:, :, 0] += 4.6
    pose[..., 3] = torch.rand(150, 3, generator=generator) * 6.2 - 3.1
    place(env, pose, pose[..., :2].clone())
    env.simulation.step(0, 1)
    lengths, widths = ([getattr(r, side) for r in env.robot_configs] for side in ("length", "width"))
    thresholds = [r.collision_threshold if mode == "centre" else 0.0 for r in env.robot_configs]
    close, hits = 0, 0
    for e in range(150):
        now = inputs(env, e)
        kinds = [r.kind for r in env.robot_configs]
        states = [motion.rear_state(p, n, k) for p, n, k in zip(now.pose, lengths, kinds, strict=True)]
        near = world.boundary[np.linalg.norm(world.boundary[:, :2] - now.center[0], axis=1) < 5.0]
        want, margin = motion.collided(states, lengths, widths, thresholds, near, mode=mode)
        sure = margin > 1e-5
        np.testing.assert_array_equal(now.crashed[sure] != 0, want[sure])
        hits, close = hits + want.sum(), close + (margin < 0.1).sum()
    assert 50 < hits < 400 and close > 50
