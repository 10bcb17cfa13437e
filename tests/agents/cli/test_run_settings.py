"""A run says what it ran: resolved values, how a checkpoint's settings meet new words."""

import shlex
import warnings
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from maexp.agents.algorithms import ALGORITHMS
from maexp.agents.build import make_env, make_learner
from maexp.agents.cli import main
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.resolved import flatten, resolve, to_yaml
from maexp.agents.config.runs import continue_run
from maexp.agents.errors import UserError
from maexp.agents.files import checksums, warn_of_changed_maps
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.envs import make_map
from maexp.envs.config import GROUPS
from maexp.envs.scenarios import SCENARIOS

FILE = Path("run.pt")
BUILT = [name for name, row in SCENARIOS.items() if row.build]


def save(*words: str, **changed: object) -> dict:
    """What a checkpoint of a run says of its settings; `changed` stand for defaults that were others then."""
    cfg = compose_settings("train", list(words))
    settings = resolve(cfg)
    for name, value in changed.items():
        group, _, key = name.partition("__")
        settings[group][key] = value
    return {"overrides": list(words), "settings": settings, "followers": list(cfg.followers)}


def play(saved: dict, *new: str, verb: str = "evaluate") -> dict:
    """The values that a verb has for a checkpoint and new words."""
    return flatten(resolve(compose_settings(verb, continue_run(FILE, saved, list(new), verb))))


@pytest.mark.parametrize(
    ("scenario", "planner"), [*((name, "dwa") for name in BUILT), ("maze", "wavefront"), ("maze", "direct")]
)
def test_nothing_is_null(scenario, planner):
    settings = flatten(resolve(compose_settings("train", [f"scenario={scenario}", f"planner={planner}"])))
    assert None not in settings.values()
    row = SCENARIOS[scenario]
    assert settings["radar.range"] == row.radar_range and settings["robot.max_speed"] == row.max_speed
    assert settings["scenario.local_steps"] == row.decision_steps()
    assert settings["scenario.maps"] and settings["scenario.held_out"]
    assert ("planner.num_steering" in settings) == (planner != "direct")
    assert ("planner.replan_steps" in settings) == (planner == "wavefront")


def test_places_and_moments_of_a_run_are_played():
    """They are pairs in the env, lists in files."""
    words = ["comm.base_station=[3,4]", "faults.at=[[0,30],[1,2.5]]"]
    there = {"comm.base_station": [3.0, 4.0], "faults.at": [[0, 30.0], [1, 2.5]]}
    assert there.items() <= play(save(*words)).items()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_algorithm_shows_its_own_settings_and_no_others(algorithm):
    cfg = compose_settings("train", [f"algorithm={algorithm}", "algorithm.lr=0.5", "model=paper"])
    shown = resolve(cfg)
    assert shown["algorithm"].keys() == {"name", *asdict(ALGORITHMS[algorithm].settings)}
    assert shown["algorithm"]["lr"] == 0.5
    assert shown["model"] == asdict(cfg.model) and shown["model"]["channels"] == 32


def test_the_values_are_those_of_the_env_and_the_learner():
    cfg = compose_settings("train", ["num_envs=2", "robot.team=[{kind: differential, radar: {range: 3}}, {}]"])
    maps = [make_map("maze_small", 0)]
    env, shown = make_env(cfg, maps, 2), resolve(cfg, maps)
    assert [
        robot | {"radar": asdict(radar)}
        for robot, radar in zip(map(asdict, env.robot_configs), env.radar_configs, strict=True)
    ] == [{"radius": None} | robot for robot in shown["robot"]["team"]]
    assert shown["planner"].items() <= asdict(env.planner_config).items()
    assert shown["reward"] == asdict(env.settings.reward) and shown["comm"] == asdict(env.comm_config)
    assert (env.local_steps, env.macro_steps) == (shown["scenario"]["local_steps"], shown["scenario"]["macro_steps"])
    learner = make_learner(cfg, env)
    mine = {name: value for name, value in asdict(learner.updater.settings).items() if value is not None}
    assert {"name": "expert_iteration"} | mine == shown["algorithm"]


