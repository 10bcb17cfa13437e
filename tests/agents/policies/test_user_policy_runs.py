"""One's own policies, runs and exported ones in the commands that take minutes: benchmark, warm start, view."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from small_suite import make_small_suite

from maexp.agents.benchmarks.suites.play import SuitePolicy
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.policies.registry import find_named_policy
from maexp.agents.training.checkpoint import load_checkpoint

pytestmark = pytest.mark.slow  # trainings

TINY = [
    "preset=smoke",
    "num_envs=2",
    "num_robots=2",
    "scenario.local_steps=5",
    "scenario.maps=[0]",
    "scenario=maze_small",
    "scenario.held_out=[70]",
    "device=cpu",
    "evaluate_every=0",
]
TEACHER = """
import torch

class First:
    def __init__(self, env):
        self.shape = (env.num_envs, env.num_robots)
    def __call__(self, td):
        td["agents", "action", "target"] = torch.zeros(self.shape, dtype=torch.int64)

def regions(env):
    from maexp.agents.policies import POLICIES
    return POLICIES["voronoi"](env)
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a module, a run on targets and a run on regions."""
    folder = tmp_path_factory.mktemp("own runs")
    (folder / "teachers.py").write_text(TEACHER)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, specs in (("aims", ["action=targets"]), ("regions", ["action=regions", "model.channels=4"])):
            specs = [*TINY, *specs, "total_frames=6", "episodes=0", f"hydra.run.dir={name}"]
            assert main(["train", *specs]) == 0
    return folder


@pytest.fixture(autouse=True)
def inside(place, monkeypatch):
    monkeypatch.chdir(place)


def test_runs_play_beside_what_ships_with_the_checks_of_checkpoint(capsys):
    specs = ["policy=aims,regions,universal", "episodes=2", "num_envs=2", "num_robots=2", "scenario.macro_steps=2"]
    assert main(["evaluate", *specs, "scenario.held_out=[70]", "device=cpu", "hydra.run.dir=beside"]) == 0
    found = json.loads(Path("beside/results.json").read_text())
    assert list(found)[:3] == ["aims", "regions", "universal"] and set(found["difference"]["aims"]) > {"universal"}
    alone = ["checkpoint=aims", "episodes=2", "scenario.macro_steps=2", "reward=default"]
    assert main(["evaluate", *alone, "scenario.local_steps=10", "hydra.run.dir=alone"]) == 0
    trained = json.loads(Path("alone/results.json").read_text())["trained"]
    assert trained["coverage_auc"] == found["aims"]["coverage_auc"]
    saved = find_named_policy("aims").saved
    assert load_checkpoint(Path("aims/checkpoints/iteration_000001.pt"))["maps"] == saved["maps"]
    saved["maps"] = dict.fromkeys(saved["maps"], "0" * 16)
    from maexp.envs import make_map

    with pytest.warns(UserWarning, match="maze_small_70 has changed"):
        find_named_policy("aims").__class__("aims", None, "checkpoint", saved=saved).check_maps(
            [make_map("maze_small", 70)]
        )


def test_a_benchmark_of_ones_own_goes_on_and_says_what_changed(capsys, place):
    specs = [
        *TINY[:4],
        "scenarios=maze_small",
        "algorithms=[]",
        "seeds=0",
        "episodes=2",
        "scenario.macro_steps=2",
        "test_maps=1",
        "workers=1",
        "estimate=false",
        "device=cpu",
    ]
    policies = "policies=[voronoi,universal,teachers:First,aims,./regions]"
    assert main(["benchmark", *specs, policies, "hydra.run.dir=table"]) == 0
    names = ["voronoi", "universal", "teachers.First", "aims", "regions"]
    summary = json.loads(Path("table/summary.json").read_text())
    assert [name for name in summary["maze_small"] if name != "difference"] == names
    assert set(summary["maze_small"]["difference"]) == set(names[1:])
    assert Path("table/table.md").read_text().count("teachers.First") >= 2
    cells = {path.parent.parent.name for path in Path("table/cells").glob("*/*/*/held_out.json")}
    assert cells == set(names)
    capsys.readouterr()
    assert main(["benchmark", "resume=table"]) == 0
    source = Path("teachers.py").read_text()
    Path("teachers.py").write_text(source + "# changed\n")
    assert main(["benchmark", "resume=table"]) == 2
    assert "policies: teachers.First has changed since its cells in " in capsys.readouterr().err
    Path("teachers.py").write_text(source)


@pytest.mark.parametrize(
    ("specs", "told"),
    [
        (["policies=nobody"], "policies=nobody is unknown: choose one of random"),
        (["policies=teachers:nobody"], "policies=teachers:nobody: teachers has no nobody"),
        (["policies=aims,aims"], "names aims twice"),
    ],
)
def test_a_benchmark_names_what_it_cannot_play(specs, told, capsys):
    assert main(["benchmark", "algorithms=[]", *specs]) == 2
    assert told in capsys.readouterr().err


def test_ones_own_policy_is_a_teacher_and_is_told_what_it_must_choose(capsys):
    specs = [*TINY, "total_frames=6", "episodes=0", "warm_start_frames=6"]
    assert main(["train", *specs, "warm_start=teachers:First", "hydra.run.dir=pupil"]) == 0
    assert Path("pupil/warm_start.csv").is_file()
    assert main(["train", *specs, "warm_start=teachers:regions", "hydra.run.dir=lost"]) == 2
    told = capsys.readouterr().err
    assert "warm_start=teachers:regions wrote region and offset, and the policy that is to imitate it chooses" in told
    for spec, sentence in (
        ("regions", "chooses regions, which a policy with action=targets"),
        ("nobody", "warm_start=nobody is unknown"),
    ):
        assert main(["train", *specs, f"warm_start={spec}", "hydra.run.dir=no"]) == 2
        assert sentence in capsys.readouterr().err


def test_a_team_of_ones_own_can_be_seen(capsys):
    specs = ["view", "policy=teachers:regions", "scenario=maze_small", "out=team.png", "renderer=painter"]
    assert main([*specs, "scenario.macro_steps=2", "num_robots=2", "hydra.run.dir=seen"]) == 0
    assert Path("team.png").is_file() and "teachers.regions" in capsys.readouterr().out
    assert Path("seen/episodes/teachers.regions_0.npz").is_file()


def test_what_stands_beside_a_training_may_be_ones_own(capsys):
    shutil.rmtree("beside_training", ignore_errors=True)
    specs = [*TINY, "total_frames=6", "episodes=2", "classical=[voronoi,universal,teachers:regions]"]
    assert main(["train", *specs, "hydra.run.dir=beside_training"]) == 0
    summary = json.loads(Path("beside_training/summary.json").read_text())
    assert list(summary)[:6] == ["trained", "untrained", "random", "voronoi", "universal", "teachers.regions"]
    assert summary["voronoi"] == summary["teachers.regions"]


PACKAGE = """
import numpy as np

