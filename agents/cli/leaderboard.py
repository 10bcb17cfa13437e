"""`maexp leaderboard`: runs of suites as rows, and rows as a page."""

from collections.abc import Callable, Iterator
from pathlib import Path

from maexp.agents.benchmarks.suites.suite import RESULTS
from maexp.agents.cli import Command
from maexp.agents.cli.run_folder import check_writable
from maexp.agents.config.verbs import LeaderboardSettings
from maexp.agents.errors import UserError
from maexp.agents.files import short
from maexp.agents.progress import Progress

# What needs torch is imported where it is used.


def folder(overrides: list[str], claim: Callable[[], Path]) -> None:
    """None: all is written to `out`."""
    return None


def check(cfg: LeaderboardSettings) -> None:
    """Raise UserError for what is no run and no leaderboard, and where nothing can be written."""
    if not cfg.out:
        raise UserError("out is missing: name the leaderboard's folder, as in maexp leaderboard outputs/mine out=site.")
    out = Path(cfg.out).expanduser()
    for place in _places(cfg):
        find_kind(place)
    if out.is_file():
        raise UserError(f"out={cfg.out} is a file: name a folder.")
    there = list(out.iterdir()) if out.is_dir() else []
    if there and not list(out.glob("*/*.json")):
        raise UserError(f"out={cfg.out} holds something else than a leaderboard: name a new folder.")
    if not there and not _places(cfg):
        raise UserError(f"No row is in out={cfg.out} yet: give folders of maexp suite run.")
    if not there:
        check_writable(out.absolute())


def _places(cfg: LeaderboardSettings) -> list[Path]:
    words = [cfg.places] if isinstance(cfg.places, str) else cfg.places or []
    return [Path(word).expanduser() for word in words]


def find_kind(place: Path) -> str:
    """ "run", "row" (its file) or "rows" (a leaderboard).

    Raises:
        UserError: it is none of them.
    """
    if place.is_file() and place.suffix == ".json":
        return "row"
    if (place / RESULTS).is_file():
        return "run"
    if place.is_dir() and any(place.glob("*/*.json")):
        return "rows"
    raise UserError(f"{place} is no finished run of maexp suite, no row and no leaderboard.")


def run(cfg: LeaderboardSettings, where: None, overrides: list[str]) -> int:
    """Add the rows of all places to `out`, then draw its page."""
    from maexp.agents.benchmarks import leaderboard

    out = Path(cfg.out).expanduser()
    for row in _read_all(cfg):
        row |= {} if cfg.note is None else {"note": " ".join(str(cfg.note).split())}
        path = out / leaderboard.file_of(row)
        if path.exists() and (before := leaderboard.read_row(path)) != row:
            _tell_replaced(path, before, row)
        leaderboard.write_row(out, row)  # at once: what is done stays, should a later place be damaged
    kept = [leaderboard.read_row(path) for path in leaderboard.find_rows(out)]
    written = leaderboard.write_site(out, kept)
    suites = len(leaderboard.group(kept))
    print(f"{len(kept)} rows on {suites} suite{'s' * (suites != 1)}. Written: {', '.join(map(short, written))}")
    return 0


def _tell_replaced(path: Path, before: dict, row: dict) -> None:
    """Say what a row takes the place of; UserError where that is another policy's."""
    if before["policy"] != row["policy"]:
        told = f"{row['policy']} would replace {before['policy']} in {short(path)}"
        raise UserError(f"{told}: give it another name with maexp suite run ... name=NAME.")
    suite, scores = row["suite"]["name"], [f"{version['score']['mean']:.3f}" for version in (before, row)]
    print(f"{row['policy']} on {suite} was there already, with score {scores[0]}, and is replaced: now {scores[1]}.")


def _read_all(cfg: LeaderboardSettings) -> Iterator[dict]:
    """The rows of all places, one by one."""
    from maexp.agents.benchmarks import leaderboard
    from maexp.agents.benchmarks.suites.run_files import read_json

    for place in _places(cfg):
        kind = find_kind(place)
        if kind != "run":
            yield from map(leaderboard.read_row, [place] if kind == "row" else leaderboard.find_rows(place))
            continue
        count = sum(len(part["decisions"]) for part in read_json(place / RESULTS)["episodes"].values())
        with Progress(f"playing {place} again", count) as progress:
            row = leaderboard.make_row(place, cfg.suite, cfg.verify, progress.advance)
        yield row


COMMAND = Command(run, check, folder=folder)
