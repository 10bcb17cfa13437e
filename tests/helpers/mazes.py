"""Teams on two small mazes, for tests of the classical planners and of what they know."""

from maexp.envs import ExplorationEnv, PlannerConfig, make_map

MAPS = [make_map("maze_small", k) for k in (0, 3)]
REGION, OFFSET = ("agents", "action", "region"), ("agents", "action", "offset")
GOAL = ("agents", "action", "goal")


def make_env(num_envs=4, planner="wavefront", clearance=None, **settings) -> ExplorationEnv:
    pace = {} if {"local_steps", "decision_seconds"} & {*settings} else {"decision_seconds": "protocol"}
    settings = {"maps": MAPS, "seed": 11, "macro_steps": 80} | pace | settings
    planning = PlannerConfig(name=planner, clearance_factor=clearance)
    return ExplorationEnv(num_envs=num_envs, planner=planning, num_threads=1, **settings)
