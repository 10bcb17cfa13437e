"""Value mixers: the team's value from the robots' values, for a team of any size.

Both are monotone in every robot's value (so what is good for a robot is good for the team) and do not
depend on the order of the robots. VDN: Sunehag et al. 2018; QMIX: Rashid et al. 2018.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F


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
