"""Every command the documentation shows is run as it stands there, made small, in a folder with the files it names."""

import importlib.util
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import open3d
import pytest
from paths import ROOT
from small_suite import make_small_suite
from worlds import room

from maexp.agents.cli import VERBS, main
from maexp.agents.files import write_json
from maexp.agents.progress import Progress
from maexp.envs.io.map_server import export_ros_map
from maexp.envs.io.occupancy import read_occupancy
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport

HAS_ONNX = all(importlib.util.find_spec(name) for name in ("onnx", "onnxscript", "safetensors"))
HAS_BAGS = importlib.util.find_spec("rosbags") is not None
REPORTS = ROOT / "docs" / "reports"  # what was run once, with the code of its day
PAGES = [*(page for page in sorted((ROOT / "docs").rglob("*.md")) if REPORTS not in page.parents), ROOT / "README.md"]
PLACES = ("scenario.macro_steps=2", "scenario.local_steps=3", "num_envs=3", "device=cpu")
OWN_MAPS = ("scenario.maps=[0]", "scenario.held_out=[1]")
SMALLER = {  # verb -> what makes it small, last and so stronger
    "train": (
        *PLACES,
        "total_frames=8",
        "warm_start_frames=8",
        "collector.steps=2",
        "episodes=2",
        "model.channels=4",
        "evaluate_episodes=2",
    ),
    "evaluate": (*PLACES, "episodes=2"),
    "benchmark": (
        *PLACES,
        "scenarios=maze_small",
        "algorithms=mappo",
        "policies=random",
        "seeds=0",
        "iterations=null",
        "total_frames=4",
        "collector.steps=2",
        "episodes=2",
        "model.channels=4",
        "train_maps=1",
        "test_maps=1",
        "policy_per_map=null",
        "estimate=false",
        "workers=1",
    ),
    "view": (*PLACES, "renderer=painter", "size=200"),
    "irsim": ("seconds=1", "beams=40", "num_robots=2", "people=1"),
    "bench": ("scenario.local_steps=3", "num_envs=2", "num_robots=2", "device=cpu", "seconds=0.05"),
}
MEANT = {  # placeholder -> what stands for it here
    "outputs/DATE/RUN": "outputs/run",
    "RUN_OR_CHECKPOINT": "outputs/run",
    "policy=NAME": "policy=voronoi",
    "algorithm=NAME": "algorithm=ippo",
    "maexp VERB": "maexp train",
    "RUN": "outputs/run",
    "FILE": "floor.yaml",
    "FOLDER": "scans",
}
ELSEWHERE = ("hydra/launcher=", "hydra.launcher.", "collector.ray_address=")
"""Words that need a cluster or another project's plugin; the rest of the command is run without them."""
WORKERS = ("num_envs=4", "collector.workers=2", "total_frames=16")  # stronger than SMALLER: a team for each worker
NOT_OURS = (
    "pip ",
    "sphinx-build ",
    "ray ",
    "python -m maexp.agents.runtime",
    "python -m build",
)
"""Lines that begin so are other programs, which .ci/run or a test of its own calls."""


ANSWERS = re.findall(r"^\$ (maexp .*)\n(maexp: .*)$", (ROOT / "docs" / "troubleshooting.md").read_text(), re.MULTILINE)
COMPARED = [line for line, _ in ANSWERS]


