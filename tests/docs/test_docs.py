"""What the documentation shows works: its Python blocks run, its patches apply, its links lead somewhere."""

import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import fields
from typing import get_args

import numpy as np
import pytest
import torch
from paths import ROOT
from tensordict.nn import set_composite_lp_aggregate
from tensordict.nn.probabilistic import composite_lp_aggregate

from maexp.agents.algorithms import ALGORITHMS
from maexp.envs import SCENARIOS, ExplorationEnv, ObservationConfig, PlannerConfig, RobotConfig, make_map
from maexp.envs.config import ROBOT_KINDS
from maexp.envs.specs import REWARD_TERMS
from maexp.envs.targets.features import FEATURES
from maexp.kernels.state import STATE
from maexp.kernels.types import PICTURE_CHANNELS

EXAMPLES = ROOT / "docs" / "examples"
PATCHES = sorted((EXAMPLES / "patches").glob("*.diff"))
PAGES = sorted((ROOT / "docs").rglob("*.md")) + [ROOT / "README.md"]
SMALLER = {"num_envs=64": "num_envs=2", "rollout(10,": "rollout(2,"}
"""The README shows sizes that people use; here they would take too long."""
PLANNERS = get_args(PlannerConfig.__dataclass_fields__["name"].type)
SHIPPED = {
    "reward terms": (len(REWARD_TERMS), 5),
    "parameters of robots": (len(fields(RobotConfig)), 10),
    "kinds of robots": (len(ROBOT_KINDS), 3),
    "planners": (len(PLANNERS), 3),
    "features": (len(FEATURES), 32),
    "channels": (PICTURE_CHANNELS, 4),
    "arrays of the state": (len(STATE), 59),
}
"""What the patches add to: how many there are, and how many they are written for."""


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of one language of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def run_block(code: str, page: str) -> dict:
    """Run a block as a user would paste it; returns its names."""
    names: dict = {"__name__": "docs"}
    exec(compile(code, page, "exec"), names)
    return names


@pytest.fixture(autouse=True)
def leave_no_trace():
    """Blocks may add rows to tables, set TorchRL's global switch and draw numbers."""
    kept = [(table, dict(table)) for table in (SCENARIOS, ALGORITHMS)]
    with torch.random.fork_rng(devices=[]), set_composite_lp_aggregate(composite_lp_aggregate(nowarn=True)):
        torch.manual_seed(0)
        yield
    for table, rows in kept:
        table.clear()
        table.update(rows)


def test_readme():
    (code,) = blocks("README.md", "python")
    for large, small in SMALLER.items():
        assert large in code
        code = code.replace(large, small)
    names = run_block(code, "README.md")
    assert names["rollout"].shape == (2, 2)
    assert names["rollout"]["agents", "action", "region"].shape == (2, 2, 3)


def test_own_training_loop():
    code, of_a_command = blocks("docs/torchrl.md", "python")
    assert "make_env(" in of_a_command  # compared with the command's own in test_command_env.py
    assert len([line for line in code.splitlines() if line.strip()]) <= 30
    names = run_block(code, "docs/torchrl.md")
    assert names["batch"].shape == (4, 6) and names["log_prob"].shape == (4, 6, 3)
    for value in names["log_prob"].values(True, True):
        assert value.shape == (4, 6, 3)  # one per robot: not the joint action's
    assert torch.isfinite(names["loss"])
    moved = names["optimizer"].state
    assert moved and all(state["step"] == 2 for state in moved.values())


@pytest.mark.parametrize(("block", "library"), enumerate(["pettingzoo", "gymnasium"]))
def test_other_interfaces(block, library, capsys):
    pytest.importorskip(library, reason=f"THE EXTRA maexp[{library}] IS NOT INSTALLED: its example is not tested")
    names = run_block(blocks("docs/adapters.md", "python")[block], "docs/adapters.md")
    told = capsys.readouterr().out
    if library == "pettingzoo":
        assert names["picture"].shape[1:] == (512, 3) and "% of the place seen" in told and not names["env"].agents
    else:
        assert names["observations"]["map"].shape == (4, 3, PICTURE_CHANNELS, 125, 125)
        assert told.count("returns of the teams") == 2


def test_episode_files_and_recorders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_block("\n".join(blocks("docs/viewing.md", "python")), "docs/viewing.md")
    assert names["picture"].shape[1:] == (512, 3) and (tmp_path / "episode.npz").is_file()
    assert (tmp_path / "logs" / "films" / "videos" / "film_0.pt").is_file()


def test_the_planner_of_the_arena_is_the_example_and_short():
    assert "{literalinclude} examples/policies/nearest.py" in (ROOT / "docs" / "arena.md").read_text()
    assert len([line for line in (EXAMPLES / "policies" / "nearest.py").read_text().splitlines() if line.strip()]) <= 30


