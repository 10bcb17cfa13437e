"""Goals for a team of robots from an occupancy grid and their poses, without torch and without the simulator."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.assignment import DistinctTargets
from maexp.agents.deploy.planner.bodies import BodyTrails
from maexp.agents.deploy.planner.bundle import Contract, LearnedChoice, find_policy
from maexp.agents.deploy.planner.features import Motion, list_candidates
from maexp.agents.deploy.planner.grid import KnownGrid, is_planned_on, read_grid
from maexp.agents.deploy.planner.grid_search import coarsen, snap, trace_from
from maexp.agents.deploy.planner.lookahead import LOOKAHEAD, load_foresight, read_lookahead
from maexp.agents.deploy.planner.radio_features import Links, open_book, read_links
from maexp.agents.deploy.planner.scene import CHOICES, ArrayScene, look_at
from maexp.agents.deploy.planner.stall_monitor import Watch
from maexp.agents.deploy.planner.team import Team, read_team
from maexp.envs.config.robot import ROBOT_KINDS, RobotKind
from maexp.envs.config.targets import SPARE, Spare
from maexp.kernels.constants import FREE, UNREACHED

SAME_TURN = 0.02  # a grid that turns by less is the same one: localisation corrects a little all the time [rad]
LOG = logging.getLogger("maexp.runtime")
DEFAULTS = Contract("", 1, radar_range=5.0, robot_radius=0.3, motion=Motion(1.0, 1.0, 1.0))


@dataclass(frozen=True)
class Plan:
    """Where a team should go now; N robots in the order of the poses, lengths in metres, in the map's frame.

    Attributes:
        names: keys of the poses, or 0 to N - 1.
        goals: float64 [N, 2]; where a robot stands if it has nowhere to go, NaN if its pose is not known.
        active: bool [N], robots that have somewhere to go: their goals lie on known free ground that they get to.
        waits: bool [N], robots that are to stop where they are: others have the remaining targets.
        ways: float64 [k, 2] each, corners of the way from a robot to its goal; k = 0 for robots that stay.
        targets: float64 [K, 2], all candidates, for drawing.
        done: no robot can reach a place from which it would see more.
        notes: what was ignored or given up, a sentence each.
        tells: bool [N], robots that go and tell the base station; their goals are as near to it as they get.
    """

    names: tuple[Hashable, ...]
    goals: np.ndarray
    active: np.ndarray
    waits: np.ndarray
    ways: list[np.ndarray]
    targets: np.ndarray
    done: bool
    notes: tuple[str, ...]
    tells: np.ndarray


class TeamPlanner:
    """Chooses where each robot of a team should go next, call by call.

    Args:
        policy: one of the classical planners, `maexp.agents.deploy.planner.CHOICES`, a trained policy that ships, by
            its name (`shipped_names()`), the folder of another one, or "lookahead", which needs Warp and torch.
        radar_range: how far robots see [m]; None: as the policy was trained, 5 m for planners.
        robot_radius: distance that a robot's centre keeps from obstacles [m]: one for all, {name: radius} or a list;
            None: as the policy was trained, 0.3 m for planners.
        clearance_factor: where there is room, ways keep twice this many radii from obstacles.
        occupied: cells of the grid with this value and above are obstacles, 1 to 100.
        bounded: the grid shows the whole place; otherwise the unknown continues beyond its edge.
        least_area: targets with less unknown area in sight are left out [m^2]; None: what the smallest robot covers.
        patience: how long a robot may stand still on its way, or beside a target that remains [s].
        pause: how long a target is given up [s]; the second time for twice as long, the third time for good.
        max_speed, max_accel, seconds: limits of the robots [m/s, m/s^2], and the time between two calls [s]; only
            trained policies use them; None: as the policy was trained.
        distinct: robots go to different targets, farther apart than their bodies; otherwise each takes its best.
        spare: what robots without a target do: "wait" where they are, or drive "home" to where they were first seen.
        seed: of random choices.
        lookahead: how policy="lookahead" plans, a `maexp.envs.LookaheadConfig` or a mapping of its fields by name.
        drive: how the robots move, for "lookahead": "differential", "omnidirectional" or, as a car, "ackermann".
        deadline: after so many seconds of a call, robots that "lookahead" has not searched for keep to its
            ``rollout_policy`` [s]; None: all have their turn, and plans repeat bit for bit.
        comm: for policies trained with ``observation.radio=true``: how far radios reach, and where the base station is
            in the map's frame [m], a `maexp.envs.CommConfig` or a mapping of its fields by name.
        time_limit: for the whole exploration [s]; such policies need it.
        clear_mates: cells where a robot of a team stands or has stood are no walls: SLAM draws mates as obstacles.
    """

    def __init__(
        self,
        policy: str | Path = "cost_utility",
        *,
        radar_range: float | None = None,
        robot_radius=None,
        clearance_factor: float = 2.0,
        occupied: float = 50.0,
        bounded: bool = False,
        least_area: float | None = None,
        patience: float = 10.0,
        pause: float = 60.0,
        max_speed: float | None = None,
        max_accel: float | None = None,
        seconds: float | None = None,
        distinct: bool = True,
        spare: Spare = "wait",
        seed: int = 0,
        lookahead: Any = None,
        drive: RobotKind = "differential",
        deadline: float | None = None,
        comm: Any = None,
        time_limit: float | None = None,
        clear_mates: bool = True,
    ):
        for name, word, words in (("spare", spare, SPARE), ("drive", drive, ROBOT_KINDS)):
            if word not in words:
                raise ValueError(f"{name}={word!r} is unknown: choose {' or '.join(words)}")
        self.distinct, self.spare = distinct, spare
        self.search, base = None, policy
        if policy == LOOKAHEAD:
            self.search = read_lookahead(lookahead)
            base = self.search.rollout_policy
        elif lookahead is not None or deadline is not None:
            raise ValueError(f"lookahead= and deadline= are for policy={LOOKAHEAD!r}, and this is {policy!r}")
        known = isinstance(base, str) and base in CHOICES
        self.learned = None if known else LearnedChoice(find_policy(base, (*CHOICES, LOOKAHEAD)))
        self.policy, self.base, self.bounded, self.seed = policy, base, bounded, _whole("seed", seed)
        defaults = DEFAULTS if self.learned is None else self.learned.contract
        self.radar_range = _positive("radar_range", defaults.radar_range if radar_range is None else radar_range)
        self.robot_radius = defaults.robot_radius if robot_radius is None else robot_radius
        limits = {"max_speed": max_speed, "max_accel": max_accel, "seconds": seconds}
        given = {name: _positive(name, value) for name, value in limits.items() if value is not None}
        self.motion = replace(defaults.motion, **given)
        self.clearance_factor = _positive("clearance_factor", clearance_factor)
        self.occupied = _positive("occupied", occupied)
        if self.occupied > 100.0:
            raise ValueError(f"occupied={occupied!r} must be at most 100, as the cells of a grid are")
        self.least_area = least_area if least_area is None else _positive("least_area", least_area, zero=True)
        self.watch = Watch(_positive("patience", patience), _positive("pause", pause))
        self.time_limit = time_limit if time_limit is None else _positive("time_limit", time_limit)
        radio = self.learned is not None and self.learned.contract.radio
        if radio and self.search is not None:
            raise ValueError(f"lookahead.rollout_policy={base} was trained with observation.radio=true: choose another")
        self.book = open_book(base, radio, comm, self.time_limit, self.motion, self.watch)
        self.foresight = None
        if self.search is not None:
            limit = math.inf if deadline is None else _positive("deadline", deadline)
            self.foresight = load_foresight()(self.search, drive, self.clearance_factor, distinct, bounded, limit)
        self.bodies = BodyTrails() if clear_mates else None
        self.reset()

    def reset(self) -> None:
        """Forget the past: what was given up, where robots were."""
        self.watch.forget()
        if self.bodies is not None:
            self.bodies.forget()
        self.rng = np.random.default_rng(self.seed)
        self.anchor: KnownGrid | None = None  # blocks of targets are counted from its corner
        self.last: dict[Hashable, np.ndarray] = {}  # where each robot's latest target was in the map's frame
        self.home: dict[Hashable, np.ndarray] = {}  # where each robot was first seen there
        self.said: frozenset[str] = frozenset()
        self.begun: float | None = None  # time of the first call [s]
        if self.book is not None:
            self.book.forget()

    def plan(
        self,
        grid,
        resolution: float,
        origin,
        poses,
        *,
        velocities=None,
        time_left: float | None = None,
        radar_range: float | None = None,
        robot_radius=None,
        now: float | None = None,
        connected: bool | Links = False,
    ) -> Plan:
        """Goals of all robots.

        Args:
            grid: numbers [H, W], `grid[row = y, column = x]`: -1 unknown, 0 free to 100 occupied.
            resolution: edge of a cell [m].
            origin: x, y [m] and, if given, yaw [rad] of the grid's lower left corner in the map's frame.
            poses: {name: (x, y, yaw) or None}, or numbers [N, 2] or [N, 3]; map's frame [m, rad].
            velocities: speeds [m/s] or (vx, vy), one for each robot; None: standing.
            time_left: share of the time for the whole exploration that is left, 1 to 0; None: of `time_limit` since the
                first call, and 1 without that.
            radar_range, robot_radius: instead of those of this planner.
            now: time of the call [s]; None: a clock's.
            connected: whether the robots are connected with the base station now, and all with each other; or {name:
                the names that this robot is connected with over any number of others, "base_station" for that}. Only
                policies trained with ``observation.radio=true`` look at it.

        Raises:
            ValueError: an argument cannot be used. Odd cells and poses are ignored, and `Plan.notes` says so.
        """
        notes: list[str] = []
        now = time.monotonic() if now is None else finite("now", now)
        known = read_grid(grid, resolution, origin, self.occupied, notes)
        team = read_team(poses, velocities, self.robot_radius if robot_radius is None else robot_radius, notes)
        reach = self.reach(radar_range)
        _check_reach(reach, known)
        if self.bodies is not None:
            self.bodies.look(team)
            known = self.bodies.clear(known)
        time_left = self._time_left(time_left, now)
        if self.book is not None:
            notes += self.book.look(team, known, 1.0 - time_left, read_links(connected, team), now)
        known = coarsen(known, team.radius.min(initial=math.inf))
        scene = self._look(known, team, reach, notes)
        if not (known.known == FREE).any():
            notes.append("the grid holds no free cell yet: robots stay where they are")
            return self._finish(_stay(team, notes))
        notes += self.watch.look(team, scene.robots, scene.targets, scene.travel, scene.near, now)
        ends = np.full(len(scene.robots), -1) if self.book is None else self.book.ends(team, scene, notes)
        shares, events = self._choose(team, scene, time_left, ends)
        plan = _describe(team, scene, shares.taken, notes + events)
        self.last = {name: plan.goals[k] for k, name in enumerate(team.names) if plan.active[k]}
        return self._finish(self._send_away(self._send_to_tell(plan, team, scene, ends), team, scene, shares))

    def reach(self, radar_range: float | None) -> float:
        """How far robots see [m]: as `plan` is told, None: as this planner was.

        Raises:
            ValueError: it is none.
        """
        return self.radar_range if radar_range is None else _positive("radar_range", radar_range)

    def _time_left(self, given: float | None, now: float) -> float:
        self.begun = now if self.begun is None else self.begun
        if given is None:
            given = 1.0 if self.time_limit is None else 1.0 - (now - self.begun) / self.time_limit
        return min(max(finite("time_left", given), 0.0), 1.0)

    def _look(self, grid: KnownGrid, team: Team, reach: float, notes: list[str]) -> ArrayScene:
        shift = self._shift(grid, notes)
        return look_at(grid, team, reach, self.clearance_factor, self.bounded, self.least_area, shift, self.rng, notes)

    def _shift(self, grid: KnownGrid, notes: list[str]) -> tuple[int, int]:
        """How far the grid's corner has moved since the first call, in cells."""
        old = self.anchor
        if old is not None and (abs(old.cell / grid.cell - 1.0) > 1e-3 or abs(old.yaw - grid.yaw) > SAME_TURN):
            notes.append("the grid has another resolution or turn than before: what was given up is forgotten")
            self.watch.forget_targets()
            old = None
        if old is None:
            self.anchor = old = replace(grid, known=grid.known[:0])
        x, y = -np.rint(grid.from_map(old.corner) / grid.cell)
        return int(x), int(y)

    def _choose(self, team: Team, scene: ArrayScene, time_left: float, ends) -> tuple[DistinctTargets, list[str]]:
        """The target of each robot of the scene, and what happened; who goes to tell the base station has none.

        Args:
            ends: of `ContactBook.ends`.
        """
        notes = []
        allowed = self.watch.allowed(team, scene.robots, scene.targets)
        if not np.isfinite(scene.travel[allowed]).any() and self.watch.try_again():
            notes.append("nothing else is left: what was given up is tried once more")
            allowed = self.watch.allowed(team, scene.robots, scene.targets)
        travel = np.where(allowed, scene.travel, np.inf).astype(np.float32)
        parked = np.array([self.watch.tracks[team.names[robot]].parked for robot in scene.robots], bool)
        preference, tell = np.full(travel.shape, -np.inf), np.where((ends >= 0) & ~parked, 0.0, -np.inf)
        if travel.size and not parked.all():
            asked = replace(scene, travel=travel).of(~parked)
            preference[~parked], tell[~parked] = self._ask(team, asked, time_left, ends[~parked] >= 0, notes)
        travel[parked] = scene.travel[parked]
        preference[parked] = -travel[parked]
        preference[~np.isfinite(travel)] = -np.inf
        held = self.watch.held(team, scene.robots, scene.targets)
        rows = np.flatnonzero(held >= 0)
        rows = rows[np.isfinite(travel[rows, held[rows]])]
        preference[rows, held[rows]] = np.inf
        if self.book is not None:
            tells = (tell > preference.max(-1, initial=-np.inf)) | self.book.on_duty(team, scene.robots)
            self.book.send(team, scene.robots, tells & (ends >= 0))
            preference[tells & (ends >= 0)] = -np.inf
        shares = DistinctTargets(preference, travel, scene.points, team.radius[scene.robots], self.distinct)
        some = shares.reached.any(-1)
        shares.settle_for(np.flatnonzero(some & ~parked))
        for row in np.flatnonzero(some & parked).tolist():  # who stands still takes nothing away from the others
            if (free := shares.free(row)).any():
                shares.taken[row] = np.where(free, travel[row], np.inf).argmin()
        notes += self.watch.settle(team, scene.robots, scene.targets, travel, shares, scene.radar_range)
        return shares, notes

    def _ask(self, team: Team, scene: ArrayScene, time_left: float, can: np.ndarray, notes: list[str]):
        """What the policy thinks of each target for each robot of the scene, float [n, K], and of going to tell the
        base station, float [n], -inf for those that cannot, bool [n]; notes are added."""
        tell = np.full(len(can), -np.inf)
        heading = team.yaw - scene.grid.yaw
        if self.learned is None:
            preference = CHOICES[str(self.base)](scene)
        else:
            robots = scene.robots
            last = [self.last.get(team.names[robot], (np.nan, np.nan)) for robot in robots]
            before = scene.grid.from_map(np.array(last))
            telling = None
            if self.book is not None:
                telling = partial(self.book.add_to, scene=scene, names=[team.names[k] for k in robots], can=can)
            count, now = self.learned.contract.candidates, (heading[robots], team.speed[robots], before, time_left)
            preference, tell = self.learned.rank(scene, list_candidates(scene, count, *now, self.motion, telling))
        if self.foresight is not None:
            preference = self.foresight.improve(scene, preference, team, self.motion, self.learned is not None, notes)
        return preference, tell

    def _send_to_tell(self, plan: Plan, team: Team, scene: ArrayScene, ends: np.ndarray) -> Plan:
        """The plan with the ways of robots that go and tell the base station, to cells `ends`, int64 [n]."""
        if self.book is None:
            return plan
        for row in np.flatnonzero(self.book.on_duty(team, scene.robots)).tolist():
            robot = scene.robots[row]
            way = trace_from(team.at[robot], scene.grid, scene.passable[row], scene.distance[row], ends[row])
            plan.ways[robot], plan.goals[robot] = way, way[-1]
            plan.active[robot] = plan.tells[robot] = True
        return replace(plan, done=plan.done and not plan.tells.any())

    def _send_away(self, plan: Plan, team: Team, scene: ArrayScene, shares: DistinctTargets) -> Plan:
        """The plan with what robots do for which no target is left."""
        for robot in np.flatnonzero(np.isfinite(team.at).all(-1)):
            self.home.setdefault(team.names[robot], team.at[robot].copy())
        notes = []
        for row in np.flatnonzero(shares.reached.any(-1) & (shares.taken < 0)).tolist():
            robot = scene.robots[row]
            way = self._way_home(team, scene, row) if self.spare == "home" else None
            plan.waits[robot] = way is None
            if way is not None:
                plan.ways[robot], plan.goals[robot], plan.active[robot] = way, way[-1], True
            does = "waits" if way is None else "drives home"
            notes.append(f"{team.title(robot)} {does}: the others have the targets that are left")
        return replace(plan, notes=(*plan.notes, *notes))

    def _way_home(self, team: Team, scene: ArrayScene, row: int) -> np.ndarray | None:
        """Corners of the way to where a robot was first seen, [k, 2]; None where it is there or gets nowhere near."""
        robot = scene.robots[row]
        home = self.home[team.names[robot]]
        cell = int(scene.grid.cells(scene.grid.from_map(home)))
        cell = -1 if cell < 0 else snap(scene.passable[row], cell)
        near = np.linalg.norm(team.at[robot] - home) <= team.radius[robot]
        if near or cell < 0 or scene.distance[row].flat[cell] >= UNREACHED:
            return None
        return trace_from(team.at[robot], scene.grid, scene.passable[row], scene.distance[row], cell)

    def _finish(self, plan: Plan) -> Plan:
        """Log what has not been said in the call before."""
        self.said = log_new(plan.notes, self.said)
        return plan


