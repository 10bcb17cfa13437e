"""Train the map predictor on beliefs that `tests.tools.predictor.beliefs` wrote.

`python -m tests.tools.predictor.train data=FOLDER out=FOLDER` goes on where it was stopped, with the same
numbers as if it had not been.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

from maexp.agents.errors import UserError
from maexp.agents.files import write_file, write_text
from maexp.agents.models.map_predictor import MapPredictor
from maexp.envs.config_fields import check_settings, setting
from maexp.kernels.constants import FREE, UNKNOWN

from .beliefs import BeliefEpisode, load_groups
from .command import run

BAND = 2.0  # radar ranges from known free ground within which cells count
EDGE = 8  # cells at the edge of a crop that do not count: what is known beyond is cut off
CHECKPOINT, LOG = "checkpoint.pt", "metrics.csv"


@dataclass(frozen=True)
class PredictorConfig:
    """How the predictor is trained."""

    data: str = setting("beliefs", "folder of beliefs")
    out: str = setting("map_predictor", "folder of the checkpoint and the log")
    start: str = setting("", 'folder of an earlier training whose weights are the first ones; "": none')
    width: int = setting(16, "channels of the network's finest level", low=1, high=256)
    steps: int = setting(4000, "gradient steps of the whole training", low=1)
    batch: int = setting(16, "beliefs in a step", low=1, high=4096)
    crop: int = setting(80, "side of the square cut out around a frontier cell of each", unit="cells", low=32, high=512)
    learning_rate: float = setting(2e-3, "of Adam after 100 steps; falls to 0 along a cosine", above=0, below=1)
    seed: int = setting(0, "of weights and of what is drawn", low=0)
    save_every: int = setting(100, "steps between checkpoints", low=1)


@dataclass(frozen=True)
class Crops:
    """Beliefs to learn from.

    Attributes:
        known: uint8 [B, S, S].
        truth: bool [B, S, S], what is free.
        counts: bool [B, S, S], unknown cells that the loss is about.
    """

    known: torch.Tensor
    truth: torch.Tensor
    counts: torch.Tensor


def draw_crops(groups: dict[str, list[BeliefEpisode]], count: int, side: int, rng: np.random.Generator) -> Crops:
    """Beliefs of scenarios drawn evenly, around frontier cells, turned and mirrored."""
    names = sorted(groups)
    drawn = []
    while len(drawn) < count:
        group = groups[names[rng.integers(len(names))]]
        episode = group[rng.integers(len(group))]
        known = episode.known(int(rng.integers(episode.decisions)))
        crop = cut_around(known, episode, side, rng)
        if crop is not None:
            drawn.append(turn(crop, int(rng.integers(8))))
    known, truth, counts = (torch.from_numpy(np.stack(crops)) for crops in zip(*drawn, strict=True))
    return Crops(known, truth, counts)


def cut_around(known: np.ndarray, episode: BeliefEpisode, side: int, rng: np.random.Generator):
    """A square around a frontier cell that is drawn: known, truth, counts, [side, side] each; None without frontier."""
    frontier = np.argwhere((known == FREE) & ndimage.binary_dilation(known == UNKNOWN))
    if not len(frontier):
        return None
    corner = frontier[rng.integers(len(frontier))] - side // 2 + rng.integers(-side // 8, side // 8 + 1, 2)
    known, truth = (cut(grid, corner, side) for grid in (known, episode.truth))
    counts = matters(known, BAND * episode.reach)
    counts[:EDGE] = counts[-EDGE:] = False
    counts[:, :EDGE] = counts[:, -EDGE:] = False
    return known, truth, counts


def cut(grid: np.ndarray, corner: np.ndarray, side: int) -> np.ndarray:
    """The square of `side` cells from `corner` on; 0 outside of the grid."""
    out = np.zeros((side, side), dtype=grid.dtype)
    low, high = np.maximum(corner, 0), np.minimum(corner + side, grid.shape)
    to = low - corner
    size = np.maximum(high - low, 0)
    out[to[0] : to[0] + size[0], to[1] : to[1] + size[1]] = grid[low[0] : low[0] + size[0], low[1] : low[1] + size[1]]
    return out


def matters(known: np.ndarray, band: float) -> np.ndarray:
    """Unknown cells within `band` cells of known free ground, bool [H, W]."""
    if not (known == FREE).any():
        return np.zeros(known.shape, dtype=bool)
    return (known == UNKNOWN) & (ndimage.distance_transform_edt(known != FREE) <= band)


def turn(grids: tuple[np.ndarray, ...], number: int) -> list[np.ndarray]:
    """One of the eight symmetries of a square."""
    turned = [np.rot90(grid, number % 4) for grid in grids]
    return [np.ascontiguousarray(grid.T if number >= 4 else grid) for grid in turned]


def rate(step: int, config: PredictorConfig) -> float:
    """The learning rate of a step."""
    return config.learning_rate * min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / config.steps))


def train_predictor(config: PredictorConfig, report: Callable[[str], None] = print) -> MapPredictor:
    """Train, or go on, to the end.

    Raises:
        ValueError: a setting is out of its range, or the folder holds a training with others.
    """
    check_settings(config)
    groups = load_groups(Path(config.data))
    torch.manual_seed(config.seed)
    net = start_net(config).to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.learning_rate, weight_decay=1e-4)
    step, rows = resume(config, net, optimizer)
    begin, losses = time.perf_counter(), []
    while step < config.steps:
        crops = draw_crops(groups, config.batch, config.crop, np.random.default_rng([config.seed, step]))
        for group in optimizer.param_groups:
            group["lr"] = rate(step, config)
        loss = F.binary_cross_entropy_with_logits(net(crops.known)[crops.counts], crops.truth[crops.counts].float())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
        step += 1
        if step % config.save_every == 0 or step == config.steps:
            rows.append([step, float(np.mean(losses))])
            losses = []
            save(config, net, optimizer, step, rows)
            report(f"step {step} of {config.steps}: log-loss {rows[-1][1]:.4f}, {time.perf_counter() - begin:.0f} s")
    return net.eval()


def start_net(config: PredictorConfig) -> MapPredictor:
    """The network before the first step."""
    net = MapPredictor(config.width)
    if config.start:
        path = Path(config.start) / CHECKPOINT
        saved = torch.load(path, weights_only=True) if path.is_file() else {"config": {"width": 0}}
        if saved["config"]["width"] != config.width:
            raise UserError(
                f"start={config.start} holds no training with width={config.width}: give the folder of one."
            )
        net.load_state_dict(saved["net"])
    return net


def resume(config: PredictorConfig, net: MapPredictor, optimizer: torch.optim.Optimizer) -> tuple[int, list]:
    """Where a training stands, and the rows of its log."""
    path = Path(config.out) / CHECKPOINT
    if not path.exists():
        return 0, []
    saved = torch.load(path, weights_only=True)
    now = trained_with(config)
    if saved["config"] != now:
        other = next(name for name in now if saved["config"].get(name) != now[name])
        raise UserError(
            f"out={config.out} holds a training with {other}={saved['config'].get(other)}, not {now[other]}: set that, "
            "or give another folder."
        )
    net.load_state_dict(saved["net"])
    optimizer.load_state_dict(saved["optimizer"])
    return saved["step"], saved["rows"]


def trained_with(config: PredictorConfig) -> dict:
    """Settings that the weights depend on."""
    return {name: value for name, value in asdict(config).items() if name not in ("data", "out", "start", "save_every")}


def save(config: PredictorConfig, net: MapPredictor, optimizer: torch.optim.Optimizer, step: int, rows: list) -> None:
    """Checkpoint and log."""
    content = {
        "config": trained_with(config),
        "net": net.state_dict(),
        "optimizer": optimizer.state_dict(),
        "step": step,
        "rows": rows,
    }
    write_file(Path(config.out) / CHECKPOINT, lambda file: torch.save(content, file))
    lines = ["step,log_loss", *(f"{step},{loss:.6f}" for step, loss in rows)]
    write_text(Path(config.out) / LOG, "\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(run(PredictorConfig, train_predictor))
