"""What robots attempt in vain: targets that stay, robots that stand still, come no nearer or go back and forth.

Times are in seconds, as `TeamPlanner.plan` is told them. Targets are remembered by their block.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Container, Hashable
from dataclasses import dataclass, field

import numpy as np

from maexp.agents.deploy.planner.assignment import DistinctTargets
from maexp.agents.deploy.planner.frontiers import Targets
from maexp.agents.deploy.planner.team import Team

LOG = logging.getLogger("maexp.runtime")
FOR_GOOD = 3  # times that a target is given up until it is for good
PARKED = 3  # targets that a robot has to give up without moving until it no longer stands in others' way
SLOW = 3.0  # a robot that moves may take so many times the patience to come nearer
PERIODS = (2, 3, 4)  # targets in turn, twice the same round: back and forth
ROUNDING = 1e-6  # steps of 0.1 s add up to a little less than whole seconds
STEP = 0.5  # a robot has moved, or come nearer, by so many of its radii

Block = tuple[int, int]
GONE: Block = (1 << 40, 1 << 40)  # a target whose block is not known any more


@dataclass
class Track:
    """What is remembered of a robot.

    Attributes:
        at, since: where it last stood still, and since when; times at which its pose was not known, or it had no target
            to drive to, do not count. The clock is the robot's: targets may come and go meanwhile.
        seen: when its pose was last known.
        idle: for how long it has had nowhere to drive to [s].
        block: the target it has; None = none.
        arrived: whether it stood beside that when it got it.
        best, best_since: the shortest way left to it so far [m], and since when.
        past: the targets before, and where the robot was when it got them.
        hold: the target to go on with after it was caught going back and forth.
        failed: targets given up in a row without moving.
    """

    at: np.ndarray
    since: float
    seen: float
    idle: float = 0.0
    block: Block | None = None
    arrived: bool = False
    best: float = math.inf
    best_since: float = 0.0
    past: list[tuple[Block, np.ndarray]] = field(default_factory=list)
    hold: Block | None = None
    failed: int = 0

    @property
    def parked(self) -> bool:
        """Whether it has not moved for so long that the team goes on without it."""
        return self.failed >= PARKED


class Watch:
    """Gives up, for a while, what robots attempt in vain.

    Args:
        patience: how long a robot may stand still on its way, or beside a target that stays [s].
        pause: how long a target is given up for the first time; twice as long the second [s].
    """

    def __init__(self, patience: float, pause: float):
        self.patience, self.pause = patience, pause
        self.forget()

    def forget(self) -> None:
        """Forget the past."""
        self.tracks: dict[Hashable, Track] = {}
        self.given: dict[tuple[Hashable, Block], tuple[float, int]] = {}  # (robot or None = all) -> until, times
        self.beside: dict[Block, tuple[float, float]] = {}  # -> how long robots stood beside it, when last [s]
        self.near = np.zeros((0, 0), bool)  # of the last call: which robots stand beside which targets
        self.now = -math.inf

    def forget_targets(self) -> None:
        """Forget what is remembered by blocks, which are others now; since when robots stand still remains."""
        self.given, self.beside = {}, {}
        for track in self.tracks.values():
            track.block, track.past, track.hold = None if track.block is None else GONE, [], None
            track.best, track.best_since = math.inf, self.now

    def look(self, team: Team, robots: np.ndarray, targets: Targets, travel: np.ndarray, near, now: float) -> list[str]:
        """Bring everything up to date with where robots and targets are; returns what was given up.

        Args:
            robots: int [n], the robots of the team that take part.
            travel: way from these to the targets [m], [n, K].
            near: of which targets a robot stands beside, bool [n, K].
            now: time [s].
        """
        if now < self.now:
            self.forget()
        before, self.now, self.near = self.now, now, near
        blocks = targets.keys()
        notes = self._look_beside(blocks, near.any(0), before)
        number = {block: k for k, block in enumerate(blocks)}
        for row, robot in enumerate(robots):
            track = self._follow(team, robot, before)
            k = number.get(track.block)
            if track.block is None or (track.arrived if k is None else near[row, k]):
                self._rest(track, before)
            else:
                track.idle = 0.0
                left = math.inf if k is None else float(travel[row, k])
                notes += self._check(team, robot, track, left)
            if track.hold not in number:
                track.hold = None
        self.tracks = {name: kept for name, kept in self.tracks.items() if now - kept.seen <= self.pause}
        return notes

    def _look_beside(self, blocks: list[Block], beside: np.ndarray, before: float) -> list[str]:
        """Give up targets that robots stood beside for long: what is unknown there cannot be seen from there. One that
        is gone for a moment is not begun anew; `before` is the time of the last call."""
        self.beside = {
            block: (total, last)
            for block, (total, last) in self.beside.items()
            if self.now - last <= self.patience or last >= before
        }
        notes = []
        for block in [block for block, is_beside in zip(blocks, beside, strict=True) if is_beside]:
            known = self.beside.get(block)
            total = 0.0 if known is None else known[0] + self.now - before
            if total >= self.patience - ROUNDING and not self._is_given(None, block):
                self._give_up(None, block)
                total = 0.0
                notes.append(f"a target was given up: {self.patience:g} s beside it showed nothing new")
            self.beside[block] = total, self.now
        return notes

    def _rest(self, track: Track, before: float) -> None:
        """The clocks of a robot that had nowhere to drive to stand still; after the pause they begin anew."""
        gone = min(self.now - before, self.now - track.since)
        track.idle += gone
        track.since, track.best_since = track.since + gone, min(track.best_since + gone, self.now)
        if track.idle >= self.pause - ROUNDING:
            track.since = track.best_since = self.now

    def _follow(self, team: Team, robot: int, before: float) -> Track:
        """A robot's track, its place brought up to date; `before` is the time of the last call."""
        name, at = team.names[robot], team.at[robot]
        track = self.tracks.setdefault(name, Track(at, self.now, self.now))
        absent = max(before - track.seen, 0.0)
        track.since, track.best_since, track.seen = track.since + absent, track.best_since + absent, self.now
        if np.linalg.norm(at - track.at) >= STEP * team.radius[robot]:
            if track.parked:  # what held it is over
                self.given = {key: value for key, value in self.given.items() if key[0] != name}
            track.at, track.since, track.failed = at, self.now, 0
        return track

    def _check(self, team: Team, robot: int, track: Track, left: float) -> list[str]:
        """Give a robot's target up if it stands still or has come no nearer for long; `left` is infinite where it is
        gone or cut off for now [m]."""
        step = STEP * team.radius[robot]
        other = 2.0 * track.best + step < left < math.inf  # another way around
        if left < track.best - step or other:
            track.best, track.best_since = left, self.now
        still = self.now - track.since >= self.patience - ROUNDING
        if track.parked or not (still or self.now - track.best_since >= SLOW * self.patience - ROUNDING):
            return []
        self._give_up(team.names[robot], track.block)
        track.failed += still
        track.since = track.best_since = self.now
        why = "it did not move" if still else "it came no nearer"
        seconds = self.patience if still else SLOW * self.patience
        notes = [f"{team.title(robot)} gave its target up: {why} for {seconds:g} s"]
        if track.parked:
            notes.append(f"{team.title(robot)} stands still whatever its target: the team plans without it")
        return notes

    def _give_up(self, name: Hashable, block: Block) -> None:
        times = self.given.get((name, block), (0.0, 0))[1] + 1
        until = math.inf if times >= FOR_GOOD else self.now + self.pause * 2.0 ** (times - 1)
        self.given[name, block] = (until, times)

    def _is_given(self, name: Hashable, block: Block) -> bool:
        return self.given.get((name, block), (-math.inf, 0))[0] > self.now

    def allowed(self, team: Team, robots: np.ndarray, targets: Targets) -> np.ndarray:
        """Targets that have not been given up, for all or for a robot: bool [n, K]."""
        rows = [[not self._is_given(team.names[i], block) for block in targets.keys()] for i in robots]
        free = [not self._is_given(None, block) for block in targets.keys()]
        return np.array(rows, bool).reshape(len(robots), len(free)) & np.array(free, bool)

    def try_again(self) -> bool:
        """Take back what was given up for a while; whether that was anything."""
        waiting = [key for key, (until, _) in self.given.items() if self.now < until < math.inf]
        for key in waiting:
            self.given[key] = (self.now, self.given[key][1])
        return bool(waiting)

    def held(self, team: Team, robots: np.ndarray, targets: Targets) -> np.ndarray:
        """Targets that robots go on with after they were caught going back and forth, int64 [n]; -1 = none."""
        number = {block: k for k, block in enumerate(targets.keys())}
        return np.array([number.get(self.tracks[team.names[robot]].hold, -1) for robot in robots], np.int64)

    def settle(
        self, team: Team, robots: np.ndarray, targets: Targets, travel: np.ndarray, shares: DistinctTargets, room: float
    ) -> list[str]:
        """Write down the targets that robots get, and change those of robots that go back and forth; returns what was
        changed, in sentences.

        Args:
            travel: [n, K], infinite where a target is not to be taken [m].
            shares: who has which.
            room: a robot that changes its mind within so many metres goes back and forth.
        """
        blocks, notes, chosen = targets.keys(), [], shares.taken
        number = {block: k for k, block in enumerate(blocks)}
        for row, robot in enumerate(robots):
            track = self.tracks[team.names[robot]]
            block = blocks[chosen[row]] if chosen[row] >= 0 else None
            if block != track.hold:
                track.hold = None
            if self._swings(track, block, team.at[robot], room, number):
                chosen[row] = np.where(shares.free(row), travel[row], np.inf).argmin()
                track.hold = blocks[chosen[row]]
                self._give_up(team.names[robot], track.block if track.hold == block else block)
                block = track.hold
                notes.append(f"{team.title(robot)} went back and forth between targets: it goes on to the nearest")
            if block is not None and block != (track.past[-1][0] if track.past else None):
                track.best, track.best_since = math.inf, self.now
            if block != track.block:
                track.past = [*track.past[2 - 2 * PERIODS[-1] :], (block, team.at[robot])] if block else track.past
            track.block, track.arrived = block, block is not None and bool(self.near[row, number[block]])
        return notes

    @staticmethod
    def _swings(track: Track, block: Block | None, at: np.ndarray, room: float, present: Container[Block]) -> bool:
        """Whether a robot, on taking `block`, would have gone from A to B, back to A and to B again in little room (or
        round by C, or by D), while all of them are still there."""
        if block is None or track.block in (None, block):
            return False
        taken = [*track.past, (block, at)]
        blocks = [block for block, _ in taken]
        for period in PERIODS:
            round_ = blocks[-period:]
            again = len(set(round_)) > 1 and blocks[-2 * period :] == round_ * 2
            if again and all(block in present for block in round_):
                return bool(np.linalg.norm(at - taken[-2 * period][1]) < room)
        return False
