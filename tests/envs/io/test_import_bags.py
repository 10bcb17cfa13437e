"""Maps out of rosbag2 recordings, which `rosbags` writes here and our importer reads."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from import_process import Importer, assert_sound

from maexp.agents.cli import main
from maexp.envs import MapError, import_map
from maexp.envs.io import import_map_with_report
from maexp.envs.io.grid import FREE, OBSTACLE
from maexp.envs.io.map_server import export_ros_map
from maexp.envs.io.occupancy import read_occupancy
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport
from maexp.envs.io.ros_messages import to_points

pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: bags are not tested")
from bag_writer import cloud, grid, transforms, write_bag
from worlds import room

FLOORS = Path(__file__).resolve().parents[4] / "shared" / "data" / "maps2d"


def values_of(yaml: Path) -> tuple[np.ndarray, float, tuple]:
    """The floor of a map_server yaml as the numbers of an OccupancyGrid, its cell [m] and its corner."""
    found = read_occupancy(yaml, ImportOptions(), ImportReport(str(yaml)))
    values = np.full(found.labels.shape, -1)
    values[found.labels == FREE], values[found.labels == OBSTACLE] = 0, 100
    return values.T, found.cell, found.origin


def floor(tmp_path: Path) -> tuple[np.ndarray, float, tuple]:
    return values_of(export_ros_map(room(30, 21, spacing=0.2), tmp_path / "floor.yaml"))


def grown(values: np.ndarray, cell: float, corner: tuple, **more) -> list:
    """A SLAM's messages: ever more of the map."""
    known = [np.where(np.arange(values.shape[1]) < share * values.shape[1], values, -1) for share in (0.3, 0.6, 1.0)]
    return [("/map", t, grid(cells, cell, corner, time=float(t), **more)) for t, cells in enumerate(known)]


def assert_same(world, other) -> None:
    assert world.resolution == other.resolution
    for name in ("free", "obstacles", "boundary"):
        assert np.array_equal(getattr(world, name), getattr(other, name)), name


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_last_grid_is_the_map(tmp_path, storage):
    bag = write_bag(tmp_path / "walk", grown(*floor(tmp_path)), storage)
    expected = import_map(tmp_path / "floor.yaml")
    world, report = import_map_with_report(bag)
    assert_same(world, expected)
    assert world.name == "walk" and "the last of 3 grids on /map" in report.table()
    (file,) = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    assert_same(import_map(file), expected)


@pytest.mark.parametrize("name", ["crob_lab_slam", "rail_ilab"])
def test_a_real_floor(tmp_path, name):
    yaml = FLOORS / f"{name}.yaml"
    if not yaml.is_file():
        pytest.skip(f"REAL FLOORS ARE ABSENT: {yaml.name} is not in shared/data")
    bag = write_bag(tmp_path / name, grown(*values_of(yaml)))
    assert_same(import_map(bag), import_map(yaml))


def test_a_turned_grid(tmp_path):
    values, cell, corner = floor(tmp_path)
    bag = write_bag(tmp_path / "turned", [("/map", 0.0, grid(values, cell, (3.0, -2.0), yaw=0.7))])
    straight = import_map(write_bag(tmp_path / "straight", [("/map", 0.0, grid(values, cell, corner))]))
    c, s = math.cos(0.7), math.sin(0.7)
    turned = (straight.free[:, :2] - corner) @ np.array([[c, s], [-s, c]]) + (3.0, -2.0)
    assert np.allclose(import_map(bag).free[:, :2], turned, atol=1e-4)


def test_probabilities_of_cartographer(tmp_path):
    """0 to 100 in steps; what lies between the thresholds is unknown."""
    values, cell, corner = floor(tmp_path)
    soft = np.where(values == 0, 20, np.where(values == 100, 70, values))
    bag = write_bag(tmp_path / "soft", [("/map", 0.0, grid(soft, cell, corner))])
    assert_same(import_map(bag), import_map(tmp_path / "floor.yaml"))
    with pytest.raises(MapError, match="no cell of the grid is free"):
        import_map(bag, free_threshold=0.1)


def test_topics_are_listed(tmp_path):
    values, cell, corner = floor(tmp_path)
    whole = grid(values, cell, corner)
    costs = grid(np.where(values == 0, 50, values), cell, corner)
    bag = write_bag(tmp_path / "nav", [("/map", 0.0, whole), ("/costmap", 0.0, costs), ("/costmap", 1.0, costs)])
    with pytest.raises(MapError) as told:
        import_map(bag)
    for part in ("2 topics", "importing.topic=NAME", "/map (1 x nav_msgs/msg/OccupancyGrid)", "/costmap (2 x"):
        assert part in str(told.value)
    for topic in ("/map", "map"):
        assert_same(import_map(bag, topic=topic), import_map(tmp_path / "floor.yaml"))
    with pytest.raises(MapError, match=r"topic='/scan' of .* holds no map; it has /costmap"):
        import_map(bag, topic="/scan")
    with pytest.raises(MapError, match="has no topics"):
        import_map(tmp_path / "floor.yaml", topic="/map")


