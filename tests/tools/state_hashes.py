"""Hashes of what teams come to in many different set-ups: `python -m tests.tools.state_hashes [--compare FILE]`.

For a change that is to keep all bits: write the hashes to a file before it, and compare after it. A hash is of all that
the simulation and what looks at it remember, of the observation and of the rewards, after a few decisions. The hashes
are of one machine alone: others round differently.
"""

import argparse
import hashlib
import sys
from pathlib import Path

import torch

from maexp.agents import make_policy
from maexp.agents.policies import POLICIES
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    FaultsConfig,
    LookaheadConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
    RobotConfig,
    TargetsConfig,
    make_map,
)

SEED = 11
DWA, DIRECT = PlannerConfig(name="dwa"), PlannerConfig(name="direct")
OFFICE = "indoor_small"
KNOWN = ObservationConfig("known")
BLIND, SHOWN = ObservationConfig(pictures=False), ObservationConfig(pictures=False, targets=24)
RADIO = ObservationConfig(pictures=False, targets=24, radio=True)


def radio(strategy: str, **more) -> dict:
    """Settings of an episode that is long enough for robots to come back and tell."""
    comm = CommConfig(range=8.0, base_station=strategy != "rendezvous", strategy=strategy, **more)
    return {"comm": comm, "decisions": 8, "macro_steps": 9, "observation": BLIND}


# Name: (who acts, settings of the env, "scenario" and "decisions"). Regions, controls and targets are drawn, others are
# policies.
SETUPS = {
    "regions": ("regions", {}),
    "regions of plain DWA, what is known drawn": ("regions", {"planner": DWA, "observation": KNOWN}),
    "controls": ("controls", {"planner": DIRECT}),
    "controls, differential": ("controls", {"planner": DIRECT, "robot": RobotConfig("differential")}),
    "regions, omnidirectional, footprints": (
        "regions", {"robot": RobotConfig("omnidirectional"), "collision": "footprint"},
    ),
    "regions in an office": ("regions", {"scenario": OFFICE, "observation": BLIND}),
    "regions among obstacles": ("regions", {"scenario": "random_obstacles", "observation": BLIND}),
    "regions, a camera": ("regions", {"radar": RadarConfig(fov=1.5), "observation": BLIND}),
    "cost_utility": ("cost_utility", {}),
    "cost_utility of plain DWA": ("cost_utility", {"planner": DWA}),
    "cost_utility in an office": ("cost_utility", {"scenario": OFFICE, "observation": BLIND}),
    "cost_utility, four robots, spare ones go home": (
        "cost_utility",
        {"num_robots": 4, "targets": TargetsConfig(spare="home"), "starts": "together", "observation": BLIND},
    ),
    "nearest_frontier, not distinct": ("nearest_frontier", {"targets": TargetsConfig(distinct=False)}),
    "rrt_frontiers": ("rrt_frontiers", {"observation": BLIND}),
    "voronoi, radios": ("voronoi", {"comm": CommConfig(range=8.0, line_of_sight=True), "observation": BLIND}),
    "potential_field, signals": ("potential_field", {"comm": CommConfig(signal=True, noise=2.0), "observation": BLIND}),
    "cost_utility, messages": ("cost_utility", {"comm": CommConfig(range=8.0, bandwidth=2000.0, delay=0.5)}),
    "cost_utility reports": ("cost_utility", radio("return_to_base")),
    "cost_utility meets": ("cost_utility", radio("rendezvous", period=2)),
    "cost_utility relays": ("cost_utility", radio("relay")),
    "cost_utility pursues": ("cost_utility", radio("pursuit")),
    "cost_utility, faults": (
        "cost_utility", {"faults": FaultsConfig(at=((1, 1.0),), probability=0.3, duration=2.0), "observation": BLIND},
    ),
    "cost_utility, drift": ("cost_utility", {"odometry": OdometryConfig(drift=0.05, turn=0.02), "observation": BLIND}),
    "cost_utility, maps with errors, radios": (
        "cost_utility",
        {
            "odometry": OdometryConfig(drift=0.05, turn=0.02, map_errors=True),
            "comm": CommConfig(range=8.0),
            "observation": BLIND,
        },
    ),
    "cost_utility, noise": (
        "cost_utility",
        {"radar": RadarConfig(missed=0.2, noise=0.02, false_alarm=0.001, evidence=2), "observation": BLIND},
    ),
    "targets by number": ("targets", {"observation": SHOWN}),
    "universal": ("universal", {"observation": SHOWN}),
    "targets by number, radios": ("targets", radio("opportunistic") | {"observation": RADIO}),
    "lookahead": (
        "lookahead", {"lookahead": LookaheadConfig(candidates=3, horizon=2, local_steps=10), "observation": BLIND},
    ),
    "clairvoyant": (
        "clairvoyant", {"lookahead": LookaheadConfig(candidates=3, horizon=2, local_steps=10), "observation": BLIND},
    ),
}  # fmt: skip


def actor(word: str, env: ExplorationEnv):
    """tensordict -> tensordict with an action."""
    if word in POLICIES or word == "universal":
        return make_policy(word, env)
    draw, shape = torch.Generator().manual_seed(SEED), (env.num_envs, env.num_robots)

    def act(state):
        if word == "targets":
            first = state["agents", "observation", "targets_mask"].float().argmax(-1)
            rank = torch.randint(3, shape, generator=draw)
            state["agents", "action", "target"] = (first + rank).clamp(max=env.target_view.shown - 1)
        elif word == "controls":
            state["agents", "action", "control"] = torch.rand(*shape, 2, generator=draw) - 0.5
        else:
            state["agents", "action", "region"] = torch.randint(64, shape, generator=draw)
            state["agents", "action", "offset"] = torch.rand(*shape, 2, generator=draw) * 2.2 - 1.1
        return state

    return act


def digest(name: str, without: list[str]) -> str:
    """SHA-256 of all that a set-up has come to, but for what is left out."""
    word, settings = SETUPS[name]
    pace = {"decision_seconds": "protocol"}
    settings = {"num_robots": 3, "scenario": "maze_small", "decisions": 3} | pace | settings
    scenario, decisions = settings.pop("scenario"), settings.pop("decisions")
    maps = [make_map(scenario, index) for index in (0, 1)]
    env = ExplorationEnv(maps, 2, seed=SEED, num_threads=1, **settings)
    torch.manual_seed(SEED)
    policy, state = actor(word, env), env.reset()
    for _ in range(decisions):
        state = env.step(policy(state))["next"]
    found = dict(state.flatten_keys(".").items()) | env.state_dict()
    total = hashlib.sha256()
    for key in sorted(found):
        if key in without or key.startswith("agents.action"):
            continue  # how an action is written down is no part of what comes of it
        total.update(key.encode())
        total.update(found[key].detach().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--compare", type=Path, metavar="FILE", help="what this command printed before")
    parser.add_argument("--without", nargs="+", default=[], metavar="STATE", help="state that was not there before")
    given = parser.parse_args()
    compare = given.compare
    before = dict(line.rsplit("  ", 1) for line in compare.read_text().splitlines()) if compare else {}
    differ = 0
    for name in SETUPS:
        found = digest(name, given.without)
        other = name in before and before[name] != found
        differ += other
        print(f"{name}  {found}" + ("  differs" if other else ""), flush=True)
    if compare:
        print(f"{differ} of {len(before.keys() & SETUPS)} differ", file=sys.stderr)
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
