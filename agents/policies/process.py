"""A policy in a process of its own, as a run sees it: asked, waited for, ended. Nothing that it does ends the run.

It is no sandbox: the policy can read and write what its user can. Whoever runs code that he does not trust gives it a
container of its own.
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import subprocess
import sys
import time
from typing import Any

from maexp.agents.policies import wire

EXEC, APART = "exec:", "process:"
POLL = 0.02  # seconds between two looks at the clocks of processes that think
GRACE = 2.0  # seconds that a process whose pipes are closed may take to end
TAIL = 2_000  # bytes kept of what a process says on its standard error
CHUNK = 2**16


def command_of(word: str) -> list[str]:
    """The command that `exec:COMMAND` gives, or that of a policy in Python.

    Raises:
        ValueError: the quotes of COMMAND do not match, or there is none.
    """
    if word.startswith(EXEC):
        words = shlex.split(word.removeprefix(EXEC))
        if not words:
            raise ValueError("it names no command")
        return words
    return [sys.executable, "-m", "maexp.agents.policies.guest", word.removeprefix(APART)]


class Lost(Exception):
    """A process that cannot be gone on with; says why."""


class Guest:
    """A process that plays one team.

    Args:
        command: program and arguments.

    Attributes:
        seconds: processor time of the answer that came last [s]; where a system does not tell it, the time waited.
    """

    def __init__(self, command: list[str]):
        try:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0,
                start_new_session=True,
            )  # fmt: skip
        except (OSError, ValueError) as error:
            raise Lost(f"{command[0]} cannot be started ({getattr(error, 'strerror', None) or error})") from error
        self.inbox, self.said, self.seconds, self.spent = bytearray(), bytearray(), 0.0, 0.0
        self.outbox = memoryview(b"")
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            os.set_blocking(pipe.fileno(), False)

    def begin(self, message: dict[str, Any]) -> None:
        """Put a question."""
        if self.inbox:
            raise Lost("it spoke without being asked")
        self.outbox = memoryview(wire.pack(message))
        self.asked, self.clock = time.monotonic(), self.processor_seconds()

    def processor_seconds(self) -> float:
        """Of the process and its threads so far [s]; where a system does not tell, a clock's time."""
        try:
            self.spent = time.clock_gettime((~self.process.pid << 3) | 2)  # Linux: the clock of another process
        except (OSError, AttributeError):
            if self.process.poll() is None:
                self.spent = time.monotonic()
        return self.spent

    def send(self) -> None:
        """As much of the question as fits."""
        try:
            self.outbox = self.outbox[os.write(self.process.stdin.fileno(), self.outbox[:CHUNK]) :]
        except BlockingIOError:
            pass
        except OSError:
            raise Lost(self.last_words()) from None

    def receive(self) -> dict[str, Any] | None:
        """The answer, once it is there as a whole."""
        try:
            part = os.read(self.process.stdout.fileno(), CHUNK)
        except BlockingIOError:
            return None
        if not part:
            raise Lost(self.last_words())
        self.inbox += part
        if len(self.inbox) < wire.HEAD.size:
            return None
        (length,) = wire.HEAD.unpack_from(self.inbox)
        if length > wire.MOST_ANSWER:
            raise Lost(f"it answered garbage (a message of {length:,} bytes)")
        if len(self.inbox) < wire.HEAD.size + length:
            return None
        body, self.inbox = bytes(self.inbox[wire.HEAD.size :][:length]), self.inbox[wire.HEAD.size + length :]
        self.seconds = max(self.processor_seconds() - self.clock, 0.0)
        try:
            message = wire.unpack(body)
        except ValueError as error:
            raise Lost(f"it answered garbage (a message that {error})") from error
        if message["type"] == "error":
            raise Lost(f"it gave up: {' '.join(str(message.get('message')).split())[:300]}")
        return message

    def listen(self) -> bool:
        """Keep the end of what it says on its standard error; whether there can be more."""
        try:
            part = os.read(self.process.stderr.fileno(), CHUNK)
        except BlockingIOError:
            return True
        self.said = (self.said + part)[-TAIL:]
        return bool(part)

    def check_clocks(self, limit: float, patience: float) -> None:
        """Raise Lost where it has thought for longer than `limit` [s], or owed an answer for `patience` [s]."""
        if self.processor_seconds() - self.clock > limit:
            raise Lost(f"it thought for more than {limit:g} s")
        if time.monotonic() - self.asked > patience:
            raise Lost(f"it gave no answer in {patience:g} s")

    def last_words(self) -> str:
        """How a process that has closed its pipes ended, and the last line that it said."""
        try:
            status = self.process.wait(GRACE)
            how = f"it ended with {signal.Signals(-status).name if status < 0 else f'status {status}'}"
        except (subprocess.TimeoutExpired, ValueError):
            how = "it closed its input or output"
        self.listen()
        lines = [line.strip() for line in bytes(self.said).decode(errors="replace").splitlines() if line.strip()]
        return f"{how}{f', saying {lines[-1][:200]!r}' if lines else ''}"

    def kill(self) -> None:
        """End the process, and those that it started and did not hide."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            pass
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            pipe.close()


def ask_all(
    questions: list[tuple[Guest, dict[str, Any]]], limit: float, patience: float
) -> list[dict[str, Any] | Lost]:
    """Ask several processes at once; the answer of each, or why there is none.

    Args:
        limit: processor time of an answer [s].
        patience: how long an answer may take otherwise [s].
    """
    answers: list[Any] = [None] * len(questions)
    with selectors.DefaultSelector() as selector:

        def settle(k: int, answer: Any) -> None:
            answers[k] = answer
            process = questions[k][0].process
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe.fileno() in selector.get_map():
                    selector.unregister(pipe)

        for k, (guest, message) in enumerate(questions):
            try:
                guest.begin(message)
            except Lost as lost:
                answers[k] = lost
                continue
            selector.register(guest.process.stdin, selectors.EVENT_WRITE, (k, "send"))
            selector.register(guest.process.stdout, selectors.EVENT_READ, (k, "receive"))
            selector.register(guest.process.stderr, selectors.EVENT_READ, (k, "listen"))
        while any(one is None for one in answers):
            events = selector.select(POLL)
            for key, _ in events:
                _serve(selector, key, questions[key.data[0]][0], answers, settle)
            for k, (guest, _) in enumerate(questions):
                if answers[k] is None:
                    try:
                        guest.check_clocks(limit, patience)
                    except Lost as lost:
                        settle(k, lost)
    return answers


def _serve(selector, key, guest: Guest, answers: list, settle) -> None:
    """One pipe that is ready."""
    k, what = key.data
    if answers[k] is not None:
        return
    try:
        if what == "send":
            guest.send()
            if not guest.outbox:
                selector.unregister(key.fileobj)
        elif what == "listen":
            if not guest.listen():
                selector.unregister(key.fileobj)
        elif (answer := guest.receive()) is not None:
            settle(k, answer)
    except Lost as lost:
        settle(k, lost)
