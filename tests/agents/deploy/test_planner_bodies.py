"""Mates that SLAM has drawn as obstacles are no walls, and nobody is locked in by them."""

import numpy as np
import pytest

from maexp.agents.deploy.planner import RobotPlanner, TeamPlanner, Word
from maexp.agents.deploy.planner.grid import read_grid
from maexp.kernels.constants import OBSTACLE

CELL, RADIUS = 0.1, 0.3
SETTINGS = {"radar_range": 3.0, "robot_radius": RADIUS}


def corridor() -> np.ndarray:
    """1.6 m wide, known on the left; the way out is to the right."""
    grid = np.full((20, 120), -1, np.int16)
    grid[2:18, 2:60] = 0
    grid[[1, 18], 1:61] = 100
    grid[1:19, 1] = 100
    return grid


def draw(grid: np.ndarray, x: float, y: float, radius: float = 0.25) -> None:
    """A body as a lidar sees it."""
    rows, columns = np.mgrid[: grid.shape[0], : grid.shape[1]]
    far = np.hypot((columns + 0.5) * CELL - x, (rows + 0.5) * CELL - y)
    grid[(far <= radius) & (far > radius - 0.15)] = 100


def test_a_mate_in_the_way_is_no_wall():
    grid, poses = corridor(), {"a": (1.0, 1.0, 0.0), "b": (3.0, 1.0, 0.0)}
    draw(grid, 3.0, 1.0)
    plan = TeamPlanner(**SETTINGS).plan(grid, CELL, (0, 0), poses, now=0.0)
    assert plan.active.any() and not any("wall" in note for note in plan.notes)
    stuck = TeamPlanner(**SETTINGS, clear_mates=False).plan(grid, CELL, (0, 0), {"a": poses["a"]}, now=0.0)
    assert not stuck.active.any()


@pytest.mark.parametrize("alone", [False, True])
def test_a_robot_frees_itself_from_ghosts_of_mates(alone):
    """b has driven around a; everywhere it was, it was drawn and never rubbed out."""
    grid = corridor()
    team, robot = TeamPlanner(**SETTINGS), RobotPlanner("a", **SETTINGS)
    for now, angle in enumerate(np.linspace(-1.5, 1.5, 16)):
        b = (1.2 + 0.9 * np.cos(angle), 1.0 + 0.4 * np.sin(angle), 0.0)
        draw(grid, *b[:2], radius=0.2)
        if alone:
            robot.hear(Word("b", b, 0.0, float(now)))
            plan = robot.plan(grid, CELL, (0, 0), (1.2, 1.0, 0.0), now=float(now))
        else:
            plan = team.plan(grid, CELL, (0, 0), {"a": (1.2, 1.0, 0.0), "b": b}, now=float(now))
    assert plan.active[0] and plan.goals[0, 0] > 4.0
    stuck = TeamPlanner(**SETTINGS, clear_mates=False)
    assert not stuck.plan(grid, CELL, (0, 0), {"a": (1.2, 1.0, 0.0)}, now=0.0).active.any()


def test_walls_stay():
    grid, poses = corridor(), {"a": (0.5, 0.45, 0.0), "b": (3.0, 1.0, 0.0)}
    planner = TeamPlanner(**SETTINGS)
    for now in range(5):
        plan = planner.plan(grid, CELL, (0, 0), poses, now=now)
        poses["b"] = (3.0 + 0.3 * now, 0.45, 0.0)  # along the wall
    closed = np.where(np.arange(120) == 59, 100, grid)
    cleared = planner.bodies.clear(read_grid(closed, CELL, (0, 0), 50.0, []))
    assert np.array_equal(cleared.known == OBSTACLE, closed == 100) and plan.active.any()
