"""Settings of algorithms and networks: each has a range, and what lies outside is named with it."""

import math
import re
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import torch

from maexp.agents.algorithms import ALGORITHMS
from maexp.agents.cli import main
from maexp.agents.config.model import SIZES, ModelConfig
from maexp.agents.config.schema import settings_of
from maexp.agents.config.verbs import SCHEMAS
from maexp.envs.config import (
    CommConfig,
    FaultsConfig,
    LookaheadConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
    RewardConfig,
    RobotConfig,
)
from maexp.envs.config_fields import check_settings, kinds

# What each setting may be and what it may not be, from what it means (not from the code).
GOOD = {
    "gamma": [0, 1.0, None],
    "lmbda": [0, 1, None],
    "learn_share": [1e-3, 1, None],
    "horizon_seconds": [1e-3, 1e6],
    "trace_seconds": [1e-3, 1e6],
    "final_lr_share": [0, 1],
    "accept_ratio": [0, 1],
    "lr": [1e-9, 2],
    "critic_lr": [1e-9],
    "max_grad_norm": [1e-3],
    "kl_target": [1e-6],
    "max_kl": [1e-6],
    "entropy_coeff": [0],
    "critic_coeff": [0],
    "clip_value": [0, 10],
    "kl_coeff": [0],
    "damping": [0],
    "anchor_coeff": [0, 3],
    "clip_epsilon": [0.01, 0.99],
    "backtrack_factor": [0.01, 0.99],
    **{name: [True, False] for name in ("value_norm", "normalize_advantage", "finite_horizon", "mask_collided")},
    "mixer": ["vdn", "qmix"],
    **{
        name: [1, 7]
        for name in (
            "minibatch_size",
            "epochs",
            "cg_steps",
            "backtracks",
            "policy_minibatch_size",
            "fisher_size",
            "critic_epochs",
        )
    },
}
BAD = {
    "gamma": [-0.1, 1.1, 2],
    "lmbda": [-1, 2],
    "learn_share": [0, 1.1],
    "horizon_seconds": [0, -1],
    "trace_seconds": [0, -1],
    "final_lr_share": [-0.5, 1.5],
    "accept_ratio": [-0.1, 1.1],
    "clip_epsilon": [-1, 0, 1],
    "backtrack_factor": [0, 1],
    "mixer": ["sum", ""],
    **{name: [0, -1] for name in ("lr", "critic_lr", "max_grad_norm", "kl_target", "max_kl")},
    **{
        name: [-1e-9]
        for name in (
            "entropy_coeff",
            "critic_coeff",
            "clip_value",
            "kl_coeff",
            "damping",
            "anchor_coeff",
        )
    },
    **{
        name: [0, -3, 1.5, True]
        for name in (
            "minibatch_size",
            "epochs",
            "cg_steps",
            "backtracks",
            "policy_minibatch_size",
            "fisher_size",
            "critic_epochs",
        )
    },
    **{name: [1, "yes"] for name in ("value_norm", "normalize_advantage", "finite_horizon", "mask_collided")},
}
EVERYWHERE = [math.nan, math.inf, -math.inf, "much", None]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_setting_of_an_algorithm_has_its_range(name):
    row = ALGORITHMS[name]
    for tuning in ("default", "reference"):
        row.configure(tuning)
    for setting in (field.name for field in fields(row.settings) if field.name != "name"):
        for value in GOOD[setting]:
            assert getattr(row.configure(**{setting: value}), setting) == value
        for value in [value for value in BAD[setting] + EVERYWHERE if value is not None or None not in GOOD[setting]]:
            with pytest.raises(ValueError, match=rf"algorithm\.{setting}=") as caught:
                row.configure(**{setting: value})
            assert repr(value) in str(caught.value) and "must be" in str(caught.value)


@pytest.mark.parametrize("name", [field.name for field in fields(ModelConfig)])
def test_every_size_of_a_network_has_its_range(name):
    kind = type(getattr(SIZES["small"], name))
    bad = {str: ["fft"], bool: [1], int: [0, -1, 2.0, 10**6, True], float: [-1e-9]}[kind]
    for value in bad + EVERYWHERE:
        with pytest.raises(ValueError, match=rf"model\.{name}=.*must be"):
            ModelConfig(**{name: value})


