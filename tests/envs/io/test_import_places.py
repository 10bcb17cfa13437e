"""Imports where names are odd, the disk is full, or folders are not there or cannot be written."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_import_grids import write_ros

from maexp.agents.cli import main
from maexp.envs.io import report


def run(*words, **environment):
    """The command in a process of its own, with the environment changed; None takes a variable away."""
    changed = {**os.environ, **environment}
    changed = {name: value for name, value in changed.items() if value is not None}
    command = [sys.executable, "-m", "maexp.agents.cli", *words]
    return subprocess.run(command, env=changed, capture_output=True, text=True, errors="replace", timeout=120)


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux only")
def test_names_that_are_no_text(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        write_ros(tmp_path / "maps", name=name)
    os.rename(b"maps/one.yaml", b"maps/l\xe4b.yaml")
    Path("maps", os.fsdecode(b"bad\xff.pcd")).write_text("x")
    assert main(["maps", "import", "maps", "hydra.run.dir=all"]) == 1
    assert "2 of 3 files became maps" in capsys.readouterr().out
    assert "l\\xe4b.yaml" in Path("all/report.csv").read_text() and "bad\\xff.pcd" in Path("all/report.md").read_text()
    assert main(["maps", "import", os.fsdecode(b"maps/l\xe4b.yaml"), "hydra.run.dir=out"]) == 0
    assert Path("out/l_xe4b.npz").is_file() and Path("out/l_xe4b.png").is_file()


def test_the_report_as_json(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_ros(tmp_path / "maps", free_thresh=None)
    assert main(["maps", "import", "maps/floor.yaml", "hydra.run.dir=out"]) == 0
    found = json.loads(Path("out/report.json").read_text())
    assert found["verdict"] == "good" and found["map"]["free_area"] > 60
    assert found["import"]["steps"][0]["name"] == "read" and "0.196" in found["import"]["assumptions"][0]
    assert main(["maps", "import", "maps", "hydra.run.dir=all"]) == 0
    assert json.loads(Path("all/floor.yaml.json").read_text())["map"] == found["map"]


def test_strict_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_ros(tmp_path, free_thresh=None)
    assert main(["maps", "import", "floor.yaml", "importing.strict=true"]) == 2
    told = capsys.readouterr().err
    assert "importing.strict=true refuses" in told and "importing.free_threshold" in told and told.count("\n") == 1


def test_a_disk_that_is_full_while_the_picture_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_ros(tmp_path)

    def full(*words, **settings):
        raise OSError(28, "No space left on device")

    from matplotlib.backends.backend_agg import FigureCanvasAgg

    monkeypatch.setattr(FigureCanvasAgg, "print_png", full)
    assert report.draw_import and main(["maps", "import", "floor.yaml", "hydra.run.dir=out"]) == 2
    told = capsys.readouterr().err
    assert "Writing of" in told and "floor.png failed (No space left on device): free some space" in told


@pytest.mark.skipif(sys.platform != "linux", reason="other systems keep the folder")
def test_a_working_folder_that_was_removed(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    try:
        assert main(["maps", "list"]) == 2
    finally:
        os.chdir(tmp_path)
    assert "the working folder was removed" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_as_a_module():
    done = run("maps", "list")
    assert done.returncode == 0 and "pointcloud" in done.stdout
    done = run("maps", "check")
    assert done.returncode == 2 and "needs a file" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("words", [("maps", "list"), ("train", "--cfg", "job")])
def test_a_home_that_cannot_be_written(tmp_path, words):
    (tmp_path / "file").touch()
    home = str(tmp_path / "file" / "home")
    places = {"HOME": home, "XDG_CACHE_HOME": None, "WARP_CACHE_PATH": None, "TMPDIR": str(tmp_path)}
    done = run(*words, **places)
    assert done.returncode == 0 and done.stdout, done.stderr
    assert "Traceback" not in done.stderr
    if words[0] == "maps":
        assert "cannot be written" in done.stderr and "WARP_CACHE_PATH names another folder" in done.stderr
        assert done.stderr.count("maexp: note") == 1 and list(tmp_path.glob("maexp-warp-*"))
