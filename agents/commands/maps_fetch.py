"""`maexp maps fetch NAME`: a set of published maps from its public address, file by file as pinned, and imported."""

import csv
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

import maexp.conf
from maexp.agents.commands import maps_folder
from maexp.agents.errors import UserError
from maexp.agents.files import short, write_text
from maexp.agents.locking import lock
from maexp.agents.progress import Progress

SETS = Path(maexp.conf.__path__[0]) / "_maps"
LICENCES, FILES, MAPS = "licences", "files", "maps"
SPLITS = ("training", "validation", "test")


@dataclass(frozen=True)
class Entry:
    """A file of a set: an image of a floor, or a licence.

    Attributes:
        split: training, validation, test; or licences
        address: below the set's
        bytes, sha256: what it must be
        licence: its short name
        building: floors of one are in one split
        resolution: edge of a pixel [m]
        free_thresh: of map_server
    """

    split: str
    file: str
    address: str
    bytes: int
    sha256: str
    licence: str
    building: str
    resolution: float
    free_thresh: float

    @property
    def place(self) -> str:
        """Where it is kept, below the folder of the set."""
        return f"{LICENCES}/{self.file}" if self.split == LICENCES else f"{FILES}/{self.split}/{self.file}"

    @property
    def source(self) -> str:
        """The repository, OWNER/NAME."""
        return "/".join(self.address.split("/")[:2])


@dataclass(frozen=True)
class MapSet:
    """A set of maps; `about` says what it is and `address` where it is, before those of its files."""

    name: str
    about: str
    address: str
    entries: tuple[Entry, ...]

    @property
    def maps(self) -> list[Entry]:
        return [one for one in self.entries if one.split != LICENCES]

    def describe(self) -> list[str]:
        """Its content and licences."""
        count = ", ".join(f"{sum(one.split == part for one in self.maps)} for {part}" for part in SPLITS)
        size = sum(one.bytes for one in self.entries) / 1e6
        lines = [f"{self.name}: {self.about}", f"{len(self.maps)} maps ({count}), {size:.1f} MB. Licences:"]
        return [*lines, *(f"  {licence} {source}" for source, licence in self.sources().items())]

    def sources(self) -> dict[str, str]:
        """Repository -> licence."""
        return {one.source: one.licence for one in self.maps}


def set_names() -> list[str]:
    """The sets that come with the package."""
    return sorted(one.stem for one in SETS.glob("*.yaml"))


def load_set(name: str) -> MapSet:
    """A set by its name.

    Raises:
        UserError: there is none of that name.
    """
    if name not in set_names():
        raise UserError(f"{name} is no set of maps: choose one of {', '.join(set_names())}.")
    head = yaml.safe_load((SETS / f"{name}.yaml").read_text())
    with open(SETS / f"{name}.csv", newline="") as file:
        entries = tuple(_entry(row) for row in csv.DictReader(file))
    return MapSet(name, head["about"], head["address"], entries)


def _entry(row: dict[str, str]) -> Entry:
    numbers = {name: float(row[name] or "nan") for name in ("resolution", "free_thresh")}
    return Entry(**row | numbers | {"bytes": int(row["bytes"])})


def find_cache() -> Path:
    """Where sets are kept unless `out` says otherwise."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "maexp" / "maps"


def check(name: str, mirror: str | None) -> None:
    """Raise UserError for what names no set or no server."""
    load_set(name)
    if mirror and not mirror.startswith(("http://", "https://")):
        raise UserError(f"mirror={mirror} must begin with http:// or https://.")


def run(name: str, out: str | None, mirror: str | None, options: dict[str, Any]) -> int:
    """Fetch what is missing and import it; 1 where a map was refused."""
    found = load_set(name)
    where = (Path(out).expanduser() if out else find_cache()) / name
    print("\n".join(found.describe()), flush=True)
    where.mkdir(parents=True, exist_ok=True)
    with lock(where, "maexp maps fetch"):
        _fetch(found, where, mirror or found.address)
        if _is_imported(where, found):
            print(f"All is there: {short(where / MAPS)}, {short(where / LICENCES)}")
            return 0
        status = maps_folder.run(where / FILES, where / MAPS, options)
    print(f"The maps: {short(where / MAPS)}/{{{','.join(SPLITS)}}}/FILE.npz; licences: {short(where / LICENCES)}")
    return status


def _fetch(found: MapSet, where: Path, address: str) -> None:
    """Licences first, so that no map is there without its own."""
    from maexp.envs.importing.download import download

    entries = sorted(found.entries, key=lambda one: one.split != LICENCES)
    with Progress(f"fetching {found.name}", sum(one.bytes for one in entries)) as progress:
        for one in entries:
            with _blame_source():
                download(
                    f"{address.rstrip('/')}/{one.address}", where / one.place, one.bytes, one.sha256, progress.advance
                )
            if one.split != LICENCES:
                _write_yaml(where / one.place, one)


@contextmanager
def _blame_source() -> Iterator[None]:
    """What the source does wrong in a sentence; the disk's errors go on."""
    from maexp.envs.importing.download import DownloadError

    try:
        yield
    except DownloadError as error:
        raise UserError(str(error)) from error


def _write_yaml(image: Path, entry: Entry) -> None:
    """How map_server reads the image."""
    content = {
        "image": image.name,
        "resolution": entry.resolution,
        "origin": [0.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": entry.free_thresh,
    }
    write_text(image.with_suffix(".yaml"), yaml.safe_dump(content, sort_keys=False))


def _is_imported(where: Path, found: MapSet) -> bool:
    """Whether the report has every map."""
    report = where / MAPS / maps_folder.REPORT
    if not report.is_file():
        return False
    with open(report, newline="") as file:
        return sum(1 for _ in csv.DictReader(file)) == len(found.maps)
