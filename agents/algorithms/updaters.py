"""Updaters: turn Collector batches into better networks, one call a batch.

An updater estimates advantages, then takes its policy and critic steps on minibatches of team steps. It
holds the optimizers; its state_dict continues a run bit for bit.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from maexp.agents.algorithms.gae import look, write_advantages
from maexp.agents.algorithms.losses import ANCHOR, check_finite
from maexp.agents.algorithms.trust_region import TRPO
from maexp.agents.models.actor import ALIVE, CELLS, COMM, DECIDING, GRID, MAP, PARAMS, POSE, SEEN, TARGETS
from maexp.agents.models.encoder import compact, pools_pictures

Task = Callable[[], Any]
Both = Callable[[Task, Task], tuple[Any, Any]]
"""``both(first, second)`` runs two tasks and returns what they return."""


@contextmanager
def at_once(wanted: bool) -> Iterator[Both]:
    """Inside, two tasks run at once: the second in a thread of its own, each with half of torch's threads.

    They must not write what the other reads; random numbers are the first one's. Where it is not wanted, or torch has a
    single thread, they run one after the other. With two threads results are those of a single one, bit for bit.
    """
    threads = torch.get_num_threads()
    if not wanted or threads == 1:
        yield lambda first, second: (first(), second())
        return
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(threads // 2,)) as pool:
        pool.submit(torch.get_num_threads).result()  # it has set its share: what follows is for this thread

        def both(first: Task, second: Task) -> tuple[Any, Any]:
            other = pool.submit(second)
            try:
                mine = first()
            finally:
                wait([other])
            return mine, other.result()

        torch.set_num_threads(threads - threads // 2)
        try:
            yield both
        finally:
            torch.set_num_threads(threads)


CALIBRATION_ROUNDS = 5
CHUNK = 256  # team steps at a time where memory matters more than speed
Terms = Callable[[TensorDictBase], TensorDict]


class Meter:
    """Means of what is logged over an update."""

    def __init__(self):
        self.sums = defaultdict(float)
        self.counts = defaultdict(int)

    def add(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            self.sums[name] += value
            self.counts[name] += 1

    def means(self) -> dict[str, float]:
        return {name: total / self.counts[name] for name, total in self.sums.items()}


class Updater:
    """What all updaters share: advantages, minibatches, the critic's optimizer, saving.

    Args:
        loss: made by make_loss
        settings: the algorithm's settings
    """

    uses_critic = True

    def __init__(self, loss, settings):
        self.loss = loss
        self.settings = settings
        self.policy_params = [p for p in loss.actor_network_params.parameters()]
        self.critic_params = [p for p in loss.critic_network_params.parameters()]
        self.critic_optimizer = torch.optim.Adam(self.critic_params, lr=settings.critic_lr, eps=1e-5)
        self.policy_optimizer = self.make_policy_optimizer()
        self.anchor: TensorDictBase | None = None

    def make_policy_optimizer(self) -> torch.optim.Optimizer:
        """Adam for gradient steps; a trust region has its own."""
        return torch.optim.Adam(self.policy_params, lr=self.settings.lr, eps=1e-5)

    def update(self, *batches: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from Collector batches of shape [envs, T]; several for teams of several sizes.

        The losses of teams of different sizes are averaged, each batch counting alike.

        Args:
            batches: with "next" and all that the policy wrote
            progress: share of the training done, for settings that decay

        Returns:
            means of what the algorithm logs, and the seconds of its two stages, "advantage" and "update"

        Raises:
            NonFiniteLoss: a term became NaN or infinite; the message names it
        """
        begin = time.perf_counter()
        self.set_progress(progress)
        steps = [self.prepare(batch) for batch in batches]
        between = time.perf_counter()
        meter = Meter()
        self.learn(steps, meter)
        timings = {"advantage": between - begin, "update": time.perf_counter() - between}
        return meter.means() | timings

    def set_progress(self, progress: float) -> None:
        """Lower the learning rates linearly to `final_lr_share`, and the pull of a warm start to 0, at the end."""
        self.loss.anchor_coeff = self.settings.anchor_coeff * (1 - progress)
        share = 1 - (1 - self.settings.final_lr_share) * progress
        for group in self.critic_optimizer.param_groups:
            group["lr"] = self.settings.critic_lr * share
        if not isinstance(self.policy_optimizer, TRPO):
            for group in self.policy_optimizer.param_groups:
                group["lr"] = self.settings.lr * share

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Write advantages; return the team steps with what the losses read, flattened.

        Where another policy acted, as in a warm start, there is no more in them than what that one wrote.
        """
        batch = write_advantages(self.loss, self._compact(batch.copy()))
        keys = self.loss.tensor_keys
        check_finite("the advantage", batch.get(keys.advantage))
        self._calibrate(batch)
        needed = [*self.loss.actor_network.in_keys, *self.loss.critic_network.in_keys]
        needed += [keys.advantage, keys.value_target, keys.value, *keys.action]
        needed += [key for key in (ALIVE, DECIDING, PARAMS, *keys.sample_log_prob) if key in batch.keys(True)]
        return self._add_anchor(batch.select(*needed).flatten())

    def set_anchor(self) -> None:
        """From now on keep the policy near what it is at this moment."""
        self.anchor = self.loss.actor_network_params.data.clone()

    @torch.no_grad()
    def _add_anchor(self, steps: TensorDictBase) -> TensorDictBase:
        if self.anchor is not None and self.settings.anchor_coeff > 0:
            actor = self.loss.actor_network
            with self.anchor.to_module(actor):
                parts = [actor.get_dist_params(part)[PARAMS] for part in steps.select(*actor.in_keys).split(CHUNK)]
            steps.set(ANCHOR, torch.cat(parts))
        return steps

    def _compact(self, batch: TensorDictBase) -> TensorDictBase:
        """Pooled and merged pictures in place of pictures, where all networks that look at them would make the same."""
        readers = [net for net in (self.loss.actor_network, self.loss.critic_network) if MAP in net.in_keys]
        if not readers or not all(pools_pictures(net) for net in readers):
            return batch
        if CELLS in batch.keys(True):
            batch[MAP] = batch[CELLS]
        else:  # another policy acted
            parts = [part.flatten(0, 1) for part in (batch[MAP], batch[POSE], batch[GRID], batch[COMM])]
            chunks = zip(*(part.split(CHUNK) for part in parts), strict=True)
            batch[MAP] = torch.cat([compact(*chunk) for chunk in chunks]).unflatten(0, batch.shape)
        return batch

    def _calibrate(self, batch: TensorDictBase) -> None:
        """Once: set the critic's scale. A few rounds, because the targets lean on the values."""
        critic = self.loss.critic_network.module
        if getattr(critic, "calibrated", True):
            return
        for _ in range(CALIBRATION_ROUNDS):
            critic.calibrate(batch.get(self.loss.tensor_keys.value_target))
            write_advantages(self.loss, batch)

    def minibatches(self, steps: list[TensorDictBase], size: int, share: float = 1.0) -> Iterator[list[TensorDictBase]]:
        """Random parts of every batch, together about `size` team steps; no step twice.

        Args:
            share: of the steps that are taken, of each batch alike; 1: all
        """
        total = sum(part.shape[0] for part in steps)
        count = min(max(1, round(total / size)), *(part.shape[0] for part in steps))
        orders = [torch.randperm(part.shape[0]).tensor_split(count) for part in steps]
        for chosen in islice(zip(*orders, strict=True), max(1, round(share * count))):
            yield [part[index] for part, index in zip(steps, chosen, strict=True)]

    def learn(self, steps: list[TensorDictBase], meter: Meter) -> None:
        """Take the algorithm's optimisation steps."""
        raise NotImplementedError

    def clip(self, params: list[Tensor], name: str) -> float:
        """Clip a group's gradients to `max_grad_norm`; returns the norm before."""
        norm = torch.nn.utils.clip_grad_norm_(params, self.settings.max_grad_norm)
        check_finite(f"the {name}'s gradient", norm)
        return norm.item()

    def state_dict(self) -> dict:
        """Networks, running statistics, optimizers, and after a warm start its policy."""
        state = {
            "loss": self.loss.state_dict(),
            "policy_optimizer": self.policy_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
        }
        if self.anchor is not None:
            state["anchor"] = dict(self.anchor.flatten_keys(".").items())
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore what state_dict gave; the policy and critic given to make_loss change with it."""
        self.loss.load_state_dict(state["loss"])
        self.policy_optimizer.load_state_dict(state["policy_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        if "anchor" in state:
            self.anchor = TensorDict(state["anchor"]).unflatten_keys(".").to(self.policy_params[0].device)

    def learn_values(self, steps: list[TensorDictBase], meter: Meter) -> None:
        """One pass of the critic alone."""
        for parts in self.minibatches(steps, self.settings.minibatch_size, self.settings.learn_share):
            for part in parts if self.loss.is_shared else ():
                part.set(SEEN, look(self.loss, part, CHUNK))
            meter.add(self.descend(self.loss.critic_terms, parts, "critic"))

    def descend(self, terms: Terms, parts: list[TensorDictBase], *sides: str) -> dict[str, float]:
        """A gradient step of the "policy", the "critic" or both on the mean of `terms`; returns what is logged."""
        outputs = [terms(part) for part in parts]
        names = [name for name in outputs[0].keys() if name.startswith("loss_")]
        losses = {name: sum(out[name] for out in outputs) / len(outputs) for name in names}
        for name, value in losses.items():
            check_finite(name, value)
        by_side = {
            "policy": (self.policy_optimizer, self.policy_params, "gradient_norm"),
            "critic": (self.critic_optimizer, self.critic_params, "critic_gradient_norm"),
        }
        for side in sides:
            by_side[side][0].zero_grad()
        sum(losses.values()).backward()
        norms = {by_side[side][2]: self.clip(by_side[side][1], side) for side in sides}
        for side in sides:
            by_side[side][0].step()
        return summary(outputs) | norms


class GradientUpdater(Updater):
    """Epochs of Adam on minibatches: clipped algorithms (several epochs) and A2C (one)."""

    def learn(self, steps: list[TensorDictBase], meter: Meter) -> None:
        small = TARGETS in self.loss.actor_network.in_keys and self.policy_params[0].device.type == "cpu"
        with at_once(small and not self.loss.is_shared) as both:
            for _ in range(self.settings.epochs):
                for parts in self.minibatches(steps, self.settings.minibatch_size, self.settings.learn_share):
                    meter.add(self._step(parts, both))
        if getattr(self.loss, "kl_coeff", 0) > 0:
            self.loss.adapt_penalty(meter.means()["kl"])

    def _step(self, parts: list[TensorDictBase], both: Both) -> dict[str, float]:
        if self.loss.is_shared:
            return self.descend(self.loss, parts, "policy", "critic")
        policy, critic = both(
            lambda: self.descend(self.loss.policy_terms, parts, "policy"),
            lambda: self.descend(self.loss.critic_terms, parts, "critic"),
        )
        return policy | critic


class TrustRegionUpdater(Updater):
    """Constrained policy steps, each on its own part of the batch, then epochs of Adam for the critic."""

    def make_policy_optimizer(self) -> TRPO:
        names = ("max_kl", "accept_ratio", "damping", "cg_steps", "backtracks", "backtrack_factor")
        return TRPO(self.policy_params, **{name: getattr(self.settings, name) for name in names})

    def learn(self, steps: list[TensorDictBase], meter: Meter) -> None:
        share = self.settings.learn_share
        for number, parts in enumerate(self.minibatches(steps, self.settings.policy_minibatch_size, share)):
            if number:
                self._act_again(parts)
            *closures, terms = self._closures(parts)
            meter.add(self.policy_optimizer.step(*closures) | terms)
        for _ in range(self.settings.critic_epochs):
            self.learn_values(steps, meter)

    @torch.no_grad()
    def _act_again(self, parts: list[TensorDictBase]) -> None:
        """Measure the next step's divergence from the policy as it now is, not from the one that acted."""
        actor = self.loss.actor_network
        for part in parts:
            with self.loss.actor_network_params.to_module(actor):
                part.update(actor.get_dist_params(part.select(*actor.in_keys)).select(PARAMS))

    def _closures(self, parts: list[TensorDictBase]):
        """Loss and divergence on all of `parts`; divergence alone on the few states of the Fisher matrix; and the
        terms of the loss when it was last asked for, of the last part."""
        total = sum(part.shape[0] for part in parts)
        share = min(1.0, self.settings.fisher_size / total)
        few = [part[: max(1, round(share * part.shape[0]))] for part in parts]
        last: dict[str, float] = {}

        def closure() -> tuple[Tensor, Tensor]:
            losses, divergences, terms = zip(*(self.loss.surrogate(part) for part in parts), strict=True)
            last.update({name: value.item() for name, value in terms[-1].items() if name != "loss_entropy"})
            loss = sum(losses) / len(parts)
            if torch.is_grad_enabled():
                check_finite("loss_objective", loss)
            return loss, sum(divergences) / len(parts)

        def fisher_closure() -> Tensor:
            return sum(self.loss.divergence(part) for part in few) / len(few)

        return closure, fisher_closure, last


def summary(outputs: list[TensorDict]) -> dict[str, float]:
    """What a loss reports, averaged over the batches."""
    return {name: sum(out[name].float().mean().item() for out in outputs) / len(outputs) for name in outputs[0].keys()}
