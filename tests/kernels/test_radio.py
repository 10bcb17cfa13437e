"""Radios against the oracle: received power, links behind walls, who knows how much, who is connected."""

import numpy as np
import pytest
import torch
from oracle import radio
from worlds import act, room

import maexp.kernels as mk
from maexp.envs import CommConfig, ExplorationEnv, PlannerConfig
from maexp.envs.maps.nav_grid import build_nav_grid, open_cells
from maexp.kernels import unpack_flags
from maexp.kernels.merge import LOSS_KEY
from maexp.kernels.radio import FADING_KEY

pytestmark = pytest.mark.kernels

SIGNAL = dict(signal=True, power=-18.0, cell=0.05)


@pytest.mark.parametrize("edge, cell", [(1.0, 1.0), (0.4, 0.05), (0.1, 0.35)])
def test_received_power_agrees_with_the_oracle(edge, cell):
    rng = np.random.default_rng(3)
    free = rng.random((40, 60)) < 0.9
    a, b = rng.uniform((-2.0, -2.0), (62.0, 42.0), (2, 400, 2)) * edge
    a, b = a.astype(np.float32), b.astype(np.float32)
    got = mk.received_power(torch.from_numpy(free), torch.from_numpy(a), torch.from_numpy(b), edge, cell, -15.0)
    back = mk.received_power(torch.from_numpy(free), torch.from_numpy(b), torch.from_numpy(a), edge, cell, -15.0)
    wanted = [radio.power(free, edge, p, q, cell, -15.0) for p, q in zip(a, b, strict=True)]
    sure = np.array([certain for _, certain in wanted])
    values = np.array([value for value, _ in wanted])
    assert sure.mean() > 0.8 and np.ptp(values) > 20.0
    np.testing.assert_allclose(got.numpy()[sure], values[sure], atol=2e-3)
    np.testing.assert_allclose(back.numpy()[sure], values[sure], atol=2e-3)


@pytest.mark.parametrize("edge", [1.0, 0.25, 0.1])
def test_lines_between_middles_of_cells_count_the_same_both_ways(edge):
    """Along them points lie on edges of cells."""
    rng = np.random.default_rng(5)
    free = rng.random((40, 60)) < 0.9
    a, b = ((rng.integers(0, (60, 40), (2, 600, 2)) + 0.5) * edge).astype(np.float32)
    b[:200, 1], b[200:400, 0] = a[:200, 1], a[200:400, 0]  # along rows and columns, too
    ground, there, back = torch.from_numpy(free), torch.from_numpy(a), torch.from_numpy(b)
    got = mk.received_power(ground, there, back, edge, edge)
    assert torch.equal(got, mk.received_power(ground, back, there, edge, edge))
    wanted = [radio.power(free, edge, p, q, edge) for p, q in zip(a, b, strict=True)]
    sure = np.array([certain for _, certain in wanted])
    assert sure.mean() > 0.95
    np.testing.assert_allclose(got.numpy()[sure], np.array([value for value, _ in wanted])[sure], atol=2e-3)


def test_numbers_of_ir2():
    """One blocked cell costs nothing, two 12 dB and three the link; in the open it ends after 312 cells."""
    free = torch.ones(3, 400, dtype=torch.bool)
    here, far = torch.tensor([[0.5, 1.5]]), torch.tensor([[399.5, 1.5]])

    def power(x: float, walls: int = 0) -> float:
        ground = free.clone()
        ground[:, 2 : 2 + walls] = False
        return float(mk.received_power(ground, here, torch.tensor([[x, 1.5]])))

    assert power(30.5) == power(10.5) == power(10.5, walls=1) == -51.0
    assert power(10.5, walls=2) == pytest.approx(-63.041, abs=1e-3) and power(10.5, walls=3) < -70.0
    assert power(312.0) > -70.0 > power(313.5)
    assert float(mk.received_power(free, here, far)) == pytest.approx(-51.0 - 20.0 * np.log10(399.0 / 35.0), abs=1e-3)


@pytest.mark.parametrize(
    "bad",
    [
        dict(free=torch.ones(4)),
        dict(senders=torch.zeros(2, 3)),
        dict(senders=torch.full((2, 2), torch.nan)),
        dict(cell=0.0),
    ],
)
def test_misfits_are_refused(bad):
    given = dict(free=torch.ones(4, 4, dtype=torch.bool), senders=torch.zeros(2, 2), receivers=torch.zeros(2, 2))
    with pytest.raises(ValueError, match=next(iter(bad))):
        mk.received_power(**given | bad)


