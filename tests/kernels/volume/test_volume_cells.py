"""Room, cells, frontiers, distances and ways in volumes against plain loops."""

import numpy as np
import pytest
import torch
from oracle import volume_cells
from voxel_worlds import grid, map_of, place, run, volume_env

from maexp.envs import CommConfig, RadarConfig, RobotConfig
from maexp.envs.volume.map import VoxelMap, pack_words
from maexp.kernels.launches import launch_named, launch_on, view
from maexp.kernels.volume import coarse

pytestmark = pytest.mark.kernels

CLOSE = 1e-4  # cells: nearer ones are as near in float32


def known_env(limited: bool, radar: RadarConfig | None = None):
    """An env whose robots know balls at random, and something of nothing."""
    comm = CommConfig(range=1.0) if limited else CommConfig()
    env = volume_env(3, 2, comm=comm, radar=radar or RadarConfig(range=2.0))
    s, rng = env.simulation.tensors, np.random.default_rng(7)
    place(env, rng)
    for name in ("known_free", "known_surface"):
        s[name].zero_()
    for e in range(3):
        m = map_of(env, e)
        index = np.stack(np.meshgrid(*map(np.arange, m.shape), indexing="ij"), axis=-1)
        for r in range(s["known_free"].shape[1]):
            known = np.zeros(m.shape, dtype=bool)
            home = (s["center"][e, r].numpy() - m.origin) / m.resolution
            for k in range(9):
                ball = home if k == 0 else rng.uniform(0, m.shape)
                known |= np.linalg.norm(index + 0.5 - ball, axis=-1) < rng.uniform(5.0, 9.0)
            known &= rng.random(m.shape) < 0.9985
            for name, part in (("known_free", m.free), ("known_surface", m.occupied)):
                words = pack_words(known & part).reshape(-1, m.num_words)
                s[name][e, r, : len(words), : m.num_words] = torch.from_numpy(words)
    s["looked"].copy_(torch.tensor([1, 1, 0]))
    return env