@pytest.mark.parametrize(
    ("kind", "name", "value", "sentence"),
    [
        (RobotConfig, "length", -1, "robot.length=-1 must be a finite number above 0 [m]."),
        (
            RobotConfig,
            "kind",
            "boat",
            "robot.kind='boat' must be one of ackermann, differential, omnidirectional, quadrotor, climber.",
        ),
        (RadarConfig, "alpha1", 3.0, "radar.alpha1=3.0 must be a number from 0 to 2."),
        (RadarConfig, "fov", 0, "radar.fov=0 must be a finite number above 0 [rad]."),
        (CommConfig, "cell", "big", "comm.cell='big' must be auto or a finite number above 0 [m]."),
        (PlannerConfig, "horizon", 2.5, "planner.horizon=2.5 must be a whole number, 1 or more."),
        (OdometryConfig, "turn", 1e38, "odometry.turn=1e+38 must be a number from 0 to 1e+12 [rad]."),
        (OdometryConfig, "drift", 1e300, "odometry.drift=1e+300 must be a number from 0 to 1e+12 [m]."),
        (OdometryConfig, "jump", 1e20, "odometry.jump=1e+20 must be a number from 0 to 1e+12 [m]."),
        (RadarConfig, "range", 1e39, "radar.range=1e+39 must be a number from 1e-12 to 1e+12 [m]."),
        (RadarConfig, "alpha2", -1e300, "radar.alpha2=-1e+300 must be a number from -1e+12 to 1e+12 [m]."),
        (RobotConfig, "max_speed", 1e-300, "robot.max_speed=1e-300 must be a number from 1e-12 to 1e+12 [m/s]."),
        (RobotConfig, "length", 10**400, "robot.length=1e+400 must be a number from 1e-12 to 1e+12 [m]."),
        (RewardConfig, "explore", 1e38, "reward.explore=1e+38 must be a number from 0 to 1e+12."),
        (CommConfig, "cell", 1e-300, "comm.cell=1e-300 must be auto or a number from 1e-12 to 1e+12 [m]."),
        (CommConfig, "cell", 1e300, "comm.cell=1e+300 must be auto or a number from 1e-12 to 1e+12 [m]."),
        (CommConfig, "power", -(10**400), "comm.power=-1e+400 must be a number from -1e+12 to 1e+12 [dBm]."),
        (CommConfig, "range", 10**400, "comm.range=1e+400 must be a number from 0 to 1.79769e+308 [m], or inf."),
        (
            CommConfig,
            "period",
            10**12,
            "comm.period=1000000000000 must be auto or a whole number from 1 to 1000000000.",
        ),
        (CommConfig, "period", 10**400, "comm.period=1e+400 must be auto or a whole number from 1 to 1000000000."),
        (CommConfig, "range", math.nan, "comm.range=nan must be a number, 0 or more [m], or inf."),
        (CommConfig, "power", "loud", "comm.power='loud' must be a finite number [dBm]."),
        (CommConfig, "signal", 1, "comm.signal=1 must be true or false."),
        (ObservationConfig, "targets", True, "observation.targets=True must be a whole number from 0 to 256."),
        (LookaheadConfig, "loss", math.inf, "lookahead.loss=inf must be a finite number, 0 or more [radar discs]."),
        (RewardConfig, "time", None, "reward.time=None must be a finite number, 0 or more."),
    ],
)
def test_the_message_names_setting_value_range_and_unit(kind, name, value, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        check_settings(kind(**{name: value}), kind.__name__.removesuffix("Config").lower())


@pytest.mark.parametrize(
    "place",
    [
        [1, 2],
        (np.float32(1), np.int64(2)),
        np.array([1.0, 2.0], np.float32),
        np.array([1, 2]),
        torch.tensor([1.0, 2.0]),
        [torch.tensor(1), 2.0],
    ],
)
def test_a_place_of_any_numbers_is_one_of_pythons(place):
    comm = CommConfig(base_station=place).checked()
    assert comm == CommConfig(base_station=(1.0, 2.0)) and hash(comm) == hash(CommConfig(base_station=(1.0, 2.0)))
    assert [type(x) for x in comm.base_station] == [float, float]


def test_whether_there_is_a_base_may_be_numpys():
    assert CommConfig(base_station=np.True_).checked().base_station is True


@pytest.mark.filterwarnings("error")  # NumPy warns where a limit overflows in a number's own kind
def test_numbers_of_numpy_are_compared_as_what_they_are():
    check_settings(CommConfig(range=np.float32(8.0), period=np.int64(3), bandwidth=np.float32("inf")), "comm")
    check_settings(RadarConfig(missed=np.float32(0.99)), "radar")  # the greatest
    for range_ in (np.float32("nan"), np.float32(-1.0)):
        with pytest.raises(ValueError, match="comm.range="):
            check_settings(CommConfig(range=range_), "comm")
    with pytest.raises(ValueError, match="comm.base_station="):
        CommConfig(base_station=(np.float32("inf"), 0.0)).checked()


def test_what_may_be_infinite_or_left_open_passes():
    check_settings(CommConfig(range=math.inf, cell=2.0, base_station=(1.0, 2.0)), "comm")
    check_settings(RobotConfig(wheelbase="length"), "robot")


@pytest.mark.parametrize(
    "settings",
    [
        CommConfig(range=1e300, bandwidth=1e300, cell=0.001, power=100, period=10**6),
        FaultsConfig(duration=1e300),
        OdometryConfig(drift=1e6, turn=100, jump=1e6, jump_rate=10),
        RadarConfig(range=1e9, fov=100.0),
        RobotConfig(max_accel=1e9, max_speed=np.float32(3.0), length=np.int64(2)),
        RewardConfig(success=1e9),
    ],
)
def test_large_numbers_that_mean_something_pass(settings):
    assert settings.checked() == settings


@pytest.mark.parametrize("verb", SCHEMAS)
def test_every_setting_has_a_line_of_help(verb):
    """But names of choices and what only the command line fills in."""
    settings = SCHEMAS[verb]
    missing = {field.name for field in settings_of(settings) if not field.metadata.get("help")}
    groups = {name for name in missing if is_dataclass(kinds(settings)[name][0])}
    allowed = {
        "preset",
        "action",
        "tuning",
        "task",
        "sweep",
        "checkpoint",
        *(["seed", "algorithm"] if verb == "benchmark" else []),
    }
    assert missing - groups <= allowed
    for group in groups:
        kind = kinds(settings)[group][0]
        bare = {field.name for field in fields(kind) if not field.metadata.get("help")}
        assert bare <= {"name", "team", "importing"}, (group, bare)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["algorithm.lr=nan"], "algorithm.lr=nan must be a finite number above 0."),
        (["algorithm.gamma=2"], "algorithm.gamma=2.0 must be a number from 0 to 1."),
        (
            ["algorithm=mappo", "algorithm.clip_epsilon=-1"],
            "algorithm.clip_epsilon=-1.0 must be a number above 0 and below 1.",
        ),
        (["algorithm.minibatch_size=0"], "algorithm.minibatch_size=0 must be a whole number, 1 or more."),
        (["algorithm=vdppo", "algorithm.mixer=sum"], "algorithm.mixer='sum' must be one of qmix, vdn."),
        (["model.channels=0"], "model.channels=0 must be a whole number from 1 to 4096."),
    ],
)
def test_the_command_refuses_in_one_sentence(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny = ["scenario.maps=[0]", "scenario.held_out=[70]", "num_envs=2", "total_frames=30", "episodes=0"]
    assert main(["train", *tiny, *words]) == 2
    assert capsys.readouterr().err == f"maexp: {sentence}\n"
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("train episodes=-1", "episodes=-1 must be a whole number, 0 or more."),
        ("train total_frames=0", "total_frames=0 must be a whole number from 1 to 1000000000000."),
        ("train seed=2147483648", "seed=2147483648 must be a whole number from 0 to 2147483647."),
        ("train collector=processes collector.workers=0", "collector.workers=0 must be a whole number, 1 or more."),
        ("evaluate policy=random render_envs=65", "render_envs=65 must be a whole number from 1 to 64."),
        ("benchmark iterations=0", "iterations=0 must be a whole number, 1 or more."),
        ("view maze_small size=10", "size=10 must be a whole number from 64 to 8192 [px]."),
        ("view maze_small azimuth=nan", "azimuth=nan must be a number from -360 to 360 [degrees]."),
        ("view maze_small cut=0", "cut=0.0 must be a finite number above 0 [m]."),
        ("maps make maze index=-1", "index=-1 must be a whole number, 0 or more."),
        ("irsim floor.yaml people=-1", "people=-1 must be a whole number, 0 or more."),
        ("suite run minival policy=random patience=inf", "patience=inf must be a finite number above 0 [s]."),
        ("bench env seconds=0", "seconds=0.0 must be a finite number above 0 [s]."),
        ("train --cfg job evaluate_every=-1", "evaluate_every=-1 must be a whole number, 0 or more."),
    ],
)
def test_a_setting_of_a_verb_is_refused_by_the_range_of_its_field(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    assert capsys.readouterr().err == f"maexp: {sentence}\n" and not list(tmp_path.iterdir())
