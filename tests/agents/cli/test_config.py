"""Settings: every choice composes, and what does not fit is refused in one sentence."""

from dataclasses import asdict, fields

import pytest
from hydra._internal.hydra import Hydra

from maexp.agents.algorithms.registry import ALGORITHMS, TRAININGS
from maexp.agents.build import load_maps, make_env, make_learner, map_indices
from maexp.agents.cli import main
from maexp.agents.config.algorithms import KINDS
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.compose import compose, compose_settings
from maexp.agents.config.env import planner_config, team_configs
from maexp.agents.config.model import SIZES
from maexp.agents.config.overrides import find_override, make_overrides, quote, without
from maexp.agents.config.schema import default_values
from maexp.agents.config.verbs import SCHEMAS
from maexp.agents.errors import UserError
from maexp.conf import groups, list_choices, read_choice, read_file
from maexp.envs.config import PlannerConfig, RadarConfig, RobotConfig
from maexp.envs.scenarios import SCENARIOS, VOLUMES, Scenario


def refusal(verb: str, *words: str) -> str:
    with pytest.raises(UserError) as caught:
        compose_settings(verb, make_overrides(verb, list(words)))
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("group", groups())
def test_every_choice_composes_and_is_described(group):
    for choice, text in list_choices(group).items():
        assert text, f"conf/{group}/{choice}.yaml has no description on its first line"
        verb = "train" if group in SCHEMAS["train"].__dataclass_fields__ else "benchmark"
        words = [f"{group}={choice}", *["scenario.path=x.npz"] * (choice in ("pointcloud", "ir2"))]
        assert getattr(compose_settings(verb, words), group) is not None


def test_choices_match_the_tables_of_the_code():
    assert set(list_choices("scenario")) == {*SCENARIOS, *VOLUMES}
    assert set(list_choices("algorithm")) == set(TRAININGS)
    assert set(list_choices("model")) == set(SIZES)


REGIONS = ["action=regions"]  # action=targets brings settings of its own


def values(node, kind: type) -> dict:
    return {field.name: getattr(node, field.name) for field in fields(kind)}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_tuning_holds_the_settings_of_its_row(algorithm):
    row = ALGORITHMS[algorithm]
    for words, wanted in (
        (REGIONS, row.settings),
        (["action=targets", "tuning=reference"], row.reference),  # over what action=targets brings
    ):
        cfg = compose_settings("train", [f"algorithm={algorithm}", *words])
        held = values(cfg.algorithm, type(wanted))
        if wanted.lmbda is not None:  # it wins over the trace in seconds, which action=targets sets
            held["trace_seconds"] = wanted.trace_seconds
        assert held == asdict(wanted)


@pytest.mark.parametrize("planner", ["dwa", "wavefront", "direct"])
@pytest.mark.parametrize("scenario", ["maze", "indoor_small", "outdoor"])
def test_the_command_line_takes_what_the_env_takes_by_itself(scenario, planner):
    cfg, row = compose_settings("train", [*REGIONS, f"scenario={scenario}", f"planner={planner}"]), SCENARIOS[scenario]
    (robot,), (radar,) = team_configs(cfg, 1)
    assert robot.completed(row) == RobotConfig().completed(row)
    assert radar.completed(row) == RadarConfig().completed(row)
    whole = PlannerConfig(name=planner).completed(row)
    assert planner_config(cfg, row).completed(row) == whole


@pytest.mark.parametrize("verb", ["train", "evaluate", "export", "view"])
@pytest.mark.parametrize(
    ("words", "algorithm"),
    [
        (["action=targets"], None),
        (["action=regions"], "mappo"),
        (["action='regions'"], "mappo"),
        (["preset=paper"], "mappo"),
        (["action=regions", "algorithm=ippo"], "ippo"),
    ],
)
def test_the_default_algorithm_goes_with_the_action(verb, words, algorithm):
    """Expert iteration, the default, learns what targets are worth."""
    if "preset" not in default_values(SCHEMAS[verb]) and words == ["preset=paper"]:
        return
    assert compose_settings(verb, words).algorithm.name == (algorithm or "expert_iteration")


def test_hydra_composes_once_for_a_command(monkeypatch, capsys):
    calls, compose_once = [], Hydra.compose_config

    def count(*words, **settings):
        calls.append(words)
        return compose_once(*words, **settings)

    monkeypatch.setattr(Hydra, "compose_config", count)
    assert main(["train", "scenario=maze", "--cfg", "job"]) == 0
    assert len(calls) == 1 and "name: maze\n" in capsys.readouterr().out


