"""A trained map predictor as a folder that ships or that robots use: weights, ONNX, contract and card.

`python -m tests.tools.predictor.export run=FOLDER train=BELIEFS out=FOLDER card=FILE`
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import torch
from torch import Tensor, nn

from maexp.agents.deploy.planner.bundle import CARD, WEIGHTS
from maexp.agents.errors import UserError
from maexp.agents.files import write_file, write_json, write_text
from maexp.agents.models.map_predictor import CONTRACT, NETWORK, STRIDE, MapPredictor, finish_guess
from maexp.agents.policies.export import OPSET, PACKAGES, trace_network
from maexp.agents.versions import find_commit

from .beliefs import load_groups
from .command import run
from .score import count_tables
from .train import CHECKPOINT

FORMAT = "maexp-predictor-1"
MOST = {"batch": 4096, "rows": 256, "columns": 256}


@dataclass(frozen=True)
class ExportConfig:
    """What is exported.

    Attributes:
        run: folder of a training.
        train: folder of the beliefs it was trained on, for the histogram.
        card: Markdown file that says what it was trained on and how well it does.
        out: the new folder.
    """

    run: str = "map_predictor"
    train: str = "beliefs/train"
    card: str = ""
    out: str = "predictor"


class Guess(nn.Module):
    """The network with what is known put in its place."""

    def __init__(self, net: MapPredictor):
        super().__init__()
        self.net = net

    def forward(self, known: Tensor) -> Tensor:
        """Probabilities float32 [batch, height, width] of known uint8 [batch, height, width]."""
        return finish_guess(self.net(known), known)


def predictor_to_onnx(net: MapPredictor) -> bytes:
    """The predictor for any batch and grid.

    Raises:
        UserError: the exporter is not installed.
    """
    batch, height, width = (torch.export.Dim(name, min=1, max=most) for name, most in MOST.items())
    sizes = {0: batch, 1: STRIDE * height, 2: STRIDE * width}
    example = torch.randint(0, 3, (2, 3 * STRIDE, 5 * STRIDE), dtype=torch.uint8)
    return trace_network(Guess(net).eval(), {"known": example}, "free", {"known": sizes})


def export_predictor(config: ExportConfig) -> None:
    """Write the folder.

    Raises:
        UserError: there is no training, or `out` holds something.
    """
    from safetensors.torch import save

    path, out = Path(config.run) / CHECKPOINT, Path(config.out)
    if not path.is_file():
        raise UserError(f"run={config.run} holds no {CHECKPOINT}: give the folder of a training.")
    if out.exists() and any(out.iterdir()):
        raise UserError(f"out={out} holds something already and is left alone: choose another name.")
    saved = torch.load(path, weights_only=True)
    net = MapPredictor(saved["config"]["width"])
    net.load_state_dict(saved["net"])
    files = {
        WEIGHTS: save({key: value.contiguous() for key, value in net.state_dict().items()}),
        NETWORK: predictor_to_onnx(net),
    }
    for name, content in files.items():
        write_file(out / name, lambda file, content=content: file.write(content))
    write_text(out / CARD, Path(config.card).read_text() if config.card else f"# {out.name}\n")
    shape = ["batch", "height", "width"]
    contract = {
        "format": FORMAT,
        "name": out.name,
        "width": net.width,
        "inputs": {"known": {"shape": shape, "type": "uint8", "is": "0 unknown, 1 free, 2 obstacle"}},
        "outputs": {"free": {"shape": shape, "type": "float32", "is": "probability that the cell is free"}},
        "by_distance": count_tables(load_groups(Path(config.train)))["distance"].round(4).tolist(),
        "trained": saved["config"] | {"steps_done": saved["step"]},
        "opset": OPSET,
        "versions": {package: metadata.version(package) for package in PACKAGES},
        "commit": find_commit(),
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }
    write_json(out / CONTRACT, contract)  # last: a folder without it is no predictor


if __name__ == "__main__":
    sys.exit(run(ExportConfig, export_predictor))
