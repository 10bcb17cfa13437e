"""DDS for tests: on this machine alone, in a domain that nobody else is likely to have."""

import os
import random

QUICK = {"stands": 0.2, "limit": 0.5, "answer": 20.0}
"""Of `Serving`: nobody waits for long [s]."""

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General>"
    "</Domain></CycloneDDS>"
)


def surroundings() -> dict[str, str]:
    """Environment variables of a process that is to be alone with those that get the same."""
    domain = random.Random(os.urandom(8)).randrange(100, 230)
    return {"CYCLONEDDS_URI": LOOPBACK, "ROS_DOMAIN_ID": str(domain), "OMP_NUM_THREADS": "1"}
