"""The example of a learned planner: its network in NumPy is the one that is trained, and it goes where frontier is."""

import sys

import numpy as np
import pytest
import torch
from paths import ROOT

FOLDER = ROOT / "docs" / "examples" / "policies"
WEIGHTS = FOLDER / "ariadne.npz"


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    import ariadne

    yield ariadne
    for name in ("ariadne", "ariadne_train"):
        sys.modules.pop(name, None)


def hall() -> tuple[dict, dict]:
    """Episode and observation of two robots in a hall of 20 x 9 m with an opening at its right end, 5 m wide."""
    grid = np.full((2, 11, 22), 100, np.int8)
    grid[:, 1:-1, 1:-1] = 0
    grid[:, 3:8, -1] = -1
    poses = np.tile([[4.5, 5.5, 0.0], [6.5, 5.5, 0.0]], (2, 1, 1))
    seen = {"alive": np.array([True, True]), "grid": grid, "resolution": 1.0, "origin": (0.0, 0.0), "poses": poses}
    episode = {"radar_range": 10.0, "robot_radius": 0.5, "max_speed": 2.0, "decision_seconds": 2.0}
    return episode, seen | {"time_left": 1.0}


def test_it_goes_to_frontier_until_there_is_none(example):
    assert WEIGHTS.stat().st_size < 2**20
    planner, (episode, seen) = example.Ariadne(), hall()
    planner.reset(episode)
    goals = planner.act(seen)
    assert (goals[:, 0] == 20.5).all() and (abs(goals[:, 1] - 5.5) <= 2.0).all()
    seen["grid"][:, 3:8, -1] = 100
    assert np.isnan(planner.act(seen)).all()


def test_features_tell_the_way_round_a_wall_and_what_is_picked(example):
    episode, seen = hall()
    seen["grid"][:, 1:8, 12] = 100  # a wall with a gap at its upper end
    planner, goals = example.Ariadne(None), np.full((2, 2), np.nan)
    planner.reset(episode)
    taken = []
    for robot, graph, own, features in planner.look(seen, goals):
        assert own == robot and graph.nodes[own].tolist() == [5, (4, 6)[robot]]
        behind = int(np.hypot(*(graph.nodes - (5, 16)).T).argmin())
        straight = np.hypot(*(graph.nodes[behind] - graph.nodes[own]))
        assert straight + 1.0 < graph.distances(own)[behind] < 2.5 * straight
        assert np.array_equal(features[:, example.SEES] > 0, graph.length > 0) and graph.length.any()
        goals[robot] = 20.5, 5.5
        taken.append(features[:, 9].max())
    assert taken[0] == 0.0 and taken[1] > 0.5


def test_what_is_trained_is_what_plays(example, tmp_path, monkeypatch):
    """Also with weights that were just trained, a little."""
    import ariadne_train as train

    monkeypatch.setattr(train, "TEAMS", 2)
    rows = train.collect("maze_small", 24, WEIGHTS, 0)
    assert len(rows) >= 60 and all(abs(wanted.sum() - 1.0) < 1e-5 for *_, wanted in rows)
    torch.manual_seed(0)
    net, losses = train.Net(), []
    with monkeypatch.context() as patch:
        patch.setattr("builtins.print", lambda text, **_: losses.append(float(text.split()[3].rstrip(","))))
        train.fit(net, rows, 6, np.random.default_rng(0))
    assert losses[-1] < losses[0]
    net.save(tmp_path / "new.npz")
    for path in (tmp_path / "new.npz", WEIGHTS):
        with np.load(path) as file:
            plays = example.Network(dict(file))
        net.load_state_dict({name: torch.from_numpy(value) for name, value in plays.arrays.items()})
        for features, edges, own, _ in rows[::13]:
            with torch.no_grad():
                batch = (torch.from_numpy(features)[None], torch.from_numpy(edges)[None], torch.tensor([own]))
                told = net(*batch)[0].numpy()
            assert np.abs(told - plays(features, edges, own)).max() < 1e-3
