"""Attention over a graph of viewpoints: a planner in the manner of ARiADNE, written anew, with weights trained here.

Free ground that a robot can get to is covered with viewpoints; those that see each other are neighbours. A viewpoint is
worth the frontier that is seen from it. Layers of attention between neighbours tell each viewpoint what lies around it,
a pointer network then picks one, robot by robot: each is told what those before it have picked. The robot drives to the
frontier that is nearest to the viewpoint. Other than in the paper it picks any viewpoint that sees frontier, not only
neighbours, for decisions are seconds apart here; and it learns from an expert's choices (`ariadne_train.py`), not by
soft actor-critic. Source: Cao, Hou, Wang, Yi and Sartoretti, ARiADNE, ICRA 2023.
"""

from pathlib import Path

import numpy as np

STEP, NEAR, SIGHT = 0.4, 0.9, 0.9  # between viewpoints, between neighbours, of frontiers; shares of the radar's range
FRONTIERS = 160  # cells of frontier that are looked at, at most
FAR = 6.0  # what distances end at [radar ranges]
WIDTH, HEADS, LAYERS = 64, 4, 3  # of the network
WEIGHTS = Path(__file__).with_suffix(".npz")
FEATURES, SEES = 13, 6  # of a viewpoint; that which says whether it sees frontier


def grown(cells, times=1):
    """The cells and those within `times` of them."""
    for _ in range(times):
        wide = np.pad(cells, 1)
        cells = cells | wide[2:, 1:-1] | wide[:-2, 1:-1] | wide[1:-1, 2:] | wide[1:-1, :-2]
    return cells


def sees(clear, a, b):
    """Whether the straight way between cells a and b [n, 2] (y, x) is clear, bool [n]."""
    count = int(np.abs(a - b).max(initial=1)) + 1
    points = a[:, None] + (b - a)[:, None] * np.linspace(0.0, 1.0, count)[:, None]
    y, x = np.rint(points).astype(int).transpose(2, 0, 1)
    return clear[y, x].all(1)


def pairs_within(a, b, reach):
    """Rows i of a and j of b that are closer than `reach`."""
    return np.nonzero(((a[:, None] - b[None]) ** 2).sum(-1) <= reach**2)


