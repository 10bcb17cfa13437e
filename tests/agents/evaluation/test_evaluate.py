"""Evaluation: the same episodes for everyone, every one to its end, and no trace in the random numbers."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from maexp.agents import make_policy
from maexp.agents.build import import_files, load_maps
from maexp.agents.cli import main
from maexp.agents.cli.evaluate import describe_episodes
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides, split_paths
from maexp.agents.errors import UserError
from maexp.agents.evaluation.comparison import describe_differences, describe_training, find_typical
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate, evaluate_recorded, play, pool
from maexp.agents.evaluation.metric_format import Evidence, describe_evidence
from maexp.agents.evaluation.results import COLUMNS, paired_differences, print_results
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, make_map
from maexp.envs.metrics import episode_metrics, in_reach, label_copies, resample_weights, summarise

POINTCLOUD = ("scenario=pointcloud", "policy=random")


def build(num_envs=3, num_robots=2, seed=0, macro_steps=3):
    maps = [make_map("maze_small", index) for index in (70, 71)]
    return ExplorationEnv(maps, num_envs, num_robots, seed=seed, macro_steps=macro_steps, local_steps=10)


@pytest.fixture(scope="module")
def env():
    return build()


def still(state):
    """Every robot's goal is region 0: a policy without random numbers."""
    shape = state["agents", "observation", "pose"].shape[:2]
    state["agents", "action", "region"] = torch.zeros(shape, dtype=torch.int64)
    state["agents", "action", "offset"] = torch.zeros(*shape, 2)
    return state


@pytest.mark.parametrize("num_envs", [1, 2, 5])
def test_episodes_do_not_depend_on_the_batch(env, num_envs):
    wanted = evaluate(still, env, 5).episodes
    found = evaluate(still, build(num_envs), 5).episodes
    for name, values in wanted.items():
        assert len(values) == 5
        torch.testing.assert_close(torch.from_numpy(found[name]), torch.from_numpy(values), equal_nan=True)


def test_recording_changes_nothing_and_ends_where_the_episodes_end(env):
    wanted, found = evaluate(still, env, 4), evaluate_recorded(still, env, 4)
    for name, values in wanted.episodes.items():
        np.testing.assert_array_equal(found.episodes[name], values)
    np.testing.assert_allclose(found.times, [0, 1, 2, 3])
    np.testing.assert_allclose(found.coverage[:, -1], wanted.episodes["exploration_ratio"], atol=1e-6)
    assert found.coverage.shape == (4, 4) and found.shares.shape == (4, 2) and wanted.coverage is None


def test_pooled_curves_share_their_times():
    """A place with longer episodes and other moments: what is done keeps its coverage."""
    first, second = (
        EvaluationResult(
            "random",
            1,
            {"exploration_ratio": np.ones(1)},
            1.0,
            np.array(["floor"]),
            times=np.array(times),
            coverage=np.array([coverage]),
            shares=np.ones((1, 1)),
        )
        for times, coverage in (([0.0, 2.0], [0.0, 0.5]), ([0.0, 1.0, 4.0], [0.1, 0.4, 1.0]))
    )
    both = pool([first, second])
    assert both.times.tolist() == [0, 1, 2, 4] and both.seconds == 2 and both.shares.shape == (2, 1)
    np.testing.assert_allclose(both.coverage, [[0, 0.25, 0.5, 0.5], [0.1, 0.4, 0.6, 1.0]])


def test_another_seed_gives_other_episodes(env):
    first, second = evaluate(still, env, 4).episodes, evaluate(still, build(seed=1), 4).episodes
    assert (first["exploration_ratio"] != second["exploration_ratio"]).any()


def test_the_final_info_is_that_of_the_episodes_end(env):
    """An env that ends early keeps the numbers of its end while the others play on."""
    env.set_episodes(torch.arange(3))
    state, ends = env.reset(), {}
    for step in range(env.macro_steps):
        state = env.step(still(state))
        for index in torch.nonzero(state["next", "done"].squeeze(-1)).flatten().tolist():
            ends.setdefault(index, (step, state["next", "info", "coverage"][index].item()))
        state = state["next"].exclude("agents").update({"agents": state["next", "agents"]})
    final = play(still, env, torch.arange(3))
    assert [ends[index][1] for index in range(3)] == final["coverage"].squeeze(-1).tolist()


