"""Imagined worlds by definition: what is known where it is, a guess elsewhere, cell by cell."""

import numpy as np

UNKNOWN, FREE, OBSTACLE = 0, 1, 2


def imagine(known, guess, margin: int, corner, cell: float, walls: dict) -> dict:
    """What a world is made of.

    known: (H, W) of the true grid; guess: (H + 2 margin, W + 2 margin); corner: lower corner of the true grid [m].
    walls: {(row, column) of the true grid: (x, y)} of known wall points; others stand in the middle of their cells.

    Returns:
        "free", "walls": {(row, column) of the world: (x, y)}; "known": set of cells; "beside": {free cell: wall cells}.
    """
    rows, columns = np.asarray(guess).shape
    free, found, certain = {}, {}, set()
    for r in range(rows):
        for c in range(columns):
            y, x = r - margin, c - margin
            inside = 0 <= y < known.shape[0] and 0 <= x < known.shape[1]
            state = int(known[y, x]) if inside else UNKNOWN
            if state != UNKNOWN:
                certain.add((r, c))
            middle = (corner[0] + (x + 0.5) * cell, corner[1] + (y + 0.5) * cell)
            if (state or int(guess[r, c])) == OBSTACLE:
                found[r, c] = walls.get((y, x), middle) if state == OBSTACLE else middle
            else:
                free[r, c] = middle
    near = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)]
    beside = {(r, c): {(r + dr, c + dc) for dr, dc in near if (r + dr, c + dc) in found} for r, c in free}
    return {"free": free, "walls": found, "known": certain, "beside": beside}
