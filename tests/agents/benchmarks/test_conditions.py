"""`python -m maexp.agents.benchmarks.conditions`: a table of conditions that goes on where it was stopped."""

import shutil

import numpy as np
import pytest

from maexp.agents import cli
from maexp.agents.benchmarks import conditions
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.resolved import resolve
from maexp.agents.evaluation.baseline import load_baseline
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.envs import make_map

WORDS = [
    "scenarios=[maze_small]",
    "teams=[2]",
    "policies=[cost_utility]",
    "episodes=2",
    "num_envs=2",
    "conditions=[base_return]",
]


@pytest.mark.parametrize("words", conditions.CONDITIONS.values(), ids=list(conditions.CONDITIONS))
def test_conditions_are_settings(words):
    resolve(compose_settings("evaluate", ["policy=cost_utility", *words]))


def test_the_table_is_made_once_and_goes_on(tmp_path, capsys, monkeypatch):
    words = [f"out={tmp_path}/it", *WORDS]
    assert conditions.main(words) == 0
    text = (tmp_path / "it" / "conditions.md").read_text()
    rows = [line.split(" | ") for line in text.splitlines() if "`cost_utility`" in line]
    assert [row[0] for row in rows] == ["| perfect", "| base_return"]
    heads = next(line for line in text.splitlines() if line.startswith("| condition")).split(" | ")
    base = heads.index("base over time [%]")
    assert rows[0][base] == "" and 5.0 < float(rows[1][base]) < float(rows[1][heads.index("over time [%]")])
    assert heads[2] == "over time, minus perfect [points]" and "minus" not in heads[3], "one policy, no `base`"
    assert rows[0][2] == "" and rows[1][2].startswith(("+", "-"))
    played = []
    monkeypatch.setattr(cli, "main", lambda argv: played.append(argv) or 0)
    shutil.rmtree(tmp_path / "it" / "maze_small" / "robots_2" / "base_return")
    assert conditions.main(words) == 0
    assert len(played) == 1 and "comm.strategy=return_to_base" in played[0], "only what was not there"
    monkeypatch.setattr(cli, "main", lambda argv: 130)
    assert conditions.main(words) == 2
    assert "stopped at base_return, cost_utility. The same command goes on there" in capsys.readouterr().err
    assert conditions.main([*words, "episodes=4"]) == 2
    assert "was played with episodes=2, not 4: take another folder" in capsys.readouterr().err


def test_differences_are_paired_and_to_what_the_head_says():
    """Against what NumPy makes of the same episodes."""
    rng = np.random.default_rng(0)
    maps = np.repeat(["a", "b", "c", "d", "e", "f"], 2)

    def episodes(base: bool) -> EvaluationResult:
        names = ("coverage_auc", "base_coverage_auc") if base else ("coverage_auc",)
        return EvaluationResult("", 3, {name: rng.random(12) for name in names}, 1.0, maps)

    found = {
        condition: {policy: episodes(condition != "perfect") for policy in ("x", "y")}
        for condition in ("perfect", "base", "base_return")
    }
    lines = conditions.table("here", found).splitlines()
    heads = lines[2].strip("| ").split(" | ")
    assert heads[2:6] == [
        "over time, minus perfect [points]",
        "base over time, minus base [points]",
        "over time, minus `x` [points]",
        "base over time, minus `x` [points]",
    ]
    cells = {tuple(row[:2]): row[2:6] for row in (line[2:-2].split(" | ") for line in lines[4:])}

    def apart(metric, condition, policy):
        mine, other = found["base_return"]["y"], found[condition][policy]
        return f"{100 * (mine.episodes[metric] - other.episodes[metric]).mean():+.1f}"

    mine = cells["base_return", "`y`"]
    others = (("perfect", "y"), ("base", "y"), ("base_return", "x"), ("base_return", "x"))
    for cell, metric, other in zip(mine, ("coverage_auc", "base_coverage_auc") * 2, others, strict=True):
        assert cell.split(" ")[0] == apart(metric, *other)
    assert cells["perfect", "`x`"] == [""] * 4 and cells["base", "`x`"][1:] == [""] * 3


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("conditions=[fog]", "conditions=fog is unknown: choose among perfect, range"),
        ("episodes=0", "conditions.episodes=0 must be a whole number"),
        ("policies=[]", "policies=[] is empty"),
        ("own.maze=x.yaml", "own.maze cannot be a scenario's name"),
        ("own.floors=gone.yaml", "own.floors names gone.yaml, and there is no such file"),
        ("weather=fog", "weather"),
        ("words.x='comm.range=9'", "words.x is of no policy that is played: policies=cost_utility,hungarian,universal"),
        ("words.universal=fast", "words.universal: fast is no word of `maexp evaluate`"),
        ("words.universal=a='b", "No closing quotation"),
        ("words.universal=[a=1]", "is no word of `maexp evaluate`: write words.universal='a.b=1 c.d=2'"),
        ("words.universal='a=1 num_robots=7'", "num_robots=7 would play other episodes than the table says"),
        ("policies=[a/one,b/one]", "policies=one,one has two called one: their folders would be one"),
    ],
)
def test_bad_words_are_named(word, told, tmp_path, capsys):
    assert conditions.main([f"out={tmp_path}/it", word]) == 2
    assert told in capsys.readouterr().err


