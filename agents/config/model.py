"""Sizes of the networks: the dataclass, and those that have a name."""

from dataclasses import dataclass, fields
from typing import Literal

from maexp.conf import list_choices, read_choice
from maexp.envs.config_fields import check_settings, setting


@dataclass(frozen=True)
class ModelConfig:
    """What a policy chooses, and the sizes that it shares with the critics.

    `target_...`, `starts_from` and `score_weight` belong to a policy that chooses among targets, the other sizes but
    `critic_hidden` to one that chooses regions.
    """

    action: Literal["regions", "targets"] = setting(
        "regions", "what a robot chooses: regions (and an offset), or one of its frontier targets"
    )
    target_width: int = setting(48, "features per target", low=1, high=4096)
    target_heads: int = setting(2, "of the attention over targets; divide target_width", low=1, high=64)
    starts_from: Literal["cost_utility", "multi_criteria"] = setting(
        "cost_utility", "planner whose choices an untrained policy makes"
    )
    score_weight: float = setting(50.0, "of the classical value of a target in its logit", low=0)
    stem: Literal["pool", "conv"] = setting(
        "pool", "how the picture becomes small: pool averages 4 x 4 pixels, conv learns two strided convolutions"
    )
    channels: int = setting(16, "feature maps of the convolutions", low=1, high=4096)
    grid_features: int = setting(16, "features made from pose and last goal, per cell", low=1, high=4096)
    depth: int = setting(1, "Spatial-TeamFormer blocks", low=1, high=64)
    heads: int = setting(1, "of the attention; divide channels + grid_features", low=1, high=64)
    feedforward: int = setting(2, "width of the feed-forward layers, times a cell's features", low=1, high=64)
    merge_maps: bool = setting(True, "show each cell what the robots in contact have explored together")
    offsets: Literal["per_region", "shared"] = setting("per_region", "per_region, or one shared by all regions")
    sees_time: bool = setting(True, "show each cell the time that is left and whether its robot has collided")
    critic_hidden: int = setting(64, "width of the critic's hidden layers", low=1, high=4096)
    critic_encoder: Literal["own", "shared"] = setting(
        "own", "of targets: own, or shared: what the policy's made of them (faster; not beside trust regions)"
    )

    def __post_init__(self):
        check_settings(self, "model")
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

    @property
    def policy(self) -> dict[str, object]:
        """What a policy's network is made from: two policies that agree in this can take each other's weights."""
        if self.action == "targets":
            names: tuple[str, ...] = ("action", "target_width", "target_heads", "starts_from", "score_weight")
        else:
            critics = ("target_width", "target_heads", "starts_from", "score_weight", "critic_hidden", "critic_encoder")
            names = tuple(field.name for field in fields(self) if field.name not in critics)
        return {name: getattr(self, name) for name in names}


SIZES = {name: ModelConfig(**read_choice("model", name)) for name in list_choices("model")}


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
