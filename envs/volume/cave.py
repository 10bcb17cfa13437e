"""Caves: cellular automata in three dimensions, halls on several levels joined by shafts and ramps."""

import numpy as np
from scipy import ndimage

LEVELS = (2, 3)
ROUNDS = 5
ROCK = 0.51  # share of the voxels at first, in the middle of a level


def draw_cave(shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Free voxels of a cave; bool [X, Y, Z]."""
    nx, ny, nz = shape
    levels = int(rng.integers(LEVELS[0], LEVELS[1] + 1))
    height = (np.arange(nz) + 0.5) / nz * levels
    # Rock is likelier between the levels, and where a slow noise says so: halls and passages, not a sponge.
    tilt = ndimage.gaussian_filter(rng.standard_normal((nx, ny)), 14.0, mode="wrap")
    tilt *= 0.22 / tilt.std()
    between = np.abs((height[None, None] + tilt[:, :, None]) % 1.0 - 0.5) * 2.0
    slow = ndimage.gaussian_filter(rng.standard_normal(shape), (6.0, 6.0, 2.5), mode="wrap")
    slow /= slow.std()
    rock = rng.random(shape) < np.clip(ROCK + 0.09 * between**3 + 0.085 * slow, 0.0, 1.0)
    kernel = np.ones(3)
    for _ in range(ROUNDS):
        near = rock.astype(np.float32)
        for axis in range(3):
            near = ndimage.convolve1d(near, kernel, axis=axis, mode="constant", cval=1.0)
        rock = near >= 14  # of 27
    return _join(~rock, rng)


def _join(free: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Tunnels from the larger halls to the largest one, a winding tube each."""
    core = ndimage.binary_erosion(free, np.ones((3, 3, 3)))
    labels, count = ndimage.label(core)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    order = [k for k in np.argsort(-sizes[1:], kind="stable") + 1 if sizes[k] >= 400]
    if not order:
        return free
    joined = np.argwhere(labels == order[0])
    for k in order[1:12]:
        hall = np.argwhere(labels == k)
        start = hall[rng.integers(len(hall))]
        end = joined[np.square(joined - start).sum(axis=1).argmin()]
        start = hall[np.square(hall - end).sum(axis=1).argmin()]
        _dig(free, start, end, rng)
        joined = np.concatenate([joined, hall])
    return free


def _dig(free: np.ndarray, start: np.ndarray, end: np.ndarray, rng: np.random.Generator) -> None:
    """A tube five voxels across along a bent line."""
    middle = (start + end) / 2 + rng.uniform(-4, 4, 3) * (1, 1, 0.4)
    steps = int(np.abs(end - start).max()) * 3 + 2
    t = np.linspace(0.0, 1.0, steps)[:, None]
    line = np.rint((1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end).astype(int)
    reach = np.arange(-2, 3)
    tube = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
    tube = tube[np.square(tube).sum(axis=1) <= 6]
    cells = (line[:, None] + tube).reshape(-1, 3)
    cells = cells[((cells > 0) & (cells < np.array(free.shape) - 1)).all(axis=1)]
    free[tuple(cells.T)] = True
