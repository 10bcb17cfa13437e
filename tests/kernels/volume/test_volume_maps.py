"""Maps of robots and teams in volumes against sets of voxels: bits, counts, overlap, and what robots tell."""

import numpy as np
import pytest
import torch
from oracle import volume_maps
from voxel_worlds import map_of, place, run, volume_env

from maexp.envs import CommConfig, RadarConfig
from maexp.kernels.volume.mapping import forget_maps, merge_scans, share_maps
from maexp.kernels.volume.scan import scan

pytestmark = pytest.mark.kernels

ROW_SETS = {"seen": "seen_free", "known": "known_free", "known_surface": "known_surface"}
TEAM_SETS = {"team": "team_free", "team_surface": "team_surface", "twice": "twice_free"}


def voxels(env, name: str, e: int, i: int | None = None) -> set:
    nx, ny, nz = map_of(env, e).shape
    words = env.simulation.tensors[name][e]
    words = (words if i is None else words[i]).numpy()
    assert not words[nx * ny :].any()
    return volume_maps.bits(words[: nx * ny].reshape(nx, ny, -1), 32 * words.shape[-1])


def team_of(env, e: int) -> dict:
    rows = {key: env.simulation.tensors[name].shape[1] for key, name in ROW_SETS.items()}
    found = {key: [voxels(env, name, e, i) for i in range(rows[key])] for key, name in ROW_SETS.items()}
    return found | {key: voxels(env, name, e) for key, name in TEAM_SETS.items()}


def counted_of(env, e: int) -> tuple[set, set]:
    number = int(env.simulation.tensors["map_id"][e])
    grids = env.bank.seeable[number], env.bank.surface[number]
    return tuple({tuple(v) for v in np.argwhere(g).tolist()} for g in grids)


def count_of(env, e: int, name: str):
    return env.simulation.tensors[name][e].tolist()


@pytest.mark.parametrize("limited", [False, True])
def test_merging_and_counting(limited):
    comm = CommConfig(range=2.0) if limited else CommConfig()
    radars = [RadarConfig(range=1.5, vertical_fov=1.57, every=every) for every in (1, 2, 1)]
    env = volume_env(2, 3, radar=radars, comm=comm)
    s, rng = env.simulation.tensors, np.random.default_rng(1)
    active = env.simulation.shards[0].view.active
    weights = [[0] * 3] * 2
    for step in range(3):
        place(env, rng, spread=1.0)
        s["local_step"].fill_(step)
        before = [team_of(env, e) for e in range(2)]
        if limited:
            weights = [count_of(env, e, "known_weight") for e in range(2)]
        run(env, scan, active, ahead=1)
        free, solid = (
            [[voxels(env, n, e, i) for i in range(3)] for e in range(2)] for n in ("visible_free", "visible_surface")
        )
        assert all(bool(free[e][1]) == ((step + 1) % 2 == 0) for e in range(2))
        run(env, merge_scans, active, ahead=1)
        assert not s["visible_free"].any() and not s["visible_surface"].any()
        for e in range(2):
            counted, surface = counted_of(env, e)
            team = before[e]
            old = [set(known) for known in team["known"]]
            discovered, overlap = volume_maps.merge(team, free[e], solid[e], counted, surface, limited)
            now = team_of(env, e)
            for key in ROW_SETS.keys() | TEAM_SETS.keys():
                assert now[key] == team[key], key
            assert count_of(env, e, "discovered") == discovered and sum(discovered)
            assert count_of(env, e, "overlap") == overlap
            for name in ("covered", "covered_surface", "shared"):
                assert count_of(env, e, name) == team[name], name
            if limited:
                heard = [len((now["known"][i] - old[i]) & counted) for i in range(3)]
                assert count_of(env, e, "known_weight") == [a + b for a, b in zip(weights[e], heard, strict=True)]
    assert any(count_of(env, e, "shared") for e in range(2))


def test_all_that_a_reset_sees_is_merged():
    """The sensor of a reset looks farther than one of a metre."""
    env = volume_env(3, 2, radar=RadarConfig(range=0.75, vertical_fov=1.57))
    s = env.simulation.tensors
    assert not s["visible_free"].any() and not s["visible_surface"].any()
    for e in range(3):
        assert count_of(env, e, "covered") > 100


@pytest.mark.parametrize("sight", [False, True])
def test_who_hears_whom_and_what_they_tell(sight):
    env = volume_env(3, 4, comm=CommConfig(range=2.5, line_of_sight=sight), radar=RadarConfig(range=1.5))
    s, rng = env.simulation.tensors, np.random.default_rng(2)
    active = env.simulation.shards[0].view.active
    heard, silent, hidden = 0, 0, 0
    for _ in range(4):
        place(env, rng, spread=3.0)
        s["failed"].copy_(torch.from_numpy(rng.random((3, 4)) < 0.1))
        run(env, scan, active, ahead=0)
        run(env, merge_scans, active, ahead=0)
        before = [team_of(env, e) for e in range(3)]
        weight, sent = s["known_weight"].clone(), s["cells_sent"].clone()
        run(env, share_maps, active)
        for e in range(3):
            m = map_of(env, e)
            points = (s["center"][e].double().numpy() - m.origin) / m.resolution
            want = volume_maps.hears(m.occupied, points, s["failed"][e].tolist(), 2.5, sight, m.resolution)
            got = s["comm"][e].tolist()
            for i in range(4):
                for j in range(4):
                    if want[i][j] is not None:
                        assert got[i][j] == want[i][j], (e, i, j)
                    heard, silent = heard + got[i][j], silent + (not got[i][j])
                    far = np.linalg.norm(points[i] - points[j]) * m.resolution > 2.5
                    hidden += not got[i][j] and not far and not s["failed"][e, [i, j]].any()
            assert s["hears"][e, :, 0].tolist() == [sum(1 << j for j in range(4) if got[i][j]) for i in range(4)]
            counted, _ = counted_of(env, e)
            known, solid, news, count = volume_maps.share(before[e]["known"], before[e]["known_surface"], got, counted)
            now = team_of(env, e)
            assert now["known"] == known and now["known_surface"] == solid
            assert (s["known_weight"][e] - weight[e]).tolist() == news
            assert int(s["cells_sent"][e] - sent[e]) == count
    assert heard > 50 and silent > 20 and (hidden > 0) == sight


def test_losses_are_drawn_for_both_ways_at_once():
    env = volume_env(4, 3, comm=CommConfig(range=100.0, loss=0.4))
    s, found = env.simulation.tensors, []
    for step in range(12):
        s["local_step"].fill_(step)
        run(env, share_maps, env.simulation.shards[0].view.active)
        assert torch.equal(s["comm"], s["comm"].transpose(1, 2))
        found.append(s["comm"][:, [0, 0, 1], [1, 2, 2]].clone())
    share = torch.stack(found).float().mean()
    assert 0.5 < share < 0.7


def test_a_reset_forgets():
    env = volume_env(3, 2)
    s = env.simulation.tensors
    s["mask"].copy_(torch.tensor([1, 0, 1]))
    run(env, forget_maps)
    for name in (*ROW_SETS.values(), *TEAM_SETS.values()):
        assert [bool(words.any()) for words in s[name]] == [
            False,
            name != "twice_free" or bool(s[name][1].any()),
            False,
        ]
