"""What a planner knows of its env: the team's grid, targets and ways to them, places as actions, open ground."""

import math

import numpy as np
import pytest
import torch
from mazes import GOAL, OFFSET, REGION, make_env
from oracle.grid import frontier_cells, geodesic_distance
from oracle.pace import look_around
from worlds import room, ways_to_blocks

from maexp.envs import RadarConfig, RobotConfig, make_map
from maexp.envs.targets.navigation import Navigation
from maexp.envs.targets.region_action import to_regions
from maexp.envs.targets.tracker import keyed_uniform
from maexp.kernels.constants import FREE, OBSTACLE, RAYS, UNKNOWN, UNREACHED, block_sides


def test_navigation_shows_what_the_team_knows():
    env = make_env(3)
    env.reset()
    nav = Navigation(env)
    nav.update()
    for e in range(3):
        shot = env.snapshot(e)
        place = shot["map"]
        side = int(round(place.extent[1][0] - place.extent[0][0])) + 1
        known = np.zeros((side, side), np.uint8)
        for points, seen, kind in (
            (place.free, shot["seen_free"], FREE),
            (place.boundary, shot["seen_boundary"], OBSTACLE),
        ):
            cells = np.round(points[seen.any(axis=0)][:, :2] - np.array(place.extent[0])).astype(int)
            known[cells[:, 1], cells[:, 0]] = kind
        got = nav.known[e, 0].numpy()[: side * side].reshape(side, side)
        np.testing.assert_array_equal(got, known)
        want = frontier_cells(known == FREE, known == OBSTACLE)
        np.testing.assert_array_equal(nav.frontier[e, 0].numpy()[: side * side].reshape(side, side) != 0, want)
        assert nav.size[e, 0].sum() == want.sum() > 0
        for cell in nav.target[e, 0][nav.target[e, 0] >= 0].tolist():
            assert known.flat[cell] == FREE
    assert (known == UNKNOWN).any()


@pytest.mark.parametrize("reach", [500.0, 60.0])
def test_a_radar_that_reaches_beyond_the_map_leaves_more_than_one_target(reach):
    """A quarter of the map's longer side is the most that a block measures; robots agree where they know the map."""
    env = make_env(2, radar=RadarConfig(range=reach))
    side = 9  # of 37 cells
    assert Navigation(env).blocks.block.numpy().tolist() == [side, side] and Navigation(env).num_blocks == 25
    assert block_sides(1.0, reach, 37, 37) == side and block_sides(1.0, reach, math.inf, math.inf) == reach / 4
    assert block_sides(1.0, 10.0, 37, 37) == 2, "what lies within the map counts as before"


def test_travel_and_points_of_targets():
    env = make_env(2, robot=RobotConfig(collision_threshold=0.1))  # nothing is tight: plain distances
    env.reset()
    nav = Navigation(env)
    nav.update()
    travel = ways_to_blocks(nav)
    for e in range(2):
        w = int(nav.width[nav.state["map_id"][e]])
        known = nav.known[e, 0].numpy()[: w * w].reshape(w, w)
        for i in range(3):
            x, y = np.floor(nav.centers()[e, i].numpy() + 0.5).astype(int)
            want = geodesic_distance(known == FREE, [y * w + x]).ravel()
            target = nav.target[e, 0]
            for k in (target >= 0).nonzero().ravel().tolist():
                far = want[target[k]]
                assert travel[e, i, k] == (np.inf if far == UNREACHED else pytest.approx(far / 10))
                point = nav.points(nav.target)[e, 0, k]
                assert point.tolist() == [int(target[k]) % w, int(target[k]) // w]
    assert travel.isfinite().any()


def test_actions_mean_the_points_they_came_from():
    env = make_env(3)
    env.reset()
    points = keyed_uniform(env, 2) * 36.0
    region, offset = to_regions(env.simulation, points)
    td = env.reset()
    td[REGION], td[OFFSET] = region, offset
    env.step(td)
    torch.testing.assert_close(env.simulation.tensors["goal"], points, atol=1e-4, rtol=0)
    td[GOAL], td[REGION] = points, 63 - region
    env.step(td)
    assert torch.equal(env.simulation.tensors["goal"], points), "goals in metres count before regions, to the bit"
    region, offset = to_regions(env.simulation, points + 1000.0)
    assert (region == 63).all() and (offset == 1.0).all()


def test_open_ground_is_where_no_known_obstacle_is_near():
    env = make_env(12, planner="dwa", maps=[make_map("indoor_small", 1)])
    env.reset()
    nav = Navigation(env)
    nav.update()
    ends = nav.centers() + 2.0 * (keyed_uniform(env, 2) - 0.5)
    found = nav.leads_through_open_ground(ends)
    width, radius = int(nav.width[0]), 1.2 * 3.0 * 0.06
    for e in range(12):
        at = (nav.known[e, 0] == OBSTACLE).nonzero()[:, 0].numpy()
        walls = np.stack([at % width, at // width], -1)
        for i in range(3):
            places = np.linspace(nav.centers()[e, i].numpy(), ends[e, i].numpy(), 7)
            cells = np.floor((places - nav.origin[0].numpy()) / float(nav.cell_size[0]))
            cells = cells.clip(0, [width - 1, int(nav.height[0]) - 1])
            gaps = np.linalg.norm(cells[:, None] - walls[None], axis=-1).min(1) * float(nav.cell_size[0])
            assert bool(found[e, i]) == bool((gaps >= radius).any())
    assert found.any() and not found.all()


def test_what_needs_all_envs_is_an_error_where_only_some_are_looked_at():
    env = make_env(2)
    env.reset()
    nav = Navigation(env)
    nav.update()
    place, reach = nav.centers(), torch.ones(2, env.num_robots)
    nowhere = torch.full((2, env.num_robots), -1)
    for name, values in (
        ("grow_trees", (5, 2.0)),
        ("waypoints", (nowhere, place, reach)),
        ("leads_through_open_ground", (place,)),
    ):
        getattr(nav, name)(*values)
        with pytest.raises(RuntimeError, match=f"{name} is about all envs"):
            getattr(nav.some(torch.tensor([1])), name)(*values)


def test_a_radius_beyond_the_map_costs_no_more_than_the_map():
    """Nothing known, looked at from a corner: the longest rays there are."""
    env = make_env(2, maps=[room(16, 23), room(40, 11, spacing=0.4)])
    env.reset()
    nav = Navigation(env)
    nav.update()
    assert len(nav.cell_size.unique()) == len(nav.state["map_id"].unique()) == 2
    unknown = torch.full_like(nav.known, UNKNOWN)
    area, middle = nav.look_around(1e12, torch.zeros(2, 1, 1, dtype=torch.int64), unknown)
    ((rays, _),) = nav._rays.values()
    for e, m in enumerate(nav.state["map_id"].tolist()):
        w, h = int(nav.width[m]), int(nav.height[m])
        total, *way = look_around(np.full((h, w), UNKNOWN), 0, 0, w + h, RAYS)
        assert area[e, 0, 0].item() == pytest.approx(total, rel=1e-4) and total > 0.7 * w * h
        cell = float(nav.cell_size[m])
        np.testing.assert_allclose(middle[e, 0, 0].numpy() / cell, way, rtol=1e-4)
        assert rays.shape[1] <= np.hypot(nav.width.max(), nav.height.max()) + 2