def test_the_greedy_planner_weighs_distance_and_length_and_gives_up():
    """A hall of 20 x 9 m whose walls have a gap of 1 m near the robot, on the left, and one of 5 m on the right."""
    example = runpy.run_path(str(EXAMPLES / "policies" / "greedy.py"))
    grid = np.full((1, 11, 22), 100, np.int8)
    grid[0, 1:-1, 1:-1] = 0
    grid[0, 5, 0] = grid[0, 3:8, -1] = -1
    seen = {"alive": [True], "grid": grid, "resolution": 1.0, "origin": (0.0, 0.0), "time": 0.0}
    seen["poses"] = np.array([[[10.5, 5.5, 0.0]]])
    episode = {"robot_radius": 0.0, "decision_seconds": 1.0, "radar_range": 10.0, "num_robots": 1}
    planner = example["Greedy"]()
    planner.reset(episode)
    assert planner.act(seen).tolist() == [[20.5, 5.5]], "a metre farther than the other, and longer"
    seen["poses"][0, 0, 0] = 3.0
    assert planner.act(seen).tolist() == [[1.5, 5.5]], "nearer counts more"
    assert planner.act(seen | {"time": 29.0}).tolist() == [[1.5, 5.5]]
    assert planner.act(seen | {"time": 31.0}).tolist() == [[20.5, 5.5]], "it got no nearer for 30 s"
    planner.reset(episode | {"robot_radius": 0.5})
    grid[0, 5, 0] = grid[0, 3:8, -1] = 100
    assert np.isnan(planner.act(seen)).all(), "nothing is left to see"
    grid[0, 3:8, -1] = -1
    assert planner.act(seen).tolist() == [[20.5, 5.5]]
    grid[0, :, 12] = 100
    assert np.isnan(planner.act(seen)).all(), "behind a wall"


def test_own_policy():
    """A network chooses among the targets shown."""
    names = run_block(blocks("docs/extending.md", "python")[0], "docs/extending.md")
    env = ExplorationEnv(make_map("maze_small", 0), num_robots=2, observation=ObservationConfig(targets=6))
    chosen = names["Network"](env)(env.reset())["agents", "action", "target"]
    assert chosen.shape == (1, 2) and (chosen >= 0).all()


def test_own_algorithm():
    names = run_block(blocks("docs/extending.md", "python")[1], "docs/extending.md")
    assert not names["loss"].team_value and names["logged"]["gradient_norm"] > 0


def test_every_block_of_extending_is_tested():
    assert len(blocks("docs/extending.md", "python")) == 2


@pytest.mark.skipif(shutil.which("git") is None, reason="git is absent: patches are not checked")
@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.stem)
def test_patches_apply(patch):
    """To the tree as it ships. Where something was added, lines beside it have moved: that is no fault of the patch."""
    done = subprocess.run(["git", "apply", "--check", patch], text=True, capture_output=True, cwd=ROOT)
    own = [f"{count - shipped} {what}" for what, (count, shipped) in SHIPPED.items() if count > shipped]
    if done.returncode and own:
        pytest.skip(f"{patch.name} IS FOR THE TREE AS IT SHIPS; here are more: {', '.join(own)}")
    assert done.returncode == 0, f"write {patch.relative_to(ROOT)} anew:\n{done.stderr}"


def test_extending_shows_every_patch():
    shown = re.findall(r"\{literalinclude\} examples/patches/(.*)", (ROOT / "docs/extending.md").read_text())
    assert sorted(shown) == [patch.name for patch in PATCHES] and len(shown) == 9


COUNTED = {
    "a-scenario": "scenario",
    "a-parameter-of-robots": "robot_parameter",
    "a-robot-kind": "robot_kind",
    "a-planner": "classical_planner",
    "a-reward-term": "reward_term",
}
"""Rows of the page's table, and the patch that shows how many files it takes."""


@pytest.mark.parametrize(("what", "patch"), COUNTED.items())
def test_the_table_of_extending_counts_the_files(what, patch):
    page = (ROOT / "docs/extending.md").read_text()
    files = re.findall(r"^\+\+\+ b/(\S+)", (EXAMPLES / "patches" / f"{patch}.diff").read_text(), re.MULTILINE)
    assert int(re.search(rf"\(#{what}\) \| (\d)", page)[1]) == len(files) == len(set(files))
    assert len(files) <= 2 or what == "a-robot-kind"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_every_picture_is_shown():
    """And is small enough to be fetched with the repository; films and curves of many panels may be larger."""
    links = {page: re.findall(r"!\[.*?\]\((.*?)\)", page.read_text()) for page in PAGES}
    shown = {(page.parent / link).resolve() for page, found in links.items() for link in found}
    files = [path for path in (ROOT / "docs").rglob("*.*") if "_build" not in path.parts]
    pictures = {path for path in files if path.suffix in (".png", ".gif")}
    assert pictures == shown and len(pictures) > 20
    large = [path.name for path in pictures if path.stat().st_size > (1.5e6 if path.suffix == ".gif" else 4e5)]
    assert not large


def test_the_pages_build_without_a_warning(tmp_path):
    """Sphinx, warnings as errors: broken references, pages nobody links to, docstrings that are no markup."""
    pytest.importorskip("sphinx", reason="Sphinx is absent: pip install -e '.[docs]'")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "docs", str(tmp_path / "html")]
    done = subprocess.run(command, text=True, capture_output=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    reference = (tmp_path / "html" / "api" / "envs.html").read_text()
    assert "maexp.envs.ExplorationEnv" in reference and "num_envs" in reference
