"""Three dimensions: what a scene holds, what the painter shows, who draws it, and the command that asks for it."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from worlds import index_of

from maexp.agents.cli import main
from maexp.agents.evaluation.video import play_teams
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, PointCloudMap, make_map
from maexp.envs.render import show
from maexp.envs.render.episode import Episode
from maexp.envs.render.frames import EXPLORED, OVERLAP, ROBOT_COLOURS, UNEXPLORED, WALL_SEEN, WALL_UNSEEN, robot_colour
from maexp.envs.render.painter import look_at, make_quads, paint
from maexp.envs.render.stage import GROUND, WALL_SHARE, Stage

pytestmark = pytest.mark.slow  # a browser's page

SIZE = (600, 400)


def room(width=20, height=16, **heights) -> PointCloudMap:
    """A walled room of width x height points at 1 m with a wall across from x = 10, y = 5 to 10."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(width), np.arange(height), indexing="ij"))
    wall = (x == 0) | (y == 0) | (x == width - 1) | (y == height - 1) | ((x == 10) & (y >= 5) & (y <= 10))
    points = np.column_stack([x, y]).astype(float)
    return PointCloudMap(points[~wall], points[wall], 1.0, name="room", **heights)


def team(place: PointCloudMap, **changes) -> dict:
    """A snapshot of two robots at (3, 3) and (16, 12), which have seen nothing, heading along x."""
    center = np.array([[3.0, 3.0], [16.0, 12.0]])
    none = {"free": np.zeros((2, len(place.free)), bool), "boundary": np.zeros((2, len(place.boundary)), bool)}
    snapshot = {
        "map": place,
        "pose": np.column_stack([center, np.zeros((2, 2))]),
        "center": center,
        "trail": center[None],
        "body": np.full((2, 2), [1.2, 0.8]),
        "goal": np.full((2, 2), np.nan),
        "radar_range": np.full(2, 0.1),
        "seen_free": none["free"],
        "seen_boundary": none["boundary"],
        "visible": none["free"],
        "coverage": 0.0,
        "local_step": 0,
        "collided": np.zeros(2, bool),
    }
    return snapshot | changes


def painted(scene, azimuth=-60.0, elevation=50.0):
    """The painter's picture, and a function that tells the colour at a place (x, y, z)."""
    camera = look_at(scene.bounds, *SIZE, azimuth, elevation)
    picture = paint(make_quads(scene), camera)

    def at(*place) -> tuple:
        column, row = camera.project(np.array(place, dtype=float))[0]
        return tuple(picture[int(row), int(column)].tolist())

    return picture, at


@pytest.fixture(scope="module")
def episode() -> Episode:
    """Two robots for 1.5 s."""
    env = ExplorationEnv([make_map("maze_small", 0)], num_envs=1, num_robots=2, macro_steps=3, local_steps=5)
    return play_teams(env, POLICIES["random"](env), "random", every=1)[0]


def test_columns_are_as_high_as_the_scan_says():
    place = room()
    assert Stage(place).wall_height == pytest.approx(np.full(len(place.obstacles), WALL_SHARE * 19))
    heights = np.linspace(102.0, 104.0, len(place.obstacles))
    scanned = room(free_height=np.full(len(place.free), 100.0), obstacle_height=heights)
    assert Stage(scanned).walls[:, 2] + Stage(scanned).wall_height == pytest.approx(heights - 100, abs=1e-4)
    assert Stage(scanned, cut=0.5).wall_height == pytest.approx(np.full(len(heights), 0.5))


def test_robots_stand_on_the_hill():
    slope = room().free[:, 0] * 0.5 + 7.0
    stage = Stage(room(free_height=slope, obstacle_height=np.full(len(room().obstacles), 30.0)))
    scene = stage.inputs(team(stage.map))
    assert scene.robots[:, 2] == pytest.approx([0.5 * (3 - 1), 0.5 * (16 - 1)])


