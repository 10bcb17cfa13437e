"""The page in the browser: what its controls do, the file that needs no server, and how it looks in Chromium."""

import sys

import numpy as np
import pytest
from browser import find_browser, open_tab
from PIL import Image

from maexp.agents.cli import main
from maexp.agents.evaluation.video import play_teams
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, make_map
from maexp.envs.render.frames import EXPLORED, LIGHT, UNEXPLORED
from maexp.envs.render.stage import Stage

pytest.importorskip("viser", reason="THE EXTRA maexp[view] IS NOT INSTALLED: the page is not tested")
from maexp.envs.render.page import TEAM, Page, _paint, write_page

pytestmark = pytest.mark.slow  # a browser's page


@pytest.fixture(scope="module")
def episodes() -> list:
    """Two teams of two robots for 1.5 s."""
    env = ExplorationEnv([make_map("maze_small", 0)], num_envs=2, num_robots=2, macro_steps=3, local_steps=5)
    return play_teams(env, POLICIES["random"](env), "random", every=1)


@pytest.fixture()
def page(episodes):
    page = Page([Stage(episode.map) for episode in episodes], episodes)
    yield page
    page.stop()


def ground(page) -> np.ndarray:
    return page.actors.ground.batched_colors


def test_playing_goes_to_the_end_and_stops(page, episodes):
    page.speed.value = "2x"
    page.toggle()
    assert page.playing and page.play.label == "Pause"
    page.advance(0.25)
    assert page.episode.seconds[page.record] == pytest.approx(0.5) and page.time.value == pytest.approx(0.5)
    page.toggle()
    page.advance(10.0)
    assert page.episode.seconds[page.record] == pytest.approx(0.5), "paused"
    page.toggle()
    page.advance(10.0)
    assert page.record == len(episodes[0]) - 1 and not page.playing and page.play.label == "Play"
    page.toggle()
    assert page.record == 0, "from the start again"


def test_scrubbing_shows_that_moment(page, episodes):
    for seconds in (1.0, 0.0, 1.5):
        page.seek(seconds)
        snapshot = episodes[0].snapshot(round(10 * seconds))
        scene = Stage(episodes[0].map).inputs(snapshot)
        assert np.array_equal(ground(page), _paint(scene.ground_colour))
        np.testing.assert_allclose(page.actors.moving["robots"].batched_positions, scene.robots, atol=1e-4)
        assert f"after **{seconds:.1f} s**" in page.status.content


def test_what_one_robot_has_seen(page, episodes):
    page.seek(1.5)
    whole = ground(page).copy()
    page.robot.value = "robot 1"
    page.show()
    seen = episodes[0].snapshot(-1)["seen_free"][1]
    assert (ground(page) == _paint(UNEXPLORED)).all(-1).sum() == (~seen).sum() > 0
    assert "robot 1 has seen" in page.status.content
    page.robot.value = TEAM
    page.show()
    assert np.array_equal(ground(page), whole)


def test_another_episode(page, episodes):
    page.seek(1.0)
    page.open_episode(1)
    assert page.record == 0 and page.episode is episodes[1]
    page.seek(1.5)
    scene = Stage(episodes[1].map).inputs(episodes[1].snapshot(-1))
    np.testing.assert_allclose(page.actors.moving["robots"].batched_positions, scene.robots, atol=1e-4)


def test_a_map_alone_has_no_controls():
    stage = Stage(make_map("maze_small", 1))
    page = Page([stage], [])
    try:
        assert not hasattr(page, "play") and len(ground(page)) == len(stage.map.free)
        page.run(0.05)
    finally:
        page.stop()


def test_a_taken_port_is_passed_over(page, episodes):
    other = Page([Stage(episode.map) for episode in episodes], episodes, port=page.server.get_port())
    assert other.address != page.address and other.address.startswith("http://127.0.0.1:")
    other.stop()


def test_colours_come_out_of_the_film_curve_as_they_went_in():
    """The curve as three.js has it, on the light that a level surface of that paint sends back."""
    from maexp.envs.render import page

    wanted = np.array([EXPLORED, (120, 170, 225), (196, 196, 196), (213, 94, 0), (52, 52, 56)])
    light = _paint(wanted) / 255 * page.LIGHT / 0.6 @ page._ACES_IN.T
    film = (light * (light + 0.0245786) - 0.000090537) / (light * (0.983729 * light + 0.432951) + 0.238081)
    shown = np.clip(film @ page._ACES_OUT.T, 0, 1)
    shown = 255 * np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert np.abs(shown - wanted).max() < 12


def test_a_missing_viser_is_named(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "maze_small", "browser=true"]) == 2
    assert 'pip install "maexp[view]"' in capsys.readouterr().err


def test_the_page_as_a_file(episodes, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    episodes[0].save(tmp_path / "e.npz")
    assert main(["view", "e.npz", "out=page.html", "hydra.run.dir=v"]) == 0
    text = (tmp_path / "page.html").read_text()
    assert "__VISER_EMBED_DATA__" in text and "page.html" in capsys.readouterr().out
    assert len(text) > len(write_page(Stage(episodes[0].map), None, tmp_path / "map.html").read_text())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.npz", "map.html", "page.html"]


def share_of(pixels: np.ndarray, colour) -> float:
    """The share of a picture that is about as coloured."""
    return float((np.abs(pixels - colour).max(axis=-1) < 16).mean())


@pytest.mark.slow
def test_the_page_in_a_browser(page, tmp_path):
    """It opens, plays when the button is pressed, and shows green ground; about a minute without a GPU."""
    program = find_browser()
    if program is None:
        pytest.skip("NO CHROMIUM HERE: the page was not opened in a browser")
    with open_tab(program, page.address, tmp_path / "profile") as tab:
        tab.wait_for("after 0.0 s", 180)
        for control in ("speed", "episode", "explored by", "follow the robot", "radar range"):
            assert control in tab.text()
        tab.press("Play")
        for _ in range(600):
            page.run(0.1)
            if page.record == len(page.episode) - 1:
                break
        tab.wait_for("after 1.5 s")
        for _ in range(20):  # the picture fades in, slowly without a GPU
            page.run(5.0)
            with Image.open(tab.picture(tmp_path / "page.png")) as picture:
                pixels = np.asarray(picture.convert("RGB")).astype(int)
            if share_of(pixels, (1 - LIGHT) * np.array(EXPLORED) + LIGHT * 255) > 0.01:  # what is seen just now
                break
        else:
            pytest.fail("the page never showed explored ground")
        assert share_of(pixels, UNEXPLORED) > 0.1
