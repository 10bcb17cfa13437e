"""A benchmark that trains one policy on all scenarios at once: one training a seed, played in every scenario."""

import json
import shutil

import pytest
import torch
from tiny_benchmark import settings

from maexp.agents.benchmarks.cell import EnvShelf, finished, run_cell
from maexp.agents.benchmarks.plan import Cell, cell_overrides, list_cells, training_cell
from maexp.agents.cli import main
from maexp.agents.training.checkpoint import find_checkpoint

pytestmark = pytest.mark.slow  # trainings

WORDS = [
    "preset=smoke",
    "scenarios=maze_small,random_obstacles",
    "policies=cost_utility",
    "algorithms=mappo",
    "seeds=0",
    "episodes=2",
    "num_envs=4",
    "num_robots=2",
    "scenario.local_steps=3",
    "scenario.macro_steps=2",
    "total_frames=16",
    "estimate=false",
    "device=cpu",
    "observation.targets=4",
    "together=true",
    "workers=1",
    "iterations=null",
    "train_maps=null",
]


def test_cells_of_all_scenarios_share_one_training():
    cfg = settings(*WORDS)
    trained = [cell for cell in list_cells(cfg) if cell.trains]
    assert [cell.scenario for cell in trained] == ["maze_small", "random_obstacles"]
    assert {training_cell(cfg, cell) for cell in trained} == {Cell("together", "mappo", 0)}
    words = cell_overrides(cfg, Cell("together", "mappo", 0))
    assert "scenario=maze_small" in words and "scenario.also=['random_obstacles']" in words
    assert not any(word.startswith("scenario.also") for word in cell_overrides(cfg, trained[0]))
    apart = settings(*[word for word in WORDS if word != "together=true"])
    assert [training_cell(apart, cell) for cell in trained] == trained


def test_it_trains_once_and_plays_everywhere(tmp_path, capsys):
    folder = tmp_path / "bench"
    assert main(["benchmark", *WORDS, f"hydra.run.dir={folder}"]) == 0
    runs = sorted(path.parent.relative_to(folder / "cells") for path in folder.glob("cells/**/checkpoints"))
    assert [str(run) for run in runs] == ["together/mappo/seed_0"]
    summary = json.loads((folder / "summary.json").read_text())
    for scenario in ("maze_small", "random_obstacles"):
        assert summary[scenario]["mappo"]["coverage_auc"]["n"] == 2
        assert "cost_utility" in summary[scenario]["difference"]["mappo"]
    assert "on all scenarios at once" in (folder / "table.md").read_text()
    whole = json.loads((folder / "cells/maze_small/mappo/seed_0/held_out.json").read_text())["run"]["training_seconds"]
    assert summary["run"]["training_seconds"] == pytest.approx(whole, abs=0.02), "counted once"
    before = find_checkpoint(folder / "cells/together/mappo/seed_0")[1]
    cell = Cell("random_obstacles", "mappo", 0)
    played = (folder / "cells" / cell.name / "held_out.npz").read_bytes()
    shutil.rmtree(folder / "cells" / cell.name)
    assert run_cell(settings(*WORDS), folder, cell, EnvShelf(), ["held_out"]) and finished(folder, cell, "held_out")
    assert (folder / "cells" / cell.name / "held_out.npz").read_bytes() == played, "with the same policy"
    after = find_checkpoint(folder / "cells/together/mappo/seed_0")[1]
    assert all(torch.equal(after["policy"][name], tensor) for name, tensor in before["policy"].items()), (
        "not trained again"
    )


@pytest.mark.parametrize(
    "words",
    ["policy_per_map={maze_small:1,random_obstacles:1}", "iterations=2", "train_maps=3"],
)
def test_what_does_not_go_together_is_named(words, capsys, tmp_path):
    assert main(["benchmark", *WORDS, words, f"hydra.run.dir={tmp_path / 'bench'}"]) == 2
    said = capsys.readouterr().err
    assert words.partition("=")[0] in said and "together=true" in said
