"""The closed loop of the runtime: teams that start together explore a floor to the end, and never drive as a pack."""

import subprocess
import sys

import numpy as np
import pytest

from maexp.agents.deploy.planner import __main__ as runtime
from maexp.agents.deploy.planner.simulate import SimulatedFloor, explore, make_floor, place_team, read_floor
from maexp.agents.runtime import TeamPlanner

CELL, RADIUS, REACH = 0.2, 0.3, 4.0


def play(policy: str, grid=None, cell: float = CELL, seconds: float = 600.0, first=None, **settings):
    """A team of three in rooms of 4 m, from one place."""
    if policy == "universal":
        pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    grid = make_floor(81, room=20, door=5) if grid is None else grid
    places = place_team(grid, cell, RADIUS, 3, np.random.default_rng(1) if first is None else np.array(first))
    floor = SimulatedFloor(grid, cell, places, RADIUS, REACH, 0.6)
    planner = TeamPlanner(policy, radar_range=REACH, robot_radius=RADIUS, bounded=True, seconds=1.0, **settings)
    return floor, explore(floor, planner, seconds)


@pytest.mark.parametrize("policy", ["cost_utility", "hungarian", "universal"])
def test_no_needless_duplicates_in_rooms(policy):
    _, course = play(policy)
    assert course.done and course.share > 0.995 and (np.diff(course.reached) >= 0).all()
    assert (course.needless, course.close) == (0, 0)
    apart = np.linalg.norm(course.tracks[:, :, None] - course.tracks[:, None], axis=-1) + 9.0 * np.eye(3)
    assert apart.min() >= 2.0 * RADIUS - 1e-6
    speed = np.linalg.norm(np.diff(course.tracks, axis=0), axis=-1) / 0.1
    assert 0.5 < speed.max() <= 0.6 + 1e-6
    assert course.driven == pytest.approx(0.1 * speed.sum(), rel=1e-6)


def test_a_pack_is_counted():
    """Without distinct goals the same rooms show what the count is for."""
    _, course = play("nearest_frontier", distinct=False)
    assert course.close >= course.needless > 0


def test_coarse_cells_hold_nobody_back():
    """Cells longer than what a robot drives in a call: it does not turn back to the middle of its own."""
    _, course = play("cost_utility", make_floor(25, room=8, door=2), 1.0, seconds=300.0)
    assert course.done and course.reached[0] < 120.0


@pytest.mark.parametrize("name", ["crob_lab_slam", "rail_lab"])
def test_real_floors(name, data_dir):
    grid, cell = read_floor(data_dir / "maps2d" / f"{name}.yaml", 0.2)
    assert cell == pytest.approx(0.2, rel=0.3) and (grid == 0).sum() * cell**2 > 20.0
    _, course = play("cost_utility", grid, cell, seconds=40.0)
    assert course.needless == 0 and course.share > 0.05 and course.driven > 10.0


def test_a_lidar_sees_the_first_wall_and_nothing_behind():
    grid = np.full((20, 40), 100, np.int8)
    grid[1:-1, 1:-1], grid[:, 20] = 0, 100
    floor = SimulatedFloor(grid, 0.25, np.array([[2.0, 2.5]]), 0.3, 20.0, 0.6)
    assert floor.seen[1:-1, 1:20].all() and floor.seen[5, 20] and not floor.seen[:, 21:].any()
    assert floor.share() == 1.0, "what lies behind walls does not count"
    assert set(np.unique(floor.known())) == {-1, 0, 100}


def test_robots_begin_beside_each_other():
    grid = make_floor(81, room=20, door=5)
    places = place_team(grid, CELL, RADIUS, 5, np.array([2.0, 2.0]))
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + 99.0 * np.eye(5)
    assert gaps.min() >= 2.5 * RADIUS - 1e-9 and np.linalg.norm(places - (2.0, 2.0), axis=-1).max() < 1.5
    same = [place_team(grid, CELL, RADIUS, 3, np.random.default_rng(k)) for k in (3, 3, 4)]
    assert np.array_equal(same[0], same[1]) and not np.array_equal(same[0], same[2])
    with pytest.raises(ValueError, match="robots=400 of 0.3 m have no room here"):
        place_team(grid, CELL, RADIUS, 400, np.array([2.0, 2.0]))


def test_the_command(tmp_path):
    words = ["simulate", "--metres", "8.1", "--resolution", "0.2", "--seconds", "20", "--picture", tmp_path / "a.png"]
    done = subprocess.run(
        [sys.executable, "-m", "maexp.agents.runtime", *map(str, words)], capture_output=True, text=True
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and lines[0].endswith("3 robots of 0.35 m start together"), done.stderr
    assert "needless duplicates 0" in lines[1] and (tmp_path / "a.png").stat().st_size > 5000
    wrong = subprocess.run(
        [sys.executable, "-m", "maexp.agents.runtime", "simulate", tmp_path / "no.yaml"],
        capture_output=True,
        text=True,
    )
    assert wrong.returncode == 1 and wrong.stderr.startswith("error: ") and "Traceback" not in wrong.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--robots 0", "--robots=0 must be a whole number, 1 or more"),
        ("--runs 0", "--runs=0 must be"),
        ("--radius -1", "--radius=-1.0 must be a finite number above 0 [m]"),
        ("--speed nan", "--speed=nan must be"),
        ("--seed -1", "--seed=-1 must be a whole number, 0 or more"),
        ("--range 1,5", "invalid float value: '1,5'"),
        ("--spare out", "spare='out' is unknown: choose wait or home"),
        ("--picture gone/x.png", "--picture=gone/x.png must be a .png file in a folder that is there"),
        ("--metres 8.1 --start 900 0", "start=900 0 is no place for a robot of 0.35 m, nor is any near it: the"),
        ("--metres 8.1 --start nan 0", "start=nan 0 is no place"),
    ],
)
def test_the_command_refuses_in_a_sentence(words, told, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["runtime", "simulate", *words.split()])
    with pytest.raises(SystemExit) as end:
        runtime.main()
    assert told in capsys.readouterr().err + str(end.value)
