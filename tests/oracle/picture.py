"""The picture of a map: 125 x 125 pixels over a square frame around the extent."""

import math

import numpy as np

from oracle.motion import depth_in_body

PIXELS = 125


def frame(extent, margin: float = 0.05, pixels: int = PIXELS) -> tuple[np.ndarray, float]:
    """`(corner, size)`: lower corner [m] of the square frame and edge of a pixel [m].

    The frame is centred on the extent ((xmin, ymin), (xmax, ymax)); its side is the longer side of the extent
    with `margin` of it on either side.
    """
    (x0, y0), (x1, y1) = ((float(a), float(b)) for a, b in extent)
    side = max(x1 - x0, y1 - y0) * (1.0 + 2.0 * margin)
    return np.asarray([0.5 * (x0 + x1 - side), 0.5 * (y0 + y1 - side)]), side / pixels


def pixel_center(ix: int, iy: int, corner, size: float) -> tuple[float, float]:
    """World position [m] of the centre of pixel (ix, iy); x along the first axis."""
    return corner[0] + (ix + 0.5) * size, corner[1] + (iy + 0.5) * size


def nearest_pixel(point, corner, size: float) -> tuple[int, int]:
    """The pixel whose centre is nearest to a world point."""
    return math.floor((float(point[0]) - corner[0]) / size), math.floor((float(point[1]) - corner[1]) / size)


def shown_points(points, reach, corner, size: float, pixels: int = PIXELS) -> dict[tuple[int, int], list]:
    """Which points each pixel shows: those whose nearest pixel centre it is; where there are none, the
    nearest point whose `reach` (n,) [m] extends to the pixel's centre (no holes between points)."""
    shown: dict[tuple[int, int], list[int]] = {}
    for index, point in enumerate(points):
        shown.setdefault(nearest_pixel(point, corner, size), []).append(index)
    flat = np.asarray(points, np.float64)[:, :2]
    for ix in range(pixels):
        for iy in range(pixels):
            if (ix, iy) in shown:
                continue
            away = np.hypot(*(flat - pixel_center(ix, iy, corner, size)).T)
            nearest = int(np.argmin(away))
            if away[nearest] <= reach[nearest]:
                shown[ix, iy] = [nearest]
    return shown


def footprint(state, length: float, width: float, corner, size: float) -> np.ndarray:
    """Signed depth [m] of every pixel centre in the body, (125, 125): above 0 inside, below 0 outside."""
    depth = np.zeros((PIXELS, PIXELS))
    for ix in range(PIXELS):
        for iy in range(PIXELS):
            depth[ix, iy] = depth_in_body(pixel_center(ix, iy, corner, size), state, length, width)
    return depth


def fade(age: int) -> float:
    """Grey value of a trajectory pixel last visited `age` local steps ago."""
    return 255.0 * 0.99**age
