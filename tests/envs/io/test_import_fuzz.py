"""Files that are damaged, odd or hostile: a map that passes the checker, or one sentence; never anything else.

Every file is imported in a process of its own (`importer.py`), so that crashes, hangs and memory are seen. A few
examples by default; by hand `pytest tests/envs/io/test_import_fuzz.py --hypothesis-profile=long` goes on until
MAEXP_FUZZ_MINUTES (30) are over for each of the two random tests, and prints how many files it tried.
"""

import os
import pickle
import struct
import time
import zipfile
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from import_process import Importer, assert_sound
from PIL import Image
from test_import_clouds import scan_room, terrain, turn, write_pcd, write_ply, write_xyz
from test_import_grids import picture

from maexp.envs import MapError, import_map, make_map

pytestmark = pytest.mark.slow  # fuzzing

LONG = settings.get_current_profile_name() == "long"
SECONDS = 60.0 * float(os.environ.get("MAEXP_FUZZ_MINUTES", 30))
QUIET = settings(
    deadline=None,
    derandomize=not LONG,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)
SHEET = "image: x.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
COUNTED = ("npz", "pgm", "binary.pcd", "binary.ply", "las", "glb")
"""Kinds of files that say how much they hold: cut short, they must be refused."""
ROOM_AREA = 43.6
tried = Counter()


@pytest.fixture(scope="module")
def importer(request):
    pytest.importorskip("laspy"), pytest.importorskip("trimesh"), pytest.importorskip("pyoctomap")
    worker = Importer()
    yield worker
    worker.close()
    if LONG:
        told = ", ".join(f"{count:,} {what}" for what, count in sorted(tried.items()))
        request.config.pluginmanager.get_plugin("terminalreporter").write_line(f"\nimport fuzzing: {told}")


def ask(importer: Importer, path: Path, what: str) -> dict:
    answer = assert_sound(importer.ask(path))
    tried[f"{what} files"] += 1
    tried[f"{what} {answer['kind']}s"] += 1
    return answer


@cache
def room(spacing: float = 0.15) -> np.ndarray:
    return scan_room(spacing=spacing)


@cache
def good_files(folder: Path) -> dict[str, bytes]:
    """One good file of every kind, by kind: "SUFFIX" or "VARIANT.SUFFIX"."""
    import laspy
    import pyoctomap
    import trimesh

    points, path = room(), folder / "good"
    files = {
        "pcd": write_pcd(path, points).read_bytes(),
        "binary.pcd": write_pcd(path, points, "binary").read_bytes(),
        "binary.ply": write_ply(path, points).read_bytes(),
        "xyz": write_xyz(path, points).read_bytes(),
        "npz": make_map("maze_small", 3).save(folder / "m.npz").read_bytes(),
        "yaml": SHEET.encode(),
    }
    rows = b"\n".join(b" ".join(b"%.4f" % value for value in row) for row in points)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property float {a}\n" for a in "xyz")
    files["ply"] = head.encode() + b"end_header\n" + rows + b"\n"
    for suffix in ("pgm", "png"):
        Image.fromarray(picture()).save(path.with_suffix(f".{suffix}"))
        files[suffix] = path.with_suffix(f".{suffix}").read_bytes()
    for kind, name in (("freespace", "npy"), ("obstacles", "obstacles.npy")):
        np.save(path, getattr(make_map("maze_small", 3), {"freespace": "free"}.get(kind, kind)))
        files[name] = path.with_suffix(".npy").read_bytes()
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.001] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = (terrain(1.5) - [512_000, 400_000, 0]).T
    for suffix in ("las", "laz"):
        data.write(path.with_suffix(f".{suffix}"))
        files[suffix] = path.with_suffix(f".{suffix}").read_bytes()
    mesh = trimesh.creation.box(bounds=[[0, 0, 0], [8, 6, 2.5]])
    for suffix in ("obj", "glb"):
        mesh.export(path.with_suffix(f".{suffix}"))
        files[suffix] = path.with_suffix(f".{suffix}").read_bytes()
    tree = pyoctomap.OcTree(0.2)
    for point in points:
        tree.updateNode(point, True)
    tree.writeBinary(str(path.with_suffix(".bt")))
    files["bt"] = path.with_suffix(".bt").read_bytes()
    return files


