"""Policies of a suite, by the words that name them: what they see, and one for each env."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from maexp.agents.errors import UserError
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.connection import SOCKET
from maexp.agents.policies.hosted import HostedPolicy, greet, guest_of
from maexp.agents.policies.load import is_exported
from maexp.agents.policies.names import plug_ins
from maexp.agents.policies.process import APART, EXEC, Guest, command_of
from maexp.agents.training.named import NamedPolicy, find_player
from maexp.agents.training.named import short_name as name_of
from maexp.envs import ExplorationEnv, ObservationConfig


class Player:
    """A policy by the word that names it.

    Args:
        word: what `policy=` takes everywhere; `exec:COMMAND`, a program that speaks `maexp.agents.policies.wire`;
            `socket:HOST:PORT`, where one listens; or `process:NAME`, one of ours as if it were a stranger's. A class
            with `act` always plays in processes.
        limit: processor time that a decision may take a policy in processes of its own, or time elsewhere [s].
        patience: how long an answer of such a one may take otherwise [s].
        name: what tables call it; None: by its word.

    Raises:
        UserError: there is none of that name, it is damaged, does not start, or gives controls.
    """

    def __init__(self, word: str, limit: float = 60.0, patience: float = 120.0, name: str | None = None):
        self.word, self.limit, self.patience = word, limit, patience
        self.make_guest = self._find_guest()
        self.name = name or short_name(word)
        self.found: NamedPolicy | None = None if self.hosted else find_player(word, name=self.name)
        if self.found is not None and self.found.direct:
            raise UserError(f"policy={word} gives controls (planner=direct), and the robots of a suite drive to goals.")

    def _find_guest(self) -> Callable[[], Guest] | None:
        """What plays a team in a process of its own or elsewhere; None: it plays in this one."""
        if not self.word.startswith((EXEC, APART, SOCKET)) and not is_own(self.word):
            return None
        try:
            make_guest = guest_of(self.word)
        except ValueError as error:
            raise UserError(f"policy={self.word} cannot be played: {error}.") from error
        if greet(make_guest, self.word):
            return make_guest
        if self.word.startswith(APART):
            raise UserError(f"policy={self.word} is no class with act(observation): see docs/arena.md.")
        return None

    @property
    def hosted(self) -> bool:
        """Whether each team has a process or connection of its own."""
        return self.make_guest is not None

    @property
    def most_teams(self) -> int:
        """How many a hosted one plays at once unless told: who listens at a socket may serve one after another."""
        return 1 if self.word.startswith(SOCKET) else os.cpu_count() or 1

    def observation(self) -> ObservationConfig:
        """What its env shows."""
        found = self.found
        if found is None:
            return ObservationConfig(pictures=False)
        shown = {"map": found.map or "seen", "pictures": found.pictures, "targets": found.targets or 0}
        return ObservationConfig(**shown, radio=found.radio)

    def open(self, env: ExplorationEnv) -> AbstractContextManager[Callable]:
        """The policy for an env; at the end of the context it has done with its guests."""
        if self.found is None:
            return HostedPolicy(env, self.make_guest, self.name, self.limit, self.patience)
        return nullcontext(self.found.make(env))


def is_own(word: str) -> bool:
    """Whether this is module:Class or the name of a plug-in: told without running anything of it."""
    if word in POLICIES or is_exported(word):
        return False
    return word in plug_ins() or (":" in word and not os.path.exists(word))


def short_name(word: str) -> str:
    """What tables call a policy: its name, that of its folder, or that of its program."""
    if word.startswith(EXEC):
        return os.path.basename(command_of(word)[0])
    return word if ":" in word else name_of(word)
