"""`maexp view`: a run, a recorded episode or a map in three dimensions: a window, a picture, a page in the browser."""

import zipfile
from pathlib import Path

import numpy as np

from maexp.agents.build import import_file, import_files, load_maps, make_env
from maexp.agents.cli import Command
from maexp.agents.cli.evaluate import find_trained
from maexp.agents.cli.run_folder import remove_if_empty
from maexp.agents.config.groups import MOST_TEAMS
from maexp.agents.config.overrides import find_override, quote, without
from maexp.agents.config.runs import Recipe, continue_run
from maexp.agents.config.verbs import ViewSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.evaluation.video import EPISODES, play_teams
from maexp.agents.files import command, short
from maexp.agents.policies.registry import check_planner, find_named_policy, suit_observation
from maexp.agents.training.checkpoint import find_checkpoint, is_run
from maexp.envs import PointCloudMap, make_map
from maexp.envs.render import show
from maexp.envs.render.episode import Episode
from maexp.envs.render.frames import percent
from maexp.envs.render.stage import Stage
from maexp.envs.scenarios import SCENARIOS, VOLUMES

CUT_SHARE = 0.06  # walls of an episode's picture are cut here, a share of the map's longer side: robots stay in sight
ENDINGS = (".png", ".html")
MOST_EPISODES = 2**31  # their numbers are 32-bit integers


def prepare(overrides: list[str]) -> Recipe:
    """The place to view by what it is: a scenario's name, or a run, whose own settings come first."""
    place = find_override(overrides, "place")
    if place in SCENARIOS and not Path(place).exists():
        return Recipe([f"scenario={place}", *without(overrides, "place")])
    if place is not None and is_run(Path(place)):
        overrides = [*without(overrides, "place"), f"checkpoint={quote(place)}"]
    run = find_override(overrides, "checkpoint")
    if run is None and place is not None and find_override(overrides, "scenario") is None and Path(place).is_file():
        return Recipe(["scenario=pointcloud", f"scenario.path={quote(place)}", *overrides])  # robots fit its map
    if run is None:
        return Recipe(overrides)
    return continue_run(*find_checkpoint(run), without(overrides, "place"), "view", "num_envs")


def check(cfg: ViewSettings) -> None:
    """Raise UserError for what cannot be viewed, before a folder is made."""
    last = MOST_EPISODES - cfg.num_envs
    if cfg.episode is not None and not 0 <= cfg.episode <= last:
        raise UserError(f"episode={cfg.episode} must be a whole number from 0 to {last}.")
    if cfg.policy is not None and not holds_episodes(cfg.place):  # there it only picks some of what was recorded
        check_planner(cfg.planner.name, [find_named_policy(cfg.policy)])
    if cfg.policy is not None and cfg.checkpoint is not None:
        raise UserError(f"policy={cfg.policy} and the run {cfg.checkpoint} were both given: give one of them.")
    if cfg.renderer not in show.RENDERERS:
        raise UserError(f"renderer={cfg.renderer} is unknown: choose one of {', '.join(show.RENDERERS)}.")
    if cfg.out is not None:
        check_out(Path(cfg.out))
    if wants_page(cfg):
        from maexp.envs.render.page import import_viser

        with blame_input():
            import_viser()


def holds_episodes(place: str | None) -> bool:
    """Whether recorded episodes are to be seen."""
    return place is not None and Path(place).exists() and bool(episode_files(Path(place)))


def wants_page(cfg: ViewSettings) -> bool:
    """Whether a page is asked for, in the browser or as a file."""
    return cfg.browser or str(cfg.out).endswith(".html")


def check_out(out: Path) -> None:
    """Raise UserError unless `out` can be written and its ending says what it is to be."""
    if out.suffix not in ENDINGS:
        raise UserError(f"out={out} must end in .png (a picture) or .html (a page that needs no server).")
    if out.exists():
        raise UserError(f"out={out} exists already and is left alone: choose another name.")
    if not out.parent.is_dir():
        raise UserError(f"out={out} lies in no folder: make {out.parent} first.")


def run(cfg: ViewSettings, where: Path, overrides: list[str]) -> int:
    """Find what is to be seen, and show it as asked and as this machine can."""
    with blame_input():
        episodes, world = find_subject(cfg, where)
        check_team(cfg, episodes)
        for episode in episodes:
            print(describe(episode))
        if wants_page(cfg):
            status = show_page(cfg, episodes, world)
        else:
            status = show_scene(cfg, episodes, world, where)
    remove_if_empty(where)
    return status


