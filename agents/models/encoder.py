"""From one robot's observation to features of the L x L regions: picture, CNN, grid features."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from maexp.agents.config.model import ModelConfig

STRIDE = 4  # both stems shrink the picture by this factor
SUBCELLS = 4  # cells a side that the CNN sees of one region
MERGED = 2  # channels of a picture that may be merged with those of other robots: the explored and the walls


def add_rows(picture: Tensor) -> Tensor:
    """Average every four rows of a uint8 picture, values 0 to 1.

    Rows are added as int16: converting 62,500 pixels to float first would cost more than the whole network.

    Args:
        picture: uint8, shape [*, rows, columns]

    Returns:
        float32, shape [*, ceil(rows / 4), columns]; rows beyond the edge count as 0
    """
    total = picture[..., 0::STRIDE, :].to(torch.int16)
    for start in range(1, STRIDE):
        rows = picture[..., start::STRIDE, :]
        total[..., : rows.shape[-2], :] += rows
    return total.float() / (255 * STRIDE)


def region_centres(pose: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Where the regions' centres lie in the picture, in [-1, 1] along each axis.

    The observation gives the robot's position in half sides of the picture and each region's offset from
    the robot in sides (`kernels/observe.py`).

    Args:
        pose: shape [batch, 4]
        grid: shape [batch, 4, L, L]

    Returns:
        centres along x and along y, each of shape [batch, L]
    """
    return pose[:, 0, None] + 2 * grid[:, 0, :, 0], pose[:, 1, None] + 2 * grid[:, 1, 0, :]


def resampling(centres: Tensor, first: float, step: float, cells: int) -> Tensor:
    """Weights that resample a line of cells to SUBCELLS cells per region.

    Args:
        centres: the regions' centres, shape [batch, L]
        first: where the first cell lies in [-1, 1]
        step: distance between cells
        cells: how many there are

    Returns:
        shape [batch, cells, L * SUBCELLS]; triangular kernels, each column sums to 1
    """
    count = centres.shape[-1]
    pitch = (centres[:, -1:] - centres[:, :1]) / max(count - 1, 1) / SUBCELLS
    steps = torch.arange(count * SUBCELLS, dtype=torch.float32, device=centres.device) - (count * SUBCELLS - 1) / 2
    targets = (centres[:, :1] + centres[:, -1:]) / 2 + steps * pitch
    source = torch.arange(cells, dtype=torch.float32, device=centres.device) * step + first
    reach = pitch.abs().clamp_min(step).unsqueeze(1)
    weights = (1 - (targets.unsqueeze(1) - source.unsqueeze(-1)).abs() / reach).clamp_min(0)
    return weights / weights.sum(1, keepdim=True).clamp_min(1e-6)


