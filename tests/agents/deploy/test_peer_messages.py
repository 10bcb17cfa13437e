"""What is odd in a mate's word is left out of a robot's plan, and noted; the rest of the word counts."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
from test_robot_planner import AT, seen
from test_stall_monitor import CELL, SETTINGS

from maexp.agents.deploy.planner.frames import OccupancyGrid
from maexp.agents.deploy.planner.radio_features import BASE, Contact, Memory
from maexp.agents.runtime import RobotPlanner, Word


def seen_by_mate() -> OccupancyGrid:
    """What a mate has mapped of the place of `seen`."""
    return OccupancyGrid(seen(slice(8, 38), True), CELL, (0.0, 0.0, 0.0))


GOOD = Word("b", (2.0, 2.0, 0.0), 0.2, 1.0, {"b": (1.0, seen_by_mate())}, hears={"c": 0.5})


def plan_after(*words, now: float = 1.0, planner: RobotPlanner | None = None):
    """A plan after these words, and the planner."""
    planner = planner or RobotPlanner("a", **SETTINGS)
    for came in words:
        planner.hear(came)
    return planner.plan(seen(slice(2, 10), False), CELL, (0.0, 0.0), AT, now=now, share=True), planner


def assert_same(plan, wanted) -> None:
    for name in ("goals", "active", "targets"):
        np.testing.assert_array_equal(getattr(plan, name), getattr(wanted, name))
    np.testing.assert_array_equal(plan.ways[0], wanted.ways[0])


class Unlike:
    """Has no order and cannot be shown."""

    def __repr__(self):
        raise RuntimeError


ODD_WORDS = {
    "text": ("hello", "a str came, which is no Word"),
    "none": (None, "a NoneType came, which is no Word"),
    "mapping": ({"name": "b"}, "a dict came, which is no Word"),
    "name none": (replace(GOOD, name=None), "the word of None is left out: its name must"),
    "name number": (replace(GOOD, name=3), "the word of 3 is left out: its name must"),
    "name list": (replace(GOOD, name=["b"]), "the word of ['b'] is left out: its name must"),
    "name unlike": (replace(GOOD, name=Unlike()), "is left out: its name must"),
    "time none": (replace(GOOD, time=None), "the word of 'b' is left out: time=None must"),
    "time text": (replace(GOOD, time="1"), "time='1' must be a number of seconds"),
    "time nan": (replace(GOOD, time=math.nan), "time=nan must"),
    "time inf": (replace(GOOD, time=math.inf), "time=inf must"),
    "time huge": (replace(GOOD, time=10**400), "must be a number of seconds"),
}


@pytest.mark.parametrize("word, note", ODD_WORDS.values(), ids=ODD_WORDS)
def test_an_odd_word_is_left_out_and_noted_once(word, note):
    """It changes no plan, and a good word after it counts."""
    plan, planner = plan_after(word)
    assert_same(plan, plan_after()[0])
    assert note in plan.notes[0] and "\n" not in plan.notes[0] and not planner.heard and not planner.grids
    assert not any(note in said for said in plan_after(planner=planner)[0].notes)
    plan, wanted = plan_after(word, GOOD)[0], plan_after(GOOD)[0]
    assert_same(plan, wanted)
    assert plan.notes[1:] == wanted.notes


def mapped(**changes) -> dict:
    return {"grids": {"b": (1.0, replace(seen_by_mate(), **changes))}}


VALUES = seen_by_mate().values
NO_MAP = "the map of 'b' is left out: "
ODD_MAPS = {
    "origin nan": (mapped(origin=(math.nan, 0.0, 0.0)), "origin=(nan, 0.0, 0.0) must be x, y"),
    "origin inf": (mapped(origin=(0.0, -math.inf, 0.0)), "origin=(0.0, -inf, 0.0) must be x, y"),
    "origin huge": (mapped(origin=(1e300, 0.0, 0.0)), "origin=(1e+300, 0.0, 0.0) must be x, y"),
    "origin of one": (mapped(origin=(1.0,)), "origin=(1.0,) must be x, y"),
    "origin none": (mapped(origin=None), "origin=None must be x, y"),
    "yaw inf": (mapped(origin=(0.0, 0.0, math.inf)), "origin=(0.0, 0.0, inf) must be x, y"),
    "resolution 0": (mapped(resolution=0.0), "resolution=0.0 must be the edge"),
    "resolution below 0": (mapped(resolution=-0.1), "resolution=-0.1 must be the edge"),
    "resolution nan": (mapped(resolution=math.nan), "resolution=nan must be the edge"),
    "resolution none": (mapped(resolution=None), "resolution=None must be the edge"),
    "resolution far too fine": (mapped(resolution=1e-9), "resolution=1e-09 must be the edge"),
    "a row": (mapped(values=VALUES[0]), "grid has 1 axes"),
    "a block": (mapped(values=VALUES[..., None]), "grid has 3 axes"),
    "ragged": (mapped(values=[[0, 1], [0]]), "grid has rows of different lengths"),
    "text": (mapped(values=VALUES.astype(str)), "grid is a ndarray of <U"),
    "objects": (mapped(values=np.full((5, 5), None)), "grid is a ndarray of object"),
    "yes and no": (mapped(values=VALUES > 0), "grid is a ndarray of bool"),
    "shares": (mapped(values=np.where(VALUES > 0, 1.0, np.where(VALUES == 0, 0.2, -1.0))), "multiply them by 100"),
    "no grid": ({"grids": {"b": (1.0, None)}}, "a NoneType is no OccupancyGrid"),
    "no time": ({"grids": {"b": seen_by_mate()}}, "must be (time, grid)"),
    "time none": ({"grids": {"b": (None, seen_by_mate())}}, "its time=None must be"),
    "time nan": ({"grids": {"b": (math.nan, seen_by_mate())}}, "its time=nan must be"),
}


@pytest.mark.parametrize("changes, note", ODD_MAPS.values(), ids=ODD_MAPS)
def test_an_odd_map_is_left_out_and_the_rest_of_the_word_counts(changes, note):
    plan, planner = plan_after(replace(GOOD, **changes))
    assert_same(plan, plan_after(replace(GOOD, grids={}))[0])
    assert NO_MAP in plan.notes[0] and note in plan.notes[0] and not planner.grids
    assert planner.heard["b"].pose == GOOD.pose and planner.beats.times == {"b": 1.0, "c": 0.5}
    plan, planner = plan_after(replace(GOOD, **changes), GOOD)
    assert_same(plan, plan_after(GOOD)[0])
    assert_same(plan_after(GOOD, replace(GOOD, **changes))[0], plan)
    both = replace(GOOD, grids=GOOD.grids | {"c": next(iter(changes["grids"].values()))})
    assert_same(plan_after(both)[0], plan)


MEMORY = Memory((1.0, 2.0), 3.0, 4.5, False, True, {"c": Contact(0.25, (1.0, 2.0), 3.0, 1.5)})
ODD_PARTS = {
    "pose of one": ({"pose": (1.0,)}, {"pose": None}, "pose=(1.0,) is left out"),
    "pose number": ({"pose": 1.0}, {"pose": None}, "pose=1.0 is left out"),
    "pose text": ({"pose": "here"}, {"pose": None}, "pose='here' is left out"),
    "pose of nobody": ({"pose": (1.0, None, "x")}, {"pose": None}, "pose=(1.0, None, 'x') is left out"),
    "grids none": ({"grids": None}, {"grids": {}}, "grids=None is left out"),
    "grids list": ({"grids": [(1.0, seen_by_mate())]}, {"grids": {}}, "is left out: it must be {name: (time, grid)}"),
    "hears none": ({"hears": None}, {"hears": {}}, "hears=None is left out"),
    "hears list": ({"hears": ["c"]}, {"hears": {}}, "hears=['c'] is left out"),
    "heard at none": ({"hears": {"c": 0.5, "d": None}}, {"hears": {"c": 0.5}}, "hears={'c': 0.5, 'd': None} is left"),
    "heard at nan": ({"hears": {"c": 0.5, "d": math.nan}}, {"hears": {"c": 0.5}}, "is left out where it is not"),
    "memory text": ({"memory": "all"}, {"memory": None}, "memory='all' is left out"),
    "memory of nowhere": ({"memory": replace(MEMORY, at=None)}, {"memory": None}, "is left out: it must be a Memory"),
    "memory nan": ({"memory": replace(MEMORY, known=math.nan)}, {"memory": None}, "is left out: it must be a Memory"),
    "met none": ({"memory": replace(MEMORY, met={"c": None})}, {"memory": None}, "is left out: it must be a Memory"),
}


@pytest.mark.parametrize("changes, kept, note", ODD_PARTS.values(), ids=ODD_PARTS)
def test_an_odd_part_of_a_word_is_left_out_and_the_rest_counts(changes, kept, note):
    base = replace(GOOD, memory=MEMORY)
    plan, planner = plan_after(replace(base, **changes))
    wanted, without = plan_after(replace(base, **kept))
    assert_same(plan, wanted)
    assert note in plan.notes[0] and "the word of 'b'" in plan.notes[0] and plan.notes[1:] == wanted.notes
    assert planner.heard == without.heard and planner.beats.times == without.beats.times
    assert planner.grids.keys() == without.grids.keys()
    assert_same(plan_after(replace(base, **changes), base)[0], plan_after(base)[0])


def test_good_words_are_taken_as_they_came():
    """Of numbers as NumPy has them, too; nothing is said."""
    few = replace(GOOD, time=np.float64(1.0), pose=np.array(GOOD.pose), hears={"c": np.float32(0.5)}, memory=MEMORY)
    plan, planner = plan_after(few, replace(GOOD, name=BASE, grids={}))
    assert planner.heard["b"] is few and planner.grids["b"][1] is GOOD.grids["b"][1]
    assert_same(plan, plan_after(GOOD)[0])
    assert not plan.notes
    number = RobotPlanner(3, **SETTINGS)
    number.hear(replace(GOOD, name=BASE))
    assert BASE in number.heard, "it need not sort with the robots"


@pytest.mark.parametrize(
    "changes",
    [
        {"values": VALUES.tolist()},
        {"origin": (0.0, 0.0)},
        {"origin": np.zeros(3)},
        {"origin": ["0", "0", "0"]},
        {"resolution": str(CELL)},
    ],
)
def test_what_does_for_its_own_grid_does_for_a_map_that_is_told(changes):
    plan = plan_after(replace(GOOD, **mapped(**changes)))[0]
    assert_same(plan, plan_after(GOOD)[0])
    assert not plan.notes


@pytest.mark.parametrize("always", [True, False], ids=["always", "in one call"])
def test_a_map_too_fine_to_look_around_on_is_left_out(always):
    """Few cells, but the whole would be planned on as finely, with what is in sight around it."""
    fine = OccupancyGrid(np.zeros((10, 10), np.int8), 0.002, (0.0, 0.0, 0.0))
    given, found = {"radar_range": 5.0}, []
    for grids in ({"b": (1.0, fine)}, {}):
        planner = RobotPlanner("a", **SETTINGS | (given if always else {}))
        planner.hear(replace(GOOD, grids=grids))
        call = (seen(slice(2, 10), False), CELL, (0.0, 0.0), AT)
        found.append(planner.plan(*call, now=1.0, share=True, **({} if always else given)))
    assert_same(*found)
    assert found[0].notes == ("the map of b is left out: it lies too far away, or has too small cells",)


def test_notes_of_odd_words_are_few_are_logged_and_wait_for_a_plan(caplog):
    planner = RobotPlanner("a", **SETTINGS)
    for k in range(100):
        planner.hear(replace(GOOD, pose=(float(k),)))
        planner.hear(replace(GOOD, pose=(0.0,)))
    with pytest.raises(ValueError, match="origin=None"):
        planner.plan(seen(slice(2, 10), False), CELL, None, AT, now=1.0, share=True)
    with caplog.at_level(logging.WARNING, "maexp.runtime"):
        plan = plan_after(planner=planner)[0]
    odd = [note for note in plan.notes if "is left out" in note]
    assert len(odd) == len(set(odd)) == 20 and set(odd) <= set(caplog.messages)
    planner.hear(None)
    planner.reset()
    assert not plan_after(planner=planner)[0].notes
