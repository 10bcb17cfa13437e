"""Settings of `maexp policies`."""

from dataclasses import dataclass

from omegaconf import MISSING

from maexp.envs.config_fields import setting


@dataclass
class PoliciesSettings:
    """`maexp policies`."""

    task: str = MISSING
    name: str | None = setting(None, "show: the policy, or the folder of one")
