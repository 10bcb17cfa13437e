"""A planner on each robot: with what it has heard it chooses as a planner of the team does, else it plays alone."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
from test_runtime_watch import CELL, SETTINGS, World

from maexp.agents.runtime import CHOICES, RobotPlanner, TeamPlanner, Word
from maexp.agents.runtime.contacts import BASE, Contact, Memory
from maexp.agents.runtime.frames import OccupancyGrid, merge_grids

NAMES = ("a", "b")


def robots(policy: str = "cost_utility", **settings) -> dict[str, RobotPlanner]:
    return {name: RobotPlanner(name, policy, **SETTINGS | settings) for name in NAMES}


def decide(world: World, each: dict[str, RobotPlanner], share: bool = False) -> list:
    """A plan of each robot, at its place; grids as all robots have seen them together."""
    return [
        planner.plan(world.grid(), CELL, (0.0, 0.0), tuple(at), now=world.now, share=share)
        for planner, at in zip(each.values(), world.at, strict=True)
    ]


def tell(each: dict[str, RobotPlanner]) -> None:
    """All hear all."""
    for speaker in each.values():
        for listener in each.values():
            if listener is not speaker and speaker.word() is not None:
                listener.hear(speaker.word())


@pytest.mark.parametrize("policy", list(CHOICES))
def test_robots_that_hear_each_other_choose_as_the_team_does(policy):
    """Twenty decisions of a team that drives: the same goals and ways, and they are apart."""
    world, each, team = World(), robots(policy), TeamPlanner(policy, **SETTINGS)
    for _ in range(20):
        for planner, at in zip(each.values(), world.at, strict=True):  # where they are now, before they decide
            for other in each.values():
                if other is not planner:
                    other.hear(word(planner.name, at, world.now))
        found = decide(world, each)
        wanted = team.plan(world.grid(), CELL, (0.0, 0.0), dict(zip(NAMES, world.at, strict=True)), now=world.now)
        for k, plan in enumerate(found):
            assert plan.names == (NAMES[k],) and plan.active.tolist() == [wanted.active[k]]
            np.testing.assert_array_equal(plan.goals[0], wanted.goals[k])
            np.testing.assert_array_equal(plan.ways[0], wanted.ways[k])
        assert not wanted.active.all() or np.linalg.norm(wanted.goals[0] - wanted.goals[1]) >= 0.4
        world.drive(wanted)


def word(name: str, at, time: float, grid: OccupancyGrid | None = None) -> Word:
    return Word(name, (float(at[0]), float(at[1]), 0.0), 0.0, time, {} if grid is None else {name: (time, grid)})


def test_who_hears_nobody_plays_alone():
    """Its own pose is all it knows: two such robots side by side go to one place."""
    world, each = World(), robots("nearest_frontier")
    world.at[1] = world.at[0] + (0.1, 0.0)
    alone = [TeamPlanner("nearest_frontier", **SETTINGS) for _ in NAMES]
    same = 0
    for _ in range(10):
        found = decide(world, each)
        for k, (plan, planner) in enumerate(zip(found, alone, strict=True)):
            wanted = planner.plan(world.grid(), CELL, (0.0, 0.0), {NAMES[k]: world.at[k]}, now=world.now)
            np.testing.assert_array_equal(plan.goals, wanted.goals)
        same += bool(np.array_equal(found[0].goals, found[1].goals))
        world.now += 1.0
    assert same > 5


def test_words_and_grids_go_together():
    """Each has seen its own half; after a word both know both, and choose as the team does on the merged grid."""
    world, each = World(), robots()
    halves = [world.grid(), world.grid()]
    world.at[1] = (13.0, 8.0)
    world.look()
    halves[1] = np.where(halves[0] >= 0, -1, world.grid())
    origin, team = (0.0, 0.0), TeamPlanner("cost_utility", **SETTINGS)
    for _ in range(2):
        found = [
            planner.plan(half, CELL, origin, tuple(at), now=0.0, share=True)
            for planner, half, at in zip(each.values(), halves, world.at, strict=True)
        ]
        tell(each)
    wanted = team.plan(world.grid(), CELL, origin, dict(zip(NAMES, world.at, strict=True)), now=0.0)
    np.testing.assert_array_equal(np.concatenate([plan.goals for plan in found]), wanted.goals)
    told = each["a"].word().grids
    for name, half in zip(NAMES, halves, strict=True):
        np.testing.assert_array_equal(told[name][1].values, half)


AT = (1.0, 1.0, 0.0)
PERSON = (slice(20, 24), slice(20, 24))


def seen(columns: slice, person: bool) -> np.ndarray:
    """What a robot has mapped of a place of 40 x 40 cells, with somebody standing there, or not any more."""
    values = np.full((40, 40), -1)
    values[2:38, columns] = 0
    if person:
        values[PERSON] = 100
    return values


def plan_on(planner: RobotPlanner, values: np.ndarray, now: float, monkeypatch) -> np.ndarray:
    """The grid that a robot plans on."""
    asked, ask = [], planner.team.plan
    with monkeypatch.context() as patch:
        patch.setattr(
            planner.team, "plan", lambda grid, *others, **more: asked.append(grid) or ask(grid, *others, **more)
        )
        planner.plan(values, CELL, (0.0, 0.0), AT, now=now, share=True)
    return asked[0]


def test_what_a_robot_has_cleared_is_gone_for_who_heard_of_it(monkeypatch):
    """Somebody stood in the way, and has gone; the others have never been there, and pass on what they heard."""
    first, second, third = (RobotPlanner(name, **SETTINGS) for name in "abc")
    for now in range(4):
        there = plan_on(first, seen(slice(2, 30), now == 0), float(now), monkeypatch)[PERSON]
        assert (there == (100 if now == 0 else 0)).all(), "what it told others came back to it"
        for teller, listener in ((first, second), (second, third), (third, second), (second, first)):
            if teller.word() is not None:
                listener.hear(teller.word())
        for planner in (second, third):
            there = plan_on(planner, seen(slice(2, 10), False), now + 0.5, monkeypatch)[PERSON]
        assert (there == [-1, 100, 0, 0][now]).all(), "over two others it takes a round longer"


def test_of_a_robot_the_newest_map_counts_whoever_told_it():
    """Words come by several ways, and in any order."""
    planner = RobotPlanner("a", **SETTINGS)
    old, new, later = (OccupancyGrid(np.full((4, 4), k), CELL, (0.0, 0.0, 0.0)) for k in range(3))

    def tell(teller: str, time: float, **grids) -> None:
        planner.hear(replace(word(teller, AT, time), grids=grids))

    tell("b", 9.0, c=(5.0, new))
    tell("d", 9.5, c=(4.0, old), a=(9.0, old))
    assert planner.grids == {"c": (5.0, new)}, "older, and its own"
    tell("d", 9.6, c=(5.0, old))
    assert planner.grids["c"] == (5.0, new), "of the same moment"
    tell("c", 5.0, c=(5.0, old))
    assert planner.grids["c"] == (5.0, old), "it knows best what it has told then"
    tell("b", 8.0, c=(6.0, later))
    assert planner.grids["c"] == (6.0, later) and planner.heard["b"].time == 9.5 - 0.5


def test_a_mate_is_forgotten_but_not_its_map(monkeypatch):
    world, planner = World(), RobotPlanner("a", memory=5.0, **SETTINGS)
    known = OccupancyGrid(np.where(world.truth > 0, 100, 0), CELL, (0.0, 0.0, 0.0))
    planner.hear(word("b", world.at[1], 0.0, known))
    planner.hear(word("b", (5.0, 5.0), -1.0))
    assert planner.heard["b"].pose[0] == world.at[1][0], "an older word"
    asked, ask = [], planner.team.plan

    def note(grid, resolution, origin, poses, **more):
        asked.append(list(poses))
        return ask(grid, resolution, origin, poses, **more)

    monkeypatch.setattr(planner.team, "plan", note)
    for now in (5.0, 5.1):
        assert planner.plan(world.grid(), CELL, (0.0, 0.0), (1.0, 1.0), now=now, share=True).done
    assert asked == [["a", "b"], ["a"]]
    planner.reset()
    assert not planner.plan(world.grid(), CELL, (0.0, 0.0), (1.0, 1.0), now=0.0, share=True).done


def test_who_is_connected_over_others(monkeypatch):
    """In a line, a hears of d by b and c; once d is silent, that its last word goes round connects it with nobody."""
    each = {name: RobotPlanner(name, **SETTINGS) for name in "abcd"}
    world, found = World(), {name: [] for name in each}
    for name, planner in each.items():
        plan = planner.team.plan

        def note(*call, name=name, plan=plan, **more):
            found[name].append("".join(sorted(more["connected"][name])))
            return plan(*call, **more)

        monkeypatch.setattr(planner.team, "plan", note)
    for now in range(9):
        for planner in each.values():
            planner.plan(world.grid(), CELL, (0.0, 0.0), AT, now=float(now))
        for teller, listener in ("ab", "ba", "bc", "cb", "cd", "dc"):
            if now < 4 or teller != "d":
                each[listener].hear(each[teller].word())
    assert found["a"] == ["", "b", "bc"] + ["bcd"] * 4 + ["bc"] * 2
    assert found["c"] == ["", "bd"] + ["abd"] * 3 + ["ab"] * 4
    assert each["a"].word().hears == {"b": 7.0, "c": 6.0, "d": 3.0}


def test_a_word_from_the_future_does_not_stay():
    world, planner = World(), RobotPlanner("a", memory=5.0, **SETTINGS)
    grid = OccupancyGrid(np.full((4, 4), 100), CELL, (0.0, 0.0, 0.0))
    planner.hear(word("b", (9.0, 9.0), 1e9, grid))
    planner.plan(world.grid(), CELL, (0.0, 0.0), (1.0, 1.0), now=1.0)
    assert not planner.grids and not planner.beats.times
    planner.hear(word("b", world.at[1], 2.0))
    assert planner.heard["b"].time == 2.0


def test_a_robot_without_a_pose_says_nothing_and_stays():
    planner = RobotPlanner("a", **SETTINGS)
    plan = planner.plan(World().grid(), CELL, (0.0, 0.0), None, now=0.0)
    assert planner.word() is None and not plan.active.any() and "has no pose" in plan.notes[0]


def test_bad_input_is_named():
    for memory in (0, "5", None, math.nan):
        with pytest.raises(ValueError, match=f"memory={memory!r} must be a number of seconds above 0"):
            RobotPlanner("a", memory=memory)
    for now in (None, "soon", math.inf):
        with pytest.raises(ValueError, match=f"now={now!r} must be a finite number"):
            RobotPlanner("a").plan(World().grid(), CELL, (0.0, 0.0), AT, now=now)
    with pytest.raises(ValueError, match="a word from 'a' came to 'a'"):
        RobotPlanner("a").hear(word("a", (0.0, 0.0), 0.0))
    with pytest.raises(ValueError, match="choose|unknown"):
        RobotPlanner("a", spare="away")


@pytest.mark.parametrize("kind", [np.uint8, float, np.int16])
@pytest.mark.parametrize("side", [0.0, 0.3], ids=["alike", "apart"])
def test_cells_that_tell_nothing_rub_out_nothing(kind, side):
    """Unknown cells of unsigned numbers are 255, and others are odd."""
    walls = np.array([[100, 0, -1, 0]])
    odd = np.array([[255, 255, 255, 101]]).astype(kind)
    grids = [OccupancyGrid(values, 0.1, (side * k, 0.0, 0.0)) for k, values in enumerate((walls, odd))]
    assert merge_grids(grids).values[0, :4].tolist() == [100, 0, -1, 0]
    assert merge_grids(grids[::-1]).values[0, :4].tolist() == [100, 0, -1, 0]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"origin": (1.0,)}, "origin=.1.0,. must be x, y"),
        ({"origin": None}, "origin=None must be"),
        ({"resolution": 0.0}, "resolution=0.0 must be"),
        ({"grid": np.zeros((4, 4), bool)}, "of bool: give numbers"),
    ],
)
def test_a_grid_that_is_none_is_named_beside_those_of_mates(changes, told):
    planner, grid = RobotPlanner("a", **SETTINGS), World().grid()
    mate = Word("b", (1.0, 1.0, 0.0), 0.0, 0.0, {"b": (0.0, OccupancyGrid(grid, CELL, (0.0, 0.0, 0.0)))})
    planner.hear(mate)
    given = {"grid": grid, "resolution": CELL, "origin": (0.0, 0.0), "pose": None} | changes
    with pytest.raises(ValueError, match=told):
        planner.plan(**given, now=0.0, share=True)
    odd = np.where(grid < 0, 300, grid)
    assert "hold neither -1 nor 0 to 100" in planner.plan(odd, CELL, (0.0, 0.0), None, now=0.0, share=True).notes[0]


def test_an_own_cell_as_a_word_does_beside_maps_of_mates():
    world = np.zeros((60, 60), int)
    plans = []
    for cell in (0.1, "0.1"):
        planner = RobotPlanner("a", radar_range=1.0)
        planner.hear(Word("b", (3.0, 3.0, 0.0), 0.0, 0.0, {"b": (0.0, OccupancyGrid(world, 0.1, (1.0, 0.0, 0.0)))}))
        plans.append(planner.plan(world, cell, (0.0, 0.0), (1.0, 1.0), now=0.0, share=True))
    assert np.array_equal(plans[0].goals, plans[1].goals)


def test_a_grid_that_lies_too_far_away_is_left_out():
    planner, grid = RobotPlanner("a", **SETTINGS), World().grid()
    planner.hear(Word("b", (1.0, 1.0, 0.0), 0.0, 0.0, {"b": (0.0, OccupancyGrid(grid, CELL, (1e6, 0.0, 0.0)))}))
    plan = planner.plan(grid, CELL, (0.0, 0.0), (1.0, 1.0, 0.0), now=0.0, share=True)
    assert plan.notes[0] == "the map of b is left out: it lies too far away, or has too small cells"


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


def test_a_robot_whose_own_pose_holds_nothing_stays():
    planner = RobotPlanner("a", **SETTINGS)
    plan = planner.plan(World().grid(), CELL, (0.0, 0.0), (None, None, None), now=0.0)
    assert not plan.active.any() and "has no pose" in plan.notes[0]
