"""Maps that robots without a central planner tell each other over ROS 2: by the robot that made each, the newest."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from loopback import publish_robot

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")

from maexp.agents.deploy.planner.drivers import RobotDriver, map_topic
from maexp.agents.deploy.planner.frames import OccupancyGrid, fill_grid, read_map, read_time
from maexp.agents.deploy.planner.team_driver import DriverSettings
from maexp.agents.deploy.ros2.dds import Wire
from maexp.agents.deploy.ros2.robot import Ros2Robot

NAMES = ("a", "b", "c")
SETTINGS = {"robots": NAMES, "radar_range": 3.0, "robot_radius": (0.2,), "offsets": (0.0,) * 9, "period": 0.2}
PERSON = (slice(20, 24), slice(20, 24))
LINE = (("a", "b"), ("b", "a"), ("b", "c"), ("c", "b"))  # a and c do not hear each other


def seen(columns: slice, person: bool = False) -> np.ndarray:
    """What a robot has mapped of a place of 60 x 60 cells, with somebody standing there, or not any more."""
    values = np.full((60, 60), -1, np.int8)
    values[5:40, columns] = 0
    if person:
        values[PERSON] = 100
    return values


def message(values: np.ndarray, stamp: float, frame: str = "map"):
    """A nav_msgs/OccupancyGrid."""
    place = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace(x=0.0, y=0.0))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)))
    made = SimpleNamespace(header=header, info=SimpleNamespace(origin=place))
    fill_grid(made, frame, OccupancyGrid(values, 0.1, (0.0, 0.0, 0.0)))
    return made


def look(driver: RobotDriver, values: np.ndarray, stamp: float) -> None:
    """A robot's own map comes."""
    driver.take_map(driver.listened[0], message(values, stamp))


def drivers() -> dict[str, RobotDriver]:
    return {name: RobotDriver(DriverSettings(**SETTINGS, only=name)) for name in NAMES}


def tell(each: dict[str, RobotDriver], now: float) -> dict[str, dict[str, float]]:
    """All tell what is new, along `LINE`; the times of the maps that each has told."""
    told = {}
    for name, driver in each.items():
        since, own = driver.tell_own(now)
        told[name] = {name: message(own.values, since)} | driver.pass_on(now)
    for speaker, listener in LINE:
        for source, what in told[speaker].items():
            if source != listener:
                each[listener].take_known(source, what)
    return {
        name: {source: read_time(what.header.stamp) for source, what in found.items()} for name, found in told.items()
    }


def test_what_a_robot_has_cleared_is_gone_for_who_heard_of_it():
    """Somebody stood in the way, and has gone; the others have never been there, and pass on what they heard."""
    each, found, told = drivers(), [], []
    for name in ("b", "c"):
        look(each[name], seen(slice(5, 10)), 0.0)
    for now in range(5):
        look(each["a"], seen(slice(5, 30), person=now < 2), now)
        told.append(tell(each, float(now)))
        found.append([int(driver.known([]).values[PERSON].max()) for driver in each.values()])
    assert found == [[100, 100, -1], [100, 100, 100], [0, 0, 100], [0, 0, 0], [0, 0, 0]]
    assert [what["a"] for what in told] == [{"a": 0.0}, {"a": 0.0, "b": 0.0}] + [{"a": 2.0, "c": 0.0}] + [
        {"a": 2.0}
    ] * 2
    assert [what["b"].get("a") for what in told] == [None, 0.0, None, 2.0, None], "each once, as of its own time"


def test_of_a_robot_the_newest_map_counts_whoever_told_it():
    driver = drivers()["a"]
    look(driver, seen(slice(5, 10)), 0.0)
    for stamp, person in ((5.0, True), (6.0, False), (5.5, True), (6.0, True)):
        driver.take_known("c", message(seen(slice(5, 30), person), stamp))
    assert driver.known([]).values[PERSON].max() == 0
    assert list(driver.pass_on(6.0)) == ["c"] and not driver.pass_on(7.0)