def shown() -> dict[str, list[str]]:
    """Command -> pages that show it: lines of shell blocks, `$ ...` of console blocks less those that are compared with
    their answers, and `maexp ...` with settings or flags in a sentence.
    """
    found: dict[str, list[str]] = {}
    for page in PAGES:
        text = page.read_text()
        lines = [
            line
            for block in re.findall(r"^```(?:sh|bash)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
            for line in block.replace("\\\n", " ").splitlines()
        ]
        consoles = re.findall(r"^```console\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        typed = [line for block in consoles for line in block.replace("\\\n", " ").splitlines() if line[:2] == "$ "]
        lines += [line[2:] for line in typed if line[2:] not in COMPARED]
        spoken = [line for line in re.findall(r"`(maexp [^`\n]+)`", text) if "..." not in line and "[" not in line]
        lines += [line for line in spoken if "=" in line or "--" in line]
        for line in lines:
            line = re.sub(r"\s+#.*", "", line).strip()
            line = line[line.index("maexp ") :] if line.startswith("pip ") and "maexp " in line else line
            if line and not line.startswith("#"):
                found.setdefault(line, []).append(page.name)
    return found


SHOWN = shown()
COMMANDS = [line for line in SHOWN if line.startswith("maexp")]


def small(line: str) -> list[str]:
    """The words of a command, with what it stands for, and small."""
    if line.startswith("maexp leaderboard"):
        return [*shlex.split(line)[1:], "suite=small.yaml"]
    if line.startswith("maexp suite "):
        line = line.replace("run minival", "run small.yaml").replace("mine.yaml", "small.yaml")
        line = line.replace("FOLDER", "outputs/mine")
        given = "verify" not in line or "suite=" in line
        return [*shlex.split(line)[1:], *([] if given else ["suite=small.yaml"])]
    if "resume=FOLDER" in line:  # one that was stopped (`set_stage`)
        line = line.replace("FOLDER", f"outputs/stopped_{'sweep' if ' -m ' in line else 'evaluation'}")
    for name, meaning in MEANT.items():
        line = re.sub(rf"(?<![A-Za-z_]){re.escape(name)}(?![A-Za-z_])", meaning, line)
    words = [word for word in shlex.split(line)[1:] if not word.startswith(ELSEWHERE)]
    if not words or {"--help", "--cfg"} & set(words):
        return words
    if any(word.endswith("_device=cuda:1") or word.endswith("_device=cuda") for word in words):
        return [*words, "--cfg", "job"]  # its settings are good; a machine with such devices runs it in test_cuda.py
    more = SMALLER.get(words[0], ())
    own = ("scenario=pointcloud", "checkpoint=", "resume=")
    if words[0] in SMALLER and words[0] != "irsim" and not any(word.startswith(own) for word in words):
        more = (*more, *OWN_MAPS)
    if any(word.startswith("resume=") for word in words):
        more = ("algorithms=mappo",) if words[0] == "benchmark" else ()
    if any(word.startswith("collector.workers=") for word in words):
        more = (*more, *WORKERS)
    return [*words, *more]


def interrupt(*_) -> None:
    """What Ctrl-C comes to; a signal may be heard in a finalizer, where Python drops what it raises."""
    raise KeyboardInterrupt


def set_stage(words: list[str]) -> None:
    """Earlier commands of a page made what this one reads, and none made what it is to write."""
    mine = words[0] in ("suite", "leaderboard") and "outputs/mine" in "".join(words[2:])
    if mine and not Path("outputs/mine").exists():
        assert main(["suite", "run", "small.yaml", "policy=random", "hydra.run.dir=outputs/mine"]) == 0
    for name, value in (word.split("=", 1) for word in words if "=" in word):
        place = Path(value)
        if name == "hydra.run.dir" and place.is_dir():
            shutil.rmtree(place)
        elif name == "out" and not place.is_dir():
            place.unlink(missing_ok=True)
        elif name == "checkpoint" and not place.exists():
            shutil.copytree("outputs/run", place)
        elif name == "resume" and place.name == "stopped_evaluation":
            shutil.rmtree(place, ignore_errors=True)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(Progress, "advance", interrupt)
                evaluate = ["evaluate", *SMALLER["evaluate"], *OWN_MAPS, "policy=random"]
                assert main([*evaluate, f"hydra.run.dir={place}"]) == 130
        elif name == "resume" and place.name == "stopped_sweep":
            words_of_it = [*SMALLER["train"], *OWN_MAPS, "seed=0,1", "episodes=0"]
            write_json(place / "sweep.json", {"format": "maexp-sweep-1", "words": words_of_it})
        elif name == "resume" and words[0] == "benchmark" and not place.exists():
            assert main(["benchmark", *SMALLER["benchmark"], *OWN_MAPS, f"hydra.run.dir={place}"]) == 0
    if words[0] == "view" and words[1].startswith("outputs/") and not Path(words[1]).exists():
        shutil.copytree("outputs/run", words[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where a reader would be: maps of their own under the names that the pages use, and a run."""
    place = tmp_path_factory.mktemp("reader")
    (place / "scans").mkdir()
    named = {w for line in COMMANDS for w in re.findall(r"[\w/]+\.(?:yaml|pcd|npz|ply|mcap)", line)}
    for name in named | {"scans/a.yaml"}:
        if (place / name).suffix in (".pcd", ".ply"):
            cloud = room(30, 21, spacing=0.2)
            flat = np.concatenate([cloud.free, *(cloud.obstacles + [0, 0, h] for h in np.arange(0.2, 1.4, 0.2))])
            if any(name in line and "units=mm importing.up=y" in line for line in COMMANDS):
                flat = 1000 * flat[:, [0, 2, 1]]
            points = open3d.utility.Vector3dVector(flat.astype(float))
            open3d.io.write_point_cloud(str(place / name), open3d.geometry.PointCloud(points))
        elif (place / name).suffix == ".yaml":
            export_ros_map(room(30, 21, spacing=0.2), place / name)
        elif (place / name).suffix == ".mcap" and HAS_BAGS:
            write_map(place / name, room(30, 21, spacing=0.2))
        elif (place / name).suffix == ".npz":
            room(30, 21, spacing=0.2).save(place / name)
    export_ros_map(room(8, 6, spacing=0.1), place / "cupboard.yaml")
    (place / "scan.xyz").write_text("1 2 nan\n" + "\n".join(f"{i % 9} {i // 9} 0" for i in range(90)))
    make_small_suite(place / "small.yaml")
    shutil.copytree(ROOT / "docs" / "leaderboard", place / "docs" / "leaderboard")
    shutil.copy(ROOT / "docs" / "examples" / "policies" / "nearest.py", place)
    page = (ROOT / "docs" / "extending.md").read_text()
    (place / "my_robots.py").write_text(re.findall(r"`my_robots.py`:\n\n```python\n(.*?)```", page, re.DOTALL)[0])
    (place / "my_module.py").write_text("from maexp.agents.policies import POLICIES\n\nmake = POLICIES['voronoi']\n")
    (place / "nearest").write_text(
        f"#!/bin/sh\nexec {sys.executable} -m maexp.agents.policies.remote.worker nearest:Nearest\n"
    )
    (place / "nearest").chmod(0o755)
    header = "VERSION 0.7|FIELDS x y z|SIZE 4 4 4|TYPE F F F|COUNT 1 1 1|WIDTH 100|HEIGHT 1|POINTS 100|DATA ascii"
    (place / "truncated.pcd").write_text("\n".join([*header.split("|"), "1 2 3", ""]))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(["train", *SMALLER["train"], *OWN_MAPS, "hydra.run.dir=outputs/run"]) == 0
    return place


def write_map(path: Path, world) -> None:
    """A recording of that map."""
    from bag_writer import grid, write_bag

    image = export_ros_map(world, path.with_suffix(".yaml"))
    found = read_occupancy(image, ImportOptions(), ImportReport(str(image)))
    values = np.array([-1, 0, 100])[found.labels]
    bag = write_bag(path.with_suffix(""), [("/map", 0.0, grid(values.T, found.cell, found.origin))])
    next(bag.glob("*.mcap")).rename(path)
    for left in (image, image.with_suffix(".pgm")):
        left.unlink()


DIFFERENT = {tuple(small(line)): line for line in reversed(COMMANDS)}.values()  # small, some are the same command
FIRST = {tuple(small(line)) for line in COMMANDS if "README.md" in SHOWN[line]}
"""What a new reader tries: the other commands are slow tests, for there are many."""
RUNS = [
    pytest.param(line, id=line, marks=[] if tuple(small(line)) in FIRST else [pytest.mark.slow])
    for line in COMMANDS
    if line in DIFFERENT
]


@pytest.mark.parametrize("line", RUNS)
def test_command(line, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    if "collector=ray" in line:
        pytest.importorskip("ray", reason="ray is absent")
    if "browser=true" in line:  # the page opens, and ends at once
        page = pytest.importorskip("maexp.envs.render.page", reason="viser is absent")
        monkeypatch.setattr(page.Page, "run", lambda page: None)
    if line.startswith("maexp export") and not HAS_ONNX:
        pytest.skip("THE EXTRA maexp[export] IS NOT INSTALLED: its command is not run")
    if ".mcap" in line and not HAS_BAGS:
        pytest.skip("THE EXTRA maexp[rosbag] IS NOT INSTALLED: bags are not imported")
    if line.startswith("maexp irsim"):
        pytest.importorskip("irsim", reason="THE EXTRA maexp[irsim] IS NOT INSTALLED: no trial is run")
    words = small(line)
    set_stage(words)
    status = main(words)
    output = capsys.readouterr()
    assert status == 0, f"{' '.join(words)}\n{output.err}"
    assert "Traceback" not in output.err


@pytest.mark.parametrize(("line", "answer"), ANSWERS, ids=[line for line, _ in ANSWERS])
def test_errors_are_as_shown(line, answer, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(shlex.split(line)[1:]) == 2
    assert capsys.readouterr().err.replace(f"{folder}/", "").strip().startswith(answer)


def test_every_line_is_one_of_ours_or_listed():
    others = [line for line in shown() if not line.startswith("maexp")]
    assert [line for line in others if not line.startswith(NOT_OURS)] == []
    assert len(COMMANDS) > 15 and len(ANSWERS) > 10


def test_every_verb_is_shown():
    pages = " ".join(page.read_text() for page in PAGES)
    assert [verb for verb in VERBS if f"maexp {verb}" not in pages] == []
