"""Sets of maps are fetched as they are pinned, from a server on this machine; what goes wrong is told in a sentence."""

import csv
import errno
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from file_server import Server
from worlds import room

from maexp.agents import map_sets
from maexp.agents.cli import main
from maexp.envs import PointCloudMap
from maexp.envs.io import download
from maexp.envs.io.map_server import export_ros_map

LICENCE = b"Do as you like.\n"
BUILDINGS = {"hall_1": ("hall", "training"), "hall_2": ("hall", "training"), "shed": ("shed", "test")}


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A set `tiny` of three floors of two buildings, and the server that has it."""
    files, rows, sets = {}, [], tmp_path / "sets"
    sets.mkdir()
    for name, (building, split) in BUILDINGS.items():
        image = export_ros_map(room(30, 21, spacing=0.2), tmp_path / f"{name}.yaml").with_suffix(".pgm")
        files[f"some/where/{name}.pgm"] = image.read_bytes()
        rows.append([split, image.name, f"some/where/{name}.pgm", building, "0.2", "0.196"])
    files["some/where/LICENSE"] = LICENCE
    rows.append(["licences", "LICENSE", "some/where/LICENSE", "", "", ""])
    with open(sets / "tiny.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow("split file address building resolution free_thresh bytes sha256 licence".split())
        for row in rows:
            body = files[row[2]]
            writer.writerow([*row, len(body), hashlib.sha256(body).hexdigest(), "MIT"])
    made = Server(files)
    (sets / "tiny.yaml").write_text(f"about: rooms\naddress: {made.address}\n")
    monkeypatch.setattr(map_sets, "SETS", sets)
    monkeypatch.setattr(download, "PAUSES", (0.0, 0.0))
    monkeypatch.setattr(download, "PATIENCE", 2.0)
    with made.serving():
        yield made


@pytest.fixture
def fetch(tmp_path, capsys):
    """Runs `maexp maps fetch tiny`: status, what it printed, the sentence."""

    def run(*words: str) -> tuple[int, str, str]:
        status = main(["maps", "fetch", "tiny", f"out={tmp_path / 'cache'}", "num_robots=1", *words])
        out, err = capsys.readouterr()
        return status, out, "".join(line for line in err.splitlines(True) if line.startswith("maexp: "))

    return run


def content(folder: Path) -> dict[str, bytes]:
    """Path -> bytes of the files that are there, hidden ones included."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_set_is_fetched_with_its_licence_split_and_imported(server, fetch, tmp_path):
    status, out, _ = fetch()
    assert status == 0
    assert "tiny: rooms" in out and "3 maps (2 for training, 0 for validation, 1 for test)" in out
    assert "  MIT some/where" in out
    assert server.asked[0] == ("LICENSE", 0), "the licence first"
    where = tmp_path / "cache" / "tiny"
    there = content(where)
    assert there["licences/LICENSE"] == LICENCE
    for name, (_, split) in BUILDINGS.items():
        assert there[f"files/{split}/{name}.pgm"] == server.files[f"some/where/{name}.pgm"]
        world = PointCloudMap.load(where / "maps" / split / f"{name}.yaml.npz")
        assert world.free_area == pytest.approx(room(30, 21, spacing=0.2).free_area, rel=0.1)
    assert not [name for name in there if name.endswith(".part") or ".lock" in name]


def test_what_is_there_is_not_fetched_again_and_what_was_changed_is(server, fetch, tmp_path):
    fetch()
    server.asked.clear()
    status, out, _ = fetch()
    assert status == 0 and server.asked == [] and "All is there" in out
    image = tmp_path / "cache" / "tiny" / "files" / "test" / "shed.pgm"
    image.write_bytes(image.read_bytes()[:-5])
    assert fetch()[0] == 0 and server.asked == [("shed.pgm", 0)]
    assert image.read_bytes() == server.files["some/where/shed.pgm"]


@pytest.mark.parametrize("ranges", [True, False])
def test_what_was_cut_off_goes_on_where_it_stopped(server, fetch, tmp_path, ranges):
    server.cut, server.ranges = 200, ranges
    status, _, told = fetch()
    assert status == 2 and "was cut off after" in told and "fetch again to go on from there" in told
    assert told.count("\n") == 1
    parts = {name: body for name, body in content(tmp_path / "cache" / "tiny").items() if name.endswith(".part")}
    assert len(parts) == 1 and not any(name.endswith(".pgm") for name in content(tmp_path / "cache" / "tiny"))
    server.cut = 0
    server.asked.clear()
    assert fetch()[0] == 0
    begins = {begin for name, begin in server.asked if name == "hall_1.pgm"}
    assert begins == {len(next(iter(parts.values())))} and min(begins) > 0
    there = content(tmp_path / "cache" / "tiny")
    assert there["files/training/hall_1.pgm"] == server.files["some/where/hall_1.pgm"]
    assert not any(name.endswith(".part") for name in there)