def test_every_class_has_its_colour_in_its_place():
    place = room()
    seen, walls = np.zeros((2, len(place.free)), bool), np.zeros((2, len(place.boundary)), bool)
    seen[0, index_of(place.free, (6, 3))] = seen[:, index_of(place.free, (14, 3))] = True
    walls[1, index_of(place.boundary, (19, 8))] = True
    picture, at = painted(Stage(place).inputs(team(place, seen_free=seen, seen_boundary=walls)))
    top = WALL_SHARE * 19
    assert picture.shape == (SIZE[1], SIZE[0], 3) and picture.dtype == np.uint8
    assert at(6, 3, 0) == EXPLORED and at(14, 3, 0) == OVERLAP and at(8, 12, 0) == UNEXPLORED
    assert at(19, 8, top) == WALL_SEEN and at(0, 8, top) == WALL_UNSEEN
    assert (picture == robot_colour(1)).all(-1).any(), "robots lie over the ground around them"


def test_seen_by_one_robot_alone():
    place = room()
    seen = np.zeros((2, len(place.free)), bool)
    seen[0, index_of(place.free, (6, 3))] = seen[1, index_of(place.free, (14, 3))] = True
    _, at = painted(Stage(place).inputs(team(place, seen_free=seen), robot=1))
    assert at(6, 3, 0) == UNEXPLORED and at(14, 3, 0) == EXPLORED


@pytest.mark.parametrize("azimuth", [-120.0, -60.0, 0.0, 60.0, 160.0])
def test_walls_hide_what_is_behind_them(azimuth):
    """From every side: just behind the wall across is hidden, just before it is not."""
    place = room(free_height=np.zeros(len(room().free)), obstacle_height=np.full(len(room().obstacles), 2.5))
    scene = Stage(place).empty()
    picture, at = painted(scene, azimuth, 35.0)
    ahead = np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    step = 1.6 * np.array([np.sign(ahead[0]), 0])
    assert at(*(np.array([10.0, 7.5]) + step), 0) == GROUND
    assert at(*(np.array([10.0, 7.5]) - step), 0) != GROUND


def test_the_camera_sees_the_whole_map():
    for azimuth in range(0, 360, 45):
        for low, high in (((0, 0, 0), (100, 3, 1)), ((-5, 2, 0), (5, 90, 40)), ((7, 7, 0), (8, 8, 0.1))):
            bounds = np.array(low, float), np.array(high, float)
            camera = look_at(bounds, *SIZE, azimuth, 40.0)
            corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
            pixels, depth = camera.project(bounds[0] + corners * (bounds[1] - bounds[0]))
            share = np.ptp(pixels, axis=0) / SIZE
            assert (pixels >= 0).all() and (pixels <= SIZE).all() and (depth > 0).all()
            assert 0.8 < share.max() <= 1.0


def test_colours_of_three_hundred_robots_differ():
    colours = [robot_colour(i) for i in range(300)]
    assert len(set(colours)) == 300 and tuple(colours[:8]) == ROBOT_COLOURS
    background = np.array([UNEXPLORED, EXPLORED, OVERLAP], dtype=int)
    assert all(np.abs(background - colour).sum(axis=1).min() > 90 for colour in colours)


@pytest.mark.parametrize(
    ("outcome", "wanted"),
    [
        (subprocess.CompletedProcess([], -11, "", ""), "signal 11"),
        (subprocess.CompletedProcess([], 1, "", "first\nFailed to create EGL context\n"), "EGL context"),
        (subprocess.CompletedProcess([], 0, "", ""), "status 0"),
        (subprocess.TimeoutExpired([], 1), "TimeoutExpired"),
        (OSError("no memory"), "OSError"),
    ],
)
def test_where_open3d_fails_the_painter_draws_and_says_so(outcome, wanted, monkeypatch):
    def run(*args, **kwargs):
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(show.subprocess, "run", run)
    scene = Stage(room()).empty()
    picture, how = show.draw_scene(scene, 300)
    assert picture.shape == (200, 300, 3) and picture.std() > 5
    assert "painter" in how and wanted in how and "\n" not in how
    with pytest.raises(ValueError, match="renderer=open3d does not work here"):
        show.draw_scene(scene, 300, "open3d")
    if wanted != "status 0":
        assert wanted in show.open_window(scene, "title")


@pytest.mark.slow
def test_open3d_draws_what_the_painter_draws(episode):
    scene = Stage(episode.map).inputs(episode.snapshot(-1))
    try:
        drawn, how = show.draw_scene(scene, 480, "open3d")
    except ValueError as error:
        pytest.skip(f"OPEN3D CANNOT DRAW HERE: {error}")
    picture, _ = show.draw_scene(scene, 480, "painter")
    assert "Open3D" in how and drawn.shape == picture.shape
    close = np.abs(drawn.astype(int) - picture).max(axis=-1) < 12
    assert close.mean() > 0.9


