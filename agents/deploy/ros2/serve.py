"""A suite served over DDS: its robots publish as robots of ROS 2 do, in simulated time, and drive to goals that come.

Decisions are those of the suite. At each the clock stands still until all robots that can drive have a new goal
(`wait_for="all"`), or until none is without one (`"idle"`). After `stands` seconds by the wall it runs on, in which the
robots stand where they are; after `limit` seconds of that the decision is played with the goals that there are. What
the clock shows beyond the time of the episode is no part of any score.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from maexp.agents.deploy.irsim.simulator import make_floor
from maexp.agents.deploy.planner.frames import Pose
from maexp.agents.deploy.ros2.dds import EPISODE, Wire
from maexp.agents.deploy.ros2.goals import ABORTED, SUCCEEDED, NavigationServer
from maexp.agents.deploy.ros2.messages import (
    SECOND,
    fill_map,
    fill_odometry,
    fill_scan,
    fill_time,
    look,
    read_nanoseconds,
    transform,
)
from maexp.agents.errors import UserError, printable
from maexp.agents.policies.remote.numpy_policy import TeamSight
from maexp.envs import ExplorationEnv, ObservationConfig
from maexp.kernels.constants import DT

TICK = round(DT * SECOND)
LOOKS = 2  # ticks between two scans
GAP = 10 * SECOND  # between two episodes, so that nobody believes poses of the last
SETTLE = 1.0  # seconds that slow readers are waited for
PROGRESS = 5  # ticks between two feedbacks of navigate_to_pose
MOVES, PATIENCE = 0.5, 10 * SECOND  # a goal is given up where a robot moves less in this time [m, ns]; nav2's defaults
MOST_TOLD = 20  # goals that were refused
WORD = "ros2"
"""What results say instead of a policy's name on the command line."""


@dataclass(frozen=True)
class Serving:
    """How a suite is served.

    Attributes:
        robots: their namespaces; () for robot1, robot2, ...
        own_tf: frames have no prefix, and each robot has its own /NAME/tf; else all are in /tf with NAME/ in front.
        wait_for: "all" or "idle", see the head of this file.
        stands: how long the clock stands still at a decision [s by the wall].
        limit: how long it may run on, then [s].
        answer: how long somebody is waited for who publishes goals at all [s by the wall].
        tell: called with a sentence.
    """

    robots: tuple[str, ...] = ()
    own_tf: bool = False
    wait_for: str = "all"
    stands: float = 5.0
    limit: float = 10.0
    answer: float = 60.0
    tell: Callable[[str], None] = lambda text: None

    def names(self, count: int) -> tuple[str, ...]:
        """Of a team's robots.

        Raises:
            UserError: there are too few.
        """
        if self.robots and len(self.robots) < count:
            raise UserError(f"robots={','.join(self.robots)} names {len(self.robots)}, and the suite has {count}.")
        return self.robots[:count] or tuple(f"robot{k + 1}" for k in range(count))


class Ros2Player:
    """Whoever answers on DDS, as a player of suites.

    Args:
        name: what results call it.
    """

    spec = WORD
    hosted = False

    def __init__(self, name: str, wire: Wire, serving: Serving):
        self.name, self.wire, self.serving = name, wire, serving
        self.clock = Clock(wire)

    def observation(self) -> ObservationConfig:
        """What its env shows: nothing, for all goes over DDS."""
        return ObservationConfig(pictures=False)

    def open(self, env: ExplorationEnv) -> Ros2Policy:
        """For the env of a part, of one team."""
        return Ros2Policy(env, self.wire, self.clock, self.serving)

    def end(self) -> None:
        """Tell that nothing more comes."""
        self.clock.tell_episode({"over": True})


class Clock:
    """The time of a run, which never goes back, and what is told of its episodes."""

    def __init__(self, wire: Wire):
        self.writer, self.episode = wire.writer("/clock"), wire.writer(EPISODE)
        self.now = 0

    def publish(self, now: int) -> None:
        """It is `now` [ns]."""
        self.now = now
        message = self.writer.make()
        fill_time(message.clock, now)
        self.writer.write(message)

    def tell_episode(self, content: dict) -> None:
        self.episode.write(self.episode.make(data=json.dumps(content)))
        self.episode.settle(SETTLE)


