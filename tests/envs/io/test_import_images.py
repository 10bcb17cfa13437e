"""Transparency however a png stores it, the grey of map savers, and yamls as ROS reads them."""

import numpy as np
import pytest
from PIL import Image
from test_import_grids import FREE, UNKNOWN, WALL, picture, write_ros

from maexp.envs.io import import_map, import_map_with_report
from maexp.envs.maps.point_cloud import MapError

ROOM = 70.0  # m2 of `picture`


def outside_white():
    """The room whose outside is white."""
    image = picture()
    image[image == UNKNOWN] = 255
    return image


def write(folder, image, **save):
    path = write_ros(folder, suffix="png")
    image.save(folder / "floor.png", **save)
    return path


def indexed(image, alphas):
    """With a palette of outside, free and wall."""
    index = np.select([image == 255, image == FREE], [0, 1], 2).astype(np.uint8)
    made = Image.fromarray(index)
    made.putpalette([255, 255, 255, 254, 254, 254, 0, 0, 0])
    return made, {"transparency": alphas}


def pngs():
    image = outside_white()
    colour = np.repeat(image[..., None], 3, axis=2)
    deep = image.astype(np.uint16) * 257
    alpha = np.where(image == 255, 0, 255).astype(np.uint8)
    yield "indexed", *indexed(image, b"\x00\xff\xff")
    yield "indexed, one", *indexed(image, 0)
    yield "grey", Image.fromarray(image), {"transparency": 255}
    yield "grey of 16 bits", Image.fromarray(deep), {"transparency": 65535}
    yield "colour", Image.fromarray(colour), {"transparency": (255, 255, 255)}
    yield "alpha", Image.fromarray(np.dstack([colour, alpha])), {}
    yield "grey alpha", Image.fromarray(np.dstack([image, alpha])), {}


PNGS = {name: (image, save) for name, image, save in pngs()}


@pytest.mark.parametrize("name", PNGS)
def test_transparent_is_unknown(tmp_path, name):
    image, save = PNGS[name]
    assert import_map(write(tmp_path, image, **save)).free_area == pytest.approx(ROOM, rel=0.08)


def test_transparent_black_and_white(tmp_path):
    """1 bit a pixel: free is white, what is transparent black, and no walls but the edge of what is known."""
    image = np.zeros((90, 120), dtype=bool)
    image[10:80, 10:110] = True
    path = write(tmp_path, Image.fromarray(image), transparency=0)
    assert import_map(path).free_area == pytest.approx(ROOM, rel=0.08)


def divided():
    """The room with a part of it that was never seen, behind a wall."""
    image = picture()
    image[10:80, 60:62] = WALL
    image[10:80, 62:110] = UNKNOWN
    image[0, :] = image[-1, :] = image[:, 0] = image[:, -1] = WALL  # the margin says nothing
    return image


@pytest.mark.parametrize("negate", [0, 1])
def test_the_grey_of_map_savers_is_unknown_wherever_it_lies(tmp_path, negate):
    image = 255 - divided() if negate else divided()
    world, report = import_map_with_report(write_ros(tmp_path, image, negate=negate, free_thresh=0.25))
    assert world.free_area == pytest.approx(35.0, rel=0.1)
    assert any(f"grey {50 if negate else 205}" in text for text in report.warnings)
    with pytest.raises(MapError, match="strict=true refuses"):
        import_map(write_ros(tmp_path, image, negate=negate, free_thresh=0.25), strict=True)
    import_map(write_ros(tmp_path, image, negate=negate), strict=True)


def test_a_negated_image_whose_margin_is_grey(tmp_path):
    image = picture()
    image[image == UNKNOWN] = 206
    world, report = import_map_with_report(write_ros(tmp_path, 255 - image, negate=1))
    assert world.free_area == pytest.approx(ROOM, rel=0.08) and any("49" in text for text in report.warnings)


def test_one_shade_of_many_is_no_unknown(tmp_path):
    image = picture()
    image[image == FREE] = np.random.default_rng(0).integers(200, 256, (image == FREE).sum())
    image[20, 20] = 254
    world = import_map(write_ros(tmp_path, image, free_thresh=0.25, mode="trinary"))
    assert world.free_area > 60


SPELLINGS = {
    "plain exponents": "resolution: 1e-1\norigin: [0., -1e1, 0]\nfree_thresh: 196e-3\n",
    "capitals": "resolution: 0.1\norigin: [0, 0, 0]\nmode: TRINARY\n",
    "scale": "resolution: 0.1\norigin: [0, 0, 0]\nmode: Scale\n",
    "words": "resolution: 0.1\norigin: [0, 0, 0]\nnegate: false\n",
    "mark": "\ufeffresolution: 0.1\norigin: [0, 0, 0]\n",
    "text": "resolution: '0.1'\norigin: [0, 0, 0]\nnegate: '0'\n",
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_yaml_as_ros_reads_it(tmp_path, name):
    write_ros(tmp_path)
    (tmp_path / "floor.yaml").write_text(SPELLINGS[name] + "image: floor.pgm\n", encoding="utf-8")
    world = import_map(tmp_path / "floor.yaml")
    assert world.free_area == pytest.approx(ROOM, rel=0.08)


def test_thresholds_that_are_not_said(tmp_path):
    path = write_ros(tmp_path, free_thresh=None)
    _, report = import_map_with_report(path)
    (assumed,) = report.assumptions
    assert "map_server's free_thresh=0.196 taken" in assumed and "importing.free_threshold" in assumed
    with pytest.raises(MapError, match="free_thresh=0.196 .*strict=true refuses"):
        import_map(path, strict=True)
    import_map(path, strict=True, free_threshold=0.196)


def test_raw_values_of_one_are_walls(tmp_path):
    image = picture()
    raw = np.select([image == FREE, image == WALL], [0, 1], 255).astype(np.uint8)
    raw[10:80, 60:62] = 1
    world, report = import_map_with_report(write_ros(tmp_path, raw, mode="raw"))
    assert world.free_area < 40 and any("1 was taken as occupied" in text for text in report.warnings)
