"""What shows an episode: films, episode files, three-dimensional pictures, the page in the browser."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from maexp.agents.cli import main
from maexp.agents.evaluation.video import draw_film, play_teams
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, MapError, make_map
from maexp.envs.render.episode import Episode, EpisodeRecorder
from maexp.envs.render.frames import EXPLORED, draw_frame, draw_grid, watch_episode

TINY = ["scenario.held_out=[70]", "scenario.macro_steps=2", "num_robots=2"]


def make_env(num_envs=3, macro_steps=3) -> ExplorationEnv:
    maps = [make_map("maze_small", 0)]
    return ExplorationEnv(maps, num_envs=num_envs, num_robots=2, macro_steps=macro_steps, local_steps=5)


@pytest.fixture(scope="module")
def played() -> tuple[Episode, list[dict]]:
    """An episode and the snapshots it was made of."""
    env = make_env()
    torch.manual_seed(0)
    recorder, snapshots = EpisodeRecorder("random"), []

    def look(inputs: list[dict]) -> None:
        snapshots.append(inputs[0])
        recorder.add(inputs[0])

    watch_episode(env, env.rand_action, look, 1, every=2)
    return recorder.episode(), snapshots


@pytest.fixture()
def episode_file(played, tmp_path) -> Path:
    return played[0].save(tmp_path / "episode.npz")


def test_an_episode_replays_what_the_env_showed(played, episode_file):
    episode, snapshots = Episode.load(episode_file), played[1]
    assert len(episode) == len(snapshots) == 10
    assert episode.policy == "random" and episode.num_robots == 2
    assert episode.seconds.tolist() == pytest.approx([0, 0.2, 0.4, 0.5, 0.7, 0.9, 1.0, 1.2, 1.4, 1.5])
    for record, wanted in enumerate(snapshots):
        found = episode.snapshot(record)
        for name in set(wanted) - {"map", "trail", "coverage"}:
            np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
        assert found["coverage"] == pytest.approx(wanted["coverage"], abs=1e-6)
        assert found["map"].name == wanted["map"].name
        assert found["trail"].shape == wanted["trail"].shape
        np.testing.assert_allclose(found["trail"], wanted["trail"], atol=0.5)  # the env's comes off the picture's grid
    assert snapshots[-1]["seen_free"].sum() > snapshots[0]["seen_free"].sum(), "or flags were not tried"
    np.testing.assert_allclose(episode.snapshot(-1)["trail"][-1], snapshots[-1]["center"])


def test_episode_file_holds_no_pickle_and_appears_whole(played, tmp_path, monkeypatch):
    path = played[0].save(tmp_path / "a.npz")
    before = path.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda file, **arrays: file.write(b"half") and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        played[0].save(path)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    with np.load(path, allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind != "O" for name in arrays.files)


def spoil(path: Path, **changes) -> Path:
    """The same file with some arrays changed (None: left out)."""
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in arrays.files}
    kept |= changes
    np.savez(path, **{name: value for name, value in kept.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"pose": None}, "no pose"),
        ({"visible": np.zeros((10, 2, 1), np.uint8)}, "visible has shape"),
        ({"step": np.arange(10)[::-1]}, "do not rise"),
        ({"step": np.arange(10) * 2**40}, "local steps"),
        ({"step": np.zeros(0, int)}, "step has shape"),
        ({"coverage": np.full(10, np.nan)}, "coverage has NaN"),
        ({"body": np.zeros((2, 2))}, "a body of 0"),
        ({"episode_format": np.array("other")}, "episode format other"),
        ({"policy": np.zeros(3)}, "must be text"),
        ({"free": np.zeros((0, 3))}, "0 points"),
    ],
)
def test_damaged_episodes_are_refused_in_a_sentence(episode_file, changes, wanted):
    with pytest.raises(MapError, match=wanted) as caught:
        Episode.load(spoil(episode_file, **changes))
    assert str(episode_file) in str(caught.value) and "\n" not in str(caught.value)


def test_truncated_and_foreign_files_are_refused(episode_file, tmp_path):
    content = episode_file.read_bytes()
    for cut in (0, 10, len(content) // 2, len(content) - 5):
        episode_file.write_bytes(content[:cut])
        with pytest.raises(MapError):
            Episode.load(episode_file)
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("step.npy", b"\x80\x04not an array")
    with pytest.raises(MapError):
        Episode.load(tmp_path / "b.npz")


def test_film_shows_the_teams_at_the_same_time():
    env = make_env(2)
    episodes = play_teams(env, POLICIES["random"](env), "random", every=2)
    short = episodes[1]
    cut = {
        name: getattr(short, name)[:4]
        for name in ("step", "pose", "center", "goal", "waypoint", "collided", "coverage", "visible")
    }
    episodes[1] = Episode(**{**short.__dict__, **cut})  # a team that was done early
    frames = draw_film(episodes)
    assert len(frames) == 10
    for record in (2, 9):
        left, right = (draw_frame(episodes[k].snapshot((record, min(record, 3))[k]), 440) for k in (0, 1))
        assert np.array_equal(frames[record][:, :440], left) and np.array_equal(frames[record][:, -440:], right)
    below = draw_film(episodes, ["One line.", "Another."], columns=1)[9]
    alone = draw_grid([draw_frame(episodes[k].snapshot((9, 3)[k]), 440) for k in (0, 1)], columns=1)
    assert np.array_equal(below[-len(alone) :], alone) and len(below) % 2 == 0 and len(below) > len(alone)
    assert (below[: len(below) - len(alone)] < 100).any(), "letters"


@pytest.mark.parametrize("count", [1, 3])
def test_recorders_of_torchrl_film_the_env(count, tmp_path):
    from torchrl.envs import Compose, TransformedEnv, check_env_specs
    from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

    env = make_env()
    logger = CSVLogger("run", log_dir=str(tmp_path), video_format="pt")
    pixels = PixelRenderTransform(mode="rgb_array", size=96, index=list(range(count)))
    filmed = TransformedEnv(env, Compose(pixels, VideoRecorder(logger, "film")))
    check_env_specs(filmed)
    filmed.transform[-1].obs.clear()
    filmed.rollout(3)
    filmed.transform.dump()
    film = torch.load(tmp_path / "run" / "videos" / "film_0.pt", weights_only=True)
    last = env.render(list(range(count)), size=96)
    assert film.shape == (1, 4, 3, *last.shape[:2]) and film.dtype == torch.uint8  # the start and three steps
    assert np.array_equal(film[0, -1].permute(1, 2, 0).numpy(), last)
    assert not torch.equal(film[0, 0], film[0, 1])
    assert (last == EXPLORED).all(-1).any()


def test_render_refuses_what_is_no_team():
    env = make_env()
    for index in (3, -1, [0, 3], [], 0.5, [[0]]):
        with pytest.raises(ValueError, match="numbers from 0 to 2"):
            env.render(index)
    with pytest.raises(ValueError, match="mode='human'"):
        env.render(mode="human")


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_evaluate_renders_a_film_of_each_policy(kind, tmp_path, capsys):
    if kind == "mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the extra maexp[video] is not installed")
    where = tmp_path / "e"
    words = ["policy=random,nearest_frontier", "episodes=2", "num_envs=2", "render=true", "render_envs=2"]
    assert main(["evaluate", *TINY, *words, f"render_format={kind}", f"hydra.run.dir={where}"]) == 0
    printed = capsys.readouterr().out
    for name in ("random", "nearest_frontier"):
        assert (where / f"film_{name}.{kind}").stat().st_size > 1000 and f"film_{name}.{kind}" in printed
        starts = [Episode.load(where / "episodes" / f"{name}_{k}.npz").center[0] for k in range(2)]
        assert not np.array_equal(*starts), "each team has an episode of its own"
    if kind == "gif":
        with Image.open(where / "film_random.gif") as film:
            assert film.n_frames > 10 and film.width > 2 * 360
    first, second = (Episode.load(where / "episodes" / f"{name}_0.npz") for name in ("random", "nearest_frontier"))
    assert np.array_equal(first.center[0], second.center[0]), "policies play the same episodes"
    assert "maexp view" in printed


def test_no_team_is_filmed_that_is_not_in_the_results(tmp_path, capsys):
    words = ["policy=random", "episodes=2", "render=true", "render_envs=3", f"hydra.run.dir={tmp_path / 'e'}"]
    assert main(["evaluate", *TINY, *words]) == 0
    assert "render_envs=3 is more than is played (episodes=2): 2 will be filmed" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "e" / "episodes").iterdir()} == {"random_0.npz", "random_1.npz"}


@pytest.mark.parametrize(
    ("word", "wanted"), [("render_format=avi", "gif, mp4"), ("render_envs=0", "1 to 64"), ("render_envs=65", "1 to 64")]
)
def test_evaluate_refuses_what_cannot_be_rendered(word, wanted, tmp_path, capsys):
    where = tmp_path / "e"
    assert main(["evaluate", "policy=random", "render=true", word, f"hydra.run.dir={where}"]) == 2
    assert wanted in capsys.readouterr().err and not where.exists()
