"""Town blocks: streets, houses with roofs, trees and shelters, under a sky that the box closes."""

import numpy as np

STREET = (7, 13)
LOT = (14, 27)
HOUSE_HEIGHT = (8, 19)
OPEN_HOUSE, YARD = 0.4, 0.1  # shares of the lots


def draw_town(shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Free voxels of a part of a town; bool [X, Y, Z]."""
    nx, ny, _ = shape
    free = np.ones(shape, dtype=bool)
    free[:, :, 0] = False
    for x0, x1 in _lots(nx, rng):
        for y0, y1 in _lots(ny, rng):
            if rng.random() >= YARD:
                _build_house(free, x0 + int(rng.integers(0, 4)), x1, y0 + int(rng.integers(0, 4)), y1, rng)
    for _ in range(int(rng.integers(2, 6))):
        _build_shelter(free, rng)
    for _ in range(int(rng.integers(25, 55))):
        _plant(free, rng)
    return free


def _lots(length: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Stretches between streets."""
    lots, at = [], int(rng.integers(3, 12))
    while at + LOT[0] < length - 4:
        end = min(at + int(rng.integers(*LOT)), length - 4)
        lots.append((at, end))
        at = end + int(rng.integers(*STREET))
    return lots


def _build_house(free: np.ndarray, x0: int, x1: int, y0: int, y1: int, rng: np.random.Generator) -> None:
    """Walls and a flat or gabled roof that hangs over; some houses are hollow, with a door and windows."""
    height = int(rng.integers(*HOUSE_HEIGHT))
    free[x0:x1, y0:y1, :height] = False
    if rng.random() < OPEN_HOUSE and min(x1 - x0, y1 - y0) >= 12:
        free[x0 + 1 : x1 - 1, y0 + 1 : y1 - 1, 1 : height - 1] = True
        _open_house(free, x0, x1, y0, y1, height, rng)
    if rng.random() < 0.5:
        along_x = x1 - x0 >= y1 - y0
        width = (y1 - y0) if along_x else (x1 - x0)
        for k in range(min(width // 4, free.shape[2] - 6 - height)):  # a gable, two voxels in for one up
            inset = 2 * k - 1
            xs, ys = (slice(x0, x1), slice(y0 + inset, y1 - inset))
            if not along_x:
                xs, ys = slice(x0 + inset, x1 - inset), slice(y0, y1)
            free[_at_least_0(xs), _at_least_0(ys), height + k] = False
    else:
        over = int(rng.integers(0, 4))
        roof = slice(max(x0 - over, 0), x1 + over), slice(max(y0 - over, 0), y1 + over)
        free[(*roof, height)] = False


def _at_least_0(part: slice) -> slice:
    return slice(max(part.start, 0), max(part.stop, 0))


def _open_house(free: np.ndarray, x0: int, x1: int, y0: int, y1: int, height: int, rng: np.random.Generator) -> None:
    """A door of 1.25 x 2 m in one wall, windows of 1 to 2 m in the others."""
    walls = [(slice(x0, x0 + 1), None), (slice(x1 - 1, x1), None), (None, slice(y0, y0 + 1)), (None, slice(y1 - 1, y1))]
    for k, wall in enumerate(rng.permutation(4)):
        xs, ys = walls[wall]
        low, high = (y0, y1) if ys is None else (x0, x1)
        width = 5 if k == 0 else int(rng.integers(4, 8))
        start = low + 2 + int(rng.integers(0, high - low - width - 3))
        part = slice(start, start + width)
        layers = slice(1, min(9, height - 1)) if k == 0 else slice(3, max(7, min(8, height - 1)))
        if k < 3:
            free[part if xs is None else xs, part if ys is None else ys, layers] = True


def _build_shelter(free: np.ndarray, rng: np.random.Generator) -> None:
    """A roof on four posts, where nothing else stands."""
    nx, ny, _ = free.shape
    width, depth, height = int(rng.integers(8, 16)), int(rng.integers(6, 10)), int(rng.integers(8, 12))
    x, y = int(rng.integers(3, nx - width - 3)), int(rng.integers(3, ny - depth - 3))
    if not free[x - 3 : x + width + 3, y - 3 : y + depth + 3, 1].all():
        return
    free[x : x + width, y : y + depth, height] = False
    for px in (x, x + width - 1):
        for py in (y, y + depth - 1):
            free[px, py, :height] = False


def _plant(free: np.ndarray, rng: np.random.Generator) -> None:
    """A tree: trunk and a crown that is a ball, where the ground is bare."""
    nx, ny, nz = free.shape
    x, y = int(rng.integers(3, nx - 4)), int(rng.integers(3, ny - 4))
    radius, trunk = float(rng.uniform(2.2, 5.0)), int(rng.integers(6, 11))
    if not free[x - 3 : x + 4, y - 3 : y + 4, 1].all():
        return
    free[x, y, :trunk] = False
    middle = trunk + radius - 1
    grid = np.ogrid[:nx, :ny, :nz]
    away = (grid[0] - x) ** 2 + (grid[1] - y) ** 2 + (1.2 * (grid[2] - middle)) ** 2
    free[away <= radius**2] = False
