"""The gain of viewpoints against plain loops over the tree."""

import math

import numpy as np
import pytest
from oracle import volume_gain
from test_volume_cells import cell_shape, known_env
from voxel_worlds import grid, map_of, run

from maexp.envs import RadarConfig
from maexp.kernels.volume import coarse
from maexp.kernels.volume.gain import look_around

pytestmark = pytest.mark.kernels


def looked_env(limited: bool = False, **radar):
    """An env whose targets are looked around, and the trees of its robots' views."""
    env = known_env(limited, RadarConfig(**{"range": 2.0, "vertical_fov": 1.2} | radar))
    for stage in (coarse.find_cells, coarse.flood, coarse.place_targets, look_around):
        run(env, stage)
    return env


def tree_of(env, m: int, r: int) -> dict:
    views = env.simulation.values["views"]
    first, end = views.begin.numpy()[m, r, :2]
    return {name: getattr(views, name).numpy()[first:end] for name in ("offset", "skip", "weight")}


@pytest.mark.parametrize("fov", [2.0 * math.pi, 2.0])
@pytest.mark.parametrize("limited", [False, True])
def test_gain_of_targets(fov, limited):
    env = looked_env(limited, fov=fov)
    s, side = env.simulation.tensors, env.bank.side
    some = 0
    for e in range(2):
        m, shape, number = map_of(env, e), cell_shape(env, e), int(s["map_id"][e])
        whole = env.simulation.values["views"].whole.numpy()[number]
        for r in range(s["target"].shape[1]):
            unknown = s["unknown"][e, r, : math.prod(shape)].numpy().reshape(shape).astype(int)
            room, tree = grid(env, "room", e, r), tree_of(env, number, r)
            for k, cell in enumerate(s["target"][e, r].tolist()):
                got = float(s["gain"][e, r, k])
                if cell < 0:
                    assert got == 0.0
                    continue
                assert (s["distance"][e, :, cell] < coarse.UNREACHED).any()
                at = np.unravel_index(cell, shape)
                edge = m.resolution * side
                want, middle, heading = volume_gain.gain(
                    tree, unknown, at, edge, float(whole[r]), fov if fov < 6.0 else 0.0
                )
                assert got == pytest.approx(want, rel=1e-4, abs=1e-6)
                assert s["middle"][e, r, k].tolist() == pytest.approx(middle, rel=1e-3, abs=1e-4)
                assert float(s["best_heading"][e, r, k]) == pytest.approx(heading, abs=1e-5)
                low = np.array(at) * side
                v = np.floor((s["point"][e, r, k].double().numpy() - m.origin) / m.resolution).astype(int)
                assert (v >= low).all() and (v < low + side).all() and room[tuple(v)]
                middles = np.argwhere(room[tuple(slice(a, a + side) for a in low)]) + 0.5 - 0.5 * side
                gap = np.linalg.norm(v + 0.5 - low - 0.5 * side)
                assert gap == pytest.approx(np.linalg.norm(middles, axis=1).min())
                some += got > 0.0
    assert some > 10
