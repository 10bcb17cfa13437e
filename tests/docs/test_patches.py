"""What docs/extending.md shows to add is added to a copy of the package, and played."""

import os
import shutil
import subprocess
import sys

import pytest
from paths import ROOT

PATCHES = ("scenario", "robot_parameter", "classical_planner", "target_feature", "reward_term")
PLAY = """
import torch
from maexp.agents.cli import main
from maexp.agents.policies import POLICIES
from maexp.envs import (
    ExplorationEnv, ObservationConfig, PlannerConfig, RewardConfig, RobotConfig, check_map, make_map
)
from maexp.envs.targets.features import FEATURES

place = make_map("ring", 3)
assert check_map(place).ok and place.name == "ring_3"
shown = ObservationConfig(targets=6)
env = ExplorationEnv(place, 2, 3, local_steps=10, reward=RewardConfig(team=0.1), observation=shown)
played = env.rollout(4, POLICIES["largest_frontier"](env))
info, seen = played["next", "info"], played["agents", "observation", "targets"]
assert (info["reward_team"] > 0).all() and not torch.equal(info["reward_team"], info["reward_explore"])
assert seen.shape[-1] == len(FEATURES) and FEATURES[-1] == "crowd"
assert {*seen[..., -1].unique().tolist()} <= {0.0, 0.25, 0.5} and seen[..., -1].any()

slow, steered = RobotConfig(max_reverse=0.5), PlannerConfig(name="direct")
back = ExplorationEnv(place, 1, 2, robot=slow, planner=steered, local_steps=10)
td = back.reset()
td["agents", "action", "control"] = torch.tensor([[[-1.0, 0.0]]]).expand(1, 2, 2).contiguous()
back.step(td)
speed = back.simulation.tensors["pose"][..., 2]
assert (speed == -0.5).all(), speed

words = ["policy=largest_frontier", "scenario=ring", "robot.max_reverse=0.5", "reward.team=0.1"]
assert main(["evaluate", *words, "--cfg", "job"]) == 0
assert main(["evaluate", "policy=largest_frontier", "robot.max_reverse=-1"]) == 2
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("git") is None, reason="git is absent: patches are not applied")
def test_a_package_with_five_additions_plays(tmp_path):
    """A scenario, a parameter of robots, a planner, a feature and a reward term at once: kernels compile once."""
    copy = tmp_path / "maexp"
    for room in ("agents", "conf", "envs", "kernels"):
        shutil.copytree(ROOT / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    patches = [ROOT / "docs" / "examples" / "patches" / f"{name}.diff" for name in PATCHES]
    apart = os.environ | {"GIT_CEILING_DIRECTORIES": str(tmp_path)}
    subprocess.run(["git", "apply", *patches], check=True, cwd=copy, env=apart)
    done = subprocess.run(
        [sys.executable, "-c", PLAY],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=1200,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "max_reverse: 0.5  # greatest speed backwards [m/s]" in done.stdout
    assert "robot.max_reverse=-1" in done.stderr
