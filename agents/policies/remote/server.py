"""A policy elsewhere, in a container or on another machine: `socket:HOST:PORT`, the messages of `wire` over TCP.

`python -m maexp.agents.policies.remote.server HOST:PORT WORD` is the other side of it, for what a process can play:
WORD is module:Class, a name, or exec:COMMAND. Every connection gets a process of its own, which ends with it; whoever
reaches the port can have it think. HOST is an address of this machine, 0.0.0.0 all of them. Needs NumPy and msgpack.
"""

from __future__ import annotations

import select
import shutil
import socket
import sys
from threading import Thread

from maexp.agents.errors import ended_by_signals
from maexp.agents.policies.remote.process import Lost, PolicyProcess, Session, command_of

SOCKET = "socket:"
REACH = 10.0  # seconds that connecting may take
CLOSED = getattr(select, "POLLRDHUP", select.POLLHUP)
POLL_MS = 100  # between two looks at whether a process has ended


def address_of(spec: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, which `socket:` may stand before; of IPv6 in brackets, as [::1]:5000.

    Raises:
        ValueError: it is none.
    """
    host, _, port = spec.removeprefix(SOCKET).rpartition(":")
    if not host or not port.isascii() or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"{spec.removeprefix(SOCKET)!r} is no HOST:PORT, as localhost:5000")
    return host.removeprefix("[").removesuffix("]"), int(port)


class Connection(PolicyProcess):
    """One that somebody at an address plays; what an answer took is the time waited, for no more is known.

    Raises:
        Lost: nobody is there.
    """

    def __init__(self, host: str, port: int):
        try:
            link = socket.create_connection((host, port), REACH)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or str(error) or "no answer"
            raise Lost(f"nobody can be reached at {host}, port {port} ({why})") from error
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().__init__(link, link.dup())


def serve(host: str, port: int, command: list[str]) -> None:
    """Start `command` for everybody who connects, with the connection as its input and output, until interrupted."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    running: set[Session] = set()
    with socket.create_server((host, port), family=family) as server:
        print(f"listening at {host}, port {server.getsockname()[1]}", flush=True)
        try:
            while True:
                link, _ = server.accept()
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                process = Session(command, stdin=link, stdout=link)
                running.add(process)
                Thread(target=_attend, args=(link, process, running), daemon=True).start()
        finally:
            for process in list(running):
                process.end()


def _attend(link: socket.socket, process: Session, running: set[Session]) -> None:
    """Have done with a process as soon as it has ended, or nobody listens to it."""
    with link:
        watch = select.poll()
        watch.register(link, CLOSED)
        while process.poll() is None and not watch.poll(POLL_MS):
            pass
        process.end()
        running.discard(process)


def main(specs: list[str]) -> int:
    """Serve until Ctrl-C, SIGTERM or SIGHUP."""
    try:
        where, spec = specs
        command = command_of(spec)
        if shutil.which(command[0]) is None:
            raise ValueError(f"{command[0]} is no program")
        with ended_by_signals():
            serve(*address_of(where), command)
    except (OSError, ValueError) as error:
        print(f"usage: python -m maexp.agents.policies.remote.server HOST:PORT WORD ({error})", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
