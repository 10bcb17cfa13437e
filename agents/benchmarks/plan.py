"""What a benchmark is made of: cells, the settings of each, the folder they live in and what may change there."""

import json
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from maexp.agents.algorithms.registry import TRAININGS
from maexp.agents.config.checks import as_list, check_distinct, check_names, check_seed
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.env import episode_decisions
from maexp.agents.config.overrides import quote
from maexp.agents.config.resolved import flatten, plain
from maexp.agents.config.runs import SUPPLIERS
from maexp.agents.config.verbs import BenchmarkSettings, TrainSettings
from maexp.agents.errors import UserError
from maexp.agents.files import write_json
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.registry import NamedPolicy, check_planner, find_named_policy, name_policies
from maexp.envs.scenarios import cut_last_fifth, find_scenario, split

PLAN, FORMAT = "benchmark.json", "maexp-benchmark-1"
OPEN = "left_open"
SOURCES = "sources"
TOGETHER = "together"
"""In place of a scenario's name: all of them at once."""
SUITES = {
    "held_out": "held-out maps",
    "trained": "training maps",
    "held_out_together": "held-out maps, starts together",
}
SECTIONS = (
    "scenario",
    "robot",
    "radar",
    "planner",
    "reward",
    "observation",
    "comm",
    "faults",
    "odometry",
    "targets",
    "lookahead",
    "model",
    "collector",
    "algorithm",
    "action",
    "tuning",
    "num_envs",
    "num_robots",
    "device",
    "total_frames",
    "checkpoint_every",
    "checkpoint_keep",
    "num_threads",
)
"""Settings that a cell takes over from the benchmark where they differ from those of maexp train."""
OWN = ("scenario.name", "algorithm.name")  # each cell has its own
FREE = (
    "preset",
    "scenarios",
    "algorithms",
    "policies",
    "seeds",
    "seed",
    "maps",
    "workers",
    "device",
    "confirm",
    "report",
    "estimate",
    "resume",
    "checkpoint_every",
    "checkpoint_keep",
    "num_threads",
    *OWN,
)
"""Settings that may change when a benchmark goes on: finished cells stay comparable."""


@dataclass(frozen=True)
class Cell:
    """One policy on one scenario with one seed; the unit that is run, skipped and reported.

    Attributes:
        map: the one map the policy is trained on; None: all training maps of the scenario
    """

    scenario: str
    policy: str
    seed: int
    map: int | None = None

    @property
    def name(self) -> str:
        """As on the screen, and below `cells/`."""
        place = "" if self.map is None else f"map_{self.map}_"
        return f"{self.scenario}/{self.policy}/{place}seed_{self.seed}"

    @property
    def trains(self) -> bool:
        """Whether the policy has to be trained."""
        return self.policy in TRAININGS


def is_learned(policy: str) -> bool:
    """Whether a policy, by its name in the tables, competes with the planners that come with the package."""
    return policy not in POLICIES


def training_cell(cfg: BenchmarkSettings, cell: Cell) -> Cell:
    """The cell whose folder holds the training: one for all scenarios where they are trained on together."""
    return replace(cell, scenario=TOGETHER) if cfg.together and cell.trains else cell


def list_cells(cfg: BenchmarkSettings) -> list[Cell]:
    """All cells in the order they are run: seed by seed, scenario by scenario, classical policies first."""
    names = policy_names(cfg)
    ordered = [name for name in names if name not in TRAININGS] + [name for name in names if name in TRAININGS]
    return [
        Cell(scenario, policy, seed, index)
        for seed in as_list(cfg.seeds)
        for scenario in as_list(cfg.scenarios)
        for index in own_maps(cfg, scenario)
        for policy in ordered
    ]


def own_maps(cfg: BenchmarkSettings, scenario: str) -> list[int | None]:
    """The maps that have a policy each, or one None where a policy is trained on all."""
    if cfg.policy_per_map is None:
        return [None]
    return list(range(cfg.policy_per_map[scenario]))


def policy_names(cfg: BenchmarkSettings) -> list[str]:
    """Algorithms and policies by their names in the tables, each once."""
    words = list(dict.fromkeys(as_list(cfg.algorithms) + as_list(cfg.policies)))
    named = word_names(cfg)
    return [named.get(word, word) for word in words]


def word_names(cfg: BenchmarkSettings) -> dict[str, str]:
    """The words that name policies, and what the tables call these."""
    words = [str(word) for word in dict.fromkeys(as_list(cfg.algorithms) + as_list(cfg.policies))]
    return name_policies([word for word in words if word not in TRAININGS], "policies", TRAININGS)


