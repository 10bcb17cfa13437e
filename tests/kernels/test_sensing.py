"""Radars that miss returns or give false ones: the kernel against its definition, and what robots make of it."""

import numpy as np
import pytest
import torch
from oracle import radar, sensing
from worlds import act, play_alike, room

from maexp.agents.policies import POLICIES
from maexp.agents.policies.remote.numpy_policy import TeamSight
from maexp.envs import CommConfig, ExplorationEnv, FaultsConfig, PlannerConfig, RadarConfig
from maexp.kernels import unpack_flags
from maexp.kernels.constants import OBSTACLE
from maexp.kernels.types import VIEWER_NOW

pytestmark = pytest.mark.kernels

WORLDS = [room(24, 17), room(19, 22, "rotated", spacing=0.8)]
RADARS = [
    RadarConfig(range=6.0, missed=0.3, noise=0.3, evidence=2),
    RadarConfig(range=7.0, missed=0.6, false_alarm=0.2),
    RadarConfig(range=5.0, evidence=3, false_alarm=0.3),
]
PERFECT = [RadarConfig(range=radar.range) for radar in RADARS]


def make(radars, envs: int = 2, **settings) -> ExplorationEnv:
    settings = {"local_steps": 3, "macro_steps": 12, "num_threads": 1, "seed": 4, "success_coverage": 1.0} | settings
    return ExplorationEnv(WORLDS, envs, len(radars), radar=list(radars), **settings)


def drive(env: ExplorationEnv, steps: int, each=None) -> None:
    """Random controls or goals from a reset on; ``each(env)`` after every scan."""
    generator = torch.Generator().manual_seed(2)
    if each is not None:
        env.set_step_hook(each)
    env.reset()
    for _ in range(steps):
        env.step(act(env, generator))


def scans(radars, steps: int = 4) -> list:
    """An env, and its tensors after every scan, controls given: robots drive alike whatever they know."""
    found = []
    keep = (
        "visible",
        "visible_count",
        "seen_free",
        "seen_boundary",
        "false_walls",
        "viewers_free",
        "viewers_boundary",
        "center",
        "covered",
        "map_id",
        "episode",
        "overlap",
        "discovered",
    )
    env = make(radars, planner=PlannerConfig(name="direct"))
    drive(env, steps, lambda env: found.append({name: env.simulation.tensors[name].clone() for name in keep}))
    return [env, *found]


def bits(words: torch.Tensor, robot: int, count: int) -> set[int]:
    return set(unpack_flags(words[None, :, :count], 3)[0, robot].nonzero().ravel().tolist())


def test_what_is_seen_is_that_of_the_definition():
    """Every scan of two teams on two maps: returns, evidence, what is known, who has seen it and who sees it now."""
    env, *true = scans(PERFECT)
    _, *found = scans(RADARS)
    maps, dropped, waited, walled = env.simulation.map_tensors, 0, 0, 0
    for e in range(2):
        m = int(true[0]["map_id"][e])
        free, boundary = (
            maps[name][int(maps[f"{name}_begin"][m]) : int(maps[f"{name}_begin"][m + 1])].double().numpy()
            for name in ("free", "boundary")
        )
        spacing, points = env.maps[m].resolution, len(free) + len(boundary)
        lookers = [
            sensing.Looker(
                4,
                e,
                int(true[0]["episode"][e]),
                i,
                points,
                sensing.chance(radar.missed, radar.noise, spacing),
                radar.evidence,
                radar.false_alarm,
                len(free),
                len(RADARS),
            )
            for i, radar in enumerate(RADARS)
        ]
        for step, (before, now) in enumerate(zip(true, found, strict=True)):
            assert torch.equal(before["center"], now["center"]), "robots drive alike"
            seen = []
            for i, looker in enumerate(lookers):
                view = before["visible"][e, i, : before["visible_count"][e, i]].tolist()
                flags = np.zeros(len(free), bool)
                flags[view] = True
                walls, clear = radar.seen_boundary(
                    boundary, free, flags, before["center"][e, i].double().numpy(), RADARS[i].range, 1.5 * spacing
                )
                assert clear.all()
                shown = looker.look([*view, *(len(free) + walls.nonzero()[0]).tolist()], step)
                listed = now["visible"][e, i, : now["visible_count"][e, i]].tolist()
                assert len(listed) == len(set(listed)) and set(listed) == {j for j in shown if j < len(free)}
                assert bits(now["seen_free"][e], i, len(free)) == {j for j in looker.known if j < len(free)}
                known = {j - len(free) for j in looker.known if j >= len(free)}
                assert bits(now["seen_boundary"][e], i, len(boundary)) == known
                dropped += len(view) - len(listed)
                waited += sum(count > 0 and j not in looker.known for j, count in enumerate(looker.returns))
                seen.append(set(listed))
            known = [sum(j in looker.known for looker in lookers) for j in range(points)]
            for i, looker in enumerate(lookers):
                walls = {j for j in looker.walls if not known[j]}
                assert bits(now["false_walls"][e], i, len(free)) == walls
                walled += len(walls)
            assert now["viewers_free"][e, 0, : len(free)].tolist() == known[: len(free)]
            assert now["viewers_boundary"][e, 0, : len(boundary)].tolist() == known[len(free) :]
            assert int(now["covered"][e]) == sum(map(bool, known[: len(free)]))
            if step:
                for i, mine in enumerate(seen):
                    others = set().union(*(points for k, points in enumerate(seen) if k != i))
                    assert int(now["overlap"][e, i]) == len(mine & others)
    assert dropped > 1000 and waited > 100 and walled > 30


