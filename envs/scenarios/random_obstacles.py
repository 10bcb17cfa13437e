"""Random obstacles: corridors, corner loops and rooms first, then isolated obstacles up to a set density."""

import numpy as np
from scipy import ndimage

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios.lattice import grid_map, grid_points, largest_component, make_generator

# All lengths below are in lattice points (1 m). A robot keeps 2.25 m away from what it can, so a passage of
# four free points (2.5 m on either side of its middle line) is the narrowest one made.
SIZE = 125
OUTER_WALL = 2
PASSAGE = 4
STREET = 3  # half the street between two blocks


def random_layout(rng: np.random.Generator) -> np.ndarray:
    """Blocked lattice points of one map, bool (125, 125); free space is one 4-connected piece, sealed."""
    blocked = np.ones((SIZE, SIZE), dtype=bool)
    inner = slice(OUTER_WALL, SIZE - OUTER_WALL)
    blocked[inner, inner] = False
    blocks = _split_blocks(OUTER_WALL + 1, OUTER_WALL + 1, SIZE - OUTER_WALL - 1, SIZE - OUTER_WALL - 1, rng)
    kinds = [_corridors, _corner_loop, _rooms]  # one of each at least, as in the paper's description
    extra = [_corridors, _corner_loop, _rooms, None, None, None]  # None: open ground for isolated obstacles
    kinds += [extra[k] for k in rng.integers(len(extra), size=max(0, len(blocks) - len(kinds)))]
    for k, (x0, y0, x1, y1) in zip(np.argsort(rng.random(len(kinds))), blocks, strict=False):
        if kinds[k] is not None:
            kinds[k](blocked[x0 + STREET : x1 - STREET, y0 + STREET : y1 - STREET], rng)
    _scatter(blocked, max(rng.uniform(0.18, 0.25), blocked.mean() + 0.02), rng)
    return ~largest_component(~blocked)


def build_random_obstacles(index: int, *, scenario: str, resolution: float) -> PointCloudMap:
    """Map `index`: 125 x 125 lattice points `resolution` apart [m]."""
    free = ~random_layout(make_generator(scenario, index))
    return grid_map(free, resolution, name=f"{scenario}_{index}", scenario=scenario)


