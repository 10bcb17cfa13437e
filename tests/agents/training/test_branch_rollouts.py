"""Branches as data: what candidates are worth is what comes of them, and only training maps are played."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import step_mdp
from worlds import room

from maexp.agents.config.compose import compose_settings
from maexp.agents.config.env import map_indices
from maexp.agents.models.actor import TARGETS, TARGETS_MASK
from maexp.agents.models.distributions import ACTION
from maexp.agents.models.target_chooser import NEVER, SCORE
from maexp.agents.training import branch_rollouts
from maexp.agents.training.branch_rollouts import BranchRollouts, main, training_maps
from maexp.envs import ExplorationEnv, ObservationConfig, make_map


def make_env() -> ExplorationEnv:
    return ExplorationEnv(
        [make_map("maze_small", 1), room(45, 36, "rotated")],
        num_envs=3,
        num_robots=2,
        seed=2,
        local_steps=8,
        macro_steps=6,
        observation=ObservationConfig(pictures=False, targets=8),
    )


def play(env: ExplorationEnv, td, preference: torch.Tensor, index: torch.Tensor):
    td[(*ACTION, "preference")], td[(*ACTION, "target")] = preference, index
    return step_mdp(env.step(td))


def covered_over_time(env: ExplorationEnv) -> torch.Tensor:
    """As in `Rollouts`: the average over the decision's time, and what is covered at its end."""
    state = env.simulation.tensors
    return state["covered_sum"].double() / env.local_steps + state["covered"]


def test_a_candidate_is_worth_what_comes_of_it():
    """One decision played in the branch and in the env itself, robot by robot and candidate by candidate."""
    env = make_env()
    td, compared = env.reset(), 0
    for _ in range(2):
        preference = torch.where(td[TARGETS_MASK], td[TARGETS][..., SCORE], NEVER)
        index, advantage = BranchRollouts(env, candidates=3, horizon=1).try_candidates(td[TARGETS], preference)
        own, saved, ended = index[..., 0].clamp_min(0), env.state_dict(), {}
        points = env.target_view.state["point"].clone()
        state = env.simulation.tensors
        total = env.simulation.map_tensors["total_weight"][state["map_id"].long()]
        area = torch.tensor([world.free_area for world in env.maps])[state["map_id"].long()]
        disc = total / area * torch.pi * env.radar_configs[0].range ** 2
        for robot in range(2):
            for k in range(3):
                env.load_state_dict(saved)
                named = own.clone()
                named[:, robot] = index[:, robot, k].clamp_min(0)
                wanted = torch.where(torch.arange(8) == named.unsqueeze(-1), -NEVER, preference)
                play(env, td.clone(), wanted, named)
                ended[robot, k] = covered_over_time(env)
                for team in (index[:, robot, k] >= 0).nonzero().flatten().tolist():
                    more = (ended[robot, k] - ended[robot, 0])[team] / disc[team]
                    if _goes_there(env, team, robot, points[team, robot, named[team, robot]]):
                        assert float(advantage[team, robot, k]) == pytest.approx(float(more), abs=1e-5)
                        compared += k > 0
        env.load_state_dict(saved)
        td = play(env, td, preference, own)
    assert compared >= 8, "hardly anything was tried"


def _goes_there(env: ExplorationEnv, team: int, robot: int, wanted: torch.Tensor) -> bool:
    """Whether nobody else had the place that a robot names, float32 [2] [m]."""
    return torch.equal(env.target_view.state["last"][team, robot], wanted)


def test_only_training_maps_are_played():
    for scenario in ("maze_small", "indoor_medium"):
        indices, validation, held_out = map_indices(compose_settings("train", [f"scenario={scenario}"]).scenario)
        assert training_maps(scenario) == indices
        assert not {*validation, *held_out} & {*training_maps(scenario)}


def test_the_files_and_that_those_there_are_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(branch_rollouts, "make_map", lambda name, index: room(29, 22))
    words = ["scenarios=[maze_small]", "teams=2", "robots=2", "candidates=3", "horizon=1", "every=6"]
    assert main([f"out={tmp_path}/a", *words, "rounds=2"]) == 0
    assert main([f"out={tmp_path}/b", *words, "rounds=1"]) == 0
    first = tmp_path / "b" / "branches_maze_small_0.npz"
    before = first.read_bytes()
    assert main([f"out={tmp_path}/b", *words, "rounds=2"]) == 0
    assert first.read_bytes() == before
    assert (tmp_path / "b" / "costs.csv").read_text().count("\n") == 3  # the head, and each file once
    for turn in range(2):
        ours, theirs = (dict(np.load(tmp_path / k / f"branches_maze_small_{turn}.npz")) for k in "ab")
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=ours[name].dtype.kind == "f") for name in ours)
    there = ours["index"] >= 0
    assert (
        np.array_equal(np.isfinite(ours["advantage"]), there) and (ours["advantage"][..., 0][there[..., 0]] == 0).all()
    )
    assert np.take_along_axis(ours["mask"], np.maximum(ours["index"], 0).astype(int), 2)[there].all()
    assert len({*map(tuple, ours["features"][:, 0, 0].tolist())}) > 1


@pytest.mark.parametrize(
    "word, told",
    [
        ("horizon=0", "branching.horizon=0 must be"),
        ("scenarios=[pointcloud]", "has no training maps"),
        ("teems=3", "teems"),
        ("scenarios=[cellar]", "cellar"),
    ],
)
def test_bad_settings_are_named(word, told, capsys):
    assert main([word]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
