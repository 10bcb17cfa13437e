"""`maexp maps fetch NAME`: a set of published maps from its public address, file by file as pinned, and imported."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from maexp.agents.cli import maps_folder
from maexp.agents.errors import UserError
from maexp.agents.files import lock, short, write_text
from maexp.agents.map_sets import FILES, LICENCES, MAPS, SPLITS, Entry, MapSet, find_cache, load_set
from maexp.agents.progress import Progress


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
    from maexp.envs.io.download import download

    entries = sorted(found.entries, key=lambda entry: entry.split != LICENCES)
    with Progress(f"fetching {found.name}", sum(entry.bytes for entry in entries)) as progress:
        for entry in entries:
            with _blame_source():
                download(
                    f"{address.rstrip('/')}/{entry.address}",
                    where / entry.place,
                    entry.bytes,
                    entry.sha256,
                    progress.advance,
                )
            if entry.split != LICENCES:
                _write_yaml(where / entry.place, entry)


@contextmanager
def _blame_source() -> Iterator[None]:
    """What the source does wrong in a sentence; the disk's errors go on."""
    from maexp.envs.io.download import DownloadError

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
