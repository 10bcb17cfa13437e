"""docs/notebook.ipynb: its cells run from top to bottom in an interpreter of its own, made small."""

import json
import os
import subprocess
import sys

import pytest
from paths import ROOT

pytestmark = pytest.mark.slow  # runs a notebook

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"


def cells(kind: str) -> list[str]:
    """The sources of the cells of one kind, in order."""
    found = json.loads(NOTEBOOK.read_text())["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == kind]


def as_script() -> str:
    """The code without IPython's magic, which only installs what is here; `display` prints what it is given."""
    lines = "\n".join(cells("code")).splitlines()
    magic = [line for line in lines if line.lstrip().startswith(("%", "!"))]
    assert [line.strip() for line in magic] == ["%pip install -q -c ../constraints.txt -e .."]
    return "\n".join(line.replace("%pip", "pass  #") if line in magic else line for line in lines)


def test_the_notebook_runs(tmp_path):
    pytest.importorskip("IPython", reason="IPython is absent: the notebook is not run")
    environment = os.environ | {"MAEXP_SMOKE": "1", "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", as_script()]
    done = subprocess.run(command, text=True, capture_output=True, cwd=tmp_path, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "free points" in done.stdout and "local steps" in done.stdout  # the place, the planner
    differences = [line for line in done.stdout.splitlines() if line.endswith("coverage over time")]
    assert len(differences) == 2  # one for each size of team
    (run,) = tmp_path.glob("*/run")
    for name in ("summary.json", "curves.png", "coverage.png", "rollout.gif"):
        assert (run / name).stat().st_size > 100
    assert (run.parent / "team.png").stat().st_size > 1000


def test_the_notebook_holds_no_outputs():
    """They would make every run of it a change of the repository."""
    assert all(cell.get("outputs", []) == [] for cell in json.loads(NOTEBOOK.read_text())["cells"])
    assert len(cells("markdown")) >= 5
