"""Every stage of the local step against its oracle, from the state the kernels themselves had before it."""

import math

import numpy as np
import pytest
import torch
from oracle import dwa, motion, picture, radar, team
from worlds import act, inputs, room

from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    ObservationConfig,
    PlannerConfig,
    RadarConfig,
    RewardConfig,
    RobotConfig,
)

pytestmark = pytest.mark.kernels

SMALL = {"length": 0.8, "width": 0.5, "max_speed": 3.0, "max_accel": 6.0, "collision_threshold": 0.35}


def robots() -> list[RobotConfig]:
    """Four robots no two of which are alike."""
    return [
        RobotConfig(wheelbase=0.8, max_steer=1.0, **SMALL),
        RobotConfig(kind="differential", max_yaw_rate=2.0, **SMALL | {"length": 0.6, "max_speed": 2.2}),
        RobotConfig(kind="omnidirectional", **SMALL | {"width": 0.7, "collision_threshold": 0.45}),
        RobotConfig(wheelbase=0.4, max_steer=0.6, **SMALL | {"length": 1.1, "max_accel": 4.0}),
    ]


def radars(**settings) -> list[RadarConfig]:
    """A lidar, two of other reach, and a camera."""
    return [
        RadarConfig(range=5.2, **settings),
        RadarConfig(range=3.7, alpha1=0.02, **settings),
        RadarConfig(range=6.1, alpha2=0.05, **settings),
        RadarConfig(range=5.6, fov=1.9, **settings),
    ]


CASES = {
    "dwa": {},
    "footprint": {"collision": "footprint"},
    "direct": {"planner": PlannerConfig(name="direct")},
    "crashes": {"planner": PlannerConfig(name="direct"), "collision": "footprint"},
    "deaf": {"comm": CommConfig(range=4.0)},
    "points": {"radar": radars(obstacle_radius=0.0)},
    "known": {"comm": CommConfig(range=6.0), "radar": radars(obstacle_radius=0.8)},
}


@pytest.fixture(scope="module", params=CASES)
def episode(request):
    """`(env, moments)`: for each of two envs on maps of different size, the states along some local steps."""
    maps = [room(17, 11, "rotated", 1), room(13, 14, "mixed", 2), room(11, 15, "jittered", 3)]
    settings = {"planner": PlannerConfig(name="dwa", num_steering=7, clearance_factor=4.0), "radar": radars()}
    settings["reward"] = RewardConfig(overlap=0.01)
    env = ExplorationEnv(
        maps,
        3,
        4,
        seed=5,
        robot=robots(),
        local_steps=1,
        macro_steps=1000,
        success_coverage=1.0,
        num_threads=2,
        **settings | CASES[request.param],
    )
    generator = torch.Generator().manual_seed(3)
    env.reset()
    moments = [[inputs(env, e)] for e in range(3)]
    action = act(env, generator)
    for step in range(14):
        if step % 5 == 4:
            action = act(env, generator)
        env.step(action.clone())
        for e in range(3):
            moments[e].append(inputs(env, e))
    return env, moments


def pairs(episode, stride: int = 1):
    """`(env, before, after)` of the steps to look at."""
    env, moments = episode
    for k, line in enumerate(moments):
        for step in range(k % stride, len(line) - 1, stride):
            yield env, line[step], line[step + 1]


def body(env, i: int, pose):
    """State of the rear of robot i, its length and width."""
    config = env.robot_configs[i]
    return motion.rear_state(pose, config.length, config.kind), config.length, config.width


def move(config, state, slip, control, limited: bool):
    """Next `(state, slip)` of a robot by its kind; `limited` False: predicted as DWA does."""
    limits = {"max_accel": config.max_accel, "max_speed": config.max_speed if limited else math.inf}
    if config.kind == "ackermann":
        limits |= {"max_steer": config.max_steer, "wheelbase": config.wheelbase}
        return motion.ackermann(state, control, **limits), slip
    if config.kind == "differential":
        return motion.differential(state, control, max_yaw_rate=config.max_yaw_rate, **limits), slip
    return motion.omnidirectional(state, slip, control, **limits)