def test_every_setting_of_a_file_differs_from_its_default():
    """A value stands once: in the dataclass, or where a choice changes it."""
    chosen, open_ = 0, ("name", "kind", "path", "defaults")
    car = {field.name: field.default for field in fields(Scenario)}
    for group, defaults in default_values(SCHEMAS["train"]).items():
        for choice in list_choices(group) if isinstance(defaults, dict) else ():
            content = read_file(group, choice)
            held, usual = content.get(group, content), defaults | {"row": car}
            if group == "algorithm":
                usual = asdict(KINDS[choice]())
            for base in (entry for entry in content.get("defaults", ()) if isinstance(entry, str) and entry[0] != "_"):
                usual = usual | {"row": car | read_choice(group, base)["row"]}
            for name, value in held.items():
                values = value if name == "row" else {name: value}
                known = usual["row"] if name == "row" else usual
                same = {name for name, value in values.items() if name not in open_ and known.get(name, {}) == value}
                assert not same - {"clearance_factor"}, f"conf/{group}/{choice}.yaml repeats the defaults of {same}"
                chosen += len(values)
    assert chosen > 20


def test_null_is_refused_where_it_means_nothing():
    assert refusal("train", "reward.explore=null") == "reward.explore=null has no meaning: give it a value."
    assert compose_settings("train", ["radar.range=null"]).radar.range is None  # the scenario's


def test_every_verb_composes():
    for verb in SCHEMAS:
        words = ["task=list"] if verb in ("maps", "policies", "bench", "suite", "ros2") else []
        assert compose(verb, words).run_dir.endswith(f"-{verb}")


@pytest.mark.parametrize(
    ("word", "wanted"),
    [
        ("num_envs=three", ("num_envs='three'", "whole number")),
        ("num_envs=", ("num_envs=", "whole number")),
        ("radar.range=far", ("radar.range='far'", "number")),
        ("scenario=labyrinth", ("scenario=labyrinth", "maze_small")),
        ("num_robot=3", ("num_robot ", "num_robots")),
        ("radar.rang=3", ("radar.rang ", "radar.range")),
        ("num_envs=1,2", ("num_envs=1,2", "-m")),
        ("comm.base_station=1,1", ("comm.base_station=1,1", "-m", "comm.base_station=[1,1]")),
        ("comm.range=1" + 400 * "0", ("comm.range=1e+400 must be a number",)),
        ("comm.range=1" + 5000 * "0", ("comm.range=1000000000", "give fewer digits")),
        ("seed=1" + 400 * "0", ("seed=1e+400", "from 0 to")),
        ("+comm.bogus=5", ("comm.bogus is not a setting of maexp train",)),
        ("++faults.bogus=5", ("faults.bogus is not a setting of maexp train", "faults.at")),
        ("+scenario.importing.bogus=5", ("scenario.importing.bogus is not a setting",)),
        ("+comm.bogus.more=5", ("comm.bogus is not a setting",)),
        ("+bogus=5", ("bogus is not a setting of maexp train",)),
        ("maze", ("'maze'", "name=value")),
    ],
)
def test_one_clear_sentence(word, wanted):
    message = refusal("train", word)
    assert all(part in message for part in wanted), message


@pytest.mark.parametrize("verb", ["evaluate", "view", "bench"])
def test_a_verb_without_sweeps_names_no_flag_for_them(verb):
    message = refusal(verb, "comm.base_station=1,1")
    assert "-m " not in message and "or, if it takes several, comm.base_station=[1,1]" in message, message


def test_a_setting_that_is_there_may_be_forced():
    assert compose_settings("train", ["++comm.range=5"]).comm.range == 5.0


def test_no_team_is_so_large():
    with pytest.raises(UserError, match=r"num_robots=1e\+400 must be a whole number from 1 to 1000000000"):
        team_sizes(10**400)


NAMES = ["a b.yaml", "a=b (1).yaml", "it's.npz", "a,b.ply", "${x}.pcd", "back\\slash.xyz", "1e3"]


@pytest.mark.parametrize("name", NAMES)
def test_any_file_name_survives(name, tmp_path):
    word = f"scenario.path={tmp_path / name}"
    cfg = compose_settings("train", make_overrides("train", ["scenario=pointcloud", word]))
    assert cfg.scenario.path == str(tmp_path / name)
    cfg = compose_settings("maps", make_overrides("maps", ["import", name], ("task", "file")))
    assert (cfg.task, cfg.file) == ("import", name)


def test_quote_round_trip_of_trailing_backslashes():
    assert find_override([f"file={quote(chr(92) * 3)}"], "file") == chr(92) * 3


