"""`scenario=ir2`: the protocol of IR2 on a user's plans."""

import json
import warnings

import numpy as np
import pytest
from PIL import Image

from maexp.agents.build import load_maps, make_env
from maexp.agents.cli import main
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.resolved import flatten, resolve
from maexp.agents.config.runs import continue_run
from maexp.agents.errors import UserError
from maexp.envs.maps.point_cloud import MapError

WALL, GROUND, START = 127, 195, 208  # shades of IR2's own plans
SMALL = ("scenario.macro_steps=2", "scenario.local_steps=5", "device=cpu", "num_threads=1")


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> str:
    """Two rooms of 10 x 10 m with a door of 2 m between, as a picture without a yaml, 0.2 m a pixel."""
    pixels = np.full((60, 120), WALL, dtype=np.uint8)
    pixels[5:55, 5:55] = pixels[5:55, 65:115] = pixels[25:35, 55:65] = GROUND
    pixels[28:32, 20:30] = START
    path = tmp_path_factory.mktemp("plans") / "1.png"
    Image.fromarray(pixels).save(path)
    return str(path)


def compose(*words: str):
    return compose_settings("evaluate", ["scenario=ir2", "policy=random", *words])


def test_the_protocol_counts_in_pixels(plan):
    cfg = compose(f"scenario.path={plan}", *SMALL[2:])
    world = load_maps(cfg.scenario).held_out[0]
    assert world.scenario == "ir2" and world.free_area == pytest.approx(204.0, rel=0.05), "grey walls, grey ground"
    env = make_env(cfg, [world], cfg.num_robots, 2)
    assert (env.num_robots, env.local_steps, env.macro_steps) == (4, 40, 196)
    assert {radar.range for radar in env.radar_configs} == {80 * 0.2}
    assert env.comm_config.signal and env.comm_config.cell == "auto"  # an 80th of the radar range: a pixel
    settings = env.settings
    assert (settings.done, settings.success_coverage) == ("everyone", 0.99)
    starts = env.reset()["agents", "observation", "pose"][..., :2]
    apart = (starts[:, :, None] - starts[:, None]).norm(dim=-1)
    assert apart.sort(-1).values[..., 1].max() < 1.5, "beside each other"


def test_a_pixel_is_a_pixel_whatever_a_yaml_says(plan, tmp_path):
    (tmp_path / "plan.yaml").write_text(
        f"image: {plan}\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    area = [
        load_maps(compose(f"scenario.path={path}").scenario).held_out[0].free_area
        for path in (plan, tmp_path / "plan.yaml")
    ]
    assert area[0] == area[1]


def test_words_of_the_command_come_before_the_protocol():
    assert compose().comm.signal and compose().num_robots == 4
    assert compose("comm=everyone").comm.signal is False
    assert compose("comm.noise=13", "num_robots=5", "scenario.done=union").comm.noise == 13.0
    assert compose("num_robots=5").num_robots == 5 and compose("scenario.done=union").scenario.done == "union"


def test_a_run_of_elsewhere_plays_by_the_protocol(tmp_path):
    words = ["scenario=maze_small", "num_robots=2", "comm.loss=0.5", "seed=7"]
    values = flatten(resolve(compose_settings("train", words)))
    saved = {"settings": values, "overrides": words, "followers": []}
    recipe = continue_run(tmp_path, saved, ["scenario=ir2", "scenario.path=x.png"], "evaluate")
    assert not {"num_robots", "comm.loss", "comm.signal", "scenario.done"} & {*recipe.values}
    assert recipe.values["seed"] == 7 and "num_robots=2" not in recipe.words
    recipe = continue_run(tmp_path, saved, ["scenario=ir2", "scenario.path=x.png", "num_robots=3"], "evaluate")
    assert "num_robots=3" in recipe.words
    stays = continue_run(tmp_path, saved, ["scenario=maze"], "evaluate")
    assert stays.values["num_robots"] == 2


def test_what_is_no_plan_is_refused(plan, tmp_path):
    with pytest.raises(UserError, match="scenario=ir2 needs a map: add scenario.path=FILE"):
        load_maps(compose().scenario)
    load_maps(
        compose_settings(
            "evaluate",
            [
                "scenario=pointcloud",
                f"scenario.path={plan}",
                "policy=random",
                "scenario.importing.pixel_size=0.2",
                "scenario.importing.free_threshold=0.3",
            ],
        ).scenario
    ).held_out[0].save(tmp_path / "saved.npz")
    with pytest.raises(UserError, match="1 is a saved map of scenario=pointcloud: give its picture"):
        load_maps(compose(f"scenario.path={tmp_path / 'saved.npz'}").scenario)
    Image.fromarray(np.full((40, 40), WALL, dtype=np.uint8)).save(tmp_path / "dark.png")
    with pytest.raises(MapError, match="no pixel is free"):
        load_maps(compose(f"scenario.path={tmp_path / 'dark.png'}").scenario)
    with pytest.raises(MapError, match="gone.png"):
        load_maps(compose(f"scenario.path={tmp_path / 'gone.png'}").scenario)


@pytest.mark.parametrize(
    ("gap", "told"),
    [
        (0, "map 2: 50% of the free space is not joined to the largest piece of it, and is left out"),
        (2, "map 2: 50% of the free space lies behind gaps narrower than 0.6 m"),
        (10, ""),
    ],
)
def test_who_plays_is_told_of_ground_that_is_left_out(gap, told, tmp_path, monkeypatch):
    monkeypatch.setattr("maexp.agents.build.TOLD", set())
    pixels = np.full((60, 120), WALL, dtype=np.uint8)
    pixels[5:55, 5:55] = pixels[5:55, 65:115] = pixels[25 : 25 + gap, 55:65] = GROUND
    Image.fromarray(pixels).save(tmp_path / "2.png")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):  # a command may load a map several times: it is told once
            load_maps(compose(f"scenario.path={tmp_path / '2.png'}", "scenario.importing.resolution=0.1").scenario)
    heard = [str(warning.message) for warning in caught]
    assert len(heard) == bool(told) and all(text.startswith(told) for text in heard), heard


def test_an_evaluation_has_their_metrics(plan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", "scenario=ir2", f"scenario.path={plan}", "policy=cost_utility", "episodes=2", "num_envs=2"]
    assert main([*words, *SMALL, "hydra.run.dir=out"]) == 0
    found = json.loads((tmp_path / "out" / "results.json").read_text())["cost_utility"]
    for name in ("longest_path", "success_rate", "worst_coverage", "connected", "told_step_95"):
        assert name in found
    assert found["connected"]["mean"] > 0