def test_random_numbers_go_on_as_if_nothing_had_happened(env):
    policy = make_policy(env)
    torch.manual_seed(3)
    wanted = torch.rand(4)
    torch.manual_seed(3)
    first = evaluate(policy, env, 4, seed=1).episodes["path_length"]
    assert torch.equal(torch.rand(4), wanted)
    assert (evaluate(policy, env, 4, seed=1).episodes["path_length"] == first).all()
    assert (evaluate(policy, env, 4, seed=2).episodes["path_length"] != first).any()


def test_the_longest_way_and_the_marks_of_an_episode():
    """The longest of three robots' ways; 99 % was reached once, and counts with the limit where it was not."""
    team, count = [2, 1], 2
    info = {name: torch.zeros(team) for name in ("coverage", "coverage_auc")} | {
        name: torch.zeros(count, 3) for name in ("episode_reward_unscaled", "episode_reward", "collided")
    }
    for mark in (85, 95, 99):
        info |= {f"{name}_{mark}": torch.full(team, -1) for name in ("coverage_step", "mutual_overlap")}
    info |= {f"path_length_{mark}": torch.zeros(count, 3) for mark in (85, 95, 99)}
    info["path_length"] = torch.tensor([[1.0, 5.0, 3.0], [4.0, 0.0, 2.0]])
    info["coverage_step_99"], info["mutual_overlap_99"] = torch.tensor([[70], [-1]]), torch.tensor([[0.25], [0.0]])
    found = episode_metrics(TensorDict(info, [count]), 90)
    assert found["longest_path"].tolist() == [5.0, 4.0] and found["path_length"].tolist() == [3.0, 2.0]
    assert found["coverage_step_99_censored"].tolist() == [70.0, 90.0]
    np.testing.assert_array_equal(found["coverage_step_99"], [70.0, np.nan])
    np.testing.assert_array_equal(found["mutual_overlap_99"], [0.25, np.nan])


@pytest.mark.parametrize(("goal", "shown"), [(0.95, False), (0.99, True), (1.0, True)])
def test_marks_beyond_the_end_of_an_episode_are_not_shown(goal, shown, capsys):
    assert in_reach("coverage_step_99_censored", goal) == in_reach("path_length_99", goal) == shown
    assert in_reach("coverage_step_95", goal) and in_reach("coverage_auc", goal)
    assert not in_reach("mutual_overlap_95", 0.9)
    value = {name: np.ones(2) for name in COLUMNS}
    played = EvaluationResult("random", 3, value, 1.0, np.array(["a", "b"]), success_coverage=goal)
    print_results([played], "maze")
    assert ("99 % at step" in capsys.readouterr().out) == shown
    teams = [replace(played, policy="trained", learned=True), replace(played, policy="voronoi")]
    assert ("+0 steps to 99 %" in describe_differences(teams, {3: "voronoi"})[0]) == shown


@pytest.mark.parametrize("name", ["random", "nearest_frontier"])
def test_classical_policies_play(env, name):
    summary = evaluate(POLICIES[name](env), env, 3, name=name).summary()
    assert 0 < summary["exploration_ratio"]["mean"] <= 1
    assert summary["coverage_step_95"]["n"] <= summary["exploration_ratio"]["n"] == 3


def test_one_policy_for_every_team_size(env):
    policy = make_policy(env)
    for size in (1, 4):
        assert evaluate(policy, build(2, size), 2).num_robots == size


def test_several_maps_of_ones_own_are_told_apart_and_pooled(tmp_path, monkeypatch, capsys):
    """Each policy plays the same number of episodes on every map, as it would alone."""
    for index in (70, 71):
        make_map("maze_small", index).save(tmp_path / f"floor{index}.npz")
    monkeypatch.chdir(tmp_path)
    words = [
        "evaluate",
        "policy=random,nearest_frontier",
        "scenario=pointcloud",
        "episodes=2",
        "num_envs=2",
        "scenario.macro_steps=2",
        "scenario.local_steps=5",
        "num_robots=2",
        "device=cpu",
    ]
    main([*words, "scenario.path=floor70.npz,floor71.npz", "hydra.run.dir=both"])
    told = capsys.readouterr().out
    assert re.search(r"pointcloud: 2 episodes on each of 2 maps *\n", told) and "held-out" not in told
    main([*words, f"scenario.path={tmp_path}/floor71.npz", "hydra.run.dir=alone"])
    assert re.search(r"pointcloud: 2 episodes *\n", capsys.readouterr().out)
    both, alone = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("both", "alone"))
    assert both["run"]["maps"] == ["maze_small_70", "maze_small_71"]
    assert set(alone) == {"random", "nearest_frontier", "run"}
    for policy in ("random", "nearest_frontier"):
        first, second = (both[f"{policy} on maze_small_{index}"]["exploration_ratio"] for index in (70, 71))
        assert second == alone[policy]["exploration_ratio"] and first["n"] == second["n"] == 2
        together = both[policy]["exploration_ratio"]
        assert together["n"] == 4 and together["mean"] == pytest.approx((first["mean"] + second["mean"]) / 2)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["episodes=3"], "3 held-out episodes"),
        (["episodes=1"], "1 held-out episode"),
        (["episodes=3", "scenario.held_out=[0]"], "3 episodes"),  # a map that teams are trained on
    ],
)
def test_episodes_are_called_held_out_where_they_are(words, wanted):
    cfg = compose_settings("evaluate", ["policy=random", "scenario.held_out=[70]", *words])
    results = [EvaluationResult("random", 2, {"exploration_ratio": np.zeros(cfg.episodes)}, 1.0, np.array(["a"]))]
    assert describe_episodes(cfg.episodes, results, load_maps(cfg.scenario, train=False)) == wanted


