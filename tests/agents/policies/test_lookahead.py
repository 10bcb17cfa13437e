"""Planning by rollouts: what it knows, what it chooses, and that it chooses well."""

import json

import numpy as np
import pytest
import torch
from worlds import room

from maexp.agents.cli import main
from maexp.agents.evaluation.evaluate import evaluate
from maexp.agents.policies import POLICIES
from maexp.agents.policies.lookahead import LookaheadPlanner, list_candidates
from maexp.agents.policies.pretrained import load_policy_folder
from maexp.agents.policies.rollouts import pick_tried
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    LookaheadConfig,
    ObservationConfig,
    PlannerConfig,
    PointCloudMap,
    RadarConfig,
    RobotConfig,
    TargetsConfig,
    make_map,
)
from maexp.envs.maps.nav_grid import bank_block_sides
from maexp.envs.targets.region_action import from_regions


def actions(env, config: LookaheadConfig, steps: int, true_world: bool = False) -> list[torch.Tensor]:
    """Goals of some decisions."""
    planner, found = LookaheadPlanner(env, config, true_world), []
    td = env.reset()
    for _ in range(steps):
        found.append(planner.goals())
        td["agents", "action", "goal"] = found[-1]
        td = env.step(td)["next"].exclude("agents", "reward")
    return found


def changed(world: PointCloudMap, far: tuple[float, float], radius: float = 4.0) -> PointCloudMap:
    """The map with free points turned into walls around a place, its extent as it was."""
    near = np.linalg.norm(world.free[:, :2] - far, axis=1) < radius
    near &= (world.free[:, :2] > world.free[:, :2].min(0) + 2).all(1)
    return PointCloudMap(
        world.free[~near],
        np.concatenate([world.obstacles, world.free[near]]),
        world.resolution,
        name="changed",
        scenario=world.scenario,
    )


@pytest.mark.parametrize("config", [{"horizon": 1}, {"horizon": 2}, {"unknown": "nearest"}, {"unknown": "predicted"}])
def test_nothing_true_leaks(config):
    """Two maps that differ where nobody has looked: the same choices, bit for bit."""
    world = make_map("maze_small", 3)
    other = changed(world, (30.0, 30.0))
    assert other.extent == world.extent and len(other.free) < len(world.free)
    starts = torch.tensor([[4.0, 4.0, 0.3], [4.0, 8.0, 0.0]])
    starts[:, :2] += torch.tensor(world.extent[0])
    found = []
    for floor in (world, other):
        env = ExplorationEnv(floor, num_envs=1, num_robots=2, seed=0)
        free = torch.from_numpy(floor.free[:, :2])
        place = [free[(free - at[:2]).norm(dim=1).argmin()] for at in starts]
        env.set_starts(torch.cat([torch.stack(place), starts[:, 2:]], 1))
        found.append(actions(env, LookaheadConfig(**config), 1))
        known = env.simulation.tensors["viewers_free"][0, 0, : len(floor.free)] != 0
        order = env.bank.order_free[0]
        assert np.linalg.norm(floor.free[order][known.numpy()][:, :2] - (30.0, 30.0), axis=1).min() > 5.0
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_choices_depend_on_neither_batch_nor_repetition():
    worlds = [make_map("maze_small", k) for k in range(3)]
    config = LookaheadConfig(horizon=2)

    def play(count: int) -> list[torch.Tensor]:
        return actions(ExplorationEnv(worlds, num_envs=count, num_robots=3, seed=4), config, 3)

    few, again, many = play(2), play(2), play(5)
    for first, second, third in zip(few, again, many, strict=True):
        assert torch.equal(first, second) and torch.equal(first, third[:2])


@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("true_world", [False, True])
def test_a_team_that_has_lost_a_robot_chooses_the_same_beside_others(lost, true_world):
    """What nobody's departure is worth is known only where it has been played."""
    worlds, found = [make_map("maze_small", k) for k in range(2)], []
    for count in (1, 3):
        env = ExplorationEnv(worlds, num_envs=count, num_robots=3, seed=4)
        planner = LookaheadPlanner(env, LookaheadConfig(margin=0.2), true_world)
        env.reset()
        env.simulation.tensors["collided"][0, lost] = 1
        found.append(planner.goals()[0])
    assert torch.equal(*found)


