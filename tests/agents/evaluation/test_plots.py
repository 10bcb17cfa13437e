"""Plots: what they show for given numbers, missing columns and broken files; the recorder behind them."""

import json

import numpy as np
import pytest
from PIL import Image

from maexp.agents.cli.evaluate import draw_results
from maexp.agents.evaluation import learning_curves, plots
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.learning_curves import draw_curves
from maexp.agents.evaluation.plots import draw_contributions, draw_coverage, draw_summary


@pytest.fixture
def figures(monkeypatch) -> list:
    """The figures drawn, kept to look into; they are written all the same."""
    kept, save = [], plots.save
    for module in (learning_curves, plots):
        monkeypatch.setattr(module, "save", lambda figure, path: kept.append(figure) or save(figure, path))
    return kept


def panels(figure) -> dict:
    return {ax.get_title(loc="left"): ax for ax in figure.axes if ax.axison}


def write_csv(folder, columns: dict, name="metrics.csv"):
    folder.mkdir(parents=True, exist_ok=True)
    rows = zip(*columns.values(), strict=True)
    (folder / name).write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return folder / name


def readable(path) -> bool:
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("L"))
    return image.width > 300 and pixels.std() > 5


def test_curves_show_the_known_columns_with_units(tmp_path, figures):
    steps = np.arange(1, 101)
    columns = {
        "iteration": steps,
        "frames": 480 * steps,
        "coverage": steps / 200,
        "loss_critic": 1 / steps,
        "odd": steps,
    }
    path = draw_curves(write_csv(tmp_path, columns), tmp_path / "curves.png")
    assert readable(path)
    shown = panels(figures[0])
    assert set(shown) == {"Coverage at the end of an episode", "Critic loss"}
    coverage = shown["Coverage at the end of an episode"]
    assert coverage.get_ylabel() == "%" and coverage.get_xlabel() == "macro steps of teams"
    smooth, raw = coverage.lines
    np.testing.assert_allclose(raw.get_xdata(), 480 * steps)
    np.testing.assert_allclose(raw.get_ydata(), steps / 2)
    np.testing.assert_allclose(smooth.get_ydata()[5:-5], steps[5:-5] / 2)


def test_smoothing_is_a_mean():
    values = np.random.default_rng(0).normal(size=200)
    smooth = learning_curves._smooth(values)
    assert smooth.shape == values.shape
    assert smooth[100] == pytest.approx(values[95:106].mean())
    assert smooth[0] == pytest.approx(values[:6].mean())


def test_columns_without_values_are_left_out_and_gaps_bridged(tmp_path, figures):
    gaps = ["nan", "0.5", "", "0.7", "nan", "0.9"]
    columns = {"frames": range(6), "coverage": gaps, "validation_coverage": ["nan"] * 6, "entropy": [""] * 6}
    draw_curves(write_csv(tmp_path, columns), tmp_path / "curves.png")
    (ax,) = panels(figures[0]).values()
    assert [line.get_label() for line in ax.lines] == ["training"]
    np.testing.assert_allclose(ax.lines[0].get_xdata(), [1, 3, 5])
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [50, 70, 90])


def test_a_torn_last_line_is_left_out(tmp_path, figures):
    path = write_csv(tmp_path, {"frames": [1, 2, 3], "coverage": [0.1, 0.2, 0.3], "entropy": [5, 5, 5]})
    path.write_text(path.read_text() + "4,0.9")
    draw_curves(path, tmp_path / "curves.png")
    np.testing.assert_allclose(figures[0].axes[0].lines[0].get_xdata(), [1, 2, 3])


def test_seeds_become_mean_and_band(tmp_path, figures):
    runs = []
    for seed, level in enumerate((0.2, 0.4, 0.6)):
        columns = {"frames": np.arange(50 + seed) * 10, "coverage": np.full(50 + seed, level)}
        runs.append(write_csv(tmp_path / str(seed), columns).parent)
    draw_curves(runs, tmp_path / "curves.png")
    ax = figures[0].axes[0]
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 40)
    assert ax.lines[0].get_xdata()[-1] == 490, "to where all seeds have values"
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    spread = 100 * np.std([0.2, 0.4, 0.6])
    assert band.min() == pytest.approx(40 - spread) and band.max() == pytest.approx(40 + spread)


def test_settings_are_compared_in_colours_and_styles(tmp_path, figures):
    rows = [{"frames": k, "reward_explore": 0.1 * k, "reward_time": -0.1} for k in range(20)]
    draw_curves({"mappo": rows, "ippo": rows[:15]}, tmp_path / "curves.png")
    (ax,) = panels(figures[0]).values()
    assert ax.get_title(loc="left") == "Reward by term: explore"
    labelled = [line for line in ax.lines if not line.get_label().startswith("_")]
    assert [line.get_label() for line in labelled] == ["mappo", "ippo"]
    assert labelled[0].get_color() != labelled[1].get_color()
    assert labelled[0].get_linestyle() != labelled[1].get_linestyle()