def spread(found: dict) -> float:
    return found["ci95"][1] - found["ci95"][0]


def test_intervals_resample_maps_and_the_episodes_on_each():
    """Ten maps that differ and ten episodes each that do not: a hundred episodes say no more than ten."""
    rng = np.random.default_rng(1)
    of_map, maps = rng.normal(size=10), np.repeat([f"map {k}" for k in range(10)], 10)
    same = np.repeat(of_map, 10)
    plain, grouped, ten = summarise(same), summarise(same, resample_weights(maps)), summarise(of_map)
    assert spread(plain) < 0.45 * spread(ten) and spread(grouped) == pytest.approx(spread(ten), rel=0.1)
    assert (grouped["mean"], grouped["n"]) == (plain["mean"], 100)
    noise = rng.normal(size=100)  # maps alike: both say nearly the same
    assert spread(summarise(noise, resample_weights(maps))) == pytest.approx(spread(summarise(noise)), rel=0.4)
    alone = summarise(noise, resample_weights(np.repeat("floor", 100)))
    assert spread(alone) == pytest.approx(spread(summarise(noise)), rel=0.1)


def test_intervals_resample_the_seeds_of_training():
    """Three trainings of which one failed: no number of episodes makes that certain."""
    seeds, maps = np.repeat([0, 1, 2], 200), np.tile(np.repeat(["a", "b"], 100), 3)
    values = np.where(seeds == 2, 0.0, 1.0)
    assert spread(summarise(values, resample_weights(maps))) < 0.1
    found = summarise(values, resample_weights(maps, seeds))
    assert found["ci95"] == [pytest.approx(0.0, abs=0.01), pytest.approx(1.0)] and found["n"] == 600


def test_weights_count_episodes_and_values_that_are_missing_are_left_out():
    weights = resample_weights(np.array(["a", "a", "b", "b", "b"]))
    assert (weights == np.round(weights)).all() and weights.shape[1] == 5
    totals = {0: 4, 1: 5, 2: 6}  # twice a, once each, twice b
    assert set(weights.sum(1)) == set(totals.values()) and ((weights[:, :2].sum(1) % 2) == 0).all()
    values, maps = np.array([1.0, np.nan, 2.0, 3.0, np.nan, 4.0, 5.0]), np.array(list("aabbbbb"))
    found = summarise(values, resample_weights(maps))
    assert (found["mean"], found["n"]) == (3.0, 5) and 1.0 <= found["ci95"][0] < 3.0 < found["ci95"][1] <= 5.0
    assert np.isnan(summarise(values[1:], resample_weights(maps[1:]))["ci95"]).all()  # four have a value


def test_copies_say_no_more_than_one():
    """Ten episodes, each copied twenty times: the interval is that of ten; of four copied there is none."""
    values = np.random.default_rng(2).normal(size=10)
    maps, many = np.repeat("a", 200), np.repeat(values, 20)
    copies = label_copies(maps, {"one": many, "none": np.full(200, np.nan)})
    assert copies.tolist() == np.repeat(np.arange(10), 20).tolist()
    alone, told = summarise(values), summarise(many, resample_weights(maps, copies=copies), copies)
    assert spread(told) == pytest.approx(spread(alone), rel=0.1) and told["n"] == 200
    assert spread(summarise(many)) < 0.3 * spread(alone)
    few = copies.clip(max=3)
    assert np.isnan(summarise(many, resample_weights(maps, copies=few), few)["ci95"]).all()
    assert (resample_weights(maps) == resample_weights(maps, copies=np.arange(200))).all()


