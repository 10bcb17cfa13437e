"""A policy in a process of its own, as a run sees it: asked, waited for, ended. Nothing that it does ends the run.

It is no sandbox: the policy can read and write what its user can. Whoever runs code that he does not trust gives it a
container of its own, and calls it there (`maexp.agents.policies.remote.server`).
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from maexp.agents.errors import printable
from maexp.agents.policies.remote import protocol, reaper

EXEC, APART = "exec:", "process:"
POLL = 0.02  # seconds between two looks at the clocks of processes that think
GRACE = 2.0  # seconds that a process whose pipes are closed may take to end
TAIL = 2_000  # bytes kept of what a process says on its standard error
CHUNK = 2**16
MOST_REASON = 400  # characters


def command_of(spec: str) -> list[str]:
    """The command that `exec:COMMAND` gives, or that of a policy in Python.

    Raises:
        ValueError: the quotes of COMMAND do not match, or there is none.
    """
    if spec.startswith(EXEC):
        specs = shlex.split(spec.removeprefix(EXEC))
        if not specs:
            raise ValueError("it names no command")
        return specs
    return [sys.executable, "-m", "maexp.agents.policies.remote.worker", spec.removeprefix(APART)]


class Lost(Exception):
    """A process that cannot be gone on with; says why in a line that can be printed, whatever the process wrote."""

    def __str__(self) -> str:
        return printable(" ".join(super().__str__().split()), MOST_REASON)


class Session(subprocess.Popen):
    """A process that leads a session; `end` ends it with all that it started, and so does the end of this process,
    however it comes."""

    def __init__(self, command: list[str], **files: Any):
        self.mark = f"{reaper.watch(os.getpid())}.{uuid4().hex}"
        super().__init__(command, start_new_session=True, env=os.environ | {reaper.MARK: self.mark}, **files)
        with suppress(OSError):  # where memory runs out, Linux ends it, and not the run
            Path(f"/proc/{self.pid}/oom_score_adj").write_text("1000")

    def end(self) -> None:
        """End all of the session, then those that left it: who was started by it has its environment."""
        try:
            os.killpg(self.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            pass
        self.wait()
        reaper.end_marked(self.mark)


class PolicyProcess:
    """A policy that plays one team, beyond two files that do not block: one takes questions, one gives answers.

    Attributes:
        seconds: what the answer that came last took [s]: processor time where that is known, else the time waited.
        spoken: what it says besides, to be read for its last words; None: nothing.
    """

    spoken: BinaryIO | None = None

    def __init__(self, asked: BinaryIO, answers: BinaryIO):
        self.asked, self.answers = asked, answers
        self.inbox, self.outbox, self.seconds = bytearray(), memoryview(b""), 0.0
        for file in self.files:
            os.set_blocking(file.fileno(), False)

    @property
    def files(self) -> list[BinaryIO]:
        """All that are open between us."""
        return [file for file in (self.asked, self.answers, self.spoken) if file is not None]

    def begin(self, message: dict[str, Any]) -> None:
        """Put a question."""
        self.receive_part()
        if self.inbox:
            raise Lost("it spoke without being asked")
        self.outbox = memoryview(protocol.pack(message))
        self.since, self.clock = time.monotonic(), self.spent_seconds()

    def spent_seconds(self) -> float:
        """What its clock shows [s]."""
        return time.monotonic()

    def send(self) -> None:
        """As much of the question as fits."""
        try:
            self.outbox = self.outbox[os.write(self.asked.fileno(), self.outbox[:CHUNK]) :]
        except BlockingIOError:
            pass
        except OSError:
            raise Lost(self.last_output()) from None

    def receive_part(self) -> None:
        """What it has said since."""
        try:
            part = os.read(self.answers.fileno(), CHUNK)
        except BlockingIOError:
            return
        except OSError:
            part = b""
        if not part:
            raise Lost(self.last_output())
        self.inbox += part

    def receive(self) -> dict[str, Any] | None:
        """The answer, once it is there as a whole."""
        self.receive_part()
        if len(self.inbox) < protocol.HEAD.size:
            return None
        (length,) = protocol.HEAD.unpack_from(self.inbox)
        if length > protocol.MOST_ANSWER:
            raise Lost(f"it answered garbage (a message of {length:,} bytes)")
        if len(self.inbox) < protocol.HEAD.size + length:
            return None
        body, self.inbox = bytes(self.inbox[protocol.HEAD.size :][:length]), self.inbox[protocol.HEAD.size + length :]
        self.seconds = max(self.spent_seconds() - self.clock, 0.0)
        try:
            message = protocol.unpack(body)
        except ValueError as error:
            raise Lost(f"it answered garbage (a message that {error})") from error
        if message["type"] == "error":
            raise Lost(f"it gave up: {' '.join(str(message.get('message')).split())[:300]}")
        return message

    def listen(self) -> bool:
        """Keep the end of what it says besides; whether there can be more."""
        return False

    def check_clocks(self, limit: float, patience: float) -> None:
        """Raise Lost where it has thought for longer than `limit` [s], or owed an answer for `patience` [s]."""
        if time.monotonic() - self.since > patience:
            raise Lost(f"it gave no answer in {patience:g} s")
        if self.spent_seconds() - self.clock > limit:
            raise Lost(f"it thought for more than {limit:g} s")

    def last_output(self) -> str:
        """Why there will be no more answers."""
        return "it closed the connection"

    def kill(self) -> None:
        """Have done with it."""
        for file in self.files:
            file.close()


class Process(PolicyProcess):
    """One in a process of this machine, which ends with it.

    Args:
        command: program and arguments.

    Raises:
        Lost: it does not start.
    """

    def __init__(self, command: list[str]):
        try:
            pipe = subprocess.PIPE
            self.process = Session(command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0)
        except (OSError, ValueError) as error:
            raise Lost(f"{command[0]} cannot be started ({getattr(error, 'strerror', None) or error})") from error
        self.spoken, self.said, self.spent, self.ended = self.process.stderr, bytearray(), 0.0, False
        super().__init__(self.process.stdin, self.process.stdout)

    def spent_seconds(self) -> float:
        """Processor time of the process and its threads so far; where a system does not tell, a clock's time."""
        try:
            self.spent = time.clock_gettime((~self.process.pid << 3) | 2)  # Linux: the clock of another process
        except (OSError, AttributeError):
            if self.process.poll() is None:
                self.spent = time.monotonic()
        return self.spent

    def listen(self) -> bool:
        """Keep the end of what it says on its standard error; whether there can be more."""
        try:
            part = os.read(self.spoken.fileno(), CHUNK)
        except BlockingIOError:
            return True
        self.said = (self.said + part)[-TAIL:]
        return bool(part)

    def check_clocks(self, limit: float, patience: float) -> None:
        """A process that has ended gives no answer, even where others that it started hold its pipes open."""
        if self.ended:  # at the last look: what it left in the pipe has been read since
            raise Lost(self.last_output())
        self.ended = self.process.poll() is not None
        super().check_clocks(limit, patience)

    def last_output(self) -> str:
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
        """End it, too."""
        self.process.end()
        super().kill()


