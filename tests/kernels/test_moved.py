"""Import paths of version 0.2: the old name is the new module itself, with a warning."""

import importlib
import subprocess
import sys

import pytest

OLD = [
    ("maexp.envs.map", "maexp.envs.maps.point_cloud"),
    ("maexp.envs.importing", "maexp.envs.io"),
    ("maexp.envs.importing.options", "maexp.envs.io.options"),
    ("maexp.agents.runtime.frames", "maexp.agents.deploy.planner.frames"),
    ("maexp.agents.runtime.radio_driver", "maexp.agents.deploy.planner.drivers"),
    ("maexp.agents.networks.critics", "maexp.agents.models.critics"),
]


@pytest.mark.parametrize("old, new", OLD)
def test_old_path_is_the_new_module(old, new):
    for name in [name for name in sys.modules if name == old]:
        del sys.modules[name]
    with pytest.warns(DeprecationWarning, match=new):
        found = importlib.import_module(old)
    assert found is importlib.import_module(new)
    assert found.__spec__.name == found.__name__ == new


def test_unknown_module_of_a_moved_package():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("maexp.envs.importing.nothing")


def test_public_robot_api_warns_of_nothing():
    code = "import maexp.agents.runtime as r; r.TeamPlanner, r.RobotPlanner, r.shipped_names"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_module_of_an_old_path_runs():
    command = [sys.executable, "-m", "maexp.agents.policies.connection"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "usage: python -m maexp.agents.policies.remote.server" in done.stderr