def test_every_group_of_settings_reaches_the_env():
    changed = {
        "robot.max_yaw_rate": 1.0,
        "radar.evidence": 2,
        "planner.replan_steps": 7,
        "reward.time": 0.25,
        "observation.pictures": False,
        "comm.range": 5.0,
        "faults.probability": 0.5,
        "odometry.drift": 0.01,
        "targets.distinct": False,
        "lookahead.horizon": 3,
    }
    assert {name.split(".")[0] for name in changed} == set(GROUPS)
    cfg = compose_settings("evaluate", ["num_envs=1", *(f"{name}={value}" for name, value in changed.items())])
    env = make_env(cfg, [make_map("maze_small", 0)], 1)
    for name, value in changed.items():
        group, key = name.split(".")
        config = getattr(env.settings, group)
        assert getattr(config[0] if isinstance(config, tuple) else config, key) == value, name


def test_a_map_of_ones_own_tells_its_scenario_and_the_length_of_an_episode(tmp_path):
    world = make_map("maze_small", 0)
    cfg = compose_settings("train", ["scenario=pointcloud", f"scenario.path={world.save(tmp_path / 'x.npz')}"])
    assert resolve(cfg, [world])["radar"]["range"] == 10.0, "the map was built for maze_small"
    assert "range" not in resolve(cfg)["radar"], "who has not read the map does not know"


def test_classical_planners_have_no_algorithm_and_a_benchmark_no_scenario_of_its_own():
    for verb, words in (("evaluate", ["policy=random"]), ("view", ["policy=random", "checkpoint=null"])):
        shown = resolve(compose_settings(verb, words))
        assert not {"algorithm", "tuning", "model"} & shown.keys() and shown["radar"]["range"] == 10.0
        learned = resolve(compose_settings(verb, [*words, "checkpoint=x"]))
        assert shown.keys() == learned.keys() - {"algorithm", "tuning", "model", "checkpoint"}
    shown = resolve(compose_settings("benchmark", ["scenarios=[maze,outdoor]"]))
    assert "name" not in shown["scenario"] and "name" not in shown["algorithm"] and None not in flatten(shown).values()


def test_yaml_holds_the_same_values():
    settings = resolve(compose_settings("train", ["comm.range=inf"]))
    settings |= {"resume": " ".join(["a run"] * 30)}  # more than a line
    written = to_yaml(settings, "train")
    assert OmegaConf.to_container(OmegaConf.create(written)) == settings
    assert "  range: 1.0  # how far it sees [m]\n" in written and "  gamma: 1.0  # does nothing here\n" in written
    assert "num_robots: 3  # robots in a team" in written and "  lr: 0.002  # learning rate of the policy\n" in written


# A checkpoint and new words


def test_a_run_is_played_as_it_was_trained():
    words = ["scenario=maze", "planner=wavefront", "reward=paper", "radar.range=8", "model.channels=8", "num_robots=2"]
    words += ["collector.steps=30"]  # a run sets it to the episode's length
    saved = save(*words, scenario__macro_steps=7, reward__overlap=0.3, robot__wheelbase=0.7, algorithm__lr=0.25)
    before = flatten(saved["settings"])
    assert play(saved, "resume=x", verb="train") == before | {"resume": "x"}
    for verb in ("evaluate", "view"):
        after = play(saved, "checkpoint=x", verb=verb)
        same = {name for name in before if "." in name and name.partition(".")[0] not in ("collector", "logger")}
        assert same <= after.keys() and all(after[name] == before[name] for name in same)
        assert after["num_robots"] == 2


def test_new_words_win():
    saved = save("radar.range=8", reward__overlap=0.3)
    after = play(saved, "scenario.held_out_count=50")
    assert after["scenario.held_out_count"] == 50 and "scenario.held_out" not in after
    after = play(saved, "radar.range=5", "reward.overlap=0.1", "seed=3", "num_robots=6")
    assert (after["radar.range"], after["reward.overlap"], after["seed"], after["num_robots"]) == (5.0, 0.1, 3, 6)


