"""An occupancy grid of the team from its ranges, in log-odds."""

from __future__ import annotations

import numpy as np

from .simulator import Scan

MISS, HIT = -0.5, 0.9  # evidence of one beam
LEAST, MOST = -2.5, 3.5  # so that people who have left are soon forgotten
DEEP = 0.3  # cells behind a measured surface that stand for it
MATE = 0.4  # [m]; a surface this near a team mate's centre is the mate


class TeamGrid:
    """Cells [rows along y, columns along x] that all robots write into.

    Args:
        low, high: corners of the area [m]; what lies outside is not mapped.
        cell: side of a cell [m].
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, cell: float):
        self.low, self.cell = np.asarray(low, float), cell
        width, height = np.ceil((np.asarray(high) - low) / cell).astype(int)
        self.evidence = np.zeros((height, width), np.float32)
        self.touched = np.zeros((height, width), bool)

    def add(self, pose: np.ndarray, scan: Scan, mates: np.ndarray) -> None:
        """Write a scan from where the robot believes to be; x, y [m], heading [rad]; `mates` [m] [k, 2]."""
        turn = pose[2] + scan.angles
        way = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        ends = pose[:2] + scan.ranges[:, None] * way
        mate = np.zeros(len(ends), bool)
        if len(mates):
            mate = (np.linalg.norm(ends[:, None] - mates, axis=-1) < MATE).any(axis=1)
        along = np.arange(0.0, scan.ranges.max(), 0.5 * self.cell)
        before = along < (scan.ranges - np.where(scan.hit, 0.25 * self.cell, 0.0))[:, None]
        clear = pose[:2] + along[:, None] * way[:, None]
        misses = self._cells(clear[before])
        hits = self._cells((ends + DEEP * self.cell * way)[scan.hit & ~mate])
        misses = np.setdiff1d(misses, hits, assume_unique=True)
        flat, touched = self.evidence.reshape(-1), self.touched.reshape(-1)
        for cells, evidence in ((misses, MISS), (hits, HIT)):
            flat[cells] = (flat[cells] + evidence).clip(LEAST, MOST)
            touched[cells] = True

    def _cells(self, places: np.ndarray) -> np.ndarray:
        """Numbers of the cells of places [m], each once."""
        height, width = self.evidence.shape
        index = np.floor((places - self.low) / self.cell).astype(int)
        index = index[((index >= 0) & (index < (width, height))).all(axis=1)]
        return np.unique(index[:, 1] * width + index[:, 0])

    def values(self) -> np.ndarray:
        """As ROS has it: -1 unknown, 0 free to 100 occupied; int8 [H, W]."""
        chance = np.rint(100 / (1 + np.exp(-self.evidence)))
        return np.where(self.touched, chance, -1).astype(np.int8)
