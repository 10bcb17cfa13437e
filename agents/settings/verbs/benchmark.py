"""Settings of `maexp benchmark`."""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from maexp.agents.settings.groups import CollectorSettings, LearnerSettings
from maexp.envs.config_fields import setting
from maexp.envs.targets.heuristics import CLASSICAL


@dataclass
class BenchmarkSettings(LearnerSettings):
    """`maexp benchmark`."""

    seed: int = 0  # each cell has its own, from `seeds`
    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
    scenarios: Any = setting(None, "where they are compared")
    algorithms: Any = setting(None, "trained and then evaluated")
    policies: Any = setting(["random", *CLASSICAL, "oracle"], "only evaluated: planners, trained ones, module:function")
    seeds: Any = setting(None, "of training, starts and maps")
    episodes: int = setting(100, "episodes of each cell (a cell: one policy, scenario and seed)", low=1)
    num_robots: int = setting(3, "robots in a team", low=1)
    total_frames: int = setting(80_000, "macro steps of teams to train each algorithm for", low=1, high=10**12)
    iterations: int | None = setting(None, "instead: iterations of one episode of each of the num_envs teams", low=1)
    maps: Any = setting("held_out", "evaluated on held_out, trained, held_out_together (so teams start), or several")
    train_maps: int | None = setting(
        None, "train on the first so many maps; default: all that may be trained on", low=1
    )
    test_maps: int | None = setting(
        None, "evaluate on so many held-out maps, new ones too; default: the last fifth", low=1
    )
    policy_per_map: Any = setting(None, "a policy for each of so many maps, as {maze: 4}; default: one for all")
    together: bool = setting(False, "train one policy on all scenarios at once; default: one for each scenario")
    workers: int | None = setting(None, "cells at once; default: the cores, or the GPUs where there are some", low=1)
    resume: str | None = setting(None, "folder of a benchmark to go on with (its settings are kept)")
    report: bool = setting(False, "run nothing, only write the tables and pictures of the cells that are done")
    confirm: bool = setting(False, "run it although it would take more than a day")
    estimate: bool = setting(True, "measure a few steps first and say how long it will take")
    checkpoint_every: int = setting(10, "iterations between two checkpoints of a training", low=1)
    checkpoint_keep: int = setting(2, "newest checkpoints kept, besides the best", low=1)
    collector: CollectorSettings = field(default_factory=CollectorSettings)