def put(folder: Path, kind: str, content: bytes) -> Path:
    """The file, beside what belongs to it."""
    files = good_files(folder)
    if kind in ("yaml", "pgm", "png"):
        (folder / "x.pgm").write_bytes(files["pgm"])
        (folder / "x.yaml").write_text(SHEET.replace("x.pgm", f"x.{kind}") if kind != "yaml" else SHEET)
    if kind == "npy":
        (folder / "x_obstacles.npy").write_bytes(files["obstacles.npy"])
    path = folder / (f"x_freespace.{kind}" if kind == "npy" else f"x.{kind.split('.')[-1]}")
    path.write_bytes(content)
    return path


NUMBERS = b"0 -1 1 255 65536 2147483648 99999999999999999999 nan inf 1e308 x".split()
damages = st.lists(
    st.one_of(
        st.tuples(st.just("cut"), st.floats(0, 1), st.just(0)),
        st.tuples(st.sampled_from(["set", "insert", "head"]), st.floats(0, 0.9999), st.integers(0, 255)),
        st.tuples(st.just("number"), st.floats(0, 0.9999), st.integers(0, len(NUMBERS) - 1)),
        st.tuples(st.sampled_from(["repeat", "drop"]), st.floats(0, 0.9999), st.integers(1, 5000)),
    ),
    min_size=1,
    max_size=4,
)


def damage(content: bytes, steps) -> bytes:
    for kind, place, value in steps:
        at = int(place * len(content))
        if kind == "cut":
            content = content[:at]
        elif kind in ("set", "head"):
            at = int(place * min(len(content), 400)) if kind == "head" else at
            content = content[:at] + bytes([value]) + content[at + 1 :]
        elif kind == "insert":
            content = content[:at] + bytes([value]) + content[at:]
        elif kind == "number":  # one of the numbers of a text header
            spots = [i for i in range(min(len(content), 600)) if content[i : i + 1].isdigit()]
            if spots:
                first = last = spots[int(place * len(spots))]
                while content[last : last + 1].isdigit():
                    last += 1
                content = content[:first] + NUMBERS[value] + content[last:]
        elif kind == "repeat":
            content = content[:at] + content[at : at + value] + content[at:]
        else:
            content = content[:at] + content[at + value :]
    return content


BEGIN = {}


def time_is_over(name: str) -> bool:
    return LONG and time.monotonic() - BEGIN.setdefault(name, time.monotonic()) > SECONDS


KINDS = (
    "yaml",
    "pgm",
    "png",
    "npz",
    "npy",
    "pcd",
    "binary.pcd",
    "ply",
    "binary.ply",
    "xyz",
    "las",
    "laz",
    "obj",
    "glb",
    "bt",
)


def test_undamaged_files_are_maps(importer, tmp_path):
    for kind in KINDS:
        assert ask(importer, put(tmp_path, kind, good_files(tmp_path)[kind]), "good")["kind"] == "map", kind


@settings(QUIET, max_examples=10_000 if LONG else 25)
@given(kind=st.sampled_from(KINDS), steps=damages, other=st.sampled_from([None] * 9 + list(KINDS)))
def test_damaged_files(importer, tmp_path_factory, kind, steps, other):
    if time_is_over("files"):
        return
    folder = tmp_path_factory.getbasetemp()
    good = good_files(folder)[kind]
    content = damage(good, steps)
    answer = ask(importer, put(folder, other or kind, content), "damaged")
    cut = len(steps) == 1 and steps[0][0] == "cut" and len(content) < len(good)
    if cut and kind in COUNTED and other in (None, kind):
        assert answer["kind"] == "error", f"a {kind} file cut to {len(content)} of {len(good)} bytes gave a map"


harmless = st.one_of(
    st.tuples(st.just("repeat"), st.integers(2, 5)),
    st.tuples(st.just("yaw"), st.floats(-180, 180)),
    st.tuples(st.just("tilt"), st.floats(-9, 9)),
    st.tuples(st.just("shift"), st.floats(-1e5, 1e5)),
    st.tuples(st.just("shuffle"), st.integers(0, 9)),
    st.tuples(st.just("strays"), st.integers(1, 20)),
)
harmful = st.one_of(
    st.tuples(st.just("scale"), st.floats(-4, 6)),
    st.tuples(st.just("squash"), st.sampled_from([(0, 0, 1), (1, 0, 0), (1, 1, 0), (1, 0, 1), (0, 0, 0), (1, 1, 0.1)])),
    st.tuples(st.just("tilt"), st.floats(-90, 90)),
    st.tuples(st.just("far"), st.floats(4, 300)),
    st.tuples(st.just("keep"), st.floats(0, 1)),
    st.tuples(st.just("odd"), st.sampled_from([np.nan, np.inf, -np.inf, 1e38])),
    st.tuples(st.just("heap"), st.integers(1, 100_000)),
    st.tuples(st.just("cloudy"), st.floats(-2, 4)),
)