def test_lists_may_be_given_without_brackets():
    words = ["scenarios=maze_small,maze", "teams=2", "policies=cost_utility,some/run", "conditions=base"]
    config = conditions.read_config(words)
    assert (config.scenarios, config.teams) == (["maze_small", "maze"], [2])
    assert (config.policies, config.conditions) == (["cost_utility", "some/run"], ["perfect", "base"])
    assert conditions.read_config(["teams=3,5"]).teams == [3, 5]


def test_maps_of_ones_own_share_the_episodes(tmp_path):
    for index in (0, 1):
        make_map("maze_small", index).save(tmp_path / f"m{index}.npz")
    own = f"own.mine={tmp_path}/m0.npz,{tmp_path}/m1.npz"
    words = [f"out={tmp_path}/it", "scenarios=[]", own, "teams=[2]", "policies=[random]", "conditions=[perfect]"]
    assert conditions.main([*words, "episodes=3", "num_envs=2"]) == 0
    found = load_baseline(str(tmp_path / "it" / "mine" / "robots_2" / "perfect" / "random")).results["random", 2]
    assert sorted(found.maps) == ["maze_small_0"] * 2 + ["maze_small_1"] * 2, "half of three, rounded up"
    assert "**mine, 2 robots**" in (tmp_path / "it" / "conditions.md").read_text()


def test_a_policy_has_words_of_its_own_and_the_condition_overrides_them(tmp_path, monkeypatch, capsys):
    played = []
    monkeypatch.setattr(cli, "main", lambda argv: played.append(argv) or 0)
    words = [f"out={tmp_path}/it", *WORDS, "policies=[some/searching,cost_utility]", "conditions=[range]"]
    own = "words.searching=comm.range=90 lookahead.horizon=2"
    assert conditions.main([*words, own]) == 0
    search, plain = played[2:]
    assert search.index("comm.range=90") < search.index("comm.range=8"), "the last one counts"
    assert "lookahead.horizon=2" in search and "lookahead.horizon=2" not in plain
    assert conditions.main([*words, own.replace("2", "3")]) == 0, "as long as nothing is played"
    assert conditions.main([*words, own]) == 0
    (tmp_path / "it" / "maze_small" / "robots_2" / "range" / "searching").mkdir(parents=True)
    assert conditions.main([*words, own.replace("90", "80")]) == 2
    told = "was played with words.searching=comm.range=90 lookahead.horizon=2, not comm.range=80 lookahead.horizon=2"
    assert told in capsys.readouterr().err
    assert conditions.main([*words, "policies=[cost_utility,random]"]) == 0, "more policies may join"
    assert conditions.main(words) == 2, "with none they are others, too"
