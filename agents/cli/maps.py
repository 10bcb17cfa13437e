"""`maexp maps`: list scenarios, make, import and fetch maps, check, repair and draw them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maexp.agents.cli import Command, maps_fetch, maps_volume
from maexp.agents.cli.maps_folder import describe_import, find_files
from maexp.agents.cli.maps_folder import run as run_folder
from maexp.agents.config.overrides import find_override
from maexp.agents.config.verbs import MapsSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import command, write_json, write_text
from maexp.agents.map_sets import set_names
from maexp.envs.io import ImportReport, draw_import, export_ros_map, import_map_with_report
from maexp.envs.io.bags import is_bag
from maexp.envs.io.options import make_options
from maexp.envs.maps.checker import check_map, repair_map
from maexp.envs.maps.plot import draw_map
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios import GENERATED, SCENARIOS, VOLUMES, make_map
from maexp.envs.volume.surfaces import VOLUME_FILES

UNUSABLE = 1
FORMATS = ".yaml (ROS map_server) .pgm .png .pcd .ply .xyz .las .laz .obj .stl .glb .bt .npz .npy .mcap .db3 (rosbag2)"


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path | None:
    """A new folder, except for the list, and for sets of maps, which have their own."""
    return None if find_override(overrides, "task") in ("list", "fetch") else claim()


def check(cfg: MapsSettings) -> None:
    """Raise UserError for what is missing or does not fit, before a folder is made."""
    if cfg.task == "list" and cfg.file:
        raise UserError(f"maexp maps list lists all scenarios and takes no file: leave {cfg.file} out.")
    if cfg.task != "list" and not cfg.file:
        what = {"make": "scenario", "fetch": f"set ({', '.join(set_names())})"}.get(cfg.task, "file")
        raise UserError(f"maexp maps {cfg.task} needs a {what} after it.")
    if cfg.task == "fetch":
        maps_fetch.check(cfg.file, cfg.mirror)
        return
    if cfg.task == "make" and cfg.file not in SCENARIOS | VOLUMES:
        known = [*GENERATED, *(name for name, row in VOLUMES.items() if row.build)]
        raise UserError(f"{cfg.file} is no scenario: choose one of {', '.join(known)}.")
    if cfg.out and Path(cfg.out).exists():
        raise UserError(f"out={cfg.out} exists already and is left alone: choose another name.")
    if cfg.out and cfg.task == "check" and Path(cfg.out).suffix != ".npz":
        raise UserError(f"out={cfg.out} must end in .npz.")
    if cfg.out and cfg.task in ("make", "import") and Path(cfg.out).suffix not in (".npz", ".yaml"):
        raise UserError(f"out={cfg.out} must end in .npz, or in .yaml for a map of map_server and nav2.")
    if cfg.out and cfg.task == "show" and Path(cfg.out).suffix != ".png":
        raise UserError(f"out={cfg.out} must end in .png.")
    if cfg.out and not Path(cfg.out).parent.is_dir():
        raise UserError(f"out={cfg.out} lies in no folder: make {Path(cfg.out).parent} first.")
    if _is_folder(cfg):
        check_folder(cfg)
    maps_volume.check(cfg)
    with blame_input():
        make_options(None, import_options(cfg))


def is_volume(cfg: MapsSettings) -> bool:
    """Whether it is about voxels: a scenario of them, an import that asks for them, or a saved map of them."""
    if cfg.volume or (cfg.file in VOLUMES and not Path(cfg.file).exists()):
        return True
    return cfg.task != "make" and maps_volume.is_voxels(cfg.file)


def _is_folder(cfg: MapsSettings) -> bool:
    """Whether a folder of several files is to be imported; the folder of a bag is one map."""
    return cfg.task == "import" and Path(cfg.file).is_dir() and not is_bag(Path(cfg.file))


def check_folder(cfg: MapsSettings) -> None:
    """Raise UserError for settings that are meant for one file."""
    if cfg.out:
        raise UserError(f"out={cfg.out} is for one file: hydra.run.dir=FOLDER says where the maps of {cfg.file} go.")
    if cfg.importing.name:
        raise UserError(f"importing.name={cfg.importing.name} is for one file: each of {cfg.file} keeps its own name.")
    find_files(Path(cfg.file))


def run(cfg: MapsSettings, where: Path | None, overrides: list[str]) -> int:
    """Do what `action` says; 1 where the map turned out unusable."""
    if cfg.task == "list":
        print_scenarios()
        return 0
    if cfg.task == "fetch":
        return maps_fetch.run(cfg.file, cfg.out, cfg.mirror, import_options(cfg))
    if _is_folder(cfg):
        return run_folder(Path(cfg.file), where, import_options(cfg))
    if is_volume(cfg):
        return maps_volume.run(cfg, where, import_options(cfg))
    with blame_input():
        world, imported = read_map(cfg)
        story = "" if imported is None else imported.table()
        report = check_map(world, num_robots=cfg.num_robots, threshold=cfg.robot.radius)
        if cfg.repair and cfg.task == "check":
            world, steps = repair_map(world, threshold=cfg.robot.radius)
            story = "\n".join(f"repair: {step}" for step in steps or ["nothing to mend"])
            report = check_map(world, num_robots=cfg.num_robots, threshold=cfg.robot.radius)
        told = "\n".join(part for part in (story, report.table()) if part)
        print(told)
        written = write_files(cfg, where, world, imported)
    write_text(where / "report.txt", told + "\n")
    if imported is not None:
        write_json(where / "report.json", describe_import(imported, report))
    print(f"Written: {', '.join(str(path) for path in written)}")
    if report.ok and cfg.task in ("make", "import"):
        size = [] if cfg.robot.radius is None else [f"robot.radius={cfg.robot.radius:g}"]
        print(f"Next: {command('train', 'scenario=pointcloud', f'scenario.path={written[0]}', *size)}")
    return 0 if report.ok else UNUSABLE


def write_files(cfg: MapsSettings, where: Path, world: PointCloudMap, imported: ImportReport | None) -> list[Path]:
    """The map (unless it was only looked at) and its picture, in the run's folder or where `out` says."""
    name = file_name(world)
    out = Path(cfg.out) if cfg.out else where / (f"{name}.png" if cfg.task == "show" else f"{name}.npz")
    written = []
    if out.suffix == ".yaml":
        written += [export_ros_map(world, out), out.with_suffix(".pgm")]
    elif cfg.task in ("make", "import") or cfg.repair:
        world.save(out)
        written.append(out)
    picture = out if cfg.task == "show" else where / f"{name}.png"
    if cfg.task == "import":
        written.append(draw_import(world, imported, picture))
    else:
        written.append(draw_map(world, picture))
    return written