def test_another_scenario_brings_its_own_values_but_not_what_the_run_had_set():
    saved = save("scenario=maze", "robot.max_speed=3", "scenario.maps=[1]", reward__overlap=0.3, radar__range=99.0)
    after, row = play(saved, "scenario=indoor_medium"), SCENARIOS["indoor_medium"]
    assert after["radar.range"] == row.radar_range and after["robot.length"] == row.body_length
    assert (
        after["scenario.macro_steps"] == row.episode_decisions(None, row.decision_steps())
        and after["planner.num_steering"] == row.num_steering
    )
    assert after["scenario.maps"] == list(range(21)) and after["scenario.validation"] == list(range(21, 26))
    assert after["robot.max_speed"] == 3.0, "set by the run itself"
    assert after["reward.overlap"] == 0.3, "no matter of scenarios"
    assert play(saved, "scenario=maze")["radar.range"] == 99.0, "the scenario that it was"


def test_a_group_chosen_anew_is_todays():
    saved = save("planner=dwa", "planner.horizon=5", planner__clearance_weight=7.0, planner__clearance_factor=9.0)
    today = flatten(resolve(compose_settings("train", ["planner=wavefront"])))
    after = play(saved, "planner=wavefront")
    assert {k: v for k, v in after.items() if k.startswith("planner.")} == {
        k: v for k, v in today.items() if k.startswith("planner.")
    }
    assert play(saved, "planner=dwa")["planner.clearance_factor"] == 9.0, "the planner that it was"


def test_what_a_scenario_supplies_can_be_set_there():
    saved = save(radar__range=99.0)
    assert (
        play(saved, "scenario.max_speed=3", "scenario.radar_range=5").items()
        >= {"robot.max_speed": 3.0, "radar.range": 5.0, "robot.length": 0.15}.items()
    )


def test_the_wheelbase_follows_the_body():
    saved = save(robot__wheelbase=0.7)
    assert play(saved)["robot.wheelbase"] == 0.7
    assert play(saved, "robot.length=2", "robot.width=2")["robot.wheelbase"] == 2.0


def test_a_run_takes_another_radius():
    saved = save("scenario=maze")
    assert (
        play(saved, "robot.radius=0.35").items()
        >= {"robot.length": 0.7, "robot.wheelbase": 0.7, "robot.collision_threshold": 0.35}.items()
    )
    saved = save("scenario=maze", "robot.radius=0.35")
    assert play(saved)["robot.width"] == 0.7 and play(saved, "robot.radius=0.5")["robot.width"] == 1.0
    assert play(saved, "scenario=indoor_small")["robot.width"] == 0.7
    back = play(saved, "robot.radius=null")
    assert "robot.radius" not in back and (back["robot.length"], back["robot.wheelbase"]) == (1.5, 1.0)
    with pytest.raises(ValueError, match=r"robot\.radius=0\.35 makes robot\.length 0\.7 m"):
        play(saved, "robot.length=2")


def test_what_follows_the_scenario_still_does_after_a_resumption():
    saved = save("scenario=maze", radar__range=99.0)
    recipe = continue_run(FILE, saved, ["resume=x", "total_frames=99"], "train")
    assert list(compose_settings("train", recipe.words).followers) == saved["followers"]


def test_a_value_that_is_no_longer_known_is_named():
    saved = save(planner__patience=7)
    with pytest.raises(UserError, match=r"run.pt holds planner.patience=7, which this version .* does not know"):
        play(saved)


def test_the_papers_clearance_follows_the_scenario():
    for saved in (save("preset=paper", "scenario=maze"), save("planner=paper", "scenario=maze")):
        assert play(saved)["planner.clearance_factor"] == 4.0
        assert play(saved, "scenario=indoor_small")["planner.clearance_factor"] == 4.2
        assert play(saved, "planner=wavefront")["planner.clearance_factor"] == 2.0


# Through the command line


