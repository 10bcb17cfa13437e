"""`maexp maps` for maps of voxels."""

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from maexp.agents.config.verbs import MapsSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import command, write_text
from maexp.envs.io import ImportReport, import_map_with_report
from maexp.envs.maps.point_cloud import MapError, read_npz
from maexp.envs.scenarios import VOLUMES, make_map
from maexp.envs.volume.checker import VolumeReport, check_volume
from maexp.envs.volume.map import VoxelMap, is_voxel_file
from maexp.envs.volume.picture import draw_volume

UNUSABLE = 1


def check(cfg: MapsSettings) -> None:
    """Raise UserError for settings that do not fit maps of voxels."""
    if cfg.volume and cfg.task != "import":
        raise UserError(f"volume=true is for maexp maps import: leave it out of maexp maps {cfg.task}.")
    if cfg.volume and Path(cfg.file).is_dir():
        raise UserError(f"volume=true imports one file: give one of {cfg.file}.")
    if cfg.file not in VOLUMES and not cfg.volume:
        return
    if cfg.repair:
        raise UserError("repair=true is for maps in the plane: import a map of voxels again with other settings.")
    if cfg.out and cfg.task != "show" and Path(cfg.out).suffix != ".npz":
        raise UserError(f"out={cfg.out} must end in .npz for a map of voxels.")


def is_voxels(file: str | None) -> bool:
    """Whether a file is a saved map of voxels; what cannot be read is said where it is read."""
    if not file or not file.endswith(".npz") or not Path(file).is_file():
        return False
    try:
        return is_voxel_file(read_npz(file))
    except MapError:
        return False


def run(cfg: MapsSettings, where: Path, options: dict[str, Any]) -> int:
    """Do what `task` says; 1 where the map turned out unusable."""
    with blame_input():
        world, imported = read_map(cfg, options)
        report = check_volume(world, num_robots=cfg.num_robots, radius=cfg.robot.radius)
        text = "\n".join(part for part in (imported and imported.table(), report.table()) if part)
        print(text)
        written = write_files(cfg, where, world, imported)
    write_text(where / "report.txt", text + "\n")
    write_text(where / "report.json", json.dumps(describe(report, imported), indent=2) + "\n")
    print(f"Written: {', '.join(str(path) for path in written)}")
    if report.ok and cfg.task in ("make", "import"):
        print(f"Next: {command('evaluate', 'policy=cost_utility', 'scenario=volume', f'scenario.path={written[0]}')}")
    return 0 if report.ok else UNUSABLE


def read_map(cfg: MapsSettings, options: dict[str, Any]) -> tuple[VoxelMap, ImportReport | None]:
    """The map of a scenario's name or of a file, and what the import did."""
    if cfg.file in VOLUMES and not Path(cfg.file).exists():
        return make_map(cfg.file, cfg.index), None
    if cfg.task in ("check", "show"):
        return VoxelMap.load(cfg.file), None
    return import_map_with_report(cfg.file, volume=True, **options)


def write_files(cfg: MapsSettings, where: Path, world: VoxelMap, imported: ImportReport | None) -> list[Path]:
    """The map (unless it was only looked at) and its picture, in the run's folder or where `out` says."""
    name = re.sub(r"[^\w .()=+-]", "_", world.name)[:100].lstrip(".") or "map"
    written, picture = [], where / f"{name}.png"
    if cfg.task in ("make", "import"):
        written.append(world.save(Path(cfg.out) if cfg.out else where / f"{name}.npz"))
    elif cfg.task == "show" and cfg.out:
        picture = Path(cfg.out)
    before = None
    if imported is not None and imported.before is not None:
        from maexp.envs.io.report import paint_cloud

        def before(figure):
            paint_cloud(figure, imported.before)
            figure.suptitle(f"before: {Path(imported.path).name}", fontsize=11)

    return [*written, draw_volume(world, picture, before)]


def describe(report: VolumeReport, imported: ImportReport | None) -> dict[str, Any]:
    """The report for other programs."""
    steps = [] if imported is None else [asdict(step) for step in imported.steps]
    return asdict(report) | {"verdict": report.verdict, "ok": report.ok, "steps": steps}


def print_scenarios() -> None:
    """The table of scenarios in three dimensions."""
    head = f"\n{'in three dimensions':<26}{'maps':>6}{'voxel m':>11}{'size m':>14}{'radar m':>9}{'speed m/s':>11}"
    print(head + "  local x macro steps")
    for name, row in VOLUMES.items():
        size = "yours" if row.size is None else f"{row.size:g} x {row.size:g} x {row.height:g}"
        steps = f"{row.local_steps} x {row.macro_steps or 'from the free volume'}"
        print(
            f"{name:<26}{row.count or 'yours':>6}{row.resolution:>11g}{size:>14}{row.radar_range:>9g}"
            f"{row.max_speed:>11g}  {steps}"
        )
