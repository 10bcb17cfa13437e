"""Grids of bags that are not as usual: updates of parts, grids of -1, 0 and 1, thresholds, float32 far away."""

import numpy as np
import pytest

from maexp.envs import MapError, import_map
from maexp.envs.io import import_map_with_report

pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: bags are not tested")
from bag_writer import cloud, grid, update, write_bag
from test_import_bags import assert_same, floor, scanned


def parts_of(values, count=4):
    """The map in vertical strips: (first column, values)."""
    edges = np.linspace(0, values.shape[1], count + 1).astype(int)
    return [(int(a), values[:, a:b]) for a, b in zip(edges[:-1], edges[1:], strict=True)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("topic", ["/map_updates", "/updates"])
def test_updates_are_applied_to_the_last_grid(tmp_path, storage, topic):
    values, cell, corner = floor(tmp_path)
    first = np.where(np.arange(values.shape[1]) < values.shape[1] // 4, values, -1)
    old = (topic, 0.5, update(np.full((3, 3), 100), 0, 0))
    messages = [old, ("/map", 1.0, grid(first, cell, corner))]
    messages += [(topic, 2.0 + i, update(part, x, 0)) for i, (x, part) in enumerate(parts_of(values))]
    world, report = import_map_with_report(write_bag(tmp_path / "slam", messages, storage))
    assert_same(world, import_map(tmp_path / "floor.yaml"))
    assert f"4 parts sent on {topic} after the last grid" in report.table()


def test_updates_that_do_not_fit_or_belong_are_told(tmp_path):
    values, cell, corner = floor(tmp_path)
    whole = grid(values, cell, corner)
    outside = update(np.full((5, 5), 100), values.shape[1] - 2, 0)
    _, report = import_map_with_report(
        write_bag(tmp_path / "a", [("/map", 0.0, whole), ("/map_updates", 1.0, outside)])
    )
    assert report.warnings == ["1 updates on /map_updates do not fit the last grid and were left out"]
    costs = [("/map", 0.0, whole), ("/cost", 0.0, whole), ("/cost_updates", 1.0, update(np.full((5, 5), 100), 0, 0))]
    world, report = import_map_with_report(write_bag(tmp_path / "b", costs), topic="/map")
    assert_same(world, import_map(tmp_path / "floor.yaml"))
    assert "on /cost_updates were not applied" in report.warnings[0]


def test_one_is_occupied_where_nothing_is_above(tmp_path):
    values, cell, corner = floor(tmp_path)
    ones = write_bag(tmp_path / "ones", [("/map", 0.0, grid(np.minimum(values, 1), cell, corner))])
    world, report = import_map_with_report(ones)
    assert_same(world, import_map(tmp_path / "floor.yaml"))
    assert any("0 and 1 and nothing above" in text for text in report.warnings)
    with pytest.raises(MapError, match=r"nothing above.*strict=true refuses"):
        import_map(ones, strict=True)
    usual = write_bag(tmp_path / "usual", [("/map", 0.0, grid(values, cell, corner))])
    _, report = import_map_with_report(usual, strict=True)
    assert not report.warnings and not report.assumptions


def test_thresholds_of_chances_are_noted_or_refused(tmp_path):
    values, cell, corner = floor(tmp_path)
    soft = np.where(values == 0, 20, np.where(values == 100, 70, values))
    bag = write_bag(tmp_path / "soft", [("/map", 0.0, grid(soft, cell, corner))])
    assert len(import_map_with_report(bag)[1].assumptions) == 2
    with pytest.raises(MapError, match="free_threshold .* 0.25.*strict"):
        import_map(bag, strict=True)
    import_map(bag, strict=True, free_threshold=0.25, occupied_threshold=0.65)


def test_clouds_in_float32_far_away(tmp_path):
    place, _ = scanned()
    far = place + [512_000.0, 5_400_000.0, 0.0]
    with pytest.raises(MapError, match=r"steps of 0\.5 m"):
        import_map(write_bag(tmp_path / "far", [("/points", 0.0, cloud(far, "map", 0.0))]))
    import_map(write_bag(tmp_path / "double", [("/points", 0.0, cloud(far, "map", 0.0, "<f8"))]))