class Graph:
    """Viewpoints on a grid.

    Attributes:
        nodes: cells [V, 2] (y, x); goals: of the frontier nearest to each, NaN where none is seen [V, 2];
        length: of the frontier seen [V]; ways: to neighbours, infinite for others [V, V]. All in cells.
    """

    def __init__(self, grid, reach, radius, starts):
        wall, step = grid == 100, max(2, round(STEP * reach))
        free = (grid == 0) & ~grown(wall, int(np.ceil(radius)))
        self.nodes = np.concatenate([starts, self._spread(free, step)])
        i, j = pairs_within(self.nodes, self.nodes, NEAR * reach)
        i, j = (ends[i != j] for ends in (i, j))
        clear = sees(grown(grid == 0) & ~wall, self.nodes[i], self.nodes[j])
        i, j = i[clear], j[clear]
        self.ways = np.full((len(self.nodes),) * 2, np.inf)
        self.ways[i, j] = np.hypot(*(self.nodes[i] - self.nodes[j]).T)
        self._look(grid, wall, SIGHT * reach)

    @staticmethod
    def _spread(free, step):
        """The free cell nearest to the middle of each square."""
        cells = np.argwhere(free)
        square, rest = np.divmod(cells, step)
        order = np.argsort(((rest - step / 2) ** 2).sum(1), kind="stable")
        _, first = np.unique(square[order], axis=0, return_index=True)
        return cells[order[first]]

    def _look(self, grid, wall, reach):
        cells = np.argwhere((grid == 0) & grown(grid == -1) & ~grown(wall))
        every = max(1, -(-len(cells) // FRONTIERS))
        cells = cells[::every]
        i, j = pairs_within(self.nodes, cells, reach)
        seen = sees(~wall & (grid != -1), self.nodes[i], cells[j])
        i, j = i[seen], j[seen]
        self.length = np.bincount(i, minlength=len(self.nodes)) * float(every)
        self.goals = np.full((len(self.nodes), 2), np.nan)
        order = np.argsort(-np.hypot(*(self.nodes[i] - cells[j]).T), kind="stable")
        self.goals[i[order]] = cells[j[order]]  # the nearest comes last, and stays

    def distances(self, start):
        """Along edges from a node to all [V]."""
        far = np.full(len(self.nodes), np.inf)
        far[start] = 0.0
        while True:
            nearer = np.minimum(far, (far[:, None] + self.ways).min(0))
            if (nearer == far).all():
                return far
            far = nearer


def describe(graph, robot, others, picked, visited, reach, shared):
    """What the network is told of each viewpoint [V, FEATURES].

    Args:
        robot: its node; others: those of its team; picked: goals of the robots before it [cells];
        visited: places where robots have been [cells]; reach: of the radar [cells];
        shared: of all viewpoints alike: the time left, what is driven in a decision [radar ranges]
    """
    ways = np.minimum(graph.distances(robot) / reach, FAR)
    away = (graph.nodes - graph.nodes[robot]) / reach
    theirs = np.min([graph.distances(mate) for mate in others] or [np.full(len(ways), np.inf)], 0) / reach
    goals = np.where(np.isnan(graph.goals), graph.nodes, graph.goals)
    taken = np.min([np.hypot(*(goals - goal).T) for goal in picked] or [np.full(len(ways), np.inf)], 0) / reach
    been = np.min([np.hypot(*(graph.nodes - place).T) for place in visited], 0) / reach
    columns = [
        away / 3,
        np.hypot(*away.T) / 3,
        ways / 3,
        np.exp(-ways),
        np.log1p(graph.length / reach),
        graph.length > 0,
        np.minimum(theirs, FAR) / 3,
        np.clip(ways - theirs, -3.0, 3.0),
        np.exp(-(taken**2)),
        been < 0.3,
        np.full(len(ways), shared[0]),
        np.full(len(ways), shared[1]),
    ]
    return np.column_stack(columns).astype(np.float32)


class Network:
    """What `ariadne_train.py` trains, in NumPy; its arrays have the names of the module there."""

    def __init__(self, arrays):
        self.arrays = {name: value.astype(np.float32) for name, value in arrays.items()}

    def __call__(self, features, edges, own):
        """How much each viewpoint is liked [V], by a robot at viewpoint `own`."""
        x = self._linear("embed", features)
        for k in range(LAYERS):
            x = self._norm(f"norms.{k}.0", x + self._attend(f"layers.{k}", x, x, edges))
            inner = np.maximum(self._linear(f"inner.{k}", x), 0.0)
            x = self._norm(f"norms.{k}.1", x + self._linear(f"outer.{k}", inner))
        whole = x[own : own + 1] + self._attend("whole", x[own : own + 1], x, np.ones((1, len(x)), bool))
        return 10.0 * np.tanh(self._linear("point", x) @ self._linear("ask", whole)[0] / np.sqrt(WIDTH))

    def _linear(self, name, x):
        return x @ self.arrays[f"{name}.weight"].T + self.arrays[f"{name}.bias"]

    def _norm(self, name, x):
        x = x - x.mean(-1, keepdims=True)
        x = x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-5)
        return x * self.arrays[f"{name}.weight"] + self.arrays[f"{name}.bias"]

    def _attend(self, name, x, y, edges):
        """Of x to those of y that `edges` [len(x), len(y)] allow."""
        q, k, v = (
            self._linear(f"{name}.{projection}", z).reshape(len(z), HEADS, -1).swapaxes(0, 1)
            for projection, z in (("q", x), ("k", y), ("v", y))
        )
        score = np.where(edges, q @ k.swapaxes(1, 2) / np.sqrt(WIDTH / HEADS), -np.inf)
        weight = np.exp(score - score.max(-1, keepdims=True))
        weight = weight / weight.sum(-1, keepdims=True)
        return self._linear(f"{name}.out", (weight @ v).swapaxes(0, 1).reshape(len(x), -1))


def edges_of(graph):
    """Whom each viewpoint attends to, itself included, bool [V, V]."""
    return np.isfinite(graph.ways) | np.eye(len(graph.nodes), dtype=bool)


class Ariadne:
    """Of `weights`, the file that `ariadne_train.py` writes; None: it can only look."""

    def __init__(self, weights=WEIGHTS):
        if weights is not None:
            with np.load(weights) as file:
                self.network = Network(dict(file))

    def reset(self, episode):
        self.episode, self.visited = episode, []

    def act(self, observation):
        goals = np.full((len(observation["alive"]), 2), np.nan)
        for robot, graph, own, features in self.look(observation, goals):
            liked = np.where(graph.length > 0, self.network(features, edges_of(graph), own), -np.inf)
            if graph.length.any():
                cell = graph.goals[liked.argmax()][::-1] + 0.5
                goals[robot] = np.asarray(observation["origin"]) + cell * observation["resolution"]
        return goals

    def look(self, observation, goals):
        """(robot, graph, its node, features) of each robot that lives, one after the other.

        Between two of them the caller writes where the first goes into `goals` [N, 2] [m].
        """
        alive, cell = observation["alive"], observation["resolution"]
        reach, radius = self.episode["radar_range"] / cell, self.episode["robot_radius"] / cell
        driven = self.episode["max_speed"] * self.episode["decision_seconds"] / self.episode["radar_range"]
        shared = observation["time_left"], min(driven, 4.0) / 4.0

        def cells(points):
            return ((points - np.asarray(observation["origin"])) / cell - 0.5)[:, ::-1]

        before = None
        for robot in np.flatnonzero(alive):
            grid, poses = observation["grid"][robot], observation["poses"][robot, :, :2]
            known = np.flatnonzero(alive & ~np.isnan(poses[:, 0]))
            places = np.clip(np.rint(cells(poses[known])).astype(int), 0, np.array(grid.shape) - 1)
            if before is None or not (np.array_equal(grid, before[0]) and np.array_equal(places, before[1])):
                before, graph = (grid, places), Graph(grid, reach, radius, places)
            own = int(np.flatnonzero(known == robot)[0])
            self.visited.append(places[own])
            picked = cells(goals[:robot][~np.isnan(goals[:robot, 0])])
            others = [k for k in range(len(known)) if k != own]
            yield robot, graph, own, describe(graph, own, others, picked, self.visited, reach, shared)
