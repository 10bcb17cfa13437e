"""Units, heights and flags of .las files: geo keys, WKT of both generations, and what is not known."""

import sys

import numpy as np
import pytest
from test_import_clouds import terrain

from maexp.envs.io import import_map, import_map_with_report
from maexp.envs.io.las_units import _parse, _walk
from maexp.envs.maps.point_cloud import MapError

laspy = pytest.importorskip("laspy")
FOOT, US_FOOT = 0.3048, 1200 / 3937
AREA = (0.9 * 11_760, 12_190)  # of `terrain`, whose house stands on it [m2]


def write_las(path, points, keys=None, wkt=None, doubles=(), withheld=None):
    """A .las of the points: geo keys {id: value}, or WKT."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, np.floor(points.min(axis=0))
    if keys:
        record = laspy.vlrs.known.GeoKeyDirectoryVlr()
        entry = laspy.vlrs.known.GeoKeyEntryStruct
        record.geo_keys = [
            entry(id=name, tiff_tag_location=34736 if name == 3077 else 0, count=1, value_offset=value)
            for name, value in keys.items()
        ]
        record.geo_keys_header.number_of_keys = len(keys)
        header.vlrs.append(record)
    if doubles:
        header.vlrs.append(laspy.VLR("LASF_Projection", 34736, record_data=np.array(doubles).tobytes()))
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    if withheld is not None:
        data.withheld = withheld
    data.write(path)
    return path


def area(path, **settings):
    world, report = import_map_with_report(path, scenario="outdoor", place="outdoor", **settings)
    return world.free_area, report


def wkt1(unit, vertical=""):
    plane = 'PROJCS["NAD83 / x",GEOGCS["NAD83",DATUM["D",SPHEROID["GRS",6378137,298.2]],UNIT["degree",0.0174532925]],'
    return f'COMPD_CS["x",{plane}PROJECTION["Lambert"],PARAMETER["k",1],{unit}]{vertical}]'


def wkt2(unit, cs="", vertical=""):
    base = 'BASEGEOGCRS["NAD83",DATUM["D",ELLIPSOID["GRS",6378137,298.2,LENGTHUNIT["metre",1]]]],'
    conversion = 'CONVERSION["c",METHOD["Lambert"],PARAMETER["False easting",0,LENGTHUNIT["metre",1]]],'
    return (
        f'PROJCRS["x",{base}{conversion}CS[Cartesian,2],{cs}{unit}]'
        if not vertical
        else (f'COMPOUNDCRS["x",{wkt2(unit, cs)},{vertical}]')
    )


FEET = f"{US_FOOT:.16g}"
IN_FEET = {
    "key 3076": dict(keys={1024: 1, 3076: 9003}),
    "key 3077": dict(keys={1024: 1, 3072: 32767, 3076: 32767, 3077: 1}, doubles=(6378137.0, US_FOOT)),
    "WKT1": dict(wkt=wkt1(f'UNIT["US survey foot",{FEET}]')),
    "WKT1, feet twice": dict(wkt=wkt1(f'UNIT["Foot_US",{FEET}]', f',VERT_CS["NAVD88",UNIT["Foot_US",{FEET}]]')),
    "WKT2": dict(wkt=wkt2(f'LENGTHUNIT["US survey foot",{FEET}]')),
    "WKT2 in axes": dict(
        wkt=wkt2(f'AXIS["n",north,LENGTHUNIT["ft",{FEET}]]', f'AXIS["e",east,ORDER[1],LENGTHUNIT["ft",{FEET}]],')
    ),
    "WKT2, small letters": dict(wkt=wkt2(f'lengthunit( "US survey foot" , {FEET} )')),
    "WKT2 compound": dict(
        wkt=wkt2(
            f'LENGTHUNIT["f",{FEET}]', vertical=f'VERTCRS["h",CS[vertical,1],AXIS["up",up],LENGTHUNIT["f",{FEET}]]'
        )
    ),
}


@pytest.mark.parametrize("name", IN_FEET)
def test_feet_are_read_from_keys_and_wkt(tmp_path, name):
    found, report = area(write_las(tmp_path / "x.las", terrain() / US_FOOT, **IN_FEET[name]))
    assert AREA[0] < found < AREA[1] and not report.assumptions


METRE_HEIGHTS = {
    "ESRI": dict(wkt=wkt1(f'UNIT["Foot_US",{FEET}]', ',VERTCS["NAVD_1988",VDATUM["x"],UNIT["Meter",1.0]]')),
    "WKT1": dict(wkt=wkt1(f'UNIT["Foot_US",{FEET}]', ',VERT_CS["NAVD88",VERT_DATUM["x",2005],UNIT["metre",1]]')),
    "WKT2": dict(
        wkt=wkt2(f'LENGTHUNIT["f",{FEET}]', vertical='VERTCRS["h",CS[vertical,1],AXIS["up",up,LENGTHUNIT["m",1]]]')
    ),
    "keys": dict(keys={1024: 1, 3076: 9003, 4099: 9001}),
    "datum": dict(keys={1024: 1, 3076: 9003, 4096: 5703}),
}


@pytest.mark.parametrize("name", METRE_HEIGHTS)
def test_heights_have_a_unit_of_their_own(tmp_path, name):
    """A hedge of 2 m in feet would be one of 0.6 m, which a car drives over."""
    points = terrain()
    hedge = np.abs(points[:, 0] - points[:, 0].min() - 30) < 0.9
    points[hedge, 2] += 2.0
    points[:, :2] /= US_FOOT
    found, report = area(write_las(tmp_path / "x.las", points, **METRE_HEIGHTS[name]))
    assert 0.9 * 8_660 < found < 9_000 and "heights 1 m" in report.table()


def test_a_system_by_number_is_known_or_refused(tmp_path, monkeypatch):
    path = write_las(tmp_path / "x.las", terrain() / US_FOOT, keys={1024: 1, 3072: 2277})
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(MapError, match="EPSG:2277, whose unit is not known here; pip install pyproj.*importing.units"):
        import_map(path)
    assert AREA[0] < area(path, units="us-ft")[0] < AREA[1]
    metres = write_las(tmp_path / "y.las", terrain(), keys={1024: 1, 3072: 32617})
    assert AREA[0] < area(metres)[0] < AREA[1]


def test_pyproj_knows_systems_by_number(tmp_path):
    pytest.importorskip("pyproj")
    path = write_las(tmp_path / "x.las", terrain() / US_FOOT, keys={1024: 1, 3072: 2277})
    assert AREA[0] < area(path)[0] < AREA[1]
    by_id = wkt2('ID["EPSG",2277]')
    assert AREA[0] < area(write_las(tmp_path / "y.las", terrain() / US_FOOT, wkt=by_id))[0] < AREA[1]


@pytest.mark.parametrize(
    "given, words",
    [
        (dict(keys={1024: 2, 2048: 4326}), "degrees of longitude and latitude"),
        (dict(keys={2048: 4269}), "degrees of longitude and latitude"),
        (dict(keys={1024: 3}), "earth-centred"),
        (dict(wkt='GEOGCS["WGS 84",DATUM["W"],UNIT["degree",0.0174532925199433]]'), "degrees"),
        (dict(wkt='GEOGCRS["WGS 84",DATUM["W"],CS[ellipsoidal,2],ANGLEUNIT["degree",0.0174]]'), "degrees"),
        (dict(keys={1024: 1, 3076: 9999}), "9999 of geo key 3076"),
        (dict(keys={1024: 1, 3076: 9001, 4099: 9999}), "9999 of geo key 4099"),
        (dict(wkt='PROJCS["x",PROJECTION["y"]]'), "whose unit is not known"),
        (dict(wkt='PROJCS["x",UNIT["none",0]]'), "whose unit is not known"),
    ],
)
def test_what_is_no_length_is_refused(tmp_path, given, words):
    path = write_las(tmp_path / "x.las", terrain(), **given)
    with pytest.raises(MapError, match=words):
        import_map(path)
    assert area(path, units="m")[0] > AREA[0], "whoever says the unit knows better than the header"


def test_withheld_points_are_left_out(tmp_path):
    points = terrain()
    ghosts = points[::7] + [0, 0, 3.0]
    every = np.concatenate([points, ghosts])
    flags = np.arange(len(every)) >= len(points)
    found, _ = area(write_las(tmp_path / "x.las", every, keys={1024: 1, 3076: 9001}, withheld=flags))
    assert AREA[0] < found < AREA[1]
    with pytest.raises(MapError, match="all its .* points are classed as noise or flagged as withheld"):
        import_map(write_las(tmp_path / "y.las", points, withheld=np.ones(len(points), bool)))


def test_without_a_system_metres_are_noted_or_refused(tmp_path):
    path = write_las(tmp_path / "x.las", terrain())
    assert "taken to be metres" in area(path)[1].assumptions[0]
    with pytest.raises(MapError, match="unit is not known.*strict=true refuses; set importing.units"):
        import_map(path, strict=True)
    import_map(path, strict=True, units="m")


def test_odd_wkt_is_read_to_its_end():
    deep = "PROJCS[" * 5000
    assert len(_walk(_parse(deep))) > 40
    for text in ("]]]", 'A["b""c],"', "[[[,,", "\0\0"):
        _parse(text)
