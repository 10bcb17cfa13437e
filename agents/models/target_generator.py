"""The Multi-Agent Target Generator: Spatial-TeamFormer and the heads that choose a goal.

After the paper's section IV-D and the Spatial-TeamFormer of MAANS (Yu et al. 2022). One set of weights
serves a team of any size, and permuting the robots permutes the output.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from maexp.agents.config.model import ModelConfig
from maexp.agents.models.encoder import CellEncoder, add_state

MIN_SCALE = 0.05  # a narrower offset makes probability ratios explode, a wider one than 1 leaves the region
MAX_SCALE = 1.0


class SpatialAttention(nn.Module):
    """Self-attention over the cells of one robot (Individual Spatial Encoder): [batch, cells, width]."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.project = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, cells: Tensor) -> Tensor:
        query, key, value = self.project(cells).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(1, 2).flatten(-2))


class TeamAttention(nn.Module):
    """Attention across the robots at each cell, among those in contact (Team Relation Encoder).

    Teams are small, so the products are written out: a matrix product per cell would cost 5 times more.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, asking: Tensor, answering: Tensor, bias: Tensor) -> Tensor:
        """Mix `answering` into `asking`, both [batch, robots, cells, width].

        `bias` [batch, robots, robots] is 0 where a robot is heard and -inf elsewhere.
        """
        query = self.query(asking).unflatten(-1, (self.heads, -1))
        key, value = self.key_value(answering).unflatten(-1, (2, self.heads, -1)).unbind(-3)
        scores = (query.unsqueeze(2) * key.unsqueeze(1)).sum(-1, keepdim=True) / math.sqrt(query.shape[-1])
        weights = (scores + bias[..., None, None, None]).softmax(2)
        return self.out((weights * value.unsqueeze(1)).sum(2).flatten(-2))


class FeedForward(nn.Sequential):
    """Two layers applied to every cell by itself."""

    def __init__(self, width: int, multiple: int):
        super().__init__(nn.Linear(width, multiple * width), nn.ReLU(), nn.Linear(multiple * width, width))


class TeamFormerBlock(nn.Module):
    """Individual Spatial Encoder, then Team Relation Encoder, each followed by a feed-forward layer."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        width = config.width
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.spatial = SpatialAttention(width, config.heads)
        self.team = TeamAttention(width, config.heads)
        self.feedforward = FeedForward(width, config.feedforward)

    def forward(self, cells: Tensor, bias: Tensor) -> Tensor:
        cells = cells + self.spatial(self.norms[0](cells).flatten(0, 1)).unflatten(0, cells.shape[:2])
        normal = self.norms[1](cells)
        cells = cells + self.team(normal, normal, bias)
        return cells + self.feedforward(self.norms[2](cells))


class TargetGenerator(nn.Module):
    """Observations of a team to the parameters of every robot's action.

    A robot listens only to those it hears, but block by block these pass on what they heard themselves.

    Args:
        config: sizes
        channels: channels of the picture
        side: regions along one axis (L)
        regions: whether the action is a region and an offset, or else a control vector of 2
    """

    def __init__(self, config: ModelConfig, channels: int, side: int, regions: bool = True):
        super().__init__()
        self.regions = regions
        self.encoder = CellEncoder(config, channels, merge="heard" if config.merge_maps else None)
        self.blocks = nn.ModuleList(TeamFormerBlock(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.width)
        self.merge = TeamAttention(config.width, config.heads)
        self.per_region = regions and config.offsets == "per_region"
        self.cells = nn.Linear(config.width, 5 if self.per_region else 2)
        self.fine = None if self.per_region else nn.Linear(side * side, 4)
        self._start_uniform()

    def _start_uniform(self) -> None:
        """Start with nearly equal logits and a wide offset around each region's centre."""
        for layer, gain in ((self.cells, 0.1), (self.fine, 0.01)):
            if layer is None:
                continue
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)

    def forward(self, picture: Tensor, pose: Tensor, grid: Tensor, comm: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Parameters of the action for any leading batch shape [*, robots].

        Args:
            picture: uint8, shape [*, robots, channels, pixels, pixels]
            pose: shape [*, robots, 4]
            grid: shape [*, robots, 4, L, L]
            comm: who hears whom, bool [*, robots, robots]
            state: with `sees_time` the share of time left [*, robots, 1] and who is alive, bool [*, robots]

        Returns:
            logits [*, robots, L * L] (left out for a control action), mean and scale of the offset or control,
            [*, robots, 2], or [*, robots, L * L, 2] where each region has an offset of its own
        """
        lead, pose = comm.shape[:-2], add_state(pose, *state)
        picture, pose, grid, comm = (
            value.reshape(-1, *value.shape[len(lead) :]) for value in (picture, pose, grid, comm)
        )
        cells = own = self.encoder(picture, pose, grid, comm)
        bias = contact_bias(comm)
        for block in self.blocks:
            cells = block(cells, bias)
        cells = cells + self.merge(own, self.norm(cells), bias)
        cells = self.cells(cells)
        cells = cells.reshape(*lead, *cells.shape[1:])
        coarse, fine = cells[..., 0], cells[..., 1:]
        if not self.per_region:
            fine = self.fine(fine.squeeze(-1))
        mean, scale = fine.chunk(2, dim=-1)
        mean, scale = mean.tanh(), MIN_SCALE + (MAX_SCALE - MIN_SCALE) * scale.sigmoid()
        return (coarse, mean, scale) if self.regions else (mean, scale)


def contact_bias(comm: Tensor) -> Tensor:
    """0 where robot i hears robot j or is j, -inf elsewhere; shape [batch, robots, robots]."""
    own = torch.eye(comm.shape[-1], dtype=torch.bool, device=comm.device)
    return torch.zeros(comm.shape, dtype=torch.float32, device=comm.device).masked_fill(~(comm | own), -math.inf)
