"""Teams in ir-sim: its parts by themselves, a short trial, and the command."""

import json
import math
import sys

import numpy as np
import pytest
from worlds import room

from maexp.agents.cli import main
from maexp.agents.deploy.irsim import policies
from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.agents.deploy.irsim.policies import team_planner
from maexp.agents.deploy.irsim.robot import Follower, Odometry, TeamGrid
from maexp.agents.deploy.irsim.simulator import Scan, Walkers, make_floor
from maexp.agents.deploy.irsim.trial import Coverage, map_errors
from maexp.agents.policies import POLICIES
from maexp.kernels.constants import DT

pytestmark = pytest.mark.slow  # another simulator

ABSENT = "THE EXTRA maexp[irsim] IS NOT INSTALLED: no trial is run"
ANGLES = np.linspace(-math.pi, math.pi, 180, endpoint=False)
NOBODY = np.empty((0, 2))


def config(**changes) -> TrialConfig:
    robot = {"radar_range": 5.0, "max_speed": 2.0, "max_accel": 1.0, "body_radius": 0.2, "clearance": 0.3}
    return TrialConfig(**{"seconds": 4.0} | robot | changes)


@pytest.fixture(scope="module")
def world():
    return room(24, 16, spacing=0.25)


def box_scan(x: float, y: float, heading: float, width: float, height: float, reach: float = 20.0) -> Scan:
    """Ranges inside an empty box from (0, 0) to (width, height) [m]."""
    way = np.stack([np.cos(ANGLES + heading), np.sin(ANGLES + heading)], axis=1)
    way[np.abs(way) < 1e-9] = 1e-9
    far = np.where(way > 0, (np.array([width, height]) - (x, y)) / way, -np.array([x, y]) / way)
    ranges = np.minimum(far.min(axis=1), reach)
    return Scan(ANGLES, ranges, ranges < reach)


def test_a_floor_is_the_maps_free_cells(world):
    floor = make_floor(world)
    assert floor.free.sum() == len(world.free) and not floor.free[[0, -1]].any() and not floor.free[:, [0, -1]].any()
    assert floor.free[tuple(floor.index(world.free[:, :2]).T)].all()
    assert not floor.free[tuple(floor.index(world.obstacles[:, :2]).T)].any()
    assert np.allclose(np.sort(floor.centre(np.argwhere(floor.free)), axis=0), np.sort(world.free[:, :2], axis=0))
    inner = floor.centre(np.argwhere(floor.roomy(0.5)))
    away = np.linalg.norm(inner[:, None] - world.obstacles[:, :2], axis=-1).min()
    assert 0.5 <= away < 0.9
    with pytest.raises(ValueError, match="lattice"):
        make_floor(room(24, 16, "rotated", spacing=0.25))


def test_ranges_become_a_grid():
    grid = TeamGrid(np.array([-1.0, -1.0]), np.array([7.0, 5.0]), 0.1)
    for x, y, heading in ((1.0, 1.0, 0.3), (5.0, 2.0, -2.0), (3.0, 3.2, 1.0)):
        grid.add(np.array([x, y, heading]), box_scan(x, y, heading, 6.0, 4.0), NOBODY)
    values = grid.values()
    rows, columns = np.indices(values.shape)
    x, y = (columns + 0.5) * 0.1 - 1, (rows + 0.5) * 0.1 - 1
    inside = (x > 0.15) & (x < 5.85) & (y > 0.15) & (y < 3.85)
    assert (values[inside & (values >= 0)] < 50).all() and (values[inside] >= 0).mean() > 0.98
    beyond = (x < -0.15) | (x > 6.15) | (y < -0.15) | (y > 4.15)
    assert (values[beyond] == -1).all()
    wall = (values >= 50) & ~inside
    assert wall.sum() > 120 and not (values[inside] >= 50).any()


