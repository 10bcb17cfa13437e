"""What a team in training is worth: the same validation episodes again and again, beside the best classical planner.

The planners play them once in a run; a run that is resumed takes what they did from its checkpoint.
"""

import copy
import math
from functools import cached_property
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from maexp.agents.build import MapSuite, choose_device, make_env
from maexp.agents.config.checks import choices_of, team_sizes
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.evaluation.comparison import DECIDES, play_best
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate, join
from maexp.agents.policies.classical import CLASSICAL
from maexp.envs import ExplorationEnv
from maexp.envs.metrics import in_reach

STEPS = "coverage_step_95_censored"
PAIRED = {"validation_gain": (DECIDES, 100.0), "validation_steps_95": (STEPS, 1.0)}
"""Column -> the metric and its factor: the team's less the best planner's in the same episodes."""
ENDS = ("", "_low", "_high")
COLUMNS = ("validation_coverage", "validation_coverage_auc", *(f"{name}{end}" for name in PAIRED for end in ENDS))


def judged(cfg: TrainSettings) -> TrainSettings:
    """The settings with the seed of the episodes that judge the team."""
    cfg = copy.deepcopy(cfg)
    cfg.seed = cfg.seed if cfg.evaluation_seed is None else cfg.evaluation_seed
    return cfg


class Validation:
    """The validation episodes of a run, shared evenly among its team sizes.

    Args:
        cfg: the settings.
        suite: the maps; those of `validation` are played.
    """

    def __init__(self, cfg: TrainSettings, suite: MapSuite):
        self.cfg, self.suite = cfg, suite
        self.sizes = team_sizes(cfg.num_robots)
        self.episodes = math.ceil(cfg.evaluate_episodes / len(self.sizes))
        words = [] if cfg.planner.name == "direct" else choices_of(cfg.classical)  # controls: no planner gives these
        self.planners = [spec for spec in words if spec in CLASSICAL]
        self._rivals: dict[int, EvaluationResult] = {}

    @cached_property
    def envs(self) -> dict[int, ExplorationEnv]:
        """Team size -> where its episodes are played."""
        device, count = choose_device(self.cfg, "train_device"), min(self.cfg.num_envs, self.episodes)
        return {size: make_env(self.cfg, self.suite.validation, size, count, device=device) for size in self.sizes}

    @property
    def rivals(self) -> dict[int, EvaluationResult]:
        """Team size -> the episodes of the best classical planner; empty where the run compares with none."""
        if self.planners and not self._rivals:
            self._rivals = {
                size: play_best(env, self.planners, self.episodes, self.cfg.seed) for size, env in self.envs.items()
            }
        return self._rivals

    @property
    def best(self) -> dict[int, str]:
        """Team size -> the best classical planner."""
        return {size: rival.policy for size, rival in self.rivals.items()}

    @property
    def rival(self) -> str:
        """What the best planner is called where one word must do for all team sizes; "": there is none."""
        names = set(self.best.values())
        return next(iter(names)) if len(names) == 1 else "the best planner" * bool(names)

    def row(self, policy: TensorDictModuleBase) -> dict[str, float]:
        """`COLUMNS` for the policy as it is now; NaN where no planner is there, or an episode is over before 95 %.

        Coverages are shares, at the end of an episode and on average over its time, `validation_gain` points of the
        latter, `validation_steps_95` local steps (the limit where a team never gets there); these two are paired means
        with the ends of their 95 % intervals over maps and episodes.
        """
        rivals = self.rivals
        mine = join([evaluate(policy, env, self.episodes, seed=self.cfg.seed) for env in self.envs.values()])
        found = mine.minus(join(list(rivals.values()))) if rivals else {}
        row = {
            "validation_coverage": float(mine.episodes["exploration_ratio"].mean()),
            "validation_coverage_auc": float(mine.episodes[DECIDES].mean()),
        }
        for column, (metric, factor) in PAIRED.items():
            known = metric in found and in_reach(metric, mine.success_coverage)
            values = (found[metric]["mean"], *found[metric]["ci95"]) if known else (math.nan,) * 3
            row |= {f"{column}{end}": factor * x for end, x in zip(ENDS, values, strict=True)}
        return row

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """What the best planners did, as containers of tensors and text."""
        return {
            size: {
                "policy": rival.policy,
                "episodes": {metric: torch.from_numpy(values) for metric, values in rival.episodes.items()},
                "maps": rival.maps.tolist(),
                "success_coverage": rival.success_coverage,
            }
            for size, rival in self._rivals.items()
        }

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """What `state_dict` returned; the planners need not play."""
        for size, rival in state.items():
            episodes = {metric: values.numpy() for metric, values in rival["episodes"].items()}
            maps, goal = np.array(rival["maps"]), rival["success_coverage"]
            self._rivals[size] = EvaluationResult(rival["policy"], size, episodes, 0.0, maps, success_coverage=goal)