def test_a_server_that_is_busy_once_is_asked_again(server, fetch):
    server.busy = 1
    assert fetch()[0] == 0 and [name for name, _ in server.asked][:2] == ["LICENSE", "LICENSE"]


def change(server, name: str, body: bytes | None) -> None:
    server.files = {key: content for key, content in server.files.items() if not key.endswith(name)}
    if body is not None:
        server.files[f"some/where/{name}"] = body


@pytest.mark.parametrize("endless", [False, True])
def test_another_file_than_the_pinned_one_is_refused_and_not_kept(server, fetch, tmp_path, endless):
    good = server.files["some/where/shed.pgm"]
    change(server, "shed.pgm", good[:-1] + bytes([good[-1] ^ 1]))
    server.endless = endless
    status, _, told = fetch()
    assert status == 2 and "is not the file that is pinned here (SHA-256" in told and told.count("\n") == 1
    there = content(tmp_path / "cache" / "tiny")
    wrong = "LICENSE" if endless else "shed.pgm"  # without end: more than a chunk of what should be a few bytes
    assert not any(wrong in name for name in there) and not any(name.startswith("maps/") for name in there)


def test_a_file_that_has_moved_and_a_network_that_is_not_there(server, fetch, tmp_path):
    change(server, "hall_2.pgm", None)
    status, _, told = fetch()
    assert status == 2 and "hall_2.pgm answered 404 (Not Found): it may have moved." in told
    assert told.count("\n") == 1 and [name for name, _ in server.asked].count("hall_2.pgm") == 1, "no use in more"
    status, _, told = fetch("mirror=http://127.0.0.1:9")
    assert status == 2 and "cannot be reached (" in told and "check the network, or give mirror=ADDRESS" in told
    assert told.count("\n") == 1 and (tmp_path / "cache" / "tiny" / "licences" / "LICENSE").is_file()


def test_a_full_disk_is_one_sentence_and_nothing_half_written_stays(server, fetch, tmp_path, monkeypatch):
    def full(path, mode="r", *others):
        file = open(path, mode, *others)
        if "a" in mode and "hall_2" in str(path):
            monkeypatch.setattr(file_type := Full, "inner", file)
            return file_type()
        return file

    class Full:
        inner = None

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self.inner.close()

        def write(self, piece):
            self.inner.write(piece[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(download, "open", full, raising=False)
    status, _, told = fetch()
    assert status == 2 and "No space left on device" in told and "free some space" in told and told.count("\n") == 1
    there = content(tmp_path / "cache" / "tiny")
    assert any("hall_1.pgm" in name for name in there) and not any("hall_2.pgm" in name for name in there)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["fetch"], "maexp maps fetch needs a set (dungeons, floors) after it"),
        (["fetch", "atlantis"], "atlantis is no set of maps: choose one of dungeons, floors"),
        (["fetch", "floors", "mirror=ftp://x"], "mirror=ftp://x must begin with http:// or https://"),
    ],
)
def test_bad_words_get_a_sentence(words, told, capsys):
    assert main(["maps", *words]) == 2
    assert told in capsys.readouterr().err


def test_the_cache_is_where_such_things_are_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert map_sets.find_cache() == tmp_path / "maexp" / "maps"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert map_sets.find_cache() == Path.home() / ".cache" / "maexp" / "maps"


@pytest.mark.parametrize("name", map_sets.set_names())
def test_a_set_is_pinned_split_by_building_and_has_its_licences(name):
    found = map_sets.load_set(name)
    assert (
        len({entry.sha256 for entry in found.maps})
        == len({entry.place for entry in found.maps})
        == len(found.maps)
        > 10
    )
    assert len({Path(entry.file).stem for entry in found.maps}) == len(found.maps), "a yaml each"
    for entry in found.entries:
        assert len(entry.sha256) == 64 and 0 < entry.bytes < 10**7 and entry.split in (*map_sets.SPLITS, "licences")
        commit = entry.address.split("/")[2]
        assert len(commit) == 40 and not set(commit) - set("0123456789abcdef"), "an address that does not move"
    splits = {}
    for entry in found.maps:
        assert np.isfinite([entry.resolution, entry.free_thresh]).all()
        assert splits.setdefault(entry.building, entry.split) == entry.split
    assert set(splits.values()) == set(map_sets.SPLITS)
    licensed = {entry.source for entry in found.entries if entry.split == "licences"}
    assert set(found.sources()) == licensed and all(found.sources().values())
