"""`make_policy`: the target generator as a TorchRL actor that fits an environment's specs."""

from dataclasses import dataclass, replace

from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, distributions, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from maexp.agents.config.model import ModelConfig, model_config
from maexp.agents.errors import UserError
from maexp.agents.models.distributions import ACTION, Heads, RegionHeads
from maexp.agents.models.encoder import compact, pools_pictures
from maexp.agents.models.precision import float32_modules
from maexp.agents.models.target_chooser import TargetChooser
from maexp.agents.models.target_generator import TargetGenerator
from maexp.envs.targets.features import FEATURES


def load_matching(policy: nn.Module, state: dict) -> None:
    """Load a policy's weights.

    Raises:
        UserError: they belong to another network.
    """
    wrong = mismatched(policy.state_dict(), state)
    if wrong:
        raise UserError(
            f"The checkpoint holds another network ({len(wrong)} tensors differ, first {wrong[0]}): "
            "use the model and planner settings it was trained with."
        )
    policy.load_state_dict(state)


def mismatched(own: dict, state: dict) -> list[str]:
    """Names of the tensors that one of two states lacks, or that differ in shape."""
    wrong = [name for name in own if name not in state or state[name].shape != own[name].shape]
    return wrong + [name for name in state if name not in own]


MAP = ("agents", "observation", "map")
POSE = ("agents", "observation", "pose")
GRID = ("agents", "observation", "grid")
COMM = ("agents", "observation", "comm")
TIME_LEFT = ("agents", "observation", "time_left")
ALIVE = ("agents", "observation", "alive")
TARGETS = ("agents", "observation", "targets")
TARGETS_MASK = ("agents", "observation", "targets_mask")
DECIDING = ("agents", "deciding")  # whose action counts, where robots decide when they arrive
COVERAGE = ("info", "coverage")
PARAMS = ("agents", "params")
SEEN = ("agents", "seen")  # each robot as one vector: what the policy made of its observation, for critics
PREFERENCE = (*ACTION, "preference")  # the logits of targets: where a robot goes whose target another one has taken
CELLS = ("agents", "cells")  # what `compact` made of the pictures: who learns from them need not pool them again
REGION_HEADS = {"region": distributions.Categorical, "offset": IndependentNormal}
TARGET_HEADS = {"target": distributions.Categorical}
CONTROL_HEADS = {"control": IndependentNormal}
PARAM_NAMES = {distributions.Categorical: ("logits",), IndependentNormal: ("loc", "scale")}


@dataclass(frozen=True)
class ObservationShape:
    """What the networks need to know about an environment.

    Attributes:
        channels: channels of each robot's picture
        side: regions along one axis (L)
        regions: whether the action is a region and an offset, or else a control vector (planner=direct)
        radio: whether targets tell of radios
    """

    channels: int
    side: int
    regions: bool
    radio: bool = False


def observation_keys(config: ModelConfig) -> list[tuple[str, ...]]:
    """What policy and critics read, in the order of their networks' arguments."""
    if config.action == "targets":
        return [TARGETS, TARGETS_MASK, COMM]
    return [MAP, POSE, GRID, COMM, *([TIME_LEFT, ALIVE] if config.sees_time else [])]


def observation_shape(env, config: ModelConfig) -> ObservationShape:
    """Read the sizes from an environment's specs.

    Raises:
        ValueError: a key that the networks read is missing.
    """
    spec = env.observation_spec
    missing = [key for key in observation_keys(config) if key not in spec.keys(True, True)]
    if TARGETS in missing:
        raise ValueError("A policy that chooses among targets must see some: set observation.targets to how many.")
    if missing:
        raise ValueError(
            f"The environment's observation lacks {missing}; give the keys of ExplorationEnv "
            "(those of pictures are there with observation.pictures=true)."
        )
    actions = env.full_action_spec.keys(True, True)
    return ObservationShape(
        channels=spec[MAP].shape[-3] if MAP in spec.keys(True, True) else 0,
        side=spec[GRID].shape[-1] if GRID in spec.keys(True, True) else 0,
        regions=(*ACTION, "control") not in actions,
        radio=TARGETS in spec.keys(True, True) and spec[TARGETS].shape[-1] > len(FEATURES),
    )