def view(capsys, *words: str) -> str:
    """What `maexp view` prints, with the painter, which is quick."""
    assert main(["view", "renderer=painter", *words]) == 0
    return capsys.readouterr().out


def test_view_of_an_episode_writes_a_picture(episode, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = episode.save(tmp_path / "my (1) = episode.npz")
    printed = view(capsys, str(path), "hydra.run.dir=v", "size=300")
    assert "maze_small_0, random, 2 robots" in printed and "v/view.png" in printed and "painter" in printed
    with Image.open("v/view.png") as picture:
        assert picture.width == 300 and picture.height > 200  # a caption below
        last = np.asarray(picture)
    view(capsys, str(path), "seconds=0", "out=first.png", "size=300")
    with Image.open("first.png") as picture:
        assert not np.array_equal(np.asarray(picture), last)


def test_the_picture_shows_the_episode_that_is_asked_for(tmp_path, capsys, monkeypatch):
    """`episode=1` of a folder is what its own file shows alone; a page begins with it, too."""
    monkeypatch.chdir(tmp_path)
    env = ExplorationEnv([make_map("maze_small", 0)], num_envs=3, num_robots=2, macro_steps=2, local_steps=5)
    Path("e/episodes").mkdir(parents=True)
    for name in ("voronoi", "random"):
        for number, episode in enumerate(play_teams(env, POLICIES[name](env), name), 9):
            episode.save(f"e/episodes/{name}_{number}.npz")

    def picture(*words) -> np.ndarray:
        view(capsys, *words, "out=a.png", "size=300")
        with Image.open("a.png") as drawn:
            found = np.asarray(drawn)
        Path("a.png").unlink()
        return found

    alone = {file.stem: picture(f"e/episodes/{file.name}") for file in Path("e/episodes").iterdir()}
    assert np.array_equal(picture("e"), alone["random_9"]), "the first by number, not by letters (random_10)"
    assert np.array_equal(picture("e", "episode=10"), alone["random_10"])
    assert np.array_equal(picture("e", "episode=11", "policy=voronoi"), alone["voronoi_11"])
    assert not np.array_equal(alone["random_10"], alone["random_9"])
    for words, wanted in (
        (["episode=12"], "give 9 to 11"),
        (["policy=frontier"], "those of random, voronoi"),
        (["policy=nearest_frontier"], "those of random, voronoi"),
    ):
        assert main(["view", "e", *words, "out=b.png"]) == 2 and not Path("b.png").exists()
        err = capsys.readouterr().err
        assert wanted in err and err.count("\n") == 1, err


@pytest.mark.parametrize("words", [["indoor_small", "index=3"], ["scenario=indoor_small", "index=3"], ["map.npz"]])
def test_view_of_a_map(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_map("indoor_small", 3).save("map.npz")
    view(capsys, *words, "out=a.png", "size=300")
    scene = Stage(make_map("indoor_small", 3)).empty()
    with Image.open("a.png") as picture:
        assert np.array_equal(np.asarray(picture), show.draw_scene(scene, 300, "painter")[0])


def test_view_plays_a_policy_on_the_map_that_is_given(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_map("maze_small", 3).save("map.npz")
    words = ["policy=random", "num_robots=2", "num_envs=2", "scenario.macro_steps=1", "hydra.run.dir=v", "size=300"]
    printed = view(capsys, "map.npz", *words)
    assert printed.count("maze_small_3, random, 2 robots") == 2 and "maexp view v browser=true" in printed
    assert [Episode.load(path).map.name for path in sorted(Path("v/episodes").iterdir())] == ["maze_small_3"] * 2
    assert "maze_small_3" in view(capsys, "v", "out=again.png", "size=300"), "its folder can be viewed again"
    assert "maze_small_5, random" in view(capsys, "maze_small", "index=5", *words[:-2], "hydra.run.dir=w", "size=300")


def test_view_of_a_run_plays_its_policy(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny = ["scenario.maps=[0]", "scenario.held_out=[70]", "num_envs=2", "scenario.macro_steps=2", "num_robots=2"]
    words = ["scenario=maze_small", "collector.steps=2", "total_frames=4", "episodes=0", "evaluate_every=0"]
    words += ["checkpoint_every=1", "hydra.run.dir=run"]
    assert main(["train", *tiny, *words]) == 0
    printed = view(capsys, "run", "hydra.run.dir=v", "size=300")
    assert "maze_small_70, trained, 2 robots" in printed
    again = view(capsys, "run/checkpoints/best.pt", "num_robots=3", "hydra.run.dir=w", "size=300")
    assert "maze_small_70, trained, 3 robots" in again
    first = Episode.load("v/episodes/trained_0.npz")
    assert first.step[-1] == 20 and len(first) > 10
    capsys.readouterr()
    assert main(["evaluate", "checkpoint=run", "episodes=2", "render=true", "hydra.run.dir=e"]) == 0
    film = Episode.load("e/episodes/trained_0.npz")
    assert np.array_equal(film.center[0], first.center[0]), "the same held-out episode"


def test_a_window_opens_where_there_is_a_display(episode, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, opened = episode.save(tmp_path / "e.npz"), []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(show, "open_window", lambda scene, title, **view: opened.append(title))
    assert main(["view", str(path), "hydra.run.dir=v"]) == 0
    assert opened == ["MAexp: maze_small_0"] and not Path("v").exists(), "nothing was written, no folder is left"
    monkeypatch.setattr(show, "open_window", lambda scene, title, **view: "it was ended by signal 11")
    monkeypatch.setattr(show, "_run_open3d", lambda *args: "no driver")
    capsys.readouterr()
    assert main(["view", str(path), "hydra.run.dir=v", "size=300"]) == 0
    assert "signal 11" in capsys.readouterr().out and Path("v/view.png").is_file()


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["nothing.pcd"], "nothing.pcd does not exist"),
        (["empty"], "neither checkpoints nor episodes"),
        (["half.npz"], "half.npz"),
        (["run"], "whole checkpoint"),
        (["maze_small", "out=a.jpg"], ".png"),
        (["maze_small", "out=none/a.png"], "lies in no folder"),
        (["maze_small", "out=half.npz.png"], "exists already"),
        (["maze_small", "seen_by=0"], "there is no team"),
        (["maze_small", "episode=1"], "there is no team"),
        (["maze_small", "seconds=1"], "there is no team"),
        (["e.npz", "episode=1"], "episode=1 is not in e.npz: give 0"),
        (["e.npz", "episode=-1"], "from 0 to 2147483647"),
        (["maze_small", "policy=random", f"episode={2**31}"], "from 0 to 2147483647"),
        (["e.npz", "seconds=-5"], "seconds=-5"),
        (["e.npz", "seconds=nan"], "seconds=nan"),
        (["e.npz", "seconds=inf"], "seconds=inf"),
        (["e.npz", "seen_by=2"], "0 to 1"),
        (["e.npz", "seen_by=-1"], "0 to 1"),
        (["maze_small", "policy=luck"], "policy=luck"),
        (["maze_small", "renderer=crayon"], "auto, open3d, painter"),
        (["maze_small", "elevation=90"], "from 1 to 89"),
        (["maze_small", "azimuth=nan"], "azimuth=nan"),
        (["maze_small", "cut=-1"], "cut=-1"),
        (["maze_small", "size=10"], "size=10"),
        (["maze_small", "num_envs=65"], "from 1 to 64"),
        (["maze_small", "index=-1"], "index=-1"),
        (["map.npz", "index=1"], "map.npz is one map"),
        (["maze_small", "more"], "'more'"),
    ],
)
def test_view_refuses_in_one_sentence(words, wanted, episode, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = episode.save(tmp_path / "e.npz").read_bytes()
    Path("half.npz").write_bytes(content[: len(content) // 2])
    Path("half.npz.png").touch()
    Path("empty").mkdir()
    Path("run/checkpoints").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    assert main(["view", *words, "hydra.run.dir=v"]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("maexp: ") and err.count("\n") == 1 and wanted in err, err
    assert sorted(tmp_path.rglob("*")) == before


def test_random_numbers_go_on_as_if_nothing_had_been_watched():
    env = ExplorationEnv([make_map("maze_small", 0)], num_envs=1, num_robots=2, macro_steps=1, local_steps=2)
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    play_teams(env, POLICIES["random"](env), "random")
    assert torch.equal(torch.rand(3), wanted)
