"""A guess of what stands where nobody has looked: the probability that an unknown cell is free ground.

A small U-Net (Ronneberger et al. 2015) looks at what a team knows as a grid of cells, of which 10 to 17 make a radar
range in all scenarios. Every layer gives 0 where there is nothing but unknown ground around, so that the 0 beyond the
end of a grid is unknown ground, too.
"""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from maexp.agents.deploy.planner.bundle import WEIGHTS
from maexp.agents.models.precision import float32_modules
from maexp.kernels.constants import FREE, OBSTACLE

PATCH = 2  # cells along a side that the network looks at as one place
LEVELS = 4
STRIDE = PATCH * 2 ** (LEVELS - 1)  # grids are filled up with unknown ground to multiples of so many cells
PREDICTORS = Path(__file__).resolve().parents[1] / "predictors"
NETWORK, CONTRACT = "predictor.onnx", "predictor.json"


class Layer(nn.Module):
    """3 x 3 convolution and ReLU of what differs from unknown ground: 0 stays 0, whatever the bias."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        nn.init.kaiming_normal_(self.conv.weight)
        self.bias = nn.Parameter(0.1 * torch.randn(outputs, dtype=torch.float32))

    def forward(self, places: Tensor) -> Tensor:
        """[batch, inputs, h, w] -> [batch, outputs, h / stride, w / stride]."""
        bias = self.bias.view(1, -1, 1, 1)
        return F.relu(self.conv(places) + bias) - F.relu(bias)


class MapPredictor(nn.Module):
    """What is known of a grid to the logit of every cell's being free.

    Args:
        width: channels of the finest level; the next have two, four and four times as many.
    """

    def __init__(self, width: int = 24):
        super().__init__()
        self.width = width
        widths = [width, 2 * width, 4 * width, 4 * width]
        self.inputs = nn.Sequential(Layer(2 * PATCH**2, width), Layer(width, width))
        pairs = list(zip(widths, widths[1:], strict=False))
        self.down = nn.ModuleList(
            nn.Sequential(Layer(fine, coarse, 2), Layer(coarse, coarse)) for fine, coarse in pairs
        )
        self.lift = nn.ModuleList(nn.Conv2d(coarse, fine, 1, bias=False) for fine, coarse in pairs)
        self.up = nn.ModuleList(Layer(fine, fine) for fine, _ in pairs)
        self.head = nn.Conv2d(width, PATCH**2, 1)

    def forward(self, known: Tensor) -> Tensor:
        """Logits, float32 [B, H, W], of known uint8 [B, H, W]: 0 unknown, 1 free, 2 obstacle."""
        height, width = known.shape[-2:]
        seen = torch.stack((known == FREE, known == OBSTACLE), dim=1).float()
        seen = F.pad(seen, (0, -width % STRIDE, 0, -height % STRIDE))
        levels = [self.inputs(F.pixel_unshuffle(seen, PATCH).contiguous(memory_format=torch.channels_last))]
        for layers in self.down:
            levels.append(layers(levels[-1]))
        places = levels.pop()
        for lift, layer in zip(reversed(self.lift), reversed(self.up), strict=True):
            skipped = levels.pop()
            places = skipped + layer(skipped + F.interpolate(lift(places), scale_factor=2.0, mode="nearest"))
        logits = F.pixel_shuffle(self.head(places), PATCH)
        return logits[:, 0, :height, :width]


def finish_guess(logits: Tensor, known: Tensor) -> Tensor:
    """Probabilities, float32 [B, H, W]: 1 where free ground is known, 0 where an obstacle is."""
    chance = torch.sigmoid(logits)
    chance = torch.where(known == FREE, 1.0, chance)
    return torch.where(known == OBSTACLE, 0.0, chance)


@torch.no_grad()
def predict(known: Tensor, predictor: MapPredictor | str = "general") -> Tensor:
    """Probability that each cell is free, explorable ground.

    Args:
        known: uint8 [B, H, W], 0 unknown, 1 free, 2 obstacle (`Navigation.known`, cut to a map's width and height); any
            device. Unknown cells around, as many as one wants to know of, belong to it.
        predictor: the network, or the name of one that ships.

    Returns:
        float32 [B, H, W]; 1 for known free ground, 0 for known obstacles.

    Raises:
        ValueError: another shape or type, or an unknown name.
    """
    if known.dim() != 3 or known.dtype != torch.uint8:
        raise ValueError(f"known is {known.dtype} {list(known.shape)}: give uint8 [B, H, W]")
    net = load_predictor(predictor, str(known.device)) if isinstance(predictor, str) else predictor
    return finish_guess(net(known), known)


def sample_worlds(chance: Tensor, count: int, seed: int = 0, length: float = 3.0) -> Tensor:
    """Worlds that hang together: in each, a cell is free with its own probability, and neighbours go the same way.

    A Gaussian field, smoothed over `length` cells, decides which cells get what is less likely, so that there are rooms
    and walls instead of noise (a Gaussian copula).

    Args:
        chance: of `predict`, float32 [B, H, W].
        count: worlds of each grid, K.
        seed: of the fields, which are the same for all grids of a batch: a grid's worlds do not depend on the others.
        length: standard deviation of the smoothing [cells]; 0: every cell by itself.

    Returns:
        uint8 [B, K, H, W], 1 free, 2 obstacle.
    """
    draw = torch.Generator().manual_seed(seed)
    reach = math.ceil(3 * length)
    size = [side + 2 * reach for side in chance.shape[1:]]
    field = torch.randn((count, 1, *size), generator=draw, dtype=torch.float32)
    if reach:
        weight = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=torch.float32) / length) ** 2)
        weight = weight / weight.norm()  # keeps the variance 1
        field = F.conv2d(F.conv2d(field, weight.view(1, 1, 1, -1)), weight.view(1, 1, -1, 1))
    level = torch.special.ndtr(field[:, 0]).to(chance.device)  # uniform in [0, 1]
    return torch.where(level < chance.unsqueeze(1), FREE, OBSTACLE).to(torch.uint8)


@torch.no_grad()
def predict_by_distance(known: Tensor, predictor: str = "general") -> Tensor:
    """The same from nothing but the distance to known free ground, as it was on training maps.

    Cheap and calibrated over all unknown cells, but blind: what a predictor has to be better than.
    """
    table = torch.tensor(contract_of(predictor)["by_distance"], dtype=torch.float32, device=known.device)
    chance = table[distance_to_free(known, len(table) - 1).long()]
    chance = torch.where(known == FREE, 1.0, chance)
    return torch.where(known == OBSTACLE, 0.0, chance)


def distance_to_free(known: Tensor, most: int) -> Tensor:
    """Euclidean distance to known free ground [cells], float32 [B, H, W], no more than `most`."""
    away = torch.where(known == FREE, 0.0, float(most) ** 2)
    for axis in (-1, -2):  # of all lines across, the least of what they hold and the square of how far they are
        padded = F.pad(away, (most, most) if axis == -1 else (0, 0, most, most), value=float(most) ** 2)
        size = away.shape[axis]
        away = torch.stack([padded.narrow(axis, most + d, size) + d * d for d in range(-most, most + 1)]).amin(0)
    return away.sqrt().clamp_max(most)


def predictor_names() -> list[str]:
    """Predictors that ship."""
    return sorted(path.parent.name for path in PREDICTORS.glob(f"*/{CONTRACT}"))


def find_predictor(name: str | Path) -> Path:
    """The folder of a predictor that ships, by its name, or one's own.

    Raises:
        ValueError: there is none.
    """
    folder = PREDICTORS / name if name in predictor_names() else Path(name)
    if not (folder / CONTRACT).is_file():
        raise ValueError(
            f"predictor={name} is unknown: choose one of {', '.join(predictor_names())}, or the folder of one"
        )
    return folder


def contract_of(name: str | Path) -> dict:
    """What a predictor's folder says of it."""
    return json.loads((find_predictor(name) / CONTRACT).read_text())


@cache
@float32_modules()
def load_predictor(name: str | Path = "general", device: str = "cpu") -> MapPredictor:
    """A predictor that ships, by its name, or one in a folder of one's own.

    Raises:
        ValueError: there is none.
    """
    from safetensors.torch import load_file

    net = MapPredictor(contract_of(name)["width"])
    net.load_state_dict(load_file(find_predictor(name) / WEIGHTS))
    return net.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)