def test_a_bag_without_maps(tmp_path):
    bag = write_bag(tmp_path / "empty", [("/tf", 0.0, transforms([("map", "odom", 0.0, (0.0, 0.0, 0.0), 0.0)]))])
    with pytest.raises(MapError, match=r"holds no nav_msgs/msg/OccupancyGrid .*; it has /tf \(1 x tf2_msgs"):
        import_map(bag)


def scanned() -> tuple[np.ndarray, list]:
    """A room of 8 x 6 m with floor and walls [m], and a drive through it, scanned within 5 m."""
    side = np.arange(0, 8.01, 0.05)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side[side <= 6.01], indexing="ij"))
    edge = (x < 0.01) | (x > 7.99) | (y < 0.01) | (y > 5.99)
    layers = [(x, y, 0.0), *((x[edge], y[edge], z) for z in np.arange(0.05, 1.5, 0.05))]
    place = np.concatenate([np.column_stack([a, b, np.full(len(a), z)]) for a, b, z in layers])
    messages = [
        ("/tf_static", 0.0, transforms([("base_link", "lidar", 0.0, (0.2, 0.0, 0.4), 0.3)])),
        ("/tf", 0.0, transforms([("map", "odom", 0.0, (1.0, 1.0, 0.0), 0.5)])),
    ]
    for t in np.arange(0.0, 6.0, 0.5):
        where, yaw = np.array([1.0 + t, 3.0]), 0.4 * t
        inverse = np.array([[math.cos(0.5), math.sin(0.5)], [-math.sin(0.5), math.cos(0.5)]])
        local = inverse @ (where - (1.0, 1.0))  # of the base in odom
        messages.append(("/tf", t, transforms([("odom", "/base_link", t, (*local.tolist(), 0.0), yaw - 0.5)])))
    for t in np.arange(0.25, 5.5, 0.5):  # between two transforms
        where, yaw = np.array([1.0 + t, 3.0]), 0.4 * t
        base = turned_back(place, where, yaw)
        near = base[np.linalg.norm(base[:, :2], axis=1) < 5]
        points = turned_back(near - (0, 0, 0.4), np.array([0.2, 0.0]), 0.3)
        points = np.concatenate([points, np.full((3, 3), np.nan)])
        messages.append(("/points", float(t), cloud(points, "lidar", float(t))))
    return place, messages