def test_copies_are_alike_on_one_map_in_all_metrics_of_all_policies():
    metrics = {"coverage_auc": np.array([0.5, 0.5, 0.5, 0.5]), "steps": np.array([np.nan, np.nan, 7.0, np.nan])}
    assert label_copies(np.array(list("aaab")), metrics).tolist() == [0, 0, 1, 2]
    drawn = {"coverage_auc": np.array([0.1, 0.2, 0.1, 0.1])}
    assert label_copies(np.array(list("aaab")), metrics, drawn).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "rows, wanted",
    [
        ([(64, 64, 16), (64, 64, 16)], []),
        (
            [(8, 1, 1), (8, 1, 1)],
            ["Of 8 episodes 1 is distinct, the rest copies: too few for an interval, which takes 5."],
        ),
        (
            [(8, 1, 1), (8, 8, 1)],
            [
                "Of 8 episodes of p0 1 is distinct, the rest copies: too few for an interval, which takes 5.",
                "The intervals rest on 1 map: they tell little of others.",
            ],
        ),
        ([(64, 8, 5)], ["Of 64 episodes 8 are distinct, the rest copies: the intervals count each once."]),
        ([(3, 3, 3)], ["3 episodes: too few for an interval, which takes 5."]),
        ([(99, 99, 4)], ["The intervals rest on 4 maps: they tell little of others."]),
    ],
)
def test_what_figures_rest_on_is_said_where_it_is_little(rows, wanted):
    assert describe_evidence([Evidence(f"p{k}", *row) for k, row in enumerate(rows)]) == wanted


def test_a_team_that_sees_the_map_from_the_start_is_told(capsys):
    env = ExplorationEnv(make_map("maze_small", 0), num_envs=2, num_robots=50, macro_steps=2)
    result = evaluate_recorded(POLICIES["random"](env), env, 2)
    print_results([result], "maze")
    told = "In 2 of 2 episodes 50 robots saw 95 % of the map from the start"
    assert told in capsys.readouterr().out
    print_results([replace(result, coverage=0.9 * result.coverage)], "maze")
    assert "from the start" not in capsys.readouterr().out


def test_eight_copies_are_not_ahead(tmp_path, monkeypatch, capsys):
    """All episodes from one start: policies that draw nothing play one and the same eight times."""
    monkeypatch.chdir(tmp_path)
    words = [
        "policy=cost_utility,universal,random",
        "scenario.held_out=[70]",
        "scenario.macro_steps=2",
        "num_envs=4",
        "scenario.local_steps=5",
        "num_robots=2",
        "episodes=8",
        "device=cpu",
        "num_threads=1",
    ]
    assert main(["evaluate", *words, "scenario.starts=fixed", "hydra.run.dir=run"]) == 0
    out = capsys.readouterr().out
    assert "Of 8 episodes of cost_utility, universal 1 is distinct" in out and "ahead" not in out
    assert "universal has played too few distinct episodes to be compared with cost_utility" in out
    assert "[+" not in out and "[-" not in out
    found = json.loads((tmp_path / "run/results.json").read_text())
    assert found["universal"]["coverage_auc"]["ci95"] == [None, None] == found["cost_utility"]["path_length"]["ci95"]
    assert found["difference"]["universal"]["cost_utility"]["coverage_auc"]["ci95"] == [None, None]
    distinct = found["run"]["distinct_episodes"]
    assert distinct | {"random": 0} == {"cost_utility": 1, "universal": 1, "random": 0} and distinct["random"] > 4


def result(policy: str, coverage: list, steps: list, learned: bool = False, **others) -> EvaluationResult:
    """Three episodes on map a and two on b, a little apart."""
    values = {"coverage_auc": coverage, "coverage_step_95_censored": steps}
    episodes = {name: np.repeat(pair, (3, 2)) + 0.01 * np.arange(5) for name, pair in values.items()}
    maps = np.repeat(["a", "b"], (3, 2))
    return EvaluationResult(policy, others.pop("num_robots", 3), episodes, 1.0, maps, learned, **others)


