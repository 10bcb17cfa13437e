"""A suite: parts with their maps, robots, radar, radios, starts and episodes, from a file that never changes.

`NAME.yaml` defines it and ends with what was frozen: checksums of the points of its maps, the scores of `random` and of
the reference planner, and a checksum over all of it. `NAME.csv` holds their episodes.
"""

import hashlib
import json
import math
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import maexp.conf
from maexp.agents.errors import UserError
from maexp.agents.files import short
from maexp.agents.map_sets import SPLITS, Entry, MapsError, MapSet, load_set, set_names
from maexp.envs.config import DONE, STARTS
from maexp.envs.scenarios import SCENARIOS

FOLDER = Path(maexp.conf.__path__[0]) / "_suite"
KEYS = ("name", "version", "score", "metrics", "reference", "seed", "episodes", "decision_limit", "parts")
GENERATED, FETCHED = ("scenario", "first", "count"), ("fetched",)
"""What says which maps a part has: one or the other."""
OWN = ("score", "done")
"""What a part may have beside `PART_KEYS`: its score, where that is not the suite's; whose coverage ends an episode."""
PART_KEYS = (
    "num_robots",
    "starts",
    "local_steps",
    "macro_steps",
    "success_coverage",
    "collision",
    "robot",
    "radar",
    "planner",
    "comm",
)
RESULTS = "results.json"
"""In the folder of a run that is complete."""
SCORE = "score"
"""What counts in each part, as if it were a metric, where parts have different scores."""
OTHER_MAPS = 10_000, 2**31
"""Between these lie the numbers of the maps of another seed."""


@dataclass(frozen=True)
class Part:
    """Teams of one size on maps of one scenario, or of a published set; fields as in the file, lengths in metres, times
    in local steps.
    """

    name: str
    num_robots: int
    starts: str
    local_steps: int
    macro_steps: int
    success_coverage: float
    collision: str
    robot: dict
    radar: dict
    planner: dict
    comm: dict
    scenario: str = ""
    first: int = 0
    count: int = 0
    fetched: str = ""
    score: str = ""
    done: str = "union"

    @property
    def limit(self) -> int:
        """Local steps of an episode."""
        return self.local_steps * self.macro_steps

    def indices(self, seed: int | None = None) -> list[int]:
        """Numbers of its maps in the scenario; of another `seed` others, none of them twice."""
        if seed is None:
            return list(range(self.first, self.first + self.count))
        drawn = np.random.default_rng([seed, *self.scenario.encode()]).integers(*OTHER_MAPS, 4 * self.count)
        return list(dict.fromkeys(drawn.tolist()))[: self.count]

    @property
    def map_set(self) -> MapSet:
        """The published set of which `fetched` names a split."""
        return load_set(self.fetched.partition("/")[0])

    @property
    def floors(self) -> list[Entry]:
        """The maps of that split, in the order of the set."""
        return [floor for floor in self.map_set.maps if floor.split == self.fetched.partition("/")[2]]

    def check_fetched(self) -> None:
        """Raise MapsError unless all of them have been fetched."""
        where, floors = self.map_set.kept, self.floors
        if missing := [floor.name for floor in floors if not (where / floor.map_place).is_file()]:
            raise MapsError(
                f"{self.name} plays maps of {self.fetched}, and {len(missing)} of {len(floors)} are not in "
                f"{short(where)}: fetch them with {self.map_set.fetch}."
            )

    def map_names(self, seed: int | None = None) -> list[str]:
        """What tells its maps apart: numbers in the scenario, or names in the set."""
        if self.fetched:
            return [floor.name for floor in self.floors]
        return [str(index) for index in self.indices(seed)]


@dataclass(frozen=True)
class Suite:
    """A suite as its file has it; `content` is all that the file says."""

    path: Path
    content: dict[str, Any]

    @property
    def name(self) -> str:
        return self.content["name"]

    @property
    def version(self) -> int:
        return self.content["version"]

    @property
    def seed(self) -> int:
        return self.content["seed"]

    def key(self, seed: int | None) -> int:
        """What random numbers of a run start from; `seed` None: the suite's own."""
        return self.seed if seed is None else seed

    @property
    def episodes(self) -> int:
        """Episodes of each part."""
        return self.content["episodes"]

    @property
    def score(self) -> str:
        """The metric whose mean over all episodes is the score; `SCORE` where parts have different ones."""
        found = set(self.scores.values())
        return SCORE if len(found) > 1 else found.pop()

    @property
    def scores(self) -> dict[str, str]:
        """Part -> the metric that counts there."""
        return {name: part.score or self.content["score"] for name, part in self.parts.items()}

    @property
    def metrics(self) -> list[str]:
        return self.content["metrics"]

    @property
    def reference(self) -> str:
        """The planner whose score counts as 1."""
        return self.content["reference"]

    @property
    def decision_limit(self) -> float:
        """Processor time that a decision may take a policy in a process of its own [s]."""
        return self.content["decision_limit"]

    @cached_property
    def parts(self) -> dict[str, Part]:
        return {name: Part(name, **values) for name, values in self.content["parts"].items()}

    @property
    def frozen(self) -> dict[str, Any]:
        """What `maexp suite freeze` wrote; {} before."""
        return self.content.get("frozen", {})

    @property
    def episodes_file(self) -> Path:
        """The episodes of `random` and of the reference planner."""
        return self.path.with_suffix(".csv")

    @cached_property
    def checksum(self) -> str:
        """SHA-256 over the definition, the points of the maps, the frozen scores and the frozen episodes."""
        frozen = {name: value for name, value in self.frozen.items() if name not in ("checksum", "made")}
        text = json.dumps(_plain(self.content | {"frozen": frozen}), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def check(self) -> None:
        """Raise UserError unless the file and the episodes beside it are as they were frozen."""
        if not self.frozen:
            raise UserError(f"{self.path} is not frozen: play its reference with maexp suite freeze {self.path}.")
        if sha256(self.episodes_file) != self.frozen["episodes"]:
            raise UserError(f"{self.episodes_file} is not the file that {self.path.name} was frozen with: restore it.")
        if self.checksum != self.frozen["checksum"]:
            raise UserError(
                f"{self.path} was changed since it was frozen (checksum {self.checksum[:16]}, not "
                f"{self.frozen['checksum'][:16]}): restore it, or give it a new version and freeze it."
            )


def suite_names() -> list[str]:
    """The suites that come with the package, the quick one first."""
    return sorted((path.stem for path in FOLDER.glob("*.yaml")), key=lambda name: (name != "minival", name))


def load_suite(spec: str) -> Suite:
    """A suite by its name, or by the path of its .yaml file.

    Raises:
        UserError: there is none of that name, or its file does not define one.
    """
    path = FOLDER / f"{spec}.yaml" if spec in suite_names() else Path(spec).expanduser()
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        raise UserError(f"{spec} is no suite: choose one of {', '.join(suite_names())}, or give a .yaml file.")
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path} cannot be read as YAML ({' '.join(str(error).split())[:200]}).") from error
    _check_content(path, content)
    return Suite(path, content)


