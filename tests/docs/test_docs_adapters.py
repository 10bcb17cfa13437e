"""The page on other libraries: its recipes run, and Stable-Baselines3 takes what is there."""

import runpy

import numpy as np
import pytest
from test_docs import EXAMPLES, blocks, run_block

from maexp.agents import make_env

pytestmark = pytest.mark.slow  # other libraries train

PAGE = "docs/adapters.md"
MISSING = "THE EXTRA maexp[sb3] IS NOT INSTALLED: Stable-Baselines3 on targets is not tested"


def test_stable_baselines_learns_on_targets(tmp_path, monkeypatch, capsys):
    for name in ("supersuit", "stable_baselines3", "sb3_contrib"):
        pytest.importorskip(name, reason=MISSING)
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(EXAMPLES / "sb3_train.py"))
    model, agents = names["model"], names["agents"]
    assert model.num_timesteps == 180 and agents.num_envs == 6
    rollout = model.rollout_buffer
    masks, chosen = rollout.action_masks.reshape(-1, 24), rollout.actions.reshape(-1, 1).astype(int)
    assert np.take_along_axis(masks, chosen, 1).all(), "nobody takes what is not there"
    assert 0 < masks.mean() < 0.9 and np.ptp(chosen) > 3
    assert "ep_rew_mean" in capsys.readouterr().out
    poses = agents.reset()["pose"].reshape(2, 3, 4)
    assert not np.array_equal(*poses), "the two teams play episodes of their own"
    env = make_env("scenario=maze_small", "num_envs=2")
    after = env.rollout(3, runpy.run_path(str(EXAMPLES / "sb3_team.py"))["make"](env))
    shown, chosen = after["agents", "observation", "targets_mask"], after["agents", "action", "target"]
    assert shown.gather(-1, chosen.unsqueeze(-1)).all(), "what was learned plays in the platform"


def test_copies_are_sent_to_processes():
    pytest.importorskip("gymnasium", reason="THE EXTRA maexp[gymnasium] IS NOT INSTALLED: copies are not tested")
    *_, copies = blocks(PAGE, "python")
    names = run_block(copies, PAGE)
    assert names["infos"]["action_mask"].shape == (2, 3, 24) and not np.array_equal(*names["observations"]["pose"])