def build_adaptive(index: int, *, scenario: str, resolution: float, near: float) -> PointCloudMap:
    """The same kind of place with varying density.

    Free points lie `resolution` [m] apart within `near` [m] of an obstacle, twice as far apart in the open:
    one point at the middle stands for a 2 x 2 square of lattice points there, so that the squares of
    `free_spacing` sum to the free area however it is sampled. Obstacle points stay `resolution` apart.
    """
    blocked = random_layout(make_generator(scenario, index))
    open_ground = ndimage.distance_transform_edt(~blocked) * resolution > near
    whole = SIZE // 2 * 2
    squares = open_ground[:whole, :whole].reshape(whole // 2, 2, whole // 2, 2).all(axis=(1, 3))
    merged = np.zeros_like(blocked)
    merged[:whole, :whole] = squares.repeat(2, axis=0).repeat(2, axis=1)
    fine = grid_points(~blocked & ~merged, resolution)
    coarse = grid_points(squares, 2 * resolution)
    coarse[:, :2] += resolution / 2
    spacing = np.repeat(np.float32([resolution, 2 * resolution]), [len(fine), len(coarse)])
    return PointCloudMap(
        np.concatenate([fine, coarse]),
        grid_points(blocked, resolution),
        resolution,
        name=f"{scenario}_{index}",
        scenario=scenario,
        free_spacing=spacing,
    )


def _split_blocks(x0: int, y0: int, x1: int, y1: int, rng: np.random.Generator) -> list[tuple]:
    """Cut a rectangle into blocks (x0, y0, x1, y1) of about 30 to 55 points a side."""
    width, depth = x1 - x0, y1 - y0
    longest = max(width, depth)
    if longest < 60 and (longest < 48 or rng.random() < 0.35):
        return [(x0, y0, x1, y1)]
    cut = int(longest * rng.uniform(0.4, 0.6))
    if width >= depth:
        return _split_blocks(x0, y0, x0 + cut, y1, rng) + _split_blocks(x0 + cut, y0, x1, y1, rng)
    return _split_blocks(x0, y0, x1, y0 + cut, rng) + _split_blocks(x0, y0 + cut, x1, y1, rng)


def _corridors(block: np.ndarray, rng: np.random.Generator) -> None:
    """Narrow parallel corridors between bars; half of them closed at alternate ends (a serpentine)."""
    if rng.random() < 0.5:
        block = block.T
    width, depth = block.shape
    serpentine = rng.random() < 0.5
    if serpentine:
        block[[0, -1], :] = True
    y, side = 0, int(rng.integers(2))
    while y + 2 <= depth:
        thickness = min(int(rng.integers(2, 5)), depth - y)
        block[:, y : y + thickness] = True
        last = y + thickness + PASSAGE + 2 > depth
        if serpentine or last:
            gap = int(rng.integers(PASSAGE, PASSAGE + 3))
            start = 1 if side else width - 1 - gap
            block[start : start + gap, y : y + thickness] = False
            side = 1 - side
        elif rng.random() < 0.6:  # a short cut somewhere along the bar
            start = int(rng.integers(2, width - PASSAGE - 2))
            block[start : start + PASSAGE, y : y + thickness] = False
        y += thickness + int(rng.integers(PASSAGE, PASSAGE + 3))


def _corner_loop(block: np.ndarray, rng: np.random.Generator) -> None:
    """Nested ring corridors around a solid core, entered at corners."""
    ring = block
    while min(ring.shape) >= 2 * PASSAGE + 6:
        wall = int(rng.integers(1, 4))
        before = ring.copy()
        ring[:wall], ring[-wall:], ring[:, :wall], ring[:, -wall:] = True, True, True, True
        corners = np.argsort(rng.random(4))[: 2 + int(rng.integers(2))]
        for corner in corners:
            gap = PASSAGE + int(rng.integers(2))
            view = ring[:: 1 - 2 * (corner // 2), :: 1 - 2 * (corner % 2)]
            old = before[:: 1 - 2 * (corner // 2), :: 1 - 2 * (corner % 2)]
            if rng.random() < 0.5:
                view, old = view.T, old.T
            view[:wall, wall : wall + gap] = old[:wall, wall : wall + gap]
        inset = wall + int(rng.integers(PASSAGE, PASSAGE + 3))
        ring = ring[inset:-inset, inset:-inset]
    if min(ring.shape, default=0) > 0:
        ring[:] = True


def _rooms(block: np.ndarray, rng: np.random.Generator) -> None:
    """Walled rooms: two outer doors at least, and a door in every wall between two rooms."""
    width, depth = block.shape
    xs = _room_walls(width, rng)
    ys = _room_walls(depth, rng)
    block[xs, :] = True
    block[:, ys] = True
    outer = []
    for i, x in enumerate(xs):
        for j in range(len(ys) - 1):
            if x in (0, width - 1):
                outer.append((0, i, j))
            else:
                _door(block[x], ys[j], ys[j + 1], rng)
    for j, y in enumerate(ys):
        for i in range(len(xs) - 1):
            if y in (0, depth - 1):
                outer.append((1, j, i))
            elif rng.random() < 0.7:  # rows are joined by the other doors already, or by this one
                _door(block[:, y], xs[i], xs[i + 1], rng)
    for k in np.argsort(rng.random(len(outer)))[: max(2, len(outer) // 2)]:
        axis, wall, gap = outer[k]
        if axis == 0:
            _door(block[xs[wall]], ys[gap], ys[gap + 1], rng)
        else:
            _door(block[:, ys[wall]], xs[gap], xs[gap + 1], rng)


def _room_walls(length: int, rng: np.random.Generator) -> list[int]:
    """Positions of the walls along one side of a block of rooms, 9 to 18 points apart."""
    rooms = max(1, round(length / rng.uniform(10, 17)))
    cuts = np.linspace(0, length - 1, rooms + 1) + np.r_[0, rng.uniform(-1.5, 1.5, rooms - 1), 0]
    return [int(round(cut)) for cut in cuts]


def _door(wall: np.ndarray, start: int, stop: int, rng: np.random.Generator) -> None:
    """Open a door in a wall between two corners `start` and `stop`."""
    gap = PASSAGE + int(rng.integers(2))
    first = int(rng.integers(start + 1, max(start + 2, stop - gap + 1)))
    wall[first : min(first + gap, stop)] = False


def _scatter(blocked: np.ndarray, density: float, rng: np.random.Generator) -> None:
    """Add isolated obstacles, a passage apart, until a share `density` is blocked or no room is left."""
    for _ in range(4000):
        if blocked.mean() >= density:
            return
        stamp = _obstacle(rng)
        width, depth = stamp.shape
        x = int(rng.integers(PASSAGE, SIZE - width - PASSAGE))
        y = int(rng.integers(PASSAGE, SIZE - depth - PASSAGE))
        around = blocked[x - PASSAGE : x + width + PASSAGE, y - PASSAGE : y + depth + PASSAGE]
        if not around.any():
            blocked[x : x + width, y : y + depth] |= stamp


def _obstacle(rng: np.random.Generator) -> np.ndarray:
    """Shape of one isolated obstacle: box, disc, cross or angle, bool (width, depth)."""
    kind = int(rng.integers(4))
    width, depth = (int(side) for side in rng.integers(2, 8, size=2))
    if kind == 0:
        return np.ones((width, depth), dtype=bool)
    x, y = np.mgrid[:width, :width] - (width - 1) / 2
    if kind == 1:
        return x**2 + y**2 <= (width / 2) ** 2
    if kind == 2:
        return (np.abs(x) < 1) | (np.abs(y) < 1)
    angle = np.zeros((width + 2, depth + 2), dtype=bool)
    angle[:2, :], angle[:, :2] = True, True
    return angle[:: 1 - 2 * int(rng.integers(2)), :: 1 - 2 * int(rng.integers(2))]
