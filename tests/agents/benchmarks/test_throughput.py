"""`maexp bench`: what it measures, what it compares, how it refuses."""

import json
from pathlib import Path

import pytest
import torch

from maexp.agents.benchmarks.throughput import kernels
from maexp.agents.benchmarks.throughput.scale import large_maze
from maexp.agents.benchmarks.throughput.shared import spread, sweep_points
from maexp.agents.cli import main
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides, move_sweeps
from maexp.envs import ExplorationEnv, make_map

pytestmark = pytest.mark.slow  # measurements of speed

TINY = ["scenario=maze_small", "scenario.maps=[0]", "num_envs=2", "seconds=0.02"]


@pytest.fixture(autouse=True)
def somewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(kernels, "COPY_BYTES", 2**20)
    monkeypatch.setattr(kernels, "MATRIX", 64)


def report(folder: str, name: str) -> dict:
    return json.loads(Path(folder, name).read_text())


def test_settings_with_several_values_become_every_combination():
    words = make_overrides("bench", ["env", "num_envs=2,4", "scenario=maze,maze_small", "num_robots=3,5"], ("task",))
    prepared = move_sweeps(words)
    cfg = compose_settings("bench", prepared)
    points = sweep_points(cfg, prepared, [2])
    found = [(point.num_envs, point.scenario.name, point.num_robots) for point in points]
    assert found == [(e, s, n) for e in (2, 4) for s in ("maze", "maze_small") for n in (3, 5)]


def test_spread_is_median_and_tenths():
    assert spread([float(k) for k in range(11)]) == {"median": 5.0, "p10": 1.0, "p90": 9.0}
    assert spread([3.0]) == {"median": 3.0, "p10": 3.0, "p90": 3.0}


def test_env_measures_every_point(capsys):
    assert main(["bench", "env", *TINY, "num_robots=1,2", "radar.range=4,8", "hydra.run.dir=out"]) == 0
    rows = report("out", "bench_env.json")["rows"]
    points = [(row["radar_range"], row["planner"], row["num_robots"]) for row in rows]
    assert points == [(r, p, n) for r in (4, 8) for p in ("wavefront", "dwa") for n in (1, 2)]
    assert all(row["robot_local_steps_per_second"] > 0 and row["memory_per_env"] > 0 for row in rows)
    text = capsys.readouterr().out
    assert "robot-local-steps/s" in text and "bench_env.json" in text


def test_env_measures_the_planner_that_is_asked_for(capsys):
    assert main(["bench", "env", *TINY, "num_robots=2,3", "planner=dwa", "hydra.run.dir=out"]) == 0
    assert [row["planner"] for row in report("out", "bench_env.json")["rows"]] == ["dwa", "dwa"]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines if "this machine" in line] == [["this", "machine,", "dwa"]]


def test_kernels_are_timed_and_compared(capsys):
    words = ["bench", "kernels", *TINY, "num_robots=2", "planner=dwa"]
    assert main([*words, "hydra.run.dir=first"]) == 0
    first = report("first", "bench_kernels.json")
    names = {row["kernel"] for row in first["rows"] if row["stage"] == "local step"}
    assert {"plan_dwa", "scan_free", "merge_scan", "close_step"} <= names
    assert {row["stage"] for row in first["rows"]} == {"goal", "local step", "observe", "reset"}
    for row in first["rows"]:
        assert 0 < row["in_place_us"]["p10"] <= row["in_place_us"]["median"] <= row["in_place_us"]["p90"]
        assert row["alone_us"]["median"] > 0
    assert all(ceiling > 0 for ceiling in first["ceilings"].values())
    # an earlier run in which one kernel was ten times as fast, all beyond doubt
    for row in first["rows"]:
        factor = 0.1 if row["kernel"] == "scan_free" else 1.0
        row["in_place_us"] = {name: factor * value for name, value in row["in_place_us"].items()}
    Path("old run.json").write_text(json.dumps(first))
    capsys.readouterr()
    assert main([*words, "baseline=old run.json", "hydra.run.dir=second"]) == 0
    rows = [row for row in report("second", "bench_kernels.json")["rows"] if row["kernel"] == "scan_free"]
    assert all(row["changed"] and row["ratio"] > 2 for row in rows)
    assert "!" in capsys.readouterr().out