def find_subject(cfg: ViewSettings, where: Path) -> tuple[list[Episode], PointCloudMap | None]:
    """The episodes to be seen, or else the map.

    Raises:
        UserError: there is nothing at the place.
    """
    place = None if cfg.place is None else Path(cfg.place)
    if place is not None and (files := episode_files(place)):
        files = choose_files(files, place, cfg.episode, cfg.policy)
        return [Episode.load(file) for file in files[:MOST_TEAMS]], None
    if cfg.checkpoint is None and cfg.policy is None:
        return [], find_map(cfg, place)
    given_map = place is not None or cfg.index is not None
    maps = [find_map(cfg, place)] if given_map else load_maps(cfg.scenario, train=False).held_out
    player = find_trained(cfg) if cfg.checkpoint is not None else find_named_policy(cfg.policy)
    suit_observation(cfg, [player])
    player.check_maps(maps)
    env, first, name = make_env(cfg, maps, cfg.num_robots), cfg.episode or 0, player.name
    episodes = play_teams(env, player.make(env), name, first=first, seed=cfg.seed)
    (where / EPISODES).mkdir()
    for number, episode in enumerate(episodes, first):
        episode.save(where / EPISODES / f"{name}_{number}.npz")
    return episodes, None


def episode_files(place: Path) -> list[Path]:
    """The episode files that a place holds; none where it is a map.

    Raises:
        UserError: it is a folder without any.
    """
    if place.is_dir():
        files = sorted((place / EPISODES if (place / EPISODES).is_dir() else place).glob("*.npz"))
        if not files:
            advice = "give a run of maexp train, or of maexp evaluate with render=true"
            raise UserError(f"{place} holds neither checkpoints nor episodes: {advice}.")
        return files
    try:
        with zipfile.ZipFile(place) as archive:
            return [place] if "episode_format.npy" in archive.namelist() else []
    except (OSError, zipfile.BadZipFile):
        return []  # a map of another format, or nothing readable: the import says what is wrong


def choose_files(files: list[Path], place: Path, episode: int | None, policy: str | None) -> list[Path]:
    """Episode files by number and then policy, from `episode` on, of one `policy` or of all.

    Raises:
        UserError: there is no such episode, or none of that policy.
    """
    named = sorted((*split_name(file), file) for file in files)
    policies = sorted({name for _, name, _ in named})
    if policy is not None:
        named = [parts for parts in named if parts[1].split("_N")[0] == policy]
        if not named:
            raise UserError(f"policy={policy} has no episode in {place}: there are those of {', '.join(policies)}.")
    numbers = sorted({number for number, *_ in named})
    if episode is not None and episode not in numbers:
        gaps = numbers[-1] - numbers[0] >= len(numbers)
        held = ", ".join(map(str, numbers)) if gaps or len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
        raise UserError(f"episode={episode} is not in {place}: give {held}.")
    return [file for number, _, file in named if episode is None or number >= episode]


def split_name(file: Path) -> tuple[int, str]:
    """The number and the policy that an episode's file is named after, 0 and all of it where there is no number."""
    name, _, number = file.stem.rpartition("_")
    return (int(number), name) if number.isascii() and number.isdigit() else (0, file.stem)


def find_map(cfg: ViewSettings, place: Path | None) -> PointCloudMap:
    """The map of a file, or the one with the index in a scenario, the first by default.

    Raises:
        UserError: an index where there is only one map, or of one that is not there.
    """
    if place is not None:
        if cfg.index is not None:
            raise UserError(f"index={cfg.index} picks a map of a scenario, and {place} is one map: leave one out.")
        return import_file(str(place), cfg.scenario.importing)
    index = cfg.index or 0
    if (SCENARIOS | VOLUMES)[cfg.scenario.name].build is not None:
        return make_map(cfg.scenario.name, index)
    maps = import_files(cfg.scenario)
    if index >= len(maps):
        raise UserError(f"index={index} is not here: scenario.path gives {len(maps)}, from 0 on.")
    return maps[index]


