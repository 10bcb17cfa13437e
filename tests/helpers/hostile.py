"""Policies of the arena that do what they should not, in every second episode; else their robots stay."""

import os
import shutil
import struct
import sys
import time

import msgpack
import numpy as np

from maexp.agents.policies.remote import protocol


class Stays:
    """Good: NaN is a choice. `fault` is what goes wrong at the second decision of about half the episodes."""

    def reset(self, episode):
        self.count, self.bad, self.calls = episode["num_robots"], episode["seed"] // 2 % 2 == 1, 0

    def act(self, observation):
        self.calls += 1
        if self.bad and self.calls == 2:
            return self.fault(observation)
        return np.full((self.count, 2), np.nan)

    def fault(self, observation):
        return np.full((self.count, 2), np.nan)


class IntoWalls(Stays):
    def fault(self, observation):
        return np.full((self.count, 2), -1e6)


class Chats(Stays):
    def fault(self, observation):
        print("thinking " * 200_000)
        print("thinking " * 200_000, file=sys.stderr)
        return super().fault(observation)


class Raises(Stays):
    def fault(self, observation):
        raise KeyError("no\nplan")


class Exits(Stays):
    def fault(self, observation):
        sys.exit(3)


class Dies(Stays):
    def fault(self, observation):
        os.abort()


class Sleeps(Stays):
    def fault(self, observation):
        time.sleep(1000)


class Spins(Stays):
    def fault(self, observation):
        while True:
            pass


class WrongShape(Stays):
    def fault(self, observation):
        return np.zeros((self.count + 1, 2))


class Words(Stays):
    def fault(self, observation):
        return "north"


class Nothing(Stays):
    def fault(self, observation):
        return None


class Infinite(Stays):
    def fault(self, observation):
        return np.full((self.count, 2), np.inf)


class Huge(Stays):
    """A message of a gigabyte, to every file that is open."""

    def fault(self, observation):
        message = struct.pack("<I", 2**30) + b"x" * 2**16
        for number in range(3, 30):
            for _ in range(2**14):
                try:
                    os.write(number, message)
                except OSError:
                    break
        return super().fault(observation)


class Says(Stays):
    """Writes `message` to every file that is open, and nothing more."""

    message = b""

    def fault(self, observation):
        for number in range(3, 30):
            try:
                rest = self.message
                while rest:
                    rest = rest[os.write(number, rest) :]
            except OSError:
                pass
        time.sleep(1000)


class Noise(Says):
    message = struct.pack("<I", 20) + bytes(range(200, 220))


class Twice(Says):
    """Answers before it is asked."""

    message = 2 * protocol.pack({"type": "goals", "goals": [[0.0, 0.0]] * 3})


class Deep(Says):
    """Lists in lists, so deep that Python cannot print them."""

    message = b"\x82" + b"".join(map(msgpack.packb, ("type", "error", "message"))) + b"\x91" * 1010 + b"\x01"
    message = struct.pack("<I", len(message)) + message


class Novel(Says):
    """As an array of words of one length this takes 200 GiB."""

    message = protocol.pack({"type": "goals", "goals": ["x" * 900_000] + [""] * 60_000})


class Paints(Says):
    """Words that would do something to a terminal."""

    message = protocol.pack({"type": "error", "message": "\x1b[2J\x07\u202e" + "å\n" * 300_000})


class Deaf(Stays):
    """Closes everything."""

    def fault(self, observation):
        os.closerange(0, 30)
        time.sleep(1000)


class Forks(Stays):
    """Children that hold its pipes; their numbers go to the file that HOSTILE_CHILDREN names."""

    def fault(self, observation):
        for _ in range(5):
            child = os.fork()
            if child == 0:
                self.hide()
                time.sleep(1000)
                os._exit(0)
            with open(os.environ["HOSTILE_CHILDREN"], "a") as file:
                file.write(f"{child}\n")
        os._exit(0)

    def hide(self):
        pass


class Daemons(Forks):
    """Children that leave its session."""

    def hide(self):
        os.setsid()


class Deletes(Stays):
    """The folder that it and the run are in."""

    def fault(self, observation):
        shutil.rmtree(os.getcwd())
        raise RuntimeError("gone")


class BadReset(Stays):
    def reset(self, episode):
        super().reset(episode)
        if self.bad:
            raise RuntimeError("not today")


class BadStart(Stays):
    def __init__(self):
        raise RuntimeError("no weights")


class Inert:
    """Forgot to act."""


def factory(env):
    """No class with act."""
