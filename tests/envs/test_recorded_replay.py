"""An episode recorded from the original platform, driven anew by our env from the same starts to the same goals."""

import numpy as np
import pytest
import torch

from maexp.envs import ExplorationEnv, PlannerConfig, PointCloudMap, RobotConfig

LENGTH = 1.5


@pytest.fixture(scope="module")
def recorded(oracle_dir):
    """The arrays of the episode, the map they were recorded on, and the ways of the rear points [m]."""
    with np.load(oracle_dir / "episode_maze_n3.npz") as arrays:
        episode = dict(arrays)
    with np.load(oracle_dir / "map_maze.npz") as arrays:
        place = PointCloudMap(arrays["freespace"], arrays["obstacles"], 1.0, name="recorded", scenario="maze")
    at = np.concatenate([episode["initial_state"][None], episode["state"]])[..., :2]
    return episode, place, np.linalg.norm(np.diff(at, axis=0), axis=-1).sum(0)


def replay(recorded, **robot) -> tuple[np.ndarray, np.ndarray]:
    """Ways of the robots [m], and their rear points after every local step, [200, N, 2]."""
    episode, place, _ = recorded
    env = ExplorationEnv(
        place,
        num_robots=3,
        num_threads=1,
        macro_steps=10,
        robot=RobotConfig(**robot),
        planner=PlannerConfig(name="dwa", clearance_factor=4.0),
    )
    x, y, speed, heading = episode["initial_state"].T
    assert not speed.any()
    ahead = 0.5 * LENGTH * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    env.set_starts(np.column_stack([x + ahead[:, 0], y + ahead[:, 1], heading]))
    env.reset()
    state, rear = env.simulation.tensors, []
    np.testing.assert_allclose(state["pose"][0, :, :2], np.stack([x, y], axis=1), atol=1e-4)
    for goal in episode["g_goal"]:  # some lie beyond the extent, where no action gets
        for name in ("goal", "waypoint"):
            state[name][0] = torch.from_numpy(goal)
        for k in range(20):
            env.simulation.step(k, 1)
            rear.append(state["pose"][0, :, :2].numpy().copy())
    assert not state["collided"].any() and not episode["collided"].any()
    return state["path_length"][0].numpy(), np.stack(rear)


def test_our_car_drives_as_far_as_the_original(recorded):
    episode, _, original = recorded
    np.testing.assert_allclose(original, [122, 32, 113], atol=0.5)
    way, rear = replay(recorded)
    np.testing.assert_allclose(way, original, rtol=0.1)
    gap = np.linalg.norm(rear - episode["state"][..., :2], axis=-1)
    assert gap[:80].max() < 0.5, gap.max(0)


def test_with_the_bodys_length_as_wheelbase_it_is_stuck(recorded):
    way, _ = replay(recorded, wheelbase="length")
    assert way.sum() < 0.3 * recorded[2].sum()
