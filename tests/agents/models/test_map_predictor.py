"""The guess of unknown ground: what it keeps to, what it is blind to, how it is trained, judged and exported."""

import hashlib
import json
import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from tools.predictor import beliefs, command, score, train
from tools.predictor.beliefs import NEVER, BeliefConfig, BeliefEpisode
from tools.predictor.export import Guess, predictor_to_onnx
from tools.predictor.train import PredictorConfig

from maexp.agents.config.env import map_indices
from maexp.agents.config.groups import ScenarioSettings
from maexp.agents.deploy.planner.bundle import CARD, WEIGHTS
from maexp.agents.errors import UserError
from maexp.agents.models.map_predictor import (
    CONTRACT,
    NETWORK,
    STRIDE,
    MapPredictor,
    contract_of,
    distance_to_free,
    find_predictor,
    load_predictor,
    predict,
    predict_by_distance,
    predictor_names,
    sample_worlds,
)
from maexp.envs import make_map
from maexp.envs.maps.nav_grid import build_nav_grid, open_cells

pytestmark = pytest.mark.slow  # trainings

UNKNOWN, FREE, OBSTACLE = 0, 1, 2


def some_room(height: int = 48, width: int = 64) -> torch.Tensor:
    """A room of which a part is known, in the middle of a grid."""
    known = torch.zeros((1, height, width), dtype=torch.uint8)
    known[0, 18:28, 20:34] = FREE
    known[0, 17, 20:34] = known[0, 18:28, 19] = OBSTACLE
    return known