def test_gains_have_a_band_and_the_planner_is_zero(tmp_path, figures):
    rows = [
        {
            "frames": 10 * k,
            "validation_gain": k - 2,
            "validation_gain_low": k - 3,
            "validation_gain_high": k,
            "reward": 0.5,
            "validation_steps_95": 0.0,
            "coverage": 0.95 + 0.001 * k,
        }
        for k in range(9)
    ]
    rows.insert(5, {"frames": 45, "reward": 0.5})
    coverage = np.array([[0.1, 0.9], [0.2, 0.8]])
    ends = {"trained": ([0.0, 1.0], coverage), "voronoi": ([0.0, 1.0], coverage[:1])}
    draw_curves(rows, tmp_path / "curves.png", rival="voronoi", ends=ends)
    shown = panels(figures[0])
    assert list(shown) == ["Gain in coverage over time", "Coverage over time, held-out episodes"], "the rest is flat"
    gain, after = shown.values()
    line, zero = gain.lines
    np.testing.assert_allclose(line.get_xydata(), [[10 * k, k - 2] for k in range(9)])
    assert list(zero.get_ydata()) == [0, 0] and [text.get_text() for text in gain.texts] == ["voronoi"]
    band = {tuple(point) for point in gain.collections[0].get_paths()[0].vertices}
    assert {(10.0 * k, k - 3.0) for k in range(9)} | {(10.0 * k, float(k)) for k in range(9)} <= band
    assert [line.get_label() for line in after.lines][:2] == ["trained (n = 2)", "voronoi (n = 1)"]


@pytest.mark.parametrize("count", [1, 2])
def test_a_run_of_few_iterations_can_be_seen(tmp_path, figures, count):
    draw_curves([{"frames": k, "coverage": 0.5} for k in range(count)], tmp_path / "curves.png")
    assert figures[0].axes[0].lines[0].get_marker() == "o"


