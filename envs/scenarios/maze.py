"""Mazes: a random spanning tree of cells (Kruskal), corridors of constant width, no loops."""

import numpy as np

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios.lattice import grid_map, make_generator


def spanning_tree(cells: int, rng: np.random.Generator) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Random spanning tree of a `cells` x `cells` grid (Kruskal's algorithm): pairs of joined cells."""
    edges = [((i, j), (i + 1, j)) for i in range(cells - 1) for j in range(cells)]
    edges += [((i, j), (i, j + 1)) for i in range(cells) for j in range(cells - 1)]
    parent = {(i, j): (i, j) for i in range(cells) for j in range(cells)}

    def find_root(cell: tuple[int, int]) -> tuple[int, int]:
        while parent[cell] != cell:
            parent[cell] = parent[parent[cell]]
            cell = parent[cell]
        return cell

    tree = []
    for k in np.argsort(rng.random(len(edges)), kind="stable"):
        first, second = edges[k]
        root_first, root_second = find_root(first), find_root(second)
        if root_first != root_second:
            parent[root_first] = root_second
            tree.append((first, second))
    return tree


def build_maze(index: int, *, scenario: str, cells: int, corridor: int, wall: int, resolution: float) -> PointCloudMap:
    """Maze of `cells` x `cells` cells, corridors `corridor` lattice points wide, walls `wall` points thick.

    The lattice has cells * (corridor + wall) + wall points a side and starts at (0, 0).
    """
    pitch = corridor + wall
    free = np.zeros((cells * pitch + wall,) * 2, dtype=bool)
    for i in range(cells):
        for j in range(cells):
            x, y = wall + i * pitch, wall + j * pitch
            free[x : x + corridor, y : y + corridor] = True
    for (i, j), (p, q) in spanning_tree(cells, make_generator(scenario, index)):
        x, y = wall + i * pitch, wall + j * pitch
        free[x : x + (p - i) * pitch + corridor, y : y + (q - j) * pitch + corridor] = True
    return grid_map(free, resolution, name=f"{scenario}_{index}", scenario=scenario)