def test_more_teams_than_are_played_at_once(monkeypatch):
    from maexp.agents.policies import rollouts

    worlds, found = [room(29, 22), room(21, 31, "rotated")], []
    for most in (rollouts.BRANCHES, 7):
        monkeypatch.setattr(rollouts, "BRANCHES", most)
        env = ExplorationEnv(worlds, num_envs=5, num_robots=3, seed=1, local_steps=8, macro_steps=5)
        found.append(actions(env, LookaheadConfig(horizon=2), 2))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_a_single_candidate_is_the_rollout_policy():
    env = ExplorationEnv(make_map("maze_small", 1), num_envs=2, num_robots=3, seed=0)
    found = actions(env, LookaheadConfig(candidates=1), 3)
    env = ExplorationEnv(make_map("maze_small", 1), num_envs=2, num_robots=3, seed=0)
    td = env.rollout(3, POLICIES["multi_criteria"](env))
    for step in range(3):
        action = td["agents", "action"][:, step]
        where = from_regions(env.simulation, action["region"], action["offset"])
        torch.testing.assert_close(found[step], where, atol=1e-5, rtol=0)


@pytest.mark.parametrize("comm", [None, CommConfig(range=6.0)])
def test_a_trained_policy_is_a_base_too(comm):
    """With a single candidate the search drives as the policy does; with more it departs."""

    def play(policy, targets, **lookahead):
        env = ExplorationEnv(
            make_map("indoor_medium", 1),
            num_envs=2,
            num_robots=3,
            seed=0,
            comm=comm,
            lookahead=LookaheadConfig(**lookahead),
            observation=ObservationConfig(pictures=False, targets=targets),
        )
        with torch.no_grad():
            return env.rollout(4, policy(env), break_when_any_done=False)["next", "agents", "observation", "pose"]

    alone = play(lambda env: load_policy_folder("universal", env), 24)
    assert torch.equal(play(POLICIES["lookahead"], 0, rollout_policy="universal", candidates=1), alone)
    searched = play(POLICIES["lookahead"], 0, rollout_policy="universal", candidates=4)
    assert not torch.equal(searched, alone)
    assert not torch.equal(searched, play(POLICIES["lookahead"], 0, candidates=4)), "its base changes nothing"


@pytest.mark.parametrize(
    "settings",
    [
        {"num_robots": 1},
        {"num_robots": 8},
        {"comm": CommConfig(range=6.0)},
        {"comm": CommConfig(range=20.0, line_of_sight=True), "num_robots": 4},
        {"robot": [RobotConfig(kind="differential"), RobotConfig(), RobotConfig(length=1.0, width=0.8)]},
        {"planner": PlannerConfig(name="dwa")},
        {"collision": "footprint"},
        {"targets": TargetsConfig(distinct=False)},
    ],
)
@pytest.mark.parametrize("true_world", [False, True])
def test_plays_every_kind_of_team(settings, true_world):
    env = ExplorationEnv(make_map("maze_small", 2), num_envs=2, seed=0, macro_steps=3, **settings)
    found = actions(env, LookaheadConfig(horizon=2, candidates=3), 3, true_world)
    assert all(torch.isfinite(tensor.float()).all() for tensor in found)
    assert float(env.simulation.tensors["covered"].min()) > 0


