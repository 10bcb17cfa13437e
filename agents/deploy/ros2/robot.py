"""A robot or the base station of a ROS 2 team over DDS without a central planner: it tells what it knows, and hears."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from maexp.agents.deploy.planner.drivers import BaseDriver, RadioDriver, map_topic
from maexp.agents.deploy.planner.frames import OccupancyGrid
from maexp.agents.deploy.planner.messages import write_word
from maexp.agents.deploy.ros2.dds import Wire, Writer
from maexp.agents.deploy.ros2.messages import SECOND, fill_map
from maexp.agents.deploy.ros2.team import Ros2Team
from maexp.agents.errors import UserError, printable

LISTEN = 1.0  # seconds by the wall that mates are waited for in an arena, whose clock stands meanwhile


class Ros2Robot(Ros2Team):
    """A `RadioDriver` on DDS.

    Before each decision it publishes its map on /NAME/maexp/map, those of its mates that are new to it on
    /NAME/maexp/heard/MATE/map, and its pose on /NAME/maexp/word; to who looks on, what it plans on, on
    /NAME/maexp/known. Mates are heard as long as their words come, and the base station, too. In an arena it waits for
    the mates that it has heard at the decision before.

    Args:
        listen: how long [s by the wall].
        others: of `Ros2Team`.
    """

    driver: RadioDriver

    def __init__(self, driver: RadioDriver, wire: Wire, *others, listen: float = LISTEN, **more):
        super().__init__(driver, wire, *others, **more)
        self.listen = listen
        self.words = {name: wire.reader(f"/{name}/maexp/word") for name in driver.speakers}
        self.grids = {topic: (source, wire.reader(topic)) for topic, source in driver.map_topics().items()}
        self.says, self.shows = (wire.writer(f"/{driver.name}/maexp/{topic}") for topic in ("word", "known"))
        self.maps_out = {name: wire.writer(map_topic(driver.name, name)) for name in (driver.name, *driver.mates)}
        self.told: float | None = None  # time of the last word [s]
        self.since = 0.0  # when it was told [s by the wall]
        self.near = set(driver.mates)  # who is waited for
        self.noted: set[str] = set()

    def _begin(self, episode: dict) -> None:
        super()._begin(episode)
        self.told, self.near = None, set(self.driver.mates) & set(episode["robots"])

    def _take_others(self) -> None:
        super()._take_others()
        for name, reader in self.words.items():  # first: the maps that belong to them have come before
            for message in reader.take():
                if self._hear(f"/{name}/maexp/word", self.driver.take_word, name, message.data):
                    self.near |= {name} & set(self.driver.mates)
        for topic, (source, reader) in self.grids.items():
            for message in reader.take():
                self._hear(topic, self.driver.take_known, source, message)

    def _hear(self, topic: str, take: Callable, name: str, what: Any) -> Any:
        """What the driver makes of what a mate has told; nonsense is noted."""
        try:
            return take(name, what)
        except ValueError as error:
            self._note(f"{topic}: {error}")
            return None

    def _note(self, sentence: str) -> None:
        """Told once; what others wrote does nothing to a terminal."""
        sentence = printable(sentence)
        if sentence not in self.noted:
            self.noted.add(sentence)
            self.tell(sentence)

    def _due(self) -> float | None:
        """As of a team; after this robot has told the others of the moment, and in an arena has heard them."""
        now = super()._due()
        if now is None:
            return None
        if self.told != now:
            self._tell_mates(now)
        if self.driver.episode is None:
            return now
        missing = {name for name in self.near if not self.driver.has_heard(name, now)}
        if missing and time.monotonic() - self.since < self.listen:
            return None
        self.near -= missing
        return now

    def _tell_mates(self, now: float) -> None:
        """What this robot knows, and where it is."""
        self.told, self.since = now, time.monotonic()
        try:
            own = self.driver.tell_own(now)
            known = self.driver.known([]) if self.shows.matched else None
        except ValueError as error:
            raise UserError(f"{error}.") from error
        if own is not None:
            self._write_map(self.maps_out[self.driver.name], *own)
        if known is not None:
            self._write_map(self.shows, now, known)
        for source, message in self.driver.pass_on(now).items():
            self.maps_out[source].write(message)
        if (word := self.driver.word(now)) is not None:
            self.says.write(self.says.make(data=write_word(word)))

    def _write_map(self, writer: Writer, time: float, grid: OccupancyGrid) -> None:
        message, frame = writer.make(), self.driver.settings.global_frame
        fill_map(message, frame, round(time * SECOND), grid.values, grid.resolution, grid.origin)
        writer.write(message)


class Ros2Base(Ros2Robot):
    """A `BaseDriver` on DDS. It goes on while no robot is near; only if none was ever heard, it ends."""

    driver: BaseDriver

    def _due(self) -> float | None:
        now = self._due_by_clock()
        if now is not None and self.told != now:
            self._tell_mates(now)
        return now

    def _is_over(self) -> bool:
        if not self.driver.words and not any(reader.matched for reader in self.words.values()):
            raise UserError(
                f"Nobody speaks on {', '.join(f'/{name}/maexp/word' for name in self.words)} in {self.answer:g} s: "
                "start the robots' processes (maexp ros2 team only=NAME), and check that robots= names them and all "
                "have the same ROS_DOMAIN_ID and network (answer=SECONDS waits longer)."
            )
        return False


def make_team(driver, wire: Wire, answer: float, tell: Callable[[str], None], goals: str) -> Ros2Team:
    """One robot, the base station or the whole team on DDS, as the driver is."""
    kind = Ros2Base if isinstance(driver, BaseDriver) else Ros2Robot if isinstance(driver, RadioDriver) else Ros2Team
    return kind(driver, wire, answer, tell, goals)