def change(points: np.ndarray, steps) -> np.ndarray:
    rng = np.random.default_rng(0)
    with np.errstate(all="ignore"):
        for kind, value in steps:
            if kind == "repeat":
                points = np.tile(points, (value, 1))
            elif kind in ("yaw", "tilt"):
                points = turn(points, value, "z" if kind == "yaw" else "x")
            elif kind == "shift":
                points = points + [value, -0.3 * value, 0.001 * value]
            elif kind == "shuffle":
                points = rng.permutation(points)
            elif kind == "strays":
                points = np.concatenate([points, rng.uniform(-50, 50, (value, 3))])
            elif kind == "scale":
                points = points * 10.0**value
            elif kind == "squash":
                points = points * value
            elif kind == "far":
                points = points + [10.0**value, 0, 0]
            elif kind == "keep":
                points = points[: int(value**3 * len(points))]
            elif kind == "odd":
                points = np.concatenate([points, [[value, 0, 0]]])
            elif kind == "heap":
                points = np.concatenate([points, np.tile([[4.0, 3.0, 1.0]], (value, 1))])
            elif kind == "cloudy":
                points = rng.standard_normal((3000, 3)) * 10.0**value
    return points


@settings(QUIET, max_examples=10_000 if LONG else 15)
@given(
    suffix=st.sampled_from(["pcd", "ply", "xyz", "npz"]),
    steps=st.one_of(st.lists(harmless, max_size=3), st.lists(st.one_of(harmful, harmless), max_size=3)),
)
def test_odd_clouds(importer, tmp_path_factory, suffix, steps):
    if time_is_over("clouds"):
        return
    path = tmp_path_factory.getbasetemp() / f"cloud.{suffix}"
    points = change(room(), steps)
    if suffix == "npz":
        maze = make_map("maze_small", 3)
        free, obstacles = (change(cloud.astype(float), steps) for cloud in (maze.free, maze.obstacles))
        np.savez(path, freespace=free, obstacles=obstacles)
    else:
        {"pcd": write_pcd, "ply": write_ply, "xyz": write_xyz}[suffix](path, points)
    answer = ask(importer, path, "odd")
    plain = all(kind in ("repeat", "yaw", "tilt", "shift", "shuffle", "strays") for kind, _ in steps)
    tilt = sum(abs(value) for kind, value in steps if kind == "tilt")
    if plain and tilt < 10 and suffix != "npz" and answer["kind"] == "map":
        assert answer["area"] == pytest.approx(ROOM_AREA, rel=0.15), "another room than the one that was scanned"


@pytest.mark.parametrize("kind", ["binary.ply", "binary.pcd"])
def test_one_byte_less_than_promised_is_refused(kind, tmp_path):
    content = good_files(tmp_path)[kind]
    assert import_map(put(tmp_path, kind, content)).name == "x"
    with pytest.raises(MapError, match="truncated"):
        import_map(put(tmp_path, kind, content[:-1]))


def test_a_laz_that_promises_billions_of_chunks_is_refused(importer, tmp_path):
    """The decompressor asks for memory for all of them, and aborts the process."""
    content = bytearray(good_files(tmp_path)["laz"])
    assert ask(importer, put(tmp_path, "laz", bytes(content)), "hostile")["kind"] == "map"
    (points,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, points)
    for at, number in ((table + 4, 2**32 - 1), (points, 2**40), (points, -5)):
        broken = bytearray(content)
        struct.pack_into("<I" if at > points else "<q", broken, at, number)
        answer = ask(importer, put(tmp_path, "laz", bytes(broken)), "hostile")
        assert answer["kind"] == "error" and "table of its compressed points" in answer["text"]


class Payload:
    """What a pickle would run."""

    def __reduce__(self):
        return (os.mkdir, ("payload-was-run",))


