"""DDS for tests: on this machine alone, in a domain that nobody else has."""

import time
from itertools import count
from uuid import uuid4

import numpy as np

QUICK = {"stands": 0.2, "limit": 0.5, "answer": 20.0}
"""Of `Serving`: nobody waits for long [s]."""

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General>"
    "<Discovery><Tag>{tag}</Tag></Discovery></Domain></CycloneDDS>"
)
FIRST, LAST = 1, 101  # domains whose ports Linux gives to nobody who has not asked for them
DOMAINS = count()


def surroundings() -> dict[str, str]:
    """Environment variables of a process that is to be alone with those that get the same.

    Numbers of domains are few, and tests run at once: two that draw the same are kept apart by their tags. Within a
    process, which takes the tag of a domain that it still has, each gets another number.
    """
    domain = FIRST + next(DOMAINS) % (LAST + 1 - FIRST)
    return {"CYCLONEDDS_URI": LOOPBACK.format(tag=uuid4()), "ROS_DOMAIN_ID": str(domain), "OMP_NUM_THREADS": "1"}


def publish_robot(wire, name: str, values: np.ndarray, place: tuple[float, float, float]) -> None:
    """What a robot of nobody's simulation publishes: its map, [60, 60] of cells of 0.1 m, and its pose on that."""
    from maexp.agents.deploy.ros2.messages import transform  # needs DDS

    now = int(time.time())
    message = wire.writer(f"/{name}/map").make()
    message.header.frame_id, message.header.stamp.sec = "map", now
    message.info.resolution, message.info.width, message.info.height = 0.1, 60, 60
    message.info.origin.orientation.w = 1.0
    message.data = values.ravel().tolist()
    wire.writer(f"/{name}/map").write(message)
    frames = wire.writer(f"/{name}/tf")
    frames.write(frames.make(transforms=[transform("map", "base_link", now * 10**9, place)]))
