"""Shared fixtures: one torch thread, Warp's mode, the folder of real scans, and a tiny benchmark."""

import os
import shutil
import signal
from pathlib import Path

import pytest
import torch
import warp as wp
from hypothesis import settings

torch.set_num_threads(1)
wp.config.quiet = True
if os.environ.get("MAEXP_WARP_MODE"):  # `.ci/run` repeats the kernel tests with "debug" (bounds checks)
    wp.config.mode = os.environ["MAEXP_WARP_MODE"]
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell hands that on to what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
settings.register_profile("long")  # `--hypothesis-profile=long`: hours of fuzzing by hand (CONTRIBUTING.md)


def pytest_configure(config: pytest.Config) -> None:
    """`pytest` alone runs the quick set; files that are named, and `-m`, run what they say."""
    alone = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if alone and not any(str(word).startswith("-m") for word in config.invocation_params.args):
        config.option.markexpr = "not slow"


def pytest_report_header(config: pytest.Config) -> str | None:
    quick = config.option.markexpr == "not slow"
    return "quick set: without the tests marked slow, which `pytest -m slow` runs" if quick else None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real scans and floor maps; tests that need it skip where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MAEXP_DATA", default))
    if not (folder / "manifest.csv").is_file():
        pytest.skip(f"REAL DATA ABSENT: no manifest.csv in {folder}; set MAEXP_DATA to the folder of scans")
    return folder


@pytest.fixture(scope="session")
def oracle_dir() -> Path:
    """Folder of arrays recorded from the original platform; tests that need it skip where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "oracle"
    folder = Path(os.environ.get("MAEXP_ORACLE", default))
    if not (folder / "masking_maze.npz").is_file():
        pytest.skip(f"RECORDED ARRAYS ABSENT: no masking_maze.npz in {folder}; set MAEXP_ORACLE to the folder")
    return folder


@pytest.fixture
def somewhere(tmp_path, monkeypatch) -> None:
    """A working folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def no_pictures(monkeypatch) -> None:
    """Trainings draw nothing: pictures have tests of their own."""
    for name in ("draw_rollout", "draw_curves"):
        monkeypatch.setattr(f"maexp.agents.cli.train.{name}", lambda *args: None)


@pytest.fixture(scope="module")
def maps() -> list:
    """Two small mazes and a map of random obstacles."""
    from maexp.envs import make_map

    return [make_map("maze_small", 0), make_map("maze_small", 1), make_map("random_obstacles", 0)]


@pytest.fixture
def own_domain(monkeypatch) -> None:
    """This process, and those that it starts, in a DDS domain of their own on this machine."""
    from loopback import surroundings

    for name, value in surroundings().items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="session")
def small_suite(tmp_path_factory) -> Path:
    """The file of a frozen suite of two parts, four short episodes each: not to be changed."""
    from small_suite import make_small_suite

    return make_small_suite(tmp_path_factory.mktemp("suite") / "small.yaml")


@pytest.fixture(scope="session")
def suite_run(small_suite, tmp_path_factory) -> Path:
    """The folder of a run of it: not to be changed."""
    from maexp.agents.cli import main

    where, words = tmp_path_factory.mktemp("runs") / "run", ["policy=nearest_frontier", "num_envs=3"]
    assert main(["suite", "run", str(small_suite), *words, f"hydra.run.dir={where}"]) == 0
    return where


@pytest.fixture
def copied_run(suite_run, tmp_path) -> Path:
    """A copy of it that a test may change."""
    return Path(shutil.copytree(suite_run, tmp_path / "copy"))


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory) -> Path:
    """Folder of a tiny benchmark that ran in one go: not to be changed."""
    from tiny_benchmark import TINY

    from maexp.agents.cli import main

    folder = tmp_path_factory.mktemp("benchmark") / "whole"
    assert main(["benchmark", *TINY, f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.fixture
def run_copy(whole_run, tmp_path) -> Path:
    """A copy of it that a test may change."""
    return Path(shutil.copytree(whole_run, tmp_path / "copy"))