def test_differences_are_those_of_the_same_episodes():
    """Episodes differ far more than policies do, and the difference is certain all the same."""
    teams = [result("trained", [0.9, 0.3], [100.0, 200.0], True), result("voronoi", [0.8, 0.2], [150.0, 250.0])]
    found = paired_differences(teams)
    assert list(found) == ["trained"] and list(found["trained"]) == ["voronoi"]
    assert found["trained"]["voronoi"]["coverage_auc"]["ci95"] == [pytest.approx(0.1)] * 2
    assert found["trained"]["voronoi"]["coverage_step_95_censored"]["mean"] == -50
    text = describe_differences(teams, {3: "voronoi"})
    assert text == [
        "The trained team is ahead of voronoi, the best classical planner on the validation maps: "
        "+10.0 points of coverage over time [+10.0, +10.0], -50 steps to 95 % [-50, -50]."
    ]
    assert describe_differences(teams, {}) == [] and paired_differences(teams[1:]) == {}
    tied = [result("trained", [0.9, 0.05], [100.0, 300.0], True), teams[1]]
    assert "The trained team cannot be told from voronoi" in describe_differences(tied, {3: "voronoi"})[0]


def test_what_the_training_was_worth_is_a_sentence():
    teams = [result("trained", [0.9, 0.3], [100.0, 200.0], True), result("untrained", [0.6, 0.2], [150.0, 250.0])]
    assert describe_training(teams) == [
        "The trained team is ahead of the untrained team: +22.0 points of coverage over time [+10.0, +30.0], "
        "-50 steps to 95 % [-50, -50]."
    ]
    same = replace(teams[0], policy="warm_start")
    assert "cannot be told from the warm start" in describe_training([teams[0], same])[0]
    assert describe_training([teams[0], replace(teams[1], num_robots=2)]) == describe_training(teams[:1]) == []


def test_the_typical_episode_is_the_closest_to_the_mean():
    trained, planner = result("trained", [0.5, 0.5], [1.0, 1.0]), result("voronoi", [0.5, 0.5], [1.0, 1.0])
    trained.episodes["coverage_auc"] = planner.episodes["coverage_auc"] + np.array([0.4, 0.0, 0.1, 0.3, 0.2])
    assert find_typical(trained, planner, 5) == (4, pytest.approx(0.2), pytest.approx(0.2))
    assert find_typical(trained, planner, 3) == (2, pytest.approx(0.1), pytest.approx(0.2))
    assert find_typical(planner, None, 5)[0] == 2


def test_differences_pair_what_was_played_in_the_same_place_by_as_many():
    teams = [
        result(policy, [0.5, 0.5], [1.0, 1.0], policy == "trained", num_robots=size, place=place)
        for size in (1, 2)
        for place in ("", "floor")
        for policy in ("trained", "random")
    ]
    found = paired_differences(teams)
    assert {name: list(others) for name, others in found.items()} == {
        "trained N=1": ["random N=1"],
        "trained on floor N=1": ["random on floor N=1"],
        "trained N=2": ["random N=2"],
        "trained on floor N=2": ["random on floor N=2"],
    }


def test_paths_of_several_maps():
    assert split_paths("a.yaml") == ["a.yaml"]
    assert split_paths("[a.yaml, b c.pcd]") == split_paths("a.yaml,b c.pcd,") == ["a.yaml", "b c.pcd"]


def test_maps_of_several_scenarios_are_not_played_in_one_run(tmp_path):
    make_map("maze_small", 70).save(tmp_path / "a.npz")
    make_map("indoor_small", 70).save(tmp_path / "b.npz")
    words = [f"scenario.path={tmp_path}/a.npz,{tmp_path}/b.npz", *POINTCLOUD]
    cfg = compose_settings("evaluate", make_overrides("evaluate", words))
    with pytest.raises(UserError, match="scenarios indoor_small and maze_small, .* a run of their own"):
        import_files(cfg.scenario)


def test_a_comma_in_a_files_name_and_two_maps_of_one_name(tmp_path):
    (tmp_path / "far").mkdir()
    for path in ("a,b.npz", "a.npz", "far/a.npz"):
        make_map("maze_small", 70).save(tmp_path / path)
    comma = compose_settings("evaluate", make_overrides("evaluate", [f"scenario.path={tmp_path}/a,b.npz", *POINTCLOUD]))
    assert [m.name for m in import_files(comma.scenario)] == ["maze_small_70"]
    words = [f"scenario.path={tmp_path}/a.npz,{tmp_path}/far/a.npz", *POINTCLOUD]
    namesakes = compose_settings("evaluate", make_overrides("evaluate", words))
    with pytest.raises(UserError, match="two maps called"):
        import_files(namesakes.scenario)