class Robot:
    """Topics and frames of one robot."""

    def __init__(self, name: str, wire: Wire, own_tf: bool):
        self.name, place = name, f"/{name}"
        self.map, self.odom, self.scan = (wire.writer(f"{place}/{topic}") for topic in ("map", "odom", "scan"))
        self.goals, self.action = wire.reader(f"{place}/goal_pose"), NavigationServer(wire, name)
        before = "" if own_tf else f"{name}/"
        self.frames = {frame: before + frame for frame in ("map", "odom", "base_link", "base_scan")}
        root = [] if own_tf else [("map", self.frames["map"])]
        self.still = [
            *root,
            (self.frames["map"], self.frames["odom"]),
            (self.frames["base_link"], self.frames["base_scan"]),
        ]
        self.begin()

    def begin(self) -> None:
        """Forget what was sent for an episode before."""
        list(self.goals.take())
        for request in self.action.take():
            self.action.accept(request, False, 0)
        self.end()
        self.goal: np.ndarray | None = None
        self.moved: tuple[np.ndarray, int] | None = None  # where it was, and when, as it had moved last
        self.answered = False

    def end(self) -> None:
        """The episode is over."""
        self.action.tell_results()
        self.action.end(ABORTED, "the episode is over")

    @property
    def matched(self) -> bool:
        """Whether somebody may send it goals."""
        return self.action.matched or bool(self.goals.matched)

    def listen(self, since: int, now: int, refused: Callable[[str], None]) -> None:
        """Take the goals that have come until `now`; one that was sent before `since` is no answer to this decision."""
        for message in self.goals.take():
            if self._take(message, since, "goal_pose", refused):
                self.action.end(ABORTED, "a newer goal has come")
        for request in self.action.take():
            self.action.accept(request, self._take(request.goal.pose, since, "navigate_to_pose", refused), now)
        if self.action.cancel():
            self.goal = None
        self.action.tell_results()

    def _take(self, message: Any, since: int, topic: str, refused: Callable[[str], None]) -> bool:
        """A geometry_msgs/PoseStamped as the goal; whether it can be one."""
        frame, place = message.header.frame_id.lstrip("/"), message.pose.position
        if frame not in ("", "map", self.frames["map"], self.frames["odom"]):
            refused(f"/{self.name}/{topic}: a goal in the frame {frame} is not known: give it in map")
            return False
        if not (abs(place.x) < 1e9 and abs(place.y) < 1e9):
            refused(f"/{self.name}/{topic}: x={place.x}, y={place.y} is no goal")
            return False
        stamp = read_nanoseconds(message.header.stamp)
        self.goal, self.moved = np.array([place.x, place.y]), None
        self.answered |= stamp == 0 or stamp >= since
        return True

    def drive(self, pose: Pose | None, driven: int, now: int, near: float) -> None:
        """What a tick of driving means for a goal of navigate_to_pose.

        Args:
            pose: None: the robot has collided.
            driven: time of the episode [ns], without what the clock ran on for.
            near: the goal is reached where it is no farther away [m].
        """
        if self.action.active is None:
            return
        if pose is None:
            self.action.end(ABORTED, "the robot has collided")
            return
        at = np.array(pose[:2])
        far = float(np.linalg.norm(self.goal - at))
        if self.moved is None or np.linalg.norm(at - self.moved[0]) >= MOVES:
            self.moved = at, driven
        if far <= near:
            self.action.end(SUCCEEDED)
        elif driven - self.moved[1] >= PATIENCE:
            self.goal = None
            self.action.end(ABORTED, f"the robot moved less than {MOVES:g} m in {PATIENCE // SECOND} s")
        elif driven // TICK % PROGRESS == 0:
            self.action.tell_progress(pose, now, far)


