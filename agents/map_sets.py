"""Published sets of maps: their files as pinned, and where `maexp maps fetch` keeps them."""

import csv
import os
from dataclasses import dataclass
from pathlib import Path

import yaml

import maexp.conf
from maexp.agents.errors import UserError

SETS = Path(maexp.conf.__path__[0]) / "_maps"
LICENCES, FILES, MAPS = "licences", "files", "maps"
SPLITS = ("training", "validation", "test")


class MapsError(UserError):
    """Maps of a set that are wanted are not here, or not as they were."""


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
    def name(self) -> str:
        """Of the map that is made of it."""
        return Path(self.file).stem

    @property
    def place(self) -> str:
        """Where it is kept, below the folder of the set."""
        return f"{LICENCES}/{self.file}" if self.split == LICENCES else f"{FILES}/{self.split}/{self.file}"

    @property
    def map_place(self) -> str:
        """Where the map is kept that was made of it."""
        return f"{MAPS}/{self.split}/{self.name}.yaml.npz"

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
        return [entry for entry in self.entries if entry.split != LICENCES]

    @property
    def kept(self) -> Path:
        """Its folder, unless `out` says otherwise."""
        return find_cache() / self.name

    @property
    def fetch(self) -> str:
        """The command that fetches it."""
        return f"maexp maps fetch {self.name}"

    def describe(self) -> list[str]:
        """Its content and licences."""
        count = ", ".join(f"{sum(entry.split == part for entry in self.maps)} for {part}" for part in SPLITS)
        size = sum(entry.bytes for entry in self.entries) / 1e6
        lines = [f"{self.name}: {self.about}", f"{len(self.maps)} maps ({count}), {size:.1f} MB. Licences:"]
        return [*lines, *(f"  {licence} {source}" for source, licence in self.sources().items())]

    def sources(self) -> dict[str, str]:
        """Repository -> licence."""
        return {entry.source: entry.licence for entry in self.maps}


def set_names() -> list[str]:
    """The sets that come with the package."""
    return sorted(path.stem for path in SETS.glob("*.yaml"))


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
