"""Messages that take room and time, by their definition: sets and lists, nothing of ours."""


class Radios:
    """The radios of one team.

    Attributes:
        known: what each knows, in the order in which it learned.
        sent: points, by all.
    """

    def __init__(self, count: int, cells: int, delay: int):
        self.known: list[list[int]] = [[] for _ in range(count)]
        self.cells, self.delay, self.sent = cells, delay, 0
        self.under_way: list[tuple[int, int, int]] = []  # steps left, whom, point
        self.told = [[set() for _ in range(count)] for _ in range(count)]  # whom each has told or need not tell of what

    def step(self, hears, seen) -> None:
        """hears[i][j]: i hears j; seen[i]: points that radio i's robot has seen so far."""
        for known, own in zip(self.known, seen, strict=True):
            known += sorted(set(own) - set(known))
        messages = []
        for i, known in enumerate(self.known):
            listeners = [j for j, row in enumerate(hears) if j != i and row[i]]
            room = self.cells
            for point in known:
                if not any(point not in self.told[i][j] for j in listeners):
                    continue
                if room == 0:
                    break
                lack = [j for j in listeners if point not in self.known[j] and point not in self.told[i][j]]
                for j in listeners:
                    self.told[i][j].add(point)
                messages += [(self.delay, j, point) for j in lack]
                room -= bool(lack)
                self.sent += bool(lack)
        self.under_way += messages
        for j, known in enumerate(self.known):
            known += sorted({point for left, k, point in self.under_way if k == j and left == 0} - set(known))
        self.under_way = [(left - 1, j, point) for left, j, point in self.under_way if left]
