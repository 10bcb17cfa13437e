"""`maexp maps import`: before and after in one picture, the whole report, a map for nav2, and folders of files."""

import csv

import numpy as np
import pytest
from PIL import Image
from test_import_clouds import scan_room, turn, write_pcd
from test_import_grids import write_ros
from worlds import room

from maexp.agents.cli import main
from maexp.agents.cli.maps_folder import find_files
from maexp.envs import PointCloudMap, import_map
from maexp.envs.io import draw_import, import_map_with_report
from maexp.envs.io.report import SHOWN_POINTS, ScannedPoints

pytestmark = pytest.mark.usefixtures("somewhere")


def ink(path) -> tuple[float, float]:
    """Share of dark pixels of the left and of the right half of a picture."""
    dark = np.asarray(Image.open(path).convert("L")) < 128
    half = dark.shape[1] // 2
    return float(dark[:, :half].mean()), float(dark[:, half:].mean())


def test_the_picture_shows_the_file_as_it_was_and_the_map(tmp_path):
    floor = write_ros(tmp_path)
    world, report = import_map_with_report(floor)
    np.testing.assert_array_equal(report.before.values, np.asarray(Image.open(tmp_path / "floor.pgm")))
    left, right = ink(draw_import(world, report, tmp_path / "floor.png"))
    report.before.values[:] = 255
    blank, same = ink(draw_import(world, report, tmp_path / "blank.png"))
    assert blank < 0.5 * left and same == right, "before is on the left, after on the right"


def test_a_cloud_before_its_import_is_as_the_file_holds_it(tmp_path):
    tilted = turn(scan_room(), 6, "x")
    world, report = import_map_with_report(write_pcd(tmp_path / "tilted.pcd", tilted))
    np.testing.assert_allclose(np.sort(report.before.points, axis=0), np.sort(tilted, axis=0), atol=1e-4)
    left, right = ink(draw_import(world, report, tmp_path / "tilted.png"))
    assert left > 0.005 and right > 0.005


def test_a_large_cloud_is_shown_by_a_sample_without_loss_of_digits():
    points = np.random.default_rng(0).uniform(0, 50, (SHOWN_POINTS + 5, 3)) + [500_000, 5_400_000, 300]
    shown = ScannedPoints.some_of(points).points
    assert SHOWN_POINTS / 2 <= len(shown) <= SHOWN_POINTS
    np.testing.assert_allclose(np.ptp(shown, axis=0), 50, atol=0.01)
    assert len(np.unique(shown[:, 1])) > 0.99 * len(shown), "float32 holds no millimetres of 5,400 km"


def test_a_map_for_round_robots(tmp_path, capsys):
    assert main(["maps", "import", str(write_ros(tmp_path)), "robot.radius=0.2", "out=floor.npz"]) == 0
    out = capsys.readouterr().out
    assert "round, 0.4 m across" in out and "starts 0.6 m from walls" in out
    assert "Next: maexp train scenario=pointcloud scenario.path=floor.npz robot.radius=0.2\n" in out
    assert main(["maps", "check", "floor.npz", "robot.radius=4"]) == 1, "no room for three of them"
    assert "12 m from walls and each other" in capsys.readouterr().out


def test_the_report_is_written_whole(tmp_path):
    assert main(["maps", "import", str(write_ros(tmp_path)), "hydra.run.dir=run"]) == 0
    text = (tmp_path / "run" / "report.txt").read_text()
    assert text.startswith("import of ") and "what was done" in text and "verdict         good" in text


def test_a_map_for_nav2(tmp_path, capsys):
    room(30, 21, spacing=0.2).save(tmp_path / "room.npz")
    assert main(["maps", "import", "room.npz", "out=nav.yaml", "hydra.run.dir=run"]) == 0
    assert "nav.yaml, nav.pgm" in capsys.readouterr().out and not (tmp_path / "run" / "room.npz").exists()
    back, world = import_map(tmp_path / "nav.yaml"), PointCloudMap.load(tmp_path / "room.npz")
    assert back.free_area == pytest.approx(world.free_area, rel=0.05)
    assert main(["maps", "import", "room.npz", "out=nav.txt"]) == 2
    assert "must end in .npz, or in .yaml" in capsys.readouterr().err