def cell_shape(env, e) -> tuple[int, ...]:
    return tuple(-(-n // env.bank.side) for n in map_of(env, e).shape)


def number_of(cell, shape) -> int:
    return -1 if cell is None else (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]


@pytest.mark.parametrize("limited", [False, True])
def test_room_cells_frontiers_and_distances(limited):
    env = known_env(limited)
    s, side, block = env.simulation.tensors, env.bank.side, env.bank.block
    body = int(env.simulation.values["cells"].body)
    for name in ("open", "target", "distance"):
        s[name].fill_(-77)
    run(env, coarse.find_cells)
    run(env, coarse.flood)
    run(env, coarse.place_targets)
    assert (s["open"][2] == -77).all() and (s["target"][2] == -77).all() and (s["distance"][2] == -77).all()
    found = 0
    for e in range(2):
        m, shape = map_of(env, e), cell_shape(env, e)
        for r in range(s["room"].shape[1]):
            known, surface = grid(env, "known_free", e, r), grid(env, "known_surface", e, r)
            room = volume_cells.room(known, body)
            assert room.any() and (grid(env, "room", e, r) == room).all()
            is_open, unknown = volume_cells.cells(known, surface, room, side, coarse.SOLID)
            assert (grid(env, "open", e, r, shape) == is_open).all()
            got = s["unknown"][e, r, : is_open.size].numpy().reshape(shape)
            assert (got == unknown).all() and (unknown == 255).any()
            edge = volume_cells.frontier(known, surface)
            want = volume_cells.targets(edge, is_open, side, block, coarse.LEAST_FRONTIER, coarse.SEARCH)
            assert (s["target"][e, r, len(want) :] == -1).all()
            for k, (count, cell, lead) in enumerate(want):
                assert int(s["frontier_size"][e, r, k]) == count
                if lead > CLOSE:
                    assert int(s["target"][e, r, k]) == number_of(cell, shape)
                    found += cell is not None
        for i in range(2):
            is_open = grid(env, "open", e, i if limited else 0, shape)
            at = (s["center"][e, i].double().numpy() - m.origin) / (m.resolution * side)
            start, lead = volume_cells.nearest_open(is_open, at, coarse.SNAP)
            assert lead > CLOSE
            got = s["distance"][e, i, : is_open.size].numpy().reshape(shape)
            assert (got == volume_cells.distances(is_open, start)).all()
            if start is not None:
                reached = {tuple(c) for c in np.argwhere(got < volume_cells.UNREACHED).tolist()}
                assert reached == volume_cells.connected(is_open, start)
    assert found > 20


def flood_from(env, is_open, start):
    """Distances of robot 0 of env 0 on given open cells of its map."""
    s, side, m = env.simulation.tensors, env.bank.side, map_of(env, 0)
    words = pack_words(is_open).reshape(-1, -(-is_open.shape[2] // 32))
    s["open"].zero_()
    s["open"][0, 0, : len(words), : words.shape[1]] = torch.from_numpy(words)
    s["center"][0, 0] = torch.tensor((np.array(start) + 0.5) * side * m.resolution + m.origin).float()
    s["looked"].fill_(1)
    run(env, coarse.flood)
    return s["distance"][0, 0, : is_open.size].numpy().reshape(is_open.shape)


@pytest.mark.parametrize("share", [0.25, 0.4, 0.7])
def test_distances_in_mazes_of_cells(share):
    """Passages that hang together askew are found whatever the parity of the step."""
    env = volume_env(1, 1)
    shape, rng = cell_shape(env, 0), np.random.default_rng(int(100 * share))
    is_open = rng.random(shape) < share
    start = tuple(np.argwhere(is_open)[is_open.sum() // 2].tolist())
    got = flood_from(env, is_open, start)
    assert (got == volume_cells.distances(is_open, start)).all()
    assert {tuple(c) for c in np.argwhere(got < 32767).tolist()} == volume_cells.connected(is_open, start)


def test_a_column_of_more_than_32_cells():
    env = volume_env(1, 1, maps=[tall_map()])
    shape = cell_shape(env, 0)
    assert shape[2] > 32
    is_open = np.zeros(shape, dtype=bool)
    is_open[1, 1] = is_open[2, :, -2] = True
    got = flood_from(env, is_open, (1, 1, 0))
    assert (got == volume_cells.distances(is_open, (1, 1, 0))).all() and got[1, 1, -1] == shape[2] - 1


def tall_map():
    free = np.zeros((9, 12, 70), dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    return VoxelMap(free, ~free, 0.25, name="shaft", scenario="cave")


def first_cells(env, wanted: np.ndarray, ahead: int) -> np.ndarray:
    """What `_first_cells` finds for candidates of robot 0 of env 0."""
    s = env.simulation.tensors
    cells = torch.from_numpy(wanted).int().view(1, 1, -1)
    found = torch.zeros_like(cells)
    values = dict(env.simulation.shards[0].values) | {
        "ahead": ahead,
        "env": view(torch.zeros(1, dtype=torch.int32)),
        "distance": view(s["distance"]),
        "wanted": view(cells),
        "cell": view(found),
    }
    launch_named(launch_on("cpu"), coarse._first_cells, tuple(cells.shape), values)
    return found.view(-1).numpy()


@pytest.mark.parametrize("share", [0.25, 0.4])
def test_the_cells_on_the_way(share):
    """So many steps from the robot, or one less where the next goes askew after a straight one that leads nowhere."""
    env = volume_env(1, 1)
    shape, rng = cell_shape(env, 0), np.random.default_rng(int(100 * share))
    is_open = rng.random(shape) < share
    start = tuple(np.argwhere(is_open)[is_open.sum() // 2].tolist())
    distance = flood_from(env, is_open, start).copy()
    wanted = np.concatenate([np.arange(is_open.size), [-1]])
    before = wanted
    for ahead in range(int(distance[distance < 32767].max()), -1, -1):
        cell = first_cells(env, wanted, ahead)
        for k, (here, last) in enumerate(zip(cell, before, strict=True)):
            if wanted[k] < 0 or distance.flat[wanted[k]] == 32767:
                assert here == -1
            elif here != last and distance.flat[last] != 32767:
                a, b = (np.array(np.unravel_index(n, shape)) for n in (here, last))
                assert np.abs(a - b).max() == 1 and is_open[tuple(a)]
                assert distance.flat[here] in (ahead, ahead - 1) and distance.flat[here] < distance.flat[last]
        before = cell
    reached = distance.reshape(-1)[wanted[:-1]] < 32767
    assert (cell[:-1][reached] == number_of(start, shape)).all() and reached.sum() > 3


def test_the_unknown_voxels_of_a_cell_fit_a_byte():
    """Voxels of a sixteenth of a metre: 8 along half a metre, of which 512 would count as none."""
    free = np.zeros((29, 26, 33), dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    m = VoxelMap(free, ~free, 0.0625, name="fine", scenario="cave")
    env = volume_env(1, 1, maps=[m], robot=RobotConfig(radius=0.06), radar=RadarConfig(range=1.0))
    s = env.simulation.tensors
    s["known_free"].zero_()
    s["known_surface"].zero_()
    s["looked"].fill_(1)
    run(env, coarse.find_cells)
    assert int(s["unknown"][0, 0, 0]) == env.bank.side**3