def test_mates_are_no_obstacles_and_people_are_forgotten():
    scan = box_scan(3.0, 2.0, 0.0, 6.0, 4.0)
    ahead = np.abs(ANGLES) < 0.1
    met = Scan(ANGLES, np.where(ahead, 1.0, scan.ranges), scan.hit)
    pose = np.array([3.0, 2.0, 0.0])
    grid = TeamGrid(np.zeros(2), np.array([6.0, 4.0]), 0.1)
    grid.add(pose, met, np.array([[4.2, 2.0]]))
    row, column = 20, 40
    assert (grid.values()[row - 1 : row + 1, column : column + 2] < 50).all()
    for _ in range(3):
        grid.add(pose, met, NOBODY)
    assert grid.values()[row, column] > 50
    for _ in range(12):
        grid.add(pose, scan, NOBODY)
    assert 0 <= grid.values()[row, column] < 50


def test_odometry_without_errors_is_the_truth_and_drifts_with_the_way():
    rng = np.random.default_rng(0)
    poses = np.array([[0.0, 0.0, 0.0], [5.0, 5.0, 3.0]])
    exact, errors = Odometry(poses, 0.0, 0.0, rng), []
    drifting = [Odometry(poses, 0.0, 0.05, np.random.default_rng(k)) for k in range(40)]
    for k in range(1, 201):
        heading = 0.02 * k
        moved = poses + [[0.05 * k, math.sin(heading), heading], [0.0, 0.0, 0.0]]
        assert np.allclose(exact.update(moved), moved)
        beliefs = [odometry.update(moved) for odometry in drifting]
        if k in (50, 200):
            errors.append(np.sqrt(np.mean([np.sum((b[0, :2] - moved[0, :2]) ** 2) for b in beliefs])))
        assert all(np.allclose(b[1], moved[1]) for b in beliefs)  # who stands does not drift
    assert 0.05 < errors[0] < errors[1] < 1.0
    noisy = Odometry(poses, 0.1, 0.0, rng)
    seen = np.array([noisy.update(poses) - poses for _ in range(500)])
    assert np.allclose(seen.std(axis=(0, 1)), [0.1, 0.1, 0.02], rtol=0.1)


def drive(follower: Follower, pose, steps: int, width=8.0, height=4.0, mates=NOBODY) -> np.ndarray:
    """Where a robot in an empty box goes, x, y, heading [steps + 1, 3]."""
    track, speed = [np.array(pose, float)], 0.0
    for _ in range(steps):
        x, y, heading = track[-1]
        scan = box_scan(x, y, heading, width, height)
        wanted, yaw = follower.drive(track[-1], speed, scan, mates)
        speed = float(np.clip(wanted, speed - DT, speed + DT))
        track.append(track[-1] + DT * np.array([speed * math.cos(heading), speed * math.sin(heading), yaw]))
    return np.array(track)


def test_a_robot_drives_along_its_way():
    follower = Follower(config())
    follower.set_way(np.array([[1.0, 1.0], [6.0, 1.0], [6.0, 3.0]]))
    track = drive(follower, (1.0, 1.0, 2.5), 150)
    assert np.linalg.norm(track[-1, :2] - (6.0, 3.0)) < 0.25
    assert np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1).max() > 0.08  # near its speed, 2 m/s, on 5 m
    assert np.abs(track[:12, 0] - 1.0).max() < 0.3  # it turns first
    edge = np.minimum(track[:, :2], np.array([8.0, 4.0]) - track[:, :2]).min()
    assert edge > 0.2


def test_a_robot_stops_before_a_wall_and_backs_off():
    follower = Follower(config())
    follower.set_way(np.array([[1.0, 2.0], [12.0, 2.0]]))  # through the wall
    track = drive(follower, (1.0, 2.0, 0.0), 260)
    assert 7.4 < track[:, 0].max() < 8.0 - 0.2
    last = int(track[:, 0].argmax())
    assert track[last:, 0].min() < track[last, 0] - 0.1


def test_robots_face_to_face_leave_room():
    follower = Follower(config())
    follower.set_way(np.array([[1.0, 2.0], [7.0, 2.0]]))
    track = drive(follower, (1.0, 2.0, 0.0), 40, mates=np.array([[4.0, 2.0]]))
    assert track[:, 0].max() < 4.0 - 0.4 - 0.1


def test_nothing_to_do_is_nothing_done():
    assert Follower(config()).drive(np.zeros(3), 0.0, box_scan(1, 1, 0, 3, 3), NOBODY) == (0.0, 0.0)