def turn_limit(config) -> float:
    """Bound of the second control: steering [rad], yaw rate [rad/s] or sideways acceleration [m/s^2]."""
    return {"ackermann": config.max_steer, "differential": config.max_yaw_rate}.get(config.kind, config.max_accel)


def test_motion(episode):
    moved = 0
    for env, before, after in pairs(episode):
        for i, config in enumerate(env.robot_configs):
            want, slip = move(config, before.pose[i], before.slip[i], after.control[i], True)
            way = math.hypot(before.pose[i][2], before.slip[i]) * 0.1
            if before.collided[i]:
                want, slip, way = before.pose[i], before.slip[i], 0.0
            if after.collided[i]:  # it moved into the obstacle and stops there
                want, slip = [*want[:2], 0.0, want[3]], 0.0
            np.testing.assert_allclose(after.pose[i][:3], want[:3], atol=1e-5)
            assert abs(radar.wrap(float(after.pose[i][3]) - want[3])) < 1e-5
            assert -math.pi - 1e-6 <= after.pose[i][3] <= math.pi + 1e-6
            np.testing.assert_allclose(after.slip[i], slip, atol=1e-5)
            middle = motion.center(body(env, i, after.pose[i])[0], config.length)
            np.testing.assert_allclose(after.center[i], middle, atol=1e-5)
            np.testing.assert_allclose(after.path_length[i] - before.path_length[i], way, atol=1e-5)
            moved += way > 0.0
    assert moved > 50


def test_dwa_takes_the_best_candidate(episode):
    env, _ = episode
    if env.planner_config.name != "dwa":
        pytest.skip("controls come from the policy here")
    footprint, factor, avoided = env.collision == "footprint", env.planner_config.clearance_factor, 0
    for _, before, after in pairs(episode, 4):
        m = before.map
        for i, config in enumerate(env.robot_configs):
            if before.collided[i]:
                continue
            reach, here = env.radar_configs[i].range, before.center[i]
            known = m.boundary[before.known_boundary[i], :2].astype(np.float64)
            known = [p for p in known if radar.distance(p, here) <= reach]
            others = [
                body(env, j, before.pose[j])
                for j in range(env.num_robots)
                if j != i and radar.distance(before.center[j], here) <= reach
            ]

            def gap(ahead, i=i, config=config, known=known, others=others):
                state, size = body(env, i, ahead[0])[0], (config.length, config.width)
                middle = motion.center(state, config.length)
                gaps = [math.inf]
                for p in known:
                    gaps.append(motion.point_to_body(p, state, *size) if footprint else radar.distance(p, middle))
                for other, *extent in others:
                    if footprint:
                        gaps.append(motion.body_to_body(state, size, other, extent))
                    else:
                        gaps.append(motion.point_to_body(middle, other, *extent))
                return max(min(gaps), 1e-6)

            turn = turn_limit(config)
            controls = dwa.candidates(config.max_accel, turn, env.planner_config.num_steering)
            values = dwa.scores(
                (before.pose[i], before.slip[i]),
                after.waypoint[i],
                controls,
                move=lambda s, u, config=config: move(config, *s, u, False),
                middle=lambda s, i=i, config=config: motion.center(body(env, i, s[0])[0], config.length),
                gap=gap,
                clearance=factor * config.collision_threshold,
            )
            chosen = int(np.argmin(np.abs(controls - after.control[i]).sum(1)))
            np.testing.assert_allclose(controls[chosen], after.control[i], atol=1e-5)
            assert values[chosen] >= values.max() - 2e-3, (i, chosen, dwa.first_best(values))
            avoided += values.min() < -radar.distance(here, after.waypoint[i]) - 5.0
    assert avoided > 0