class ActionParams(nn.Module):
    """Puts what a network returns under the names that the distributions expect.

    One tensordict rather than one key each: else the actor would count ("agents", "params") as its input.

    Attributes:
        pools: the network looks at pooled pictures, which are then returned as well
        shares: it returns every robot as one vector as well, for critics
        ranks: its logits are those of targets, and go into the action as well
    """

    def __init__(self, network: nn.Module, heads: dict[str, type]):
        super().__init__()
        self.network = network
        self.names = [(head, name) for head, kind in heads.items() for name in PARAM_NAMES[kind]]
        self.pools = pools_pictures(network)
        self.shares = getattr(network, "shares", False)
        self.ranks = heads is TARGET_HEADS

    @property
    def out_keys(self) -> list[tuple[str, ...]]:
        return [PARAMS] + [PREFERENCE] * self.ranks + [CELLS] * self.pools + [SEEN] * self.shares

    def forward(self, *observation: Tensor) -> TensorDict | tuple[TensorDict, Tensor]:
        if self.pools and not observation[0].is_floating_point():
            observation = (compact(*observation[:4]), *observation[1:])
        if isinstance(self.network, TargetChooser):
            *values, seen = self.network.look(*observation)
        else:
            values, seen = self.network(*observation), None
        lead = observation[0].shape[: values[0].ndim - 2]
        params = TensorDict(dict(zip(self.names, values, strict=True)), batch_size=lead)
        ranks = [values[0].detach()] if self.ranks else []
        others = ranks + [observation[0]] * self.pools + [seen] * self.shares
        return (params, *others) if others else params


def build_network(config: ModelConfig, shape: ObservationShape) -> tuple[nn.Module, dict[str, type]]:
    """The network of a policy, and the heads of its action."""
    if config.action == "targets":
        return TargetChooser(config, shape.radio), TARGET_HEADS
    heads = REGION_HEADS if shape.regions else CONTROL_HEADS
    return TargetGenerator(config, shape.channels, shape.side, shape.regions), heads


@float32_modules()
def make_policy(env, model: "str | ModelConfig" = "small", radio: bool | None = None) -> ProbabilisticActor:
    """The trainable policy of a team, for the action that `env` takes.

    It reads ("agents", "observation", ...) and writes ("agents", "params", ...), ("agents", "action", ...)
    and one log-probability per robot and head, ("agents", "action", "<head>_log_prob") of shape [*, robots].
    Where it pools pictures, it writes them too, ("agents", "cells").
    Offsets are stored as drawn, so that their probability can be computed again; the environment clamps them.

    Collectors draw actions. Elsewhere, where no `set_exploration_type` is in force, regions are drawn as well, and of
    targets the likeliest is taken.

    Args:
        env: gives the specs and the device; not kept
        model: a name (small, paper) or a ModelConfig
        radio: whether it looks at what targets tell of radios; None: if the env shows it
    """
    config = model_config(model)
    shape = observation_shape(env, config)
    shape = shape if radio is None else replace(shape, radio=radio)
    network, heads = build_network(config, shape)
    joint = heads is REGION_HEADS and config.offsets == "per_region"
    named = ActionParams(network, heads)
    module = TensorDictModule(named, in_keys=observation_keys(config), out_keys=named.out_keys)
    actor = ProbabilisticActor(
        module,
        in_keys=[PARAMS],
        out_keys=[(*ACTION, head) for head in heads],
        spec=None,
        distribution_class=RegionHeads if joint else Heads,
        distribution_kwargs={"heads": heads},
        return_log_prob=True,
        default_interaction_type=InteractionType.DETERMINISTIC if heads is TARGET_HEADS else InteractionType.RANDOM,
    )
    return actor.to(env.device) if env.device is not None else actor
