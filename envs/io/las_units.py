"""The units of .las and .laz files: metres a unit of x and y, and of the heights, by geo keys or WKT."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from maexp.envs.maps.point_cloud import MapError

FOOT, US_FOOT = 0.3048, 1200 / 3937
UNITS = {  # EPSG codes of units of length, in metres
    9001: 1.0,
    9002: FOOT,
    9003: US_FOOT,
    9005: 0.3047972654,
    9036: 1000.0,
    9037: 0.9143917962,
    9041: 0.3047994715,
    9070: 0.3048008333,
    9080: 0.3047995102,
    9094: 0.3047997102,
    9095: 0.3048007491,
    9096: 0.9144,
    1025: 0.001,
    1033: 0.01,
}
HEIGHTS = {5703: 1.0, 5701: 1.0, 5714: 1.0, 5773: 1.0, 3855: 1.0, 5103: 1.0, 6360: US_FOOT, 5702: US_FOOT, 8228: FOOT}
METRIC = (  # EPSG systems in metres, first to last: UTM, Gauss-Kruger, and grids of countries
    *((32601, 32660), (32701, 32760), (26901, 26923), (26701, 26722), (25828, 25838), (31254, 31297), (31466, 31469)),
    *((code, code) for code in (2056, 2154, 2180, 3067, 3857, 5514, 27700, 28992, 31370)),
)
MODEL, GEOGRAPHIC, PROJECTED, PLANE_UNIT, PLANE_SIZE, HEIGHT, HEIGHT_UNIT = 1024, 2048, 3072, 3076, 3077, 4096, 4099
UNDEFINED, USER = 0, 32767
PLANES = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "DERIVEDPROJCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
ROUND = ("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS", "GEODETICCRS", "GEOCCS")
UPRIGHT = ("VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS")
CURE = "set units (on the command line importing.units=ft, us-ft, m, ...)"
DEEP = 50  # brackets in brackets

Node = tuple[str, list]  # of WKT: keyword and what stands in its brackets
Units = tuple[float | None, float | None]


def find_units(path: Path, header: Any) -> Units:
    """Metres a unit of x and y (None: the file does not say), and of the heights (None: the same).

    Raises:
        MapError: the coordinates are degrees, or in a system whose unit is not known here.
    """
    records = [*header.vlrs, *(header.evlrs or [])]
    texts = [r.string for r in records if r.record_id == 2112 and isinstance(getattr(r, "string", None), str)]
    doubles = [float(d.value) for r in records for d in getattr(r, "doubles", [])]
    keys = {key.id: _value(key, doubles) for r in records for key in getattr(r, "geo_keys", []) if key.id}
    cited = " ".join(text for r in records for text in getattr(r, "strings", []) if isinstance(text, str))
    if not _says_much(keys) and "PROJCS[" in cited:  # as ESRI writes it
        texts.append(cited[cited.index("PROJCS[") :].split("|")[0])
    texts = [text for text in texts if text.strip(" \0")]
    by_keys = _says_much(keys) and not (texts and header.global_encoding.wkt)
    if by_keys:
        return _by_keys(path, keys)
    return _by_wkt(path, texts[0][:100_000]) if texts else (None, None)


def _value(key, doubles: list[float]) -> float:
    """A geo key's own number, or the double it points to; NaN where that is not there."""
    if key.tiff_tag_location == 34736:
        return doubles[key.value_offset] if key.value_offset < len(doubles) else math.nan
    return key.value_offset


def _says_much(keys: dict[int, float]) -> bool:
    return any(keys.get(name) for name in (MODEL, GEOGRAPHIC, PROJECTED, PLANE_UNIT))


def _by_keys(path: Path, keys: dict[int, float]) -> Units:
    if keys.get(MODEL) == 2 or (MODEL not in keys and keys.get(GEOGRAPHIC) and not _plane_keys(keys)):
        raise _degrees(path, "degrees of longitude and latitude (geo key 1024 = 2)")
    if keys.get(MODEL) == 3:
        raise _degrees(path, "earth-centred (geo key 1024 = 3)")
    code, system = keys.get(PLANE_UNIT, 0), int(keys.get(PROJECTED, 0))
    plane = UNITS.get(int(code))
    if code == USER:
        plane = _sane(keys.get(PLANE_SIZE, math.nan))
    upright = None
    if plane is None and system not in (UNDEFINED, USER) and not code:
        plane, upright = _of_system(system)
        if plane is None:
            raise _unknown(path, f"EPSG:{system}")
    if plane is None and (code or system):
        raise _unknown(path, f"unit {int(code)} of geo key 3076" if code else "a system of its own (geo key 3072)")
    height, datum = keys.get(HEIGHT_UNIT, 0), int(keys.get(HEIGHT, 0))
    if height:
        upright = UNITS.get(int(height))
        if upright is None:
            raise _unknown(path, f"unit {int(height)} of geo key 4099 (heights)")
    elif datum not in (UNDEFINED, USER):
        upright = HEIGHTS.get(datum) or _of_system(datum)[1]
        if upright is None:
            raise _unknown(path, f"EPSG:{datum} (heights)")
    return plane, upright


