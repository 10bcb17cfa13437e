"""The tree of rays and the scan of volumes against exact lines of sight."""

import numpy as np
import pytest
from oracle import volume_sight
from voxel_worlds import grid, map_of, place, run, volume_env

from maexp.envs import RadarConfig
from maexp.envs.volume.map import VoxelMap, unpack_words
from maexp.kernels.volume.rays import TOUCH, grow_trees
from maexp.kernels.volume.scan import scan
from maexp.kernels.volume.seeable import mark_seeable

pytestmark = pytest.mark.kernels

MISSED, FALSE = 0.04, 0.006
MORE_MISSED = 0.05  # at the edges of narrow views, which count for more of them
LIDAR, CAMERA = dict(range=4.0, vertical_fov=1.5708), dict(range=4.0, fov=1.5708, vertical_fov=1.0472)


def look(env) -> None:
    tensors = env.simulation.tensors
    for name in ("visible_free", "visible_surface"):
        tensors[name].zero_()
    tensors["local_step"].zero_()
    run(env, scan, env.simulation.shards[0].view.active, ahead=1)


def seen_by(env, e, i) -> np.ndarray:
    return grid(env, "visible_free", e, i), grid(env, "visible_surface", e, i)


def start_of(env, e, i) -> np.ndarray:
    m = map_of(env, e)
    return (env.simulation.tensors["center"][e, i].double().numpy() - m.origin) / m.resolution


def compare(env, radar, rounds: int = 1) -> tuple[float, float]:
    """Shares of missed and of false voxels."""
    rng = np.random.default_rng(3)
    missed = visible = false = marked = 0
    side = radar.get("fov")
    for _ in range(rounds):
        place(env, rng)
        look(env)
        s = env.simulation.tensors
        for e in range(s["center"].shape[0]):
            m = map_of(env, e)
            for i in range(s["center"].shape[1]):
                free, solid = seen_by(env, e, i)
                assert not (free & ~m.free).any() and not (solid & ~m.occupied).any()
                start, ahead = start_of(env, e, i), float(s["pose"][e, i, 3])
                reach = radar["range"] / m.resolution
                must, may = volume_sight.sights(m.free, m.occupied, start, reach, radar["vertical_fov"], ahead, side)
                seen = free | solid
                nearest = np.linalg.norm(np.maximum(np.abs(np.argwhere(seen) + 0.5 - start) - 0.5, 0.0), axis=1)
                assert nearest.max() <= reach + 0.5  # rays start in the middle of an eighth
                offset = np.argwhere(seen) + 0.5 - start
                wide = volume_sight.in_view(offset, radar["vertical_fov"], ahead, side, within=-1.5)
                assert (wide | (np.linalg.norm(offset, axis=1) <= TOUCH + 1.0)).all()
                missed, visible = missed + int((must & ~seen).sum()), visible + int(must.sum())
                false, marked = false + int((seen & ~may).sum()), marked + int(seen.sum())
    return missed / visible, false / marked


@pytest.mark.parametrize("radar", [LIDAR, CAMERA], ids=["lidar", "camera"])
def test_sees_what_is_in_sight(radar):
    missed, false = compare(volume_env(2, 2, radar=RadarConfig(every=1, **radar)), radar)
    print(f"missed {100 * missed:.2f} %, false {100 * false:.2f} %")
    assert missed <= (MORE_MISSED if "fov" in radar else MISSED) and false <= FALSE


@pytest.mark.parametrize("reach, up", [(5.0, np.pi), (7.3, 0.9)])
def test_trees_hold_the_voxels_of_their_rays(reach, up):
    trees = grow_trees(reach, up)
    assert trees.begin[0] == 0 and trees.begin[-1] == len(trees.skip) == len(trees.offset)
    for octant in range(8):
        first, end = trees.begin[octant : octant + 2]
        offset, skip = trees.offset[first:end], trees.skip[first:end]
        assert (offset[0] == 0).all() and skip[0] == end
        assert (skip > np.arange(first, end)).all() and (skip <= end).all()
        start = np.array([octant & 1, octant >> 1 & 1, octant >> 2]) * 0.5 + 0.25
        gap = np.maximum(np.abs(offset + 0.5 - start) - 0.5, 0.0)
        assert np.linalg.norm(gap, axis=1).max() <= max(reach, TOUCH)
        inner = [n for n in range(end - first - 1) if skip[n] > first + n + 1]
        for n in inner:  # the next entry continues the rays through this one
            assert np.abs(offset[n + 1] - offset[n]).sum() == 1


def test_a_wall_hides_all_behind_it():
    """From either side of a wall with a window."""
    free = np.ones((21, 16, 35), dtype=bool)
    free[11] = False
    free[11, 7:9, 15:18] = True
    m = VoxelMap(free, ~free, 0.25, name="window", scenario="cave")
    env = volume_env(1, 2, maps=[m], radar=RadarConfig(range=3.0, vertical_fov=2.0, every=1))
    s = env.simulation.tensors
    s["center"][0] = (s["center"].new_tensor([[9.3, 8.1, 16.4], [15.2, 3.3, 20.6]])) * 0.25
    look(env)
    assert grid(env, "visible_free", 0, 0)[12:].any()
    for i in range(2):
        free, solid = seen_by(env, 0, i)
        must, may = volume_sight.sights(m.free, m.occupied, start_of(env, 0, i), 12.0, 2.0)
        assert ((free | solid) & ~may).sum() <= 2.0 * FALSE * may.sum()
        assert (must & ~(free | solid)).sum() <= MISSED * must.sum()


def test_scans_are_taken_when_due():
    env = volume_env(2, 2, radar=[RadarConfig(range=2.0, every=1), RadarConfig(range=2.0, every=3)])
    s = env.simulation.tensors
    place(env, np.random.default_rng(0))
    s["failed"][1, 0] = 1
    for step in range(4):
        for name in ("visible_free", "visible_surface"):
            s[name].zero_()
        s["local_step"].fill_(step)
        run(env, scan, env.simulation.shards[0].view.active, ahead=1)
        seen = s["visible_free"].flatten(2).any(-1).tolist()
        due = (step + 1) % 3 == 0
        assert seen == [[True, due], [False, due]]


def test_what_a_sensor_can_see_of_a_map():
    env = volume_env(1, 1)
    m = env.maps[0]
    places = np.argwhere(m.free)[::2500]
    trees = grow_trees(9.0, 1.2)
    words = [grid.reshape(-1, m.num_words) for grid in m.words()]
    free, surface = (
        unpack_words(w.reshape(*m.shape[:2], -1), m.shape[2]) for w in mark_seeable(m.shape, *words, places, trees)
    )
    must, may = np.zeros(m.shape, dtype=bool), np.zeros(m.shape, dtype=bool)
    for k, v in enumerate(places):
        octant = np.array([k & 1, k >> 1 & 1, k >> 2 & 1]) * 0.5 + 0.25
        found = volume_sight.sights(m.free, m.occupied, v + octant, 9.0, 1.2)
        must, may = must | found[0], may | found[1]
    seen = free | surface
    assert not (free & ~m.free).any() and not (surface & ~m.occupied).any()
    assert (must & ~seen).sum() <= MORE_MISSED * must.sum() and (seen & ~may).sum() <= FALSE * seen.sum()
