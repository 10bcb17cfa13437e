"""`python -m maexp.agents.benchmarks.conditions out=FOLDER`: what radios and failures cost, as one table
(docs/conditions.md).

Every condition is an evaluation of its own (`maexp evaluate`) below `out`, of the same episodes. A command that was
stopped goes on where it was when it is given again; more conditions, scenarios, teams or policies may join. Maps of
one's own are played as a scenario with a name: `own.floors=a.yaml,b.yaml`. A policy may need settings of its own, which
those of a condition override: `words.lookahead='lookahead.rollout_policy=universal'`.
"""

import json
import math
import shlex
import sys
from dataclasses import dataclass, field, fields
from glob import escape
from itertools import product
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from maexp.agents import cli
from maexp.agents.config.overrides import quote, split_paths
from maexp.agents.errors import UserError
from maexp.agents.evaluation.baseline import load_baseline
from maexp.agents.evaluation.cache import is_begun
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.metric_format import MEASURES, Measure
from maexp.agents.files import lock, write_json, write_text
from maexp.agents.tables import markdown_table
from maexp.envs.config_fields import check_settings, setting
from maexp.envs.scenarios import SCENARIOS

IR2 = ("comm=ir2",)
BASE = (*IR2, "comm.base_station=true", "scenario.done=base")  # else the last reports would be cut off
ODOMETRY = ("odometry.drift=0.02", "odometry.turn=0.005")
RADAR = ("radar.missed=0.5", "radar.evidence=3")
CONDITIONS = {
    "perfect": (),
    "range": ("comm.range=8", "comm.line_of_sight=true"),
    "signal": ("comm=signal",),
    "ir2": IR2,
    "ir2_noise": (*IR2, "comm.noise=13"),
    "messages": ("comm.bandwidth=1000", "comm.delay=1"),
    "faults": ("faults.probability=0.5",),
    "radar": RADAR,
    "false_alarm": ("radar.false_alarm=0.2",),
    "odometry": ODOMETRY,
    "map_errors": (*ODOMETRY, "odometry.map_errors=true"),
    "base": BASE,
    "base_return": (*BASE, "comm.strategy=return_to_base"),
    "base_courier": (*BASE, "comm.strategy=courier"),
    "base_rendezvous": (*BASE, "comm.strategy=rendezvous"),
    "base_relay": (*BASE, "comm.strategy=relay"),
    "base_pursuit": (*BASE, "comm.strategy=pursuit"),
    "all": (*BASE, "comm.noise=13", "comm.strategy=return_to_base", "faults.probability=0.5", *RADAR, *ODOMETRY),
}
"""Name -> words of `maexp evaluate`; the others are compared with the first (`COMPARED`)."""
METRICS = (
    "coverage_auc",
    "base_coverage_auc",
    "worst_coverage_auc",
    "coverage_step_95_censored",
    "told_step_95_censored",
    "mutual_overlap_85",
    "connected",
    "bytes_sent",
    "odometry_error",
    "map_error",
    "collisions",
)
"""Columns of the table."""
COMPARED = (("coverage_auc", "perfect"), ("base_coverage_auc", "base"), ("coverage_auc", ""), ("base_coverage_auc", ""))
"""Columns of paired differences in a metric, where there is something to compare: to that condition with the same
policy, or to the first policy under the same condition."""
PLAN, TABLE, FORMAT = "conditions.json", "conditions.md", "maexp-conditions-1"


@dataclass(frozen=True)
class ConditionsConfig:
    """What is played."""

    out: str = setting("conditions", "folder for the evaluations and the table")
    conditions: list[str] = setting(list(CONDITIONS), "some of `CONDITIONS`; the first of these joins them by itself")
    scenarios: list[str] = setting(["indoor_medium", "indoor_large", "maze"], "whose held-out maps are played")
    own: dict[str, str] = field(default_factory=dict)  # name -> files of a scenario of one's own, with commas between
    teams: list[int] = setting([3, 5], "sizes")
    policies: list[str] = setting(
        ["cost_utility", "hungarian", "universal"], "each as `maexp evaluate policy=` takes it"
    )
    words: dict[str, str] = field(default_factory=dict)  # name of a policy -> words of `maexp evaluate` that it needs
    episodes: int = setting(64, "of each condition, scenario, size and policy; of own maps shared out", low=1)
    num_envs: int = setting(32, "teams at once", low=1)
    seed: int = setting(0, "of maps, starts and everything else", low=0)

    @property
    def places(self) -> list[str]:
        """Names of all scenarios, those of one's own last."""
        return [*self.scenarios, *self.own]


