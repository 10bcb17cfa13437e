"""Whom a robot is connected with over any number of others: who spoke, and when, goes from word to word."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any


class Beats:
    """When radios spoke last, as far as that was heard, from themselves or over others.

    Only who speaks makes a new time. So what goes round in circles does not keep anybody connected who is silent.

    Attributes:
        times: of the last word of each radio [s].
    """

    def __init__(self):
        self.times: dict[Hashable, float] = {}
        self._lately: set[Hashable] = set()

    def hear(self, speaker: Hashable, time: float) -> None:
        """A word has come from somebody itself, of a time [s]."""
        if time >= self.times.get(speaker, time):
            self.times[speaker] = time
            self._lately.add(speaker)

    def hear_of(self, times: Mapping[Any, float]) -> None:
        """Somebody has told of others, as `tell` has it."""
        for name, time in times.items():
            if name not in self.times or time > self.times[name]:
                self.times[name] = time
                self._lately.add(name)

    def take_lately(self) -> set[Hashable]:
        """Who has spoken since the last call."""
        lately, self._lately = self._lately, set()
        return lately

    def tell(self, since: float) -> dict[Hashable, float]:
        """Who has spoken at that time [s] or later, and when."""
        return {name: time for name, time in self.times.items() if time >= since}

    def forget_later(self, time: float) -> None:
        """What claims to be of later than that [s] would hide what comes next."""
        self.times = {name: told for name, told in self.times.items() if told <= time}
        self._lately &= self.times.keys()