def test_unusable_logs_are_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere.csv does not exist"):
        draw_curves(tmp_path / "nowhere.csv", tmp_path / "a.png")
    with pytest.raises(ValueError, match="no rows"):
        draw_curves(write_csv(tmp_path, {"frames": [], "coverage": []}), tmp_path / "a.png")
    with pytest.raises(ValueError, match="odd"):
        draw_curves([{"odd": 1.0}], tmp_path / "a.png")
    with pytest.raises(ValueError, match="runs is empty"):
        draw_curves({}, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


def test_coverage_over_time(tmp_path, figures):
    seconds = np.linspace(0, 10, 21)
    levels = np.linspace(0.7, 0.9, 101)
    coverage = np.stack([np.linspace(0, level, 21) for level in levels])
    curves = {"a": (seconds, coverage), "b": (seconds, coverage[:4]), "c": (seconds, np.repeat(coverage[:1], 9, 0))}
    assert readable(draw_coverage(curves, tmp_path / "a.png"))
    ax = figures[0].axes[0]
    assert ax.get_xlabel() == "time [s]" and ax.get_ylabel() == "coverage [%]"
    assert ax.lines[0].get_label() == "a (n = 101)"
    assert ax.lines[0].get_ydata()[-1] == pytest.approx(80)
    (band,) = ax.collections  # four episodes have none, and no more have nine copies of one
    wide = 1.96 * 100 * levels.std() / np.sqrt(len(levels))
    assert band.get_paths()[0].vertices[:, 1].max() - 80 == pytest.approx(wide, rel=0.1)
    with pytest.raises(ValueError, match="'a'.*21"):
        draw_coverage({"a": (seconds, coverage[:, :5])}, tmp_path / "b.png")
    with pytest.raises(ValueError, match="curves is empty"):
        draw_coverage({}, tmp_path / "b.png")


def metric(mean, low=None, high=None, n=8) -> dict:
    return {"mean": mean, "std": 0.1, "ci95": [low, high], "n": n}


def test_summary_has_bars_with_intervals(tmp_path, figures):
    summary = {
        "trained": {"exploration_ratio": metric(0.9, 0.85, 0.93), "coverage_step_95": metric(120.0, 100.0, 140.0, 3)},
        "random": {"exploration_ratio": metric(0.6, 0.5, 0.7), "coverage_step_95": metric(None, n=0)},
        "run": {"scenario": "maze"},
    }
    path = tmp_path / "summary.json"
    path.write_text(json.dumps(summary))
    assert readable(draw_summary(path, tmp_path / "a.png"))
    shown = panels(figures[0])
    assert set(shown) == {"Coverage at the end", "Time to 95 % coverage"}
    coverage = shown["Coverage at the end"]
    assert [label.get_text() for label in coverage.get_yticklabels()] == ["trained", "random"]
    assert [bar.get_width() for bar in coverage.patches] == pytest.approx([90, 60])
    ends = [segment[:, 0].tolist() for line in coverage.collections for segment in line.get_segments()]
    np.testing.assert_allclose(ends, [[85, 93], [50, 70]])
    texts = [text.get_text().strip() for text in shown["Time to 95 % coverage"].texts]
    assert texts == ["120 (3 of 8)", "never reached (0 of 8)"]
    assert len(shown["Time to 95 % coverage"].patches) == 1


@pytest.mark.parametrize("goal", [0.95, 0.99])
def test_evaluations_show_no_mark_beyond_the_end_of_their_episodes(goal, tmp_path, figures):
    values = {"exploration_ratio": np.full(3, 0.95), "coverage_step_99_censored": np.full(3, 300.0)}
    result = EvaluationResult("random", 3, values, 1.0, np.array([*"abc"]), success_coverage=goal)
    result.times, result.coverage = np.arange(4.0), np.tile(np.linspace(0.0, 0.95, 4), (3, 1))
    result.shares = np.ones((3, 3)) / 3
    draw_results([result], tmp_path)
    assert ("Time to 99 % or the limit" in panels(figures[1])) == (goal == 0.99)


def test_a_summary_without_metrics_is_refused(tmp_path):
    with pytest.raises(ValueError, match="run"):
        draw_summary({"run": {"scenario": "maze"}}, tmp_path / "a.png")


def test_contributions_are_ranked_within_episodes(tmp_path, figures):
    shares = np.array([[0.2, 0.5, 0.3], [0.6, 0.38, 0.02], [0, 0, 0]])  # nothing new was found in the third
    assert readable(draw_contributions({"trained": shares, "random": shares[1:2, :2]}, tmp_path / "a.png"))
    ax = figures[0].axes[0]
    bars = [(bar.get_x(), bar.get_width()) for bar in ax.patches]
    np.testing.assert_allclose(bars, [(0, 55), (55, 34), (89, 11), (0, 61.2245), (61.2245, 38.7755)], rtol=1e-4)
    assert [text.get_text() for text in ax.texts] == ["55", "34", "11", "61", "39"]
    np.testing.assert_allclose([line.get_xdata() for line in ax.lines[:1]], [[100 / 3, 200 / 3]])
    assert ax.lines[1].get_xdata().tolist() == [50]
    with pytest.raises(ValueError, match="contributions is empty"):
        draw_contributions({}, tmp_path / "a.png")


@pytest.fixture(scope="module")
def recorded():
    """Two batches of three episodes, the second one cut to one, and what the env itself reports of them."""
    from maexp.agents.evaluation.evaluate import evaluate
    from maexp.envs import ExplorationEnv, make_map
    from maexp.envs.recorder import CoverageRecorder

    maps = [make_map("maze_small", 0), make_map("maze_small", 1)]
    env = ExplorationEnv(maps, num_envs=3, num_robots=2, macro_steps=3, local_steps=7, success_coverage=0.45)
    with CoverageRecorder(env, every=3) as recorder:
        result = evaluate(env.rand_action, env, 4)
    env.reset()  # not recorded any more
    return recorder, result


def test_recorder_ends_where_the_episodes_end(recorded):
    recorder, result = recorded
    seconds, coverage = recorder.curves(4)
    assert coverage.shape == (4, len(seconds)) and seconds[0] == 0
    assert seconds[-1] <= 2.1 + 1e-9
    assert (np.diff(seconds) > 0).all() and (np.diff(coverage, axis=1) >= 0).all()
    assert (coverage[:, 0] > 0).all(), "the scan at reset counts"
    np.testing.assert_allclose(coverage[:, -1], result.episodes["exploration_ratio"], atol=1e-6)
    assert recorder.curves()[1].shape[0] == 6


def test_contributions_are_shares(recorded):
    shares = recorded[0].contributions(4)
    assert shares.shape == (4, 2) and (shares >= 0).all()
    sums = shares.sum(axis=1)
    assert (np.isclose(sums, 1) | (sums == 0)).all() and np.isclose(sums, 1).any()


def test_recorder_without_records_says_so():
    from maexp.envs.recorder import CoverageRecorder

    class Env:
        def set_step_hook(self, hook, every=1):
            self.hook = hook

    env = Env()
    with CoverageRecorder(env) as recorder:
        assert env.hook is not None
    assert env.hook is None
    with pytest.raises(ValueError, match="nothing was recorded"):
        recorder.curves()
