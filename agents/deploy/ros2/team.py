"""A ROS 2 team driven over DDS: maps, frames and odometry in, goals out. All thinking is in `maexp.agents.runtime`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.team_driver import UPDATES, Decision, TeamDriver
from maexp.agents.deploy.ros2.dds import EPISODE, Wire
from maexp.agents.deploy.ros2.goals import SENDERS
from maexp.agents.deploy.ros2.messages import SECOND, read_nanoseconds
from maexp.agents.errors import UserError, printable

POLL = 0.1  # seconds between two looks where nothing comes
NUMBERS = ("begins", "radar_range", "robot_radius", "max_speed", "max_accel", "seconds", "decision_seconds", "seed")
"""Of an episode that an arena tells of: what is read of it here, and by `maexp.agents.runtime`."""


@dataclass
class Outing:
    """What a team did.

    Attributes:
        plans: made.
        seconds: of processor time that they took.
        episodes: of an arena that were played.
    """

    plans: int = 0
    seconds: float = 0.0
    episodes: int = 0


class Ros2Team:
    """A `TeamDriver` on DDS.

    Where an arena tells of an episode, the team decides whenever all robots have a new map, once: in lockstep. Else it
    decides every `period` seconds of the time of ROS: that of /clock where somebody publishes it.

    Args:
        answer: how long the first map and pose are waited for, and new ones after the last [s by the wall].
        tell: called with a sentence.
        goals: how they are sent, one of `SENDERS`.
    """

    def __init__(
        self,
        driver: TeamDriver,
        wire: Wire,
        answer: float = 60.0,
        tell: Callable[[str], None] = print,
        goals: str = "goal_pose",
    ):
        self.driver, self.wire, self.answer, self.tell = driver, wire, answer, tell
        robots = driver.driven
        self.maps = {topic: wire.reader(topic, "map") for topic in driver.listened}
        self.updates = {topic: wire.reader(f"{topic}{UPDATES}", "map_updates") for topic in driver.listened}
        self.frames = {
            (place, still): wire.reader(f"{'' if place is None else f'/{place}'}/{'tf_static' if still else 'tf'}")
            for place in (None, *robots)
            for still in (True, False)
        }
        self.odometry = {name: wire.reader(f"/{name}/odom") for name in robots}
        self.clock, self.episode = wire.reader("/clock"), wire.reader(EPISODE)
        self.goals = {name: SENDERS[goals](wire, name) for name in robots}
        self.sent: dict[str, np.ndarray] = {}  # the last goal of each
        self.time: int | None = None  # that /clock showed last [ns]
        self.planned: float | None = None  # time of the last decision [s]
        self.said: set[str] = set()
        self.refused: set[str] = set()  # updates of maps that do not fit
        self.strangers: set[str] = set()  # robots of arenas that are not this team's
        self.heard = time.monotonic()
        self.course = Outing()

    def run(self) -> Outing:
        """Drive until the arena is over, or nobody publishes maps any more.

        Raises:
            UserError: nobody answers, or the maps cannot be put together.
        """
        while not self.step():
            pass
        return self.course

    def step(self) -> bool:
        """Wait for messages, but not for long, and decide if it is time; whether there is nothing more to do.

        Raises:
            UserError: as `run`.
        """
        self.wire.wait(POLL)
        maps = self._take_maps()  # first: what belongs to them has come before
        told = [episode for message in self.episode.take() if (episode := self._read_episode(message.data)) is not None]
        if told and told[-1].get("over"):
            return True
        if told:
            self._begin(told[-1])
        self._take_others()
        self._heed()
        for topic, message in maps.items():
            self.driver.take_map(topic, message)
        self.heard = time.monotonic() if self._take_updates() or maps else self.heard
        now = self._due()
        if now is not None:
            self._decide(now)
            return False
        return time.monotonic() - self.heard > self.answer and self._is_over()

    def _is_over(self) -> bool:
        """Whether the maps that do not come any more will not come again; an error where none came at all."""
        return not any(reader.matched for reader in self.maps.values()) and self._end()

    def _end(self) -> bool:
        if self.course.plans:
            self.tell(f"Nobody publishes {', '.join(self.maps)} any more.")
            return True
        raise UserError(
            f"Nobody publishes {', '.join(self.maps)} in {self.answer:g} s: start the robots, and check that both have "
            "the same ROS_DOMAIN_ID and network (answer=SECONDS waits longer, map_topics= names other topics)."
        )

    def _take_maps(self) -> dict[str, Any]:
        """The newest of each topic that came since."""
        found = {}
        for topic, reader in self.maps.items():
            for message in reader.take():
                found[topic] = message
        return found

    def _take_updates(self) -> bool:
        """Write the parts of maps that have changed into these; whether any came."""
        came = False
        for topic, reader in self.updates.items():
            for message in reader.take():
                came = True
                try:
                    self.driver.take_update(topic, message)
                except ValueError as error:
                    self._tell_once(f"{topic}{UPDATES}: {error}")
        return came

    def _tell_once(self, sentence: str) -> None:
        if sentence not in self.refused:
            self.refused.add(sentence)
            self.tell(sentence)

    def _take_others(self) -> None:
        for (robot, still), reader in self.frames.items():
            for message in reader.take():
                self.driver.take_frames(message, robot, still)
        for robot, reader in self.odometry.items():
            for message in reader.take():
                self.driver.take_odometry(robot, message)
        for message in self.clock.take():
            self.time = read_nanoseconds(message.clock)

    def _read_episode(self, text: str) -> dict[str, Any] | None:
        """What an arena tells; None: it is something else, which is told."""
        try:
            found = json.loads(text)
            if found.get("over"):  # of an arena that plays with this team, or that it has not heard before
                return found if self.driver.episode is not None or not self.strangers else None
            robots = found["robots"]
            named = isinstance(robots, list) and all(isinstance(name, str) for name in robots)
            if named and all(type(found[name]) in (int, float) and math.isfinite(found[name]) for name in NUMBERS):
                return found if self._is_ours(robots) else None
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            pass
        self.tell(f"{EPISODE}: what came is no episode of an arena")
        return None

    def _is_ours(self, robots: list[str]) -> bool:
        """Whether an episode of these robots is one of this team; another's is told once, and passed over."""
        team, named = self.driver.settings.robots, printable(",".join(robots))
        if not set(team).isdisjoint(robots):
            return True
        if named not in self.strangers:
            self.strangers.add(named)
            self.tell(
                f"{EPISODE}: an arena plays with {named}, and not with robots={','.join(team)}: give its robots, or "
                "another ROS_DOMAIN_ID than it has"
            )
        return False

    def _begin(self, episode: dict[str, Any]) -> None:
        """Another episode of the arena."""
        try:
            self.driver.begin(episode, episode["begins"] / SECOND)
        except ValueError as error:
            raise UserError(f"{EPISODE}: this team cannot play it: {error}.") from error
        self.planned = None
        self.course.episodes += 1

    def _due(self) -> float | None:
        """The time of the decision that is to be made now [s]; None: none is."""
        episode = self.driver.episode
        if not self.driver.maps:
            return None
        if episode is not None:
            topics = [self.driver.topic_of(name) for name in self.driver.robots]
            stamps = {self._stamp(topic) for topic in topics}
            now = stamps.pop() if len(stamps) == 1 and all(goals.ready for goals in self.goals.values()) else None
            return None if now is None or now / SECOND == self.planned or now < episode["begins"] else now / SECOND
        return self._due_by_clock()

    def _due_by_clock(self) -> float | None:
        """As `_due`, every period of the time of ROS."""
        if self.time is None and self.clock.matched:
            return None
        now = time.time() if self.time is None else self.time / SECOND
        early = self.planned is not None and 0.0 <= now - self.planned < self.driver.settings.period - 1e-6
        return None if early else now

    def _stamp(self, topic: str) -> int | None:
        message = self.driver.maps.get(topic)
        return None if message is None else read_nanoseconds(message.header.stamp)

    def _decide(self, now: float) -> None:
        begin = time.process_time()
        try:
            decision = self.driver.decide(now)
        except ValueError as error:
            raise UserError(f"{error}.") from error
        self.planned = now
        if decision.plan is not None:
            self.course.plans += 1
            self.course.seconds += time.process_time() - begin
        self._send(decision, now)
        for note in decision.notes:
            if note not in self.said:
                self.tell(f"{now:.1f} s: {note}")
        self.said = set(decision.notes)

    def _send(self, decision: Decision, now: float) -> None:
        """Goals; robots that are to stop are told so, and in an arena, which waits for goals, where they are."""
        for order in decision.orders:
            goals = self.goals[order.name]
            if not goals.ready:
                self.driver.forget(order.name, order.goal)
                decision.notes.append(f"{order.name}: nobody offers /{order.name}/navigate_to_pose yet")
            elif order.stop and self.driver.episode is None:
                goals.stop(order, now)
            else:
                goals.send(order, now)
                self.sent[order.name] = order.goal

    def _heed(self) -> None:
        """A goal that was refused or has ended may be sent again."""
        for name, goals in self.goals.items():
            if goals.ended():
                self.driver.forget(name, self.sent[name])
