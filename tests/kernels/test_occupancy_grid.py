"""Known grids and masks that follow what has become known, against grids painted from nothing."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from test_wavefront import Scene, array, flag_words

from maexp.kernels.constants import OBSTACLE, UNKNOWN, UNREACHED
from maexp.kernels.occupancy_grid import KnownGrids
from maexp.kernels.path_steps import nearest_cell
from maexp.kernels.traversability import PassableGrids

pytestmark = pytest.mark.kernels

launch = partial(wp.launch, device="cpu")
ROBOTS = 3


class Growing:
    """Grids of three envs over two maps whose knowledge changes, and the same painted from nothing."""

    def __init__(self, rows_per_env: int, through_unknown: bool):
        self.scene = Scene(4, ROBOTS, rows_per_env, share=0.0)
        self.rows_per_env, self.through_unknown = rows_per_env, through_unknown
        self.false: wp.array | None = None
        self.known = self.grids()
        self.masks = self.masks_of(self.known)

    def grids(self) -> KnownGrids:
        old = self.scene.known
        return KnownGrids(
            old.maps,
            old.grids,
            old.map_id,
            old.free_flags,
            old.boundary_flags,
            old.rows_per_env,
            self.scene.cells,
            self.false,
        )

    def masks_of(self, known: KnownGrids) -> PassableGrids:
        masks = ROBOTS if self.rows_per_env > 1 else 2
        rng = np.random.default_rng(0)
        radius = rng.uniform(0.2, 1.5, (3, masks)).astype(np.float32)
        return PassableGrids(known, radius, 2.0 * radius, 0.5, self.through_unknown)

    def show(self, rng, share: float, keep: bool, envs=(0, 1, 2)) -> None:
        """Let robots know more (or something else) in some envs."""
        known = self.known
        for layer, array_of in ((self.scene.free, known.free_flags), (self.scene.boundary, known.boundary_flags)):
            for e in envs:
                more = rng.random(layer[e].shape) < share
                layer[e] = layer[e] | more if keep else more
            array_of.assign(flag_words(layer, 1, array_of.shape[2]))

    def check(self) -> None:
        self.known.paint(launch)
        self.masks.paint(launch)
        known = self.grids()
        known.paint(launch)
        masks = self.masks_of(known)
        masks.paint(launch)
        np.testing.assert_array_equal(self.known.known.numpy(), known.known.numpy())
        np.testing.assert_array_equal(self.known.walls.numpy(), known.walls.numpy())
        for row, grid in enumerate(self.masks.grid_of_row.numpy()):
            cells = self.scene.kinds[grid].size
            np.testing.assert_array_equal(self.masks.passable.numpy()[row, :cells], masks.passable.numpy()[row, :cells])


@pytest.mark.parametrize("through_unknown", [True, False])
@pytest.mark.parametrize("rows_per_env", [1, ROBOTS])
def test_what_becomes_known_is_entered_as_if_painted_anew(rows_per_env, through_unknown):
    rng = np.random.default_rng(6)
    growing = Growing(rows_per_env, through_unknown)
    growing.check()
    for _ in range(6):
        growing.show(rng, 0.08, keep=True)
        growing.check()
        assert (growing.known.news_count.numpy() >= 0).all()  # painted what was new only
        growing.check()
        assert (growing.known.news_count.numpy() == 0).all()
    growing.show(rng, 0.3, keep=False, envs=[1])  # a new episode in one env
    growing.check()
    assert (growing.known.news_count.numpy().reshape(3, -1) < 0).any(1).tolist() == [False, True, False]
    growing.show(rng, 0.08, keep=True)
    growing.check()


@pytest.mark.parametrize("rows_per_env", [1, ROBOTS])
def test_false_walls_come_and_go(rows_per_env):
    rng, growing = np.random.default_rng(10), Growing(rows_per_env, True)
    flags = growing.known.free_flags
    growing.false = wp.zeros(flags.shape, dtype=wp.int32, device="cpu")
    growing.known = growing.grids()
    growing.masks = growing.masks_of(growing.known)
    walls = [np.zeros_like(row) for row in growing.scene.free]
    growing.check()
    for gone in (0.0, 0.0, 0.5, 0.0, 1.0):
        growing.show(rng, 0.05, keep=True)
        some = [rng.random(wall.shape) < 0.03 for wall in walls]
        walls = [(wall & (rng.random(wall.shape) >= gone)) | more for wall, more in zip(walls, some, strict=True)]
        growing.false.assign(flag_words(walls, 1, flags.shape[2]))
        growing.check()
        assert (growing.known.news_count.numpy() < 0).any() == (gone > 0.0)
    assert (growing.known.known.numpy() == OBSTACLE).any()


def test_another_map_is_painted_anew():
    rng = np.random.default_rng(7)
    growing = Growing(1, True)
    growing.show(rng, 0.4, keep=True)
    growing.check()
    for e, m in ((0, 0), (2, 0)):
        growing.scene.map_id[e] = m
        place = growing.scene.places[m]
        growing.scene.free[e] = rng.random((ROBOTS, len(place.free))) < 0.3
        growing.scene.boundary[e] = rng.random((ROBOTS, len(place.boundary))) < 0.3
    growing.known.map_id.assign(np.array(growing.scene.map_id, np.int32))
    growing.show(rng, 0.0, keep=True)
    growing.check()
    assert growing.known.news_count.numpy()[[0, 2]].tolist() == [-1, -1]


def test_more_news_than_fit_draw_masks_anew():
    rng = np.random.default_rng(8)
    growing = Growing(1, False)
    growing.known.news = wp.zeros((3, 2), dtype=wp.int32, device="cpu")
    growing.check()
    for share in (0.02, 0.2, 0.5):
        growing.show(rng, share, keep=True)
        growing.check()
    assert (growing.known.news_count.numpy() == -1).all()


def test_walls_have_a_bit_for_every_obstacle():
    growing = Growing(1, True)
    growing.show(np.random.default_rng(9), 0.5, keep=True)
    growing.check()
    for e, m in enumerate(growing.scene.map_id):
        height, width = growing.scene.kinds[m].shape
        words = growing.known.walls.numpy()[e].view(np.uint32)
        bits = (words[: height * -(-width // 32)].reshape(height, -1, 1) >> np.arange(32, dtype=np.uint32)) & 1
        want = growing.known.known.numpy()[e, : height * width].reshape(height, width) == OBSTACLE
        np.testing.assert_array_equal(bits.reshape(height, -1)[:, :width] != 0, want)
        assert want.any() and (growing.known.known.numpy()[e] == UNKNOWN).any()


@wp.kernel(enable_backward=False)
def _find_nearest(
    passable: wp.array2d(dtype=wp.uint8),
    distance: wp.array2d(dtype=wp.int32),
    item: int,
    w: int,
    h: int,
    found: wp.array(dtype=wp.int32),
):
    cell = wp.tid()
    found[cell] = nearest_cell(cell, passable, 0, distance, item, w, h)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3])
def test_the_nearest_cell_is_the_first_of_the_nearest(share):
    rng = np.random.default_rng(10)
    height, width = 11, 17
    counts = rng.random(height * width) < share
    passable = array(counts[None].astype(np.uint8), wp.uint8)
    distance = array(np.where(counts[::-1], 5, UNREACHED)[None], wp.int32)
    y, x = np.divmod(np.arange(height * width), width)
    for item, marked in ((-1, counts), (0, counts[::-1])):
        found = wp.zeros(height * width, dtype=wp.int32, device="cpu")
        wp.launch(_find_nearest, height * width, [passable, distance, item, width, height], [found], device="cpu")
        gap = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
        want = np.where(marked, gap, 1 << 30).argmin(1) if marked.any() else np.full(height * width, -1)
        np.testing.assert_array_equal(found.numpy(), want)
