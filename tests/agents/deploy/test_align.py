"""Maps of two robots that are put together by what they share, and are not where that is ambiguous."""

import math

import numpy as np
import pytest

from maexp.agents.deploy.planner import align_grids
from maexp.agents.deploy.planner.align import move
from maexp.agents.deploy.planner.estimate import MapEstimate
from maexp.agents.deploy.planner.frames import OccupancyGrid, compose, invert
from maexp.agents.deploy.planner.team_driver import DriverSettings, TeamDriver

CELL = 0.1


def rooms(seed: int = 1) -> np.ndarray:
    """A floor of 24 x 18 m of rooms of different sizes with furniture."""
    rng = np.random.default_rng(seed)
    grid = np.zeros((180, 240), np.int8)
    grid[[0, 1, -2, -1]] = grid[:, [0, 1, -2, -1]] = 100
    for x in (47, 101, 173):
        grid[:, x : x + 2] = 100
        for y in rng.integers(10, 160, 3):
            grid[y : y + 12, x : x + 2] = 0
    for y in (61, 118):
        grid[y : y + 2] = 100
        for x in rng.integers(10, 220, 5):
            grid[y : y + 2, x : x + 12] = 0
    for _ in range(25):
        y, x = rng.integers(8, 165), rng.integers(8, 225)
        grid[y : y + rng.integers(3, 9), x : x + rng.integers(3, 9)] = 100
    return grid


def seen(values: np.ndarray, columns: slice, frame=(0.0, 0.0, 0.0)) -> OccupancyGrid:
    """Some columns of a floor as the map of a robot whose frame stands at `frame` there."""
    known = np.full_like(values, -1)
    known[:, columns] = values[:, columns]
    back = invert(frame)
    corners = move(back, CELL * np.array([(x, y) for x in (0, known.shape[1]) for y in (0, known.shape[0])], float))
    low, size = corners.min(0), np.ceil(np.ptp(corners, axis=0) / CELL).astype(int)
    x, y = np.meshgrid(*(low[k] + (np.arange(size[k]) + 0.5) * CELL for k in (0, 1)))
    index = np.floor(move(frame, np.stack([x.ravel(), y.ravel()], -1)) / CELL).astype(int)
    inside = (index >= 0).all(-1) & (index < known.shape[::-1]).all(-1)
    cells = np.where(inside, known[index[:, 1].clip(0, 179), index[:, 0].clip(0, 239)], -1)
    return OccupancyGrid(cells.reshape(size[::-1]).astype(np.int8), CELL, (float(low[0]), float(low[1]), 0.0))


@pytest.mark.parametrize("frame", [(3.0, -2.0, 0.0), (-5.0, 4.0, 2.2), (1.0, 9.0, -1.3)])
def test_the_place_of_a_map_is_found(frame):
    a, b = seen(rooms(), slice(0, 160)), seen(rooms(), slice(60, 240), frame)
    found = align_grids(a, b)
    assert found is not None and 0.5 < found.confidence <= 1.0 and found.shared > 20.0
    assert np.hypot(found.pose[0] - frame[0], found.pose[1] - frame[1]) < 0.15
    assert abs(math.remainder(found.pose[2] - frame[2], 2.0 * math.pi)) < math.radians(0.5)


def test_what_is_ambiguous_or_another_floor_is_refused():
    a = seen(rooms(), slice(0, 160))
    assert align_grids(a, seen(rooms(7), slice(60, 240), (1.0, 2.0, 0.7))) is None, "another floor"
    assert align_grids(seen(rooms(), slice(0, 70)), seen(rooms(), slice(150, 240))) is None, "nothing is shared"
    maze = np.zeros((180, 240), np.int8)
    maze[::30], maze[:, ::30] = 100, 100
    maze[10:20], maze[:, 10:20] = 0, 0
    assert align_grids(seen(maze, slice(0, 160)), seen(maze, slice(60, 240), (1.0, 0.5, 0.3))) is None, "all alike"
    empty = OccupancyGrid(np.full((50, 50), -1, np.int8), CELL, (0.0, 0.0, 0.0))
    assert align_grids(a, empty) is None and align_grids(empty, a) is None
    with pytest.raises(ValueError, match="resolution"):
        align_grids(a, OccupancyGrid(a.values, 0.0, a.origin))


def test_places_of_a_team_are_kept_up_to_date():
    frames = {"a": (0.0, 0.0, 0.0), "b": (3.0, 1.0, 0.8), "c": (9.0, 2.0, -2.0)}
    estimate = MapEstimate(frames)
    grids = {"a": seen(rooms(), slice(0, 110)), "c": seen(rooms(), slice(140, 240), frames["c"])}
    notes = estimate.look(grids, 0.0)
    assert estimate.places.keys() == {"a"} and "c: where it lies is not known yet" in notes[0]
    grids["b"] = seen(rooms(), slice(20, 230), frames["b"])
    estimate.look(grids, 5.0)
    assert "b" in estimate.places and "c" not in estimate.places, "c was looked at a moment ago"
    estimate.look(grids, 12.0)
    for name, frame in frames.items():
        assert np.allclose(estimate.places[name][:2], frame[:2], atol=0.2), name
    assert compose(invert(estimate.places["b"]), estimate.places["b"])[2] == 0.0


def test_a_driver_estimates_where_maps_lie():
    pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
    from bag_writer import grid, transforms

    frame, settings = (3.0, 1.0, 0.8), {"robots": ("a", "b"), "radar_range": 3.0, "offsets": ("estimate",)}
    driver = TeamDriver(DriverSettings(**settings))
    maps = {"a": seen(rooms(), slice(0, 160)), "b": seen(rooms(), slice(60, 210), frame)}
    at = {"a": (3.0, 3.0, 0.0), "b": (20.0, 3.0, 0.0)}
    for name, place in (("a", (0.0, 0.0, 0.0)), ("b", frame)):
        driver.take_map(f"/{name}/map", grid(maps[name].values, CELL, maps[name].origin[:2]))
        x, y, yaw = compose(invert(place), at[name])
        driver.take_frames(transforms([("map", "base_link", 0.0, (x, y, 0.0), yaw)]), name)
    decision = driver.decide(0.0)
    assert any(note.startswith("/b/map lies at ") for note in decision.notes), decision.notes
    assert driver.places["b"] == pytest.approx(at["b"][:2], abs=0.2)
    for order in decision.orders:  # each in its robot's own map
        place = frame if order.name == "b" else (0.0, 0.0, 0.0)
        assert compose(place, order.pose)[:2] == pytest.approx(order.goal, abs=0.2)
    assert decision.orders
    for odd in ({"only": "a"}, {"map_topics": ("/map",)}):
        with pytest.raises(ValueError, match="offsets=estimate is for one process that drives all robots"):
            TeamDriver(DriverSettings(**settings | odd))
