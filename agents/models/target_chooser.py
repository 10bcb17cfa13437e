"""Choice among frontier targets: networks over the candidates of every robot (`maexp.envs.targets.observation`).

Candidates of one robot attend to each other, then robots in contact to each other, so that one set of weights serves
any number of candidates and any team. What a classical planner thinks of a candidate goes straight into its logit: an
untrained policy makes that planner's choices, and learns where to differ (`model.starts_from`).
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from maexp.agents.config.model import ModelConfig
from maexp.agents.models.target_generator import contact_bias
from maexp.envs.targets.features import FEATURES, feature_names
from maexp.envs.targets.heuristics import APART, BEYOND, WAY
from maexp.envs.targets.observation import first_if_none

SCORE = FEATURES.index("score")
GAIN, CLAIMED, TRAVEL = (FEATURES.index(name) for name in ("gain", "claimed", "travel"))
TELLS = feature_names(radio=True).index("tells")
UNKNOWN_FAR, PLAN_GAP = (FEATURES.index(name) for name in ("unknown_far", "plan_gap"))
NEARNESS = FEATURES.index("nearness")  # above 0 for every target
OUTPUT_GAIN = 10.0  # of the logits: with 1, Adam's small steps would take too long to overrule a score
NEVER = -1e9  # logit or preference of what cannot be chosen, where numbers must be finite
PART = 96  # teams that are learned from together
COUNT = 10.0  # candidates that sums are measured in


def score_by_utility(features: Tensor) -> Tensor:
    """What `cost_utility` thinks of targets [radar discs], [*, M] of [*, M, F]."""
    return features[..., SCORE]


def score_by_criteria(features: Tensor) -> Tensor:
    """What `multi_criteria` would think of them, were the others to choose as `cost_utility` does."""
    gain, apart = features[..., GAIN] * (1.0 - features[..., CLAIMED]), features[..., PLAN_GAP]
    if features.shape[-1] > TELLS:  # nobody keeps away from who goes to tell the base station
        apart = apart * (1.0 - features[..., TELLS])
    return gain - WAY * features[..., TRAVEL] + BEYOND * features[..., UNKNOWN_FAR] + APART * apart


STARTS = {"cost_utility": score_by_utility, "multi_criteria": score_by_criteria}
"""Classical planner -> what it thinks of targets by their features: values of `model.starts_from`."""


class Attention(nn.Module):
    """Residual self-attention over a set: [batch, members, width], with `bias` added to the scores."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.project = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, members: Tensor, bias: Tensor) -> Tensor:
        """`bias` [batch, members or 1, members] is 0 where a member is looked at and -inf elsewhere."""
        parts = self.project(self.norm(members)).chunk(3 * self.heads, dim=-1)
        return members + self.out(attend(parts, bias))


def attend(parts: Sequence[Tensor], bias: Tensor) -> Tensor:
    """Attention over small sets: plain products, which take half the time of torch's fused kernel with its gradient.

    Args:
        parts: queries, then keys, then values of every head, [batch, members, width / heads] each
        bias: added to the scores, [batch, members or 1, members]

    Returns:
        shape [batch, members, width]
    """
    heads = len(parts) // 3
    scale, bias = parts[0].shape[-1] ** -0.5, bias.to(parts[0].dtype).expand(-1, parts[0].shape[1], -1)
    mixed = []
    for query, key, value in zip(parts[:heads], parts[heads : 2 * heads], parts[2 * heads :], strict=True):
        mixed.append(torch.baddbmm(bias, query, key.mT, alpha=scale).softmax(-1) @ value)
    return torch.cat(mixed, dim=-1)


