"""A tiny benchmark: its words, its cells, and settings as `maexp benchmark` would compose them."""

from maexp.agents.benchmarks.plan import Cell, compose_settings
from maexp.agents.cli.benchmark import prepare
from maexp.agents.config.overrides import make_overrides

TINY = [
    "preset=smoke",
    "scenarios=maze_small",
    "policies=voronoi,random",
    "algorithms=mappo",
    "seeds=0,1",
    "episodes=3",
    "num_envs=2",
    "num_robots=2",
    "scenario.local_steps=5",
    "iterations=4",
    "checkpoint_every=1",
    "workers=1",
    "estimate=false",
    "device=cpu",
    "model.channels=4",
]


CELLS = [Cell("maze_small", policy, seed) for seed in (0, 1) for policy in ("voronoi", "random", "mappo")]


def settings(*words: str):
    return compose_settings("benchmark", prepare(make_overrides("benchmark", list(words))).words)