def test_direct_controls_are_shares_of_the_limits(episode):
    env, _ = episode
    if env.planner_config.name == "direct":
        for env, _, after in pairs(episode):
            for i, config in enumerate(env.robot_configs):
                assert abs(after.control[i][0]) <= config.max_accel
                assert abs(after.control[i][1]) <= turn_limit(config) + 1e-6


def test_collisions(episode):
    hits = 0
    for env, before, after in pairs(episode):
        states, lengths, widths = zip(*(body(env, i, p) for i, p in enumerate(after.pose)), strict=True)
        thresholds = [r.collision_threshold for r in env.robot_configs]
        mode = env.collision
        if mode == "footprint":
            thresholds = [0.0] * env.num_robots
        want, margin = motion.collided(states, lengths, widths, thresholds, after.map.boundary, mode=mode)
        first = want & (before.collided == 0)
        sure = (margin > 1e-5) | (before.collided != 0)
        if before.active:
            np.testing.assert_array_equal(after.crashed[sure] != 0, first[sure])
            np.testing.assert_array_equal(after.collided != 0, (before.collided != 0) | (after.crashed != 0))
        hits += int(first.sum())
    if episode[0].planner_config.name == "direct":
        assert hits > 0


def occluders(env, now, i: int):
    """What masks robot i's radar: static points and the outlines of the others, with their radii."""
    m, setting = now.map, env.radar_configs[i].obstacle_radius
    spacing = np.maximum(m.resolution, m.boundary_spacing)
    if setting == "auto":
        walls, radii = m.boundary, spacing / math.sqrt(2.0)
    elif setting >= spacing.max() / math.sqrt(2.0):
        walls, radii = m.boundary, np.full(len(m.boundary), setting)
    else:
        walls, radii = m.obstacles, np.full(len(m.obstacles), setting)
    for j in range(env.num_robots):
        if j != i:
            ring, step = motion.outline(*body(env, j, now.pose[j]), m.resolution)
            rho = step / math.sqrt(2.0) if setting == "auto" else min(setting, step / math.sqrt(2.0))
            walls = np.concatenate([walls, np.pad(ring, ((0, 0), (0, 1)))])
            radii = np.concatenate([radii, np.full(len(ring), rho)])
    return walls, radii


def test_scan(episode):
    total, unclear = 0, 0
    for env, before, after in pairs(episode, 7):
        if not before.active:
            continue
        for i, config in enumerate(env.radar_configs):
            origin = np.append(after.center[i], 0.0)
            walls, radii = occluders(env, after, i)
            want, clear = radar.visible_points(
                after.map.free,
                walls,
                origin,
                config.range,
                config.alpha1,
                config.alpha2,
                radii,
                heading=float(after.pose[i][3]),
                fov=config.fov,
                tolerance=2e-5,
            )
            np.testing.assert_array_equal(after.visible[i][clear], want[clear])
            total, unclear = total + want.sum(), unclear + (~clear).sum()
            np.testing.assert_array_equal(after.seen_free[i], before.seen_free[i] | after.visible[i])
            near, sure = radar.seen_boundary(
                after.map.boundary,
                after.map.free,
                after.visible[i],
                origin,
                config.range,
                1.5 * np.maximum(after.map.resolution, after.map.boundary_spacing) * (1.0 + 1e-5),
            )
            np.testing.assert_array_equal(after.seen_boundary[i][sure], (before.seen_boundary[i] | near)[sure])
    assert total > 300 and unclear < 0.05 * total


