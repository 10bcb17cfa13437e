"""How the robots' actions are drawn: several heads a robot, their entropy, and the divergence of two policies.

TorchRL's CompositeDistribution draws its parts by themselves, so that no part can depend on another; nor does it
count robots in its batch shape. These do, and serve TorchRL's actors and losses in its place.
"""

from tensordict import TensorDict, TensorDictBase
from torch import Size, Tensor
from torch.distributions import Categorical, Distribution, kl_divergence
from torchrl.modules import IndependentNormal

ACTION = ("agents", "action")
REGION, OFFSET = (*ACTION, "region"), (*ACTION, "offset")


class Heads(Distribution):
    """Parts of an action that are drawn independently of each other, of batch shape [*, robots].

    Samples and log-probabilities are tensordicts, under ("agents", "action", "<head>") and "<head>_log_prob".

    Args:
        params: the parameters of each head under its name, shape [*]
        heads: the distribution of each head
    """

    def __init__(self, params: TensorDictBase, heads: dict[str, type]):
        self.heads = heads
        self.dists = {(*ACTION, name): kind(**params.get(name), validate_args=False) for name, kind in heads.items()}
        super().__init__(next(iter(self.dists.values())).batch_shape, validate_args=False)

    def sample(self, sample_shape: Size = Size()) -> TensorDict:  # noqa: B008
        return self._pack({key: head.sample(sample_shape) for key, head in self.dists.items()}, sample_shape)

    @property
    def mode(self) -> TensorDict:
        """The likeliest action."""
        return self._pack({key: head.mode for key, head in self.dists.items()})

    @property
    def deterministic_sample(self) -> TensorDict:
        return self.mode

    def log_prob(self, value: TensorDictBase) -> TensorDict:
        """Of each head by itself; their sum is that of the robot's action."""
        return self._pack_log_probs({key: head.log_prob(value.get(key)) for key, head in self.dists.items()})

    def entropy(self) -> Tensor:
        """Of the robot's whole action, shape [*, robots]."""
        return sum(head.entropy() for head in self.dists.values())

    def divergence_from(self, params: TensorDictBase) -> Tensor:
        """KL(policy with `params` || this one) over the whole action, shape [*, robots]."""
        before = type(self)(params, self.heads)
        return sum(divergence(before.dists[key], head) for key, head in self.dists.items())

    def _pack(self, values: dict, lead: Size = Size()) -> TensorDict:  # noqa: B008
        return TensorDict(values, batch_size=[*lead, *self.batch_shape])

    @staticmethod
    def _pack_log_probs(values: dict) -> TensorDict:
        named = {(*key[:-1], f"{key[-1]}_log_prob"): value for key, value in values.items()}
        return TensorDict(named, batch_size=next(iter(values.values())).shape)


class RegionHeads(Heads):
    """A region and then an offset within it: each region has an offset's mean and scale of its own.

    Args:
        params: region: logits [*, robots, regions]; offset: loc and scale [*, robots, regions, 2]
        heads: `region`, then `offset`
    """

    @property
    def region(self) -> Categorical:
        return self.dists[REGION]

    @property
    def within(self) -> IndependentNormal:
        """The offsets in all regions, of batch shape [*, robots, regions]."""
        return self.dists[OFFSET]

    def offset_in(self, region: Tensor) -> IndependentNormal:
        """The offset's distribution in the regions [..., *, robots]."""
        index = region[..., None, None].expand(*region.shape, 1, 2)
        base = self.within.base_dist
        loc, scale = (
            value.expand(*region.shape, *value.shape[-2:]).gather(-2, index).squeeze(-2)
            for value in (base.loc, base.scale)
        )
        return IndependentNormal(loc, scale, validate_args=False)

    def sample(self, sample_shape: Size = Size()) -> TensorDict:  # noqa: B008
        region = self.region.sample(sample_shape)
        return self._pack({REGION: region, OFFSET: self.offset_in(region).sample()}, sample_shape)

    @property
    def mode(self) -> TensorDict:
        """The likeliest region, and the mean offset in it."""
        region = self.region.mode
        return self._pack({REGION: region, OFFSET: self.offset_in(region).mean})

    def log_prob(self, value: TensorDictBase) -> TensorDict:
        """Of the region, and of the offset given the region."""
        region = value.get(REGION)
        offset = self.offset_in(region).log_prob(value.get(OFFSET))
        return self._pack_log_probs({REGION: self.region.log_prob(region), OFFSET: offset})

    def entropy(self) -> Tensor:
        """The region's, and the offset's as expected over the region."""
        return self.region.entropy() + (self.region.probs * self.within.entropy()).sum(-1)

    def divergence_from(self, params: TensorDictBase) -> Tensor:
        before = type(self)(params, self.heads)
        offsets = (before.region.probs * divergence(before.within, self.within)).sum(-1)
        return divergence(before.region, self.region) + offsets


def divergence(before: Distribution, now: Distribution) -> Tensor:
    """KL(before || now). Of choices from their logits: torch's is infinite where a probability is too small for
    float32."""
    if isinstance(now, Categorical):
        return (before.probs * (before.logits - now.logits)).sum(-1)
    return kl_divergence(before, now)
