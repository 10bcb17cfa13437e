"""Foreign policies in processes of their own or elsewhere, one a team: what one does costs it its episode, and nobody
else's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from maexp.agents.errors import UserError
from maexp.agents.policies.remote import protocol
from maexp.agents.policies.remote.numpy_policy import TeamSight, read_goals
from maexp.agents.policies.remote.process import Lost, PolicyProcess, Process, ask_all, command_of
from maexp.agents.policies.remote.server import SOCKET, Connection, address_of
from maexp.envs import ExplorationEnv

START = 120.0  # seconds that a process may take to say hello: some import a lot


def guest_of(spec: str) -> Callable[[], PolicyProcess]:
    """What makes a guest for one team: of `socket:HOST:PORT` a connection, of any other word a process.

    Raises:
        ValueError: there is no address or no command in it.
    """
    if spec.startswith(SOCKET):
        return partial(Connection, *address_of(spec))
    return partial(Process, command_of(spec))


class HostedPolicy:
    """A foreign policy for all teams of an env, each with a guest of its own.

    Beside the action it writes ``lost``, bool [E, 1]: teams whose guest has failed in this episode, and
    ``decision_seconds``, float64 [E, 1]: what the decision took (`PolicyProcess.seconds`) [s]. A team that is lost
    stays where it is; its next episode has a new process.

    Args:
        env: with a planner that drives to goals.
        start_process: called for each team (`guest_of`).
        name: of the policy, for messages.
        limit: processor time of a decision [s].
        patience: how long an answer may take otherwise [s].

    Attributes:
        reasons: why each team is lost, "" for those that are not.
    """

    def __init__(
        self, env: ExplorationEnv, start_process: Callable[[], PolicyProcess], name: str, limit: float, patience: float
    ):
        if env.planner_config.name == "direct":
            raise UserError(f"planner=direct takes controls, and {name} picks goals: use planner=dwa or wavefront.")
        self.env, self.start_process, self.name = env, start_process, name
        self.limit, self.patience = limit, patience
        self.sight, self.workers = TeamSight(env), [None] * env.num_envs
        self.reasons = [""] * env.num_envs

    def __enter__(self) -> HostedPolicy:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def close(self) -> None:
        """Have done with all guests."""
        for team, worker in enumerate(self.workers):
            if worker is not None:
                worker.kill()
            self.workers[team] = None

    @torch.no_grad()
    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        """Asks all teams that play, at once."""
        self.sight.look()
        playing, seconds = np.flatnonzero(self.sight.active).tolist(), np.zeros(self.env.num_envs)
        goals = np.full((self.env.num_envs, self.env.num_robots, 2), np.nan)
        begins = [team for team in playing if self.sight.begins[team]]
        for team in begins:
            self.reasons[team] = ""
        self._start([team for team in begins if self.workers[team] is None])
        self._ask({team: {"type": "reset", "episode": self.sight.episode(team)} for team in begins}, "ready")
        left = [team for team in playing if not self.reasons[team]]
        questions = {team: {"type": "act", "observation": self.sight.observation(team)} for team in left}
        for team, answer in self._ask(questions, "goals").items():
            seconds[team] = self.workers[team].seconds
            try:
                goals[team] = read_goals(answer.get("goals"), self.env.num_robots)
            except ValueError as error:
                self._lose(team, Lost(f"it {error}"))
        region, offset = self.sight.to_action(goals)
        state["agents", "action", "region"], state["agents", "action", "offset"] = region, offset
        state["lost"] = torch.tensor([bool(reason) for reason in self.reasons], device=self.env.device).unsqueeze(-1)
        state["decision_seconds"] = torch.from_numpy(seconds).to(self.env.device).unsqueeze(-1)
        return state

    def _start(self, teams: list[int]) -> None:
        for team in teams:
            try:
                self.workers[team] = self.start_process()
            except Lost as lost:
                self._lose(team, lost)
        hello = {"type": "hello", "version": protocol.VERSION}
        there = {team: hello for team in teams if self.workers[team] is not None}
        for team, answer in self._ask(there, "hello", START, START).items():
            if answer.get("version") != protocol.VERSION:
                version = repr(answer.get("version"))[:40]
                self._lose(team, Lost(f"it speaks version {version}, and this is {protocol.VERSION}"))

    def _ask(
        self, questions: dict[int, dict], wanted: str, limit: float | None = None, patience: float | None = None
    ) -> dict[int, dict]:
        """Answers of the wanted type by team; the teams of all others are lost."""
        asked = {team: question for team, question in questions.items() if self.workers[team] is not None}
        pairs = [(self.workers[team], question) for team, question in asked.items()]
        answers = ask_all(pairs, limit or self.limit, patience or self.patience)
        good = {}
        for team, answer in zip(asked, answers, strict=True):
            if isinstance(answer, Lost):
                self._lose(team, answer)
            elif answer["type"] != wanted:
                self._lose(team, Lost(f"it answered {answer['type'][:40]!r} where {wanted!r} was asked for"))
            else:
                good[team] = answer
        return good

    def _lose(self, team: int, why: Lost) -> None:
        self.reasons[team] = str(why)
        if self.workers[team] is not None:
            self.workers[team].kill()
        self.workers[team] = None


def greet(start_process: Callable[[], PolicyProcess], name: str) -> bool:
    """Start a policy once, before anything is played; whether it is a foreign one.

    Raises:
        UserError: it does not start, or does not say hello.
    """
    try:
        worker = start_process()
    except Lost as lost:
        raise UserError(f"policy={name}: {lost}.") from lost
    try:
        (answer,) = ask_all([(worker, {"type": "hello", "version": protocol.VERSION})], START, START)
    finally:
        worker.kill()
    if isinstance(answer, Lost):
        raise UserError(f"policy={name}: {str(answer).rstrip('.')}.") from answer
    if answer["type"] != "hello" or answer.get("version") != protocol.VERSION:
        raise UserError(
            f"policy={name} answered hello with {str(answer)[:100]}: it must speak version {protocol.VERSION}."
        )
    return bool(answer.get("foreign", True))
