"""Pictures of a scene without any graphics driver: faces sorted by distance, drawn the farthest first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from maexp.envs.viewing.quads import Quads

BACKGROUND = (255, 255, 255)
FOV = 30.0  # [degrees], vertical
_AA = 2  # drawn this many times larger, then averaged


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from: eye and target [m], picture size [px], vertical field of view [degrees]."""

    eye: np.ndarray
    target: np.ndarray
    width: int
    height: int
    fov: float = FOV

    @property
    def axes(self) -> np.ndarray:
        """Right, up and back of the picture, rows of [3, 3]."""
        back = (self.eye - self.target) / np.linalg.norm(self.eye - self.target)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2), column then row, and depth (...) of points (..., 3)."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.maximum(-seen[..., 2], 1e-9)
        focal = 0.5 * self.height / np.tan(np.radians(0.5 * self.fov))
        pixels = seen[..., :2] / depth[..., None] * [focal, -focal] + [0.5 * self.width, 0.5 * self.height]
        return pixels, depth


def look_at(bounds, width: int, height: int, azimuth: float = -60.0, elevation: float = 50.0) -> Camera:
    """A camera that sees all between two corners.

    Args:
        bounds: lowest and highest corner [m]
        width, height: of the picture [px]
        azimuth: where the camera stands, seen from the middle, counter-clockwise from x [degrees]
        elevation: of the camera over the ground [degrees], above 0 and below 90
    """
    low, high = bounds
    target = 0.5 * (low + high)
    a, e = np.radians(azimuth), np.radians(np.clip(elevation, 1.0, 89.0))
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    distance = 1.2 * float(np.linalg.norm(high - low)) / np.tan(np.radians(0.5 * FOV))
    frame = np.array([width, height])
    for _ in range(12):  # centre the picture and fill it; each round halves what is left
        camera = Camera(target + distance * direction, target, width, height)
        pixels, _ = camera.project(corners)
        middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0)) - 0.5 * frame
        per_metre = 0.5 * height / np.tan(np.radians(0.5 * FOV)) / distance
        target = target + (camera.axes[0] * middle[0] - camera.axes[1] * middle[1]) / per_metre
        distance *= max(float((np.ptp(pixels, axis=0) / (0.94 * frame)).max()), 0.2)
    return Camera(target + distance * direction, target, width, height)


def paint(quads: Quads, camera: Camera) -> np.ndarray:
    """The picture, uint8 (height, width, 3)."""
    corners = quads.corners
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = ((camera.eye - corners[:, 0]) * normal).sum(axis=1) > 0
    pixels = camera.project(corners)[0] * _AA
    frame = _AA * np.array([camera.width, camera.height])
    inside = ((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < frame)).all(axis=1)
    chosen = np.flatnonzero(facing & inside)
    far = np.linalg.norm(quads.at[chosen] - camera.eye[:2], axis=1) - quads.reach[chosen]
    order = chosen[np.lexsort((quads.layer[chosen], -far))]
    grown = pixels + 0.5 * np.sign(pixels - pixels.mean(axis=1, keepdims=True))  # no hairline between tiles
    image = Image.new("RGB", (camera.width * _AA, camera.height * _AA), BACKGROUND)
    draw = ImageDraw.Draw(image)
    for points, colour in zip(grown[order].reshape(len(order), 8).tolist(), quads.colour[order].tolist(), strict=True):
        draw.polygon(points, fill=tuple(colour))
    return np.asarray(image.reduce(_AA))
