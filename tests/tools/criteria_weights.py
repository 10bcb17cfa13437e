"""How the weights of `multi_criteria` were found (docs/reports/planners.md).

    python tests/tools/criteria_weights.py imitate
    python tests/tools/criteria_weights.py play indoor_medium 240 WAY=0.24 WAY=0.32 APART=0.1

`imitate` plays `universal` in all scenarios and fits weights of few terms to its choices, by conditional logit, each
scenario alike: where to start from. `play` tries changes of the weights as they are, one at a time, in so many
episodes: `coverage_auc` in points less that of `cost_utility` in the same ones. Maps that nobody trains on or reports.
"""

import sys

import numpy as np
import torch

from maexp.agents.evaluation.evaluate import evaluate, play
from maexp.agents.policies.classical import POLICIES, FrontierPlanner, as_module
from maexp.agents.policies.lookahead import TrainedRank
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, make_map
from maexp.envs.scenarios import GENERATED
from maexp.envs.targets import heuristics
from maexp.envs.targets.features import FEATURES

FIRST, MAPS, TEAMS = 2000, 48, 96  # no table reports maps from there on
TERMS = {
    "gain": lambda seen: seen["gain"],
    "claimed": lambda seen: -seen["gain"] * seen["claimed"],
    "WAY": lambda seen: -seen["travel"],  # log(1 + radar ranges)
    "BEYOND": lambda seen: seen["unknown_far"],
    "APART": lambda seen: seen["plan_gap"],
}


def make_env(scenario: str, teams: int, first: int) -> ExplorationEnv:
    """Three robots on fresh maps."""
    maps, shown = [make_map(scenario, first + k) for k in range(MAPS)], ObservationConfig(pictures=False)
    return ExplorationEnv(maps, teams, 3, planner=PlannerConfig(name="wavefront"), observation=shown, num_threads=1)


class Watched(TrainedRank):
    """Keeps what the network saw and what it liked best."""

    def __call__(self, scene):
        worth = super().__call__(scene)
        seen, best = self.view.show(scene)
        there = self.view.state["mask"]
        rows = (there.sum(-1) > 1) & (self.view.env.simulation.tensors["active"] != 0).unsqueeze(-1)
        liked = torch.where(there, worth.gather(2, best), -torch.inf).argmax(-1)
        self.kept.append((seen["features"][rows], there[rows], liked[rows]))
        return worth


class Watching(FrontierPlanner):
    def __init__(self, env):
        super().__init__(env, None)
        self.rank = Watched("universal", env, self.tracker, "policy")
        self.rank.kept = []

    def choose(self, scene):
        chosen = super().choose(scene)
        self.rank.note(scene, chosen[0])
        return chosen


def watch(scenario: str):
    """The terms of candidates [D, M, terms], which there are [D, M], and which the network took [D]."""
    env, planners = make_env(scenario, TEAMS, FIRST), []
    policy = as_module(lambda env: planners.append(Watching(env)) or planners[0], env)
    play(policy, env, torch.arange(TEAMS))
    features, there, liked = map(torch.cat, zip(*planners[0].rank.kept, strict=True))
    seen = {name: features[..., k] for k, name in enumerate(FEATURES)}
    return torch.stack([term(seen) for term in TERMS.values()], -1), there, liked


def imitate() -> None:
    found = [watch(name) for name in GENERATED]
    weights = torch.zeros(len(TERMS), requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        logits = [torch.where(there, terms @ weights, -1e9) for terms, there, _ in found]
        pairs = zip(logits, found, strict=True)
        value = sum(torch.nn.functional.cross_entropy(line, liked) for line, (_, _, liked) in pairs)
        value.backward()
        return value

    optimizer.step(loss)
    for name, weight in zip(TERMS, (weights / weights[0]).tolist(), strict=True):
        print(f"{name:8s} {weight:+.3f}")


def tell(scenario: str, episodes: int, changes: list[str]) -> None:
    env = make_env(scenario, min(episodes, TEAMS), FIRST + MAPS)
    base = evaluate(POLICIES["cost_utility"](env), env, episodes)
    for change in ["", *changes]:
        name, value = change.split("=") if change else ("WAY", heuristics.WAY)
        kept = getattr(heuristics, name)
        setattr(heuristics, name, float(value))
        apart = evaluate(POLICIES["multi_criteria"](env), env, episodes).minus(base)
        setattr(heuristics, name, kept)
        points = 100.0 * np.array([apart["coverage_auc"]["mean"], *apart["coverage_auc"]["ci95"]])
        lost = apart["collisions"]["mean"]
        print(
            f"{change or 'as it is':12s} {points[0]:+.2f} [{points[1]:+.2f}, {points[2]:+.2f}], lost {lost:+.3f}",
            flush=True,
        )


if __name__ == "__main__":
    if sys.argv[1] == "imitate":
        imitate()
    else:
        tell(sys.argv[2], int(sys.argv[3]), sys.argv[4:])