def as_batch(known: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(known)[None]


@pytest.mark.parametrize("guess", [predict, predict_by_distance])
def test_what_is_known_stays(guess):
    known = some_room()
    chance = guess(known)
    assert chance.shape == known.shape and chance.dtype == torch.float32
    assert (chance[known == FREE] == 1).all() and (chance[known == OBSTACLE] == 0).all()
    unknown = chance[known == UNKNOWN]
    assert ((unknown > 0) & (unknown < 1)).all()


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 37, 90), (2, STRIDE, STRIDE + 1)])
def test_any_grid_and_batch(shape):
    known = torch.randint(0, 3, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    chance = predict(known)
    assert chance.shape == shape
    alone = torch.cat([predict(grid[None]) for grid in known])
    assert torch.allclose(chance, alone, atol=1e-5)


def test_wrong_input_is_a_sentence():
    with pytest.raises(ValueError, match=r"known is torch.float32 \[1, 4, 4\]"):
        predict(torch.zeros(1, 4, 4))
    with pytest.raises(ValueError, match="predictor=nothing is unknown: choose one of general"):
        predict(some_room(), "nothing")


def test_unknown_ground_looks_the_same_however_far_it_goes_on():
    """Every layer gives 0 for it, whatever its bias."""
    torch.manual_seed(0)
    net = MapPredictor(8).requires_grad_(False)
    sizes = [(32, 32), (48, 80)]
    logits = [net(torch.zeros((1, *size), dtype=torch.uint8)) for size in sizes]
    for logit in logits:
        patch = logit[0, :2, :2].repeat(logit.shape[1] // 2, logit.shape[2] // 2)
        assert torch.equal(logit[0], patch) and patch.abs().max() > 0


def test_more_unknown_ground_around_hardly_changes_a_guess():
    """A team's grid ends at the map's extent, which is nothing that it knows."""
    known, guesses = some_room(), []
    for far in (0, 2 * STRIDE, 6 * STRIDE):
        around = torch.nn.functional.pad(known, (far, far, far, far))
        guesses.append(predict(around)[0, far : far + 48, far : far + 64])
    near = torch.from_numpy(ndimage.distance_transform_edt(known[0].numpy() != FREE) <= 12)
    change = [(guess - guesses[-1])[near].abs() for guess in guesses[:2]]
    assert change[0].mean() < 0.03 and change[1].max() < 0.01, (change[0].mean(), change[1].max())


def test_distance_to_free_ground():
    known = torch.stack([some_room()[0], some_room()[0].flip(0), torch.zeros(48, 64, dtype=torch.uint8)])
    found = distance_to_free(known, 20)
    for grid, ours in zip(known[:2].numpy(), found.numpy(), strict=False):
        truth = np.minimum(ndimage.distance_transform_edt(grid != FREE), 20)
        np.testing.assert_allclose(ours, truth, atol=1e-5)
    assert (found[2] == 20).all()


def test_samples_have_the_probabilities_and_hang_together():
    chance = torch.full((2, 40, 60), 0.3)
    chance[1] = 0.6
    share, agree = [], []
    for length in (0.0, 3.0):
        worlds = sample_worlds(chance, 200, seed=3, length=length)
        assert worlds.shape == (2, 200, 40, 60) and set(worlds.unique().tolist()) == {FREE, OBSTACLE}
        share.append((worlds == FREE).float().mean((1, 2, 3)))
        agree.append((worlds[..., 1:] == worlds[..., :-1]).float().mean((1, 2, 3)))
        alone = sample_worlds(chance[1:], 200, seed=3, length=length)
        assert torch.equal(alone, worlds[1:])
    for frequencies in share:
        assert torch.allclose(frequencies, torch.tensor([0.3, 0.6]), atol=0.02)
    assert torch.allclose(agree[0], torch.tensor([0.58, 0.52]), atol=0.02)  # p^2 + (1 - p)^2
    assert (agree[1] > 0.85).all()


def test_samples_keep_what_is_known():
    known = some_room()
    worlds = sample_worlds(predict(known), 5, seed=1)
    assert (worlds[:, :, known[0] == FREE] == FREE).all() and (worlds[:, :, known[0] == OBSTACLE] == OBSTACLE).all()


@pytest.mark.parametrize("name", predictor_names())
def test_a_predictor_that_ships_is_whole(name):
    folder, contract = find_predictor(name), contract_of(name)
    assert {path.name for path in folder.iterdir()} == {CARD, CONTRACT, NETWORK, WEIGHTS}
    for file, digest in contract["sha256"].items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
    assert sum(parameter.numel() for parameter in load_predictor(name).parameters()) < 1_000_000


@pytest.mark.parametrize("name", predictor_names())
def test_the_onnx_file_gives_the_same(name):
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(find_predictor(name) / NETWORK))
    for size in [(1, 48, 64), (3, 16, 160)]:
        known = torch.randint(0, 3, size, dtype=torch.uint8, generator=torch.Generator().manual_seed(2))
        (free,) = session.run(None, {"known": known.numpy()})
        np.testing.assert_allclose(free, predict(known, name).numpy(), atol=1e-5)


@pytest.mark.slow
def test_export_of_fresh_weights():
    pytest.importorskip("onnxscript")
    import onnxruntime

    torch.manual_seed(3)
    net = MapPredictor(4).eval()
    session = onnxruntime.InferenceSession(predictor_to_onnx(net))
    known = some_room()
    with torch.no_grad():
        np.testing.assert_allclose(session.run(None, {"known": known.numpy()})[0], Guess(net)(known), atol=1e-5)


@pytest.fixture(scope="module")
def played() -> list[BeliefEpisode]:
    return beliefs.play_maps([make_map("maze_small", index) for index in (51, 52)], 2, 5, 0.3)


def test_beliefs_grow_and_are_true(played):
    for episode in played:
        earlier = np.zeros_like(episode.known(0))
        for decision in range(episode.decisions):
            known = episode.known(decision)
            assert (known[earlier == OBSTACLE] == OBSTACLE).all() and (known[earlier == FREE] != UNKNOWN).all()
            assert episode.truth[known == FREE].all() and not episode.truth[known == OBSTACLE].any()
            earlier = known
        assert (episode.known(0) == FREE).sum() < (earlier == FREE).sum()
        assert episode.reach == 10.0
    truths = [open_cells(build_nav_grid(make_map("maze_small", index))) for index in (51, 52)]
    assert all(any(np.array_equal(episode.truth.ravel(), truth) for truth in truths) for episode in played)


def test_episodes_are_files(played, tmp_path):
    beliefs.save_episodes(tmp_path / "maze_small-00000-0.npz", played)
    loaded = beliefs.load_groups(tmp_path)["maze_small"]
    for episode, again in zip(played, loaded, strict=True):
        assert np.array_equal(episode.free_at, again.free_at) and np.array_equal(episode.truth, again.truth)
        assert again.decisions <= episode.decisions and again.reach == episode.reach
        share = (again.known(again.decisions - 1) == FREE)[again.truth].mean()
        assert share < beliefs.COVERED or again.decisions == 1


@pytest.mark.parametrize("scenario", beliefs.GENERATED)
def test_maps_for_training_are_for_nothing_else(scenario):
    trained, validation, held_out = map_indices(ScenarioSettings(name=scenario))
    assert beliefs.map_numbers(scenario, "train") == trained
    assert beliefs.map_numbers(scenario, "validation") == validation
    assert max(*held_out, *validation) + 10_000 < beliefs.EXTRA_MAPS


def test_the_last_fifth_of_plans_is_held_out(tmp_path):
    for group in ("a", "b"):
        (tmp_path / group).mkdir()
        for k in range(25):
            (tmp_path / group / f"{k:02d}.yaml").touch()
    names = {part: [file.stem for file in beliefs.plan_files(str(tmp_path), part)] for part in ("train", "validation")}
    assert names["train"] == 2 * [f"{k:02d}" for k in range(16)]
    assert names["validation"] == 2 * [f"{k:02d}" for k in range(16, 20)]


def toy_episode(wall: int = 30) -> BeliefEpisode:
    """Everything is free west of a wall; a team comes to know it from the west on."""
    truth = np.zeros((40, 50), dtype=bool)
    truth[:, :wall] = True
    columns = np.broadcast_to(np.arange(50), truth.shape)
    free_at = np.where(truth, columns // 3, NEVER).astype(np.uint8)
    wall_at = np.where(columns == wall, 10, NEVER).astype(np.uint8)
    return BeliefEpisode(free_at, wall_at, truth, 8, 5.0)


def test_crops_count_unknown_cells_near_free_ground():
    crops = train.draw_crops({"toy": [toy_episode()]}, 24, 32, np.random.default_rng(0))
    assert crops.known.shape == crops.truth.shape == crops.counts.shape == (24, 32, 32)
    for known, truth, counts in zip(crops.known.numpy(), crops.truth.numpy(), crops.counts.numpy(), strict=True):
        away = ndimage.distance_transform_edt(known != FREE)
        assert counts.any() and (known[counts] == UNKNOWN).all() and away[counts].max() <= 10
        edge = train.EDGE
        assert not counts[:edge].any() and not counts[:, -edge:].any()
        assert truth[known == FREE].all()


def test_a_cut_goes_beyond_the_grid():
    grid = np.arange(1, 13).reshape(3, 4)
    found = train.cut(grid, np.array([-1, 2]), 4)
    assert found.tolist() == [[0, 0, 0, 0], [3, 4, 0, 0], [7, 8, 0, 0], [11, 12, 0, 0]]
    assert not train.cut(grid, np.array([10, 10]), 4).any()


def test_the_eight_turns_differ_and_turn_together():
    grid = np.arange(9).reshape(3, 3)
    turned = [train.turn((grid, grid + 1), k) for k in range(8)]
    assert len({cells.tobytes() for cells, _ in turned}) == 8
    assert all(np.array_equal(cells + 1, other) for cells, other in turned)


def toy_config(folder, **others) -> PredictorConfig:
    values = {
        "data": str(folder / "data"),
        "out": str(folder / "out"),
        "width": 4,
        "steps": 60,
        "batch": 4,
        "crop": 32,
        "save_every": 20,
        "learning_rate": 0.05,
    }
    return PredictorConfig(**(values | others))


def test_training_learns_and_goes_on_bit_for_bit(tmp_path, monkeypatch):
    beliefs.save_episodes(tmp_path / "data" / "toy-00000-0.npz", [toy_episode(wall=12)])  # hardly anything is free
    whole = train.train_predictor(toy_config(tmp_path), report=lambda line: None)
    rows = (tmp_path / "out" / "metrics.csv").read_text().splitlines()
    assert len(rows) == 4 and float(rows[-1].split(",")[1]) < float(rows[1].split(",")[1]) - 0.02

    def stop(line: str) -> None:
        raise KeyboardInterrupt

    parts = toy_config(tmp_path, out=str(tmp_path / "parts"))
    with pytest.raises(KeyboardInterrupt):
        train.train_predictor(parts, report=stop)
    again = train.train_predictor(parts, report=lambda line: None)
    assert all(
        torch.equal(parameter, other) for parameter, other in zip(whole.parameters(), again.parameters(), strict=True)
    )
    assert (tmp_path / "parts" / "metrics.csv").read_text().splitlines() == rows
    with pytest.raises(UserError, match="holds a training with width=4, not 8"):
        train.train_predictor(toy_config(tmp_path, width=8), report=lambda line: None)


def test_settings_out_of_range_are_named(tmp_path):
    with pytest.raises(ValueError, match="crop=8 must be a whole number"):
        train.train_predictor(toy_config(tmp_path, crop=8))
    with pytest.raises(ValueError, match="departures=2.0 must be"):
        beliefs.write_beliefs(BeliefConfig(departures=2.0))
    with pytest.raises(UserError, match="holds no beliefs"):
        train.train_predictor(toy_config(tmp_path))


def test_figures_of_a_guess():
    free = np.array([True, True, False, False])
    chance, ranges = np.array([0.9, 0.4, 0.2, 0.2]), np.array([0.1, 0.3, 0.7, 1.5])
    found = score.judge(free, chance, ranges)
    losses = [-math.log(0.9), -math.log(0.4), -math.log(0.8), -math.log(0.8)]
    assert found["log_loss"] == pytest.approx(sum(losses) / 4)
    assert found["accuracy"] == 0.75
    assert found["calibration_error"] == pytest.approx((0.1 + 0.6 + 0.4) / 4)
    assert [found[f"accuracy_{distance:g}"] for distance in (0.25, 0.5, 1, 2)] == [1, 0, 1, 1]


def test_histograms_are_the_shares_of_free_cells():
    cells = score.look_at([toy_episode()], 2, None)
    table = score.count_free([cells], score.by_distance, score.MOST_DISTANCE + 1)
    for distance in range(1, 10):
        some = score.by_distance(cells) == distance
        assert table[distance] == pytest.approx(cells.free[some].mean(), abs=1e-3)


def test_the_predictor_beats_distance_where_nobody_trained(played):
    """On two validation maps; the guesses are those of docs/reports/lookahead.md."""
    episodes, loss = [beliefs.until_covered(episode) for episode in played], {}
    for guess in (predict, predict_by_distance):
        cells = score.look_at(episodes, 3, lambda known, guess=guess: guess(as_batch(known))[0].numpy())
        loss[guess] = score.judge(cells.free, cells.guess, cells.ranges)["log_loss"]
    assert loss[predict] < 0.6 * loss[predict_by_distance], loss


def test_the_commands_end_with_a_sentence(tmp_path, capsys, monkeypatch):
    for kind, work in ((PredictorConfig, train.train_predictor), (score.ScoreConfig, score.main)):
        monkeypatch.setattr("sys.argv", ["x", f"data={tmp_path}"])
        assert command.run(kind, work) == 1
        assert "holds no beliefs" in capsys.readouterr().err
    for word, told in (("batch=many", "many"), ("crop=8", "crop=8 must be a whole number from 32 to 512")):
        monkeypatch.setattr("sys.argv", ["x", word])
        assert command.run(PredictorConfig, train.train_predictor) == 1
        assert told in capsys.readouterr().err


def test_contract_tells_what_goes_in_and_out():
    contract = json.loads((find_predictor("general") / CONTRACT).read_text())
    assert contract["inputs"]["known"]["type"] == "uint8" and contract["outputs"]["free"]["type"] == "float32"
    assert all(0 < chance < 1 for chance in contract["by_distance"][1:])