def sha256(path: Path) -> str:
    """Of a file; "" where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _plain(value: Any) -> Any:
    """For JSON: infinity as text, keys as text."""
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _check_content(path: Path, content: Any) -> None:
    _check_keys(path, "", content, KEYS, ("frozen",))
    for name in ("version", "episodes"):
        _check_count(path, name, content[name])
    _check_count(path, "seed", content["seed"], least=0)
    if content["score"] not in content["metrics"]:
        raise UserError(f"{path}: score={content['score']} must be one of the metrics.")
    if not isinstance(content["parts"], dict) or not content["parts"]:
        raise UserError(f"{path}: parts must name at least one part.")
    for name, part in content["parts"].items():
        fetched = isinstance(part, dict) and "fetched" in part
        _check_keys(path, f"parts.{name}.", part, (*(FETCHED if fetched else GENERATED), *PART_KEYS), OWN)
        for count in ("num_robots", "local_steps", "macro_steps"):
            _check_count(path, f"parts.{name}.{count}", part[count])
        (_check_fetched if fetched else _check_generated)(path, f"parts.{name}", part)
        if part["starts"] not in STARTS:
            raise UserError(f"{path}: parts.{name}.starts={part['starts']} is unknown: choose {', '.join(STARTS)}.")
        for group, kind in _configs().items():
            _check_group(path, f"parts.{name}.{group}", part[group], kind)
        _check_own(path, f"parts.{name}", part, content)


def _check_generated(path: Path, where: str, part: dict) -> None:
    _check_count(path, f"{where}.count", part["count"])
    _check_count(path, f"{where}.first", part["first"], least=0)
    scenario = SCENARIOS.get(part["scenario"])
    if scenario is None or scenario.build is None:
        raise UserError(f"{path}: {where}.scenario={part['scenario']} builds no maps.")


def _check_fetched(path: Path, where: str, part: dict) -> None:
    known = [f"{name}/{split}" for name in set_names() for split in SPLITS]
    if part["fetched"] not in known:
        raise UserError(f"{path}: {where}.fetched={part['fetched']} is unknown: choose {', '.join(known)}.")


def _check_own(path: Path, where: str, part: dict, content: dict) -> None:
    """Whether somebody knows what is scored, and what ends an episode."""
    from maexp.envs.config import CommConfig

    score = part.get("score", content["score"])
    try:
        comm = CommConfig(**part["comm"]).checked()
    except ValueError as error:
        raise UserError(f"{path}: {where}: {error}.") from error
    if score not in content["metrics"]:
        raise UserError(f"{path}: {where}.score={score} must be one of the metrics.")
    if part.get("done", "union") not in DONE:
        raise UserError(f"{path}: {where}.done={part['done']} is unknown: choose {', '.join(DONE)}.")
    if score.startswith("base_") and not comm.has_base:
        raise UserError(f"{path}: {where} is scored by {score} and has no base station: set its comm.base_station.")
    if score.startswith("worst_") and not comm.limited:
        raise UserError(f"{path}: {where} is scored by {score}, and all know the same: limit its comm.")


def _configs() -> dict[str, type]:
    from maexp.envs.config import CommConfig, PlannerConfig, RadarConfig, RobotConfig

    return {"robot": RobotConfig, "radar": RadarConfig, "planner": PlannerConfig, "comm": CommConfig}


def _check_group(path: Path, name: str, values: Any, kind: type) -> None:
    """Every value that a scenario would else fill in must be given: the table of scenarios may change."""
    from maexp.envs.config import supplied

    _check_keys(path, f"{name}.", values, supplied(kind), [field.name for field in fields(kind)])


def _check_keys(path: Path, prefix: str, content: Any, needed, allowed=()) -> None:
    if not isinstance(content, dict):
        raise UserError(f"{path} does not define a suite: {prefix.rstrip('.') or 'it'} must hold names with values.")
    for name in needed:
        if name not in content:
            raise UserError(f"{path} leaves {prefix}{name} open: a suite fixes it.")
    for name in content:
        if name not in needed and name not in allowed:
            raise UserError(f"{path}: {prefix}{name} is unknown: choose among {', '.join((*needed, *allowed))}.")


def _check_count(path: Path, name: str, value: Any, least: int = 1) -> None:
    if type(value) is not int or value < least:
        raise UserError(f"{path}: {name}={value} must be a whole number, {least} or more.")
