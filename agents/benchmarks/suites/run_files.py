"""The folder of a run of a suite: `run.json`, the actions of every batch of episodes, and at the end `results.json`."""

import json
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.benchmarks.suites.play import Batch
from maexp.agents.benchmarks.suites.score import Results, to_result
from maexp.agents.benchmarks.suites.suite import RESULTS, Suite, sha256
from maexp.agents.errors import UserError
from maexp.agents.files import short, without_nan, write_file, write_text
from maexp.agents.versions import PACKAGES, find_commit
from maexp.envs.maps.point_cloud import MapError, read_npz

RUN, ACTIONS = "run.json", "actions"
FORMAT = "maexp-suite-result-2"
READ = (FORMAT, "maexp-suite-result-1")  # the first had regions and offsets: results that are published stay valid
ARRAYS = {"decisions": "i", "seconds": "f", "maps": "U", "reasons": "U"}
SENT = ({"goal": "f"}, {"region": "u", "offset": "f"})
"""Of a file of actions, with the kinds of their numbers: these, and one of those."""


def batch_file(where: Path, part: str, first: int) -> Path:
    """Where the batch is that begins with an episode."""
    return where / ACTIONS / f"{part}-{first:04d}.npz"


def write_batch(where: Path, suite: Suite, part: str, batch: Batch) -> None:
    """The actions of a batch, and the metrics that came of them."""
    arrays = {name: getattr(batch, name) for name in ARRAYS} | batch.sent
    arrays["metrics"] = np.stack([batch.metrics[name] for name in suite.metrics], 1)
    write_file(batch_file(where, part, batch.first), lambda file: np.savez_compressed(file, **arrays))


def read_batch(where: Path, suite: Suite, part: str, first: int) -> Batch:
    """The batch that begins with an episode.

    Raises:
        UserError: its file is missing, damaged or holds something else.
    """
    path = batch_file(where, part, first)
    try:
        arrays = read_npz(path)
        metrics = arrays.pop("metrics")
        names = SENT["region" in arrays]
        for name, kind in (ARRAYS | names).items():
            if arrays[name].dtype.kind != kind:
                raise ValueError(f"{name} is {arrays[name].dtype}")
        sent = {name: arrays.pop(name) for name in names}
        _check_shapes(arrays, sent, suite.parts[part].num_robots, metrics, len(suite.metrics))
    except (MapError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{short(path)} is damaged or holds something else ({error}).") from error
    return Batch(first, sent=sent, metrics=dict(zip(suite.metrics, metrics.T, strict=True)), **arrays)


def _check_shapes(
    arrays: dict[str, np.ndarray], sent: dict[str, np.ndarray], robots: int, metrics: np.ndarray, count: int
) -> None:
    episodes, most = arrays["seconds"].shape
    wanted = {
        "decisions": (episodes,),
        "seconds": (episodes, most),
        "maps": (episodes,),
        "reasons": (episodes,),
    } | {name: (episodes, most, robots, 2)[: 3 if name == "region" else 4] for name in sent}
    for name, array in (arrays | sent).items():
        if array.shape != wanted[name] or not episodes or not most:
            raise ValueError(f"{name} has shape {array.shape}, not {wanted[name]}")
    if metrics.shape != (episodes, count) or metrics.dtype != np.float64:
        raise ValueError(f"metrics has shape {metrics.shape}")
    if not ((0 <= arrays["decisions"]) & (arrays["decisions"] <= most)).all():
        raise ValueError("decisions are out of range")
    if not all(np.isfinite(value).all() for value in sent.values()) or sent.get("region", np.zeros(1)).max() >= 64:
        raise ValueError("an action is out of range")


def to_results(policy: str, suite: Suite, batches: dict[str, list[Batch]]) -> Results:
    """Part -> its episodes."""
    found = {}
    for name, several in batches.items():
        episodes = {metric: np.concatenate([batch.metrics[metric] for batch in several]) for metric in suite.metrics}
        maps = np.concatenate([batch.maps for batch in several])
        found[name] = to_result(suite, policy, name, episodes, maps)
    return found


def describe_suite(suite: Suite, seed: int | None) -> dict[str, Any]:
    """Which suite this is; of another seed than its own it has other maps and starts."""
    own = {"seed": suite.key(seed), "frozen_maps": seed is None}
    return {"name": suite.name, "version": suite.version, "checksum": suite.checksum} | own


def describe_machine() -> dict[str, Any]:
    """Where it ran: bits of results are promised on one platform alone."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def describe_code() -> dict[str, Any]:
    """Which code ran."""
    return {"commit": find_commit(), "versions": {name: metadata.version(name) for name in PACKAGES}}


def list_files(where: Path) -> dict[str, str]:
    """Name -> SHA-256 of the files of actions."""
    return {f"{ACTIONS}/{path.name}": sha256(path) for path in sorted((where / ACTIONS).glob("*.npz"))}


def describe_episodes(suite: Suite, batches: dict[str, list[Batch]]) -> dict[str, dict]:
    """Part -> {map, decisions, each metric}, a value for each episode; and why those ended that were lost."""
    found = {}
    for name, several in batches.items():
        rows = {"map": [place for batch in several for place in batch.maps.tolist()]}
        rows["decisions"] = [count for batch in several for count in batch.decisions.tolist()]
        rows |= {metric: [x for batch in several for x in batch.metrics[metric].tolist()] for metric in suite.metrics}
        why = [(batch.first + k, reason) for batch in several for k, reason in enumerate(batch.reasons.tolist())]
        found[name] = rows | {"lost": {str(number): reason for number, reason in why if reason}}
    return found


def describe_decisions(batches: dict[str, list[Batch]]) -> dict[str, Any]:
    """Processor time that the decisions of a team took the policy [s]; no part of any score."""
    several = [batch for part_batches in batches.values() for batch in part_batches]
    spent = [batch.seconds[k, :count] for batch in several for k, count in enumerate(batch.decisions)]
    seconds = np.concatenate(spent).astype(np.float64) if spent else np.zeros(0)
    if not len(seconds):
        return {"count": 0}
    return {
        "count": len(seconds),
        "mean_seconds": float(seconds.mean()),
        "median_seconds": float(np.median(seconds)),
        "largest_seconds": float(seconds.max()),
    }


def write_results(where: Path, content: dict[str, Any]) -> None:
    """`results.json`, lists on one line each."""
    write_text(where / RESULTS, dump(content) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """The content of `run.json` or `results.json`.

    Raises:
        UserError: it is missing, damaged or holds something else.
    """
    try:
        content = json.loads(path.read_text())
        if content["format"] not in READ:
            raise ValueError(f"format {content['format']}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        told = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise UserError(f"{short(path)} is missing, damaged, or not of maexp suite run ({told}).") from error
    return content


def dump(value: Any, indent: str = "") -> str:
    """JSON with lists on one line each, null where a number is none."""
    if not isinstance(value, dict) or not value:
        return json.dumps(without_nan(value))
    inner = indent + "  "
    lines = [f"{inner}{json.dumps(str(name))}: {dump(item, inner)}" for name, item in value.items()]
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
