"""ROS map_server maps: a yaml file beside a pgm or png image."""

from __future__ import annotations

import os
import re
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
SAVED_UNKNOWN = 205  # the grey of unknown space in the images of map_server's and nav2's map savers
PLAIN_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
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
    assumed: tuple[str, ...] = ()  # what the yaml does not say


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
    if sheet.assumed:
        told = f"map_server's {', '.join(sheet.assumed)} taken, for the yaml does not say"
        report.assume(told, "write it into the yaml, or set importing.free_threshold and importing.occupied_threshold")
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
    mode = mode.lower() if isinstance(mode, str) else mode
    if mode not in ("trinary", "scale", "raw"):
        raise MapError(f"{path}: mode={_show(mode)} must be trinary, scale or raw")
    given = {
        "resolution": options.pixel_size or content.get("resolution"),
        "occupied_thresh": _first(options.occupied_threshold, content.get("occupied_thresh"), 0.65),
        "free_thresh": _first(options.free_threshold, content.get("free_thresh"), 0.196),
        "negate": content.get("negate", 0),
    }
    set_here = {"free_thresh": options.free_threshold, "occupied_thresh": options.occupied_threshold, "negate": None}

    def _missing(name: str) -> bool:
        return content.get(name) is None and set_here[name] is None

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
        tuple(f"{name}={numbers[name]:g}" for name in ("free_thresh", "occupied_thresh", "negate") if _missing(name)),
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
    if isinstance(value, str) and PLAIN_NUMBER.fullmatch(value.strip()):
        value = float(value)  # yaml 1.1, which PyYAML reads, takes 1e-05 for a text; that of ROS does not
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
                opaque = _find_opaque(path, image)
                deep = image.mode.startswith("I") or image.mode == "F"
                values = np.asarray(image if deep else image.convert("L"), dtype=np.float32)
    except MapError:
        raise
    except Exception as error:  # Pillow raises whatever its decoders raise on damaged files
        raise MapError(f"{path} is not a readable pgm or png image ({error}); it may be truncated") from error
    if deep:
        values = values * (255 / 65535)
    return values, opaque


def _find_opaque(path: Path, image: Image.Image) -> np.ndarray | None:
    """Which pixels are not wholly transparent, bool [height, width]; None: all.

    A png has an alpha channel, alphas of its palette's colours, or one grey or colour that is transparent.
    """
    clear = image.info.get("transparency")
    if "A" in image.getbands() or "a" in image.getbands() or (image.mode == "P" and clear is not None):
        return np.asarray(image.convert("RGBA"))[..., 3] > 0
    if clear is None or image.format != "PNG":
        return None
    with path.open("rb") as file:
        depth = file.read(25)[24]  # bits of a sample: Pillow makes all of them 8, but for grey ones of 16
    pixels = np.asarray(image)
    if image.mode == "RGB":
        colour = [int(value) >> max(0, depth - 8) for value in clear]
        return (pixels != np.array(colour)).any(axis=-1)
    if image.mode == "1":
        return pixels != bool(clear)
    return pixels != (int(clear) * 255 // (2**depth - 1) if depth < 8 else int(clear))


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
    shades = 255 - values if sheet.negate and sheet.mode != "raw" else values  # white is free
    grey, why = _find_grey_margin(shades, labels), "fills the image's margin"
    if grey is None and sheet.mode == "trinary":
        grey, why = _find_saved_unknown(shades, labels), "is what map savers write for unknown space"
    if grey is not None:
        labels[shades == grey] = UNKNOWN
        shown = 255 - grey if shades is not values else grey
        report.assume(
            f"grey {shown:g} {why} yet counts as free with free_thresh {sheet.free:g}: it was taken as unknown",
            "set free_thresh in the yaml, or importing.free_threshold, to 0.196 or less",
            warn=True,
        )
    if sheet.mode == "raw":
        label_ones(values, labels, report)
    dark = _find_dark_unknown(shades, labels)
    wanted = options.grey_walls
    if wanted is None:  # where walls are black, the greys beside them are only blur
        wanted = sheet.mode != "raw" and int(dark.sum()) > int((labels == OBSTACLE).sum())
    if wanted and dark.any():
        labels[dark] = OBSTACLE
        if options.grey_walls is None:
            report.assume("greys between the thresholds were taken for walls", "set importing.grey_walls=true or false")
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


def _find_saved_unknown(shades: np.ndarray, labels: np.ndarray) -> float | None:
    """Map savers' grey of unknown space, where it passes as free beside a whiter free and black walls.

    nav2 saves `free_thresh: 0.25`, which is above it. Among many greys it is a shade like others.
    """
    grey = np.rint(shades) == SAVED_UNKNOWN
    if not grey.any() or (labels[grey] != FREE).any():
        return None
    whiter = (labels == FREE) & (shades >= 250)
    black = (labels == OBSTACLE) & (shades <= 5)
    between = (shades > 5) & (shades < 250)
    usual = whiter.any() and black.any() and grey.sum() > 0.5 * between.sum()
    return float(shades[grey][0]) if usual else None


def label_ones(values: np.ndarray, labels: np.ndarray, report: ImportReport) -> None:
    """In grids of -1, 0 and 1, of which the text of OccupancyGrid speaks, 1 is occupied, not a chance of 1 percent."""
    if (values[(values >= 0) & (values <= 100)].max(initial=0)) == 1:
        labels[values == 1] = OBSTACLE
        report.assume(
            "the grid holds 0 and 1 and nothing above: 1 was taken as occupied, not as a chance of 1 %",
            "write 100 for occupied cells",
            warn=True,
        )


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