def turned_back(points: np.ndarray, where: np.ndarray, yaw: float) -> np.ndarray:
    """World points in the frame of something at `where` that looks along `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    result = points.copy()
    result[:, :2] = (points[:, :2] - where) @ np.array([[c, -s], [s, c]])
    return result


@pytest.mark.parametrize("real", ["<f4", ">f4", "<f8", ">f8"])
def test_points_as_drivers_write_them(real):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(real)
    message = cloud(points, "lidar", 0.0, real)
    assert np.array_equal(to_points(Path("bag"), message), points)
    message.height, message.width = 5, 10  # in rows, each padded to a multiple of 512 bytes
    size = message.point_step * 10
    rows = np.zeros((5, 512), np.uint8)
    rows[:, :size] = message.data.reshape(5, size)
    message.data, message.row_step = rows.ravel(), 512
    assert np.array_equal(to_points(Path("bag"), message), points)


def test_clouds_are_registered_by_tf(tmp_path):
    place, messages = scanned()
    world, report = import_map_with_report(write_bag(tmp_path / "drive", messages), resolution=0.2)
    np.savetxt(tmp_path / "place.xyz", place)
    expected = import_map(tmp_path / "place.xyz", resolution=0.2)
    assert "11 clouds of /points in the frame map" in report.table() and not report.warnings
    assert np.allclose(world.extent, expected.extent, atol=0.11)
    assert world.free_area == pytest.approx(expected.free_area, rel=0.05)
    walls = world.boundary[:, :2]
    away = np.abs(walls[:, None] - [(0.0, 0.0), (8.0, 6.0)]).min(axis=(1, 2))  # to the nearest of four walls
    assert away.max() < 0.25


def test_clouds_without_their_transforms(tmp_path):
    _, messages = scanned()
    late = [message for message in messages if message[0] != "/tf" or message[1] < 2.1]
    _, report = import_map_with_report(write_bag(tmp_path / "late", late), resolution=0.2)
    assert report.warnings[0] == "7 of 11 clouds had no transform at their time and were left out"
    never = [message for message in messages if message[0] != "/tf"] + [
        ("/tf", 0.0, transforms([("odom", "base_link", t, (t, 0.0, 0.0), 0.0) for t in (90.0, 91.0)]))
    ]
    with pytest.raises(MapError, match="of 11 clouds on /points 11 had no transform"):
        import_map(write_bag(tmp_path / "never", never))
    alone = [message for message in messages if message[0] == "/points"]
    _, report = import_map_with_report(write_bag(tmp_path / "alone", alone), resolution=0.2)
    assert "no transform in the bag moves lidar" in report.warnings[0]


def test_transforms_that_run_in_a_circle(tmp_path):
    circle = transforms([("a", "lidar", 0.0, (0.0, 0.0, 0.0), 0.0), ("lidar", "a", 0.0, (0.0, 0.0, 0.0), 0.0)])
    points = cloud(np.zeros((5, 3)), "lidar", 0.0)
    with pytest.raises(MapError, match="1 had no transform"):
        import_map(write_bag(tmp_path / "circle", [("/tf", 0.0, circle), ("/points", 0.0, points)]))


def broken(change) -> object:
    message = grid(np.zeros((4, 5)), 0.1)
    change(message)
    return message


DAMAGED = {
    "promises 9 x 4 cells and holds 20": lambda m: setattr(m.info, "width", 9),
    "resolution=0 must be": lambda m: setattr(m.info, "resolution", 0.0),
    "resolution=nan must be": lambda m: setattr(m.info, "resolution", math.nan),
    "is no place": lambda m: setattr(m.info.origin.position, "x", math.inf),
    "no cell of the grid is free": lambda m: setattr(m, "data", np.full(20, 100, np.int8)),
}


@pytest.mark.parametrize(("told", "change"), DAMAGED.items(), ids=DAMAGED)
def test_grids_that_are_none(tmp_path, told, change):
    with pytest.raises(MapError, match=told):
        import_map(write_bag(tmp_path / "bag", [("/map", 0.0, broken(change))]))


def test_clouds_that_are_none(tmp_path):
    short = cloud(np.zeros((50, 3)), "map", 0.0)
    short.data = short.data[:100]
    with pytest.raises(MapError, match="promises 50 x 1 points and holds 100 bytes"):
        import_map(write_bag(tmp_path / "short", [("/points", 0.0, short)]))
    flat = cloud(np.zeros((50, 3)), "map", 0.0)
    flat.fields = flat.fields[:2]
    with pytest.raises(MapError, match="the fields intensity, x"):
        import_map(write_bag(tmp_path / "flat", [("/points", 0.0, flat)]))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_damaged_files_are_sentences(tmp_path, storage):
    """Cut off anywhere, with bytes turned over, or text: one sentence or a map, in seconds and little memory."""
    bag = write_bag(tmp_path / "bag", grown(*floor(tmp_path)), storage)
    (file,) = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    whole, rng, importer = file.read_bytes(), np.random.default_rng(0), Importer()
    cases = [whole[: int(share * len(whole))] for share in (0.001, 0.3, 0.9, 0.999)] + [b"no bag at all"]
    for _ in range(4):
        spoilt = np.frombuffer(whole, dtype=np.uint8).copy()
        spoilt[rng.integers(0, len(whole), 40)] ^= 0xFF
        cases.append(spoilt.tobytes())
    refused = 0
    try:
        for i, data in enumerate(cases):
            damaged = tmp_path / f"damaged{i}{file.suffix}"
            damaged.write_bytes(data)
            refused += assert_sound(importer.ask(damaged))["kind"] == "error"
    finally:
        importer.close()
    assert refused >= 4


def test_folders_that_are_no_bags(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: 3")
    with pytest.raises(MapError, match="cannot be read as a bag"):
        import_map(tmp_path / "bag")
    bag = write_bag(tmp_path / "lost", grown(*floor(tmp_path)))
    next(bag.glob("*.mcap")).unlink()
    with pytest.raises(MapError, match="files are missing"):
        import_map(bag)
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(MapError, match="0 bytes"):
        import_map(tmp_path / "empty.mcap")


def test_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    values, cell, corner = floor(tmp_path)
    whole = grid(values, cell, corner)
    bag = write_bag(tmp_path / "scans" / "nav", [("/map", 0.0, whole), ("/costmap", 0.0, whole)], "sqlite3")
    assert main(["maps", "import", str(bag)]) == 2
    told = capsys.readouterr().err
    assert "importing.topic=NAME" in told and told.count("\n") == 1
    assert main(["maps", "import", str(bag), "importing.topic=/map", "hydra.run.dir=out"]) == 0
    assert (tmp_path / "out" / "nav.npz").is_file() and (tmp_path / "out" / "nav.png").is_file()
    write_bag(tmp_path / "scans" / "walk", grown(values, cell, corner))
    assert main(["maps", "import", "scans", "hydra.run.dir=all"]) == 1
    told = capsys.readouterr().out
    assert "1 of 2 files became maps, 1 were refused" in told and "good     walk:" in told


def test_the_extra_is_named(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", grown(*floor(tmp_path)))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MapError, match=r'pip install "maexp\[rosbag\]"'):
        import_map(bag)
