"""Odometry that drifts by its definition: float64, nothing of ours but the numbers of `oracle.radio`."""

import math

from oracle.radio import uniform

KEY, DRAWS = 5 << 24, 8


def normal(key, index: int) -> float:
    """A normally distributed number that belongs to a key, by Box and Muller."""
    return math.sqrt(-2.0 * math.log(1.0 - uniform(*key, index))) * math.cos(2.0 * math.pi * uniform(*key, index + 1))


class Walker:
    """The error of one robot's estimate in an episode: x, y [m], heading [rad]."""

    def __init__(self, episode: tuple[int, int, int], robot: int, drift: float, turn: float, jump: float, rate: float):
        self.episode, self.index = episode, KEY + DRAWS * robot  # episode: seed, env, number
        self.drift, self.turn, self.jump, self.rate = drift, turn, jump, rate
        self.error, self.jumps = (0.0, 0.0, 0.0), 0

    def drive(self, speed: float, slip: float, heading: float, step: int, dt: float = 0.1) -> None:
        """One local step, its way being that of the speeds before it."""
        key, (x, y, off) = (*self.episode, step), self.error
        way = math.hypot(speed, slip) * dt
        spread = [self.drift * math.sqrt(way)]
        if uniform(*key, self.index + 6) < self.rate * dt:
            spread.append(self.jump)
            self.jumps += 1
        along, across, turned = (normal(key, self.index + 2 * k) for k in range(3))
        bearing = math.atan2(slip, speed) + heading  # of the way, as it is and as it is believed to be
        x += way * (math.cos(bearing + off) - math.cos(bearing)) + math.hypot(*spread) * along
        y += way * (math.sin(bearing + off) - math.sin(bearing)) + math.hypot(*spread) * across
        self.error = (x, y, off + self.turn * math.sqrt(way) * turned)

    def estimate(self, x: float, y: float, heading: float, offset: float, low, high):
        """Centre and heading that the robot believes, its reference point being at (x, y): on the map."""
        heading += self.error[2]
        at = (x + self.error[0] + offset * math.cos(heading), y + self.error[1] + offset * math.sin(heading))
        return tuple(min(max(coordinate, a), b) for coordinate, a, b in zip(at, low, high, strict=True)), heading


def seen_from(true, believed, place) -> tuple[float, float]:
    """Where a place of the map lies for a robot that drives there by what it sees: poses are x, y, heading."""
    ahead, bearing = math.dist(place, believed[:2]), math.atan2(place[1] - believed[1], place[0] - believed[0])
    bearing += true[2] - believed[2]
    return true[0] + ahead * math.cos(bearing), true[1] + ahead * math.sin(bearing)
