"""Who is near whom in a local step, against the distances of bodies before and after it."""

import math

import numpy as np
import pytest
import torch
from oracle import motion
from worlds import act, room

from maexp.envs import ExplorationEnv, PlannerConfig, RadarConfig, RobotConfig

pytestmark = pytest.mark.kernels

SHAPES = [  # long, turning about its rear; small and fast, so that a step counts; thresholds beyond a radar's reach
    {"kind": "ackermann", "length": 2.4, "width": 0.3, "wheelbase": 2.4, "max_speed": 9.0, "collision_threshold": 0.2},
    {"kind": "omnidirectional", "length": 0.2, "width": 0.1, "max_speed": 30.0, "collision_threshold": 0.1},
    {"kind": "differential", "length": 0.2, "width": 0.2, "max_speed": 0.1, "collision_threshold": 1.6},
    {"kind": "differential", "length": 0.2, "width": 0.1, "max_speed": 25.0, "collision_threshold": 0.1},
]
RANGES = [0.3, 4.0, 1.2]
SIDE = 12.0
"""Edge of the square that holds the team [m]."""


def crowd(robots: int) -> ExplorationEnv:
    """Two teams at random places in a square, some of them as after a collision, driven by random controls."""
    env = ExplorationEnv(
        [room(64, 60, "jittered", 1), room(61, 66, "mixed", 2)],
        2,
        robots,
        seed=robots,
        robot=[RobotConfig(max_accel=9.0, max_steer=1.2, **SHAPES[i % 4]) for i in range(robots)],
        radar=[RadarConfig(range=RANGES[i % 3], fov=2.0 * math.pi if i % 5 else 1.5) for i in range(robots)],
        planner=PlannerConfig(name="direct"),
        local_steps=1,
        macro_steps=1000,
        success_coverage=1.0,
        num_threads=1,
    )
    env.reset()
    rng, s = np.random.default_rng(robots), env.simulation.tensors
    pose = rng.uniform(0.0, 1.0, (2, robots, 4)) * SIDE + 20.0
    pose[..., 3] = rng.uniform(-math.pi, math.pi, (2, robots))
    stopped = rng.random((2, robots)) < 0.2
    top = np.array([robot.max_speed for robot in env.robot_configs])
    share = rng.uniform(-1.0, 1.0, (2, robots)) * ~stopped
    pose[..., 2] = share * top
    slides = np.array([robot.kind == "omnidirectional" for robot in env.robot_configs])
    slip = np.sqrt(1.0 - share**2) * top * rng.choice([-1.0, 1.0], (2, robots)) * slides * ~stopped
    s["pose"].copy_(torch.from_numpy(pose))
    s["slip"].copy_(torch.from_numpy(slip))
    s["collided"].copy_(torch.from_numpy(stopped))
    offset = env.simulation.robot_tensors["center_offset"]
    s["center"][..., 0] = s["pose"][..., 0] + offset * torch.cos(s["pose"][..., 3])
    s["center"][..., 1] = s["pose"][..., 1] + offset * torch.sin(s["pose"][..., 3])
    return env


def state_of(env: ExplorationEnv, e: int) -> dict[str, np.ndarray]:
    """Poses, slips and centres of a team, as float64."""
    return {name: env.simulation.tensors[name][e].double().numpy().copy() for name in ("pose", "slip", "center")}


def matters(env: ExplorationEnv, now: dict[str, np.ndarray], i: int, j: int) -> bool:
    """Whether the body of robot j is in radar range of robot i, or so near that robot i collides."""
    me, other = env.robot_configs[i], env.robot_configs[j]
    at, there = now["center"][i, :2], now["center"][j, :2]
    if np.linalg.norm(there - at) > 12.0:  # than which none of these reaches farther
        return False
    mine, rear = (
        motion.rear_state(now["pose"][k], env.robot_configs[k].length, env.robot_configs[k].kind) for k in (i, j)
    )
    if motion.point_to_body(at, rear, other.length, other.width) <= env.radar_configs[i].range:
        return True
    if np.linalg.norm(there - at) < me.collision_threshold:
        return True
    return motion.body_to_body(mine, (me.length, me.width), rear, (other.length, other.width)) == 0.0


def bound(env: ExplorationEnv, before: dict[str, np.ndarray], i: int, j: int) -> float:
    """How far apart listed robots may be: what each may take up or drive through, and the reach of robot i [m]."""

    def room_of(k: int) -> float:
        robot, way = env.robot_configs[k], 0.1 * (abs(before["pose"][k, 2]) + abs(before["slip"][k]))
        swing = 0.0
        if robot.kind == "ackermann":  # its centre lies half a length ahead of what it turns about
            swing = 0.5 * robot.length * min(2.0, 1.001 * way * math.tan(robot.max_steer) / robot.wheelbase)
        return way + swing + 0.501 * (robot.length + robot.width)

    return max(env.radar_configs[i].range, env.robot_configs[i].collision_threshold) + room_of(i) + room_of(j)


@pytest.mark.parametrize("robots", [1, 2, 3, 40, 70])
def test_near_lists_hold_all_that_matter_and_none_beyond_their_reach(robots):
    env = crowd(robots)
    generator = torch.Generator().manual_seed(robots)
    s, needed, listed = env.simulation.tensors, 0, 0
    for _ in range(3):
        before = [state_of(env, e) for e in range(2)]
        env.step(act(env, generator))
        for e in range(2):
            after = state_of(env, e)
            for i in range(robots):
                near = s["near"][e, i, : int(s["near_count"][e, i])].tolist()
                assert len(set(near)) == len(near) and i not in near and set(near) <= set(range(robots))
                gaps = np.linalg.norm(before[e]["center"][:, :2] - before[e]["center"][i, :2], axis=1)
                for j in set(range(robots)) - {i}:
                    if j in near:
                        assert gaps[j] <= 1.0001 * bound(env, before[e], i, j)
                    needs = matters(env, before[e], i, j) or matters(env, after, i, j)
                    assert j in near or not needs, (e, i, j)
                    needed += needs
                listed += len(near)
    if robots == 1:
        assert listed == 0
    if robots >= 40:  # the lists are neither empty nor all
        assert 0 < needed <= listed < 0.8 * 6 * robots * (robots - 1)
