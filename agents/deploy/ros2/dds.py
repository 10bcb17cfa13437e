"""Topics of ROS 2 over DDS: names, kinds and qualities of service as `rmw_cyclonedds` has them on the wire.

A topic /robot1/map of ROS is rt/robot1/map of DDS. What a topic carries and how it is delivered is written once, in
`TOPICS`. The hash of the definition goes with it, as ROS 2 from Iron on tells it. A service /a is two topics,
rq/aRequest and rr/aReply.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from maexp.agents.deploy.ros2.messages import CLASSES, NAVIGATE

BLOCKING = 0.1  # seconds that a write may wait for slow readers
MOST = 1_000  # messages taken at once
LARGEST_DOMAIN = 232
ALL = ViewState.Any | InstanceState.Any | SampleState.Any


@dataclass(frozen=True)
class Kind:
    """What a topic carries and how it is delivered.

    Attributes:
        message: as ROS calls it.
        hash: of its definition (REP 2016); "": not told, for it is not the same in every release.
        depth: messages kept.
        reliable: lost messages are sent again.
        latched: who comes later gets the last one.
        easy: a reader takes what is sent without that, too.
    """

    message: str
    hash: str = ""
    depth: int = 10
    reliable: bool = True
    latched: bool = False
    easy: bool = False


_TF = "tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
TOPICS = {
    "clock": Kind(
        "rosgraph_msgs/msg/Clock", "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564", 1, easy=True
    ),
    "tf": Kind(*_TF, 100),
    "tf_static": Kind(*_TF, 100, latched=True),
    "map": Kind(
        "nav_msgs/msg/OccupancyGrid",
        "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
        1,
        latched=True,
    ),
    "map_updates": Kind(
        "map_msgs/msg/OccupancyGridUpdate", "c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8"
    ),
    "known": Kind(
        "nav_msgs/msg/OccupancyGrid",
        "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
        1,
        latched=True,
    ),
    "scan": Kind(
        "sensor_msgs/msg/LaserScan",
        "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
        5,
        reliable=False,
    ),
    "odom": Kind("nav_msgs/msg/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
    "goal_pose": Kind(
        "geometry_msgs/msg/PoseStamped", "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    ),
    "episode": Kind(
        "std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18", 1, latched=True
    ),
    "word": Kind("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18", 1),
    "status": Kind(
        "action_msgs/msg/GoalStatusArray",
        "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
        1,
        latched=True,
    ),
    "feedback": Kind(f"{NAVIGATE}_FeedbackMessage"),
}
"""By the last part of the topic's name. Ours are `episode`, what an arena tells of an episode, and `word`,
what a robot tells its mates, both as JSON; and `known`, the map that a robot plans on."""
EPISODE = "/maexp/episode"
SERVICES = {
    "send_goal": f"{NAVIGATE}_SendGoal",
    "cancel_goal": "action_msgs/srv/CancelGoal",
    "get_result": f"{NAVIGATE}_GetResult",
}
"""By the last part of the service's name."""


def quality(kind: Kind, reads: bool, about: str = "") -> Qos:
    """The qualities of service of a writer or reader; `about`: what it tells of itself instead of the hash."""
    about = about or (f"typehash=RIHS01_{kind.hash};" if kind.hash else "")
    reliable = kind.reliable and not (reads and kind.easy)
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=BLOCKING)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if kind.latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(kind.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(about.encode()),
    )


