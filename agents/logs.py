"""Where the numbers of a run go: metrics.csv always, TensorBoard and Weights & Biases by configuration."""

import csv
import io
import os
from pathlib import Path
from typing import Any

from maexp.agents.errors import UserError

BACKENDS = ("tensorboard", "wandb")


class MetricsLog:
    """Rows of metrics, one an iteration, each on disk before the next iteration begins.

    Args:
        folder: the run's folder
        settings: `logger` of the settings
        kept: iteration to continue after; later rows, written by a run that was killed, are dropped
        config: plain settings, shown by W&B
    """

    def __init__(self, folder: Path, settings: Any, kept: int, config: dict):
        self.path = folder / "metrics.csv"
        self.columns = _keep_rows(self.path, kept)
        self.file = open(self.path, "a", newline="")
        self.backends = [_open_backend(name, folder, settings, config) for name in settings.backends]

    def write(self, row: dict[str, float]) -> None:
        """Add a row; the first row's names are the columns of all."""
        if self.columns is None:
            self.columns = list(row)
            self.file.write(_line(self.columns))
        unknown = [name for name in row if name not in self.columns]
        if unknown:
            raise RuntimeError(f"{unknown[0]} was not among the first row's metrics {self.columns}")
        self.file.write(_line([row.get(name, "") for name in self.columns]))
        self.file.flush()
        for backend in self.backends:
            for name, value in row.items():
                backend.log_scalar(name, value, step=row["frames"])

    def sync(self) -> None:
        """Make sure that what was written survives a power cut."""
        os.fsync(self.file.fileno())

    def close(self) -> None:
        """Finish the files."""
        self.sync()
        self.file.close()
        for backend in self.backends:
            if hasattr(backend, "experiment") and hasattr(backend.experiment, "close"):
                backend.experiment.close()


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
    aside = path.with_suffix(".tmp")
    aside.write_text("".join(_line(row) for row in [columns, *rows]))
    os.replace(aside, path)
    return columns


def read_metrics(path: Path) -> list[dict[str, float]]:
    """The rows of a metrics.csv as numbers."""
    with open(path, newline="") as file:
        return [{name: float(value or "nan") for name, value in row.items()} for row in csv.DictReader(file)]


def _open_backend(name: str, folder: Path, settings: Any, config: dict):
    if name not in BACKENDS:
        raise UserError(f"logger.backends={name} is unknown: choose of {', '.join(BACKENDS)}.")
    try:
        if name == "tensorboard":
            from torchrl.record.loggers import TensorboardLogger

            return TensorboardLogger(exp_name="tensorboard", log_dir=str(folder))
        from torchrl.record.loggers import WandbLogger

        run = f"{folder.parent.name}/{folder.name}"
        offline = settings.mode == "offline"
        return WandbLogger(
            exp_name=run, project=settings.project, offline=offline, save_dir=str(folder), config=config
        )
    except ImportError as error:
        raise UserError(f"logger={name} is not installed: run pip install 'maexp[{name}]'.") from error
