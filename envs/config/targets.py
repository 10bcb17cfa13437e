"""How robots share targets out."""

from dataclasses import dataclass
from typing import Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import choices_of, setting

Spare = Literal["wait", "home"]
"""Where robots go for which no target is left."""


@dataclass(frozen=True)
class TargetsConfig(Group):
    """How robots share targets out, with any policy that chooses among them."""

    group = "targets"

    distinct: bool = setting(
        True, "robots that hear each other go to different targets; else each goes where it likes best"
    )
    spare: Spare = setting(
        "wait", "where robots go for which no target is left: nowhere, or home to where they started"
    )


SPARE = choices_of(TargetsConfig, "spare")
