"""What an env knows at moments of an episode, as a robot would hand it to the runtime."""

from dataclasses import dataclass

import numpy as np
from worlds import room

from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, PlannerConfig, make_map
from maexp.envs.targets.navigation import Navigation

MAPS = {
    "indoor": lambda: make_map("indoor_small", 2),
    "maze": lambda: make_map("maze_small", 1),
    "jittered": lambda: room(90, 60, "jittered", spacing=0.25),
}


@dataclass
class FeatureInputs:
    """An env and its navigation, up to date; and the same as arguments of `TeamPlanner` and of its `plan`."""

    env: ExplorationEnv
    nav: Navigation
    settings: dict
    call: dict


def moments(kind: str, policy: str = "cost_utility", num_robots: int = 3, steps: int = 4, robot=None):
    """Moments of an episode, one for each decision."""
    env = ExplorationEnv(
        maps=[MAPS[kind]()],
        num_envs=1,
        num_robots=num_robots,
        seed=5,
        planner=PlannerConfig(name="wavefront"),
        robot=robot,
        num_threads=1,
    )
    play, nav = POLICIES[policy](env), Navigation(env)
    td = env.reset()
    for _ in range(steps):
        nav.update()
        yield inputs(env, nav)
        td = env.step(play(td))["next"]
        if td["done"].any():
            break


def inputs(env: ExplorationEnv, nav: Navigation) -> FeatureInputs:
    """What the env holds now."""
    width, height = (int(v[0]) for v in (nav.width, nav.height))
    known = nav.known[0, 0, : width * height].cpu().numpy().reshape(height, width)
    robots = env.simulation.robot_tensors
    radius = robots["collision_threshold"][0].tolist()
    pose = np.concatenate([nav.centers()[0].numpy(), nav.state["pose"][0, :, 3:].numpy()], axis=1)
    poses = [row if alive else None for row, alive in zip(pose.tolist(), nav.alive()[0].tolist(), strict=True)]
    return FeatureInputs(
        env,
        nav,
        settings={
            "radar_range": nav.radar_range,
            "robot_radius": radius,
            "clearance_factor": float(robots["clearance"][0, 0] / robots["collision_threshold"][0, 0]),
            "bounded": True,
            "least_area": 0.0,
        },
        call={
            "grid": np.array([-1, 0, 100], np.int8)[known],
            "resolution": float(nav.cell_size[0]),
            "origin": nav.origin[0].tolist(),
            "poses": {k: pose for k, pose in enumerate(poses)},
        },
    )