def make(robots: int = 5, envs: int = 3, **settings) -> ExplorationEnv:
    settings = {"comm": CommConfig(**SIGNAL), "planner": PlannerConfig(name="dwa"), "num_threads": 1} | settings
    settings = {"maps": [room(26, 19), room(24, 21, "rotated")], "local_steps": 4, "seed": 5} | settings
    return ExplorationEnv(num_envs=envs, num_robots=robots, **settings)


def links(env: ExplorationEnv) -> np.ndarray:
    """Whom every radio hears, bool [E, U, U]."""
    words = env.simulation.tensors["hears"]
    return unpack_flags(words.transpose(1, 2).contiguous(), words.shape[1]).transpose(1, 2).numpy()


@pytest.mark.parametrize("noise", [0.0, 13.0])
def test_links_are_those_of_the_oracle(noise):
    """Behind true walls, with the base station as one more radio, both ways alike; fading by its key."""
    env = make(8, comm=CommConfig(**SIGNAL, noise=noise, base_station=True))
    generator, td, checked, heard = torch.Generator().manual_seed(1), env.reset(), 0, 0
    s = env.simulation.tensors
    for step in (0, 3, 7):  # the local step that was under way: that of the reset, and the last one of two macro steps
        found = links(env)
        assert np.array_equal(found, found.transpose(0, 2, 1)) and found.diagonal(0, 1, 2).all()
        assert np.array_equal(found[:, :8, :8], s["comm"].numpy())
        for e in range(env.num_envs):
            world = env.maps[int(s["map_id"][e])]
            grid = build_nav_grid(world)
            free = open_cells(grid).reshape(grid.height, grid.width)
            at = np.concatenate([s["center"][e, :, :2].numpy(), s["base"][e : e + 1, :2].numpy()]) - grid.origin
            for i in range(9):
                for j in range(i + 1, 9):
                    key = FADING_KEY + 2 * (9 * i + j)
                    fading = [noise * radio.uniform(5, e, int(s["episode"][e]), step, key + k) for k in range(2)]
                    power, sure = radio.power(free, grid.cell, at[i], at[j], 0.05, -18.0, fading)
                    if sure and abs(power + 70.0) > 1e-2:
                        assert found[e, i, j] == (power > -70.0), (e, i, j, power)
                        checked, heard = checked + 1, heard + found[e, i, j]
        td = env.step(act(env, generator).update(td.select("done", "terminated")))["next"]
    assert checked > 200 and 0.1 * checked < heard < 0.9 * checked


def test_messages_are_lost_by_their_key():
    """Both ways alike, a share of the pairs in reach in every local step."""
    env, lost = make(6, comm=CommConfig(loss=0.3, base_station=True)), []

    def compare(env):
        s = env.simulation.tensors
        step = max(int(s["local_step"][0]) - 1, 0)
        for e, found in enumerate(links(env)):
            draw = {
                (i, j): radio.uniform(5, e, int(s["episode"][e]), step, LOSS_KEY + 7 * i + j)
                for i in range(7)
                for j in range(i + 1, 7)
            }
            wanted = [[i == j or draw[min(i, j), max(i, j)] >= 0.3 for j in range(7)] for i in range(7)]
            assert found.tolist() == wanted
            lost.append(1.0 - (found.sum() - 7) / 42)

    env.set_step_hook(compare)
    play(env, 3)
    assert len(lost) == 39 and 0.25 < np.mean(lost) < 0.35


def play(env: ExplorationEnv, steps: int):
    """Tensordicts after each macro step of random actions."""
    generator = torch.Generator().manual_seed(7)
    env.reset()
    return [env.step(act(env, generator))["next"] for _ in range(steps)]


@pytest.mark.parametrize("robots", [1, 5, 32])
def test_what_radios_know_is_counted(robots):
    """The weights beside the flags: what each radio knows, over time, also where the base is the first of a word."""
    env = make(robots, envs=2, comm=CommConfig(**SIGNAL, base_station=True))
    s, sums, steps = env.simulation.tensors, {}, []

    def note(env):
        known = unpack_flags(s["known_free"], robots + 1)
        weight = torch.stack([(known[e].long() * padded(env, e, known.shape[-1])).sum(-1) for e in range(2)])
        assert torch.equal(weight, s["known_weight"].long())
        if int(s["local_step"][0]):
            sums["base"] = sums.get("base", 0) + weight[:, robots]
            sums["worst"] = sums.get("worst", 0) + weight[:, :robots].amin(1)
        steps.append(weight)

    env.set_step_hook(note)
    last = play(env, 3)[-1]["info"]
    assert torch.equal(sums["base"], s["base_sum"]) and torch.equal(sums["worst"], s["worst_sum"])
    total = env.simulation.map_tensors["total_weight"][s["map_id"].long()]
    torch.testing.assert_close(last["base_coverage"][:, 0], steps[-1][:, robots] / total)
    left = env.settings.episode_steps - 12
    auc = (sums["worst"] + left * steps[-1][:, :robots].amin(1)) / (env.settings.episode_steps * total)
    torch.testing.assert_close(last["worst_coverage_auc"][:, 0], auc, rtol=1e-5, atol=1e-6)
    assert (last["base_coverage"] < last["coverage"]).any() or robots != 5


