"""ROS map_server maps: a yaml file beside a pgm or png image."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from reprlib import Repr

import numpy as np
import yaml
from PIL import Image

from maexp.envs.io.grid import FREE, MAX_CELLS, MAX_ORIGIN, OBSTACLE, UNKNOWN, Grid
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport, ScannedImage
from maexp.envs.maps.point_cloud import MapError, check_file

MAX_YAML_BYTES = 64 * 1024
_BRIEF = Repr()
_BRIEF.maxlevel = 1
FORMATS = ("PPM", "PNG", "BMP", "TIFF", "JPEG")


@dataclass(frozen=True)
class Sheet:
    """What the yaml says: lengths in metres, thresholds as shares of black."""

    image: Path
    pixel: float
    origin: tuple[float, float, float]  # of the lower left corner; the third number is the yaw [rad]
    negate: bool
    occupied: float
    free: float
    mode: str


def read_occupancy(path: Path, options: ImportOptions, report: ImportReport) -> Grid:
    """Grid of a yaml, or of an image whose yaml lies beside it or whose `pixel_size` is given."""
    if path.suffix.lower() in (".yaml", ".yml"):
        sheet = _read_yaml(path, options, report)
    else:
        beside = path.with_suffix(".yaml")
        if options.pixel_size is None and beside.is_file():
            sheet = _read_yaml(beside, options, report)
        elif options.pixel_size is not None:
            sheet = _make_sheet(path, {"image": path.name}, options)
        else:
            raise MapError(f"{path} is an image without {beside.name} beside it; give its yaml, or pixel_size [m]")
    values, opaque = _read_image(sheet.image)
    report.before = ScannedImage(values.clip(0, 255).astype(np.uint8), sheet.pixel, sheet.origin[:2])
    labels = _label(values, opaque, sheet, options, report)
    grid = Grid(labels[::-1].T.copy(), sheet.pixel, sheet.origin[:2], sheet.origin[2])
    report.add(
        "read",
        f"{sheet.image.name}: {labels.shape[1]} x {labels.shape[0]} pixels of {sheet.pixel:g} m; occupied above "
        f"{sheet.occupied:g}, free below {sheet.free:g}; {grid.count(FREE):,} free, {grid.count(OBSTACLE):,} occupied, "
        f"{grid.count(UNKNOWN):,} unknown",
        after=labels.size,
    )
    if not grid.count(FREE):
        raise MapError(
            f"{path}: no pixel is free (free_thresh {sheet.free:g}, negate {int(sheet.negate)}, image values "
            f"{values.min():g} to {values.max():g}); set free_threshold"
        )
    return grid


def _load_yaml(path: Path) -> dict:
    check_file(path)
    if path.stat().st_size > MAX_YAML_BYTES:
        raise MapError(f"{path} has {path.stat().st_size} bytes; a map_server yaml has at most {MAX_YAML_BYTES}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except Exception as error:  # PyYAML's constructors raise whatever odd values make them raise
        raise MapError(f"{path} is not yaml ({' '.join(str(error).split())[:200]}); repair the file") from error
    if not isinstance(content, dict) or not {"image", "resolution"} <= content.keys():
        raise MapError(f"{path} is not a map_server yaml: it needs the keys image and resolution")
    return content


def find_image(path: Path) -> str | None:
    """The absolute path of the image that a yaml names; None where it is no yaml of map_server."""
    try:
        image = _load_yaml(path)["image"]
    except MapError:
        return None
    return os.path.abspath(path.parent / image) if isinstance(image, str) else None


def _read_yaml(path: Path, options: ImportOptions, report: ImportReport) -> Sheet:
    content = _load_yaml(path)
    origin = content.get("origin")
    if isinstance(origin, list) and len(origin) > 3:
        report.warn(f"origin has {len(origin)} numbers; the first three are taken as x, y, yaw")
    return _make_sheet(path, content, options)


def _make_sheet(path: Path, content: dict, options: ImportOptions) -> Sheet:
    image = content["image"]
    if not isinstance(image, str):
        raise MapError(f"{path}: image={_show(image)} must be the path of a pgm or png file")
    origin = content.get("origin", [0.0, 0.0, 0.0])
    if not isinstance(origin, list) or len(origin) < 2:
        raise MapError(f"{path}: origin={_show(origin)} must be a list of x, y [m] and yaw [rad]")
    origin = [_number(path, "origin", value) for value in [*origin, 0.0][:3]]
    if max(map(abs, origin)) > MAX_ORIGIN:
        raise MapError(f"{path}: origin={origin} lies farther than {MAX_ORIGIN:g} m away; correct it")
    mode = content.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise MapError(f"{path}: mode={_show(mode)} must be trinary, scale or raw")
    given = {
        "resolution": options.pixel_size or content.get("resolution"),
        "occupied_thresh": _first(options.occupied_threshold, content.get("occupied_thresh"), 0.65),
        "free_thresh": _first(options.free_threshold, content.get("free_thresh"), 0.196),
        "negate": content.get("negate", 0),
    }
    if isinstance(given["negate"], bool):
        given["negate"] = int(given["negate"])
    numbers = {name: _number(path, name, value) for name, value in given.items()}
    if not 1e-4 <= numbers["resolution"] <= 100:
        raise MapError(f"{path}: resolution={numbers['resolution']:g} must be between 0.0001 and 100 m a pixel")
    if not 0 <= numbers["free_thresh"] <= numbers["occupied_thresh"] <= 1:
        raise MapError(
            f"{path}: free_thresh={numbers['free_thresh']:g} and occupied_thresh={numbers['occupied_thresh']:g} "
            "must be shares of black with 0 <= free <= occupied <= 1"
        )
    return Sheet(
        path.parent / image,
        numbers["resolution"],
        tuple(origin),
        bool(numbers["negate"]),
        numbers["occupied_thresh"],
        numbers["free_thresh"],
        mode,
    )


def _first(*values):
    return next(value for value in values if value is not None)


def _show(value) -> str:
    """A value of the yaml in short; written out, aliases may stand for billions of values."""
    try:
        return _BRIEF.repr(value)
    except ValueError:  # Python refuses to write out very long integers
        return "(a huge number)"


def _number(path: Path, name: str, value) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not abs(value) < 1e300:  # an integer of yaml may be too long for a float
        raise MapError(f"{path}: {name}={_show(value)} must be a number")
    return float(value)


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Brightness in 0..255, float32 [height, width], and which pixels are opaque (None: all)."""
    check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large images are checked below
            with Image.open(path, formats=FORMATS) as image:
                if image.width * image.height > MAX_CELLS:
                    raise MapError(f"{path} has {image.width} x {image.height} pixels; at most {MAX_CELLS} are read")
                _check_rows(path, image)
                alpha = np.asarray(image.convert("RGBA"))[..., 3] if "A" in image.getbands() else None
                deep = image.mode.startswith("I") or image.mode == "F"
                values = np.asarray(image if deep else image.convert("L"), dtype=np.float32)
    except MapError:
        raise
    except Exception as error:  # Pillow raises whatever its decoders raise on damaged files
        raise MapError(f"{path} is not a readable pgm or png image ({error}); it may be truncated") from error
    if deep:
        values = values * (255 / 65535)
    return values, None if alpha is None else alpha > 0


