"""`policy=lookahead` on robots: its settings, and the search, which needs Warp and torch and is loaded only for it."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from maexp.envs.config.lookahead import LookaheadConfig
from maexp.envs.config_fields import check_settings

LOOKAHEAD = "lookahead"
SEARCH = "maexp.agents.policies.grid_lookahead", "Foresight"
"""Named, not imported: it stands above the runtime, which does without what the simulator needs."""


def read_lookahead(given: LookaheadConfig | Mapping[str, Any] | None) -> LookaheadConfig:
    """How to plan; None: as the simulator does.

    Raises:
        ValueError: a setting is unknown or out of its range (named, with its value).
    """
    if given is None or isinstance(given, LookaheadConfig):
        config = given or LookaheadConfig()
    elif isinstance(given, Mapping):
        names = [field.name for field in fields(LookaheadConfig)]
        if wrong := [str(name) for name in given if name not in names]:
            raise ValueError(f"lookahead names {wrong[0]!r}: choose among {', '.join(names)}")
        config = LookaheadConfig(**given)
    else:
        raise ValueError(f"lookahead={given!r}: give a LookaheadConfig, or a mapping as {{'candidates': 5}}")
    check_settings(config, LOOKAHEAD)
    return config


def load_foresight() -> Any:
    """The class of `SEARCH`.

    Raises:
        ValueError: Warp or torch is not installed.
    """
    try:
        return getattr(importlib.import_module(SEARCH[0]), SEARCH[1])
    except ImportError as error:
        raise ValueError(
            f"policy={LOOKAHEAD!r} plays the future in the simulator, and {error.name or error} is not installed: "
            "install maexp with all it needs, or choose another policy"
        ) from error
