"""Critics: what a robot may look at when its state is valued, and how a team's value is put together.

local: own observation only. team: the observations of all robots, whoever hears whom (training is centralised).
With `model.critic_encoder=shared`, what the policy's encoder made of them. mixed: local values, mixed to one value of
the team.
"""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from maexp.agents.networks.actor import (
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
from maexp.agents.networks.encoder import CellEncoder, add_state
from maexp.agents.networks.mixers import make_mixer
from maexp.agents.networks.target_chooser import SeenReader, TargetReader
from maexp.agents.settings.model import ModelConfig, model_config

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
        self.register_buffer("offset", torch.zeros(()))
        self.register_buffer("scale", torch.ones(()))
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
