"""Classical planners: they finish, and they are batched without a trace of the batch."""

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env

from maexp.agents.policies.classical import CLASSICAL, POLICIES, OraclePlanner
from maexp.envs import CommConfig, RobotConfig, make_map
from maexp.envs.targets.tracker import keyed_uniform
from maexp.kernels import visible_points


def play(env, name: str, steps: int):
    """Plays until all teams are done or `steps` decisions; returns the last coverage of each and the actions."""
    policy = POLICIES[name](env)
    td = env.reset()
    coverage, running, actions = torch.zeros(env.num_envs), torch.ones(env.num_envs, dtype=torch.bool), []
    for _ in range(steps):
        td = policy(td)
        actions.append((td[REGION].clone(), td[OFFSET].clone()))
        td = env.step(td)["next"]
        coverage = torch.where(running, td["info", "coverage"][:, 0], coverage)
        running &= ~td["done"][:, 0]
        if not running.any():
            break
    return coverage, actions


@pytest.mark.parametrize("name", CLASSICAL)
def test_reaches_95_percent_on_small_mazes(name):
    coverage, _ = play(make_env(8), name, 79)
    assert (coverage >= 0.95).float().mean() >= 7 / 8  # a team may lose all its robots; none did in 128


@pytest.mark.parametrize("name", POLICIES)
def test_env_by_env_the_same_in_any_batch_and_on_every_run(name):
    _, small = play(make_env(2), name, 3)
    _, large = play(make_env(5), name, 3)
    _, again = play(make_env(2), name, 3)
    for (region, offset), (region_l, offset_l), (region_a, offset_a) in zip(small, large, again, strict=True):
        assert torch.equal(region, region_l[:2]) and torch.equal(offset, offset_l[:2])
        assert torch.equal(region, region_a) and torch.equal(offset, offset_a)
        assert region.dtype == torch.int64 and offset.dtype == torch.float32
        assert region.min() >= 0 and region.max() < 64 and offset.abs().max() <= 1.0


@pytest.mark.parametrize("name", ["random", "nearest_frontier"])
def test_plain_dwa_and_limited_communication_and_one_robot(name):
    for settings in (
        {"planner": "dwa"},
        {"comm": CommConfig(range=12.0)},
        {"num_robots": 1},
        {"num_robots": 2, "robot": [RobotConfig(), RobotConfig(kind="differential", collision_threshold=0.6)]},
    ):
        coverage, _ = play(make_env(2, **settings), name, 4)
        assert (coverage > 0.1).all()


@pytest.mark.parametrize("name", [*CLASSICAL, "lookahead"])
def test_robots_that_are_not_heard_change_no_choice(name):
    """A robot alone chooses the same wherever the others are: it cannot know."""
    env = make_env(12, comm=CommConfig(range=5.0))
    env.step(POLICIES["nearest_frontier"](env)(env.reset()))
    state, found = env.simulation.tensors, []
    lonely = state["comm"][:, 0].sum(-1) == 1
    for flags in (state["known_free"], state["known_boundary"]):  # what it knows: they find targets where it is, too
        flags |= (flags & 1) * 0b110
    for aside in ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)):
        state["center"][:, 1:, :2] = state["center"][:, :1, :2] + torch.tensor(aside)
        td = POLICIES[name](env)(env.observe())
        found.append((td[REGION][lonely, 0], td[OFFSET][lonely, 0]))
    assert lonely.sum() >= 4
    for region, offset in found[1:]:
        assert torch.equal(region, found[0][0]) and torch.equal(offset, found[0][1])


def test_direct_controls_are_refused():
    with pytest.raises(ValueError, match="planner=direct"):
        POLICIES["voronoi"](make_env(1, planner="direct"))


def test_random_draws_are_even_and_change_with_every_key():
    env = make_env(64)
    env.reset()
    draw = keyed_uniform(env, 40)
    assert draw.shape == (64, 3, 40) and draw.unique().numel() > 0.99 * draw.numel()
    assert abs(draw.mean() - 0.5) < 0.01 and abs(draw.std() - 12**-0.5) < 0.01
    for key in ("seed", "env_id", "episode", "macro_step"):
        env.simulation.tensors[key] += 1
        assert (keyed_uniform(env, 40) != draw).float().mean() > 0.95
        env.simulation.tensors[key] -= 1
    assert torch.equal(keyed_uniform(env, 40), draw)


def splitmix(*parts: int) -> float:
    """A number in [0, 1) of a chain of splitmix64 (Steele et al. 2014)."""
    key, bits = 0, (1 << 64) - 1
    for part in parts:
        key = (key + part + 0x9E3779B97F4A7C15) & bits
        key = (key ^ (key >> 30)) * 0xBF58476D1CE4E5B9 & bits
        key = (key ^ (key >> 27)) * 0x94D049BB133111EB & bits
        key ^= key >> 31
    return (key >> 40) / 2**24


def test_random_draws_are_those_of_their_keys():
    env = make_env(4)
    env.reset()
    env.simulation.tensors["episode"].copy_(torch.tensor([0, -1, 2, 3]))
    state, draw = env.simulation.tensors, keyed_uniform(env, 2)
    for e, i, k in np.ndindex(4, 3, 2):
        keys = (int(state["seed"]), *(int(state[name][e]) for name in ("env_id", "episode", "macro_step")), 2 * i + k)
        assert draw[e, i, k] == splitmix(*keys)


def test_the_oracle_is_told_what_is_truly_to_be_seen():
    """Cells of free points in range and sight that nobody has seen: none beyond walls that are not known yet."""
    env = make_env(3, maps=[make_map("maze_small", 0)], num_robots=2)
    env.reset()
    oracle = OraclePlanner(env)
    told, guessed = oracle.look(), oracle.tracker.look()
    disc = np.pi * 10.0**2
    compared = 0
    for e in range(3):
        shot = env.snapshot(e)
        place, seen = shot["map"], shot["seen_free"].any(axis=0)
        for k in (guessed.travel[e, 0].isfinite()).nonzero().ravel().tolist():
            point = guessed.points[e, 0, k].numpy()
            origin = np.append(point, 0.0).astype(np.float32)
            visible = visible_points(
                torch.from_numpy(place.free),
                torch.from_numpy(place.obstacles),
                torch.from_numpy(origin),
                10.0,
                obstacle_radius=0.5**0.5,
            ).numpy()
            want = (visible & ~seen).sum() / disc
            assert told.gain[e, 0, k] == pytest.approx(want, abs=0.25 * want + 0.03)
            compared += want > 0.1
    assert compared > 5 and told.gain.max() < guessed.gain.max()
    assert told.gain.sum() < 0.8 * guessed.gain.sum()


def test_wavefront_holds_nothing_that_a_saved_state_lacks():
    """Paths live in scratch: an env that takes up a saved state drives on bit for bit, as under plain DWA."""
    env, other = make_env(3), make_env(3)
    policy, resumed = POLICIES["random"](env), POLICIES["random"](other)
    td = env.reset()
    for _ in range(3):
        td = env.step(policy(td))["next"]
    other.reset()
    other.load_state_dict(env.state_dict())
    td_other = td.clone()
    for _ in range(3):
        td, td_other = env.step(policy(td))["next"], other.step(resumed(td_other))["next"]
        for name in ("pose", "waypoint", "seen_free"):
            assert torch.equal(env.simulation.tensors[name], other.simulation.tensors[name])
    assert (env.simulation.tensors["pose"][..., 2] != 0).any()
