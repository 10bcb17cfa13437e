"""Settings of one's own robots on one's own floor: lengths of episodes, sizes that cannot be, radars without end."""

import math
import re
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds import room

from maexp.agents.config.compose import compose_settings
from maexp.agents.config.env import team_configs
from maexp.agents.config.resolved import describe_radius, resolve
from maexp.envs import ExplorationEnv, MapError, RadarConfig, RobotConfig
from maexp.envs.render.frames import draw_teams
from maexp.envs.render.painter import make_quads
from maexp.envs.render.stage import Stage
from maexp.envs.scenarios import SCENARIOS, default_macro_steps

FLOOR = room(72, 64, spacing=0.25)  # 18 x 16 m
ROW = SCENARIOS["pointcloud"]


def steps(speed: float = 2.0, reach: float = 5.0, robots: int = 3, **others) -> int:
    return default_macro_steps([FLOOR], ROW, [(speed, reach)] * robots, **others)


def test_an_episode_lasts_as_long_as_its_robots_need():
    """Area swept twice over, and time to drive across twice, at their speed."""
    side = math.hypot(18.25, 16.25)
    assert steps() == max(10, math.ceil(2 * max(FLOOR.free_area / 30, side / 2) / 2))
    assert steps(0.5) == pytest.approx(4 * steps(), abs=4)
    assert steps(0.5, reach=1.0) == math.ceil(2 * FLOOR.free_area / (3 * 0.5 * 1.0) / 2) > steps(0.5)
    assert steps(0.5, 1.0, robots=1) == pytest.approx(3 * steps(0.5, 1.0), abs=3)
    assert steps(0.5, local_steps=40) == pytest.approx(steps(0.5) / 2, abs=1)
    slow = [RobotConfig(max_speed=0.25), RobotConfig(max_speed=1.0)]
    env = ExplorationEnv(FLOOR, 1, 2, robot=slow, radar=RadarConfig(range=2.0), decision_seconds="protocol")
    assert env.macro_steps == default_macro_steps([FLOOR], ROW, [(0.25, 2.0), (1.0, 2.0)])
    assert ExplorationEnv(FLOOR, 1, 2, robot=slow, macro_steps=7).macro_steps == 7


@pytest.mark.parametrize(
    ("size", "told"),
    [
        ({"length": 100.0}, r"robot\.length=100 m does not fit on map .* of 18\.25 x 16\.25 m"),
        ({"width": 40.0}, r"robot\.width=40 m does not fit"),
    ],
)
def test_a_robot_larger_than_the_map_is_refused(size, told):
    with pytest.raises(ValueError, match=told):
        ExplorationEnv(FLOOR, 1, 2, robot=RobotConfig(**size))


@pytest.mark.parametrize("starts", ["drawn", "fixed"])
def test_a_team_without_room_is_told_how_many_have(starts):
    """Packed one beside the other 50 fit; drawn at random, fewer do."""
    words = r"room for (\d+) of num_robots=45 robots.*use fewer robots, a smaller robot\.radius"
    with pytest.raises(MapError, match=words) as told:
        ExplorationEnv(FLOOR, 4, 45, robot=RobotConfig(radius=0.6), starts=starts, num_threads=1).reset()
    room = int(re.search(words, str(told.value))[1])
    assert 30 < room < 45
    ExplorationEnv(FLOOR, 4, room - 2, robot=RobotConfig(radius=0.6), starts=starts, num_threads=1).reset()


ROUND = {"length": 0.7, "width": 0.7, "collision_threshold": 0.35}


def test_a_radius_stands_for_the_sizes_of_the_body():
    round_one, by_hand = (
        ExplorationEnv(FLOOR, 1, 2, robot=RobotConfig("differential", **body)) for body in ({"radius": 0.35}, ROUND)
    )
    tensors = round_one.simulation.robot_tensors, by_hand.simulation.robot_tensors
    assert all(torch.equal(tensors[0][name], tensors[1][name]) for name in tensors[1])
    again = round_one.robot_configs[0].completed(ROW)
    assert again == round_one.robot_configs[0] and again.wheelbase == 0.7
    assert RobotConfig(radius=0.35, **ROUND).completed(ROW).length == 0.7, "the same said twice"


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (
            {"radius": 0.3, "length": 1.0},
            r"robot\.radius=0\.3 makes robot\.length 0\.6 m, and 1\.0 is given: leave one",
        ),
        ({"radius": 0.3, "collision_threshold": 0.4}, r"makes robot\.collision_threshold 0\.3 m, and 0\.4 is given"),
        ({"radius": 0.0}, r"robot\.radius=0\.0 must be a finite number above 0 \[m\]"),
        ({"radius": math.inf}, r"robot\.radius=inf must be"),
        ({"radius": True}, r"robot\.radius=True must be"),
        ({"radius": 50.0}, r"robot\.radius=50 m does not fit on map .* of 18\.25 x 16\.25 m: .* robot\.radius=0\.5"),
        ({"radius": 4.0}, r"room for 0 of num_robots=2 robots with 12 m of clearance: .* a smaller robot\.radius"),
    ],
)
def test_a_radius_that_cannot_be(body, told):
    with pytest.raises(ValueError, match=told):
        ExplorationEnv(FLOOR, 1, 2, robot=RobotConfig(**body))


def test_a_radius_in_settings():
    """It replaces what the scenario says of bodies, not what is set by hand; teams may mix sizes."""
    words = ["scenario=maze", "robot.radius=0.35", "robot=differential"]
    cfg = compose_settings("train", words)
    robot = team_configs(cfg, 3)[0][0]
    maze = SCENARIOS["maze"]
    assert robot.completed(maze) == RobotConfig("differential", radius=0.35).completed(maze)
    shown = resolve(cfg)["robot"]
    assert shown.items() >= (ROUND | {"radius": 0.35, "wheelbase": 0.7, "max_speed": 8.0}).items()
    assert describe_radius(cfg).startswith("robot.radius=0.35: round, 0.7 m across; collides")
    with pytest.raises(ValueError, match=r"robot\.radius=0\.35 makes robot\.width 0\.7 m, and 0\.5 is given"):
        resolve(compose_settings("train", [*words, "robot.width=0.5"]))
    mixed = compose_settings("train", ["scenario=maze", "robot.team=[{radius: 0.35}, {}]"])
    small, car = (config.completed(SCENARIOS["maze"]) for config in team_configs(mixed, 2)[0])
    assert (small.width, small.collision_threshold) == (0.7, 0.35) and (car.width, car.radius) == (1.0, None)
    assert "radius" not in resolve(mixed)["robot"]["team"][1] and describe_radius(mixed) is None
    own = compose_settings("train", ["scenario=pointcloud", "scenario.path=x.yaml", "robot.radius=0.35"])
    assert own.scenario.importing.robot_radius == 0.35, "the import makes room for it"


def test_a_radar_without_end_is_drawn_at_once():
    env = ExplorationEnv(FLOOR, 1, 2, radar=RadarConfig(range=30.0), num_threads=1)
    env.reset()
    snapshot = env.snapshot()
    far = snapshot | {"radar_range": np.full(2, 1e6)}
    begin = time.process_time()
    picture = draw_teams([far], 512)
    assert np.array_equal(picture, draw_teams([snapshot], 512)), "a circle of 30 m is outside, too"
    scene = Stage(FLOOR).inputs(snapshot)
    wide, none = (make_quads(replace(scene, radar_range=np.full(2, reach))) for reach in (1e6, 100.0))
    assert len(wide.corners) == len(none.corners) and time.process_time() - begin < 20.0
