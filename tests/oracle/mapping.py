"""Maps that shift with odometry by their definition: float64, plain loops, nothing of ours but the oracles."""

import math

from oracle.odometry import seen_from

DOUBT = 1e-4  # half cells: so near to a border single precision may round the other way
GIVES_WAY = -1  # the step of what is drawn only where nothing is


class Grid:
    """Cells of a map; which others follow a cell.

    stand_in: the cell whose state each cell takes, -1: none.
    """

    def __init__(self, origin, cell: float, width: int, height: int, stand_in):
        self.origin, self.cell, self.width, self.height = origin, cell, width, height
        self.followers: dict[int, list[int]] = {}
        for void, source in enumerate(stand_in):
            if source >= 0 and source != void:
                self.followers.setdefault(int(source), []).append(void)

    def place(self, at) -> tuple[tuple[int, int], bool]:
        """Half cells from the corner, rounded and clamped; and whether that is certain."""
        found, certain = [], True
        for k, cells in enumerate((self.width, self.height)):
            exact = 2.0 * (at[k] - self.origin[k]) / self.cell
            certain = certain and abs(exact - math.floor(exact) - 0.5) > DOUBT
            found.append(min(max(math.floor(exact + 0.5), 0), 2 * cells))
        return (found[0], found[1]), certain

    def covered(self, place, wall: bool) -> list[tuple[int, int]]:
        """Cells of a wall, or that a square of half a cell of ground touches."""
        spans = []
        for q, cells in zip(place, (self.width, self.height), strict=True):
            low, high = (q // 2, q // 2) if wall else ((q - 1) // 2, q // 2)
            spans.append(sorted({min(max(k, 0), cells - 1) for k in (low, high)}))
        return [(x, y) for y in spans[1] for x in spans[0]]


class Drawing:
    """The map of one robot, or of a team: what stands in each cell since which step, and where points are."""

    def __init__(self, grid: Grid):
        self.grid = grid
        self.cells: dict[tuple[int, int], tuple[int, bool]] = {}
        self.places: dict[tuple[str, int], tuple[tuple[int, int], bool]] = {}
        self.doubtful: set[tuple[int, int]] = set()

    def draw(self, of: int, place, wall: bool, step: int, certain: bool) -> None:
        """A point of cell ``of``, and what follows it."""
        width, height = self.grid.width, self.grid.height
        for x, y in self.grid.covered(place, wall):
            offset = (x - of % width, y - of // width)
            for cell in [of, *self.grid.followers.get(of, [])]:
                u, v = cell % width + offset[0], cell // width + offset[1]
                if 0 <= u < width and 0 <= v < height:
                    self.cells[u, v] = max(self.cells.get((u, v), (GIVES_WAY, False)), (step, wall))
                    if not certain:
                        self.doubtful |= {(u + a, v + b) for a in (-1, 0, 1) for b in (-1, 0, 1)}

    def look(self, true, believed, points, step: int, inner: float) -> None:
        """What a robot sees: (kind, number, where it is, its cell, whether it is known or only taken for a wall).

        true, believed: x, y, heading; inner: ground beyond gives way [m].
        """
        for kind, j, at, of, known in points:
            place, certain = self.grid.place(seen_from(believed, true, at))
            self.places[kind, j] = place, certain
            if known:
                wall = kind == "boundary"
                gives_way = step == GIVES_WAY or (not wall and math.dist(at, true[:2]) > inner)
                self.draw(of, place, wall, GIVES_WAY if gives_way else step, certain)

    def value(self, x: int, y: int) -> int:
        """0 unknown, 1 free, 2 obstacle."""
        return 0 if (x, y) not in self.cells else 2 if self.cells[x, y][1] else 1


def tell(drawings: list[Drawing], kind: str, j: int, knows, hears, of: int) -> None:
    """Let robots that know a point and have not drawn it draw it where another has.

    knows: bool of each robot; hears: [i][k], whether robot i hears robot k.
    """
    for i, mine in enumerate(drawings):
        if not knows[i] or (kind, j) in mine.places:
            continue
        tellers = [k for k, other in enumerate(drawings) if (kind, j) in other.places]
        heard = [k for k in tellers if hears[i][k]]
        if tellers:
            place, certain = drawings[(heard or tellers)[0]].places[kind, j]
            mine.places[kind, j] = place, certain
            mine.draw(of, place, kind == "boundary", GIVES_WAY, certain)
