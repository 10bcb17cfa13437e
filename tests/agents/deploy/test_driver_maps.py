"""Maps of robots that are odd: one that cannot be used never ends the team, and is named."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
from bag_writer import grid, header, transforms
from test_team_driver import drive, floor, goals, place

from maexp.agents.deploy.planner.drivers import make_driver
from maexp.agents.deploy.planner.frames import OccupancyGrid
from maexp.agents.deploy.planner.robot_planner import merge_told
from maexp.agents.deploy.planner.team_driver import DriverSettings, TeamDriver

POSES = [("map", "a/map", 0.0, (0.0, 0.0, 0.0), 0.0), ("map", "b/map", 0.0, (0.0, 3.0, 0.0), 0.0)]


def put(message, **changes):
    """A nav_msgs/OccupancyGrid with other parts of its origin, or another resolution."""
    for name, value in changes.items():
        if name == "resolution":
            message.info.resolution = value
        elif name in ("w", "z"):
            setattr(message.info.origin.orientation, name, value)
        elif name == "frame":
            message.header.frame_id = value
        elif name == "data":
            message.data = value
        else:
            setattr(message.info.origin.position, name[-1], value)
    return message


def two(**odd) -> TeamDriver:
    """Two robots with a part of the floor each, in frames of their own; b's map is odd."""
    driver = TeamDriver(DriverSettings(robots=("a", "b"), radar_range=3.0, robot_radius=(0.2,)))
    driver.take_map("/a/map", put(grid(floor()[:30], 0.1), frame="a/map"))
    driver.take_map("/b/map", put(grid(floor()[30:], 0.1), **{"frame": "b/map"} | odd))
    driver.take_frames(transforms(POSES), still=True)
    at = [("a/map", "a/base_link", 0.0, (1.0, 1.5, 0.0), 0.0), ("b/map", "b/base_link", 0.0, (1.0, 1.0, 0.0), 0.0)]
    driver.take_frames(transforms(at))
    return driver


@pytest.mark.parametrize(
    "odd",
    [
        {"at_x": 1e5},
        {"at_y": -3e7},
        {"at_x": 1e30},
        {"at_x": math.nan},
        {"w": math.nan},
        {"z": 1e200},
        {"resolution": 0.0},
        {"resolution": math.nan},
        {"resolution": -0.1},
        {"resolution": 2e-4},
        {"resolution": 50.0},
        {"data": np.zeros(7, np.int8)},
        {"data": [200] * 3000},
    ],
)
def test_an_odd_map_of_one_robot_is_left_out_and_named(odd):
    driver = two(**odd)
    decision = driver.decide(0.0)
    assert any(note.startswith("the map of /b/map is left out: ") for note in decision.notes), decision.notes
    assert np.array_equal(driver._merge([]).values, floor()[:30]) and "a" in goals(decision)


def test_of_maps_far_apart_most_stay_and_an_odd_first_one_goes():
    near = OccupancyGrid(floor(), 0.1, (0.0, 0.0, 0.0))
    far = OccupancyGrid(floor(), 0.1, (1e5, 0.0, 0.0))
    notes: list[str] = []
    merged = merge_told([], {"first": far, "b": near, "c": near}, notes, 3.0)
    assert merged.origin == near.origin and notes == [
        "the map of first is left out: it lies too far away, or has too small cells"
    ]
    assert merge_told([], {"first": far, "b": near}, [], 3.0).origin == near.origin, "nearest to the frame's origin"
    assert merge_told([far], {"b": near}, [], 3.0).origin == far.origin, "its own counts in any case"
    shifted = OccupancyGrid(floor(), 0.1, (1e5 + 5.0, 0.0, 0.0))
    assert merge_told([], {"a": far, "b": shifted, "c": near}, [], 3.0).origin == far.origin


def test_a_map_without_cells_is_waited_for():
    driver = two(data=np.zeros(0, np.int8))
    driver.maps["/b/map"].info.width = driver.maps["/b/map"].info.height = 0
    decision = driver.decide(0.0)
    assert "a" in goals(decision) and not any("left out: a map" in note for note in decision.notes)