class Wire:
    """A place in a domain of DDS, with writers and readers of topics.

    Args:
        domain: its number; None: that of ROS_DOMAIN_ID, 0 without. CYCLONEDDS_URI says which networks it uses.

    Raises:
        ValueError: the number is none, or no network can be used.
    """

    def __init__(self, domain: int | None = None):
        number = read_domain(domain)
        try:
            self.participant = DomainParticipant(number)
            self.waits = WaitSet(self.participant)
        except DDSException as error:
            raise ValueError(
                f"DDS does not start in domain {number} ({error.msg or error}): check CYCLONEDDS_URI and the network"
            ) from error
        self.conditions: list[Any] = []
        self.writers: dict[str, Writer] = {}
        self.readers: dict[str, Reader] = {}
        self.servers: dict[str, Server] = {}

    def writer(self, name: str) -> Writer:
        """Writes to a topic, /robot1/map: always the same one."""
        if name not in self.writers:
            self.writers[name] = self._writer(f"rt{name}", TOPICS[name.rpartition("/")[2]])
        return self.writers[name]

    def reader(self, name: str, kind: str = "") -> Reader:
        """Reads from a topic, always the same one; `wait` wakes up when something comes.

        Args:
            kind: one of `TOPICS`, if it is not the last part of the name.
        """
        if name not in self.readers:
            self.readers[name] = self._reader(f"rt{name}", TOPICS[kind or name.rpartition("/")[2]])
        return self.readers[name]

    def server(self, name: str) -> Server:
        """Answers who calls a service, /robot1/navigate_to_pose/_action/send_goal: always the same one."""
        if name not in self.servers:
            asked, answered = self._service(name)
            about = f"serviceid={uuid4().bytes.hex('.')};"
            self.servers[name] = Server(self._reader(*asked, about), self._writer(*answered, about))
        return self.servers[name]

    def client(self, name: str) -> Client:
        """Calls a service."""
        asked, answered = self._service(name)
        about = f"clientid={uuid4().bytes.hex('.')};"  # a server waits for the reader with the same before it answers
        return Client(self._reader(*answered, about), self._writer(*asked, about))

    def _service(self, name: str) -> tuple[tuple[str, Kind], tuple[str, Kind]]:
        """The topics of questions and answers."""
        kind = SERVICES[name.rpartition("/")[2]]
        return (f"rq{name}Request", Kind(f"{kind}_Request")), (f"rr{name}Reply", Kind(f"{kind}_Response"))

    def _writer(self, topic: str, kind: Kind, about: str = "") -> Writer:
        """For a topic by its name in DDS."""
        made = Topic(self.participant, topic, CLASSES[kind.message])
        writer = DataWriter(self.participant, made, qos=quality(kind, reads=False, about=about))
        return Writer(writer, CLASSES[kind.message])

    def _reader(self, topic: str, kind: Kind, about: str = "") -> Reader:
        made = Topic(self.participant, topic, CLASSES[kind.message])
        reader = DataReader(self.participant, made, qos=quality(kind, reads=True, about=about))
        self.conditions.append(ReadCondition(reader, ALL))
        self.waits.attach(self.conditions[-1])
        return Reader(reader)

    def wait(self, seconds: float) -> None:
        """Until something has come that was not taken yet, but no longer than that."""
        self.waits.wait(duration(seconds=max(seconds, 1e-3)))


class Writer:
    """Of one topic; `make` makes a message of its kind."""

    def __init__(self, writer: DataWriter, make: type):
        self.writer, self.make = writer, make

    def write(self, message: Any) -> None:
        """A reader that is too slow loses it."""
        try:
            self.writer.write(message)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise

    def settle(self, seconds: float) -> bool:
        """Wait until all readers have what was written, but no longer than that; whether they have."""
        try:
            return bool(self.writer.wait_for_acks(duration(seconds=seconds)))
        except DDSException:
            return False

    @property
    def matched(self) -> int:
        """How many read."""
        return len(self.writer.get_matched_subscriptions())


class Reader:
    """Of one topic."""

    def __init__(self, reader: DataReader):
        self.reader = reader

    def take(self) -> Iterator[Any]:
        """The messages that have come since, oldest first."""
        for message in self.reader.take(MOST):
            if message.sample_info.valid_data:
                yield message

    @property
    def matched(self) -> int:
        """How many write."""
        return len(self.reader.get_matched_publications())


class Server:
    """The end of a service that answers."""

    def __init__(self, asked: Reader, answers: Writer):
        self.asked, self.answers = asked, answers

    def take(self) -> Iterator[Any]:
        """The questions that have come since, oldest first."""
        return self.asked.take()

    def answer(self, question: Any, **fields) -> None:
        """Answer a question; who asks it may have been started a moment ago, and as a reader is waited for."""
        end = time.monotonic() + BLOCKING
        while self.answers.matched < self.asked.matched and time.monotonic() < end:
            time.sleep(0.005)
        self.answers.write(self.answers.make(guid=question.guid, seq=question.seq, **fields))


class Client:
    """The end of a service that asks."""

    def __init__(self, answers: Reader, asks: Writer):
        self.answers, self.asks = answers, asks
        self.guid, self.seq = uuid4().int >> 64, 0

    def ask(self, **fields) -> int:
        """Returns the number of the question."""
        self.seq += 1
        self.asks.write(self.asks.make(guid=self.guid, seq=self.seq, **fields))
        return self.seq

    def take(self) -> Iterator[Any]:
        """The answers to this client that have come since; `seq` is the number of the question."""
        return (answer for answer in self.answers.take() if answer.guid == self.guid)

    @property
    def matched(self) -> bool:
        """Whether there is a server."""
        return bool(self.answers.matched and self.asks.matched)


def read_domain(domain: int | None) -> int:
    """The number of the domain; None: that of ROS_DOMAIN_ID.

    Raises:
        ValueError: it is none.
    """
    word = os.environ.get("ROS_DOMAIN_ID") or "0" if domain is None else str(domain)
    if not word.isdecimal() or int(word) > LARGEST_DOMAIN:
        name = "ROS_DOMAIN_ID" if domain is None else "domain"
        raise ValueError(f"{name}={word} must be a whole number from 0 to {LARGEST_DOMAIN}")
    return int(word)