def test_training_is_split_into_its_parts_for_every_network(capsys):
    words = [*TINY, "collector.steps=2", "model=small,paper", "num_robots=2"]
    assert main(["bench", "train", *words, "hydra.run.dir=out"]) == 0
    small, paper = report("out", "bench_train.json")["rows"]
    assert (small["model"], paper["model"]) == ("small", "paper") and small["parameters"] < paper["parameters"]
    for row in (small, paper):
        median = {name: seconds["median"] for name, seconds in row["seconds"].items()}
        whole = median.pop("iteration")
        assert set(median) == {"simulate", "policy", "advantage", "update"} and min(median.values()) > 0
        assert sum(median.values()) == pytest.approx(whole, rel=0.3)
        assert row["macro_steps"] == 4 and row["iterations"] >= 3
        assert row["robot_macro_steps_per_second"] == pytest.approx(4 * 2 / whole)
    rates = [row["robot_macro_steps_per_second"] for row in (small, paper)]  # which is slower, a busy machine decides
    assert [row["times_the_slowest"] for row in (small, paper)] == pytest.approx([rate / min(rates) for rate in rates])
    assert "robot-steps/s" in capsys.readouterr().out


def test_scale_goes_along_its_axes(capsys):
    words = [*TINY, "scenario.macro_steps=2", "num_robots=1", "largest=8"]
    assert main(["bench", "scale", *words, "axes=envs,robots", "hydra.run.dir=out"]) == 0
    axes = report("out", "bench_scale.json")["axes"]
    assert [row["num_envs"] for row in axes["envs"]["rows"]] == [1, 8]
    assert [row["num_robots"] for row in axes["robots"]["rows"]] == [2, 4, 8]
    assert all(row["num_envs"] == 2 for row in axes["robots"]["rows"])  # what was set stays
    small, large = axes["envs"]["rows"]
    costs = [point["seconds_per_local_step"] for point in (small, large)]
    assert axes["envs"]["worst_over_linear"] == pytest.approx(costs[1] / costs[0] / 8)
    assert axes["envs"]["worst_from"] == 1 and axes["robots"]["worst_from"] in (2, 4)
    assert 0 < costs[0] * small["robot_local_steps_per_second"] < 4  # the rate counts waits, the cost does not
    assert Path("out/scale_envs.png").stat().st_size > 5000
    out = capsys.readouterr().out
    assert f"teams in the batch: 8.0 times the size costs {costs[1] / costs[0]:.1f} times as much; " in out


@pytest.mark.parametrize("words", [["axes=walls"], ["largest=0"], ["axes=map", "largest=1"], ["num_envs=2,4"]])
def test_scale_refuses_what_it_cannot_vary(words, capsys):
    assert main(["bench", "scale", *words, "hydra.run.dir=out"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("maexp: ") and err.count("\n") == 1 and not Path("out").exists()


def test_the_map_axis_makes_larger_mazes():
    small, large = large_maze(3), large_maze(6)
    assert large.extent == make_map("maze_small", 0).extent
    assert len(large.free) > 3.5 * len(small.free)


def test_a_change_is_beyond_the_noise_and_the_spread():
    key = dict.fromkeys(kernels.KEY, 0)

    def compared(median, low, high):
        row = key | {"in_place_us": {"median": median, "p10": low, "p90": high}}
        kernels.compare([row], {"by_key": {tuple(key.values()): {"median": 1.0, "p10": 0.9, "p90": 1.1}}})
        return row["changed"]

    assert compared(2.0, 1.9, 2.1) and compared(0.5, 0.4, 0.6)
    assert not compared(1.2, 1.15, 1.3)  # apart, but less than the noise
    assert not compared(2.0, 1.0, 3.0)  # far, but the spreads overlap


BAD = {
    "no file": (["baseline=no such.json"], "no such.json"),
    "another file": (["baseline=other.json"], "other.json"),
    "a moment": (["seconds=0"], "seconds=0"),
    "two times": (["seconds=1,2"], "seconds"),
    "no envs": (["num_envs=4,0"], "num_envs=0"),
    "no robots": (["num_robots=2,0"], "num_robots"),
    "an axis elsewhere": (["axes=envs"], "bench scale"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_a_sentence(case, capsys):
    words, expected = BAD[case]
    Path("other.json").write_text('{"rows": [1]}')
    assert main(["bench", "kernels", *TINY, *words, "hydra.run.dir=out"]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("maexp: ") and err.count("\n") == 1 and expected in err, err
    assert not Path("out").exists()


def test_timing_changes_nothing():
    """What is timed is put back: the same moment for every lap, in place and alone."""
    env = ExplorationEnv(make_map("maze_small", 0), num_envs=2, num_robots=3, num_threads=1)
    env.rollout(1)
    before = {name: value.clone() for name, value in env.simulation.tensors.items()}
    shard = env.simulation.shards[0]
    steps = kernels.record_steps(env, shard)
    run = kernels.Runner(env.device, None)
    run.in_place(steps, 0.01)
    run.alone(steps, 0.01)
    scratch = ("mask", "nearby")  # `record_steps` marks all envs; the planner's list is written before it is read
    for name, value in env.simulation.tensors.items():
        assert name in scratch or torch.equal(value, before[name]), name