class TargetEncoder(nn.Module):
    """Every candidate as a vector that knows of the robot's other candidates and of the robots in contact; `radio`: of
    features that tell of radios too."""

    def __init__(self, config: ModelConfig, radio: bool = False):
        super().__init__()
        width, heads, count = config.target_width, config.target_heads, len(feature_names(radio))
        self.inputs = nn.Sequential(nn.Linear(count, width), nn.ReLU(), nn.Linear(width, width))
        self.among_targets = Attention(width, heads)
        self.among_robots = Attention(width, heads)
        self.merge = nn.Sequential(nn.LayerNorm(2 * width), nn.Linear(2 * width, width), nn.ReLU())

    def forward(self, features: Tensor, some: Tensor, comm: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors of the candidates [batch, robots, M, width] and of the robots [batch, robots, width].

        Args:
            features: shape [batch, robots, M, F]
            some: which candidates there are, bool [batch, robots, M]; the first where there is none
            comm: who hears whom, bool [batch, robots, robots]
        """
        team, flat = features.shape[:2], some.flatten(0, 1)
        hidden = torch.zeros(flat.shape, dtype=torch.float32, device=flat.device)
        hidden = hidden.masked_fill(~flat, -torch.inf).unsqueeze(1)
        targets = self.among_targets(self.inputs(features).flatten(0, 1), hidden)
        weight = flat.unsqueeze(-1).to(targets.dtype)
        mean = ((targets * weight).sum(1) / weight.sum(1)).unflatten(0, team)
        robots = self.among_robots(mean, contact_bias(comm))
        targets = targets.unflatten(0, team)
        return self.merge(torch.cat((targets, robots.unsqueeze(2).expand_as(targets)), dim=-1)), robots


class TargetChooser(nn.Module):
    """Observations of a team to the logits of every robot's candidates, for any leading shape [*, robots].

    Args:
        config: sizes.
        radio: it looks at what targets tell of radios, and may choose the last one, to go and tell the base station;
            otherwise it does neither, where both are shown (``observation.radio``).
    """

    def __init__(self, config: ModelConfig, radio: bool = False):
        super().__init__()
        self.radio = radio
        self.starts_from, self.score_weight = config.starts_from, config.score_weight
        self.shares = config.critic_encoder == "shared"
        self.encoder = TargetEncoder(config, radio)
        self.head = nn.Linear(config.target_width, 1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, features: Tensor, mask: Tensor, comm: Tensor) -> tuple[Tensor]:
        """Logits [*, robots, M] of (features [*, robots, M, F], mask [*, robots, M], comm [*, robots, robots])."""
        lead = comm.shape[:-2]
        logits, _ = self._look(*flatten(features, mask, comm))
        return (logits.reshape(*lead, *logits.shape[1:]),)

    def look(self, features: Tensor, mask: Tensor, comm: Tensor) -> tuple[Tensor, Tensor]:
        """The logits, and every robot as one vector, for critics that share the encoder: [*, robots, 2 * width]."""
        lead, places = comm.shape[:-2], mask.shape[-1]
        parts, back = split_teams(*flatten(features, mask, comm))
        looks = [self._look(*part) for part in parts]
        logits = torch.cat([F.pad(scores, (0, places - scores.shape[-1]), value=NEVER) for scores, _ in looks])[back]
        seen = torch.cat([robots for _, robots in looks])[back]
        return logits.reshape(*lead, *logits.shape[1:]), seen.reshape(*lead, *seen.shape[1:])

    def _look(self, features: Tensor, mask: Tensor, comm: Tensor) -> tuple[Tensor, Tensor]:
        """Logits and robots of teams [batch]."""
        if not self.radio and features.shape[-1] > len(FEATURES):
            logits, seen = self._look(features[:, :, :-1, : len(FEATURES)], mask[..., :-1], comm)
            return F.pad(logits, (0, 1), value=NEVER), seen
        some = first_if_none(mask)
        targets, robots = self.encoder(features, some, comm)
        planned = self.score_weight * STARTS[self.starts_from](features)
        logits = planned + OUTPUT_GAIN * self.head(targets).squeeze(-1)
        seen = torch.cat((add_up(targets, real_ones(features, mask)), robots), dim=-1) if self.shares else robots
        return logits.masked_fill(~some, NEVER), seen


class TargetReader(nn.Module):
    """Each robot's candidates as one vector, for critics: [batch, robots, critic_hidden].

    Args:
        config: sizes
        team: look at the candidates of all robots, whoever hears whom, and at the coverage
        radio: they tell of radios too

    Attributes:
        first_rank: dimensions of its first input from the robots on
    """

    first_rank = 3

    def __init__(self, config: ModelConfig, team: bool, radio: bool = False):
        super().__init__()
        self.team = team
        self.encoder = TargetEncoder(config, radio)
        extra = 2 + team
        self.wide = nn.Sequential(nn.Linear(2 * config.target_width + extra, config.critic_hidden), nn.ReLU())

    def forward(self, features: Tensor, mask: Tensor, comm: Tensor, *state: Tensor) -> Tensor:
        """`state`: time_left [batch, robots, 1], alive [batch, robots], and for `team` coverage [batch, 1]."""
        parts, back = split_teams(features, mask, comm | self.team)
        seen = torch.cat([self._look(*part) for part in parts])[back]
        return self.wide(with_state(seen, *state))

    def _look(self, features: Tensor, mask: Tensor, comm: Tensor) -> Tensor:
        """Candidates and robots of teams [batch] as one vector a robot."""
        targets, robots = self.encoder(features, first_if_none(mask), comm)
        return torch.cat((add_up(targets, real_ones(features, mask)), robots), dim=-1)


class SeenReader(nn.Module):
    """Each robot's vector as the policy's encoder made it, with the state: [batch, robots, critic_hidden]."""

    first_rank = 2

    def __init__(self, config: ModelConfig, team: bool):
        super().__init__()
        self.wide = nn.Sequential(nn.Linear(2 * config.target_width + 2 + team, config.critic_hidden), nn.ReLU())

    def forward(self, seen: Tensor, time_left: Tensor, alive: Tensor, *coverage: Tensor) -> Tensor:
        return self.wide(with_state(seen, time_left, alive, *coverage))


def with_state(seen: Tensor, time_left: Tensor, alive: Tensor, *coverage: Tensor) -> Tensor:
    """`seen` [batch, robots, width], followed by what critics are told besides."""
    parts = [seen, time_left, alive.unsqueeze(-1).to(seen.dtype)]
    parts += [share.unsqueeze(1).expand(-1, seen.shape[1], -1) for share in coverage]
    return torch.cat(parts, dim=-1)


def flatten(features: Tensor, mask: Tensor, comm: Tensor) -> list[Tensor]:
    """What a team sees, with one leading dimension."""
    lead = comm.ndim - 2
    return [part.reshape(-1, *part.shape[lead:]) for part in (features, mask, comm)]


def split_teams(features: Tensor, mask: Tensor, comm: Tensor) -> tuple[list[list[Tensor]], Tensor | slice]:
    """Teams [batch] that are learned from in parts that fit a core's cache: those with few candidates together, cut to
    what these have.

    Returns:
        the parts, and the index that puts what was made of them, one after another, back in order
    """
    if len(comm) <= PART or comm.is_cuda or not torch.is_grad_enabled():
        return [[features, mask, comm]], slice(None)
    counts, order = (mask.any(1) * torch.arange(1, mask.shape[-1] + 1)).amax(-1).clamp_min(1).sort()
    most = [*counts[PART - 1 :: PART].tolist(), int(counts[-1])]
    parts = [
        [features[rows, :, :count], mask[rows, :, :count], comm[rows]]
        for rows, count in zip(order.split(PART), most, strict=False)
    ]
    return parts, order.argsort()


def add_up(targets: Tensor, mask: Tensor) -> Tensor:
    """The sum of each robot's candidates."""
    return (mask.unsqueeze(-2).to(targets.dtype) @ targets).squeeze(-2) / COUNT


def real_ones(features: Tensor, mask: Tensor) -> Tensor:
    """`mask` [*, M] without the first entry where it stands for driving anywhere: no features [*, M, F] tell of it."""
    return mask & (features[..., NEARNESS] > 0)
