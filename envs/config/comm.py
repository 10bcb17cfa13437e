"""Communication: who hears whom, and what robots do to tell others what they know."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import choices_of, is_finite, plain_numbers, setting, shown
from maexp.kernels.constants import DT, LOSS

CELL_BYTES = 4  # of a message that tell of a cell: its number and what it is
LONGEST_DELAY = 25.0  # of a message [s]
CELLS_OF_RADAR = 80  # that IR2's sensor reaches


@dataclass(frozen=True)
class CommConfig(Group):
    """Who hears whom (docs/conditions.md).

    Robots within ``range``, in line of sight if asked, and with ``signal`` those whose signal arrives
    (`maexp.kernels.radio`). Messages may take room and time (`maexp.kernels.bandwidth`). ``strategy`` is what robots do
    to tell others what they know, whatever their policy (`maexp.envs.comm.strategy`): nothing but to talk when they
    meet (``opportunistic``), or to report or meet after ``period`` decisions. A base station is a radio with a map of
    its own.
    """

    group = "comm"

    range: float = setting(math.inf, "of a radio; inf: everyone hears everyone", unit="m", low=0, infinite=True)
    line_of_sight: bool = setting(False, "walls between two robots part them")
    signal: bool = setting(False, "robots hear those whose signal arrives")
    power: float = setting(-20.0, "that signals are sent with", unit="dBm")
    threshold: float = setting(-70.0, "that has to arrive, and more, for a link", unit="dBm")
    cell: float | Literal["auto"] = setting(
        "auto", "edge of a cell of the signal's model; auto: an 80th of the greatest radar range", unit="m", above=0
    )
    noise: float = setting(
        0.0, "greatest fading of each part of the loss, drawn for every pair and moment", unit="dB", low=0
    )
    loss: float = setting(0.0, "probability that two radios miss each other in a step of 0.1 s", low=0, high=1)
    bandwidth: float = setting(
        math.inf,
        "of a radio; what does not fit waits, what it learned first is sent first",
        unit="B/s",
        low=CELL_BYTES / DT,
        infinite=True,
    )
    delay: float = setting(0.0, "until a message arrives", unit="s", low=0, high=LONGEST_DELAY)
    base_station: bool | tuple[float, float] = setting(
        False, "true: a radio with a map of its own where robot 0 starts; or a place [x, y]", unit="m"
    )
    strategy: Literal["opportunistic", "rendezvous", "relay", "return_to_base", "courier", "pursuit"] = setting(
        "opportunistic", "what robots do to tell others what they know (docs/conditions.md)"
    )
    period: int | Literal["auto"] = setting(
        "auto", "decisions between two reports or meetings; auto: by the way back and the time left", low=1
    )

    @property
    def limited(self) -> bool:
        """Whether robots may know different things."""
        parted = self.line_of_sight or math.isfinite(self.range) or self.signal or self.loss > 0.0
        return parted or self.messages or self.has_base

    @property
    def messages(self) -> bool:
        """Whether messages take room or time."""
        return math.isfinite(self.bandwidth) or self.message_steps > 0

    @property
    def message_cells(self) -> int:
        """Cells that a radio sends in a step."""
        return int(min(self.bandwidth * DT / CELL_BYTES + 1e-6, 1e9))

    @property
    def message_steps(self) -> int:
        """Steps until a message arrives."""
        return round(self.delay / DT)

    @property
    def has_base(self) -> bool:
        """Whether there is a base station."""
        return self.base_station is not False

    def checked(self) -> "CommConfig":
        """A signal must be able to arrive, and a delay be one; a place becomes a tuple."""
        super().checked()
        if 0.0 < self.delay and not self.message_steps:
            raise ValueError(f"comm.delay={self.delay:g} is less than half a step of {DT:g} s: use 0 or {DT:g}")
        if self.signal and self.threshold >= self.power - LOSS:
            raise ValueError(
                f"comm.threshold={self.threshold:g} dBm is out of reach: of comm.power={self.power:g} dBm "
                f"{self.power - LOSS:g} arrive at best, and nobody would ever hear anybody; lower the "
                "threshold, or use comm.range=0 if that is meant"
            )
        return replace(self, base_station=_check_base(self.base_station))


def _check_base(base: Any) -> bool | tuple[float, float]:
    place = plain_numbers(base)
    if isinstance(place, bool):
        return place
    if not isinstance(place, list) or len(place) != 2 or not all(map(is_finite, place)):
        where = "true (where robot 0 starts), false or a place [x, y] in metres"
        raise ValueError(f"comm.base_station={shown(base)} must be {where}")
    return float(place[0]), float(place[1])


STRATEGIES = choices_of(CommConfig, "strategy")
