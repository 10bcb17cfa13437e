"""Where the numbers of a run go: metrics.csv always, TensorBoard and Weights & Biases by configuration."""

import csv
import importlib
import io
import json
import math
import os
import uuid
from contextlib import closing
from pathlib import Path
from typing import Any

from maexp.agents.config.groups import LoggerSettings
from maexp.agents.errors import UserError
from maexp.agents.evaluation.results import COLUMNS
from maexp.agents.files import write_text
from maexp.agents.tables import markdown_table

MODES = ("online", "offline")
RESULTS = "summary.json"
PICTURES = {"curves": "png", "coverage": "png", "rollout": "gif"}
"""What a logger shows of a run's files."""
Table = tuple[list[str], list[list[Any]]]


class MetricsLog:
    """Rows of metrics, one an iteration, each on disk before the next iteration begins; and one from before the first.

    Args:
        folder: the run's folder
        settings: `logger` of the settings
        kept: iteration to continue after; later rows, written by a run that was killed, are dropped
        frames: macro steps until then
        config: plain settings, shown by W&B
    """

    def __init__(self, folder: Path, settings: LoggerSettings, kept: int, frames: int, config: dict):
        self.path = folder / "metrics.csv"
        self.columns = _keep_rows(self.path, kept)
        self.first: dict[str, float] | None = None
        self.file = open(self.path, "a", newline="")
        self.backends = [BACKENDS[name](folder, settings, config, frames) for name in settings.backends]

    def begin(self, row: dict[str, float]) -> None:
        """What is known before the first iteration; in the file it waits for that, whose names are the columns."""
        self.first = row
        self._send(row)

    def write(self, row: dict[str, float]) -> None:
        """Add an iteration's row; the first one's names are the columns of all."""
        if self.columns is None:
            self.columns = list(row)
            self.file.write(_line(self.columns))
            if self.first is not None:
                self.file.write(_line([self.first.get(name, "") for name in self.columns]))
        if unknown := [name for name in row if name not in self.columns]:
            raise RuntimeError(f"{unknown[0]} was not among the first row's metrics {self.columns}")
        self.file.write(_line([row.get(name, "") for name in self.columns]))
        self.file.flush()
        self._send(row)

    def _send(self, row: dict[str, float]) -> None:
        """To TensorBoard and Weights & Biases what has a value."""
        known = {name: value for name, value in row.items() if not math.isnan(value)}
        for backend in self.backends:
            backend.write(known)

    def sync(self) -> None:
        """Make sure that what was written survives a power cut."""
        os.fsync(self.file.fileno())

    def close(self) -> None:
        """Finish the files."""
        self.sync()
        self.file.close()
        for backend in self.backends:
            backend.close()


def _line(values: list) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(values)
    return text.getvalue()


def _keep_rows(path: Path, kept: int) -> list[str] | None:
    """Cut a log after iteration `kept`; returns its columns, None where there is none."""
    if not path.is_file():
        return None
    if kept == 0:
        path.unlink()
        return None
    with open(path, newline="") as file:
        rows = list(csv.reader(file))
    columns = rows[0]
    rows = [row for row in rows[1:] if len(row) == len(columns) and int(row[0]) <= kept]
    write_text(path, "".join(_line(row) for row in [columns, *rows]))
    return columns


def check_logger(settings: LoggerSettings) -> None:
    """Raise UserError for a logger that is unknown or not installed."""
    for name in settings.backends:
        if name not in BACKENDS:
            raise UserError(f"logger.backends={name} is unknown: choose of {', '.join(BACKENDS)}.")
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise UserError(f"logger={name} is not installed: run pip install 'maexp[{name}]'.") from error
    if settings.mode not in MODES:
        raise UserError(f"logger.mode={settings.mode} is unknown: choose one of {', '.join(MODES)}.")


GROUPS = {
    "reward": ("reward", "reward_"),
    "episodes": ("episodes", "coverage", "success_rate", "collisions", "path_length"),
    "validation": ("validation_",),
    "progress": ("iteration", "frames", "seconds", "frames_per_second", "time_", "policy_lag"),
}
"""Group -> the columns of metrics.csv that it holds, by their names or what they begin with; the rest is learning."""