def test_coverage_is_what_beams_passed(world):
    judge = Coverage(world)
    assert judge.share == 0.0
    centre = world.free[:, :2].mean(axis=0)
    judge.add(np.array([*centre, 1.0]), Scan(ANGLES, np.full(180, 9.0), np.zeros(180, bool)), 2.0)
    near = np.linalg.norm(world.free[:, :2] - centre, axis=1) <= 2.0
    assert np.array_equal(judge.seen, near) and judge.share == pytest.approx(near.mean())
    half = Coverage(world)
    half.add(np.array([*centre, 0.0]), Scan(ANGLES, np.where(ANGLES > 0, 9.0, 0.0), ANGLES < 0), 2.0)
    above = world.free[half.seen, 1] - centre[1]
    assert above.min() > -0.1 and half.seen.sum() > 0.4 * near.sum()


def test_a_map_with_errors_is_told(world):
    grid = TeamGrid(np.zeros(2), np.array([6.5, 4.5]), 0.1)
    assert map_errors(grid, world) == 0.0
    grid.touched[:], grid.evidence[:] = True, -1.0
    assert map_errors(grid, world) == 0.0
    grid.evidence[:] = 1.0
    assert map_errors(grid, world) == 1.0


def test_people_walk_and_wait(world):
    floor = make_floor(world)
    rng = np.random.default_rng(0)
    walkers = Walkers(floor, 3, np.array([[1.0, 1.0]]), rng)
    begin = walkers.places.copy()
    for _ in range(100):
        walkers.places = walkers.places + DT * walkers.step(np.array([[1.0, 1.0]]), DT)
        assert floor.free[tuple(floor.index(walkers.places).T)].all()
    assert (np.linalg.norm(walkers.places - begin, axis=1) > 0.5).any()
    alone = Walkers(floor, 1, np.array([[1.0, 1.0]]), rng)
    walk = alone.step(np.array([[50.0, 50.0]]), DT)[0]
    assert np.linalg.norm(walk) == pytest.approx(0.8)
    assert not alone.step(alone.places + walk, DT).any()  # somebody stands in front
    with pytest.raises(ValueError, match="people=9999"):
        Walkers(floor, 9999, np.array([[1.0, 1.0]]), rng)


@pytest.mark.parametrize("changes", [{"range_noise": -1.0}, {"seconds": math.inf}, {"beams": 4}, {"cell": 0.0}])
def test_bad_settings_of_a_trial(changes):
    with pytest.raises(ValueError, match=f"{next(iter(changes))}="):
        config(**changes)


@pytest.mark.parametrize("disturbed", [{}, {"range_noise": 0.03, "pose_noise": 0.02, "pose_drift": 0.02, "people": 2}])
def test_a_short_trial(world, disturbed):
    pytest.importorskip("irsim", reason=ABSENT)
    from maexp.agents.deploy.irsim.trial import run_trial

    trial_config = config(beams=90, **disturbed)
    env = policies.make_team(world, 2, trial_config)
    starts = policies.draw_starts(env, 0)
    moments = []
    trial = run_trial(world, team_planner("nearest_frontier", trial_config), starts, trial_config, moments.append)
    assert np.allclose(trial.poses[0], starts, atol=1e-5)
    assert len(trial.coverage) == 41 and len(moments) == 3
    assert (np.diff(trial.coverage) >= 0).all() and trial.coverage[-1] > trial.coverage[0] + 0.05
    assert trial.path.min() > 0.5 and not trial.collided.any()
    floor = make_floor(world)
    assert all(floor.free[tuple(floor.index(poses[:, :2]).T)].all() for poses in trial.poses)
    if disturbed:
        assert 0 < trial.drift < 0.5 and len(moments[0].people) == 2
        assert not np.allclose(moments[0].people, moments[2].people)
    else:
        assert trial.drift == pytest.approx(0.0, abs=1e-9) and trial.errors < 0.01
        curve, _ = policies.run_ours(env, POLICIES["nearest_frontier"](env), 0)
        assert len(curve) == 41 and abs(curve[0] - trial.coverage[0]) < 0.05
        again = run_trial(world, team_planner("nearest_frontier", trial_config), starts, trial_config)
        assert again.coverage == trial.coverage


