"""The runtime where nothing but NumPy and SciPy is installed; its page and its measurement work there, too. Policies
need onnxruntime besides."""

import os
import re
import subprocess
import sys

import pytest
from isolated_packages import PLAN_WITH_A_POLICY, share_packages
from paths import ROOT

from maexp.agents.runtime import CHOICES


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Runs Python where only NumPy, SciPy and this package can be imported."""
    site = tmp_path_factory.mktemp("site")
    share_packages(site, "numpy", "scipy")
    (site / "maexp").mkdir()
    for room in ("agents", "conf", "envs", "kernels"):
        (site / "maexp" / room).symlink_to(ROOT / room)

    def run(*words: str) -> subprocess.CompletedProcess:
        env = {"PYTHONPATH": str(site), "PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"}
        return subprocess.run([sys.executable, "-S", *words], capture_output=True, text=True, env=env)

    return run


def test_torch_is_not_there(alone):
    done = alone("-c", "from maexp.envs import ExplorationEnv")
    assert "ModuleNotFoundError" in done.stderr  # else the tests below would prove nothing


def test_the_page(alone):
    page = (ROOT / "docs" / "deploy.md").read_text()
    code = "".join(re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL))
    done = alone("-c", code + "\nassert plan.active.all() and not plan.notes, plan")
    assert done.returncode == 0 and done.stdout.startswith("left [") and "right [" in done.stdout, done.stderr


def test_a_policy_that_ships(alone):
    done = alone("-c", PLAN_WITH_A_POLICY)
    assert "and needs onnxruntime: pip install onnxruntime" in done.stderr  # it is not there


def test_the_measurement(alone):
    done = alone("-m", "maexp.agents.runtime", "--metres", "20", "--calls", "2")
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and lines[0] == "3 robots, 200 x 200 cells of 0.1 m", done.stderr
    assert len(lines) == 1 + len(CHOICES) and all(" ms, at most " in line for line in lines[1:])
