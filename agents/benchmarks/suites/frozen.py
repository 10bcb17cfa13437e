"""What is frozen with a suite: the points of its maps, and the episodes of `random` and of the reference planner."""

import csv
import io
from collections.abc import Callable

import numpy as np
import yaml

from maexp.agents.benchmarks.suites.play import build_env, build_maps, play_batch
from maexp.agents.benchmarks.suites.score import RANDOM, Results, mean_of, to_result
from maexp.agents.benchmarks.suites.suite import Part, Suite, load_suite, sha256
from maexp.agents.errors import UserError
from maexp.agents.files import checksum, short, write_text
from maexp.agents.map_sets import MAPS, MapsError
from maexp.agents.policies.classical import POLICIES
from maexp.envs import ObservationConfig, PointCloudMap

MARK = "\n# Frozen by `maexp suite freeze`: not to be edited.\n"
COLUMNS = ("policy", "part", "map")
NUM_ENVS = 16


def sums(part: Part, maps: list[PointCloudMap], seed: int | None = None) -> dict[str, str]:
    """Number of each map in the scenario, or its name in the set -> checksum of its points."""
    return {name: checksum(world) for name, world in zip(part.map_names(seed), maps, strict=True)}


def check_maps(suite: Suite, part: Part, maps: list[PointCloudMap]) -> None:
    """Raise UserError unless the maps have the points that were frozen."""
    found, wanted = sums(part, maps), suite.frozen["maps"][part.name]
    wrong = [name for name, digest in found.items() if wanted.get(name) != digest]
    if not wrong and len(found) == len(wanted):
        return
    told = ", ".join(f"{part.scenario} {name}".strip() for name in wrong[:3])
    told = f"suite {suite.name}: {part.name} has maps with other points than were frozen ({told})"
    version = "use the version of MAexp that the suite came with"
    if part.fetched:
        own = part.map_set
        raise MapsError(f"{told}: remove {short(own.kept / MAPS)} and import anew with {own.fetch}; or {version}.")
    raise UserError(f"{told}: {version}.")


def read_frozen(suite: Suite) -> dict[str, Results]:
    """The frozen episodes: policy -> part -> result.

    Raises:
        UserError: the file holds something else.
    """
    path, found = suite.episodes_file, {}
    try:
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        for policy in (RANDOM, suite.reference):
            found[policy] = {}
            for name in suite.parts:
                mine = [row for row in rows if (row["policy"], row["part"]) == (policy, name)]
                episodes = {metric: np.array([float(row[metric] or "nan") for row in mine]) for metric in suite.metrics}
                maps = np.array([row["map"] for row in mine])
                found[policy][name] = to_result(suite, policy, name, episodes, maps)
                if len(maps) != suite.episodes:
                    raise ValueError(f"{len(maps)} episodes of {policy} in {name}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is not what suite {suite.name} was frozen with ({error}): restore it.") from error
    return found


def play_rivals(suite: Suite, seed: int | None, advance: Callable[[int], None] = lambda count: None) -> dict:
    """`random` and the reference planner played now: policy -> part -> result; and part -> checksums of its maps."""
    found: dict[str, Results] = {RANDOM: {}, suite.reference: {}}
    points = {}
    for name, part in suite.parts.items():
        maps = build_maps(part, seed)
        points[name] = sums(part, maps, seed)
        count = min(NUM_ENVS, suite.episodes)
        env = build_env(part, maps, count, suite.key(seed), ObservationConfig(pictures=False), device="cpu")
        for policy, results in found.items():
            batches = []
            for first in range(0, suite.episodes, count):
                batches.append(play_batch(suite, env, POLICIES[policy](env), first))
                advance(len(batches[-1].decisions))
            episodes = {
                metric: np.concatenate([batch.metrics[metric] for batch in batches]) for metric in suite.metrics
            }
            names = np.concatenate([batch.maps for batch in batches])
            results[name] = to_result(suite, policy, name, episodes, names)
    return {"results": found, "maps": points}


def freeze(suite: Suite, made: dict, advance: Callable[[int], None] = lambda count: None) -> Suite:
    """Play `random` and the reference planner; write their episodes and, at the end of the file, what is frozen.

    Args:
        made: with what: commit, versions, machine
    """
    played = play_rivals(suite, None, advance)
    write_text(suite.episodes_file, _csv(suite, played["results"]))
    scores = {}
    for policy, results in played["results"].items():
        values = {part: result.episodes[suite.score] for part, result in results.items()}
        scores[policy] = {"score": mean_of(values)} | {part: float(value.mean()) for part, value in values.items()}
    frozen = {"scores": scores, "maps": played["maps"], "episodes": sha256(suite.episodes_file)}
    bare = Suite(suite.path, suite.content | {"frozen": frozen})
    frozen |= {"checksum": bare.checksum, "made": made}
    head = suite.path.read_text().partition(MARK)[0].rstrip("\n")
    tail = yaml.safe_dump({"frozen": frozen}, sort_keys=False, width=118, default_flow_style=None)
    write_text(suite.path, f"{head}\n{MARK}{tail}")
    return load_suite(str(suite.path))


def _csv(suite: Suite, played: dict[str, Results]) -> str:
    """A line for each episode: every metric, nothing where the episode has none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *suite.metrics])
    for policy, results in played.items():
        for part, result in results.items():
            for k, place in enumerate(result.maps):
                values = (float(result.episodes[metric][k]) for metric in suite.metrics)
                writer.writerow([policy, part, place, *("" if np.isnan(value) else value for value in values)])
    return text.getvalue()