def resample(cells: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Resample [batch, channels, x, y] with the weights of each batch element.

    Returns:
        shape [batch, channels, y, x]: transposed, so that neither product needs a copy of the weights
    """
    by_column = torch.bmm(cells.flatten(1, 2), columns).unflatten(1, cells.shape[1:3]).transpose(-1, -2)
    return torch.bmm(by_column.flatten(1, 2), rows).unflatten(1, (cells.shape[1], -1))


def add_state(pose: Tensor, time_left: Tensor | None = None, alive: Tensor | None = None) -> Tensor:
    """The robots' poses [*, robots, 4], followed by what else is known of each: [*, robots, 4 or 6].

    Args:
        pose: as observed
        time_left: share of the episode left, shape [*, robots, 1]
        alive: has not collided, bool [*, robots]
    """
    if time_left is None:
        return pose
    return torch.cat((pose, time_left, alive.unsqueeze(-1).to(pose.dtype)), dim=-1)


def grid_inputs(pose: Tensor, grid: Tensor, along_x: Tensor, along_y: Tensor) -> Tensor:
    """What each region is told about its robot: offsets and distances to it and to its last goal, where the
    region lies, the pose with its heading as sine and cosine, and what follows the pose (`add_state`).

    Returns:
        shape [batch, L * L, 13, and 2 more with time and life]
    """
    side = grid.shape[-1]
    distances = [grid[:, start : start + 2].square().sum(1, keepdim=True).sqrt() for start in (0, 2)]
    place = torch.stack((along_x[:, :, None].expand(-1, -1, side), along_y[:, None, :].expand(-1, side, -1)), dim=1)
    cells = torch.cat((grid, *distances, place), dim=1).flatten(2).transpose(1, 2)
    heading = pose[:, 3:4] * torch.pi
    pose = torch.cat((pose[:, :3], heading.sin(), heading.cos(), pose[:, 4:]), dim=-1)
    return torch.cat((cells, pose.unsqueeze(1).expand(-1, side * side, -1)), dim=-1)


class CellEncoder(nn.Module):
    """Features of every region as one robot sees it: CNN features and grid features side by side.

    The picture is resampled so that region (ix, iy) is exactly cell (ix, iy), whatever the map's shape.

    Args:
        config: sizes
        channels: channels of the picture
        merge: add what others and the robot have explored together (channels 0 and 1 of pictures): those "heard",
            or "all"; None adds nothing
    """

    def __init__(self, config: ModelConfig, channels: int, merge: str | None):
        super().__init__()
        self.channels, self.merge = channels, merge
        width = config.channels
        self.stem = None
        if config.stem == "conv":
            self.stem = nn.Sequential(
                nn.Conv2d(channels, width // 2, 3, stride=2, padding=1),
                nn.ReLU(),
                nn.Conv2d(width // 2, width, 3, stride=2, padding=1),
                nn.ReLU(),
            )
        inputs = (channels if self.stem is None else width) + (MERGED if merge else 0)
        self.cnn = nn.Sequential(  # kernels of 4: with 3, a region would see its neighbours on one side only
            nn.Conv2d(inputs, width, 4, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, width, 4, stride=2, padding=1),
            nn.ReLU(),
        )
        self.grid = nn.Sequential(nn.Linear(13 + 2 * config.sees_time, config.grid_features), nn.ReLU())

    def forward(self, picture: Tensor, pose: Tensor, grid: Tensor, comm: Tensor) -> Tensor:
        """Encode each robot's observation once.

        Args:
            picture: uint8, shape [batch, robots, channels, pixels, pixels]; or what `compact` makes of it
            pose: what `add_state` gives, shape [batch, robots, 4 or 6]
            grid: shape [batch, robots, 4, L, L]
            comm: who hears whom, bool [batch, robots, robots]

        Returns:
            shape [batch, robots, L * L, features]
        """
        team, side = comm.shape[:2], grid.shape[-1]
        picture, pose, grid = picture.flatten(0, 1), pose.flatten(0, 1), grid.flatten(0, 1)
        along_x, along_y = region_centres(pose, grid)
        if picture.is_floating_point():
            features = self._look_at_compact(picture)
        else:
            features = self.cnn(self._look_at(picture, along_x, along_y, comm))
        told = self.grid(grid_inputs(pose, grid, along_x, along_y)).unflatten(1, (side, side))
        return torch.cat((features.permute(0, 3, 2, 1), told), dim=-1).flatten(1, 2).unflatten(0, team)

    def _look_at(self, picture: Tensor, along_x: Tensor, along_y: Tensor, comm: Tensor) -> Tensor:
        """What the CNN is given of pictures: shape [batch * robots, inputs, y, x]."""
        if self.stem is None:
            cells = pooled = pool_regions(picture, along_x, along_y)
        else:
            cells = self._convolve(picture, along_x, along_y)
            pooled = pool_regions(picture[:, :MERGED], along_x, along_y) if self.merge else None
        if self.merge is None:
            return cells
        heard = comm if self.merge == "heard" else torch.ones_like(comm)
        merged = merged_maps(pooled[:, :MERGED].unflatten(0, comm.shape[:2]), heard)
        return torch.cat((cells, merged.flatten(0, 1)), dim=1)

    def _look_at_compact(self, cells: Tensor) -> Tensor:
        """The CNN's features of what `compact` made: weights of 0 for what it does not read cost less than a copy."""
        first, *rest = self.cnn
        own, merged = first.weight.split((self.channels, first.in_channels - self.channels), dim=1)
        nothing = own.new_zeros(own.shape[0], MERGED, *own.shape[2:])
        heard, everyone = (merged if self.merge == kind else nothing for kind in ("heard", "all"))
        weight = torch.cat((own, heard, everyone), dim=1)
        features = F.conv2d(cells.permute(0, 3, 1, 2), weight, first.bias, first.stride, first.padding)
        for layer in rest:
            features = layer(features)
        return features

    def _convolve(self, picture: Tensor, along_x: Tensor, along_y: Tensor) -> Tensor:
        """The learned stem, resampled to the regions; strided convolutions sit on every 4th pixel."""
        cells = self.stem(picture.float() / 255)
        rows, columns = picture.shape[-2:]
        by_row = resampling(along_x, 1 / rows - 1, 2 * STRIDE / rows, cells.shape[-2])
        by_column = resampling(along_y, 1 / columns - 1, 2 * STRIDE / columns, cells.shape[-1])
        return resample(cells, by_row, by_column)


def pool_regions(picture: Tensor, along_x: Tensor, along_y: Tensor) -> Tensor:
    """Average a uint8 picture [batch, channels, x, y] to SUBCELLS^2 cells per region, transposed."""
    rows, columns = picture.shape[-2:]
    lines = add_rows(picture)
    by_row = resampling(along_x, STRIDE / rows - 1, 2 * STRIDE / rows, lines.shape[-2])
    return resample(lines, by_row, resampling(along_y, 1 / columns - 1, 2 / columns, columns))


def compact(picture: Tensor, pose: Tensor, grid: Tensor, comm: Tensor) -> Tensor:
    """Pictures pooled, and merged, once for all who look at them: half their size.

    Encoders with the "pool" stem take them in place of the pictures. Channels come last: convolutions of few channels
    are a quarter faster so.

    Args:
        picture: uint8, shape [*, robots, channels, pixels, pixels]
        pose: shape [*, robots, 4]
        grid: shape [*, robots, 4, L, L]
        comm: who hears whom, bool [*, robots, robots]

    Returns:
        float32, shape [*, robots, y, x, channels + 4]: each robot's picture, then MERGED channels with those of the
        robots it hears, then as many with those of all
    """
    lead = comm.shape[:-1]
    picture, pose, grid = (value.reshape(-1, *value.shape[len(lead) :]) for value in (picture, pose, grid))
    pooled = pool_regions(picture, *region_centres(pose, grid)).unflatten(0, (-1, lead[-1]))
    comm, maps = comm.reshape(-1, *comm.shape[-2:]), pooled[:, :, :MERGED]
    everyone = maps.amax(1, keepdim=True).expand_as(maps)
    heard = everyone if bool(comm.all()) else merged_maps(maps, comm)
    parts = (pooled, heard, everyone)
    cells = torch.cat(parts, dim=2).permute(0, 1, 3, 4, 2).contiguous()
    return cells.reshape(*lead, *cells.shape[2:])


def merged_maps(maps: Tensor, comm: Tensor) -> Tensor:
    """What the robots that robot i hears have seen together, shapes [batch, robots, channels, y, x]."""
    heard = comm | torch.eye(comm.shape[-1], dtype=torch.bool, device=comm.device)
    return torch.where(heard[..., None, None, None], maps.unsqueeze(1), 0.0).amax(2)


def pools_pictures(network: nn.Module) -> bool:
    """Whether all that a network sees of a picture is its pooled cells."""
    encoders = [module for module in network.modules() if isinstance(module, CellEncoder)]
    return bool(encoders) and all(encoder.stem is None for encoder in encoders)
