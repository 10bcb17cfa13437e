"""GIF and MP4 files from frames."""

from pathlib import Path

import numpy as np
from PIL import Image

from maexp.envs.atomic_write import whole_file

HOLD = 2.0  # seconds the last picture of a GIF stays before it starts over


def write_gif(frames, path, fps: float = 10.0) -> Path:
    """Writes ``frames``, uint8 (height, width, 3) each, as an endless GIF; returns the path.

    All frames share one palette of their most frequent colours, undithered: flat areas stay flat, so the file
    stays small. The last frame is held for HOLD seconds. The file appears whole or not at all. Runs of equal
    frames become one that lasts as long, and times are rounded to GIF's hundredths of a second.

    Raises:
        ValueError: no frames, frames of different shapes, or fps not in (0, 50].
    """
    frames, path = _check_frames(frames), Path(path)
    if not 0 < fps <= 50:
        raise ValueError(f"fps={fps} cannot be shown by a GIF; give a rate above 0 and up to 50")
    palette = Image.new("P", (1, 1))
    palette.putpalette(_shared_palette(frames).ravel().tolist())
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [max(20, round(100 / fps) * 10)] * len(images)
    durations[-1] += round(1000 * HOLD)
    with whole_file(path) as part:
        images[0].save(part, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)
    return path


def write_mp4(frames, path, fps: float = 10.0) -> Path:
    """Writes ``frames``, uint8 (height, width, 3) each, as an H.264 film; returns the path.

    Raises:
        ImportError: the optional package imageio-ffmpeg is missing; the message says how to install it.
        ValueError: no frames, frames of different shapes, or fps not above 0.
    """
    frames, path = _check_frames(frames), Path(path)
    if not fps > 0:
        raise ValueError(f"fps={fps} is not a frame rate; give a number above 0")
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError('MP4 needs imageio-ffmpeg: pip install "maexp[video]", or write a .gif') from error
    height, width = frames[0].shape[:2]
    border = ((0, height % 2), (0, width % 2), (0, 0))  # the codec wants even sides
    with whole_file(path) as part:
        writer = imageio_ffmpeg.write_frames(
            part,
            (width + width % 2, height + height % 2),
            fps=fps,
            codec="libx264",
            quality=8,
            macro_block_size=2,
            output_params=["-f", "mp4"],
            ffmpeg_log_level="error",
        )
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(np.pad(frame, border, mode="edge")))
        writer.close()
    return path


def _check_frames(frames) -> list[np.ndarray]:
    frames = [np.asarray(frame) for frame in frames]
    if not frames:
        raise ValueError("frames is empty; give at least one picture")
    for frame in frames:
        if frame.dtype != np.uint8 or frame.shape != frames[0].shape or frame.shape[2:] != (3,):
            raise ValueError(
                f"frames hold a picture of shape {frame.shape} and type {frame.dtype}; "
                f"all must be uint8 of one shape (height, width, 3), here {frames[0].shape}"
            )
    return frames


def _shared_palette(frames: list[np.ndarray]) -> np.ndarray:
    """The colours, uint8 (256, 3), that are most frequent in up to 12 frames spread over the film.

    Half of the places go to the most frequent colours as they are, so that flat areas keep their exact colour,
    and half to the rest by median cut, so that a small robot's colour is not lost.
    """
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, 12).round().astype(int))]
    pixels = np.concatenate([frame.reshape(-1, 3) for frame in chosen]).astype(np.uint32)
    packed = pixels[:, 0] << 16 | pixels[:, 1] << 8 | pixels[:, 2]
    colours, counts = np.unique(packed, return_counts=True)
    order = np.lexsort((colours, -counts.astype(np.int64)))
    exact = _unpack(colours[order[:128]])
    rest = colours[order[128:]]
    if rest.size == 0:
        return np.resize(exact, (256, 3))
    cut = Image.fromarray(_unpack(rest)[None]).quantize(128, method=Image.Quantize.MEDIANCUT)
    middle = np.array(cut.getpalette()[: 3 * 128], dtype=np.uint8).reshape(-1, 3)
    return np.resize(np.concatenate([exact, middle]), (256, 3))


def _unpack(packed: np.ndarray) -> np.ndarray:
    return np.stack([packed >> 16, packed >> 8, packed], axis=-1).astype(np.uint8)