@pytest.mark.parametrize("true_world", [False, True])
def test_imagined_decisions_may_be_longer_than_the_env_s(true_world):
    """A team that decides five times as often plays the same futures: its first choice is the same, bit for bit."""
    long, short, myopic = (
        ExplorationEnv(make_map("maze_small", 4), num_envs=3, num_robots=3, seed=1, local_steps=steps)
        for steps in (20, 4, 4)
    )
    found = [
        actions(env, LookaheadConfig("cost_utility", horizon=2, prior=0.0, local_steps=steps), 1, true_world)
        for env, steps in ((long, None), (short, 20), (myopic, None))  # no target so near that it is driven beyond
    ]
    assert all(torch.equal(a, b) for a, b in zip(found[0], found[1], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(found[0], found[2], strict=True))


def test_looking_ahead_pays_in_the_true_world():
    """The reference that cheats is ahead of the planner that it plays on with, on every second map at least."""
    worlds = [make_map("maze_small", 1000 + k) for k in range(12)]
    results = []
    for make in (POLICIES["cost_utility"], POLICIES["clairvoyant"]):
        env = ExplorationEnv(worlds, num_envs=12, num_robots=3, seed=0)
        results.append(evaluate(make(env), env, 12))
    gained = results[1].episodes["coverage_auc"] - results[0].episodes["coverage_auc"]
    assert gained.mean() > 0.005 and (gained > 0).sum() >= 8


def test_candidates_of_branches():
    """Branch k of a team gives each robot the candidate that it tries."""
    offered = torch.arange(2 * 3 * 4).view(2, 3, 4)  # [T, N, K]
    tried = torch.tensor([[[0, 1, 2], [3, 1, 2]], [[1, 1, 1], [0, 0, 3]]])  # [T, branches, N]
    wanted = [[0, 5, 10], [3, 5, 10], [13, 17, 21], [12, 16, 23]]
    assert pick_tried(offered, tried).tolist() == wanted


def test_candidates_begin_with_the_own_choice():
    preference = torch.tensor([[[3.0, 1.0, -torch.inf, 2.0], [0.0, 5.0, 4.0, -torch.inf]]])
    assert list_candidates(preference, torch.tensor([[1, -1]]), 3).tolist() == [[[1, 0, 3], [-1, 1, 2]]]
    assert list_candidates(preference, torch.tensor([[0, 2]]), 5).tolist() == [[[0, 3, 1, -1, -1], [2, 1, 0, -1, -1]]]


def test_robots_go_to_different_targets():
    """Whatever branches say, as long as targets are left."""
    env = ExplorationEnv([make_map("maze_small", 5)], num_envs=4, num_robots=4, seed=3)
    planner, td = LookaheadPlanner(env), env.reset()
    for _ in range(6):
        scene = planner.look()
        chosen, waits = planner.choose(scene)
        assert not (waits & (scene.travel.isfinite().sum(-1) > 4)).any()
        for team, robots in enumerate(chosen.tolist()):
            named = [robot for robot in robots if robot >= 0]
            assert len(set(named)) == len(named), (team, robots)
        td["agents", "action", "goal"] = planner.goals()
        td = env.step(td)["next"].exclude("agents", "reward")


@pytest.mark.parametrize(
    "name, value",
    [
        ("candidates", 0),
        ("candidates", 2.5),
        ("horizon", 101),
        ("margin", -1.0),
        ("rest", float("nan")),
        ("unknown", "rooms"),
        ("loss", True),
        ("local_steps", 0),
    ],
)
def test_bad_settings_are_named(name, value):
    with pytest.raises(ValueError, match=f"lookahead.{name}="):
        ExplorationEnv(make_map("maze_small", 0), lookahead=LookaheadConfig(**{name: value}))


def test_an_unknown_rollout_policy_is_named():
    env = ExplorationEnv(make_map("maze_small", 0), lookahead=LookaheadConfig(rollout_policy="tours"))
    with pytest.raises(ValueError, match="lookahead.rollout_policy='tours' is unknown"):
        POLICIES["lookahead"](env)


def test_it_competes_with_the_classical_planners(tmp_path):
    """`maexp evaluate` tells how far it is ahead, and its share of the headroom where that was played."""
    specs = ["policy=lookahead,cost_utility,clairvoyant", "scenario=maze_small", "episodes=4", "num_envs=4"]
    assert main(["evaluate", *specs, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    found = json.loads((tmp_path / "run" / "results.json").read_text())
    assert "coverage_auc" in found["difference"]["lookahead"]["cost_utility"]
    assert set(found["difference"]) == {"lookahead"} and set(found.get("headroom_share", {})) <= {"lookahead"}


def test_imagined_worlds_hold_the_blocks_of_a_radar_that_reaches_beyond_the_map():
    env = ExplorationEnv([room(29, 22), room(21, 31)], num_envs=2, radar=RadarConfig(range=40.0))
    branches = LookaheadPlanner(env, LookaheadConfig(horizon=2)).rollouts.branches
    sizes, blocks = branches.sizes, branches.tracker.nav.blocks
    assert sizes.block.tolist() == bank_block_sides(env.bank, 40.0).tolist()
    assert blocks.num_blocks >= (-(-sizes.width // sizes.block) * -(-sizes.height // sizes.block)).max()
