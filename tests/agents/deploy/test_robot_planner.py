"""A planner on each robot: with what it has heard it chooses as a planner of the team does, else it plays alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_stall_monitor import CELL, SETTINGS, World

from maexp.agents.deploy.planner.frames import OccupancyGrid, merge_grids
from maexp.agents.runtime import CHOICES, RobotPlanner, TeamPlanner, Word

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
    old, new, later = (OccupancyGrid(np.full((4, 4), k), CELL, (0.0, 0.0, 0.0)) for k in (0, 50, 100))

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


def test_a_robot_whose_own_pose_holds_nothing_stays():
    planner = RobotPlanner("a", **SETTINGS)
    plan = planner.plan(World().grid(), CELL, (0.0, 0.0), (None, None, None), now=0.0)
    assert not plan.active.any() and "has no pose" in plan.notes[0]
