"""Critics: what a robot observes when its state is valued, and mixers of the robots' values into a team value."""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn import functional as F

from maexp.agents.config.model import ModelConfig, model_config
from maexp.agents.models.actor import (
    ALIVE,
    COMM,
    COVERAGE,
    SEEN,
    TARGETS,
    TARGETS_MASK,
    TIME_LEFT,
    observation_keys,
    observation_shape,
)
from maexp.agents.models.encoder import CellEncoder, add_state
from maexp.agents.models.precision import float32_modules
from maexp.agents.models.target_chooser import SeenReader, TargetReader


class VDNMixer(nn.Module):
    """V_tot = sum of V_i."""

    def __init__(self, features: int, hidden: int = 32):
        super().__init__()

    def forward(self, values: Tensor, features: Tensor) -> Tensor:
        """Args: values [*, robots, 1]; features [*, robots, features] (unused). Returns [*, 1]."""
        return values.sum(-2)


class QMIXMixer(nn.Module):
    """V_tot = w2 . elu(sum_i w1_i V_i + b1) + b2 with positive weights made from what the team sees.

    QMIX draws w1 from one layer of fixed width N. Here each robot's share of w1 comes from a hypernetwork of
    its own features and the team's mean, summed over robots, which leaves the team's size free.

    Args:
        features: features per robot
        hidden: width of the mixing layer
    """

    def __init__(self, features: int, hidden: int = 32):
        super().__init__()
        self.robot_weights = nn.Linear(2 * features, hidden)
        self.hidden_bias = nn.Linear(features, hidden)
        self.team_weights = nn.Linear(features, hidden)
        self.team_bias = nn.Sequential(nn.Linear(features, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        self._start_as_sum(hidden)

    def _start_as_sum(self, hidden: int) -> None:
        """Start near V_tot = sum of V_i: each path weighs 1 / hidden, so the scale is right at once."""
        with torch.no_grad():
            for layer, size in ((self.robot_weights, hidden**-0.5), (self.team_weights, hidden**-0.5)):
                layer.weight.mul_(0.1)
                layer.bias.fill_(size)
            self.hidden_bias.weight.mul_(0.1)
            self.hidden_bias.bias.fill_(1.0)  # on the straight side of elu
            self.team_bias[-1].weight.mul_(0.1)
            self.team_bias[-1].bias.fill_(-(hidden**0.5))

    def forward(self, values: Tensor, features: Tensor) -> Tensor:
        """Args: values [*, robots, 1]; features [*, robots, features]. Returns [*, 1]."""
        team = features.mean(-2)
        around = torch.cat((features, team.unsqueeze(-2).expand_as(features)), dim=-1)
        hidden = (self.robot_weights(around).abs() * values).sum(-2) + self.hidden_bias(team)
        mixed = (self.team_weights(team).abs() * F.elu(hidden)).sum(-1, keepdim=True)
        return mixed + self.team_bias(team)


MIXERS = {"vdn": VDNMixer, "qmix": QMIXMixer}


def make_mixer(name: str, features: int) -> nn.Module:
    """The mixer of that name for robots with that many features.

    Raises:
        ValueError: unknown name.
    """
    if name not in MIXERS:
        raise ValueError(f"algorithm.mixer={name!r} is unknown; choose one of {', '.join(MIXERS)}.")
    return MIXERS[name](features)


VALUE = ("agents", "state_value")
TEAM_VALUE = ("team", "state_value")
KINDS = ("local", "team", "mixed")


class RobotEncoder(nn.Module):
    """Each robot's observation as one vector.

    Args:
        config: sizes; the encoder of the cells is the policy's, without weights in common
        channels: channels of the picture
        side: regions along one axis
        team: look at all robots' pictures (merged) instead of the own one alone

    Attributes:
        first_rank: dimensions of its first input from the robots on
    """

    first_rank = 4

    def __init__(self, config: ModelConfig, channels: int, side: int, team: bool):
        super().__init__()
        self.cells = CellEncoder(config, channels, merge="all" if team else None)
        self.side = side
        self.narrow = nn.Sequential(
            nn.Conv2d(config.width, config.width, 3, stride=2, padding=1), nn.ReLU(), nn.Flatten()
        )
        self.wide = nn.Sequential(nn.Linear(config.width * ((side + 1) // 2) ** 2, config.critic_hidden), nn.ReLU())

    def forward(self, picture: Tensor, pose: Tensor, grid: Tensor, comm: Tensor, *state: Tensor) -> Tensor:
        """Batch of teams [batch, robots, ...] to [batch, robots, critic_hidden]; `state` as in `add_state`."""
        pose = add_state(pose, *state)
        cells = self.cells(picture, pose, grid, comm).transpose(-1, -2).unflatten(-1, (self.side, self.side))
        return self.wide(self.narrow(cells.flatten(0, 1))).unflatten(0, comm.shape[:2])


class Critic(nn.Module):
    """Values of every robot's state, shape [*, robots, 1], and for `mixed` also the team's, shape [*, 1].

    Args:
        config: sizes
        encoder: observations of a team [batch, robots, ...] to [batch, robots, critic_hidden]
        kind: local, team or mixed
        mixer: vdn or qmix, for mixed
    """

    def __init__(self, config: ModelConfig, encoder: nn.Module, kind: str, mixer: str = "qmix"):
        super().__init__()
        self.team = kind == "team"
        self.encoder = encoder
        hidden = config.critic_hidden
        inputs = 3 * hidden if self.team else hidden
        self.value = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        nn.init.orthogonal_(self.value[-1].weight, 0.1)
        nn.init.zeros_(self.value[-1].bias)
        self.mixer = make_mixer(mixer, hidden) if kind == "mixed" else None
        self.register_buffer("offset", torch.zeros((), dtype=torch.float32))
        self.register_buffer("scale", torch.ones((), dtype=torch.float32))
        self.register_buffer("calibrated", torch.zeros((), dtype=torch.bool))

    def forward(self, *observation: Tensor):
        """What the encoder reads, with any leading shape [*, robots, ...]."""
        lead = observation[0].shape[: -self.encoder.first_rank]
        parts = (value.reshape(-1, *value.shape[len(lead) :]) for value in observation)
        features = robots = self.encoder(*parts)
        if self.team:
            around = torch.cat((robots.mean(1, keepdim=True), robots.amax(1, keepdim=True)), dim=-1)
            features = torch.cat((robots, around.expand(-1, robots.shape[1], -1)), dim=-1)
        values = self.value(features)
        if self.mixer is None:
            return self._to_returns(values).reshape(*lead, *values.shape[1:])
        team = self._to_returns(self.mixer(values, robots))
        return values.reshape(*lead, *values.shape[1:]), team.reshape(*lead, 1)

    def _to_returns(self, values: Tensor) -> Tensor:
        return self.offset + self.scale * values

    @torch.no_grad()
    def calibrate(self, returns: Tensor) -> None:
        """Give the outputs the mean and spread of the first returns seen, so that learning starts there."""
        self.offset.copy_(returns.mean())
        self.scale.copy_(returns.std().clamp_min(1e-3))
        self.calibrated.fill_(True)


@float32_modules()
def build_critic(kind: str, env, model: "str | ModelConfig" = "small", mixer: str = "qmix") -> TensorDictModule:
    """A critic of the given kind for the specs of `env`.

    It writes ("agents", "state_value") [*, robots, 1] and, for mixed, ("team", "state_value") [*, 1].

    Args:
        kind: local, team or mixed
        env: gives the specs and the device; not kept
        model: a name (small, paper) or a ModelConfig
        mixer: vdn or qmix
    """
    if kind not in KINDS:
        raise ValueError(f"critic kind {kind!r} is unknown; choose one of {', '.join(KINDS)}.")
    config, team = model_config(model), kind == "team"
    shape = observation_shape(env, config)
    if config.action == "targets":
        if config.critic_encoder == "shared":
            encoder, inputs = SeenReader(config, team), [SEEN]
        else:
            encoder, inputs = TargetReader(config, team, shape.radio), [TARGETS, TARGETS_MASK, COMM]
        inputs += [TIME_LEFT, ALIVE] + [COVERAGE] * team
    else:
        encoder, inputs = RobotEncoder(config, shape.channels, shape.side, team), observation_keys(config)
    network = Critic(config, encoder, kind, mixer)
    keys = [VALUE, TEAM_VALUE] if kind == "mixed" else [VALUE]
    critic = TensorDictModule(network, in_keys=inputs, out_keys=keys)
    return critic.to(env.device) if env.device is not None else critic