def _check_rows(path: Path, image: Image.Image) -> None:
    """A binary pgm must not hold more rows than its header promises."""
    with path.open("rb") as file:
        if file.read(2) != b"P5" or not image.tile:
            return
    row = image.width * (1 if image.mode == "L" else 2)
    rest = path.stat().st_size - image.tile[0][2] - row * image.height
    if rest >= row:
        raise MapError(f"{path} holds {rest // row} rows more than the {image.height} it promises; save it again")


def _label(values: np.ndarray, opaque, sheet: Sheet, options: ImportOptions, report: ImportReport) -> np.ndarray:
    """UNKNOWN, FREE or OBSTACLE of every pixel, by the rules of map_server."""
    if sheet.mode == "raw":
        occupied = values / 100
    else:
        occupied = values / 255 if sheet.negate else (255 - values) / 255
    labels = np.full(values.shape, UNKNOWN, dtype=np.uint8)
    labels[occupied < sheet.free] = FREE
    labels[occupied > sheet.occupied] = OBSTACLE
    if sheet.mode == "raw":
        labels[values > 100] = UNKNOWN
    if opaque is not None:
        labels[~opaque] = UNKNOWN
    grey = _find_grey_margin(values, labels)
    if grey is not None:
        labels[values == grey] = UNKNOWN
        report.warn(
            f"grey {grey:g} fills the image's margin yet counts as free with free_thresh {sheet.free:g}: it was "
            "taken as unknown (set free_threshold below it in the yaml)"
        )
    dark = _find_dark_unknown(values, labels)
    wanted = options.grey_walls
    if wanted is None:  # where walls are black, the greys beside them are only blur
        wanted = sheet.mode != "raw" and int(dark.sum()) > int((labels == OBSTACLE).sum())
    if wanted and dark.any():
        labels[dark] = OBSTACLE
        report.add("grey walls", "pixels darker than the grey of unknown space became obstacles", after=int(dark.sum()))
    return labels


def _find_grey_margin(values: np.ndarray, labels: np.ndarray) -> float | None:
    """A mid-grey that fills most of the margin and passes as free although a whiter free exists.

    Maps painted with 206 instead of 205 for unknown slip through the usual threshold of 0.196.
    """
    margin = np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])
    shades, counts = np.unique(margin, return_counts=True)
    grey = float(shades[counts.argmax()])
    whiter = (labels == FREE) & (np.abs(values - grey) > 30)
    mid = 150 < grey < 225 and counts.max() > 0.5 * len(margin)
    free = bool((labels[values == grey] == FREE).all())
    return grey if mid and free and whiter.sum() > 0.01 * values.size else None


def _find_dark_unknown(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Pixels between the thresholds that are darker than the usual grey of unknown space: rather wall than not.

    Thin walls are often painted in such greys only; in coarse cells they would drown in the free pixels around them.
    """
    unknown = labels == UNKNOWN
    if not unknown.any():
        return unknown
    shades, counts = np.unique(values[unknown], return_counts=True)
    grey = shades[counts.argmax()]
    return unknown & (values < grey - 15) & (counts.max() > 0.5 * unknown.sum())
