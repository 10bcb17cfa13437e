"""Messages that take room and time: the kernels against their definition, and what is counted as sent."""

import numpy as np
import pytest
import torch
from oracle import messages
from test_radio import links, make
from worlds import act, play_alike, room

from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, FaultsConfig, PlannerConfig
from maexp.envs.config import CELL_BYTES
from maexp.kernels import unpack_flags

pytestmark = pytest.mark.kernels

NEAR = dict(range=9.0, loss=0.2, base_station=True)


def points(env: ExplorationEnv, what: str, e: int, radios: int) -> list[list[int]]:
    """Points of each radio of an env, boundary points after the free ones of its map."""
    s, m = env.simulation.tensors, int(env.simulation.tensors["map_id"][e])
    counts = [len(env.maps[m].free), len(env.maps[m].boundary)]
    flags = [
        unpack_flags(s[f"{what}_{kind}"][e : e + 1, :, :count], radios)[0]
        for kind, count in zip(("free", "boundary"), counts, strict=True)
    ]
    return [flag.nonzero().ravel().tolist() for flag in torch.cat(flags, 1)]


def play(env: ExplorationEnv, steps: int, each) -> None:
    """Random goals; ``each(env)`` after the reset and after every local step."""
    generator = torch.Generator().manual_seed(7)
    env.set_step_hook(each)
    env.reset()
    for _ in range(steps):
        env.step(act(env, generator))


@pytest.mark.parametrize("robots", [4, 33])
@pytest.mark.parametrize("bandwidth, delay", [(400.0, 0.0), (2000.0, 0.5), (np.inf, 0.3), (1e9, 0.0)])
def test_what_arrives_is_that_of_the_definition(robots, bandwidth, delay):
    env = make(robots, envs=2, comm=CommConfig(**NEAR, bandwidth=bandwidth, delay=delay))
    cells = int(min(bandwidth * 0.1 / 4, 1e9))
    teams = [messages.Radios(robots + 1, cells, round(delay / 0.1)) for _ in range(2)]
    lagging = []

    def compare(env):
        s = env.simulation.tensors
        for e, (team, hears) in enumerate(zip(teams, links(env), strict=True)):
            team.step(hears, points(env, "seen", e, robots + 1))
            assert points(env, "known", e, robots + 1) == [sorted(known) for known in team.known]
            assert s["learned_count"][e].tolist() == [len(known) for known in team.known]
            assert [s["learned"][e, i, : len(known)].tolist() for i, known in enumerate(team.known)] == team.known
            assert int(s["cells_sent"][e]) == team.sent
            lagging.append(len(team.under_way))

    play(env, 4, compare)
    assert (max(lagging) > 0) == (delay > 0.0) and teams[0].sent > 50
    assert teams[0].sent <= 17 * cells * (robots + 1)


def test_without_limits_it_is_what_all_hear():
    """A wide and quick channel: the bits of known points, of who has told 95 % when, and of what was sent."""
    names, kept = ("known_free", "known_boundary", "known_weight", "cells_sent", "pose", "told_step"), []
    for comm in (CommConfig(**NEAR), CommConfig(**NEAR, bandwidth=1e9)):
        env, found = make(6, comm=comm), []
        play(env, 4, lambda env, found=found: found.append([env.simulation.tensors[name].clone() for name in names]))
        kept.append(found)
    for before, now in zip(*kept, strict=True):
        assert all(torch.equal(tensor, other) for tensor, other in zip(before, now, strict=True))
    assert (kept[0][-1][3] > 100).all()


def test_bytes_are_counted():
    """Four bytes for every point that a radio tells of; nothing where nobody hears anybody."""
    for reach, some in ((9.0, True), (0.0, False)):
        env = make(4, comm=CommConfig(range=reach))
        play(env, 2, lambda env: None)
        sent = env.simulation.tensors["cells_sent"]
        assert ((sent > 0) == some).all()
        assert torch.equal(env.observe()["info", "bytes_sent"][:, 0], CELL_BYTES * sent)


def test_an_episode_begins_without_messages():
    comm = CommConfig(**NEAR, bandwidth=2000.0, delay=0.5)
    env, fresh = make(comm=comm), make(comm=comm)
    play(env, 3, lambda env: None)
    assert env.simulation.tensors["underway"].any()
    for either in (env, fresh):
        either.set_episodes(torch.arange(3))
        either.reset()
    for name in ("known_free", "known_weight", "learned_count", "offered", "underway", "cells_sent"):
        assert torch.equal(env.simulation.tensors[name], fresh.simulation.tensors[name]), name


def test_they_repeat_in_any_batch_from_a_saved_state_and_in_a_copy():
    comm = CommConfig(**NEAR, bandwidth=1000.0, delay=0.4)
    names = ("pose", "known_free", "known_boundary", "offered", "underway", "cells_sent")
    assert len([*play_alike(make(3, 1, comm=comm), make(3, 3, comm=comm), 6, names)]) == 6


@pytest.mark.parametrize("name", ["cost_utility", "lookahead", "clairvoyant"])
def test_teams_explore_all_the_same(name):
    comm = CommConfig(**NEAR, bandwidth=500.0, delay=1.0, strategy="return_to_base", period=2)
    faults = FaultsConfig(probability=0.3, duration=1.0)
    env = make(3, 2, comm=comm, faults=faults, planner=PlannerConfig(name="wavefront"), local_steps=8)
    policy, td = POLICIES[name](env), env.reset()
    for _ in range(5):
        _, td = env.step_and_maybe_reset(policy(td))
    assert (td["info", "coverage"] > 0.1).all() and (td["info", "bytes_sent"] > 0).all()


def test_what_is_late_waits_for_no_link():
    """Two robots in reach for one step: what was sent then arrives after the delay, though they have parted."""
    env = make(2, 1, maps=[room(26, 19)], comm=CommConfig(range=4.0, delay=0.5), local_steps=1)
    env.set_starts([[4.0, 10.0, 0.0], [7.0, 10.0, 0.0]])
    env.reset()
    s, counts = env.simulation.tensors, []
    s["center"][0, 1, 0] = s["pose"][0, 1, 0] = 20.0
    for _ in range(7):
        counts.append(len(set(points(env, "known", 0, 2)[0]) - set(points(env, "seen", 0, 2)[0])))
        env.step(env.fake_tensordict().zero_())
    assert counts[:5] == [0] * 5 and counts[5] == counts[6] > 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(bandwidth=39.0), "comm.bandwidth=39.0 must be a number, 40 or more"),
        (dict(bandwidth=0.0), "comm.bandwidth=0.0"),
        (dict(bandwidth=float("nan")), "comm.bandwidth=nan"),
        (dict(delay=-0.1), "comm.delay=-0.1"),
        (dict(delay=26.0), "comm.delay=26.0 must be a number from 0 to 25"),
        (dict(delay=float("inf")), "comm.delay=inf"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        make(comm=CommConfig(**settings))