def _plane_keys(keys: dict[int, float]) -> bool:
    return bool(keys.get(PROJECTED) or keys.get(PLANE_UNIT))


def _of_system(code: int) -> tuple[float | None, float | None]:
    """Metres a unit of an EPSG system of x and y, and of its heights: by pyproj where it is installed."""
    if any(first <= code <= last for first, last in METRIC):
        return 1.0, None
    try:
        import pyproj
    except ImportError:
        return None, None
    try:
        axes = pyproj.CRS.from_epsg(code).axis_info
    except pyproj.exceptions.CRSError:
        return None, None
    plane = [axis.unit_conversion_factor for axis in axes if axis.direction not in ("up", "down")]
    height = [axis.unit_conversion_factor for axis in axes if axis.direction in ("up", "down")]
    degrees = any(axis.unit_name in ("degree", "radian", "grad") for axis in axes)
    return (_sane(plane[0]) if plane and not degrees else None), (_sane(height[0]) if height else None)


def _by_wkt(path: Path, text: str) -> Units:
    tree = _parse(text)
    planes = [node for node in _walk(tree) if node[0] in PLANES]
    if not planes:
        if any(node[0] in ROUND for node in _walk(tree)):
            raise _degrees(path, "degrees of longitude and latitude, or earth-centred (by its WKT)")
        raise _unknown(path, f"{text.strip()[:40]!r}")
    plane = _unit(planes[0])
    if plane is None:
        code = _epsg(planes[0])
        plane = _of_system(code)[0] if code else None
        if plane is None:
            raise _unknown(path, f"EPSG:{code}" if code else "its WKT")
    upright = next((node for node in _walk(tree) if node[0] in UPRIGHT), None)
    if upright is None:
        own = _unit(planes[0], height=True)  # a projected system with heights
        return plane, own
    height = _unit(upright) or _unit(upright, height=True)
    if height is None and (code := _epsg(upright)):
        height = HEIGHTS.get(code) or _of_system(code)[1]
    if height is None:
        raise _unknown(path, "the heights in its WKT")
    return plane, height


def _parse(text: str) -> Node:
    """WKT as (keyword in capitals, [strings, numbers as strings, nodes]); what is left open at the end is closed."""
    root: Node = ("", [])
    open_nodes, word = [root], ""
    for token in re.findall(r'"(?:[^"]|"")*"|[\[\](),]|[^\[\](),"\s]+', text.replace("\0", "")):
        if token in "[(":
            node: Node = (word.upper(), [])
            open_nodes[-1][1].append(node)
            if len(open_nodes) < DEEP:
                open_nodes.append(node)
            word = ""
            continue
        if word:
            open_nodes[-1][1].append(word)
        word = "" if token in "]),," else token
        if token in "])" and len(open_nodes) > 1:
            open_nodes.pop()
    return root


def _walk(node: Node) -> list[Node]:
    found = [node]
    for child in node[1]:
        if isinstance(child, tuple):
            found += _walk(child)
    return found


def _unit(node: Node, height: bool = False) -> float | None:
    """Metres a unit of a system's own UNIT or LENGTHUNIT, else of those of its axes; `height`: of the axis up."""
    children = [child for child in node[1] if isinstance(child, tuple)]
    axes = [child for child in children if child[0] == "AXIS"]
    upright = [axis for axis in axes if {"up", "down"} & {str(part).lower() for part in axis[1]}]
    level = [axis for axis in axes if axis not in upright]
    own = [] if height else [child for child in children if child[0] in ("UNIT", "LENGTHUNIT")]
    for part in [*own[::-1], *(entry for axis in (upright if height else level) for entry in axis[1])]:
        if isinstance(part, tuple) and part[0] in ("UNIT", "LENGTHUNIT") and len(part[1]) > 1:
            return _sane(part[1][1])
    return None


def _epsg(node: Node) -> int | None:
    for child in node[1]:
        if isinstance(child, tuple) and child[0] in ("ID", "AUTHORITY") and len(child[1]) > 1:
            name, code = (str(part).strip('"') for part in child[1][:2])
            if name.upper() == "EPSG" and code.isdigit():
                return int(code)
    return None


def _sane(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) and 1e-6 < number < 1e6 else None


def _degrees(path: Path, what: str) -> MapError:
    cure = "project the file to metres first (pdal: filters.reprojection), or set units if its header is wrong"
    return MapError(f"{path}: its coordinates are {what}, no lengths; {cure}")


def _unknown(path: Path, what: str) -> MapError:
    known = "pip install pyproj, which may know it, or " if what.startswith("EPSG") else ""
    return MapError(f"{path} is in {what}, whose unit is not known here; {known}{CURE}")