class Stay:
    def act(self, observation):
        return np.full((len(observation["alive"]), 2), np.nan)

def voronoi(env):
    from maexp.agents.policies import POLICIES
    return POLICIES["voronoi"](env)
"""


def install(site: Path) -> None:
    """A package with two plug-ins, a class and a function of the env."""
    (site / "swarm-1.0.dist-info").mkdir(parents=True)
    (site / "swarm.py").write_text(PACKAGE)
    (site / "swarm-1.0.dist-info/METADATA").write_text("Name: swarm\nVersion: 1.0\n")
    points = "[maexp.policies]\nswarm_stay = swarm:Stay\nswarm_voronoi = swarm:voronoi\n"
    (site / "swarm-1.0.dist-info/entry_points.txt").write_text(points)


def test_a_suite_takes_what_policy_takes_elsewhere(tmp_path, monkeypatch, capsys):
    install(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    suite, found = make_small_suite(tmp_path / "small.yaml"), {}
    for spec in ("voronoi", "teachers:regions", "swarm_voronoi", "swarm_stay", "aims", "regions"):
        where = tmp_path / spec.replace(":", "_")
        assert main(["suite", "run", str(suite), f"policy={spec}", f"hydra.run.dir={where}"]) == 0
        assert main(["suite", "verify", str(where), f"suite={suite}"]) == 0, spec
        found[spec] = json.loads((where / "results.json").read_text())
    assert found["teachers:regions"]["episodes"] == found["swarm_voronoi"]["episodes"] == found["voronoi"]["episodes"]
    means = {spec: results["score"]["mean"] for spec, results in found.items()}
    assert means["swarm_stay"] == min(means.values()) and len(set(means.values())) == 4
    assert SuitePolicy("swarm_stay").hosted and not SuitePolicy("swarm_voronoi").hosted


def test_a_suite_refuses_controls(monkeypatch):
    found = find_named_policy("aims")
    monkeypatch.setattr(
        "maexp.agents.benchmarks.suites.play.find_named_policy", lambda *a, **k: replace(found, direct=True)
    )
    with pytest.raises(UserError, match="policy=aims gives controls"):
        SuitePolicy("aims")
