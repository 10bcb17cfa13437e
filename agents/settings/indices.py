"""Which maps of a scenario a run trains on, validates on and holds out."""

from collections.abc import Iterable
from typing import Any

from omegaconf import OmegaConf

from maexp.agents.errors import UserError
from maexp.agents.settings.checks import check_counts
from maexp.agents.settings.groups import ScenarioSettings
from maexp.envs.scenarios import cut_last_fifth, split


def map_indices(scenario: ScenarioSettings) -> tuple[list[int], list[int], list[int]]:
    """Indices of the maps that a scenario's settings train on, validate on (none: those trained on) and hold out."""
    trained_on, held_out = split(scenario.name)
    if scenario.held_out is not None and scenario.held_out_count is not None:
        raise UserError("scenario.held_out and scenario.held_out_count were both given: give one of them.")
    if scenario.held_out_count is not None:
        check_counts(scenario, "held_out_count", prefix="scenario.")
        held_out = range(held_out.start, held_out.start + scenario.held_out_count)
    others = _indices("scenario.held_out", scenario.held_out, held_out)
    none = OmegaConf.is_list(scenario.validation) and not len(scenario.validation)
    trained_on, choosing = (trained_on, []) if none else cut_last_fifth(trained_on)
    indices = _indices("scenario.maps", scenario.maps, trained_on)
    unused = [index for index in choosing if index not in indices and index not in others]
    return indices, [] if none else _indices("scenario.validation", scenario.validation, unused), others


def _indices(name: str, value: Any, default: Iterable[int]) -> list[int]:
    if value is None:
        return list(default)
    value = OmegaConf.to_container(value) if OmegaConf.is_list(value) else value
    indices = [value] if isinstance(value, int) else value
    good = isinstance(indices, list) and indices and all(type(index) is int and index >= 0 for index in indices)
    if not good:
        raise UserError(f"{name}={value} must be a list of whole numbers, 0 or more, as [0,1,2].")
    return indices
