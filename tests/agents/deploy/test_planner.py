"""The runtime for robots: what it computes is what the kernels compute, and it needs neither torch nor Warp."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from runtime_cases import FeatureInputs, moments
from worlds import ways_to_blocks

from maexp.agents.deploy.planner import grid_search
from maexp.agents.deploy.planner.grid import read_grid
from maexp.agents.deploy.planner.grid_search import grow_trees
from maexp.agents.deploy.planner.team import read_team
from maexp.agents.policies import classical
from maexp.agents.runtime import CHOICES, TeamPlanner
from maexp.envs import RobotConfig
from maexp.envs.targets.heuristics import RRT_SAMPLES
from maexp.kernels.constants import FREE, UNKNOWN

CASES = {
    "indoor": {},
    "maze": {},
    "jittered": {},
    "maze, two sizes": {"robot": [RobotConfig(), RobotConfig(collision_threshold=0.6), RobotConfig()]},
    "indoor, one robot": {"num_robots": 1},
}


def cases(name: str):
    return moments(name.partition(",")[0], **CASES[name])


def survey(now: FeatureInputs):
    """The scene that the runtime makes of a moment."""
    planner, notes = TeamPlanner("nearest_frontier", **now.settings), []
    grid = read_grid(now.call["grid"], now.call["resolution"], now.call["origin"], planner.occupied, notes)
    team = read_team(now.call["poses"], None, planner.robot_radius, notes)
    return planner._look(grid, team, planner.radar_range, notes)


def test_imports_neither_torch_nor_warp():
    code = (
        "import sys, numpy as np\nfrom maexp.agents.runtime import TeamPlanner\n"
        "grid = np.zeros((20, 30), np.int8); grid[:, 20:] = -1\n"
        "plan = TeamPlanner().plan(grid, 0.2, (0, 0), [(1.0, 1.0, 0.0)])\nassert plan.active.all(), plan\n"
        "print([m for m in ('torch', 'warp', 'tensordict', 'torchrl', 'skimage', 'hydra') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "[]", done.stdout + done.stderr


def test_robots_know_the_planners_of_the_simulator():
    beyond = {"oracle", "clairvoyant", "lookahead"}  # what no robot knows, or what needs the simulator
    assert set(CHOICES) == set(classical.POLICIES) - beyond


@pytest.mark.parametrize("name", CASES)
def test_targets_ways_and_gains_are_those_of_the_kernels(name):
    count = 0
    for now in cases(name):
        scene, nav = survey(now), now.nav
        alive = nav.alive()[0].numpy()
        there = nav.target[0, 0].numpy()
        assert np.array_equal(scene.targets.cell, there[there >= 0])
        assert np.array_equal(scene.targets.size, nav.size[0, 0].numpy()[there >= 0])
        cells = scene.distance[0].size
        assert np.array_equal(scene.distance.reshape(-1, cells), nav.distance[0, alive, :cells].numpy())
        travel = ways_to_blocks(nav)[0, alive][:, there >= 0].numpy()
        np.testing.assert_allclose(scene.travel, travel, rtol=1e-6)
        area, middle = (value[0, 0, there >= 0].numpy() for value in nav.look_around(nav.radar_range))
        disc = np.pi * (nav.radar_range / now.call["resolution"]) ** 2
        np.testing.assert_allclose(scene.gain * disc, area, rtol=1e-5)
        np.testing.assert_allclose(scene.middle, middle, atol=1e-4 * nav.radar_range)
        wanted = nav.target.expand(-1, len(alive), -1)
        first = nav.points_on_way(wanted, 3.0)[0, alive][:, there >= 0].numpy() - now.call["origin"]
        wanted = np.tile(scene.targets.cell, (len(scene.robots), 1))
        cells = grid_search.cells_ahead(scene.passable, scene.distance, wanted, 3.0)
        assert np.array_equal(cells >= 0, np.isfinite(travel))
        np.testing.assert_allclose(scene.grid.centers(cells)[cells >= 0], first[cells >= 0], atol=1e-4)
        count += len(there[there >= 0])
    assert count > 20


@pytest.mark.parametrize("name", CASES)
def test_robots_take_the_targets_that_the_policies_take(name):
    for now in cases(name):
        nav = now.nav
        for policy in ("nearest_frontier", "cost_utility", "multi_criteria", "voronoi", "potential_field", "hungarian"):
            # Of several assignments with the same total any will do, and others are then in each other's way.
            distinct = policy != "hungarian"
            plan = TeamPlanner(policy, distinct=distinct, **now.settings).plan(**now.call)
            there = classical.FrontierPlanner(now.env, classical.CLASSICAL[policy])
            there.tracker.body = now.env.simulation.robot_tensors["collision_threshold"]  # here robots are round
            if distinct:
                there(None)
                chosen = there.tracker.state["chosen"][0].squeeze(-1)
            else:
                scene = there.look()
                chosen = scene.block[0].gather(1, there.rank(scene)[0].argmax(-1, keepdim=True)).squeeze(-1)
                chosen = torch.where(scene.travel[0].isfinite().any(-1), chosen, -1)
            assert np.array_equal(plan.active, (chosen >= 0).numpy())
            wanted = nav.points(nav.target[:, 0, chosen.clamp_min(0)])[0].numpy()
            if policy == "hungarian":
                ours, theirs = (total_way(nav, goals) for goals in (plan.goals, wanted))
                assert ours == pytest.approx(theirs, rel=1e-3)
            else:
                np.testing.assert_allclose(plan.goals[plan.active], wanted[plan.active], atol=1e-4, err_msg=policy)


def test_a_planner_of_ones_own_chooses_the_same_for_robots():
    """One function for both: here the largest frontier."""

    def rank_largest(scene):
        return scene.xp.where(scene.xp.isfinite(scene.travel), scene.size, -scene.xp.inf)

    for now in cases("indoor"):
        ours, there = survey(now), classical.FrontierPlanner(now.env, rank_largest).look()
        theirs = rank_largest(there)[0, now.nav.alive()[0]][:, (there.cells()[0, 0] >= 0)].numpy()
        np.testing.assert_array_equal(rank_largest(ours), theirs)


def total_way(nav, goals) -> float:
    points = nav.points(nav.target.clamp_min(0))[0]
    gap = (points - torch.as_tensor(goals).unsqueeze(1)).norm(dim=-1)
    nearest = gap.masked_fill(nav.target[0, :1] < 0, torch.inf).argmin(-1)
    return float(ways_to_blocks(nav)[0].gather(1, nearest.unsqueeze(1)).sum())


def test_trees_find_frontiers_as_those_of_the_kernels_do():
    ours, theirs = 0, 0
    for now in cases("indoor"):
        scene = survey(now)
        y, x = np.divmod(
            grow_trees(scene.grid, scene.at, scene.rng, RRT_SAMPLES, 0.5 * scene.radar_range), scene.grid.width
        )
        blocks = scene.targets.block_of(x, y)
        ours += len({tuple(block) for block in blocks.tolist()})
        theirs += int(now.nav.grow_trees(RRT_SAMPLES, 0.5 * now.nav.radar_range).sum())
    assert ours == pytest.approx(theirs, rel=0.2)


def grow_one_by_one(scene) -> list[int]:
    """What `grow_trees` does, in plain loops: one tree, one sample, one cell after the other."""
    grid, ends = scene.grid, []
    branch = 0.5 * scene.radar_range / grid.cell
    for at in scene.at:
        nodes = [at / grid.cell]
        for point in scene.rng.random((RRT_SAMPLES, 2)) * (grid.width, grid.height):
            gaps = [math.hypot(*(point - node)) for node in nodes]
            start, gap = nodes[int(np.argmin(gaps))], min(gaps)
            way, last = (point - start) * min(1.0, branch / gap), -1
            steps = 1 + int(2.0 * min(gap, branch))
            for k in range(steps + 1):
                x, y = (start + way * k / steps).astype(int)
                if grid.known[y, x] != FREE:
                    if last >= 0 and grid.known[y, x] == UNKNOWN:
                        ends.append(last)
                    break
                last = y * grid.width + x
            else:
                nodes.append(start + way)
    return ends


def test_trees_are_those_of_plain_loops():
    scene = survey(next(iter(cases("indoor"))))
    twin = replace(scene, rng=np.random.default_rng(3))
    scene = replace(scene, rng=np.random.default_rng(3))
    ours, theirs = (
        grow_trees(scene.grid, scene.at, scene.rng, RRT_SAMPLES, 0.5 * scene.radar_range),
        grow_one_by_one(twin),
    )
    assert len(theirs) > 20 and np.array_equal(np.sort(ours), np.sort(theirs))
