"""The same seeds and actions on a GPU and on the CPU: the same episodes within float tolerance."""

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import step_mdp
from worlds import room

import maexp.kernels as mk
from maexp.agents.policies import POLICIES
from maexp.agents.training.collectors import make_collector
from maexp.envs import CommConfig, ExplorationEnv, FaultsConfig, OdometryConfig, PlannerConfig, RadarConfig

gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: CPU and GPU are not compared")
DEVICES = [pytest.param("cuda", marks=[pytest.mark.cuda, gpu]), "cpu"]
"""The CPU against itself shows that the comparison itself works where there is no GPU."""


def play(device: str, planner: str, **settings) -> TensorDictBase:
    """Six macro steps of five teams of three, with fixed actions, on `device`."""
    env = ExplorationEnv(
        [room(30, 22), room(26, 19, "rotated")],
        num_envs=5,
        num_robots=3,
        device=device,
        seed=3,
        local_steps=5,
        planner=PlannerConfig(name=planner),
        **settings,
    )
    generator = torch.Generator().manual_seed(0)
    state, seen = env.reset(), []
    for _ in range(6):
        region = torch.randint(64, (5, 3), generator=generator)
        offset = torch.rand(5, 3, 2, generator=generator) * 2 - 1
        state["agents", "action", "region"] = region.to(env.device)
        state["agents", "action", "offset"] = offset.to(env.device)
        stepped = env.step(state)
        seen.append(stepped["next"].select("agents", "team", "info", "done").cpu())
        state = step_mdp(stepped)
    return torch.stack(seen)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_episodes_agree(device, planner):
    here, there = play("cpu", planner), play(device, planner)
    for key in (("agents", "observation", "pose"), ("agents", "reward"), ("info", "coverage")):
        torch.testing.assert_close(there[key], here[key], rtol=1e-3, atol=2e-3)
    assert here["info", "coverage"].max() > 0.2 and torch.equal(there["done"], here["done"])
    pictures = [played["agents", "observation", "map"].int() for played in (here, there)]
    assert ((pictures[0] - pictures[1]).abs() > 2).float().mean() < 1e-3


@pytest.mark.parametrize("device", DEVICES)
def test_radios_agree(device):
    """Who hears whom, what the base station knows, and fading, which is drawn from the same keys."""
    comm = CommConfig(signal=True, power=-12.0, cell=0.1, noise=13.0, base_station=True)
    here, there = (play(processor, "wavefront", comm=comm, done="base")["info"] for processor in ("cpu", device))
    for name in ("base_coverage", "worst_coverage", "base_coverage_auc", "counted_coverage", "connected"):
        torch.testing.assert_close(there[name], here[name], rtol=1e-2, atol=1e-2)
    assert 0.05 < here["connected"].mean() < 0.95 and here["base_coverage"].max() > 0.1
    free, points = torch.rand(9, 12) < 0.8, 8.0 * torch.rand(2, 50, 2)
    found = [mk.received_power(free.to(processor), *points, edge=0.9).cpu() for processor in ("cpu", device)]
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_messages_agree(device):
    """What waits and what is under way: sums of points, the same on both."""
    comm = CommConfig(range=12.0, bandwidth=1000.0, delay=0.3, base_station=True)
    here, there = (play(processor, "wavefront", comm=comm)["info"] for processor in ("cpu", device))
    for name in ("base_coverage", "worst_coverage_auc", "bytes_sent"):
        torch.testing.assert_close(there[name], here[name], rtol=1e-2, atol=1e-2)
    assert 0 < here["bytes_sent"][-1].min() and here["bytes_sent"].max() <= 31 * 4 * 100  # steps, radios, bytes


@pytest.mark.parametrize("device", DEVICES)
def test_failures_agree(device):
    """Who fails when is drawn from the same keys."""
    faults = FaultsConfig(probability=0.7, duration=0.8)
    here, there = (play(processor, "wavefront", faults=faults, macro_steps=6)["info"] for processor in ("cpu", device))
    assert torch.equal(there["failed"], here["failed"]) and 0.02 < here["failed"].float().mean() < 0.7


@pytest.mark.parametrize("device", DEVICES)
def test_missed_returns_agree(device):
    """Which returns come is drawn from the same keys."""
    radar = RadarConfig(missed=0.4, noise=0.4, evidence=2, false_alarm=0.1)
    here, there = (play(processor, "wavefront", radar=radar)["info"] for processor in ("cpu", device))
    torch.testing.assert_close(there["coverage"], here["coverage"], rtol=1e-3, atol=2e-3)
    first = play("cpu", "wavefront")["info", "coverage"][0]
    assert here["coverage"].max() > 0.2 and (here["coverage"][0] < first).all()


