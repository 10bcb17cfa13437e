"""A trained policy as a folder that `maexp.agents.runtime` plans with, on computers without torch."""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from importlib import metadata
from pathlib import Path

import torch

from maexp.agents.errors import UserError
from maexp.agents.files import write_file, write_json, write_text
from maexp.agents.runtime.folder import CONTRACT, FORMAT, NETWORK
from maexp.agents.target_networks import TargetChooser
from maexp.envs.target_view import FEATURES

OPSET = 18
WEIGHTS, CARD = "weights.safetensors", "card.md"
MOST = {"batch": 4096, "robots": 64, "candidates": 1024}


def export_policy(policy: torch.nn.Module, env, folder: Path, name: str, card: str) -> None:
    """Write the folder of a policy that chooses among targets.

    Args:
        policy: of `make_policy`.
        env: gives what it was trained for.
        folder: new or empty.
        name: of the policy.
        card: what it was trained on, how well it does and what it is not good for, in Markdown.

    Raises:
        UserError: the policy chooses regions, the folder holds something, or an extra is missing.
    """
    chooser = find_chooser(policy)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"out={folder} holds something already and is left alone: choose another name.")
    try:
        from safetensors.torch import save
    except ImportError as error:
        raise UserError("Exporting needs safetensors: pip install 'maexp[export]'.") from error
    weights = save({key: value.contiguous() for key, value in chooser.state_dict().items()})
    files = {NETWORK: to_onnx(chooser, env.num_robots), WEIGHTS: weights}
    contract = describe(env, name) | {"sha256": {key: hashlib.sha256(one).hexdigest() for key, one in files.items()}}
    for file, content in files.items():
        write_file(folder / file, lambda out, content=content: out.write(content))
    write_text(folder / CARD, card)
    write_json(folder / CONTRACT, contract)  # last: a folder without it is no policy


def find_chooser(policy: torch.nn.Module) -> TargetChooser:
    """The network of a policy that chooses among targets, on the CPU.

    Raises:
        UserError: it chooses regions of a map, which a robot's growing map has not.
    """
    for part in policy.modules():
        if isinstance(part, TargetChooser):
            return part.cpu().eval()
    raise UserError("This policy does not choose among frontier targets: train one with action=targets to export it.")


def describe(env, name: str) -> dict:
    """What goes in and out, in which units, and what the policy was trained for."""
    robots = env.simulation.robot_tensors
    return {
        "format": FORMAT,
        "name": name,
        "inputs": {
            "features": ["batch", "robots", "candidates", len(FEATURES)],
            "mask": ["batch", "robots", "candidates"],
            "comm": ["batch", "robots", "robots"],
        },
        "outputs": {"logits": ["batch", "robots", "candidates"]},
        "features": list(FEATURES),
        "units": "lengths in radar ranges, areas in radar discs, angles as cosine and sine from the heading",
        "candidates": env.observation_config.targets,
        "radar_range": max(one.range for one in env.radar_configs),
        "robot_radius": float(robots["threshold"].max()),
        "max_speed": float(robots["max_speed"].max()),
        "max_accel": float(robots["max_accel"].max()),
        "seconds": 0.1 * env.local_steps,
        "resolution": float(env.maps[0].resolution),
        "num_robots": env.num_robots,
        "opset": OPSET,
        "versions": {one: metadata.version(one) for one in ("maexp", "torch", "onnx", "onnxscript")},
    }


def to_onnx(chooser: TargetChooser, robots: int) -> bytes:
    """The network for any batch, team and number of candidates.

    Raises:
        UserError: the exporter is not installed.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise UserError("Exporting needs onnx and onnxscript: pip install 'maexp[export]'.") from error
    batch, team, count = (torch.export.Dim(name, min=1, max=most) for name, most in MOST.items())
    example = (
        torch.randn(2, max(robots, 2), 5, len(FEATURES)),
        torch.ones(2, max(robots, 2), 5, dtype=torch.bool),
        torch.ones(2, max(robots, 2), max(robots, 2), dtype=torch.bool),
    )
    shapes = {"features": {0: batch, 1: team, 2: count}, "mask": {0: batch, 1: team, 2: count}}
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nothing here needs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about names of axes that are the same axis
        program = torch.onnx.export(
            chooser, example, dynamo=True, verbose=False, opset_version=OPSET, input_names=["features", "mask", "comm"],
            output_names=["logits"], dynamic_shapes=shapes | {"comm": {0: batch, 1: team, 2: team}},
        )  # fmt: skip
    out = io.BytesIO()
    program.save(out)
    return out.getvalue()