def make_folder(tmp_path):
    folder = tmp_path / "scans"
    write_ros(folder / "floors", name="first")
    write_ros(folder / "floors", name="second", suffix="png")
    write_pcd(folder / "room.pcd", scan_room())
    write_pcd(folder / "floors" / "first.pcd", scan_room())
    (folder / "broken.ply").write_text("ply\nnonsense")
    Image.new("L", (9, 9)).save(folder / "lonely.pgm")
    (folder / "manifest.csv").write_text("file,licence")
    return folder


def test_a_folder(tmp_path, capsys):
    make_folder(tmp_path)
    assert main(["maps", "import", "scans", "num_robots=4", "hydra.run.dir=run"]) == 1, "some were refused"
    out, err = capsys.readouterr()
    with (tmp_path / "run" / "report.csv").open(newline="") as file:
        rows = {row["file"]: row for row in csv.DictReader(file)}
    good = {"floors/first.yaml", "floors/second.yaml", "floors/first.pcd", "room.pcd"}
    assert set(rows) == good | {"broken.ply", "lonely.pgm"}, "images go with their yaml; other files are no maps"
    for name, row in rows.items():
        if name not in good:
            assert row["result"] == "refused" and row["reason"] and f"refused  {name}: {row['reason']}" in out
            continue
        world = PointCloudMap.load(tmp_path / "run" / f"{name}.npz")
        assert (row["result"], int(row["free_points"])) == ("good", len(world.free))
        assert (tmp_path / "run" / f"{name}.png").is_file()
        assert f"import of scans/{name}" in (tmp_path / "run" / f"{name}.txt").read_text()
    assert "4 of 6 files became maps, 2 were refused." in out and not err
    table = (tmp_path / "run" / "report.md").read_text().splitlines()
    assert len(table) == 2 + len(rows) and len({line.count(" | ") for line in table}) == 1


def test_a_folder_passes_over_images_that_a_yaml_names_hidden_files_and_earlier_runs(tmp_path, capsys, monkeypatch):
    folder = make_folder(tmp_path)
    sheet = folder / "floors" / "first.yaml"
    sheet.rename(folder / "floors" / "level_1.yaml")
    (folder / "floors" / "._room.pcd").write_bytes(b"left by another system")
    (folder / "odd.yaml").write_text('image: "a\\0b"\nresolution: 1')
    (folder / "floors" / "report.csv").mkdir()
    monkeypatch.chdir(folder)
    for _ in range(2):
        assert main(["maps", "import", "."]) == 1
        assert "4 of 7 files became maps, 3 were refused." in capsys.readouterr().out
    runs = [file.parent for file in folder.rglob("report.csv") if file.is_file()]
    assert len(runs) == 2
    assert len(find_files(runs[0].relative_to(folder))) == 8, "an earlier run can be asked for: 4 maps, 4 pictures"
    for name in ("here", "there"):
        assert main(["maps", "import", ".", f"hydra.run.dir={name}"]) == 1
        assert "4 of 7 files became maps, 3 were refused." in capsys.readouterr().out


def test_a_folder_of_good_files_and_its_settings(tmp_path, capsys):
    folder = make_folder(tmp_path)
    (folder / "broken.ply").unlink()
    (folder / "lonely.pgm").unlink()
    assert main(["maps", "import", "scans", "importing.resolution=0.4", "hydra.run.dir=run"]) == 0
    assert PointCloudMap.load(tmp_path / "run" / "room.pcd.npz").resolution == pytest.approx(0.4)
    capsys.readouterr()
    (tmp_path / "empty").mkdir()
    for words, named in (
        (["scans", "out=x.npz"], "out=x.npz is for one file"),
        (["scans", "importing.name=x"], "importing.name=x is for one file"),
        (["empty"], "empty holds no file that could be a map"),
    ):
        assert main(["maps", "import", *words]) == 2
        assert named in capsys.readouterr().err
