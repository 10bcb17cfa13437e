"""How goals get to a robot: by the topic /NAME/goal_pose, or by nav2's action /NAME/navigate_to_pose.

An action is three services and two topics under /NAME/navigate_to_pose/_action. As in nav2 a robot has one goal at a
time: the newest; the one before is aborted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from uuid import uuid4

from maexp.agents.deploy.planner.frames import Pose, fill_pose
from maexp.agents.deploy.planner.team_driver import Order
from maexp.agents.deploy.ros2.dds import Wire
from maexp.agents.deploy.ros2.messages import CLASSES, NAVIGATE, SECOND, fill_header, fill_time, read_nanoseconds

EXECUTING, SUCCEEDED, CANCELED, ABORTED = 2, 4, 5, 6
"""action_msgs/GoalStatus; from SUCCEEDED on a goal has ended."""
UNKNOWN_GOAL, HAS_ENDED = 2, 3  # why there is nothing to cancel, action_msgs/CancelGoal
FAILED = 9000  # nav2's error code without a better one
KEPT = 10  # goals that results are told of
ID, INFO, STATUS = (
    CLASSES[name]
    for name in ("unique_identifier_msgs/msg/UUID", "action_msgs/msg/GoalInfo", "action_msgs/msg/GoalStatus")
)
GOAL, RESULT = CLASSES[f"{NAVIGATE}_Goal"], CLASSES[f"{NAVIGATE}_Result"]


def _place(robot: str) -> str:
    return f"/{robot}/navigate_to_pose/_action"


@dataclass
class Goal:
    """A goal that was accepted.

    Attributes:
        uuid: that its client gave it.
        accepted: when [ns].
        reason: why it was aborted.
        asked: questions for its result, not answered yet.
    """

    uuid: bytes
    accepted: int
    status: int = EXECUTING
    reason: str = ""
    asked: list[Any] = field(default_factory=list)

    def info(self) -> Any:
        """An action_msgs/GoalInfo."""
        made = INFO(goal_id=ID(uuid=self.uuid))
        fill_time(made.stamp, self.accepted)
        return made


class NavigationServer:
    """Offers navigate_to_pose for one robot; whoever uses it says what becomes of the goals."""

    def __init__(self, wire: Wire, robot: str):
        place = _place(robot)
        self.sent, self.cancelled, self.asked = (
            wire.server(f"{place}/{value}") for value in ("send_goal", "cancel_goal", "get_result")
        )
        self.feedback, self.status = wire.writer(f"{place}/feedback"), wire.writer(f"{place}/status")
        self.goals: dict[bytes, Goal] = {}

    @property
    def matched(self) -> bool:
        """Whether somebody may send goals."""
        return bool(self.sent.asked.matched)

    @property
    def active(self) -> Goal | None:
        """The goal that the robot drives to."""
        last = next(reversed(self.goals.values()), None)
        return last if last is not None and last.status == EXECUTING else None

    def take(self) -> Iterator[Any]:
        """Requests with a goal that have come since, each to be answered by `accept`."""
        return self.sent.take()

    def accept(self, request: Any, accepted: bool, now: int) -> None:
        """Answer a request at `now` [ns]; a goal that is accepted takes the place of the one before."""
        uuid = request.goal_id.uuid
        accepted = accepted and uuid not in self.goals
        if accepted:
            self.end(ABORTED, "a newer goal has come")
            self.goals[uuid] = Goal(uuid, now)
            for old in list(self.goals)[:-KEPT]:
                del self.goals[old]
            self._tell_status()
        stamp = CLASSES["builtin_interfaces/msg/Time"]()
        fill_time(stamp, now)
        self.sent.answer(request, accepted=accepted, stamp=stamp)

    def end(self, status: int, reason: str = "") -> None:
        """The goal that the robot drives to, if it has one, has ended."""
        goal = self.active
        if goal is not None:
            goal.status, goal.reason = status, reason
            self._tell_status()
            for question in goal.asked:
                self._answer(question, goal)

    def cancel(self) -> bool:
        """Answer who wants to cancel goals; whether the robot is to stop."""
        stops = False
        for request in self.cancelled.take():
            goal, found = self.active, self._find(request.goal_info)
            stopped = goal is not None and goal in found
            if stopped:
                self.end(CANCELED)
            stops |= stopped
            code = 0 if stopped else (HAS_ENDED if found else UNKNOWN_GOAL)
            self.cancelled.answer(request, return_code=code, goals_canceling=[goal.info()] if stopped else [])
        return stops

    def _find(self, info: Any) -> list[Goal]:
        """The goals that are meant: that of an id, all until a time, both; nothing of both: all."""
        uuid, until = info.goal_id.uuid, read_nanoseconds(info.stamp)
        every = not any(uuid) and not until
        return [goal for goal in self.goals.values() if every or goal.uuid == uuid or goal.accepted <= until > 0]

    def tell_results(self) -> None:
        """Answer who asks for results; for a goal that has not ended yet, when it has."""
        for question in self.asked.take():
            goal = self.goals.get(question.goal_id.uuid)
            if goal is not None and goal.status == EXECUTING:
                goal.asked.append(question)
            else:
                self._answer(question, goal)

    def _answer(self, question: Any, goal: Goal | None) -> None:
        status, reason = (0, "") if goal is None else (goal.status, goal.reason)
        result = RESULT(error_code=FAILED if reason else 0, error_msg=reason)
        self.asked.answer(question, status=status, result=result)

    def _tell_status(self) -> None:
        several = [STATUS(goal_info=goal.info(), status=goal.status) for goal in self.goals.values()]
        self.status.write(self.status.make(status_list=several))

    def tell_progress(self, pose: Pose, now: int, far: float) -> None:
        """Where the robot is in map at `now` [ns], and how far from its goal, as the crow flies [m]."""
        goal = self.active
        if goal is not None and self.feedback.matched:
            message = self.feedback.make(goal_id=ID(uuid=goal.uuid))
            about = message.feedback
            fill_header(about.current_pose.header, "map", now)
            fill_pose(about.current_pose.pose, *pose)
            fill_time(about.navigation_time, now - goal.accepted)
            about.distance_remaining = far
            self.feedback.write(message)


class GoalTopic:
    """Sends goals to /NAME/goal_pose."""

    ready = True

    def __init__(self, wire: Wire, robot: str):
        self.writer = wire.writer(f"/{robot}/goal_pose")

    def send(self, order: Order, now: float) -> None:
        """At `now` [s]."""
        message = self.writer.make()
        _fill_goal(message, order, now)
        self.writer.write(message)

    stop = send  # the topic knows no cancelling: a robot is sent to where it is

    def ended(self) -> bool:
        """Nobody tells."""
        return False


class NavigationClient:
    """Sends goals by navigate_to_pose."""

    def __init__(self, wire: Wire, robot: str):
        place = _place(robot)
        self.sends, self.cancels = (wire.client(f"{place}/{value}") for value in ("send_goal", "cancel_goal"))
        self.status = wire.reader(f"{place}/status")
        self.uuid, self.number = b"", 0  # of the last goal, until it has ended

    @property
    def ready(self) -> bool:
        """Whether a server offers it."""
        return self.sends.matched and self.cancels.matched

    def send(self, order: Order, now: float) -> None:
        """At `now` [s]."""
        self.uuid, goal = uuid4().bytes, GOAL()
        _fill_goal(goal.pose, order, now)
        self.number = self.sends.ask(goal_id=ID(uuid=self.uuid), goal=goal)

    def stop(self, order: Order, now: float) -> None:
        """Cancel the last goal, if it has not ended."""
        if self.uuid:
            self.cancels.ask(goal_info=INFO(goal_id=ID(uuid=self.uuid)))
            self.uuid = b""

    def ended(self) -> bool:
        """Whether the last goal was refused or has ended since; told once."""
        list(self.cancels.take())
        over = any(send.seq == self.number and not send.accepted for send in self.sends.take())
        for message in self.status.take():
            for value in message.status_list:
                over |= value.goal_info.goal_id.uuid == self.uuid and value.status >= SUCCEEDED
        if over:
            self.uuid, over = b"", bool(self.uuid)
        return over


SENDERS = {"goal_pose": GoalTopic, "navigate_to_pose": NavigationClient}


def _fill_goal(message: Any, order: Order, now: float) -> None:
    """A geometry_msgs/PoseStamped."""
    fill_header(message.header, order.frame, round(now * SECOND))
    fill_pose(message.pose, *order.pose)
