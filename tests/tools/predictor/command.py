"""What the four commands share: settings from words like `steps=1200`, and errors as a sentence."""

import sys
from collections.abc import Callable
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from maexp.agents.config.schema import default_values, make_settings
from maexp.agents.errors import UserError


def run(kind: type, work: Callable[[Any], None]) -> int:
    """Do `work` with the settings, a dataclass of `kind`, that the command line comes to; the exit status."""
    try:
        work(make_settings(kind, default_values(kind) | OmegaConf.to_container(OmegaConf.from_cli())))
    except (OmegaConfBaseException, UserError, OSError, ValueError) as error:
        print(str(error).splitlines()[0], file=sys.stderr)
        return 1
    return 0