def find_cell_policy(cfg: BenchmarkSettings, cell: Cell) -> NamedPolicy:
    """The policy of a cell that is not trained.

    Raises:
        UserError: it is damaged, or gone.
    """
    word = next(word for word, name in word_names(cfg).items() if name == cell.policy)
    return find_named_policy(word, "policies", cell.policy)


def policy_sources(cfg: BenchmarkSettings) -> dict[str, str]:
    """By its name, what changes with a policy that does not come with the package."""
    policies = [find_named_policy(word, "policies", name) for word, name in word_names(cfg).items()]
    return {policy.name: policy.source for policy in policies if policy.source}


def check_lists(cfg: BenchmarkSettings) -> None:
    """Raise UserError unless scenarios, policies, seeds and maps are lists of what there is."""
    check_names(cfg)
    for value in as_list(cfg.maps):
        if value not in SUITES:
            raise UserError(f"maps={value} is unknown: choose of {', '.join(SUITES)}.")
    for name in ("scenarios", "maps", "seeds"):
        if not as_list(getattr(cfg, name)):
            raise UserError(f"{name}=[] leaves nothing to do: give at least one.")
    if not policy_names(cfg):
        raise UserError("algorithms=[] and policies=[] leave nothing to compare: give at least one of either.")
    for name in ("scenarios", "algorithms", "policies", "maps", "seeds"):
        check_distinct(name, as_list(getattr(cfg, name)))
    for seed in as_list(cfg.seeds):
        check_seed(seed, "seeds")
    policies = [find_named_policy(word, "policies", name) for word, name in word_names(cfg).items()]
    check_planner(cfg.planner.name, policies)
    _check_policy_per_map(cfg)
    _check_together(cfg)


def _check_together(cfg: BenchmarkSettings) -> None:
    if not cfg.together:
        return
    if cfg.iterations is not None:
        raise UserError(f"iterations={cfg.iterations} and together=true: give total_frames, and iterations=null.")
    for name in ("policy_per_map", "train_maps"):
        if getattr(cfg, name) is not None:
            raise UserError(f"{name} and together=true: one policy is trained on all maps of all scenarios.")
    for scenario in as_list(cfg.scenarios):
        if find_scenario(scenario).build is None:
            raise UserError(f"scenarios={scenario} and together=true: only generated scenarios are trained on at once.")


def _check_policy_per_map(cfg: BenchmarkSettings) -> None:
    if cfg.policy_per_map is None:
        return
    counts = cfg.policy_per_map
    good = isinstance(counts, dict) and all(type(count) is int and count >= 1 for count in counts.values())
    if not good:
        raise UserError(f"policy_per_map={counts} must say how many maps of each scenario, as {{maze: 4}}.")
    for scenario in as_list(cfg.scenarios):
        if scenario not in counts:
            raise UserError(f"policy_per_map has no {scenario}: add policy_per_map.{scenario}=1, or leave it out.")


# Settings of a cell


def cell_overrides(cfg: BenchmarkSettings, cell: Cell) -> list[str]:
    """The cell as overrides of `maexp train`: it can be resumed, evaluated and understood by itself."""
    first, *others = as_list(cfg.scenarios) if cell.scenario == TOGETHER else [cell.scenario]
    words = [f"scenario={first}", f"seed={cell.seed}"]
    words += [f"scenario.also={render(others)}"] if others else []
    words += [f"algorithm={cell.policy}"] if cell.trains else []
    usual, ours = (flatten({name: node[name] for name in SECTIONS}) for node in (_usual(), plain(cfg)))
    changed = {name: value for name, value in ours.items() if value != usual[name] and name not in OWN}
    changed |= _maps_of(cfg, cell) | length_of(cfg, cell)
    changed |= {"episodes": 0, "evaluate_every": 0, "num_threads": cfg.num_threads or 1}
    changed = {name: value for name, value in changed.items() if not (name.startswith("algorithm.") and value is None)}
    if not cell.trains:
        changed = {name: value for name, value in changed.items() if not name.startswith("algorithm.")}
    return words + [f"{name}={render(value)}" for name, value in changed.items()]


@cache
def _usual() -> dict:
    """The settings of maexp train without overrides; of scenario and algorithm, which are each cell's own, what is set
    for all cells without overrides."""
    own = plain(compose_settings("benchmark", []))
    return plain(compose_settings("train", [])) | {name: own[name] for name in ("scenario", "algorithm")}


def _maps_of(cfg: BenchmarkSettings, cell: Cell) -> dict[str, Any]:
    """Which maps the cell trains on and which are held out, where not all of them."""
    if cell.scenario == TOGETHER or find_scenario(cell.scenario).build is None:
        return {}
    chosen: dict[str, Any] = {}
    train, _ = cut_last_fifth(split(cell.scenario)[0])
    if cell.map is not None:
        chosen["scenario.maps"] = [cell.map]
    elif cfg.train_maps is not None and cfg.scenario.maps is None:
        chosen["scenario.maps"] = list(train[: cfg.train_maps])
    if cfg.test_maps is not None and cfg.scenario.held_out is None:
        chosen["scenario.held_out_count"] = cfg.test_maps
    return chosen


