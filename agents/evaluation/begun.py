"""What an evaluation was asked for, kept until its results are written, so that it can go on."""

import json
from pathlib import Path

from maexp.agents.errors import UserError
from maexp.agents.evaluation.kept import FOLDER
from maexp.agents.files import short, write_text
from maexp.agents.settings.overrides import from_root, set_names
from maexp.agents.settings.resolved import flatten, plain
from maexp.agents.settings.runs import Recipe
from maexp.agents.settings.verbs import EvaluateSettings

ASKED, FORMAT = "evaluation.json", "maexp-evaluation-1"
PATHS = ("checkpoint", "baseline")


def begin(where: Path, cfg: EvaluateSettings, overrides: list[str]) -> None:
    """Keep the settings of an evaluation, folders as such from the root.

    Args:
        cfg: as they were composed
        overrides: the words of the command line, for its config.yaml
    """
    settings = {name: value for name, value in flatten(plain(cfg)).items() if name != "resume"}
    settings |= {name: str(Path(settings[name]).absolute()) for name in PATHS if settings[name] is not None}
    words = settings["policy"]
    settings["policy"] = [from_root(word) for word in words] if isinstance(words, list) else words and from_root(words)
    content = {"format": FORMAT, "overrides": overrides, "settings": settings}
    write_text(where / FOLDER / ASKED, json.dumps(content, indent=2) + "\n")  # inf stays inf


def is_begun(where: Path) -> bool:
    """Whether an evaluation in this folder can go on."""
    return (where / FOLDER / ASKED).is_file()


def continue_evaluation(place: str, overrides: list[str]) -> Recipe:
    """The settings of the evaluation in a folder.

    Raises:
        UserError: there is none that was stopped, or the words set something anew.
    """
    if others := [name for name in set_names(overrides) if name != "resume"]:
        raise UserError(f"resume={place} keeps what was played and where: leave {others[0]} out.")
    where = Path(place).expanduser()
    if not is_begun(where):
        found = "is finished" if (where / "results.json").is_file() else "holds no evaluation that was stopped"
        raise UserError(f"resume={place} {found}: give the folder of a maexp evaluate that did not come to its end.")
    path = where / FOLDER / ASKED
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        words, values = [str(word) for word in content["overrides"]], dict(content["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{short(path)} is damaged, or not of the kind {FORMAT}: evaluate anew.") from error
    return Recipe([*words, *overrides], values=values, source=str(path))