def test_a_robot_alone_leaves_an_odd_map_of_its_own_out():
    settings = DriverSettings(robots=("a", "b"), only="b", radar_range=3.0, robot_radius=(0.2,))
    driver, odd = make_driver(settings), two(resolution=0.0)
    driver.take_map("/b/map", odd.maps["/b/map"])
    driver.take_frames(transforms(POSES), still=True)
    decision = driver.decide(0.0)
    assert decision.plan is None and decision.notes[0].startswith("the map of /b/map is left out: resolution=0.0")


def test_poses_that_are_no_numbers_change_nothing():
    driver = drive()
    first = goals(drive().decide(0.0))
    for odd in (math.nan, math.inf):
        driver.take_frames(transforms([("map", "a/base_link", 0.0, (odd, 0.0, 0.0), 0.0)]))
    message = transforms([("map", "a/base_link", 0.0, (0.0, 0.0, 0.0), 0.0)])
    message.transforms[0].transform.rotation.y = 1e200
    driver.take_frames(message)
    got = goals(driver.decide(0.0))
    assert got.keys() == first.keys() and all(np.array_equal(got[name], first[name]) for name in got)


def test_after_a_clock_that_jumps_back_goals_are_sent_again():
    driver = drive()
    place(driver, 100.0)
    first = goals(driver.decide(100.0))
    assert first.keys() == {"a", "b"} and not driver.decide(100.5).orders
    decision = driver.decide(1.0)
    assert {note.split(":")[0] for note in decision.notes if "tf does not say" in note} == {"a", "b"}, "poses of before"
    place(driver, 2.0)
    assert goals(driver.decide(2.0)).keys() == first.keys() and not driver.decide(3.0).orders


def test_ones_of_a_robots_map_are_walls():
    """The comment of ROS 2's own message is read as 0 or 1."""
    plain = drive()
    wanted = goals(plain.decide(0.0))
    driver = drive()
    driver.take_map("/map", grid(np.where(floor() == 100, 1, floor()), 0.1))
    decision = driver.decide(0.0)
    assert any(note.startswith("/map: ") and "1 was taken as occupied" in note for note in decision.notes)
    got = goals(decision)
    assert got.keys() == wanted.keys() and all(np.array_equal(got[name], wanted[name]) for name in got)
    assert np.array_equal(driver._merge([]).values, floor())


def update(values: np.ndarray, x: int, y: int, time: float = 1.0):
    """A map_msgs/OccupancyGridUpdate."""
    height, width = values.shape
    return SimpleNamespace(
        header=header("map", time), x=x, y=y, width=width, height=height, data=values.ravel().tolist()
    )


def test_updates_of_a_map_are_written_into_it():
    """Nav2's costmaps and some SLAM nodes publish the whole map once, then parts of it on /map_updates."""
    driver, whole = drive(), floor()
    first = np.where(np.arange(100) < 30, whole, -1).astype(np.int8)
    driver.take_update("/b/map", update(whole[:2, :2], 0, 0))  # of a map that did not come yet
    driver.take_map("/map", grid(first, 0.1, time=0.0))
    driver.take_update("/map", update(whole[:, 30:], 30, 0))
    assert np.array_equal(driver._merge([]).values, whole)
    wanted, got = goals(drive().decide(1.0)), goals(driver.decide(1.0))
    assert got.keys() == wanted.keys() and all(np.array_equal(got[name], wanted[name]) for name in got)
    driver.take_update("/map", update(np.full((3, 3), 100), 10, 10, time=0.5))  # older than what the map holds
    assert np.array_equal(driver._merge([]).values, whole)
    kept = driver.maps["/map"]
    for odd in (update(whole, 1, 0, 2.0), update(whole[:2, :2], -1, 5, 2.0), update(whole[:3, :3], 99, 5, 2.0)):
        with pytest.raises(ValueError, match="lies outside of 100 x 60"):
            driver.take_update("/map", odd)
    odd = update(whole[:3, :3], 5, 5, 2.0)
    odd.data = odd.data[:5]
    with pytest.raises(ValueError, match="came with 5 of them"):
        driver.take_update("/map", odd)
    assert driver.maps["/map"] is kept