KEPT = ("episodes", "num_envs", "seed")  # of a folder: the rest may grow
OWN_WORDS = ("policy", "scenario", "scenario.path", "num_robots", "num_threads", "hydra.run.dir", "resume", *KEPT)
"""Words of `maexp evaluate` that this command gives itself."""


def play(config: ConditionsConfig, scenario: str, team: int, condition: str, policy: str) -> None:
    """One evaluation, unless it is done; one that was stopped goes on.

    Raises:
        UserError: it came to no end; its own message has been printed.
    """
    where = place(config, scenario, team, condition, policy)
    if (where / "results.json").is_file() and not is_begun(where):
        return
    words = [f"resume={quote(str(where))}"]
    if not is_begun(where):
        words = [
            f"policy={policy}",
            *scenario_words(config, scenario),
            f"num_robots={team}",
            f"num_envs={config.num_envs}",
            f"seed={config.seed}",
            "num_threads=1",
            f"hydra.run.dir={quote(str(where))}",
            *shlex.split(config.words.get(where.name, "")),
            *CONDITIONS[condition],
        ]
    print(f"{scenario}, {team} robots: {condition}, {policy}", flush=True)
    if cli.main(["evaluate", *words]):
        where = f"{scenario} with {team} robots stopped at {condition}, {policy}"
        raise UserError(f"{where}. The same command goes on there.")


def scenario_words(config: ConditionsConfig, scenario: str) -> list[str]:
    """Where an evaluation plays, and how many episodes: on maps of one's own as many on each."""
    if scenario not in config.own:
        return [f"scenario={scenario}", f"episodes={config.episodes}"]
    files = config.own[scenario]
    each = math.ceil(config.episodes / len(split_paths(files)))
    return ["scenario=pointcloud", f"scenario.path={files}", f"episodes={each}"]


def place(config: ConditionsConfig, scenario: str, team: int, condition: str, policy: str) -> Path:
    """Folder of an evaluation."""
    return Path(config.out).absolute() / scenario / f"robots_{team}" / condition / Path(policy).name


def write_table(config: ConditionsConfig) -> None:
    """`TABLE`: means of every condition and policy, and paired differences between conditions and policies."""
    parts = []
    for scenario in config.places:
        for team in config.teams:
            found = {name: read(config, scenario, team, name) for name in config.conditions}
            parts.append(table(f"{scenario}, {team} robots", {name: row for name, row in found.items() if row}))
    write_text(Path(config.out) / TABLE, "\n\n".join(parts) + "\n")


def read(config: ConditionsConfig, scenario: str, team: int, condition: str) -> dict[str, EvaluationResult]:
    """policy -> its episodes, of those that are done."""
    folders = {policy: place(config, scenario, team, condition, policy) for policy in config.policies}
    done = {policy: where for policy, where in folders.items() if (where / "results.json").is_file()}
    return {policy: next(iter(load_baseline(str(where)).results.values())) for policy, where in done.items()}


def table(title: str, found: dict[str, dict[str, EvaluationResult]]) -> str:
    """Markdown; `found`: condition -> policy -> its episodes, the first condition first."""
    played = {name for row in found.values() for result in row.values() for name in result.episodes}
    shown = [MEASURES[name] for name in METRICS if name in played]
    policies = list(dict.fromkeys(policy for row in found.values() for policy in row))
    rows = [(condition, policy) for condition, row in found.items() for policy in row]
    columns = {}
    for metric, to in COMPARED:
        cells = [_compare(found, metric, row, (to, row[1]) if to else (row[0], policies[0])) for row in rows]
        if any(cells):
            columns[f"{MEASURES[metric].column}, minus {to or f'`{policies[0]}`'} [points]"] = cells
    heads = ["condition", "policy", *columns, *(f"{measure.column} [{measure.unit}]" for measure in shown)]
    lines = []
    for (condition, policy), *apart in zip(rows, *columns.values(), strict=True):
        summary = found[condition][policy].summary()
        lines.append([condition, f"`{policy}`", *apart, *(_mean(measure, summary) for measure in shown)])
    return "\n".join([f"**{title}**", "", *markdown_table(heads, lines)])


def _compare(
    found: dict[str, dict[str, EvaluationResult]], metric: str, row: tuple[str, str], beside: tuple[str, str]
) -> str:
    """Mean and interval of a paired difference between two (condition, policy); "" where there is nothing to compare
    with."""
    mine, other = (found.get(condition, {}).get(policy) for condition, policy in (row, beside))
    if row == beside or mine is None or other is None or metric not in mine.episodes.keys() & other.episodes.keys():
        return ""
    return MEASURES[metric].difference(mine.minus(other)[metric])


def _mean(measure: Measure, summary: dict[str, dict]) -> str:
    found = summary.get(measure.metric, {"n": 0})
    return measure.write(found["mean"]) if found["n"] else ""


