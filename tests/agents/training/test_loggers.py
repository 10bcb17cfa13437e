"""What TensorBoard and Weights & Biases show of a run."""

import io
import json
import sys
from pathlib import Path

import pytest
from PIL import Image

from maexp.agents.config.groups import LoggerSettings
from maexp.agents.evaluation.results import COLUMNS
from maexp.agents.training.logs import MetricsLog, log_results


class Diary:
    """What W&B is told by its public calls, where it is not installed."""

    Error = RuntimeError

    def __init__(self):
        self.told: list[tuple[dict, int]] = []

    def init(self, **settings):
        self.settings = settings
        return self

    def log(self, content: dict, step: int):
        self.told.append((content, step))

    def finish(self):
        self.told.append(({}, -1))

    def Settings(self, **kwargs):
        return kwargs

    def Table(self, columns, data):
        return ["table", columns, data]

    def Video(self, path, format):
        return ["film", Path(path).name, format]

    def Image(self, path):
        return ["picture", Path(path).name]


def test_what_came_of_a_run_goes_to_its_loggers(tmp_path, monkeypatch):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    diary = Diary()
    monkeypatch.setitem(sys.modules, "wandb", diary)
    whole = {name: {"mean": 0.5, "n": 4} for name in COLUMNS} | {"coverage_step_99": {"mean": None, "n": 0}}
    summary = {
        "trained": whole | {"coverage_auc": {"mean": 0.75, "n": 4}},
        "cost_utility": whole,
        "difference": {},
        "run": {"distinct_episodes": {"trained": 4, "cost_utility": 4}},
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    Image.new("RGB", (40, 30), "red").save(tmp_path / "coverage.png")
    frames = [Image.new("RGB", (20, 10), colour) for colour in ("red", "blue", "white")]
    frames[0].save(tmp_path / "rollout.gif", save_all=True, append_images=frames[1:])
    log_results(tmp_path, LoggerSettings(backends=["tensorboard", "wandb"]), 128, {"seed": 1})

    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    values = {name: [(e.step, e.value) for e in events.Scalars(name)] for name in events.Tags()["scalars"]}
    assert values["comparison/coverage_auc/trained"] == [(128, 0.75)]
    assert values["comparison/coverage_auc/cost_utility"] == [(128, 0.5)]
    assert not [name for name in values if "coverage_step_99/" in name], "nobody got there"
    assert events.Tags()["images"] == ["coverage", "rollout"]
    film = events.Images("rollout")[0]
    assert Image.open(io.BytesIO(film.encoded_image_string)).n_frames == 3 and (film.width, film.height) == (20, 10)
    text = events.Tensors("comparison/text_summary")[0].tensor_proto.string_val[0].decode()
    assert text.splitlines()[0].startswith("| policy | exploration_ratio |") and "| trained | 0.5 | 0.75 |" in text

    (content, step), (_, end) = diary.told
    assert (step, end) == (128, -1) and diary.settings["resume"] == "allow"
    assert content["comparison"][1][:3] == ["policy", "exploration_ratio", "coverage_auc"]
    assert [row[:3] for row in content["comparison"][2]] == [["trained", 0.5, 0.75], ["cost_utility", 0.5, 0.5]]
    assert content["coverage"] == ["picture", "coverage.png"] and content["rollout"] == ["film", "rollout.gif", "gif"]

    log = MetricsLog(tmp_path, LoggerSettings(backends=["wandb"]), 0, 0, {})
    log.write({"iteration": 1, "frames": 8, "reward_time": 2.0, "validation_gain": 0.1, "kl": 3.0, "coverage": 0.5})
    assert diary.told[-1] == (
        {
            "progress/iteration": 1,
            "progress/frames": 8,
            "reward/time": 2.0,
            "validation/gain": 0.1,
            "learning/kl": 3.0,
            "episodes/coverage": 0.5,
        },
        8,
    )
    log.close()


def test_a_run_without_results_opens_no_logger(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    log_results(tmp_path, LoggerSettings(backends=["wandb"]), 128, {})
    assert not list(tmp_path.iterdir())