def test_counts_reward_and_end(episode):
    for env, before, after in pairs(episode):
        if not before.active:
            continue
        weights = team.area_weights(after.map.free_spacing)
        area = weights.sum()
        unit = area / float(env.simulation.map_tensors["total_weight"][int(after.map_id)])
        new, overlap = team.counts(before.seen_free, after.visible, weights)
        np.testing.assert_allclose(after.discovered * unit, new, rtol=1e-6)
        np.testing.assert_allclose(after.overlap * unit, overlap, rtol=1e-6)
        np.testing.assert_allclose(after.coverage, team.coverage(after.seen_free, weights), rtol=1e-6)
        shared = after.shared / max(int(after.covered), 1)
        np.testing.assert_allclose(shared, team.mutual_overlap(after.seen_free, weights), rtol=1e-6)
        success = before.coverage < env.success_coverage <= after.coverage
        charged = team.steps_charged(after.collided, after.coverage, after.step, 1000, env.success_coverage)
        terms = team.reward_terms(
            new,
            overlap,
            before.coverage,
            success,
            after.crashed != 0,
            area,
            coverage_now=after.coverage,
            charged=charged,
        )
        for k, name in enumerate(("explore", "overlap", "time", "success", "collision")):
            np.testing.assert_allclose(after.terms[:, k], terms[name], rtol=1e-5, atol=1e-7, err_msg=name)
        over = team.terminated(after.coverage, after.collided, env.success_coverage)
        assert (after.terminated != 0) == over and (after.active != 0) == (not over)


