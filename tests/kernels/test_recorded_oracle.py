"""The oracles against arrays recorded from the original platform, where the design decides as it did."""

import math

import numpy as np
import pytest
from oracle import dwa, motion, radar


@pytest.fixture(scope="module")
def maze(oracle_dir):
    with np.load(oracle_dir / "map_maze.npz") as arrays:
        return {name: arrays[name] for name in arrays}


@pytest.mark.parametrize(
    "verdict, skip, alpha1", [("visible_paper", "tight_paper", 1e-3), ("visible_code", "tight_code", 0.011)]
)
def test_masking_agrees_with_every_recorded_pose(oracle_dir, maze, verdict, skip, alpha1):
    with np.load(oracle_dir / "masking_maze.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays}
    compared = 0
    for k, origin in enumerate(recorded["center"]):
        obstacles = np.concatenate([maze["obstacles"], recorded["other_body"][k]])
        near = np.linalg.norm(maze["freespace"] - origin, axis=1) <= 10.5  # beyond, both say no
        assert not recorded[verdict][k][~near].any()
        visible, clear = radar.visible_points(maze["freespace"][near], obstacles, origin, 10.0, alpha1=alpha1)
        differ = (visible != recorded[verdict][k][near]) & ~recorded[skip][k][near]
        # What we call too close must cover all that the recording's float32 decides otherwise.
        assert not (differ & clear).any(), f"pose {k}: {np.flatnonzero(differ & clear)}"
        assert differ.sum() <= 1
        compared += int((clear & visible).sum())
    assert compared > 2000  # of 24 poses: not all skipped


def test_motion_agrees_with_the_recorded_transitions(oracle_dir):
    with np.load(oracle_dir / "dynamics.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays}
    length, wheelbase = float(recorded["length_m"]), float(recorded["width_m"])
    for k in range(len(recorded["state"])):
        after = recorded["state"][k].astype(np.float64)
        if not recorded["destroyed"][k]:
            after = motion.ackermann(
                after,
                recorded["action_applied"][k],
                max_speed=math.inf,  # the original refuses to accelerate instead: `action_applied`
                max_accel=2.0,
                max_steer=math.pi / 3 + 1e-6,
                wheelbase=wheelbase,
            )
        np.testing.assert_allclose(after[:3], recorded["next_state"][k][:3], atol=2e-5)
        assert abs(radar.wrap(after[3] - float(recorded["next_state"][k][3]))) < 2e-6
        np.testing.assert_allclose(motion.center(after, length), recorded["next_center"][k], atol=2e-5)


def test_recorded_body_points_lie_in_our_footprint(oracle_dir):
    with np.load(oracle_dir / "dynamics.npz") as arrays:
        states, bodies = arrays["next_state"], arrays["next_body"]
        length, width = float(arrays["length_m"]), float(arrays["width_m"])
    for state, body in zip(states[: len(bodies)], bodies, strict=True):
        for point in body:
            assert motion.point_to_body(point, state, length, width) < 2e-5
        for corner in motion.corners(state, length, width):
            assert min(radar.distance(corner, point[:2]) for point in body) < 2e-5


def test_dwa_scores_and_choices_agree_with_the_recorded_cases(oracle_dir):
    with np.load(oracle_dir / "dwa_maze.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays}
    controls = dwa.candidates(2.0, math.pi / 3, 25)
    np.testing.assert_allclose(controls, recorded["candidates"], atol=1e-6)
    clearance = float(recorded["multi_para"]) * float(recorded["collision_threshold_m"])
    offsets = recorded["obstacle_offsets"]
    unlimited = {"max_speed": math.inf, "max_accel": math.inf, "max_steer": math.inf}

    def drive(state, control):
        return motion.ackermann(state, control, wheelbase=1.0, **unlimited)

    for k in range(len(offsets) - 1):
        near = recorded["obstacle_points"][offsets[k] : offsets[k + 1]]
        near = np.concatenate([near, np.zeros((1, 2))])  # a quirk of the recording: one obstacle at (0, 0)
        near = near[np.linalg.norm(near - recorded["state"][k, :2], axis=1) < 8.0]  # none beyond can score
        state, goal = recorded["state"][k], recorded["goal"][k]
        gaps: list[float] = []

        def gap(ahead, near=near, gaps=gaps):
            gaps.append(min(radar.distance(p, motion.center(ahead, 1.5)) for p in near))
            return gaps[-1]

        values = dwa.scores(
            state,
            goal,
            controls,
            move=drive,
            middle=lambda s: motion.center(s, 1.5),
            gap=gap,
            clearance=clearance,
        )
        gaps = np.asarray(gaps)
        # 100 ln d in float32: the recording's distances are good to some 5e-5 m near 0.
        assert (np.abs(values - recorded["scores"][k]) < 1e-4 + 5e-3 / gaps**2).all()
        assert np.abs(values - recorded["scores"][k])[gaps > 0.5].max() < 3e-3
        if recorded["gap_to_second"][k] > 1e-3:
            chosen = controls[dwa.first_best(values)]
            np.testing.assert_allclose(chosen, recorded["chosen_action"][k], atol=1e-6)


@pytest.mark.parametrize("suffix, factor", [("", 1.0), ("_init", 3.0)])
def test_collision_agrees_with_the_recorded_rear_points(oracle_dir, maze, suffix, factor):
    with np.load(oracle_dir / "collision_maze.npz") as arrays:
        recorded = {name: arrays[name] for name in arrays}
    threshold = factor * float(recorded["threshold_m"])
    hits = 0
    for states, hit, body in zip(
        recorded["state"], recorded["hit_point" + suffix], recorded["hit_body" + suffix], strict=True
    ):
        states = states.astype(np.float64)
        near = np.concatenate(
            [maze["boundary"][np.linalg.norm(maze["boundary"][:, :2] - s[:2], axis=1) < 5.0] for s in states]
        )
        # The original tests the rear point: a body of length 0 has its centre there.
        ours, margin = motion.collided(states, [0.0] * 3, [0.0] * 3, [threshold] * 3, near)
        assert (ours == hit)[margin > 1e-5].all()
        outlined, _ = motion.collided(states, [1.5] * 3, [1.0] * 3, [threshold + 1e-5] * 3, near, mode="footprint")
        assert (outlined | ~body).all()  # 25 points of the body cannot hit more than all of it
        hits += int(hit.sum())
    assert 50 < hits < 590