def length_of(cfg: BenchmarkSettings, cell: Cell) -> dict[str, Any]:
    """For `iterations`: each collects one whole episode of every team."""
    if cfg.iterations is None:
        return {}
    steps = episode_decisions(cfg.scenario, find_scenario(cell.scenario))
    if steps is None:
        raise UserError(f"iterations={cfg.iterations} are of whole episodes: set scenario.macro_steps too.")
    return {"collector.steps": steps, "total_frames": cfg.iterations * cfg.num_envs * steps}


def cell_config(cfg: BenchmarkSettings, cell: Cell) -> tuple[TrainSettings, list[str]]:
    """(settings of maexp train, overrides) of a cell."""
    words = cell_overrides(cfg, cell)
    return compose_settings("train", words), words


def render(value: Any) -> str:
    """A value as Hydra reads it on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, dict):
        return "{" + ",".join(f"{name}:{render(item)}" for name, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(render(item) for item in value) + "]"
    return str(value) if str(value).startswith("${scenario.") else quote(str(value))


# The folder


def cell_folder(where: Path, cell: Cell) -> Path:
    return where / "cells" / cell.name


def write_plan(where: Path, cfg: BenchmarkSettings, overrides: list[str]) -> None:
    """benchmark.json: the words of the command line, the settings that all cells share, the names of those that each
    cell has from its scenario or algorithm (its own config.yaml holds them), and what tells that a policy changed."""
    shared = shared_settings(cfg)
    fixed = {name: value for name, value in shared.items() if value is not None}
    left_open = [name for name in shared if name not in fixed]
    before = read_plan(where)[SOURCES] if (where / PLAN).is_file() else {}
    content = {"format": FORMAT, "overrides": overrides, "settings": fixed, OPEN: left_open}
    write_json(where / PLAN, content | {SOURCES: before | policy_sources(cfg)})


def read_plan(place: str | Path) -> dict:
    """The content of a benchmark's benchmark.json.

    Raises:
        UserError: the folder holds no benchmark, or one of another version.
    """
    path = Path(place) / PLAN
    if not path.is_file():
        found = "does not exist" if not Path(place).exists() else f"holds no {PLAN}"
        raise UserError(f"{place} {found}: give the folder of a maexp benchmark that was started before.")
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        settings = content["settings"] | dict.fromkeys(content[OPEN])
        return {"overrides": list(content["overrides"]), "settings": settings, SOURCES: dict(content[SOURCES])}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged, or not of the kind {FORMAT}: start anew in another folder.") from error


def shared_settings(cfg: BenchmarkSettings) -> dict[str, Any]:
    """What must stay as it is for cells to be comparable; None: left open, see `write_plan`."""
    whole = {"policy_per_map": json.dumps(plain(cfg)["policy_per_map"])}  # not taken apart
    values = flatten(plain(cfg) | whole)
    values |= {name: values[source] for name, source in SUPPLIERS.items() if values[name] is None}
    shared = {name: value for name, value in values.items() if not _is_free(name)}
    return {name: "inf" if value == math.inf else value for name, value in shared.items()}  # JSON has no infinity


def _is_free(name: str) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in FREE)


def check_unchanged(where: Path, cfg: BenchmarkSettings) -> None:
    """Raise UserError if a setting differs from that of the cells already there."""
    if not (where / PLAN).is_file() or not any((where / "cells").glob("*/*/*")):
        return
    plan = read_plan(where)
    for name, source in policy_sources(cfg).items():
        if plan[SOURCES].get(name, source) != source and any((where / "cells").glob(f"*/{name}/*/*.json")):
            raise UserError(
                f"policies: {name} has changed since its cells in {where} were played: take it as it was, remove "
                f"cells/*/{name} to play them again, or start a benchmark of its own."
            )
    before, now = plan["settings"], json.loads(json.dumps(shared_settings(cfg)))
    names = [name for name in now if name in before and before[name] != now[name]]  # others came or went with the code
    if names:
        told = [
            ["left open" if plan_settings[name] is None else plan_settings[name] for plan_settings in (before, now)]
            for name in names[:4]
        ]
        listed = ", ".join(f"{name} (was {was}, now {to})" for name, (was, to) in zip(names, told, strict=False))
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        raise UserError(
            f"The cells in {where} were run with other settings: {listed}{more}. Leave these as they were "
            "(where a default has changed since, give its old value; NAME=null for what was left open), or start a "
            "benchmark of its own."
        )