def ask_all(
    questions: list[tuple[PolicyProcess, dict[str, Any]]], limit: float, patience: float
) -> list[dict[str, Any] | Lost]:
    """Ask several at once; the answer of each, or why there is none.

    Args:
        limit: processor time of an answer, where that is known [s].
        patience: how long an answer may take otherwise [s].
    """
    answers: list[Any] = [None] * len(questions)
    with selectors.DefaultSelector() as selector:

        def settle(k: int, answer: Any) -> None:
            answers[k] = answer
            for file in questions[k][0].files:
                if file.fileno() in selector.get_map():
                    selector.unregister(file)

        for k, (worker, message) in enumerate(questions):
            try:
                worker.begin(message)
            except Lost as lost:
                answers[k] = lost
                continue
            selector.register(worker.asked, selectors.EVENT_WRITE, (k, "send"))
            selector.register(worker.answers, selectors.EVENT_READ, (k, "receive"))
            if worker.spoken is not None:
                selector.register(worker.spoken, selectors.EVENT_READ, (k, "listen"))
        while any(answer is None for answer in answers):
            events = selector.select(POLL)
            for key, _ in events:
                _serve(selector, key, questions[key.data[0]][0], answers, settle)
            for k, (worker, _) in enumerate(questions):
                if answers[k] is None:
                    try:
                        worker.check_clocks(limit, patience)
                    except Lost as lost:
                        settle(k, lost)
    return answers


def _serve(selector, key, worker: PolicyProcess, answers: list, settle) -> None:
    """One file that is ready."""
    k, what = key.data
    if answers[k] is not None:
        return
    try:
        if what == "send":
            worker.send()
            if not worker.outbox:
                selector.unregister(key.fileobj)
        elif what == "listen":
            if not worker.listen():
                selector.unregister(key.fileobj)
        elif (answer := worker.receive()) is not None:
            settle(k, answer)
    except Lost as lost:
        settle(k, lost)
