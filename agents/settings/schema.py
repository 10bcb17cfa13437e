"""What Hydra composes from: the types of a verb's settings, and the choices of groups that tables of the code hold."""

from dataclasses import asdict
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from maexp.agents.settings.algorithms import TUNINGS
from maexp.agents.settings.groups import SUPPLIED
from maexp.agents.settings.model import SIZES, SUMMARIES
from maexp.agents.settings.verbs import SCHEMAS
from maexp.envs.config import CLEARANCE, PLANNERS
from maexp.envs.scenarios import SCENARIOS, VOLUMES, Scenario

RULES: dict[str, dict[str, Any]] = {
    "ir2": {
        "defaults": [{"override /comm": "ir2"}, "_self_"],
        "num_robots": 4,
        "scenario": {
            "starts": "together",
            "done": "everyone",
            "success_coverage": 0.99,
            "importing": {"scenario": "ir2", "pixel_size": 0.2, "free_threshold": 0.41, "occupied_threshold": 0.41},
        },
    }
}
"""Scenarios that stand for a published protocol: what they set besides their rows. A pixel of IR2's plans is free if it
is brighter than 150 of 255."""


def schema(verb: str) -> type:
    """The dataclass of a verb's settings."""
    return SCHEMAS[verb]


def register_schema(verb: str) -> None:
    """Make the types known to Hydra as `<verb>_schema`, the first entry of the verb's primary config."""
    store = ConfigStore.instance().store
    store(name=f"{verb}_schema", node=schema(verb))
    for group, choices in stored_choices().items():
        for name, (_, values) in choices.items():
            rules = RULES.get(name, {}) if group == "scenario" else {}
            node = {**rules, "scenario": values | rules["scenario"]} if rules else values
            store(group=group, name=name, node=node, package="_global_" if rules else None)
    for name, row in TUNINGS.items():
        if row.reference != row.default:
            store(group="_tuning", name=f"reference_{name}", node=asdict(row.reference))


def stored_choices() -> dict[str, dict[str, tuple[str, dict[str, Any]]]]:
    """Choices of groups that tables of the code hold: {"scenario": {"maze": (summary, values)}}."""
    return {
        "scenario": {name: (row.summary, _place(row)) for name, row in (SCENARIOS | VOLUMES).items()},
        "algorithm": {name: (row.summary, {"name": name} | asdict(row.default)) for name, row in TUNINGS.items()},
        "planner": {name: (summary, _planner(name)) for name, summary in PLANNERS.items()},
        "model": {name: (SUMMARIES[name], asdict(sizes)) for name, sizes in SIZES.items()},
    }


def groups_of_rules(name: str | None) -> list[str]:
    """Groups and settings outside `scenario` that choosing a scenario sets: those of its protocol."""
    rules = RULES.get(name, {})
    chosen = [key for default in rules.get("defaults", ()) if isinstance(default, dict) for key in default]
    others = [key for key in rules if key not in ("defaults", "scenario")]
    return [key.removeprefix("override /") for key in chosen] + others


def _planner(name: str) -> dict[str, Any]:
    return {"name": name} | ({"clearance_factor": CLEARANCE[name]} if name in CLEARANCE else {})


def _place(row: Scenario) -> dict[str, Any]:
    """What a scenario's row supplies; of a map of one's own that is known when it is read."""
    if row.build is None:
        return {"name": row.name, "path": MISSING}
    return {"name": row.name} | {name: getattr(row, name) for name in SUPPLIED}
