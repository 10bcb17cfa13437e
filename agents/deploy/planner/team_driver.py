"""A ROS 2 team from its messages to the goals of its robots: what the node of `docs/ros2` and `maexp ros2 team` do.

Needs neither ROS nor DDS: whoever uses it hands over the messages, and sends the orders.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.arena_policy import extend_goals, planner_options
from maexp.agents.deploy.planner.estimate import ESTIMATE, MapEstimate
from maexp.agents.deploy.planner.frames import (
    NOWHERE,
    Frames,
    OccupancyGrid,
    Pose,
    apply_update,
    check_map,
    compose,
    heading_of,
    invert,
    place_grid,
    read_map,
    read_pose,
    read_time,
)
from maexp.agents.deploy.planner.radio_features import BASE
from maexp.agents.deploy.planner.robot_planner import merge_told
from maexp.agents.deploy.planner.team_planner import Plan, TeamPlanner
from maexp.envs.config.comm import CommConfig
from maexp.envs.config_fields import check_settings, setting

UPDATES = "_updates"  # after the topic of a map: where parts of it are told that have changed
ODOMETRY = "odometry of "
SERVED_AGE = 0.05  # seconds; an arena tells everything of one moment
NAME = re.compile(r"[a-zA-Z_]\w*(/[a-zA-Z_]\w*)*", re.ASCII)
"""What a robot may be called: topics begin with it."""


@dataclass(frozen=True)
class DriverSettings:
    """Of a team; lengths in metres, times in seconds. None or (): what the second half of the text says."""

    robots: tuple[str, ...] = setting((), "namespaces of the robots: a,b,c")
    only: str = setting("", "drives this robot alone, by what it has heard; or base_station; default: all, by one plan")
    memory: float = setting(
        10.0, "with only: a mate counts so long after its last word", unit="s", above=0, infinite=True
    )
    policy: str = setting("cost_utility", "a planner, a trained policy that ships or the folder of one, lookahead")
    map_topics: tuple[str, ...] = setting((), "the team's map, or one of each robot; default: /NAME/map of each")
    global_frame: str = setting("map", "all maps and poses are brought into this frame")
    base_frame: str = setting("base_link", "of a robot: NAME/base_link in /tf, base_link in /NAME/tf")
    offsets: tuple[Any, ...] = setting(
        (), "x, y, yaw of each robot's map in the team's frame; zeros: they are one; estimate: from the maps"
    )
    period: float = setting(2.0, "between two decisions", unit="s", above=0)
    radar_range: float | None = setting(None, "how far the robots see [m]; default: as the policy was trained, or 5")
    robot_radius: tuple[float, ...] = setting((), "of all, or of each [m]; default: as the policy was trained, or 0.3")
    clearance_factor: float = setting(2.0, "where there is room, ways keep twice this many radii from obstacles")
    occupied: float = setting(65.0, "cells with so many percent and more are obstacles")
    bounded: bool = setting(False, "the map shows the whole place")
    patience: float = setting(10.0, "how long a robot may stand still on its way [s]")
    pause: float = setting(60.0, "how long a target is given up [s]")
    max_speed: float | None = setting(None, "of the robots [m/s], told to trained policies; default: as trained")
    time_limit: float | None = setting(None, "for the whole exploration [s]; policies are told what is left of it")
    comm: CommConfig = setting(CommConfig(), "with only: radios, for policies that look at them, and the base station")
    pose_age: float = setting(2.0, "a pose older than this is not believed", unit="s", above=0, infinite=True)
    goal_change: float = setting(0.5, "a goal is sent again when it has moved farther than this", unit="m", low=0)
    resend: float | None = setting(None, "a goal is sent again after so long; default: never", unit="s", above=0)


@dataclass(frozen=True)
class Order:
    """What one robot is to do.

    Attributes:
        goal: float64 [2] in the team's frame [m]; where the robot is to stop if `stop`.
        pose: the goal in `frame`, one that the robot knows.
        stop: its goal is cancelled.
    """

    name: str
    goal: np.ndarray
    frame: str
    pose: Pose
    stop: bool = False


@dataclass(frozen=True)
class Decision:
    """What came of a look at the team.

    Attributes:
        plan: None where no map can be placed yet.
        notes: what is missing or was given up, a sentence each.
    """

    orders: list[Order]
    plan: Plan | None
    notes: list[str]


class TeamDriver:
    """Takes what a team publishes, and decides where each robot goes.

    Args:
        settings: of the team.

    Attributes:
        driven: names of the robots that it decides for; ``robots`` of those that take part now.
        listened: topics of the maps that it takes.

    Raises:
        ValueError: a setting is out of range, or the policy unknown.
    """

    def __init__(self, settings: DriverSettings):
        self.settings = settings
        check_settings(settings)
        robots, count = settings.robots, len(settings.robots)
        if not count or len(set(robots)) < count or not all(robots):
            raise ValueError(f"robots={','.join(robots)} must name the robots of the team, each once")
        for name in robots:
            check_name("robots", name)
        for topic in settings.map_topics:
            check_name("map_topics", topic.removeprefix("/"))
        if settings.comm != CommConfig() and not settings.only:
            raise ValueError("comm.* is for robots that plan for themselves: give only=NAME, or leave comm.* out")
        if settings.only and settings.only not in (*robots, BASE):
            raise ValueError(f"only={settings.only} is none of the team: robots={','.join(robots)}")
        self.topics = settings.map_topics or tuple(f"/{name}/map" for name in robots)
        if len(self.topics) not in (1, count):
            raise ValueError(f"map_topics={','.join(self.topics)} must be one for the team, or one for each robot")
        self.estimate = MapEstimate(self.topics) if settings.offsets == ESTIMATE else None
        if self.estimate is not None and (settings.only or len(self.topics) < 2):
            raise ValueError(
                "offsets=estimate is for one process that drives all robots, with a map of each: give numbers"
            )
        for name, sizes in (("offsets", (0, 3 * len(self.topics))), ("robot_radius", (0, 1, count))):
            if len(getattr(settings, name)) not in sizes and not (name == "offsets" and self.estimate is not None):
                wanted = " or ".join(map(str, sizes[1:]))
                raise ValueError(f"{name} holds {len(getattr(settings, name))} numbers: give {wanted}")
        self.driven: tuple[str, ...] = tuple(name for name in robots if settings.only in ("", name))
        self.listened = tuple(dict.fromkeys(map(self.topic_of, self.driven)))
        self.shared, self.own = Frames(), {name: Frames() for name in self.driven}
        self.begin()

    def begin(self, episode: dict[str, Any] | None = None, now: float | None = None) -> None:
        """Forget everything but frames.

        Args:
            episode: what an arena tells of the one that begins, instead of settings that are not given; only the robots
                that it names take part.
            now: when it begins [s]; None: with the first decision.
        """
        self.episode = episode
        self.robots = tuple(name for name in self.driven if episode is None or name in episode["robots"])
        self.planner: Any = self._make_planner()
        self.maps: dict[str, Any] = {}
        if self.estimate is not None:
            self.estimate.forget()
        self.speeds: dict[str, float] = {}
        self.goals: dict[str, np.ndarray] = {}  # that robots drive to
        self.sent: dict[str, float] = {}  # when [s]
        self.places: dict[str, np.ndarray] = {}  # where robots were seen last
        self.begun = now
        self.decided = -math.inf  # time of the last decision [s]

    def _make_planner(self) -> Any:
        return TeamPlanner(self.settings.policy, **self._options())

    def _options(self) -> dict[str, Any]:
        given, own = self.settings, {} if self.episode is None else planner_options(self.episode)
        for name in ("clearance_factor", "occupied", "bounded", "patience", "pause"):
            own.setdefault(name, getattr(given, name))
        own |= {name: value for name in ("radar_range", "max_speed") if (value := getattr(given, name)) is not None}
        own |= {"time_limit": self._time_limit()} | ({"comm": given.comm} if given.comm != CommConfig() else {})
        if radius := given.robot_radius:
            each = radius if len(radius) > 1 else radius * len(given.robots)
            own["robot_radius"] = dict(zip(given.robots, each, strict=True))
        return own

    def take_map(self, topic: str, message) -> None:
        """A nav_msgs/OccupancyGrid."""
        self.maps[topic] = message

    def take_update(self, topic: str, message) -> None:
        """A map_msgs/OccupancyGridUpdate of `UPDATES` of a map's topic: a part of that map that has changed. One that
        is older than the map, or came before it, changes nothing.

        Raises:
            ValueError: it does not fit the map.
        """
        last = self.maps.get(topic)
        if last is not None and read_time(message.header.stamp) >= read_time(last.header.stamp):
            self.maps[topic] = apply_update(last, message)

    def take_frames(self, message, robot: str | None = None, still: bool = False) -> None:
        """A tf2_msgs/TFMessage of /tf, or of `robot`'s own /NAME/tf; `still`: of tf_static."""
        (self.shared if robot is None else self.own[robot]).take(message, still)

    def take_odometry(self, robot: str, message) -> None:
        """A nav_msgs/Odometry; its pose counts where tf says nothing of the robot's body."""
        speed = message.twist.twist.linear
        self.speeds[robot] = float(np.hypot(speed.x, speed.y))
        body = message.child_frame_id.lstrip("/")
        if body not in self.shared and body not in self.own[robot]:
            pose, time = read_pose(message.pose.pose), read_time(message.header.stamp)
            self.own[robot].put(ODOMETRY + body, message.header.frame_id, pose, time)

    def forget(self, name: str, goal: np.ndarray) -> None:
        """A goal was reached, given up or refused: the next decision may send the same again."""
        if np.array_equal(self.goals.get(name), goal):
            del self.goals[name]

    def decide(self, now: float) -> Decision:
        """Plan for all; the orders are for those robots whose goal has changed.

        Args:
            now: time of ROS [s].

        A map that is none, or lies so far from the others that all together are too large, is left out, which is noted.

        Raises:
            ValueError: several maps claim one frame and their offsets are not known.
        """
        self.begun = now if self.begun is None else min(self.begun, now)
        self._look_back(now)
        notes: list[str] = []
        grid = self._merge(notes)
        if grid is None:
            return Decision([], None, notes)
        poses = {name: self._find(name, now, notes) for name in self.robots}
        self.places |= {name: np.array(pose[:2]) for name, pose in poses.items() if pose is not None}
        what = grid.values, grid.resolution, grid.origin
        plan = self._plan(what, poses, self._time_left(now), now)
        goals = plan.goals if self.episode is None else self._extend(plan, what, poses)
        return Decision(self._give_orders(plan, goals, now), plan, [*notes, *plan.notes])

    def _look_back(self, now: float) -> None:
        """Where the clock has jumped back, a simulation began anew: poses of later are none, and robots have lost their
        goals, which are sent again."""
        if now < self.decided:
            self.goals.clear()
            self.sent.clear()
            for frames in (self.shared, *self.own.values()):
                frames.forget_later(now + self.settings.pose_age)
        self.decided = now

    def _plan(self, grid: tuple, poses: dict[str, Pose | None], time_left: float, now: float) -> Plan:
        """Of the robots that take part, at `now` [s]."""
        speeds = [self.speeds.get(name, 0.0) for name in self.robots]
        return self.planner.plan(*grid, poses, velocities=speeds, time_left=time_left, now=self._since(now))

    def _since(self, now: float) -> float:
        """Time since it began [s]."""
        return round(now - (0.0 if self.begun is None else self.begun), 6)

    def _time_left(self, now: float) -> float:
        limit = self._time_limit()
        return 1.0 if limit is None else max(1.0 - self._since(now) / limit, 0.0)

    def _time_limit(self) -> float | None:
        """For the whole exploration [s]."""
        return self.settings.time_limit if self.episode is None else self.episode["seconds"]

    def _extend(self, plan: Plan, grid: tuple, poses: dict[str, Pose | None]) -> np.ndarray:
        at = np.array([(np.nan, np.nan) if pose is None else pose[:2] for pose in poses.values()])
        speed = np.array([self.speeds.get(name, 0.0) for name in self.robots])
        return extend_goals(plan, grid, at, speed, self.episode)

    def _merge(self, notes: list[str]) -> OccupancyGrid | None:
        """The team's map in its frame; None until there is one."""
        self._check_frames()
        placed: dict[str, OccupancyGrid] = {}
        if self.estimate is not None:
            return self._merge_estimated(notes)
        for topic, message in self.maps.items():
            pose = self._place(message.header.frame_id.lstrip("/"), topic)
            if pose is None:
                notes.append(f"{topic}: tf does not say where {message.header.frame_id} is in {self._root}")
            elif (grid := self._read_map(topic, message, notes)) is not None:
                placed[topic] = place_grid(grid, pose)
        return merge_told([], placed, notes, self._reach())

    def _merge_estimated(self, notes: list[str]) -> OccupancyGrid | None:
        """The maps whose places are known from what they share."""
        read = {topic: self._read_map(topic, message, notes) for topic, message in self.maps.items()}
        grids = {topic: grid for topic, grid in read.items() if grid is not None}
        notes += self.estimate.look(grids, self.decided)
        places = self.estimate.places
        placed = {topic: place_grid(grid, places[topic]) for topic, grid in grids.items() if topic in places}
        return merge_told([], placed, notes, self._reach())

    def _read_map(self, topic: str, message, notes: list[str]) -> OccupancyGrid | None:
        """A map that can be planned on; None: it is none, which is noted."""
        try:
            grid = check_map(read_map(message), notes, topic)
            if grid.resolution > self._reach() + 1e-6:
                raise ValueError(f"its cells of {grid.resolution:g} m are larger than radar_range={self._reach():g} m")
        except ValueError as error:
            notes.append(f"the map of {topic} is left out: {error}")
            return None
        return grid if grid.values.size else None

    def _reach(self) -> float:
        """How far robots see [m]."""
        return self.planner.radar_range

    @property
    def _root(self) -> str:
        return self.settings.global_frame

    def _check_frames(self) -> None:
        """Maps that robots make alone begin wherever each robot began, and are all called `map`."""
        frames = [message.header.frame_id for message in self.maps.values()]
        if len(set(frames)) < len(frames) and not self.settings.offsets:
            both = [topic for topic, message in self.maps.items() if frames.count(message.header.frame_id) > 1]
            raise ValueError(
                f"{' and '.join(both)} are both in a frame called {self.maps[both[0]].header.frame_id}, and where they "
                "lie to each other is not known: give offsets=x,y,yaw,x,y,yaw,... of each (zeros if they are aligned)"
            )

    def _place(self, frame: str, topic: str) -> Pose | None:
        """Where the frame of a map stands in the team's; None: unknown."""
        if self.estimate is not None:
            return self.estimate.places.get(topic)
        if self.settings.offsets:
            row = 3 * self.topics.index(topic)
            return tuple(self.settings.offsets[row : row + 3])
        if frame == self._root:
            return NOWHERE
        found = self.shared.find(frame, (self._root,))
        return None if found is None else found[1]

    def _find(self, name: str, now: float, notes: list[str]) -> Pose | None:
        """Where a robot is in the team's frame; None: unknown, or not known since `pose_age`."""
        topic = self.topic_of(name)
        message = self.maps.get(topic)
        frame = self._root if message is None else message.header.frame_id.lstrip("/")
        found = self._chain(name, {frame, self._root} if not self.settings.offsets else {frame})
        if found is None:
            notes.append(f"{name}: tf does not say where {name}/{self.settings.base_frame} is in {frame}")
            return None
        root, pose, time = found
        if time < now - (self.settings.pose_age if self.episode is None else SERVED_AGE):
            notes.append(f"{name}: its pose is too old")
            return None
        place = self._place(root, topic)
        return None if place is None else compose(place, pose)

    def _chain(self, name: str, roots: set[str]) -> tuple[str, Pose, float] | None:
        """A robot's pose in one of these frames: by its own tf, by the shared one, by its odometry."""
        base, own = self.settings.base_frame, self.own[name]
        tree = Frames()
        tree.parents = self.shared.parents | own.parents
        measured = [frame for frame in own.parents if frame.startswith(ODOMETRY)]
        for body in [f"{name}/{base}", *[base] * (base in own), *measured]:
            if found := tree.find(body, roots):
                return found
        return None

    def _give_orders(self, plan: Plan, goals: np.ndarray, now: float) -> list[Order]:
        """New goals for robots that have others than before, and a stop for those that have none any more."""
        orders = []
        for k, name in enumerate(self.robots):
            if plan.active[k]:
                if self._is_new(name, goals[k], now):
                    self.goals[name], self.sent[name] = goals[k].copy(), now
                    orders.append(self._order(name, self.goals[name], heading_of(plan.ways[k])))
            elif name in self.places and (self.goals.pop(name, None) is not None or self.episode is not None):
                orders.append(self._order(name, self.places[name], 0.0, stop=True))
        return orders

    def _order(self, name: str, goal: np.ndarray, heading: float, stop: bool = False) -> Order:
        pose, topic = (float(goal[0]), float(goal[1]), heading), self.topic_of(name)
        if not self.settings.offsets or topic not in self.maps:
            return Order(name, goal, self._root, pose, stop)
        own = self.maps[topic].header.frame_id
        place = self._place(own, topic)
        return Order(name, goal, own, pose if place is None else compose(invert(place), pose), stop)

    def topic_of(self, name: str) -> str:
        """Of the map that a robot is on."""
        return self.topics[0] if len(self.topics) == 1 else self.topics[self.settings.robots.index(name)]

    def _is_new(self, name: str, goal: np.ndarray, now: float) -> bool:
        last, resend = self.goals.get(name), self.settings.resend
        if last is None or self.episode is not None or np.linalg.norm(last - goal) >= self.settings.goal_change:
            return True
        return resend is not None and now - self.sent[name] >= resend - 1e-6


def check_name(setting: str, name: str) -> None:
    """Raise ValueError for what ROS takes for no namespace or topic."""
    if not NAME.fullmatch(name):
        raise ValueError(f"{setting}: {name!r} is no name in ROS: use letters, digits, _ and /, no digit at its head")


def read_settings(values: dict[str, Any]) -> DriverSettings:
    """Of parameters by their names. ROS has none without a value: 0.0, "" and [0.0] stand for what is not given."""
    known, found = {field.name: field.default for field in fields(DriverSettings)}, {}
    for name, value in values.items():
        if isinstance(value, CommConfig):
            found[name] = value
        elif isinstance(known[name], tuple):
            found[name] = () if list(value) == [0.0] else tuple(value)
        else:
            found[name] = None if known[name] is None and not value else value
    return DriverSettings(**found)
