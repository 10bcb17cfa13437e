"""Shows a scene with what this machine has: an Open3D window, an Open3D picture, or our own painter's."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from maexp.envs.atomic_write import whole_file
from maexp.envs.render.frames import draw_caption
from maexp.envs.render.painter import Camera, Quads, look_at, make_quads, paint
from maexp.envs.render.stage import DrawnScene

RENDERERS = ("auto", "open3d", "painter")
CAPTION = 20  # height of the letters below a picture [px]
PATIENCE = 180.0  # seconds that Open3D may take for a picture


def has_display() -> bool:
    """Whether a window could be opened here."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_window(scene: DrawnScene, title: str, **view) -> str | None:
    """An Open3D window, until it is closed; returns None, or why there was none."""
    camera = look_at(scene.bounds, 1200, 800, **view)
    return _run_open3d(make_quads(scene), camera, title, None)


def draw_scene(scene: DrawnScene, width: int = 1200, renderer: str = "auto", **view) -> tuple[np.ndarray, str]:
    """A picture of a scene, uint8 (height, width, 3), and a sentence on what drew it.

    Args:
        width: in pixels; two thirds of it high
        renderer: open3d, painter, or auto: Open3D where it works, else the painter, which always does
        view: azimuth and elevation of the camera, see `look_at`

    Raises:
        ValueError: an unknown renderer, or renderer=open3d where Open3D does not work.
    """
    if renderer not in RENDERERS:
        raise ValueError(f"renderer={renderer} is unknown: choose one of {', '.join(RENDERERS)}")
    camera, quads, reason = look_at(scene.bounds, width, 2 * width // 3, **view), make_quads(scene), ""
    if renderer != "painter":
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "scene.png"
            reason = _run_open3d(quads, camera, "", picture)
            if reason is None:
                return np.asarray(Image.open(picture).convert("RGB")), "drawn by Open3D, off-screen"
        if renderer == "open3d":
            raise ValueError(f"renderer=open3d does not work here ({reason}): use renderer=painter")
        reason = f"; Open3D does not work here: {reason}"
    return paint(quads, camera), f"drawn by MAexp's own painter{reason}"


def write_picture(picture: np.ndarray, path: Path, snapshot: dict | None = None) -> Path:
    """The picture as PNG, with the caption of a moment of an episode below; the file appears whole or not at all."""
    if snapshot is not None:
        picture = np.concatenate([picture, draw_caption(snapshot, picture.shape[1], text=CAPTION)])
    with whole_file(path) as part:
        Image.fromarray(picture).save(part, "PNG", optimize=True)
    return path


def _run_open3d(quads: Quads, camera: Camera, title: str, picture: Path | None) -> str | None:
    """Run the worker; None when it did its work, else why not, in a few words."""
    environment = dict(os.environ)
    if picture is not None:
        environment["EGL_PLATFORM"] = "surfaceless"
    with tempfile.TemporaryDirectory() as folder:
        faces = Path(folder) / "faces.npz"
        np.savez(
            faces,
            corners=quads.corners.astype(np.float32),
            colour=quads.colour,
            size=np.array([camera.width, camera.height]),
            fov=np.float64(camera.fov),
            target_eye_up=np.stack([camera.target, camera.eye, [0.0, 0.0, 1.0]]),
            title=np.array(title),
        )
        words = [sys.executable, "-m", "maexp.envs.render.open3d_worker", str(faces)]
        words += [str(picture)] if picture else []
        try:
            done = subprocess.run(
                words, env=environment, capture_output=True, text=True, timeout=PATIENCE if picture else None
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return type(error).__name__
    if done.returncode == 0 and (picture is None or picture.is_file()):
        return None
    if done.returncode < 0:
        return f"it was ended by signal {-done.returncode}"
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    return lines[-1][:200] if lines else f"it ended with status {done.returncode}"