def file_name(world: PointCloudMap) -> str:
    """The map's name as that of a file, for a file may name its map ../../x."""
    return re.sub(r"[^\w .()=+-]", "_", world.name)[:100].lstrip(".") or "map"


def read_map(cfg: MapsSettings) -> tuple[PointCloudMap, ImportReport | None]:
    """The map of a scenario's name or of a file, and what the import did."""
    if cfg.file in SCENARIOS and not Path(cfg.file).exists():
        return make_map(cfg.file, cfg.index), None
    if cfg.task in ("check", "show") and cfg.file.endswith(".npz"):
        return PointCloudMap.load(cfg.file), None
    return import_map_with_report(cfg.file, **import_options(cfg))


def import_options(cfg: MapsSettings) -> dict[str, Any]:
    """The settings of the import."""
    return vars(cfg.importing)


def print_scenarios() -> None:
    """The table of scenarios and the formats of files."""
    head = f"{'scenario':<26}{'maps':>6}{'spacing m':>11}{'size m':>8}{'radar m':>9}{'speed m/s':>11}"
    print(head + "  local x macro steps")
    for name, scenario in SCENARIOS.items():
        size = "yours" if scenario.size is None else f"{scenario.size:g}"
        steps = f"{scenario.local_steps} x {scenario.macro_steps or 'from the free area'}"
        print(
            f"{name:<26}{scenario.count or 'yours':>6}{scenario.resolution:>11g}{size:>8}{scenario.radar_range:>9g}"
            f"{scenario.max_speed:>11g}  {steps}"
        )
    maps_volume.print_scenarios()
    print(f"\nFiles that can be imported: {FORMATS}")
    print(f"With volume=true: {' '.join(VOLUME_FILES)} .npz")


COMMAND = Command(run, check, folder=folder)
