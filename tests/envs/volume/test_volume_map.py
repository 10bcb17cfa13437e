"""Maps of voxels: what is checked, words of bits, files."""

import io
import zipfile

import numpy as np
import pytest

from maexp.agents.files import checksum
from maexp.envs import MapError, VoxelMap
from maexp.envs.volume.map import pack_words, unpack_words


@pytest.fixture
def voxels() -> VoxelMap:
    rng = np.random.default_rng(3)
    state = rng.integers(0, 3, (7, 5, 70))
    return VoxelMap(state == 0, state == 1, 0.25, (1.0, -2.0, 0.5), name="box", scenario="cave")


def test_its_box(voxels):
    assert voxels.shape == (7, 5, 70) and voxels.num_words == 3
    assert voxels.extent == ((1.0, -2.0, 0.5), (2.75, -0.75, 18.0))
    assert voxels.free_volume == voxels.free.sum() * 0.25**3
    centres = voxels.centres(voxels.free)
    assert centres.dtype == np.float32
    assert (voxels.indices(centres) == np.argwhere(voxels.free)).all()
    assert (voxels.indices((0.9, -2.0, 18.1)) == (-1, 0, 70)).all()


def test_words_by_the_definition(voxels):
    for mask, words in zip((voxels.free, voxels.occupied), voxels.words(), strict=True):
        assert words.dtype == np.int32 and words.shape == (7, 5, 3)
        for x, y, z in np.ndindex(mask.shape):
            assert bool((int(words[x, y, z // 32]) >> (z % 32)) & 1) == mask[x, y, z]
        assert (unpack_words(words, 70) == mask).all()
    assert pack_words(np.ones((1, 1, 33), dtype=bool)).tolist() == [[[-1, 1]]]


def test_a_file_gives_the_same_map(voxels, tmp_path):
    again = VoxelMap.load(voxels.save(tmp_path / "x.npz"))
    for name in ("free", "occupied"):
        assert (getattr(again, name) == getattr(voxels, name)).all() and getattr(again, name).dtype == bool
    for name in ("resolution", "origin", "name", "scenario"):
        assert getattr(again, name) == getattr(voxels, name)
    assert checksum(again) == checksum(voxels)
    other = VoxelMap(voxels.free, voxels.occupied, 0.3, voxels.origin)
    assert checksum(other) != checksum(voxels)


def test_identity_and_hash_as_for_clouds(voxels):
    twin = VoxelMap(voxels.free, voxels.occupied, voxels.resolution, voxels.origin)
    assert voxels == voxels and voxels != twin and len({voxels, twin}) == 2


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"free": np.zeros((2, 2, 2), dtype=bool)}, "free has 0 voxels"),
        ({"free": np.ones((2, 2, 2))}, "give bool"),
        ({"free": np.ones((2, 2), dtype=bool)}, "give bool"),
        ({"free": [[1], [1, 2]]}, "ragged"),
        ({"occupied": np.zeros((2, 2, 3), dtype=bool)}, "one shape"),
        ({"occupied": np.ones((2, 2, 2), dtype=bool)}, "8 voxels are free and occupied"),
        ({"resolution": 0.0}, "resolution=0"),
        ({"origin": (0.0, 1.0)}, "origin"),
        ({"origin": (0.0, np.nan, 0.0)}, "origin"),
        ({"origin": "here"}, "origin"),
        ({"origin": (1e9, 0.0, 0.0)}, "too large for float32"),
        ({"free": np.broadcast_to(True, (1000, 1000, 65))}, "64,000,000"),
    ],
)
def test_what_is_no_map(changes, words):
    fields = {"free": np.ones((2, 2, 2), dtype=bool), "occupied": np.zeros((2, 2, 2), dtype=bool), "resolution": 0.25}
    with pytest.raises(MapError, match=words):
        VoxelMap(**fields | changes)


def test_foreign_and_changed_files(voxels, tmp_path):
    path = voxels.save(tmp_path / "x.npz")
    with np.load(path) as arrays:
        content = dict(arrays)
    for changes, words in (
        ({"format": np.array("maexp-voxels-99")}, "maexp-voxels-99"),
        ({"shape": np.array([7, 5, 71])}, "not the bits"),
        ({"shape": np.array([2**40, 5, 71])}, "64,000,000"),
        ({"shape": np.array([7, 5])}, "shape"),
        ({"origin": np.array(["a", "b", "c"])}, "origin"),
        ({"resolution": np.array(np.nan)}, "resolution"),
        ({"free": content["occupied"]}, "free and occupied"),
    ):
        np.savez(path, **content | changes)
        with pytest.raises(MapError, match=words):
            VoxelMap.load(path)
    del content["occupied"]
    np.savez(path, **content)
    with pytest.raises(MapError, match="no occupied"):
        VoxelMap.load(path)
    path.write_text("hello")
    with pytest.raises(MapError):
        VoxelMap.load(path)


def test_cut_and_crafted_files(voxels, tmp_path):
    path = voxels.save(tmp_path / "x.npz")
    data = path.read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(MapError):
            VoxelMap.load(path)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (2**40,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("free.npy", header.getvalue() + b"\0" * 12)
    with pytest.raises(MapError, match="promises"):
        VoxelMap.load(path)
    assert not list(tmp_path.glob(".*.part"))
    with pytest.raises(MapError, match="lies in no folder"):
        voxels.save(tmp_path / "none" / "x.npz")