def test_milestones():
    """Each share is noted in the local step that reaches it, with the overlap and the ways of that moment."""
    env = ExplorationEnv(
        [room(17, 11, "mixed", 1), room(13, 14, "rotated", 2)],
        4,
        2,
        seed=5,
        radar=RadarConfig(range=8.0),
        robot=RobotConfig(collision_threshold=0.2),
        local_steps=1,
        macro_steps=1000,
        success_coverage=1.0,
    )
    generator, lines = torch.Generator().manual_seed(3), [[] for _ in range(4)]
    env.reset()
    actions = [act(env, generator) for _ in range(20)]
    for step in range(160):
        env.step(actions[step // 8].clone())
        for e, line in enumerate(lines):
            line.append(inputs(env, e))
    counts = [0, 0, 0]
    for line in lines:
        weights = team.area_weights(line[0].map.free_spacing)
        shares = [team.coverage(now.seen_free, weights) for now in line]
        for k, mark in enumerate((0.85, 0.95, 0.99)):
            reached = [now for now, share in zip(line, shares, strict=True) if share >= mark - 1e-9]
            assert line[-1].milestone_step[k] == (reached[0].step if reached else -1)
            if reached:
                counts[k] += reached[0] is not line[0]
                want = team.mutual_overlap(reached[0].seen_free, weights)
                np.testing.assert_allclose(line[-1].milestone_overlap[k], want, rtol=1e-5)
                np.testing.assert_array_equal(line[-1].milestone_path[:, k], reached[0].path_length)
    assert min(counts) >= 1, f"marks reached on the way: {counts}"


def test_what_robots_know_travels_one_hop_a_step(episode):
    env, _ = episode
    if not env.comm_config.limited:
        pytest.skip("everyone hears everyone")
    partial = 0
    for env, before, after in pairs(episode):
        if not before.active:
            continue
        n = env.num_robots
        gaps = np.array([[radar.distance(a, b) for b in after.center] for a in after.center])
        assert (np.abs(gaps - env.comm_config.range) > 1e-5).all()
        hears = gaps <= env.comm_config.range
        partial += 0 < hears.sum() - n < n * (n - 1)
        for what in ("free", "boundary"):
            heard = getattr(before, f"known_{what}") | getattr(after, f"seen_{what}")
            want = team.merge_maps(heard[None], hears[None])[0]
            np.testing.assert_array_equal(getattr(after, f"known_{what}"), want)
    assert partial > 0


def draw_points(m, free, boundary) -> np.ndarray:
    """Channels 0 to 2 of robots for whom these points of a map are drawn, uint8 [N, 3, 125, 125]."""
    corner, size = picture.frame(m.extent)
    points = np.concatenate([m.free, m.boundary])
    spacing = np.concatenate([m.free_spacing, m.boundary_spacing])
    shown = picture.shown_points(points, spacing / math.sqrt(2.0) * (1.0 + 1e-6), corner, size)
    flags = np.concatenate([free, boundary], axis=1)
    want = np.zeros((len(flags), 3, 125, 125), np.uint8)
    for (ix, iy), listed in shown.items():
        for p in listed:
            want[:, 0 if p < len(m.free) else 1, ix, iy] |= (flags[:, p] * 255).astype(np.uint8)
            if p < len(m.free):
                want[:, 2, ix, iy] |= flags[:, p]
    return want


@pytest.mark.parametrize("count", [2, 32])
def test_pictures_of_what_robots_know_beside_a_base_station(count):
    """Which has none: its row of flags comes after the robots', in a word of its own after 32."""
    comm = CommConfig(range=4.0, base_station=True)
    settings = dict(comm=comm, observation=ObservationConfig(map="known"), local_steps=5, seed=4)
    env = ExplorationEnv(room(40, 40, "rotated", 1), 3, count, **settings)
    td, generator = env.reset(), torch.Generator().manual_seed(3)
    for _ in range(4):
        td = env.step(act(env, generator))["next"]
    for e in range(3):
        now = inputs(env, e)
        want = draw_points(now.map, now.known_free, now.known_boundary)
        np.testing.assert_array_equal(td["agents", "observation", "map"][e, :, :2].numpy(), want[:, :2])
        assert env.simulation.tensors["known_weight"][e, count] > 0 and want[:, 0].any()


def test_pictures():
    """The picture of the design from the flags, the poses and the past."""
    env = ExplorationEnv(
        [room(17, 11, "rotated", 1), room(13, 14, "mixed", 2)],
        2,
        4,
        seed=8,
        robot=robots(),
        radar=radars(),
        planner=PlannerConfig(name="direct"),
        local_steps=1,
        macro_steps=100,
    )
    td, generator = env.reset(), torch.Generator().manual_seed(3)
    past = [[inputs(env, e).center for e in range(2)]]
    for _ in range(25):
        td = env.step(act(env, generator))["next"]
        past.append([inputs(env, e).center for e in range(2)])
    pictures, teams = td["agents", "observation", "map"].numpy(), td["team", "map"].numpy()
    for e in range(2):
        now = inputs(env, e)
        m = now.map
        corner, size = picture.frame(m.extent)
        want = draw_points(m, now.seen_free, now.seen_boundary)
        np.testing.assert_array_equal(pictures[e, :, :2], want[:, :2])
        np.testing.assert_array_equal(teams[e, :2], want[:, :2].max(0))
        np.testing.assert_array_equal(teams[e, 2], want[:, 2].sum(0))
        assert (want[:, 0] > 0).sum() > 1000 and (want[:, 1] > 0).sum() > 100
        depth = np.stack([picture.footprint(*body(env, i, now.pose[i]), corner, size) for i in range(4)])
        for i in range(4):
            middle = picture.nearest_pixel(now.center[i], corner, size)
            sure = (np.abs(depth) > 1e-4).all(0)
            for j in range(4):  # the pixel under a body's middle is always drawn
                sure[picture.nearest_pixel(now.center[j], corner, size)] = False
            body_now = np.where((np.delete(depth, i, 0) > 0.0).any(0), 128, 0)
            body_now = np.where(depth[i] > 0.0, 255, body_now)
            np.testing.assert_array_equal(pictures[e, i, 2][sure], body_now[sure])
            assert pictures[e, i, 2][middle] == 255
            trail = pictures[e, i, 3]
            greys = {round(picture.fade(age)) for age in range(26)}
            assert set(np.unique(trail)) <= greys | {0} and trail[middle] == 255
            for age, centers in enumerate(reversed(past)):
                where = picture.nearest_pixel(centers[e][i], corner, size)
                assert trail[where] >= round(picture.fade(age))
        assert len(np.unique(pictures[e, :, 3])) > 5  # it really fades
