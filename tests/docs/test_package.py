"""The package that is installed holds every folder and setting that the source does."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import pytest_configure
from isolated_packages import PLAN_WITH_A_POLICY, share_packages
from packaging.requirements import Requirement
from paths import ROOT

ROOMS = ("kernels", "envs", "agents", "conf")


def folders_with_code() -> set[str]:
    found = {path.parent for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    return {"maexp." + ".".join(path.relative_to(ROOT).parts) for path in found}


def test_every_folder_is_listed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    assert set(listed) == folders_with_code()


def test_no_folder_shadows_the_package():
    assert not (ROOT / "maexp").exists()


def test_imports_go_one_way():
    above = {"kernels": ("envs", "agents", "conf"), "envs": ("agents",), "agents": (), "conf": ROOMS}
    for room, others in above.items():
        for path in (ROOT / room).rglob("*.py"):
            text = path.read_text()
            for other in others:
                assert f"import maexp.{other}" not in text and f"from maexp.{other}" not in text, path


LAYERS = (
    "deploy.planner config evaluation.metric_format models algorithms policies evaluation training.checkpoint "
    "policies.registry training deploy.irsim benchmarks deploy.ros2 cli runtime"
).split()
"""Rooms of `agents/` from the bottom up; a module belongs to the longest name that fits."""


def find_layer(module: str) -> int | None:
    fitting = [layer for layer in LAYERS if f"{module}.".startswith(f"{layer}.")]
    return LAYERS.index(max(fitting, key=len)) if fitting else None


def test_rooms_of_agents_import_only_those_below_them():
    agents = ROOT / "agents"
    assert {layer.split(".")[0] for layer in LAYERS} == {path.parts[-2] for path in agents.glob("*/*.py")} | {"deploy"}
    for path in agents.rglob("*.py"):
        layer = find_layer(".".join(path.relative_to(agents).with_suffix("").parts))
        used = re.findall(r"from maexp\.agents\.([\w.]+) import", path.read_text())
        above = [name for name in used if layer is not None and (find_layer(name) or 0) > layer]
        allowed = ["deploy.planner"] if path.parent == agents / "runtime" else []
        assert not set(above) - set(allowed), path


@pytest.mark.parametrize("name", ["torchrl", "tensordict"])
def test_torchrl_is_bounded_by_what_is_tested(name):
    """Losses, collectors and estimators build on it; the next minor version is tried before it is allowed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = next(dependency for dependency in map(Requirement, project["dependencies"]) if dependency.name == name)
    pinned = re.search(rf"^{name}==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)[1]
    major, minor, _ = map(int, pinned.split("."))
    assert pinned in wanted.specifier and f"{major}.{minor + 1}.0" not in wanted.specifier


def test_the_version_is_the_same_wherever_it_stands():
    """In the package, what one cites, and the newest entry of the changes, with its date."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = dict(re.findall(r"^(version|date-released): (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    newest = re.search(r"^## (\S+), (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert (project["version"], *cited.values()) == (newest[1], *newest.groups())


def test_constraints_name_exact_versions():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines and all("==" in line and "+" not in line for line in lines)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in lines}
    wanted = {dependency.partition(">=")[0].partition("[")[0].lower() for dependency in project["dependencies"]} - {
        "open3d"
    }
    assert wanted <= pinned


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    tmp_path = tmp_path_factory.mktemp("wheel")
    source = tmp_path / "source"  # a copy: building leaves folders behind, and picks up those of last time
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path, source]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(tmp_path.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_holds_code_settings_and_policies(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"maexp/{path.relative_to(ROOT)}" for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    wanted |= {f"maexp/{path.relative_to(ROOT)}" for path in (ROOT / "conf").rglob("*.yaml")}
    wanted |= {f"maexp/{path.relative_to(ROOT)}" for path in (ROOT / "conf" / "_suite").glob("*.csv")}
    wanted.add("maexp/kernels/loops.h")
    folders = [ROOT / "agents" / name for name in ("shipped", "predictors")]
    shipped = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    wanted |= {f"maexp/{path.relative_to(ROOT)}" for path in shipped}
    assert len(shipped) >= 12 and wanted <= names, wanted - names


@pytest.mark.slow
def test_the_wheel_plans_with_a_policy_that_ships_where_torch_is_not(wheel, tmp_path):
    """As docs/deploy.md says: `pip install --no-deps` and three packages."""
    share_packages(tmp_path / "shared", "numpy", "scipy", "onnxruntime")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "-q", wheel]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (site,) = (tmp_path / "venv").rglob("site-packages")
    (site / "shared.pth").write_text(f"{tmp_path / 'shared'}\n")
    done = subprocess.run([python, "-c", PLAN_WITH_A_POLICY], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.startswith(str(site)), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ((), "not slow"),
        (("-x",), "not slow"),
        (("-m", ""), ""),
        (("-m", "slow"), ""),
        (("tests/envs/maps/test_point_cloud.py",), ""),
    ],
)
def test_pytest_alone_is_the_quick_set(words, wanted):
    """What is asked for by a file or a mark is left as it is."""
    sources = pytest.Config.ArgsSource
    source = sources.ARGS if any(word.startswith("tests") for word in words) else sources.TESTPATHS
    option, given = SimpleNamespace(markexpr=""), SimpleNamespace(args=words)
    pytest_configure(SimpleNamespace(args_source=source, invocation_params=given, option=option))
    assert option.markexpr == wanted