def test_maps_that_make_no_sense_change_nothing():
    driver, good = drivers()["a"], message(seen(slice(5, 30)), 5.0)
    look(driver, seen(slice(5, 10)), 0.0)
    driver.take_known("c", good)
    cut = message(seen(slice(5, 30), True), 6.0)
    cut.data = cut.data[:-1]
    huge = message(np.zeros((1, 1), np.int8), 6.0)
    huge.info.width = huge.info.height = 10_000
    huge.data = np.zeros(10**8, np.int8)
    odd = [
        ("c", message(seen(slice(5, 30), True), 6.0, frame="c/map"), "a map in the frame c/map is not known"),
        ("c", cut, "a map of 60 x 60 cells came with 3599"),
        ("c", huge, "a map of 100,000,000 cells is none: grid has"),
        ("d", message(seen(slice(5, 30), True), 6.0), "a map of d came, who is no mate"),
        ("a", message(seen(slice(5, 30), True), 6.0), "a map of a came, who is no mate"),
    ]
    for source, what, why in odd:
        with pytest.raises(ValueError, match=why):
            driver.take_known(source, what)
    assert list(driver.told) == ["c"] and driver.told["c"][1].message is good
    own = {"/b/maexp/map": "b", "/c/maexp/map": "c"}
    heard = {"/b/maexp/heard/c/map": "c", "/c/maexp/heard/b/map": "b"}
    base = {"/base_station/maexp/heard/b/map": "b", "/base_station/maexp/heard/c/map": "c"}
    assert driver.map_topics() == own | heard | base


def test_a_map_of_later_neither_counts_nor_stays():
    driver = drivers()["a"]
    look(driver, seen(slice(5, 10)), 0.0)
    driver.take_known("c", message(seen(slice(5, 30), True), 1e9))
    assert not driver.pass_on(5.0)
    assert "the map of c is left out: its time has not come yet" in driver.decide(5.0).notes
    driver.take_known("c", message(seen(slice(5, 30)), 6.0))
    assert driver.known([]).values[PERSON].max() == 0 and list(driver.pass_on(6.0)) == ["c"]


def test_an_episode_of_an_arena_begins_with_nothing():
    """But with what mates that were faster have told of it already."""
    driver = drivers()["a"]
    episode = {"robots": NAMES, "seconds": 60.0, "radar_range": 5.0, "robot_radius": 0.3, "max_speed": 1.0}
    episode |= {"max_accel": 1.0, "decision_seconds": 2.0, "seed": 0}
    look(driver, seen(slice(5, 10)), 0.0)
    assert driver.tell_own(3.0)[0] == 3.0
    for source, stamp in (("b", 4.0), ("c", 12.0)):
        driver.take_known(source, message(seen(slice(5, 30), source == "b"), stamp))
    driver.begin(episode, 10.0)
    look(driver, seen(slice(5, 10)), 12.0)
    assert driver.tell_own(12.0)[0] == 12.0, "the same map, but of another place"
    assert driver.known([]).values[PERSON].max() == 0 and list(driver.pass_on(12.0)) == ["c"]


@pytest.mark.slow
def test_what_is_told_over_another_arrives_and_goes(own_domain):
    """a and c do not hear each other; c comes late, hears by b what a has seen, and later that somebody has gone."""
    wire, person, each = Wire(), [True], {name: join(name) for name in "ab"}
    shown = wire.reader("/c/maexp/known")

    def step_until(done) -> None:
        end, last = time.monotonic() + 120.0, 0.0
        while not done():
            assert time.monotonic() < end, "it did not happen"
            if time.monotonic() > last + 0.5:
                for k, name in enumerate(NAMES):
                    values = seen(slice(5, 30), person[0]) if name == "a" else seen(slice(5 + 10 * k, 10 + 10 * k))
                    publish_robot(wire, name, values, (1.5 + k, 1.5, 0.0))
                last = time.monotonic()
            for member in each.values():
                member.step()

    def there(name: str) -> int:
        known = each[name].driver.known([])
        return -1 if known is None else int(known.values[PERSON].max())

    step_until(lambda: there("b") == 100 and each["b"].driver.passed)
    each["c"] = join("c")
    step_until(lambda: there("c") == 100)
    person[0] = False
    step_until(lambda: [there(name) for name in NAMES] == [0, 0, 0])
    assert "a" not in each["c"].driver.words and not any(member.notes for member in each.values())
    got = []
    step_until(lambda: got.extend(shown.take()) or (got and read_map(got[-1]).values[PERSON].max() == 0))


def join(name: str) -> Ros2Robot:
    """A robot; walls part a and c."""
    notes: list[str] = []
    made = Ros2Robot(RobotDriver(DriverSettings(**SETTINGS, only=name)), Wire(), 5.0, notes.append)
    made.notes = notes
    for far in {"a": "c", "c": "a"}.get(name, ""):
        made.words.pop(far)
        made.grids = {topic: row for topic, row in made.grids.items() if not topic.startswith(f"/{far}/")}
    return made


def test_topics_of_maps():
    assert map_topic("a", "a") == "/a/maexp/map" and map_topic("a", "fleet/b") == "/a/maexp/heard/fleet/b/map"
