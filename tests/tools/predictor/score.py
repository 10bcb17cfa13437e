"""How well guesses of unknown ground fit maps that nobody trained on.

`python -m tests.tools.predictor.score data=FOLDER predictor=NAME_OR_FOLDER` compares a predictor with simpler
guesses on the beliefs that `tests.tools.predictor.beliefs split=validation` wrote.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from maexp.agents.files import write_json
from maexp.agents.models.map_predictor import load_predictor, predict, sample_worlds
from maexp.agents.tables import fixed, markdown_table
from maexp.envs.config_fields import check_settings, setting
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN

from .beliefs import BeliefEpisode, load_groups
from .command import run
from .train import BAND, matters

MOST_DISTANCE = 48  # cells; a histogram takes what lies farther as lying there
BINS = 15  # of the expected calibration error
COUNTED = 30  # episodes of each scenario that histograms are counted in, about
SAMPLES = 40  # worlds of each belief
LENGTHS = (0.0, 1.5, 3.0, 5.0)  # of their noise [cells]
LEAST = 1e-4  # no guess counts as more certain than so far from 0 or 1: the log-loss of a certainty could be infinite
DISTANCES = (0.25, 0.5, 1.0, 2.0)  # radar ranges up to which accuracies are told apart


@dataclass(frozen=True)
class ScoreConfig:
    """What is compared."""

    data: str = setting("beliefs/validation", "folder of beliefs for validation")
    train: str = setting("beliefs/train", "folder of beliefs that the histograms are counted in")
    predictor: str = setting("general", "name or folder")
    moments: int = setting(4, "beliefs looked at in each episode", low=1)
    out: str = setting("", 'JSON file with the figures; "": none')


@dataclass(frozen=True)
class Unknown:
    """Unknown cells of beliefs, one entry each.

    Attributes:
        free: bool, the truth.
        distance: float32, to known free ground [cells].
        beside_wall: bool, whether the nearest known cell is an obstacle.
        ranges: float32, the distance in radar ranges.
        guess: float32, of the predictor; empty where none was asked.
    """

    free: np.ndarray
    distance: np.ndarray
    beside_wall: np.ndarray
    ranges: np.ndarray
    guess: np.ndarray


def look_at(episodes: list[BeliefEpisode], moments: int, guess: Callable[[np.ndarray], np.ndarray] | None) -> Unknown:
    """Unknown cells near known free ground at some decisions of every episode, ground around the maps included."""
    parts = []
    for episode in episodes:
        margin = math.ceil(BAND * episode.reach) + 1
        truth = np.pad(episode.truth, margin)
        for k in range(moments):
            known = np.pad(episode.known(int((k + 0.5) / moments * episode.decisions)), margin)
            counts = matters(known, BAND * episode.reach)
            if counts.any():
                away = ndimage.distance_transform_edt(known != FREE)[counts].astype(np.float32)
                y, x = ndimage.distance_transform_edt(known == UNKNOWN, return_distances=False, return_indices=True)
                wall = known[y[counts], x[counts]] == OBSTACLE
                chance = guess(known)[counts] if guess else np.empty(0, np.float32)
                parts.append((truth[counts], away, wall, away / np.float32(episode.reach), chance))
    return Unknown(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def count_free(cells: list[Unknown], groups: Callable[[Unknown], np.ndarray], size: int) -> np.ndarray:
    """Share of free cells in each group, float64 [size]; every scenario counts alike."""
    free, total = np.ones(size), np.full(size, 2.0)
    for cell in cells:
        number = groups(cell)
        scale = 1e6 / len(number)
        free += scale * np.bincount(number, cell.free, size)
        total += scale * np.bincount(number, minlength=size)
    return free / total


def by_distance(cells: Unknown) -> np.ndarray:
    """Groups of `count_free`: whole cells of distance to known free ground."""
    return np.minimum(cells.distance.astype(np.int64), MOST_DISTANCE)


def by_nearest(cells: Unknown) -> np.ndarray:
    """The same, apart for cells whose nearest known one is an obstacle."""
    return by_distance(cells) + (MOST_DISTANCE + 1) * cells.beside_wall


def count_tables(groups: dict[str, list[BeliefEpisode]]) -> dict[str, np.ndarray]:
    """Histograms of training maps: what a cell is where nothing, or only what is near it, is looked at."""
    seen = [look_at(group[:: max(1, len(group) // COUNTED)], 2, None) for group in groups.values()]
    return {
        "constant": count_free(seen, lambda cells: np.zeros(len(cells.free), int), 1),
        "distance": count_free(seen, by_distance, MOST_DISTANCE + 1),
        "nearest": count_free(seen, by_nearest, 2 * (MOST_DISTANCE + 1)),
    }


def judge(free: np.ndarray, chance: np.ndarray, ranges: np.ndarray) -> dict[str, float]:
    """Figures of a guess: log-loss [nats], expected calibration error, accuracy, and that by distance."""
    chance = np.clip(chance.astype(np.float64), LEAST, 1 - LEAST)
    right = (chance > 0.5) == free
    place = np.minimum((chance * BINS).astype(int), BINS - 1)
    gap = np.bincount(place, chance, BINS) - np.bincount(place, free, BINS)
    figures = {
        "log_loss": float(-np.log(np.where(free, chance, 1 - chance)).mean()),
        "calibration_error": float(np.abs(gap).sum() / len(free)),
        "accuracy": float(right.mean()),
    }
    for low, high in zip((0.0, *DISTANCES), DISTANCES, strict=False):
        some = (ranges > low) & (ranges <= high)
        figures[f"accuracy_{high:g}"] = float(right[some].mean()) if some.any() else math.nan
    return figures


def judge_samples(
    episodes: list[BeliefEpisode], guess: Callable[[np.ndarray], np.ndarray], moments: int, lengths: Sequence[float]
) -> dict[str, dict[str, float]]:
    """Whether samples look like ground: {length: figures}, under "truth" those of the true maps.

    `alike` is the share of neighbouring unknown cells of the same state. `covered` is how often what is free within a
    radar range of a frontier cell lies within the middle 80 % of the samples, `width` how wide those are as a share of
    the unknown cells there.
    """
    rng, found = np.random.default_rng(0), {str(name): [] for name in ("truth", *lengths)}
    for episode in episodes:
        margin = math.ceil(BAND * episode.reach) + 1
        truth = np.pad(episode.truth, margin)
        for k in range(moments):
            known = np.pad(episode.known(int((k + 0.5) / moments * episode.decisions)), margin)
            frontier = np.argwhere((known == FREE) & ndimage.binary_dilation(known == UNKNOWN))
            if not len(frontier):
                continue
            y, x = frontier[rng.integers(len(frontier))]
            rows, columns = np.ogrid[: known.shape[0], : known.shape[1]]
            disc = (known == UNKNOWN) & ((rows - y) ** 2 + (columns - x) ** 2 <= episode.reach**2)
            pairs = disc[:, 1:] & disc[:, :-1]
            found["truth"].append((share_alike(truth, pairs), math.nan, math.nan))
            chance = torch.from_numpy(guess(known))[None]
            for length in lengths:
                worlds = (sample_worlds(chance, SAMPLES, int(rng.integers(1 << 30)), length)[0] == FREE).numpy()
                low, high = np.quantile(worlds[:, disc].sum(1), (0.1, 0.9))
                inside = low <= truth[disc].sum() <= high
                found[str(length)].append((share_alike(worlds, pairs), inside, (high - low) / disc.sum()))
    names = ("alike", "covered", "width")
    return {length: dict(zip(names, np.mean(rows, 0).tolist(), strict=True)) for length, rows in found.items()}


def share_alike(worlds: np.ndarray, pairs: np.ndarray) -> float:
    """Share of the pairs of neighbours along x, bool [H, W - 1], that are of one state in worlds [..., H, W]."""
    return float((worlds[..., 1:] == worlds[..., :-1])[..., pairs].mean()) if pairs.any() else 1.0


def score(config: ScoreConfig) -> dict[str, dict[str, dict[str, float]]]:
    """{scenario: {guess: figures}}; under "mean" the mean of all scenarios."""
    check_settings(config)
    net = load_predictor(config.predictor)
    tables = count_tables(load_groups(Path(config.train)))
    found = {}

    def guess(known: np.ndarray) -> np.ndarray:
        return predict(torch.from_numpy(known)[None], net)[0].numpy()

    for name, episodes in load_groups(Path(config.data)).items():
        cells = look_at(episodes, config.moments, guess)
        guesses = {
            "all free": np.ones(len(cells.free)),
            "constant": np.broadcast_to(tables["constant"], len(cells.free)),
            "distance": tables["distance"][by_distance(cells)],
            "nearest": tables["nearest"][by_nearest(cells)],
            "network": cells.guess,
        }
        found[name] = {way: judge(cells.free, guessed, cells.ranges) for way, guessed in guesses.items()}
        found[name]["cells"] = {"count": len(cells.free), "free": float(cells.free.mean())}
        found[name]["samples"] = judge_samples(episodes, guess, 2, LENGTHS)
    found["mean"] = mean_figures(list(found.values()))
    found["tables"] = {name: [round(float(chance), 4) for chance in table] for name, table in tables.items()}
    return found


def mean_figures(scores: list[dict]) -> dict:
    """The mean of the figures of several scenarios, each counting alike."""
    first = scores[0]
    if not isinstance(first, dict):
        return float(np.nanmean(scores)) if np.isfinite(scores).any() else math.nan
    return {name: mean_figures([figures[name] for figures in scores]) for name in first}


def print_scores(found: dict) -> None:
    """Tables in Markdown: of guesses, and of samples."""
    scores = {name: figures for name, figures in found.items() if name != "tables"}
    guesses = {
        name: {way: row for way, row in figures.items() if way not in ("cells", "samples")}
        for name, figures in scores.items()
    }
    print_table("guess", guesses)
    print()
    print_table("length", {name: figures["samples"] for name, figures in scores.items()})


def print_table(what: str, tables: dict[str, dict[str, dict[str, float]]]) -> None:
    """A line for each scenario and guess."""
    columns = list(next(iter(tables["mean"].values())))
    rows = [
        [scenario, way, *(fixed(3)(figures[column]) for column in columns)]
        for scenario, ways in tables.items()
        for way, figures in ways.items()
    ]
    print("\n".join(markdown_table(["scenario", what, *(column.replace("_", " ") for column in columns)], rows)))


def main(config: ScoreConfig) -> None:
    """Compare, print the tables, and write the figures where that is asked for."""
    found = score(config)
    print_scores(found)
    if config.out:
        write_json(Path(config.out), found)


if __name__ == "__main__":
    sys.exit(run(ScoreConfig, main))
