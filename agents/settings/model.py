"""Sizes of the networks: the dataclass, and those that have a name."""

from dataclasses import dataclass

from maexp.agents.settings.ranges import check_ranges, choice, flag, number, whole


@dataclass(frozen=True)
class ModelConfig:
    """What a policy chooses, and the sizes that it shares with the critics.

    Attributes:
        action: what a robot chooses: a region of the map and an offset, or one of its frontier "targets" (the env shows
            them with observation.targets). Those of `target_...` and `score_weight` belong to the latter, the
            other sizes but `critic_hidden` to regions.
        target_width: features per target.
        target_heads: attention heads; must divide `target_width`.
        score_weight: of the classical planner's value of a target in its logit, where one radar disc is 1.
        stem: how the picture becomes small. "pool" averages blocks of 4 x 4 pixels (no weights, fast on a
            CPU); "conv" learns two strided convolutions on the full picture, as in the paper.
        channels: feature maps of the convolutions.
        grid_features: features made from the pose and the previous goal, per cell.
        depth: Spatial-TeamFormer blocks.
        heads: attention heads; must divide `channels + grid_features`.
        feedforward: width of the feed-forward layers as a multiple of the cell's features.
        merge_maps: show each cell what the robots in contact have explored together, as two more input
            channels. The attention can find that out by itself, only later.
        offsets: "per_region" gives each region an offset of its own; with one "shared" by all regions, as in the
            paper, a policy cannot even copy a planner.
        sees_time: show each cell the share of the episode that is left, and whether its robot has collided.
        critic_hidden: width of the critic's hidden layers.
        critic_encoder: "own": critics of targets have an encoder of their own, as beside trust regions and for regions
            anyway. "shared": they read what the policy's encoder made of them, and what they learn trains it too.
    """

    action: str = choice("regions", "targets")
    target_width: int = whole(48, most=4096)
    target_heads: int = whole(2, most=64)
    score_weight: float = number(50.0)
    stem: str = choice("pool", "conv")
    channels: int = whole(16, most=4096)
    grid_features: int = whole(16, most=4096)
    depth: int = whole(1, most=64)
    heads: int = whole(1, most=64)
    feedforward: int = whole(2, most=64)
    merge_maps: bool = flag(True)
    offsets: str = choice("per_region", "shared")
    sees_time: bool = flag(True)
    critic_hidden: int = whole(64, most=4096)
    critic_encoder: str = choice("own", "shared")

    def __post_init__(self):
        check_ranges(self, "model")
        if self.width % self.heads:
            raise ValueError(
                f"model.heads={self.heads} does not divide channels + grid_features = {self.width}; choose a divisor."
            )

        if self.target_width % self.target_heads:
            raise ValueError(
                f"model.target_heads={self.target_heads} does not divide model.target_width={self.target_width}; "
                "choose a divisor."
            )

    @property
    def width(self) -> int:
        """Features per cell (D in the paper)."""
        return self.channels + self.grid_features


SIZES = {
    "small": ModelConfig(),
    "paper": ModelConfig(
        stem="conv",
        channels=32,
        grid_features=16,
        depth=2,
        heads=4,
        merge_maps=False,
        offsets="shared",
        sees_time=False,
        critic_hidden=128,
    ),
}


def model_config(model: "str | ModelConfig") -> ModelConfig:
    """The configuration behind a name (or the configuration itself).

    Raises:
        ValueError: the name is unknown.
    """
    if isinstance(model, ModelConfig):
        return model
    if model not in SIZES:
        names = ", ".join(SIZES)
        raise ValueError(f"model={model!r} is unknown; choose one of {names} or give a ModelConfig.")
    return SIZES[model]
