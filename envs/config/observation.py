"""What robots see."""

from dataclasses import dataclass
from typing import Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import setting

MOST_TARGETS = 256  # that a robot is shown


@dataclass(frozen=True)
class ObservationConfig(Group):
    """What a robot sees; its frontier targets are those of `maexp.envs.targets.observation`."""

    group = "observation"

    map: Literal["seen", "known"] = setting(
        "seen", "what its picture shows: seen by itself, or known: through communication, too"
    )
    pictures: bool = setting(True, "false leaves them out: they are most of an observation's cost")
    targets: int = setting(
        0, "frontier targets that a robot is shown, to choose from; 0: none", low=0, high=MOST_TARGETS
    )
    radio: bool = setting(
        False,
        "targets tell of radios too: who was connected when, what the base station lacks, its signal; and one more "
        "target is to go and tell it (docs/conditions.md)",
    )