@pytest.mark.parametrize("device", DEVICES)
def test_odometry_agrees(device):
    """How it drifts is drawn from the same keys."""
    odometry = OdometryConfig(drift=0.1, turn=0.05, jump=0.5, jump_rate=0.5)
    here, there = (play(processor, "wavefront", odometry=odometry) for processor in ("cpu", device))
    for key in (("agents", "observation", "pose"), ("info", "odometry_error"), ("info", "coverage")):
        torch.testing.assert_close(there[key], here[key], rtol=1e-3, atol=2e-3)
    assert 0.1 < here["info", "odometry_error"][-1].mean() < 2.0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=12.0)])
def test_maps_with_errors_agree(device, comm):
    """What robots draw, but for places that round otherwise."""
    odometry = OdometryConfig(drift=0.1, turn=0.05, jump=0.5, jump_rate=0.5, map_errors=True)
    here, there = (play(processor, "wavefront", odometry=odometry, comm=comm)["info"] for processor in ("cpu", device))
    for name in ("map_error", "coverage"):
        torch.testing.assert_close(there[name], here[name], rtol=1e-2, atol=1e-2)
    assert 0.1 < here["map_error"][-1].mean() < 2.0


@pytest.mark.parametrize("device", DEVICES)
def test_the_radar_agrees(device):
    world = room(30, 22, "jittered")
    free, obstacles = (torch.as_tensor(points) for points in (world.free, world.obstacles))
    for origin in free[:: len(free) // 7]:
        arguments = dict(radar_range=9.0, obstacle_radius=0.7)
        here = mk.visible_points(free, obstacles, origin, **arguments)
        there = mk.visible_points(*(tensor.to(device) for tensor in (free, obstacles, origin)), **arguments)
        assert there.device.type == device and 0 < here.sum() < len(free)
        assert (there.cpu() != here).sum() <= 1  # a point within 1e-6 of a threshold may fall either way


@pytest.mark.parametrize("device", DEVICES)
def test_branches_agree(device):
    """Worlds of what teams know, and what is played in them, on a GPU as on the CPU."""
    found = []
    for where in ("cpu", device):
        env = ExplorationEnv([room(30, 22)], num_envs=2, num_robots=3, device=where, seed=3, local_steps=5)
        state = POLICIES["lookahead"](env)(env.reset())
        found.append(state["agents", "action"].cpu())
    torch.testing.assert_close(found[0]["offset"], found[1]["offset"], rtol=1e-3, atol=2e-3)
    assert torch.equal(found[0]["region"], found[1]["region"])


class FixedActions(TensorDictModuleBase):
    """Takes the same actions on every device, and adds up the pictures that it is shown."""

    in_keys = [("agents", "observation", "map")]
    out_keys = [("agents", "action", "region"), ("agents", "action", "offset"), ("agents", "brightness")]

    def __init__(self, device: torch.device):
        super().__init__()
        self.device, self.generator = device, torch.Generator().manual_seed(1)

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        region = torch.randint(64, (4, 2), generator=self.generator)
        offset = torch.rand(4, 2, 2, generator=self.generator) * 2 - 1
        brightness = state["agents", "observation", "map"].sum((-2, -1), dtype=torch.int32)
        for key, value in zip(self.out_keys, (region, offset, brightness), strict=True):
            state[key] = value.to(self.device)
        return state


def collect(device: str) -> TensorDictBase:
    """Two batches of a Collector, one after the other in time: [4 envs, 8 steps]. On a GPU it has its own stream."""
    env = ExplorationEnv([room(30, 22)], num_envs=4, num_robots=2, device=device, seed=4, local_steps=5, macro_steps=5)
    collector = make_collector(env, FixedActions(env.device), steps=4)
    batches = [collector.next().cpu() for _ in range(2)]
    collector.shutdown()
    return torch.cat(batches, dim=1)


@pytest.mark.parametrize("device", DEVICES)
def test_a_collector_gathers_the_same(device):
    """Pictures are emptied, drawn and read in this order there, too: what was read is what the batch holds."""
    here, there = collect("cpu"), collect(device)
    assert here.shape == (4, 8) and here["next", "done"].any() and here["agents", "brightness"].sum(-1).min() > 0
    for batch in (here, there):
        pictures = batch["agents", "observation", "map"]
        assert torch.equal(pictures.sum((-2, -1), dtype=torch.int32), batch["agents", "brightness"])
    for key in (("agents", "observation", "pose"), ("next", "agents", "reward"), ("next", "info", "coverage")):
        torch.testing.assert_close(there[key], here[key], rtol=1e-3, atol=2e-3)
    seen = [batch["agents", "observation", "map"].int() for batch in (here, there)]
    assert ((seen[0] - seen[1]).abs() > 2).float().mean() < 1e-3