def padded(env: ExplorationEnv, e: int, count: int) -> torch.Tensor:
    """Weights of the free points of an env's map, int64 [count], 0 beyond them."""
    maps, m = env.simulation.map_tensors, int(env.simulation.tensors["map_id"][e])
    first, last = (int(maps["free_begin"][m + k]) for k in range(2))
    return torch.nn.functional.pad(maps["free_weight"][first:last].long(), (0, count - (last - first)))


@pytest.mark.parametrize("base", [False, True])
def test_who_is_connected(base):
    env = make(6, comm=CommConfig(range=6.0, base_station=base))
    counts = torch.zeros(3, 6)

    def note(env):
        if int(env.simulation.tensors["local_step"][0]):
            for e, found in enumerate(links(env)):
                heard = [[j for j in range(len(found)) if row[j]] for row in found]
                reached = radio.connected_with(heard, 6) if base else {i for i in range(6) if len(heard[i]) > 1}
                counts[e, sorted(reached - {6})] += 1

    env.set_step_hook(note)
    last = play(env, 4)[-1]["info"]
    torch.testing.assert_close(last["connected"], counts / 16)
    assert 0 < counts.sum() < 16 * 18


def test_news_travels_one_hop_a_step():
    """A chain of radios tells the base station what its far end sees, one local step a hop."""
    env = make(3, envs=1, maps=[room(26, 19)], comm=CommConfig(range=8.0, base_station=(1.0, 10.0)), local_steps=1)
    env.set_starts([[4.0, 10.0, 0.0], [11.0, 10.0, 0.0], [18.0, 10.0, 0.0]])
    env.reset()
    s, seen = env.simulation.tensors, []
    for _ in range(4):
        known, own = unpack_flags(s["known_free"], 4)[0], unpack_flags(s["seen_free"], 3)[0]
        seen.append([bool((known[k] & own[2] & ~own[1] & ~own[0]).any()) for k in (1, 0, 3)])
        env.step(env.fake_tensordict().zero_())
    assert seen == [[True, False, False], [True, True, False], [True, True, True], [True, True, True]]


@pytest.mark.parametrize("done", ["base", "everyone"])
def test_who_ends_an_episode(done):
    """A team that has seen enough goes on until those know it who count."""
    far = CommConfig(range=4.0, base_station=(2.0, 10.0))
    env = make(2, envs=1, maps=[room(26, 19)], comm=far, success_coverage=0.2, done=done, macro_steps=30)
    env.set_starts([[3.0, 10.0, 0.0], [24.0, 10.0, 0.0]])
    env.reset()
    s = env.simulation.tensors
    out = env.step(env.fake_tensordict().zero_())["next"]
    assert out["info", "coverage"] > 0.2 > out["info", "counted_coverage"] and not out["done"].any()
    known = {"base": out["info"].get("base_coverage"), "everyone": out["info", "worst_coverage"]}[done]
    assert torch.equal(out["info", "counted_coverage"], known)
    s["center"][0, 1] = s["pose"][0, 1] = 0.0  # robot 1 comes home
    for name in ("center", "pose"):
        s[name][0, 1, :2] = torch.tensor([5.5, 10.0])
    out = env.step(env.fake_tensordict().zero_())["next"]
    assert not out["info", "collided"].any()
    assert out["terminated"].all() and out["info", "counted_coverage"] >= 0.2


def test_the_base_station_stands_where_it_is_asked_to():
    place = make(maps=[room(26, 19)], comm=CommConfig(base_station=(2.0, 3.0)))
    place.reset()
    assert (place.simulation.tensors["base"] == torch.tensor([2.0, 3.0, 0.0])).all()
    start = make(comm=CommConfig(base_station=True))
    start.reset()
    assert torch.equal(start.simulation.tensors["base"], start.simulation.tensors["center"][:, 0])
