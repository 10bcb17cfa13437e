"""Expert iteration: a policy learns what its choices are worth from branches of its own episodes.

The expert is a search in the true simulator (`maexp.agents.training.branch_rollouts`): at some decisions every robot
tries a few of its targets, and what comes of each is its label. The policy learns these by regression, acts by what it
has
learned, and is branched again: rollout-based policy iteration (Lagoudakis and Parr 2003; Anthony et al. 2017). Labels
stay true while the policy changes, for they compare targets, not policies: all that were found are learned from again.
"""

import math
import time

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from maexp.agents.algorithms.losses import check_finite
from maexp.agents.algorithms.updaters import Meter, Updater
from maexp.agents.models.actor import COMM, PARAMS, TARGETS, TARGETS_MASK
from maexp.agents.models.target_chooser import TargetChooser

TRIED = ("branches", "tried")  # int8 [*, robots, K]: candidates, the own choice first; -1: none
ADVANTAGE = ("branches", "advantage")  # float32 [*, robots, K]: worth over the own choice [radar discs]; NaN: unknown
STEEP = 0.5  # error from which it counts linearly [radar discs]: a robot lost is 1


class ExpertUpdater(Updater):
    """Regression on the branches found so far: as many minibatches after a batch as its decisions fill, `epochs` times.

    What a target is worth to the policy is its logit over `model.score_weight`: at first what the planner
    `model.starts_from` thinks of it.

    Attributes:
        memory: the decisions that were branched at, by the number of robots.
    """

    uses_critic = False

    def __init__(self, loss, settings):
        super().__init__(loss, settings)
        self.memory: dict[int, TensorDict] = {}
        chooser = next(module for module in loss.actor_network.modules() if isinstance(module, TargetChooser))
        self.scale = chooser.score_weight

    def make_policy_optimizer(self) -> torch.optim.Optimizer:
        settings = self.settings
        return torch.optim.AdamW(self.policy_params, lr=settings.lr, eps=1e-5, weight_decay=settings.weight_decay)

    def update(self, *batches: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """As of `Updater`.

        Logged: `branched`, decisions of teams in memory; `headroom`, what the best target tried was worth over the own
        choice, mean over robots' new decisions [radar discs]; `advantage_error`, of the regression.
        """
        begin = time.perf_counter()
        self.set_progress(progress)
        found = [self._remember(batch) for batch in batches]
        between, meter = time.perf_counter(), Meter()
        new = sum(len(batch) for batch in found)
        for _ in range(math.ceil(self.settings.epochs * new / self.settings.minibatch_size)):
            meter.add(self._descend())
        known = sum(len(memory) for memory in self.memory.values())
        log = dict.fromkeys(("advantage_error", "gradient_norm"), math.nan) | meter.means()  # nan: none was new
        log |= {"branched": known, "headroom": _headroom(found)}
        return log | {"advantage": between - begin, "update": time.perf_counter() - between}

    def _remember(self, batch: TensorDictBase) -> TensorDict:
        """The decisions of a batch that were branched at; the oldest known ones are forgotten for them."""
        flat = batch.select(TARGETS, TARGETS_MASK, COMM, TRIED, ADVANTAGE).flatten()
        found = flat[(flat[TRIED][..., 1:] >= 0).flatten(1).any(1)]
        found = TensorDict(
            {
                "features": found[TARGETS].half(),
                "mask": found[TARGETS_MASK],
                "comm": found[COMM],
                "tried": found[TRIED],
                "advantage": found[ADVANTAGE],
            },
            batch_size=len(found),
        ).to(self.policy_params[0].device)
        robots = found["mask"].shape[1]
        known = torch.cat([self.memory[robots], found]) if robots in self.memory else found
        if len(known):
            self.memory[robots] = known[-self.settings.memory :]
        return found

    def _descend(self) -> dict[str, float]:
        """A step on decisions drawn evenly from all that are known."""
        total, parts = sum(len(memory) for memory in self.memory.values()), []
        for known in self.memory.values():
            count = max(1, round(self.settings.minibatch_size * len(known) / total))
            parts.append(known[torch.randint(len(known), (count,), device=known.device)])
        with self.loss.actor_network_params.to_module(self.loss.actor_network):
            losses = [self._error(part) for part in parts]
        loss = sum(losses) / len(losses)
        check_finite("the error of the advantages", loss)
        self.policy_optimizer.zero_grad()
        loss.backward()
        norm = self.clip(self.policy_params, "policy")
        self.policy_optimizer.step()
        return {"advantage_error": loss.item(), "gradient_norm": norm}

    def _error(self, part: TensorDict) -> Tensor:
        """Huber's error of what the policy thinks of the candidates tried, over the own choice [radar discs]."""
        shown = TensorDict(
            {TARGETS: part["features"].float(), TARGETS_MASK: part["mask"], COMM: part["comm"]}, part.batch_size
        )
        tried = part["tried"].long()
        logits = self.loss.actor_network.get_dist_params(shown)[(*PARAMS, "target", "logits")]
        worth = logits.gather(-1, tried.clamp_min(0)) / self.scale
        counts = tried_others(part)
        wrong = (worth - worth[..., :1] - part["advantage"].nan_to_num())[counts]
        return torch.nn.functional.huber_loss(wrong, torch.zeros_like(wrong), delta=STEEP) / STEEP

    def state_dict(self) -> dict:
        return super().state_dict() | {"memory": {str(n): known.to_dict() for n, known in self.memory.items()}}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.load_memory(state["memory"])

    def load_memory(self, memory: dict[str, dict[str, Tensor]]) -> None:
        """Learn from these decisions, as `state_dict` tells them."""
        device = self.policy_params[0].device
        self.memory = {int(n): TensorDict(arrays, len(arrays["mask"])).to(device) for n, arrays in memory.items()}


def tried_others(part: TensorDict) -> Tensor:
    """Which candidates were tried beside the own choice, bool [D, robots, K]."""
    counts = (part["tried"] >= 0) & part["advantage"].isfinite()
    counts[..., 0] = False
    return counts


def _headroom(found: list[TensorDict]) -> float:
    """Mean over robots' decisions of what the best candidate tried was worth over the own choice; NaN without any."""
    best = [torch.where(tried_others(batch), batch["advantage"], -torch.inf).amax(-1).flatten() for batch in found]
    best = torch.cat(best)
    return best[best.isfinite()].clamp_min(0.0).mean().item()
