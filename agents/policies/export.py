"""A trained policy as a folder that `maexp.agents.runtime` plans with, on computers without torch."""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import nn

from maexp.agents.deploy.planner.bundle import CARD, CONTRACT, FORMAT, NETWORK, WEIGHTS
from maexp.agents.errors import UserError
from maexp.agents.files import write_file, write_json, write_text
from maexp.agents.models.target_chooser import TargetChooser
from maexp.agents.versions import find_commit
from maexp.envs import ExplorationEnv
from maexp.envs.scenarios import Scenario, find_scenario
from maexp.envs.targets.features import RADIO_TABLE, TABLE, feature_names
from maexp.kernels.constants import DT

OPSET = 18
MOST = {"batch": 4096, "robots": 64, "candidates": 1024}
TEAM = ["batch", "robots"]
INPUTS = {
    "features": {"shape": [*TEAM, "candidates", len(TABLE)], "type": "float32", "is": "see features and units"},
    "mask": {"shape": [*TEAM, "candidates"], "type": "bool", "is": "which candidates there are"},
    "comm": {"shape": [*TEAM, "robots"], "type": "bool", "is": "who hears whom"},
}
OUTPUTS = {"logits": {"shape": [*TEAM, "candidates"], "type": "float32", "is": "of taking the candidate, each robot"}}
PACKAGES = ("maexp", "torch", "onnx", "onnxscript", "safetensors")


def export_policy(
    policy: torch.nn.Module, env: ExplorationEnv, folder: Path, name: str, card: str, trained: dict[str, Any]
) -> None:
    """Write the folder of a policy that chooses among targets.

    Args:
        policy: of `make_policy`.
        env: gives what it was trained for.
        folder: new or empty.
        name: of the policy.
        card: what it was trained on, how well it does and what it is not good for, in Markdown.
        trained: how it was trained, for the contract; `scenarios` names where.

    Raises:
        UserError: the policy chooses regions, the folder holds something, or an extra is missing.
    """
    chooser = find_chooser(policy)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"out={folder} holds something already and is left alone: choose another name.")
    from safetensors.torch import save

    weights = save({key: value.contiguous() for key, value in chooser.state_dict().items()})
    files = {NETWORK: to_onnx(chooser, env.num_robots), WEIGHTS: weights}
    sums = {key: hashlib.sha256(content).hexdigest() for key, content in files.items()}
    for file, content in files.items():
        write_file(folder / file, lambda out, content=content: out.write(content))
    write_text(folder / CARD, card)
    # Last: a folder without it is no policy.
    write_json(folder / CONTRACT, describe(chooser, env, name, trained) | {"sha256": sums})


def find_chooser(policy: torch.nn.Module) -> TargetChooser:
    """The network of a policy that chooses among targets, on the CPU.

    Raises:
        UserError: it chooses regions of a map, which a robot's growing map has not.
    """
    for part in policy.modules():
        if isinstance(part, TargetChooser):
            return part.cpu().eval()
    raise UserError("This policy does not choose among frontier targets: train one with action=targets to export it.")