def tag(column: str) -> str:
    """What a column of metrics.csv is called where tags are grouped: validation_gain is validation/gain."""
    for group, names in GROUPS.items():
        if any(column == name or (name.endswith("_") and column.startswith(name)) for name in names):
            return f"{group}/{column.removeprefix(f'{group}_')}"
    return f"learning/{column}"


def compare(summary: dict[str, Any]) -> tuple[list[str], list[list[Any]]]:
    """The columns and rows of the table of a summary.json: a policy, and the means of its metrics."""
    policies = [name for name in summary["run"]["distinct_episodes"] if name in summary]
    told = [name for name in COLUMNS if all(name in summary[policy] for policy in policies)]
    metrics = [name for name in told if any(summary[policy][name]["n"] for policy in policies)]
    return ["policy", *metrics], [[policy, *(summary[policy][name]["mean"] for name in metrics)] for policy in policies]


def log_results(folder: Path, settings: LoggerSettings, frames: int, config: dict) -> None:
    """What came of a run goes to its loggers, too: the comparison, the pictures and the film.

    Args:
        folder: the run's, with its files
        frames: macro steps of its training
        config: plain settings
    """
    summary = folder / RESULTS
    table = compare(json.loads(summary.read_text())) if summary.is_file() else None
    pictures = {name: file for name in PICTURES if (file := folder / f"{name}.{PICTURES[name]}").is_file()}
    for name in settings.backends if table or pictures else ():
        backend = BACKENDS[name](folder, settings, config, frames)
        with closing(backend):
            backend.write_results(table, pictures, frames)


class TensorBoard:
    """Event files in `tensorboard/`. Where a killed run had logged beyond its checkpoint, that is struck out."""

    def __init__(self, folder: Path, settings: LoggerSettings, config: dict, frames: int):
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=frames + 1 if frames else None)

    def write(self, row: dict[str, float]) -> None:
        for name, value in row.items():
            self.writer.add_scalar(tag(name), value, row["frames"])

    def write_results(self, table: Table | None, pictures: dict[str, Path], frames: int) -> None:
        """Scalars and a table in words; pictures and film as they are, for its own encoder needs moviepy."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        if table is not None:
            columns, rows = table
            for policy, *values in rows:
                for name, value in zip(columns[1:], values, strict=True):
                    if value is not None:
                        self.writer.add_scalar(f"comparison/{name}/{policy}", value, frames)
            lines = markdown_table(columns, ([_cell(value) for value in row] for row in rows))
            self.writer.add_text("comparison", "\n".join(lines), frames)
        for name, path in pictures.items():
            width, height = Image.open(path).size
            image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
            self.writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), frames)

    def close(self) -> None:
        self.writer.close()


class WeightsAndBiases:
    """A run of W&B, the same one when it is resumed. Offline, its files wait in `wandb/` for `wandb sync`."""

    def __init__(self, folder: Path, settings: LoggerSettings, config: dict, frames: int):
        import wandb

        identity = folder / "wandb" / "identity"
        identity.parent.mkdir(exist_ok=True)
        if not identity.is_file():
            identity.write_text(uuid.uuid4().hex)
        try:
            self.run = wandb.init(
                project=settings.project,
                name=f"{folder.parent.name}/{folder.name}",
                id=identity.read_text(),
                resume="allow",
                dir=str(folder),
                mode=settings.mode,
                config=config,
                settings=wandb.Settings(silent=settings.mode == "offline"),
            )
        except wandb.Error as error:
            why = str(error).splitlines()[0]
            advice = "run wandb login, or add logger.mode=offline"
            raise UserError(f"logger=wandb cannot start ({why}): {advice}.") from error

    def write(self, row: dict[str, float]) -> None:
        self.run.log({tag(name): value for name, value in row.items()}, step=row["frames"])

    def write_results(self, table: Table | None, pictures: dict[str, Path], frames: int) -> None:
        """A table, pictures and the film."""
        import wandb

        content: dict[str, Any] = {}
        if table is not None:
            content["comparison"] = wandb.Table(columns=table[0], data=table[1])
        for name, path in pictures.items():
            film = path.suffix == ".gif"
            content[name] = wandb.Video(str(path), format="gif") if film else wandb.Image(str(path))
        self.run.log(content, step=frames)

    def close(self) -> None:
        self.run.finish()


def _cell(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:.4g}"


BACKENDS = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