def log_new(notes: Iterable[str], said: frozenset[str]) -> frozenset[str]:
    """Log those that have not been said in the call before; returns what is said now."""
    now = tuple(notes)
    for note in now:
        if note not in said:
            LOG.warning(note)
    return frozenset(now)


def _describe(team: Team, scene: ArrayScene, chosen: np.ndarray, notes: list[str]) -> Plan:
    """The plan of a choice, with a way to every goal."""
    plan = _stay(team, notes)
    for row, robot in enumerate(scene.robots):
        if chosen[row] >= 0:
            end = scene.targets.cell[chosen[row]]
            way = trace_from(team.at[robot], scene.grid, scene.passable[row], scene.distance[row], end)
            plan.ways[robot], plan.goals[robot], plan.active[robot] = way, way[-1], True
    done = len(scene.robots) > 0 and not plan.active.any()
    return replace(plan, targets=scene.grid.to_map(scene.points), done=done)


def _stay(team: Team, notes: list[str]) -> Plan:
    """Everybody stays where they are."""
    count = len(team.names)
    return Plan(
        names=team.names,
        goals=team.at.copy(),
        active=np.zeros(count, bool),
        waits=np.zeros(count, bool),
        ways=[np.zeros((0, 2))] * count,
        targets=np.zeros((0, 2)),
        done=False,
        notes=tuple(notes),
        tells=np.zeros(count, bool),
    )


def finite(name: str, value) -> float:
    """The number that a setting has.

    Raises:
        ValueError: it is none.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name}={value!r} must be a finite number")
    return number


def _check_reach(radar_range: float, grid: KnownGrid) -> None:
    """Robots look over the grid and so far around it: farther than a cell, and no farther than the memory reaches."""
    cells = radar_range / grid.cell
    if cells < 1.0 - 1e-6:
        raise ValueError(f"radar_range={radar_range:g} m is less than a cell of {grid.cell:g} m: give both in metres")
    if not is_planned_on(grid.width, grid.height, cells):
        raise ValueError(
            f"radar_range={radar_range:g} is {cells:,.0f} cells of {grid.cell:g} m, "
            "too many to plan on: lower radar_range or make cells larger"
        )


def _positive(name: str, value, zero: bool = False) -> float:
    number = finite(name, value)
    if number < 0.0 or (number == 0.0 and not zero):
        raise ValueError(f"{name}={value!r} must be {'0 or more' if zero else 'above 0'}")
    return number


def _whole(name: str, value) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ValueError(f"{name}={value!r} must be a whole number, 0 or more")
    return int(value)
