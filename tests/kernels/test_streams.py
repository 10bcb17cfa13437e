"""Every launch goes to torch's current stream: shown without a GPU, with a fake stream and a recorded launch."""

from pathlib import Path

import pytest
import torch
import warp as wp
from worlds import act, room

import maexp.kernels as mk
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, PlannerConfig
from maexp.kernels import launches

ROOM = Path(launches.__file__).parents[1]


class Command:
    """A recorded launch that notes the stream of every repetition."""

    def __init__(self, command, note):
        self.command, self.note = command, note

    def launch(self, stream=None):
        self.note(stream)
        self.command.launch()


class Recorder:
    """Notes the kernel and the stream of every launch, at once or recorded, and launches on the CPU."""

    def __init__(self, monkeypatch):
        self.now, self.met = "first", []
        launch = wp.launch

        def noted(kernel, *args, stream=None, record_cmd=False, **kwargs):
            def note(stream):
                self.met.append((kernel.key, stream))

            made = launch(kernel, *args, record_cmd=record_cmd, **kwargs)
            return Command(made, note) if record_cmd else note(stream)

        monkeypatch.setattr(wp, "launch", noted)
        monkeypatch.setattr(launches, "KNOWN", False)  # as on a GPU: recorded commands, not packed arguments
        monkeypatch.setattr(launches, "current_stream", lambda device: self.now)

    def kernels(self, stream: str) -> set[str]:
        """Kernels launched since the last call; all must have been on that stream."""
        met, self.met = self.met, []
        assert {there for _, there in met} == {stream}
        return {kernel for kernel, _ in met}


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_steps_observations_and_plans_go_to_the_current_stream(planner, limited, monkeypatch):
    recorder = Recorder(monkeypatch)
    env = ExplorationEnv(
        [room(22, 19)],
        num_envs=2,
        num_robots=2,
        local_steps=3,
        num_threads=1,
        planner=PlannerConfig(name=planner),
        comm=CommConfig(range=9.0) if limited else None,
    )
    chooser = {name: POLICIES[name](env) for name in ("potential_field", "rrt_frontiers", "hungarian")}
    recorder.met.clear()
    td = env.reset()
    assert {"_place_team", "_draw_points", "_observe_pose"} <= recorder.kernels("first")
    for recorder.now, policy in zip(("second", "third", "fourth"), chooser.values(), strict=True):
        td = policy(td)
        assert {"_paint_points", "_search_distance", "_look_from_targets"} <= recorder.kernels(recorder.now)
        td = env.step(td)["next"].exclude("reward")
        assert {"_plan_dwa", "_scan_free", "_draw_points"} <= recorder.kernels(recorder.now)
    env.step(td.update(act(env, torch.Generator().manual_seed(0))))
    recorder.kernels("fourth")


def test_single_kernels_go_to_the_current_stream(monkeypatch):
    recorder = Recorder(monkeypatch)
    recorder.now = "own"
    points, grid = torch.rand(40, 2) * 9.0, torch.ones(1, 5, 6, dtype=torch.bool)
    mk.visible_points(points, points[:7], points[0])
    mk.merge_maps(torch.ones(1, 2, 9, dtype=torch.bool), torch.ones(1, 2, 2, dtype=torch.bool))
    mk.geodesic_distance(grid, torch.tensor([3]))
    mk.frontier_cells(grid, ~grid)
    names = {"_collect_occluders", "_scan_free", "_share_points", "_search_distance", "_mark_frontier"}
    assert recorder.kernels("own") == names


def test_nothing_is_launched_elsewhere():
    """Only `kernels/launches.py` calls Warp's launch; the streams of the rest cannot be wrong."""
    files = [file for room in ("kernels", "envs", "agents") for file in (ROOM / room).rglob("*.py")]
    found = [str(file.relative_to(ROOM)) for file in files if "wp.launch" in file.read_text()]
    assert len(files) > 60 and found == ["kernels/launches.py"]