def test_the_command(world, tmp_path, monkeypatch, capsys):
    pytest.importorskip("irsim", reason=ABSENT)
    monkeypatch.chdir(tmp_path)
    world.save(tmp_path / "floor.npz")
    words = ["irsim", "floor.npz", "policy=nearest_frontier", "num_robots=2", "seconds=2", "beams=60"]
    assert main([*words, "hydra.run.dir=out"]) == 0
    told = capsys.readouterr().out
    assert "ir-sim" in told and "ours" in told and "Written:" in told
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["run"]["policy"] == "nearest_frontier" and set(results["results"]) == {"ir-sim", "ours"}
    assert results["results"]["ir-sim"]["coverage"] == results["coverage"]["ir-sim"][-1]
    assert (tmp_path / "out" / "film.gif").is_file() and (tmp_path / "out" / "coverage.png").is_file()


WALKERS = """
import numpy as np
seen = []

class Right:
    \"\"\"Robot 0 goes to the right edge of the grid, the others stay.\"\"\"
    def reset(self, episode):
        self.episode = episode
    def act(self, observation):
        seen.append((self.episode, observation))
        goals = np.full(observation["poses"].shape[:1] + (2,), np.nan)
        right = observation["origin"][0] + observation["grid"].shape[2] * observation["resolution"]
        goals[0] = right, observation["poses"][0, 0, 1]
        return goals

def inside(env):
    return lambda td: td
"""


def test_a_foreign_policy_plays_here_too(world, tmp_path, monkeypatch, capsys):
    pytest.importorskip("irsim", reason=ABSENT)
    monkeypatch.chdir(tmp_path)
    world.save(tmp_path / "floor.npz")
    (tmp_path / "walkers.py").write_text(WALKERS)
    words = ["irsim", "floor.npz", "policy=walkers:Right", "num_robots=2", "seconds=6", "beams=60"]
    assert main([*words, "hydra.run.dir=out"]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    ways = results["results"]["ir-sim"]["path_length"]
    assert ways[0] > 1.0 and ways[1] == pytest.approx(0.0, abs=0.05)
    episode, seen = sys.modules["walkers"].seen[0]
    assert (episode["num_robots"], episode["seconds"], episode["decision_seconds"]) == (2, 6.0, 1.0)
    assert seen["grid"].dtype == np.int8 and set(np.unique(seen["grid"])) == {-1, 0, 100}
    ours_first = next(
        observation for _, observation in sys.modules["walkers"].seen if observation["resolution"] == world.resolution
    )
    assert set(ours_first) == set(seen)
    assert all(np.shape(seen[key])[:1] == np.shape(ours_first[key])[:1] for key in seen)
    assert np.allclose(seen["poses"], ours_first["poses"], atol=1e-4), "both begin in one place"
    assert main([*words[:2], "policy=walkers:inside"]) == 2
    assert "plays on tensordicts of our simulator's env: maexp irsim takes a class with act" in capsys.readouterr().err


BAD = {
    "needs a floor": [],
    "policy=best is unknown": ["floor.npz", "policy=best"],
    "policy=oracle looks into our simulator": ["floor.npz", "policy=oracle"],
    "num_robots=0": ["floor.npz", "num_robots=0"],
    "people=-1": ["floor.npz", "people=-1"],
    "does not exist": ["nowhere.yaml"],
    "range_noise=-1": ["floor.npz", "range_noise=-1"],
}


@pytest.mark.parametrize(("told", "words"), BAD.items(), ids=BAD)
def test_bad_words(world, tmp_path, monkeypatch, capsys, told, words):
    pytest.importorskip("irsim", reason=ABSENT)
    monkeypatch.chdir(tmp_path)
    world.save(tmp_path / "floor.npz")
    assert main(["irsim", *words]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1 and not (tmp_path / "outputs").exists() or "outputs" not in error


def test_the_extra_is_named(world, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    world.save(tmp_path / "floor.npz")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["irsim", "floor.npz"]) == 2
    assert 'pip install "maexp[irsim]"' in capsys.readouterr().err
    from maexp.agents.deploy.irsim.simulator import _import_irsim

    monkeypatch.setitem(sys.modules, "irsim", None)
    with pytest.raises(ImportError, match=r"maexp\[irsim\]"):
        _import_irsim()
