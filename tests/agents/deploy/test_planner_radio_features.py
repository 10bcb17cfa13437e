"""What robots know of radios without the simulator: its features, its choice to go and tell, in episodes, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from radio_policy import export_told, make_told_policy
from runtime_cases import inputs
from test_radio_features import ACTION, BASE, COUNT, HERE, PLACE, TELL, make
from test_stall_monitor import CELL, SETTINGS, World
from torchrl.envs.utils import step_mdp

from maexp.agents.deploy.planner.frames import OccupancyGrid
from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.radio_features import BASE as STATION
from maexp.agents.deploy.planner.radio_features import Memory, count_blocked, read_comm
from maexp.agents.models.actor import TARGETS, TARGETS_MASK
from maexp.agents.runtime import RobotPlanner, TeamPlanner, Word
from maexp.envs import CommConfig, ExplorationEnv
from maexp.envs.targets.features import FEATURES, RADIO_TABLE, feature_names
from maexp.kernels.constants import DT, FREE

RADIOS = {
    "range": HERE,
    "walls": CommConfig(range=12.0, line_of_sight=True, base_station=True),
    "signal": CommConfig(signal=True, power=-5.0, base_station=True),
}
EXACT = ("tells", "base_since", "base_linked", "base_far", "mates_since", "mates_far")
ROUGH = {"untold": 0.06, "mates_untold": 0.06, "base_way": 0.12, "base_spare": 0.03}
"""Areas count cells here and points there, odometers the straight line from decision to decision."""
OTHERS = (
    "travel",
    "nearness",
    "distance",
    "detour",
    "gain",
    "size",
    "ahead",
    "aside",
    "way_ahead",
    "way_aside",
    "score",
)


@pytest.fixture(scope="module")
def policy():
    return make_told_policy()


@pytest.fixture(scope="module")
def folder(policy, tmp_path_factory):
    return export_told(policy, tmp_path_factory.mktemp("policies") / "told")


class Robots:
    """A planner for each robot of an env of one team, which hears whom that one is connected with."""

    def __init__(self, env: ExplorationEnv, folder):
        self.env, self.count = env, env.num_robots
        settings = inputs(env, env.target_view.tracker.nav).settings
        robots, base = env.simulation.robot_tensors, env.simulation.tensors["base"][0, :2].tolist()
        comm = replace(env.comm_config, base_station=tuple(base))
        settings |= {name: float(robots[name].max()) for name in ("max_speed", "max_accel")}
        settings |= {"robot_radius": settings["robot_radius"][0], "seconds": DT * env.local_steps}
        settings |= {"comm": comm, "time_limit": DT * env.local_steps * env.macro_steps, "distinct": False}
        names = range(self.count)
        self.planners = [RobotPlanner(k, folder, mates=set(names) - {k}, memory=0.01, **settings) for k in names]
        self.seen: list = [None] * self.count
        for k, planner in enumerate(self.planners):
            self._spy(k, planner.team.learned)

    def _spy(self, robot: int, learned) -> None:
        rank = learned.rank

        def note(scene, candidates):
            self.seen[robot] = scene, candidates
            return rank(scene, candidates)

        learned.rank = note

    def plan(self) -> list:
        """What each robot plans now."""
        nav, step = self.env.target_view.tracker.nav, int(self.env.simulation.tensors["macro_step"])
        call, now = inputs(self.env, nav).call, DT * self.env.local_steps * step
        poses, speeds = call.pop("poses"), self.env.target_view.tracker.speed(nav)[0].tolist()
        linked = self.env.strategy.linked[0]
        plans, self.seen = [], [None] * self.count
        for k, planner in enumerate(self.planners):
            mates = [j for j in range(self.count) if j != k and linked[k, j] and poses[j] is not None]
            for j in mates:
                memory = self.planners[j].team.book.memories.get(j)
                planner.hear(Word(j, tuple(poses[j]), speeds[j], now, memory=memory))
            names = {*mates, *([STATION] if linked[k, self.count] else [])}
            height, width = call["grid"].shape
            call["grid"] = np.array([-1, 0, 100], np.int8)[nav.known[0, k, : width * height].reshape(height, width)]
            left = 1.0 - step / self.env.macro_steps
            plans.append(planner.plan(**call, pose=poses[k], speed=speeds[k], now=now, connected=names, time_left=left))
        return plans

    def direct(self) -> bool:
        """Whether all who are connected hear each other: then the policy is told of the same team in both places."""
        linked = self.env.strategy.linked[0, :, : self.count]
        return torch.equal(linked, self.env.simulation.tensors["comm"][0])


@pytest.mark.parametrize("kind", RADIOS)
def test_features_are_those_of_the_env(kind, folder):
    env = make(2, 1, PLACE, comm=RADIOS[kind], seed=3)
    torch.manual_seed(1)
    td, checked, told, signals = env.reset(), 0, 0, []
    robots = Robots(env, folder)
    for _ in range(12):
        robots.plan()
        for k, seen in enumerate(robots.seen):
            if seen is None:
                continue
            scene, ours = seen
            row, there = sorted([k, *mates_of(env, k)]).index(k), td[TARGETS][0, k].numpy()
            mask, features = td[TARGETS_MASK][0, k].numpy(), ours.features[row]
            pairs = match(env, k, scene, ours.target[row], ours.mask[row], mask)
            news = abs(float(env.strategy.known[0, k] - env.strategy.state["told"][0, k, 2]))
            if mask[TELL] != ours.mask[row, TELL]:
                assert news < 0.05 * float(env.strategy._disc()), "hardly anything new: cells and points differ"
                continue
            pairs += [(TELL, TELL)] * bool(mask[TELL])
            told += bool(mask[TELL])
            for a, b in pairs:
                compare(features[a], there[b], a == TELL)
                signals.append((features[a], there[b]))
                checked += 1
        action = env.rand_action(td)
        td = step_mdp(env.step(action))
    at = feature_names(True).index("base_signal")
    gaps = np.array([abs(signal[at] - other[at]) for signal, other in signals])
    assert (gaps < 3e-3).mean() > 0.97 and len({round(float(signal[at]), 2) for signal, _ in signals}) > 1
    assert checked > 60 and told > 3


def mates_of(env: ExplorationEnv, robot: int) -> list[int]:
    return [j for j in range(env.num_robots) if j != robot and env.strategy.linked[0, robot, j]]


def match(
    env: ExplorationEnv, robot: int, scene, target, ours: np.ndarray, theirs: np.ndarray
) -> list[tuple[int, int]]:
    """Places of the candidates that lie on the same point, which nearly all do."""
    points = scene.grid.to_map(scene.points[target])
    there = env.target_view.state["point"][0, robot].numpy()
    gap = np.linalg.norm(points[:, None] - there, axis=-1)
    gap[~ours[:COUNT]], gap[:, ~theirs[:COUNT]] = np.inf, np.inf
    pairs = [(a, int(row.argmin())) for a, row in enumerate(gap) if row.min(initial=np.inf) < 1e-3]
    assert len(pairs) >= 0.9 * theirs[:COUNT].sum()
    return pairs


def compare(ours: np.ndarray, theirs: np.ndarray, tells: bool) -> None:
    names = feature_names(True)
    for name in (*EXACT, *ROUGH, *(OTHERS if tells else ())):
        at = names.index(name)
        assert ours[at] == pytest.approx(theirs[at], abs=ROUGH.get(name, 2e-3)), name


def test_a_policy_plays_an_episode_from_the_runtime(policy, folder):
    """The choices of torch, robot by robot; who goes to tell keeps on until it is connected, and the base learns."""
    env = make(2, 1, PLACE, comm=HERE, seed=3, macro_steps=25)
    td, same, asked, duty, told, gaps = env.reset(), 0, 0, [False, False], 0, []
    robots = Robots(env, folder)
    base = env.simulation.tensors["base"][0, :2].numpy()
    for _ in range(25):
        plans, linked = robots.plan(), env.strategy.linked[0, :, 2].tolist()
        with torch.no_grad():
            wanted = policy(td.clone())["agents", "action", "preference"][0].argmax(-1).tolist()
        index, state = [], env.target_view.state
        for k, plan in enumerate(plans):
            gap = np.linalg.norm(state["point"][0, k].numpy() - plan.goals[0], axis=-1)
            nearest = int(np.where(state["mask"][0, k].numpy(), gap, np.inf).argmin())
            index.append(TELL if plan.tells[0] else nearest)
            if plan.tells[0]:
                assert not linked[k]
                gaps.append(np.linalg.norm(plan.goals[0] - base))
            if duty[k] and not linked[k]:
                assert plan.tells[0], "whatever its policy says on the way"
            elif robots.direct() and td[TARGETS_MASK][0, k].any():
                asked, same = asked + 1, same + (index[k] == wanted[k])
            told += bool(plan.tells[0]) and not duty[k]
            duty[k] = bool(plan.tells[0])
        td[ACTION] = torch.tensor([index])
        td = step_mdp(env.step(td))
        if td["done"].any():
            break
    known = env.simulation.tensors["known_weight"][0].tolist()
    assert told >= 4 and asked > 20 and same >= 0.9 * asked
    assert min(gaps) < 0.3 and max(gaps) < 7.0, "beside it, or as near as the known ground leads"
    assert known[2] > 0.5 * max(known)


RADIO = {"comm": {"range": 3.0, "base_station": (1.0, 1.0)}, "time_limit": 100.0}


def alone(folder, **changes) -> TeamPlanner:
    return TeamPlanner(folder, **SETTINGS | RADIO | changes)


def like(planner, tell: float) -> None:
    """The policy thinks so much of going to tell, and nothing of targets."""

    def logits(candidates):
        found = np.zeros(candidates.mask.shape, np.float32)
        found[:, -1] = tell
        return found

    planner.learned.logits = logits


def test_who_goes_to_tell_goes_on_until_it_is_connected(folder):
    world, planner = World(), alone(folder)
    origin, at = (0.0, 0.0), {"a": (3.0, 3.0, 0.0)}

    def plan(now: float, connected: bool = False):
        return planner.plan(world.grid(), CELL, origin, at, now=now, connected=connected)

    like(planner, 5.0)
    assert not plan(0.0, True).tells.any(), "it is connected"
    world.at[1] = (13.0, 8.0)
    world.look()
    found = plan(1.0)
    assert found.tells.all() and found.active.all() and not found.done
    assert np.linalg.norm(found.goals[0] - (1.0, 1.0)) < 0.5 and len(found.ways[0]) > 1
    like(planner, -5.0)
    at["a"] = (2.5, 2.5, 0.0)
    assert plan(2.0).tells.all(), "whatever the policy says now"
    assert not plan(3.0, True).tells.any()
    assert not plan(4.0).tells.any(), "and nothing new came since"
    planner.reset()
    assert not planner.book.memories


def test_it_is_left_where_the_robot_stands_still_or_is_there(folder):
    world, planner = World(), alone(folder, patience=5.0)
    like(planner, 5.0)
    notes, tells = [], []
    for now in range(8):
        plan = planner.plan(world.grid(), CELL, (0.0, 0.0), {"a": (3.0, 3.0)}, now=float(now))
        tells.append(bool(plan.tells[0]))
        notes += plan.notes
    assert tells == [True] * 6 + [False] * 2
    assert any("a gave up telling the base station: it did not move for 5 s" in note for note in notes)
    planner.reset()
    places, tells = [(3.0, 3.0), (1.0, 1.0), (3.0, 3.0), (3.0, 3.0)], []
    for place, now in zip(places, (0.0, 5.0, 20.0, 5.0 + planner.watch.pause), strict=True):
        plan = planner.plan(world.grid(), CELL, (0.0, 0.0), {"a": place}, now=now)
        tells.append(bool(plan.tells[0]))
        gave = any("gave up telling the base station: nothing was heard of it" in note for note in plan.notes)
        assert gave == (place == (1.0, 1.0)), plan.notes
    assert tells == [True, False, False, True], "it is there, and nobody hears it: it goes on for a while"


def test_when_nothing_is_left_to_be_seen_what_is_known_is_told(folder):
    world, planner = World(), alone(folder)
    like(planner, -5.0)
    grid = np.where(world.truth > 0, 100, 0)
    plan = planner.plan(grid, CELL, (0.0, 0.0), {"a": (3.0, 3.0)}, now=0.0)
    assert plan.tells.all() and plan.active.all() and not plan.done
    plan = planner.plan(grid, CELL, (0.0, 0.0), {"a": (3.0, 3.0)}, now=1.0, connected=True)
    assert plan.done and not plan.tells.any()


def test_robots_take_over_what_a_mate_tells_of_itself(folder):
    """Who hears that a mate is on its way to tell leaves it to that, and does not count its target."""
    world = World()
    first, second = (RobotPlanner(name, folder, mates=("a", "b"), **SETTINGS | RADIO) for name in "ab")
    for planner in (first, second):
        like(planner.team, 5.0)
    plan = second.plan(world.grid(), CELL, (0.0, 0.0), (3.0, 3.0), now=0.0)
    assert plan.tells.all() and second.word().memory.tells
    like(first.team, -5.0)
    first.hear(second.word())
    plan = first.plan(world.grid(), CELL, (0.0, 0.0), (3.2, 3.0), now=0.5)
    book = first.team.book
    assert book.memories["b"].tells and not plan.tells.any() and book.crew == {"a", "b"}
    assert book.memories["a"].met["b"].place == (3.0, 3.0) and STATION not in book.memories["a"].met
    first.plan(world.grid(), CELL, (0.0, 0.0), (3.2, 3.0), now=1.0, connected={STATION})
    assert book.memories["a"].linked and book.memories["a"].met["b"].used == pytest.approx(0.0)


def test_the_base_station_is_heard_as_mates_are(folder):
    """Its word connects the robot with it and brings its map, and nobody plans for it."""
    world, robot = World(), RobotPlanner("a", folder, **SETTINGS | RADIO)
    like(robot.team, 5.0)
    known = OccupancyGrid(np.where(world.truth > 0, 100, 0), CELL, (0.0, 0.0, 0.0))
    call = (world.grid(), CELL, (0.0, 0.0), (3.0, 3.0))
    assert robot.plan(*call, now=0.0, share=True).tells.all()
    robot.hear(Word(STATION, (1.0, 1.0, 0.0), 0.0, 0.5, {"b": (0.4, known)}))
    plan = robot.plan(*call, now=1.0, share=True)
    book = robot.team.book
    assert plan.done and not plan.tells.any() and book.memories["a"].linked and book.crew == {"a"}
    assert book.memories["a"].met[STATION].known > 0.5 * (world.truth == 0).sum() * CELL**2
    robot.plan(*call, now=2.0, share=True)
    assert not book.memories["a"].linked, "nothing was heard since"


def test_blocked_cells_along_a_line():
    """Plain loops: the middles of as many pieces as there are columns, or rows if those are more."""
    rng = np.random.default_rng(0)
    grid = KnownGrid(rng.integers(0, 3, (30, 40)).astype(np.uint8), 0.25, (0.0, 0.0))
    start, points = np.array([1.3, 2.1]), rng.uniform(-1.0, 11.0, (50, 2))
    for point, found in zip(points, count_blocked(grid, start, points), strict=True):
        along = (point - start) / grid.cell
        pieces, blocked = max(math.ceil(np.abs(along).max()), 1), 0
        for k in range(pieces):
            x, y = np.floor(start / grid.cell + along * (k + 0.5) / pieces).astype(int)
            inside = 0 <= x < 40 and 0 <= y < 30
            blocked += not inside or grid.known[y, x] != FREE
        assert found == blocked
    assert count_blocked(grid, start, start[None]).tolist() == [int(grid.known[8, 5] != FREE)]


@pytest.mark.parametrize("start", [(-30.0, 4.0), (55.0, 55.0), (-7.0, -3.0), (3.0, 80.0)])
def test_blocked_cells_from_beyond_the_grid(start):
    """What lies before the grid counts, however far; only what lies on it is looked at."""
    rng = np.random.default_rng(1)
    grid = KnownGrid(rng.integers(0, 3, (30, 40)).astype(np.uint8), 0.25, (0.0, 0.0))
    points = rng.uniform((0.0, 0.0), (10.0, 7.5), (20, 2))
    around = KnownGrid(np.pad(grid.known, 400), 0.25, (0.0, 0.0))  # unknown cells
    found = count_blocked(grid, np.array(start), points)
    assert found.tolist() == count_blocked(around, np.array(start) + 100.0, points + 100.0).tolist()
    assert (count_blocked(grid, np.array([5e6, 0.0]), points) > 1.9e7).all()


def test_a_base_station_beyond_the_grid_is_not_at_its_edge(folder, monkeypatch):
    team, seen = alone(folder, comm={"range": 3.0, "base_station": (90.0, 3.0)}), []
    add = team.book.add_to

    def note(inputs, **more):
        seen.append(add(inputs, **more))
        return seen[-1]

    monkeypatch.setattr(team.book, "add_to", note)
    team.plan(World().grid(), CELL, (0.0, 0.0), {"a": (3.0, 3.0)}, now=0.0)
    assert seen[0].travel[0, -1] == pytest.approx(1.5 * 87.0 / team.radar_range)


@pytest.mark.parametrize(
    "connected, told",
    [
        ("b", "connected='b': give"),
        (3, "connected=3: give"),
        ({"a": "base_station"}, r"connected\['a'\]='base_station': give a list"),
        ({"z": ["a"]}, "connected names 'z', and the robots are a, b"),
    ],
)
def test_odd_contacts_are_named(folder, connected, told):
    team = TeamPlanner(folder, **SETTINGS, **RADIO)
    with pytest.raises(ValueError, match=told):
        team.plan(World().grid(), CELL, (0.0, 0.0), {"a": (3.0, 3.0), "b": (4.0, 3.0)}, now=0.0, connected=connected)


def test_odd_names_are_named(folder):
    with pytest.raises(ValueError, match="mates='b': give a list of names"):
        RobotPlanner("a", mates="b")
    with pytest.raises(ValueError, match="connected=True: give a list of names"):
        RobotPlanner("a").plan(World().grid(), CELL, (0.0, 0.0), (3.0, 3.0), now=0.0, connected=True)
    with pytest.raises(ValueError, match="'base_station' names the base station"):
        TeamPlanner(folder, **SETTINGS, **RADIO).plan(World().grid(), CELL, (0.0, 0.0), {STATION: (3.0, 3.0)}, now=0.0)


@pytest.mark.parametrize(
    "changes, told",
    [
        ({"comm": None}, r"observation\.radio=true: say how far radios reach"),
        ({"time_limit": None}, r"observation\.radio=true: say how far radios reach"),
        ({"time_limit": 0.0}, "time_limit=0.0 must be above 0"),
        ({"comm": {"reach": 3.0}}, "comm names 'reach': choose among range, line_of_sight, signal"),
        ({"comm": {"range": -1.0}}, r"comm\.range=-1\.0 must be"),
        ({"comm": 3.0}, r"comm=3\.0: give a CommConfig"),
        ({"comm": {"base_station": True}}, "comm.base_station=True says no place"),
        ({"comm": {"strategy": "relay"}}, "comm.strategy=relay is for the simulator"),
    ],
)
def test_bad_input_is_named(folder, changes, told):
    with pytest.raises(ValueError, match=told):
        alone(folder, **changes)


def test_what_is_not_told_of_radios_takes_none(folder):
    with pytest.raises(ValueError, match="comm= is for policies trained with observation.radio=true, and cost_utility"):
        TeamPlanner("cost_utility", comm={"range": 3.0})
    with pytest.raises(ValueError, match=r"lookahead\.rollout_policy=.* was trained with observation\.radio=true"):
        TeamPlanner("lookahead", lookahead={"rollout_policy": str(folder)}, **RADIO)
    with pytest.raises(ValueError, match="'base_station' names the base station"):
        RobotPlanner(STATION)
    assert read_comm(None) is None and Memory((0.0, 0.0)).untold("a") == 0.0
    assert not {*FEATURES} & {*RADIO_TABLE} and BASE