def npz(path: Path, arrays: dict, claims: dict | None = None) -> Path:
    """An .npz of arrays, and of members that claim so many rows in their header and so many bytes unpacked."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, np.asanyarray(array))
        for name, (rows, unpacked) in (claims or {}).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (rows, 3)})
                file.write(bytes(2**20))
            archive.filelist[-1].file_size = unpacked
    return path


LAUGHS = "a: &a [x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
SHEETS = {  # a yaml, and a word its error must hold; None: it is a map
    "good": (SHEET, None),
    "passwd": (SHEET.replace("x.pgm", "../../../../../../../../etc/passwd"), "pgm or png"),
    "absolute": (SHEET.replace("x.pgm", "/etc/passwd"), "pgm or png"),
    "device": (SHEET.replace("x.pgm", "/dev/zero"), "not a file"),
    "long": (SHEET.replace("x.pgm", "a" * 9000), "too long"),
    "nul": (SHEET.replace("x.pgm", '"x\\0y"'), "does not exist"),
    "itself": (SHEET.replace("x.pgm", "m.yaml"), "pgm or png"),
    "folder": (SHEET.replace("x.pgm", "."), "not a file"),
    "laughs": (LAUGHS + SHEET.replace("x.pgm", "*i"), "image"),
    "laughing origin": (LAUGHS + SHEET.replace("[0.0, 0.0, 0.0]", "*i"), "origin"),
    "laughing mode": (LAUGHS + SHEET + "mode: *i\n", "mode"),
    "loop": (SHEET.replace("x.pgm", "&a [*a]"), "image"),
    "code": (SHEET + "x: !!python/object/apply:os.mkdir [payload-was-run]\n", "not yaml"),
    "stamp": (SHEET + "x: !!timestamp abc\n", "not yaml"),
    "int": (SHEET + 'x: !!int ""\n', "not yaml"),
    "bool": (SHEET + "x: !!bool x\n", "not yaml"),
    "deep": ("[" * 1500, "not yaml"),
    "huge": (SHEET.replace("0.1\n", "1" + "0" * 400 + "\n"), "resolution"),
    "hex": (SHEET.replace("0.1\n", "0x" + "f" * 50_000 + "\n"), "resolution"),
    "zero": (SHEET.replace("0.1\n", "0\n"), "resolution"),
    "negative": (SHEET.replace("0.1\n", "-0.1\n"), "resolution"),
    "nan": (SHEET.replace("0.1\n", ".nan\n"), "resolution"),
    "text": (SHEET.replace("0.1\n", "wide\n"), "resolution"),
    "true": (SHEET.replace("0.1\n", "true\n"), "resolution"),
    "thresholds": (SHEET.replace("0.196", "0.9"), "free_thresh"),
    "far": (SHEET.replace("[0.0, ", "[1.0e+300, "), "origin"),
    "no image": (SHEET.replace("image: x.pgm\n", ""), "image"),
    "missing": (SHEET.replace("x.pgm", "y.pgm"), "does not exist"),
}


def test_hostile_yaml(importer, tmp_path, monkeypatch):
    Image.fromarray(picture()).save(tmp_path / "x.pgm")
    for name, (text, words) in SHEETS.items():
        (tmp_path / "m.yaml").write_text(text)
        answer = ask(importer, tmp_path / "m.yaml", "hostile")
        assert words is None or words in answer.get("text", ""), (name, answer)
        assert (words is None) == (answer["kind"] == "map"), (name, answer)
    assert not list(Path.cwd().rglob("payload-was-run"))


def test_paths_that_are_no_files(importer, tmp_path):
    (tmp_path / "a.yaml").symlink_to(tmp_path / "b.yaml")
    (tmp_path / "b.yaml").symlink_to(tmp_path / "a.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "a.yaml", tmp_path / "pipe.yaml", tmp_path, tmp_path / ("a" * 5000), Path("/dev/zero")):
        assert ask(importer, path, "hostile")["kind"] == "error"


def test_images_that_unpack_to_much(importer, tmp_path):
    Image.fromarray(np.full((3000, 3000), 254, np.uint8)).save(tmp_path / "x.pgm")
    Image.open(tmp_path / "x.pgm").save(tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size < 100_000
    (tmp_path / "x.yaml").write_text(SHEET.replace("x.pgm", "x.png").replace("0.1\n", "2.0\n"))
    assert "max_points" in ask(importer, tmp_path / "x.yaml", "hostile")["text"]


def test_hostile_arrays(importer, tmp_path):
    """Pickles are never loaded; bombs, paths of members and arrays that do not fit one another are harmless."""
    maze = make_map("maze_small", 3)
    with np.load(maze.save(tmp_path / "m.npz")) as file:
        good = dict(file)
    kept = {name: array for name, array in good.items() if name != "free"}
    paths = {"../../../../payload": np.zeros(3), "/payload": np.zeros(3)}
    files = {
        "paths": (npz(tmp_path / "a.npz", good | paths), None),
        "pickle": (npz(tmp_path / "b.npz", kept | {"free": np.array([Payload()], dtype=object)}), "pickled"),
        "bomb": (npz(tmp_path / "c.npz", kept, {"free": (250_000_000, 3 * 10**9)}), "GiB"),
        "small bomb": (npz(tmp_path / "d.npz", kept, {"free": (20_000_000, 240_000_200)}), "at most"),
        "promise": (npz(tmp_path / "e.npz", kept, {"free": (2**60, 2**20)}), "does not hold"),
        "members": (npz(tmp_path / "f.npz", {f"a{k}": np.zeros(1) for k in range(99)}), "64 arrays"),
        "resolution": (npz(tmp_path / "g.npz", good | {"resolution": np.float64(1e30)}), "resolution"),
        "coarse": (npz(tmp_path / "h.npz", good | {"resolution": np.float64(0.01)}), "resolution"),
        "spacing": (npz(tmp_path / "i.npz", good | {"free_spacing": 1e6 * good["free_spacing"]}), "spacing"),
        "scenario": (npz(tmp_path / "j.npz", good | {"scenario": np.array("moon")}), "moon"),
        "name": (npz(tmp_path / "k.npz", good | {"name": np.array("\x1b[2J")}), "control"),
        "lifted": (npz(tmp_path / "l.npz", good | {"free": good["free"] + np.float32([0, 0, 5])}), "planar"),
        "heap": (npz(tmp_path / "m2.npz", {"freespace": np.zeros((9999, 3)), "obstacles": good["obstacles"]}), "place"),
        "no boundary": (npz(tmp_path / "n.npz", good | {"boundary": good["boundary"][:0]}), None),
    }
    np.save(tmp_path / "x_freespace.npy", np.array([Payload()], dtype=object), allow_pickle=True)
    np.save(tmp_path / "x_obstacles.npy", maze.obstacles)
    (tmp_path / "y_freespace.npy").write_bytes(pickle.dumps(Payload()))
    np.save(tmp_path / "y_obstacles.npy", maze.obstacles)
    files["pickled npy"] = (tmp_path / "x_freespace.npy", "npy")
    files["plain pickle"] = (tmp_path / "y_freespace.npy", "no .npy file")
    for name, (path, words) in files.items():
        answer = ask(importer, path, "hostile")
        assert (words is None) == (answer["kind"] == "map") and (words or "") in answer.get("text", ""), (name, answer)
        if words is None:
            assert answer["free"] == len(maze.free), name
    assert not list(Path.cwd().rglob("payload-was-run")) and not (tmp_path.parent / "payload.npy").exists()


def test_a_header_that_promises_less_than_the_file_holds(importer, tmp_path):
    """Part of a place would be a wrong map that nobody notices."""
    count, files = len(room()), good_files(tmp_path)
    for kind in ("pcd", "binary.pcd", "ply", "binary.ply", "las", "pgm"):
        content = files[kind]
        if kind == "las":
            content = content[:107] + (1000).to_bytes(4, "little") + content[111:]
        elif kind == "pgm":
            content = content.replace(b"120 90", b"120 60")
        else:
            content = content.replace(f" {count}\n".encode(), f" {count // 2}\n".encode())
        answer = ask(importer, put(tmp_path, kind, content), "hostile")
        assert content != files[kind] and answer["kind"] == "error", (kind, answer)


def test_a_room_that_leans(importer, tmp_path):
    for angle, kind in ((10, "map"), (20, "error"), (40, "error")):
        answer = ask(importer, write_ply(tmp_path / "x.ply", turn(room(), angle, "x")), "hostile")
        assert answer["kind"] == kind and (kind == "map" or f"tilted by {angle}" in answer["text"]), answer