class Ros2Policy:
    """The goals that come over DDS, as a policy for an env of one team; what it publishes is in the head of this file.

    Beside the action it writes ``lost`` and ``decision_seconds`` as `HostedPolicy` does; the time is that of waiting.

    Attributes:
        reasons: why the team is lost, [""] if it is not.
    """

    def __init__(self, env: ExplorationEnv, wire: Wire, clock: Clock, serving: Serving):
        if env.settings.limited:
            raise UserError("A suite with limited radios cannot be served: tf tells where every robot is.")
        self.env, self.wire, self.clock, self.serving = env, wire, clock, serving
        self.sight, self.reasons, self.said = TeamSight(env), [""], set()
        self.floors = [make_floor(world) for world in env.maps]
        self.robots = [Robot(name, wire, serving.own_tf) for name in serving.names(env.num_robots)]
        places = [f"/{robot.name}" for robot in self.robots] if serving.own_tf else [""]
        self.tf = [wire.writer(f"{place}/tf") for place in places]
        self.tf_static = [wire.writer(f"{place}/tf_static") for place in places]
        self.near = 2.0 * float(env.simulation.robot_tensors["collision_threshold"][0].max())  # a goal is reached [m]
        self.begin = self.idle = 0  # when the episode began, and how long it stood since [ns]

    def __enter__(self) -> Ros2Policy:
        self.env.set_step_hook(self._drive)
        return self

    def __exit__(self, *error) -> None:
        self.env.set_step_hook(None)
        for robot in self.robots:
            robot.end()

    @torch.no_grad()
    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        """Publish what is known, and wait for goals."""
        self.sight.look()
        begin, goals = time.monotonic(), np.full((1, self.env.num_robots, 2), np.nan)
        if self.sight.active[0]:
            if self.sight.begins[0]:
                self._begin()
            goals[0] = self._decide()
        state["agents", "action", "region"], state["agents", "action", "offset"] = self.sight.to_action(goals)
        state["lost"] = torch.tensor([[bool(self.reasons[0])]], device=self.env.device)
        seconds = [[time.monotonic() - begin]]
        state["decision_seconds"] = torch.tensor(seconds, dtype=torch.float64, device=self.env.device)
        return state

    def _begin(self) -> None:
        """A new episode: wait for somebody who answers, and tell of it."""
        self._await_somebody()
        self.reasons[0], self.idle = "", 0
        self.begin = self.clock.now + GAP if self.clock.now else 0
        for robot in self.robots:
            robot.begin()
        self._publish_frames(self.tf_static, self.begin, lambda robot: robot.still)
        names = [robot.name for robot in self.robots]
        self.clock.tell_episode({"begins": self.begin, "robots": names, **self.sight.episode(0)})
        self._publish_robots(self.begin)

    def _await_somebody(self) -> None:
        end, told = time.monotonic() + self.serving.answer, False
        while missing := [f"/{robot.name}" for robot in self.robots if not robot.matched]:
            if not told:
                self.serving.tell(f"Waiting for somebody who sends goals to {', '.join(missing)} ...")
                told = True
            if time.monotonic() > end:
                raise UserError(
                    f"Nobody sends goals to {', '.join(missing)}, by goal_pose or navigate_to_pose, in "
                    f"{self.serving.answer:g} s: start the team, and check that both have the same ROS_DOMAIN_ID and "
                    "network (answer=SECONDS waits longer)."
                )
            time.sleep(0.05)

    def _decide(self) -> np.ndarray:
        """The goals of all robots, [N, 2]; NaN where one stays."""
        asked = self._now()
        seen = self.sight.observation(0)
        for writer in (*self.tf, *self.tf_static, *(robot.odom for robot in self.robots)):
            writer.settle(SETTLE)
        for k, robot in enumerate(self.robots):
            robot.answered = False
            message = robot.map.make()
            fill_map(message, robot.frames["map"], asked, seen["grid"][k], seen["resolution"], seen["origin"])
            robot.map.write(message)
        self.clock.publish(asked)
        can = [robot for robot, alive in zip(self.robots, seen["alive"], strict=True) if alive]
        self._wait(asked, can)
        if not any(robot.answered or self._drives(robot) for robot in can):
            self.reasons[0] = f"no goal came within {self.serving.limit:g} s of simulated time"
        nothing = np.full(2, np.nan)
        return np.stack([robot.goal if robot in can and robot.goal is not None else nothing for robot in self.robots])

    def _wait(self, asked: int, can: list[Robot]) -> None:
        """Until all have what they are to have; the clock stands still at first, and then runs on."""
        begin, runs = time.monotonic(), 0
        while True:
            for robot in self.robots:
                robot.listen(asked, self._now(), self._refuse)
            if all(robot.answered or (self.serving.wait_for == "idle" and self._drives(robot)) for robot in can):
                return
            left = begin + self.serving.stands + runs * DT - time.monotonic()
            if left > 0:
                self.wire.wait(min(left, 0.5))
            elif runs * DT >= self.serving.limit:
                return
            else:
                runs += 1
                self.idle += TICK
                self._publish_robots(self._now())
                self.clock.publish(self._now())

    def _drives(self, robot: Robot) -> bool:
        """Whether it has a goal that it has not reached."""
        if robot.goal is None:
            return False
        k = self.robots.index(robot)
        at = self.env.simulation.tensors["center"][0, k, :2].cpu().numpy()
        return float(np.linalg.norm(robot.goal - at)) > self.near

    def _refuse(self, sentence: str) -> None:
        """Told once, and no more after `MOST_TOLD`; what others wrote does nothing to a terminal."""
        if sentence not in self.said and len(self.said) < MOST_TOLD:
            self.said.add(sentence)
            self.serving.tell(printable(sentence))

    def _now(self) -> int:
        """What the clock shows now [ns]."""
        return self.begin + self.idle + int(self.env.simulation.tensors["local_step"][0]) * TICK

    def _drive(self, env: ExplorationEnv) -> None:
        """After every tick of the simulation."""
        ticks = int(env.simulation.tensors["local_step"][0])
        if ticks and not self.reasons[0]:
            places = self._publish_robots(self._now())
            for robot in self.robots:
                robot.drive(places.get(robot.name), ticks * TICK, self._now(), self.near)
            self.clock.publish(self._now())

    def _publish_robots(self, now: int) -> dict[str, Pose]:
        """Odometry and scans of those that have not collided, and their poses, which are returned, too."""
        held = {
            name: self.env.simulation.tensors[name][0].cpu().numpy().astype(np.float64)
            for name in ("center", "pose", "slip", "collided", "map_id")
        }
        places: dict[str, Pose] = {}
        for k, robot in enumerate(self.robots):
            if held["collided"][k]:
                continue
            pose = (*held["center"][k, :2].tolist(), float(held["pose"][k, 3]))
            places[robot.name], (speed, slip) = pose, (held["pose"][k, 2], held["slip"][k])
            c, s = np.cos(pose[2]), np.sin(pose[2])
            message = robot.odom.make()
            frames = robot.frames["odom"], robot.frames["base_link"]
            fill_odometry(message, frames, now, pose, (speed * c - slip * s, speed * s + slip * c))
            robot.odom.write(message)
            if now // TICK % LOOKS == 0 and robot.scan.matched:
                self._publish_scan(robot, now, pose, int(held["map_id"]))
        self._publish_frames(
            self.tf,
            now,
            lambda robot: (
                [(robot.frames["odom"], robot.frames["base_link"], places[robot.name])] if robot.name in places else []
            ),
        )
        return places

    def _publish_scan(self, robot: Robot, now: int, pose: Pose, number: int) -> None:
        message, reach = robot.scan.make(), float(max(radar.range for radar in self.env.radar_configs))
        fill_scan(message, robot.frames["base_scan"], now, look(self.floors[number], pose, reach), reach)
        robot.scan.write(message)

    def _publish_frames(self, writers: list, now: int, rows: Callable[[Robot], list[tuple]]) -> None:
        """What `rows` says of each robot (parent, child and pose), in the one tf or in each robot's own."""
        told = [[transform(row[0], row[1], now, *row[2:]) for row in rows(robot)] for robot in self.robots]
        if len(writers) == 1:
            told = [sum(told, [])]
        for writer, several in zip(writers, told, strict=True):
            if several:
                writer.write(writer.make(transforms=several))
