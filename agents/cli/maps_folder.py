"""`maexp maps import FOLDER`: every file of a folder that can be a map, a line each, refused ones with the reason."""

import csv
import io
import os
import time
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any

from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import short, write_json, write_text
from maexp.agents.tables import markdown_table
from maexp.envs.io import draw_import, import_map_with_report
from maexp.envs.io.bags import BAGS, is_bag
from maexp.envs.io.clouds import CLOUDS
from maexp.envs.io.formats import GRIDS, POINTS
from maexp.envs.io.occupancy import find_image
from maexp.envs.io.report import ImportReport, printable
from maexp.envs.maps.checker import MapReport, check_map

YAMLS = (".yaml", ".yml")
IMAGES = tuple(suffix for suffix in GRIDS if suffix not in YAMLS)
REPORT = "report.csv"
RUNS = "outputs"  # where runs write, as in conf/run.yaml
OTHER_ARRAYS = ("obstacles", "obstacle", "boundary", "boundaries")  # of a triple, read with its free points


@dataclass(frozen=True)
class Row:
    """What became of one file; lengths in metres, areas in square metres, empty where it was refused."""

    file: str
    result: str
    scenario: str = ""
    resolution: float | str = ""
    free_points: int | str = ""
    free_area: float | str = ""
    room: int | str = ""
    visible: str = ""
    seconds: float | str = ""
    reason: str = ""

    def line(self) -> str:
        """For the terminal."""
        if self.result == "refused":
            return f"refused  {self.file}: {self.reason}"
        what = f"{self.free_points:,} points, {self.free_area:,} m2 at {self.resolution:g} m, scenario {self.scenario}"
        return f"{self.result:<8} {self.file}: {what}{f' ({self.reason})' if self.reason else ''}"


def find_files(folder: Path) -> list[Path]:
    """The files below `folder` that can be maps: an image goes with the yaml that names it, or has its name.

    Hidden files and what earlier runs left are passed over.

    Raises:
        UserError: there are none.
    """
    files = {file for file in folder.rglob("*") if file.is_file() and file.suffix.lower() in _suffixes()}
    files = sorted({file.parent if is_bag(file.parent) else file for file in files})  # the folder of a bag is one map
    results = [report.parent for report in folder.rglob(REPORT) if report.parent != folder and _is_ours(report)]
    files = [file for file in files if not _is_hidden(file, folder) and not set(results) & set(file.parents)]
    yamls = [file for file in files if file.suffix.lower() in YAMLS]
    beside = {file.with_suffix("") for file in yamls}
    named = {image for file in yamls if (image := find_image(file)) is not None}
    files = [file for file in files if not (file.suffix.lower() in IMAGES and file.with_suffix("") in beside)]
    files = [file for file in files if os.path.abspath(file) not in named]
    files = [file for file in files if not (file.suffix == ".npy" and file.stem.lower().endswith(OTHER_ARRAYS))]
    if not files:
        raise UserError(f"{folder} holds no file that could be a map ({' '.join(_suffixes())}).")
    return files


def _is_hidden(file: Path, folder: Path) -> bool:
    """Whether a name below `folder` starts with a dot, or the file is of an earlier run and `folder` is not."""
    runs, place = Path(RUNS).resolve(), folder.resolve()
    if any(part.startswith(".") for part in file.relative_to(folder).parts):
        return True
    return file.resolve().is_relative_to(runs) and not place.is_relative_to(runs)


def _is_ours(report: Path) -> bool:
    """Whether a run of this command wrote it."""
    try:
        with open(report, encoding="utf-8", errors="replace") as file:
            return file.readline().strip() == ",".join(field.name for field in fields(Row))
    except OSError:  # a folder of that name, or not ours to read
        return False


def _suffixes() -> tuple[str, ...]:
    return (*GRIDS, *CLOUDS, *POINTS, *BAGS)


def run(folder: Path, where: Path, options: dict[str, Any]) -> int:
    """Import each file, going on after refusals; the reports are whole after every file. 1 if any was refused."""
    files, rows = find_files(folder), []
    for file in files:
        rows.append(_import(file, folder, where, options))
        print(rows[-1].line(), flush=True)
        _write_csv(rows, where / REPORT)
        _write_markdown(rows, where / "report.md")
    refused = sum(row.result == "refused" for row in rows)
    print(f"{len(rows) - refused} of {len(rows)} files became maps, {refused} were refused.")
    print(f"Written: {short(where)}/: report.csv, report.md, and of each map FILE.npz, .png, .txt and .json")
    return int(refused > 0)


def _import(file: Path, folder: Path, where: Path, options: dict[str, Any]) -> Row:
    """Import one file and write its map, picture and report under its own name, the folder's sub-folders kept."""
    begin, inside = time.perf_counter(), file.relative_to(folder)
    name = printable(str(inside))
    try:
        with blame_input():
            world, report = import_map_with_report(file, **options)
    except UserError as error:
        reason = str(error).replace(str(file), file.name)
        return Row(name, "refused", seconds=_since(begin), reason=printable(reason))
    seconds = _since(begin)
    verdict = check_map(world, num_robots=options["num_robots"], threshold=options.get("robot_radius"))
    target = where / inside
    target.parent.mkdir(parents=True, exist_ok=True)
    world.save(target.with_name(f"{file.name}.npz"))
    write_text(target.with_name(f"{file.name}.txt"), f"{report.table()}\n{verdict.table()}\n")
    write_json(target.with_name(f"{file.name}.json"), describe_import(report, verdict))
    draw_import(world, report, target.with_name(f"{file.name}.png"))
    area, seen = round(world.free_area, 1), f"{verdict.visible_share:.1%}"
    warnings = "; ".join(report.warnings)
    shown = (world.scenario, round(world.resolution, 4), len(world.free), area, verdict.room, seen, seconds, warnings)
    return Row(name, verdict.verdict, *shown)


def describe_import(report: ImportReport, verdict: MapReport) -> dict[str, Any]:
    """What an import did, and the check of its map, as plain values for a JSON file."""
    return {"verdict": verdict.verdict, "import": report.as_dict(), "map": asdict(verdict)}


def _since(begin: float) -> float:
    return round(time.perf_counter() - begin, 1)


def _write_csv(rows: list[Row], path: Path) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([field.name for field in fields(Row)])
    writer.writerows(astuple(row) for row in rows)
    write_text(path, text.getvalue())


def _write_markdown(rows: list[Row], path: Path) -> None:
    head = ("file", "result", "scenario", "resolution m", "points", "m2", "room", "visible", "s", "reason or warning")
    lines = markdown_table(head, (map(_cell, astuple(row)) for row in rows))
    write_text(path, "\n".join(lines) + "\n")


def _cell(value: Any) -> str:
    text = str(value) if isinstance(value, str) else f"{value:,}"
    return text.replace("|", "\\|").replace("\n", " ")