def test_the_share_of_returns():
    """Half of them within half a spacing, and a third missed."""
    assert sensing.chance(0.0, 0.5 / 0.6744898, 1.0) == pytest.approx(0.5, abs=1e-6)
    radars = [RadarConfig(range=6.0, missed=1 / 3, noise=0.5 / 0.6744898)] * 3
    _, *true = scans([RadarConfig(range=6.0)] * 3)
    _, *found = scans(radars)
    e = int((true[0]["map_id"] == 0).nonzero()[0])
    counts = [sum(int(step["visible_count"][e].sum()) for step in each) for each in (true, found)]
    assert counts[1] / counts[0] == pytest.approx(1 / 3, abs=0.02)


def test_no_view_is_left_over():
    for radars in (RADARS, [RadarConfig(range=6.0, missed=0.9, evidence=5)] * 3):
        env = make(radars)
        drive(env, 4, lambda env: None)
        assert int(env.simulation.tensors["viewers_free"].max()) < VIEWER_NOW


def test_episodes_start_without_evidence():
    """An env that starts anew knows what a new one knows."""
    env = make(RADARS)
    drive(env, 4)
    env.set_episodes(torch.tensor([8, 9]))
    env.reset()
    fresh = make(RADARS)
    fresh.set_episodes(torch.tensor([8, 9]))
    fresh.reset()
    for name in ("evidence_free", "evidence_boundary", "seen_free", "seen_boundary", "false_walls"):
        assert torch.equal(env.simulation.tensors[name], fresh.simulation.tensors[name]), name
    assert env.simulation.tensors["evidence_free"].any()


def test_they_repeat_in_any_batch_from_a_saved_state_and_in_a_copy():
    names = ("pose", "seen_free", "evidence_free", "evidence_boundary", "false_walls")
    assert len([*play_alike(make(RADARS, envs=1), make(RADARS, envs=3), 6, names)]) == 6


@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=6.0)])
@pytest.mark.parametrize("name", ["cost_utility", "lookahead", "clairvoyant"])
def test_teams_explore_all_the_same(name, comm):
    """Planners, and worlds that they imagine, with failures and radios that do not reach."""
    env = make(RADARS, comm=comm, faults=FaultsConfig(probability=0.3, duration=1.0), local_steps=8)
    policy, td = POLICIES[name](env), env.reset()
    first = td["info", "coverage"].clone()
    for _ in range(6):
        _, td = env.step_and_maybe_reset(policy(td))
    assert (td["info", "coverage"] > 0.1).all() and first.max() < td["info", "coverage"].max()


@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=6.0)])
def test_false_walls_stand_in_the_grids_until_they_are_found_out(comm):
    """A robot's own, or those of all where all know the same; and none that it knows to be free ground."""
    env = make([RadarConfig(range=6.0, missed=0.8, false_alarm=0.3)] * 3, comm=comm, local_steps=1)
    sight, s, cells = TeamSight(env), env.simulation.tensors, env.simulation.nav_grids.free_cell.numpy()
    begin, counts, gone = env.simulation.map_tensors["free_begin"].tolist(), [], 0
    generator, before = torch.Generator().manual_seed(2), [set(), set()]
    env.reset()
    for _ in range(12):
        env.step(act(env, generator))
        sight.look()
        found = sight.known_grids.known.numpy()
        for e in range(2):
            m, rows = int(s["map_id"][e]), 1 if sight.rows == 1 else 3
            count = begin[m + 1] - begin[m]
            free = known_to(env, e, count)
            own = [bits(s["false_walls"][e], i, count) for i in range(3)]
            walls = [set.union(*own)] if rows == 1 else own
            for row in range(rows):
                assert not walls[row] & free[row]
                states = found[e * rows + row, cells[begin[m] + np.array(sorted(walls[row]), int)]]
                assert (states == OBSTACLE).all()
            counts.append(len(walls[0]))
            gone += len(before[e] - walls[0])
            before[e] = walls[0]
    assert max(counts) > 5 and gone > 20


def known_to(env: ExplorationEnv, e: int, count: int) -> list[set[int]]:
    """Free points that each robot knows, or all where all know the same."""
    if env.settings.limited:
        return [bits(env.simulation.tensors["known_free"][e], i, count) for i in range(3)]
    return [set(env.simulation.tensors["viewers_free"][e, 0, :count].nonzero().ravel().tolist())]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(missed=1.0), "radar.missed=1.0 must be a number from 0 to 0.99"),
        (dict(missed=-0.1), "radar.missed=-0.1"),
        (dict(noise=float("nan")), "radar.noise=nan"),
        (dict(noise=50.0), "radar.noise=50 m leaves fewer than one return in 100 on map"),
        (dict(false_alarm=0.5), "radar.false_alarm=0.5 must be a number from 0 to 0.4"),
        (dict(false_alarm=-0.1), "radar.false_alarm=-0.1"),
        (dict(evidence=0), "radar.evidence=0 must be"),
        (dict(evidence=101), "radar.evidence=101 must be a whole number from 1 to 100"),
        (dict(evidence=1.5), "radar.evidence=1.5"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        make([RadarConfig(**settings)] * 3)
