"""The base station of a ROS 2 team without a central planner: it hears robots, and tells who hears it what it knows."""

from __future__ import annotations

from .contacts import BASE, read_comm
from .driver import Decision, DriverSettings, TeamDriver
from .frames import OccupancyGrid
from .radio_driver import RadioDriver
from .robot_driver import RobotDriver
from .words import Word


class BaseDriver(RadioDriver):
    """A `RadioDriver` that stands in one place, `settings.comm.base_station`, and drives nothing.

    Args:
        settings: of the team, with `only` "base_station".

    Raises:
        ValueError: as for `RadioDriver`; its place is missing.
    """

    def __init__(self, settings: DriverSettings):
        comm = read_comm(settings.comm)
        if comm is None or isinstance(comm.base_station, bool):
            raise ValueError(f"only={BASE} needs its place: comm.base_station=[x,y], in metres, in the team's frame")
        self.place = comm.base_station
        super().__init__(settings)

    def _make_planner(self) -> None:
        return None

    def word(self, now: float) -> Word:
        """Where it stands, and whom it hears."""
        x, y = self.place
        return Word(BASE, (x, y, 0.0), 0.0, now, hears=self.beats.tell(now - self.settings.memory))

    def tell_own(self, now: float) -> None:
        """It sees nothing itself."""

    def known(self, notes: list[str]) -> OccupancyGrid | None:
        """As of `RadioDriver`."""
        return self._add_told([], notes)

    def _decide(self, now: float) -> Decision:
        return Decision([], None, [])


def make_driver(settings: DriverSettings) -> TeamDriver:
    """Of the whole team, or of the one robot or the base station that `only` names.

    Raises:
        ValueError: as `TeamDriver`.
    """
    kind = {"": TeamDriver, BASE: BaseDriver}.get(settings.only, RobotDriver)
    return kind(settings)