def check_team(cfg: ViewSettings, episodes: list[Episode]) -> None:
    """Raise UserError for what needs a team where there is none, and for a robot that is not in every team."""
    for name in ("seen_by", "episode", "seconds"):
        value = getattr(cfg, name)
        if value is not None and not episodes:
            raise UserError(f"{name}={value} is not here: there is no team on a map alone; add policy=NAME.")
    fewest = min((episode.num_robots for episode in episodes), default=0)
    if cfg.seen_by is not None and not 0 <= cfg.seen_by < fewest:
        raise UserError(f"seen_by={cfg.seen_by} is not here: give one of 0 to {fewest - 1}.")


def describe(episode: Episode) -> str:
    """A line about an episode."""
    crashed = int(episode.collided[-1].sum())
    team = f"{episode.num_robots} robot{'s' * (episode.num_robots > 1)}"
    words = [episode.map.name, episode.policy, team, *[f"{crashed} collided"] * (crashed > 0)]
    return f"{', '.join(words)}: {percent(episode.coverage[-1]):.1f} % explored after {episode.seconds[-1]:.1f} s"


def record_at(episode: Episode, seconds: float | None) -> int:
    """The record at a time; the last one by default."""
    if seconds is None:
        return len(episode) - 1
    return max(int(np.searchsorted(episode.seconds, seconds + 1e-6, side="right")) - 1, 0)


def show_scene(cfg: ViewSettings, episodes: list[Episode], world: PointCloudMap | None, where: Path) -> int:
    """The first episode, or the map: a window where there is a display, else a picture."""
    snapshot = None
    if episodes:
        snapshot = episodes[0].snapshot(record_at(episodes[0], cfg.seconds))
        scene = make_stage(cfg, episodes[0].map, True).inputs(snapshot, cfg.seen_by)
    else:
        scene = make_stage(cfg, world, False).empty()
    view = {"azimuth": cfg.azimuth, "elevation": cfg.elevation}
    name = world.name if snapshot is None else episodes[0].map.name
    if show.has_display() and cfg.out is None and cfg.renderer != "painter":
        print("Opening a window of Open3D; close it to end.", flush=True)
        reason = show.open_window(scene, f"MAexp: {name}", **view)
        if reason is None:
            return 0
        print(f"There was no window ({reason}): here is a picture instead.")
    picture, how = show.draw_scene(scene, cfg.size, cfg.renderer, **view)
    out = Path(cfg.out) if cfg.out else where / "view.png"
    show.write_picture(picture, out, snapshot)
    print(f"Written: {short(out.absolute())} ({how})")
    if episodes:
        print(f"Next: {command('view', *see_again(cfg, where), 'browser=true')}")
    return 0


def see_again(cfg: ViewSettings, where: Path) -> list[str]:
    """The words that show what was just seen again, without playing it anew."""
    if (where / EPISODES).is_dir():
        return [short(where)]
    again = {"policy": cfg.policy, "episode": cfg.episode}
    return [str(cfg.place), *(f"{name}={value}" for name, value in again.items() if value is not None)]


def make_stage(cfg: ViewSettings, world: PointCloudMap, has_team: bool) -> Stage:
    """The map with its walls cut: as set, or so that a team can be seen between them."""
    (xmin, ymin), (xmax, ymax) = world.extent
    default = CUT_SHARE * max(xmax - xmin, ymax - ymin) if has_team else None
    return Stage(world, default if cfg.cut is None else cfg.cut)


def show_page(cfg: ViewSettings, episodes: list[Episode], world: PointCloudMap | None) -> int:
    """The page in the browser until interrupted, or the page as a file."""
    from maexp.envs.render.page import Page, write_page

    stages = [make_stage(cfg, episode.map, True) for episode in episodes] or [make_stage(cfg, world, False)]
    if cfg.out is not None:
        write_page(stages[0], episodes[0] if episodes else None, Path(cfg.out), cfg.seen_by)
        print(f"Written: {short(Path(cfg.out).absolute())} (open it in a browser; needs no server)")
        return 0
    page = Page(stages, episodes, port=cfg.port, seen_by=cfg.seen_by)
    print(f"Open {page.address} in a browser; Ctrl-C here ends it.", flush=True)
    try:
        page.run()
    except KeyboardInterrupt:
        print()
    finally:
        page.stop()
    return 0


COMMAND = Command(run, check, prepare=prepare)