def test_run_evaluate_resume(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["num_envs=2", "num_robots=2", "scenario.maps=[0]", "scenario.held_out=[64]", "scenario.macro_steps=3"]
    words += ["collector.steps=3", "device=cpu", "num_threads=1", "checkpoint_every=1", "evaluate_every=0"]
    monkeypatch.setattr("maexp.agents.cli.train.finish", lambda done: None)
    assert main(["train", *words, "total_frames=6", "hydra.run.dir=run"]) == 0
    path, saved = find_checkpoint("run")
    written = OmegaConf.to_container(OmegaConf.load("run/config.yaml"))
    maps = [make_map("indoor_medium", index) for index in (0, 64)]
    assert written.pop("map_checksums") == saved["maps"] == checksums(maps)
    assert saved["settings"] == written
    assert "null" not in Path("run/config.yaml").read_text()
    saved["settings"]["reward"]["explore"] = 0.0  # as if the default had been another then
    saved["settings"]["robot"]["max_speed"] = 1.0
    torch.save(saved, path)
    assert main(["evaluate", "checkpoint=run", "episodes=2", "hydra.run.dir=played"]) == 0
    assert "changed" not in capsys.readouterr().err
    played = OmegaConf.load("played/config.yaml")
    assert (played.reward.explore, played.robot.max_speed, played.scenario.macro_steps) == (0.0, 1.0, 3)
    torch.save(saved | {"maps": saved["maps"] | {"indoor_medium_0": "0123"}}, path)  # as if it had been another then
    assert main(["train", "resume=run", "total_frames=12"]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "indoor_medium_0 has changed since the run was started, so that it cannot go on" in told
    anew = shlex.split(told.partition("has learned: ")[2])
    assert anew[-1] == "warm_start=run" and main([*anew[1:], "hydra.run.dir=anew", "warm_start_frames=12"]) == 0
    torch.save(saved, path)
    assert main(["train", "resume=run", "total_frames=12"]) == 0
    assert find_checkpoint("run")[1]["settings"]["reward"]["explore"] == 0.0
    assert find_checkpoint("run")[1]["followers"] == saved["followers"]


# Presets


def test_the_papers_set_up_is_the_same_for_every_verb():
    for verb in ("train", "evaluate", "benchmark"):
        cfg = compose_settings(verb, ["preset=paper"])
        assert (cfg.planner.name, cfg.reward.overlap, cfg.reward.events) == ("dwa", 0.01, 0.0)
        assert (cfg.tuning, cfg.model.stem) == ("reference", "conv")
    cfg = compose_settings("train", ["preset=paper", "algorithm=vda2c"])
    assert cfg.algorithm == ALGORITHMS["vda2c"].reference
    cfg = compose_settings("train", ["preset=paper", "planner=wavefront", "algorithm.lr=0.5"])
    assert (cfg.planner.name, cfg.model.channels, cfg.algorithm.lr) == ("wavefront", 32, 0.5)
    assert resolve(cfg)["planner"]["clearance_factor"] == 2.0
    assert resolve(compose_settings("train", ["planner=dwa"]))["planner"]["clearance_factor"] == 3.0
    paper = resolve(compose_settings("train", ["preset=paper", "scenario=indoor_large"]))["planner"]
    assert (paper["name"], paper["clearance_factor"]) == ("dwa", 4.2)
    assert "clearance_factor" not in resolve(compose_settings("benchmark", ["preset=paper"]))["planner"], (
        "its scenarios'"
    )
    assert compose_settings("train", ["preset=paper", "model=small"]).model.channels == 16


def test_a_smoke_preset_is_over_at_once():
    cfg = compose_settings("train", ["preset=smoke"])
    assert cfg.total_frames <= 2 * cfg.num_envs * cfg.collector.steps and cfg.scenario.macro_steps == 3


def test_a_preset_does_not_change_a_run():
    with pytest.raises(UserError, match="preset=paper stands for many settings, and those of run.pt are kept"):
        play(save(), "preset=paper")


# Maps


def test_maps_that_changed_are_named():
    maps = [make_map("maze_small", index) for index in range(2)]
    saved = {"maps": checksums(maps)}
    object.__setattr__(maps[1], "free", maps[1].free[:-1])
    with pytest.warns(UserWarning, match="^maze_small_1 has changed since"):
        warn_of_changed_maps(saved, maps)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_changed_maps(saved, maps[:1])


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("comm.cell=1", ""),
        ("radar.obstacle_radius=1", ""),
        ("comm.cell=0", "comm.cell=0 must be auto or a finite number above 0"),
        ("comm.period=2.5", "comm.period=2.5 must be auto or a whole number"),
        ("comm.delay=0.04", "comm.delay=0.04 is less than half a step of 0.1 s: use 0 or 0.1"),
    ],
)
def test_whole_numbers_stand_for_numbers_beside_words(word, told):
    words = ["policy=random", "comm=ir2", word]
    if told:
        with pytest.raises((ValueError, UserError), match=told):
            resolve(compose_settings("evaluate", words))
    else:
        resolve(compose_settings("evaluate", words))