def test_lists_of_values_only_where_they_mean_a_list():
    cfg = compose_settings("evaluate", make_overrides("evaluate", ["num_robots=1,2", "policy=random,nearest_frontier"]))
    assert (cfg.num_robots, cfg.policy) == ([1, 2], ["random", "nearest_frontier"])
    assert make_overrides("train", ["num_robots=2,3"]) == ["num_robots=[2,3]"]
    assert make_overrides("train", ["num_robots=2,3"], multirun=True) == ["num_robots=2,3"], "a sweep"


def test_without_drops_groups_and_their_values():
    words = ["scenario=maze", "scenario.path='x'", "seed=1"]
    assert without(words, "scenario") == ["seed=1"]


def test_settings_reach_the_env_and_the_networks():
    words = ["scenario=maze_small", "num_envs=2", "radar.range=7", "robot.max_speed=3", "planner=dwa"]
    words += ["scenario.macro_steps=4", "scenario.maps=[3]", "model.channels=8", "algorithm.lr=0.5", "comm.range=9"]
    words += ["reward.collision=5"]
    cfg = compose_settings("train", words)
    maps = load_maps(cfg.scenario)
    assert [world.name for world in maps.train] == ["maze_small_3"]
    env = make_env(cfg, maps.train, 2)
    assert (env.num_envs, env.num_robots, env.macro_steps) == (2, 2, 4)
    assert {radar.range for radar in env.radar_configs} == {7.0}
    assert {robot.max_speed for robot in env.robot_configs} == {3.0}
    assert (env.planner_config.name, env.settings.reward.collision, env.comm_config.range) == ("dwa", 5.0, 9.0)
    assert cfg.model.channels == 8
    assert make_learner(cfg, env).updater.settings.lr == 0.5


def test_a_team_of_different_robots():
    team = "robot.team=[{kind: differential, radar: {range: 3}},{max_speed: 1}]"
    cfg = compose_settings("train", ["scenario=maze_small", team])
    robots, radars = team_configs(cfg, 3)
    radars = [radar.completed(SCENARIOS["maze_small"]) for radar in radars]
    assert [robot.kind for robot in robots] == ["differential", None, "differential"]
    assert [radar.range for radar in radars] == [3, 10.0, 3]
    with pytest.raises(UserError, match="robot.team has no setting wings"):
        team_configs(compose_settings("train", ["robot.team=[{wings: 2}]"]), 3)


def indices(*words: str) -> tuple[list[int], list[int], list[int]]:
    return map_indices(compose_settings("train", ["scenario=maze_small", *words]).scenario)


def test_maps_that_choose_are_neither_trained_on_nor_held_out():
    assert indices() == ([*range(51)], [*range(51, 64)], [*range(64, 80)])
    assert indices("scenario=indoor_small") == ([*range(11)], [11, 12, 13], [14, 15, 16])
    for name, row in SCENARIOS.items():
        if row.build is not None:
            train, validation, held_out = indices(f"scenario={name}")
            assert train and validation and held_out and [*train, *validation, *held_out] == [*range(row.count)]
    assert indices("scenario.maps=[52]", "scenario.held_out=[53]") == ([52], [51, *range(54, 64)], [53])
    assert indices("scenario.validation=[3]", "scenario.maps=[0]")[1] == [3]


def test_no_validation_maps_as_before_there_were_any():
    """The maps trained on choose, as with maps of one's own."""
    assert indices("scenario.validation=[]") == ([*range(64)], [], [*range(64, 80)])
    suite = load_maps(compose_settings("train", ["scenario.validation=[]", "scenario.maps=[1,0]"]).scenario)
    assert [world.name for world in suite.validation] == ["indoor_medium_1", "indoor_medium_0"]
    suite = load_maps(compose_settings("train", ["scenario.validation=[7]", "scenario.maps=[1,0]"]).scenario)
    assert [world.name for world in suite.validation] == ["indoor_medium_7"]


def test_more_held_out_maps_than_the_table_has():
    assert indices("scenario.held_out_count=50")[2] == [*range(64, 114)]
    assert indices("scenario.held_out_count=2", "scenario=indoor_small")[2] == [14, 15]
    with pytest.raises(UserError, match="give one of them"):
        indices("scenario.held_out_count=2", "scenario.held_out=[70]")
    with pytest.raises(UserError, match="scenario.held_out_count=0 must be a whole number, 1 or more"):
        indices("scenario.held_out_count=0")


@pytest.mark.parametrize("word", ["validation=[-1]", "maps=[]", "maps=[-1]", "held_out=x"])
def test_bad_indices(word):
    with pytest.raises(UserError, match="must be a list of whole numbers"):
        load_maps(compose_settings("train", [f"scenario.{word}"]).scenario)
