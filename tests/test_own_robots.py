"""Settings of one's own robots on one's own floor: lengths of episodes, sizes that cannot be, radars without end."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from worlds import room

from maexp.envs import ExplorationEnv, RadarConfig, RobotConfig
from maexp.envs.render import draw_teams
from maexp.envs.scenarios import SCENARIOS, default_macro_steps
from maexp.envs.viewing.quads import make_quads
from maexp.envs.viewing.scene import Stage

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
    env = ExplorationEnv(FLOOR, 1, 2, robot=slow, radar=RadarConfig(range=2.0))
    assert env.macro_steps == default_macro_steps([FLOOR], ROW, [(0.25, 2.0), (1.0, 2.0)])
    assert ExplorationEnv(FLOOR, 1, 2, robot=slow, macro_steps=7).macro_steps == 7


@pytest.mark.parametrize(("size", "told"), [
    ({"length": 100.0}, r"robot\.length=100 m does not fit on map .* of 18\.25 x 16\.25 m"),
    ({"width": 40.0}, r"robot\.width=40 m does not fit"),
])  # fmt: skip
def test_a_robot_larger_than_the_map_is_refused(size, told):
    with pytest.raises(ValueError, match=told):
        ExplorationEnv(FLOOR, 1, 2, robot=RobotConfig(**size))


def test_a_radar_without_end_is_drawn_at_once():
    env = ExplorationEnv(FLOOR, 1, 2, radar=RadarConfig(range=30.0), num_threads=1)
    env.reset()
    snapshot = env.snapshot()
    far = snapshot | {"radar_range": np.full(2, 1e6)}
    begin = time.process_time()
    picture = draw_teams([far], 512)
    assert np.array_equal(picture, draw_teams([snapshot], 512)), "a circle of 30 m is outside, too"
    scene = Stage(FLOOR).moment(snapshot)
    wide, none = (make_quads(replace(scene, radar_range=np.full(2, reach))) for reach in (1e6, 100.0))
    assert len(wide.corners) == len(none.corners) and time.process_time() - begin < 20.0