def read_config(words: list[str]) -> ConditionsConfig:
    """The settings given as `name=value`.

    Raises:
        UserError: a name or value that is none.
    """
    try:
        told = OmegaConf.from_dotlist(words)
        for name in ("conditions", "scenarios", "teams", "policies"):
            if isinstance(told.get(name), str | int):  # as `maexp evaluate` takes several: a,b
                told[name] = str(told[name]).split(",")
        given = OmegaConf.merge(OmegaConf.structured(ConditionsConfig), told)
        values = OmegaConf.to_container(given)
        if wrong := [name for name in values["conditions"] if name not in CONDITIONS]:
            raise ValueError(f"conditions={wrong[0]} is unknown: choose among {', '.join(CONDITIONS)}.")
        for name in ("scenarios", "teams", "policies"):
            if not values[name] and not (name == "scenarios" and values["own"]):
                raise ValueError(f"{name}=[] is empty: name at least one.")
        check_own(values["own"], values["scenarios"])
        check_words(values["words"], [Path(policy).name for policy in values["policies"]])
        chosen = {next(iter(CONDITIONS)), *values["conditions"]}
        values["conditions"] = [name for name in CONDITIONS if name in chosen]
        config = ConditionsConfig(**values)
        check_settings(config, "conditions")
    except (OmegaConfBaseException, ValueError) as error:
        raise UserError(" ".join(str(error).split())) from error
    return config


def check_own(own: dict[str, str], scenarios: list[str]) -> None:
    """Raise ValueError for maps of one's own that are not there, or whose name is no folder's or a scenario's."""
    for name, files in own.items():
        if not name.isidentifier() or name in SCENARIOS or name in scenarios:
            raise ValueError(f"own.{name} cannot be a scenario's name: choose another, as own.floors=a.yaml,b.yaml.")
        for file in split_paths(files):
            if not Path(file).expanduser().is_file():
                raise ValueError(f"own.{name} names {file}, and there is no such file.")


def check_words(words: dict[str, str], policies: list[str]) -> None:
    """Raise ValueError for two policies of one name, and for words of a policy that is not played, or that are none."""
    if twice := [name for name in policies if policies.count(name) > 1]:
        raise ValueError(f"policies={','.join(policies)} has two called {twice[0]}: their folders would be one.")
    for name, text in words.items():
        if name not in policies:
            raise ValueError(f"words.{name} is of no policy that is played: policies={','.join(policies)}.")
        try:
            given = shlex.split(str(text))
        except ValueError as error:  # a quotation mark without its partner
            raise ValueError(f"words.{name}={text}: {error}.") from error
        if wrong := [word for word in given if "=" not in word or not isinstance(text, str)]:
            raise ValueError(
                f"words.{name}: {wrong[0]} is no word of `maexp evaluate`: write words.{name}='a.b=1 c.d=2'."
            )
        if wrong := [word for word in given if word.partition("=")[0].lstrip("+~") in OWN_WORDS]:
            raise ValueError(f"words.{name}: {wrong[0]} would play other episodes than the table says: leave it out.")


def keep_plan(config: ConditionsConfig) -> None:
    """Write down what the folder's evaluations have in common, and policies' words, or see that they are the same.

    Raises:
        UserError: it is not.
    """
    wanted = {"format": FORMAT} | {
        setting.name: getattr(config, setting.name) for setting in fields(config) if setting.name in KEPT
    }
    words = {Path(policy).name: config.words.get(Path(policy).name, "") for policy in config.policies}
    path = Path(config.out) / PLAN
    try:
        there = json.loads(path.read_text()) if path.exists() else wanted
    except ValueError:
        there = {}
    given = there.get("words", {})
    differ = {name: (there.get(name), value) for name, value in wanted.items() if there.get(name) != value}
    for name, text in words.items():
        if given.get(name, text) != text and any(Path(config.out).glob(f"*/robots_*/*/{escape(name)}")):
            differ[f"words.{name}"] = given[name], text
    for name, (was, value) in differ.items():
        raise UserError(f"out={config.out} was played with {name}={was}, not {value}: take another folder.")
    write_json(path, wanted | {"words": given | words})


def main(words: list[str]) -> int:
    """The command; see the head of this file."""
    try:
        config = read_config(words)
        Path(config.out).mkdir(parents=True, exist_ok=True)
        with lock(Path(config.out), "conditions"):
            keep_plan(config)
            try:
                for row in product(config.places, config.teams, config.conditions, config.policies):
                    play(config, *row)
            finally:  # of all that is done, however it ends
                write_table(config)
    except UserError as error:
        print(f"conditions: {error}", file=sys.stderr)
        return 2
    print(Path(config.out, TABLE).read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