def describe(chooser: TargetChooser, env: ExplorationEnv, name: str, trained: dict[str, Any]) -> dict[str, Any]:
    """What goes in and out, in which units, and what the policy was trained for."""
    protocol = env.local_steps == env.scenario.local_steps  # else all scenarios were played at the usual pace
    places = {scenario: numbers_of(find_scenario(scenario), protocol) for scenario in trained.get("scenarios", [])}
    own = numbers_of_env(env)
    if env.scenario.name in places:
        places[env.scenario.name] = own
    names, rows = feature_names(chooser.radio), TABLE | RADIO_TABLE
    features = INPUTS["features"] | {"shape": [*TEAM, "candidates", len(names)]}
    several = len(places) > 1  # lengths count in radar ranges: any will do, those of an imported floor suit robots
    return {
        "format": FORMAT,
        "name": name,
        "inputs": INPUTS | {"features": features},
        "outputs": OUTPUTS,
        "features": list(names),
        "units": {name: rows[name].unit for name in names},
        "frames": "distances and bearings are the same in every frame; bearings are taken from a robot's heading",
        "candidates": env.observation_config.targets,
        "model": {
            "target_width": chooser.head.in_features,
            "target_heads": chooser.encoder.among_targets.heads,
            "starts_from": chooser.starts_from,
            "score_weight": chooser.score_weight,
        },
        **(numbers_of(find_scenario("pointcloud"), protocol) if several else own),
        "trained": trained | {"scenarios": places},
        "team_sizes": {"trained": trained.get("num_robots", [env.num_robots]), "most": MOST["robots"]},
        "opset": OPSET,
        "versions": {package: metadata.version(package) for package in PACKAGES},
        "commit": find_commit(),
    }


def numbers_of_env(env: ExplorationEnv) -> dict[str, float]:
    """What robots are like in an env, in m and s: those that a policy looks at, and the resolution."""
    robots = env.simulation.robot_tensors
    return {
        "radar_range": max(radar.range for radar in env.radar_configs),
        "robot_radius": float(robots["collision_threshold"].max()),
        "max_speed": float(robots["max_speed"].max()),
        "max_accel": float(robots["max_accel"].max()),
        "seconds": DT * env.local_steps,
        "resolution": float(env.maps[0].resolution),
    }


def numbers_of(row: Scenario, protocol: bool) -> dict[str, float]:
    """The same of a scenario, at the pace of its protocol or at the usual one."""
    return {
        "radar_range": row.radar_range,
        "robot_radius": row.collision_threshold,
        "max_speed": row.max_speed,
        "max_accel": row.max_accel,
        "seconds": DT * (row.local_steps if protocol else row.decision_steps()),
        "resolution": row.resolution,
    }


def to_onnx(chooser: TargetChooser, robots: int) -> bytes:
    """The network for any batch, team and number of candidates.

    Raises:
        UserError: the exporter is not installed.
    """
    batch, team, count = (torch.export.Dim(name, min=1, max=most) for name, most in MOST.items())
    example = {
        "features": torch.randn(2, max(robots, 2), 5, len(feature_names(chooser.radio))),
        "mask": torch.ones(2, max(robots, 2), 5, dtype=torch.bool),
        "comm": torch.ones(2, max(robots, 2), max(robots, 2), dtype=torch.bool),
    }
    shapes = {"features": {0: batch, 1: team, 2: count}, "mask": {0: batch, 1: team, 2: count}}
    return trace_network(chooser, example, "logits", shapes | {"comm": {0: batch, 1: team, 2: team}})


def trace_network(net: nn.Module, example: dict[str, torch.Tensor], output: str, shapes: dict[str, dict]) -> bytes:
    """A network in ONNX.

    Args:
        example: its inputs by name.
        output: the name of its output.
        shapes: of each input, the axes whose lengths vary.

    Raises:
        UserError: the exporter is not installed.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise UserError("Exporting needs onnx and onnxscript: pip install 'maexp[export]'.") from error
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nothing here needs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about names of axes that are the same axis
        program = torch.onnx.export(
            net,
            tuple(example.values()),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=list(example),
            output_names=[output],
            dynamic_shapes=shapes,
        )
    out = io.BytesIO()
    program.save(out)
    return without_traces(out.getvalue())


def without_traces(network: bytes) -> bytes:
    """The network without the lines of code that it came from: they name folders of this machine."""
    import onnx

    model = onnx.load_from_string(network)
    graph = model.graph
    for part in (
        model,
        graph,
        *model.functions,
        *graph.node,
        *graph.value_info,
        *graph.input,
        *graph.output,
        *graph.initializer,
        *(node for function in model.functions for node in function.node),
    ):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    return model.SerializeToString(deterministic=True)
