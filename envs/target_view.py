"""What a learned choice among frontier targets sees: for every robot its best candidates, with features that do not
depend on the map.

Lengths count in radar ranges and areas in radar discs, so that one policy fits every scenario and team size. The
features of a candidate contain what the classical planner `cost_utility` would think of it: a policy starts from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase

from maexp.envs.targets import LEAST_GAIN, Scene, TargetTracker, plan_in_turn, value_targets
from maexp.kernels.teamwork import compare_with_others, gather_gain

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

FAR = 4.0  # lengths between targets and robots count up to so many radar ranges
WAY_AHEAD = 3.0  # cells from a robot to the point that tells where its way begins

FEATURES = (
    # What cost_utility thinks of it: value when it is the robot's turn, value without the others, whether it takes it,
    # share of the gain that robots before it have claimed, and how far off [ranges] the nearest other robot goes.
    "score", "value", "planned", "claimed", "plan_gap",
    # The way: log(1 + length [ranges]), 1 / (1 + length), straight distance [ranges], way / distance - 1.
    "travel", "nearness", "distance", "detour",
    # What is to be seen from there [discs], frontier cells [10], whether it is worth going to at once; gain of the
    # candidates within 1 and 2.5 ranges of it [1 and 4 discs].
    "gain", "size", "worth", "gain_near", "gain_around",
    # Cosine and sine of where it lies, where the way begins and where the unknown beyond it lies, from the heading;
    # how far the middle of the unknown is from it [ranges].
    "ahead", "aside", "way_ahead", "way_aside", "unknown_ahead", "unknown_aside", "unknown_far",
    # The others: least way of one of them [ranges], that less the own way, whether the own is the shortest, distance to
    # the own last target and to the nearest last target of another [ranges].
    "rival", "lead", "nearest", "own_last", "mates_last",
    # Of the robot and its team, the same for all candidates: candidates [10], speed [of the limit], way driven until
    # the next decision [ranges], time left [of the episode], log(1 + what is known [discs]), others that move [4].
    "count", "speed", "drive", "time_left", "known", "mates",
)  # fmt: skip
"""Names of the last axis of the features, with their units."""


class TargetView:
    """The candidates of every robot of an env: `observe` lists them, `take` drives to some.

    M candidates per robot, those of the highest value first; masked where there are fewer.

    Args:
        env: only read.
        count: M.
        tracker: of the env's targets, if others look with it too.

    Attributes:
        state: tensors that later decisions depend on, besides those of the tracker.
    """

    def __init__(self, env: ExplorationEnv, count: int, tracker: TargetTracker | None = None):
        self.env, self.count, self.tracker = env, count, tracker or TargetTracker(env)
        shape, device = (env.num_envs, env.num_robots), env.device
        self.state = {
            "last": torch.zeros((*shape, 2), device=device),  # where each robot's latest target was [m]
            "has_last": torch.zeros(shape, dtype=torch.bool, device=device),
            "block": torch.zeros((*shape, count), dtype=torch.int64, device=device),  # the candidates' numbers
            "cell": torch.zeros((*shape, count), dtype=torch.int64, device=device),  # and grid cells
            "point": torch.zeros((*shape, count, 2), device=device),  # and where they are [m]
            "toward": torch.zeros((*shape, count, 2), device=device),  # middle of the unknown, from there [m]
            "way": torch.zeros((*shape, count), device=device),  # how far it is to drive there [m]
            "mask": torch.zeros((*shape, count), dtype=torch.bool, device=device),
        }

    @torch.no_grad()
    def observe(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Candidates now: ``features`` float32 [E, N, M, F] and ``mask`` bool [E, N, M], which of them may be chosen.

        Without any (the robot has collided, or knows no way to a frontier) the first stands for driving anywhere, and
        is the one choice; its features are 0. ``mask`` int32 [E]: look at these envs only, the others show nothing.
        """
        if mask is None or bool(mask.all()):
            return self._look()
        features = torch.zeros((*self.state["mask"].shape, len(FEATURES)), device=mask.device)
        blank = {"features": features, "mask": torch.zeros_like(self.state["mask"])}
        envs = mask.nonzero().squeeze(-1)
        if not len(envs):
            return blank
        with self.tracker.nav.only(envs):
            return {name: blank[name].index_copy_(0, envs, rows) for name, rows in self._look().items()}

    def _look(self) -> dict[str, torch.Tensor]:
        """`observe` of the envs that `Navigation.only` leaves."""
        return self.show(self.tracker.look())[0]

    def show(self, scene: Scene) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """`observe` of what the tracker has just seen; and which of the scene's targets the candidates are, int64
        [E, N, M]."""
        nav = scene.nav
        s = {name: nav.pick(value) for name, value in self.state.items()}
        s["has_last"] = s["has_last"] & (nav.state["macro_step"] != 0).unsqueeze(-1)
        value = value_targets(scene)
        best = _best(value, self.count)
        some = (scene.travel.isfinite() & scene.alive.unsqueeze(-1)).gather(2, best)
        some[..., value.shape[-1] :] = False
        s["block"], s["mask"] = scene.block.gather(2, best), some
        s["cell"] = scene.cells().gather(2, best)
        s["way"] = torch.where(some, scene.travel.gather(2, best), 0.0)
        s["point"], s["toward"] = _pick(scene.points, best), _pick(scene.middle, best)
        self.state.update({name: nav.put(value, s[name]) for name, value in self.state.items()})
        travel = s["way"] / nav.radar_range
        near = _Near(self, s, scene, best, some, travel)
        columns = near.plan() | near.way() | near.worth() | near.bearings() | near.team()
        features = torch.stack([columns[name].expand(best.shape) for name in FEATURES], -1)
        return {"features": torch.where(some.unsqueeze(-1), features, 0.0), "mask": first_if_none(some)}, best

    def note(self, chosen: torch.Tensor, where: torch.Tensor) -> None:
        """Remember where robots go: what they chose, int64 [E, N], -1 = nothing, and where that is, float32 [E, N, 2]
        [m]."""
        self.state["has_last"], self.state["last"] = chosen >= 0, where

    def take(
        self, index: torch.Tensor, preference: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Send every robot to a candidate, int64 [E, N]; region int64 [E, N] and offset float32 [E, N, 2] of the goals.

        With `targets.distinct` a robot gets another one where the one that is named is taken.

        Args:
            index: int64 [E, N], what each robot wants.
            preference: float32 [E, N, M], what it thinks of its candidates, where it gets another one; None: those of
                the highest value first.

        Raises:
            ValueError: an index that is none.
        """
        if bool(((index < 0) | (index >= self.count)).any()):
            raise ValueError(f"action target={int(index.min())}..{int(index.max())}: give 0 to {self.count - 1}")
        s = self.state
        named = torch.arange(self.count, device=index.device) == index.unsqueeze(-1)
        there = s["mask"] & (s["mask"] & named).any(-1, keepdim=True)  # who names what is not there drives anywhere
        if preference is None:
            preference = -torch.arange(self.count, device=index.device).float()
        preference = torch.where(named, torch.inf, preference.nan_to_num())
        preference = torch.where(there, preference, -torch.inf)
        chosen, waits = self.tracker.share(preference, s["way"], s["point"])
        index = chosen.clamp_min(0).unsqueeze(-1)
        self.note(chosen, _pick(s["point"], index).squeeze(2))
        block = torch.where(chosen >= 0, s["block"].gather(2, index).squeeze(-1), -1)
        cell = s["cell"].gather(2, index).squeeze(-1)
        return self.tracker.take(block, cell, _pick(s["toward"], index).squeeze(2), waits)

    def forget(self) -> None:
        """Another policy acts: nobody knows which targets its robots go to."""
        self.state["has_last"] = torch.zeros_like(self.state["has_last"])
        self.tracker.state["chosen"] = torch.full_like(self.tracker.state["chosen"], -1)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Everything that later decisions depend on, copied."""
        parts = (("target_view", self.state), ("target", self.tracker.state))
        return {f"{prefix}_{name}": value.clone() for prefix, part in parts for name, value in part.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on where `state_dict` was taken."""
        for prefix, part in (("target_view", self.state), ("target", self.tracker.state)):
            for name in part:
                part[name] = state[f"{prefix}_{name}"].to(part[name]).clone()
        self.tracker.nav.update()  # plain DWA drives along the ways that were found when the robots last looked


class _Near:
    """The features of the candidates of one moment, group by group."""

    def __init__(
        self, view: TargetView, state: dict[str, torch.Tensor], scene: Scene, best: torch.Tensor, some: torch.Tensor,
        travel: torch.Tensor,
    ):  # fmt: skip
        self.view, self.state, self.scene = view, state, scene
        self.best, self.some, self.travel = best, some, travel
        nav = scene.nav
        self.nav, self.reach = nav, nav.radar_range
        self.point = state["point"]
        self.to = self.point - nav.centers().unsqueeze(2)
        self.distance = self.to.norm(dim=-1) / self.reach
        self.gain = scene.gain.gather(2, best)

    def plan(self) -> dict[str, torch.Tensor]:
        """What the classical planner would do, each robot hearing only those it hears."""
        some, hears = self.some, self.nav.state["comm"]
        value = value_targets(self.scene).gather(2, self.best)
        open_value = torch.where(some, value, -torch.inf)
        score, taken, claimed = plan_in_turn(self.gain, open_value, self.point / self.reach, hears)
        where = _pick(self.point, taken.unsqueeze(-1)).squeeze(2)
        return {
            "score": score,
            "value": value.clamp_min(-FAR),
            "planned": torch.zeros_like(score).scatter_(2, taken.unsqueeze(-1), 1.0),
            "claimed": claimed,
        } | self._others(where)

    def way(self) -> dict[str, torch.Tensor]:
        return {
            "travel": self.travel.log1p(),
            "nearness": 1.0 / (1.0 + self.travel),
            "distance": self.distance,
            "detour": (self.travel / self.distance.clamp_min(0.1)).clamp(max=FAR) - 1.0,
        }

    def worth(self) -> dict[str, torch.Tensor]:
        gain = torch.where(self.some, self.gain, 0.0)
        near, around = gather_gain(self.point, gain, self.reach, 1.0, 2.5)
        return {
            "gain": self.gain,
            "size": self.scene.size.gather(2, self.best) / 10.0,
            "worth": (self.gain >= LEAST_GAIN).float(),
            "gain_near": near,
            "gain_around": around / 4.0,
        }

    def bearings(self) -> dict[str, torch.Tensor]:
        heading = self.nav.state["pose"][..., 3]
        ahead = torch.stack((heading.cos(), heading.sin()), -1).unsqueeze(2)
        wanted = torch.where(self.some, self.state["cell"], -1)
        way = self.nav.points_on_way(wanted, WAY_AHEAD) - self.nav.centers().unsqueeze(2)
        toward = self.state["toward"]
        columns = {"unknown_far": toward.norm(dim=-1) / self.reach}
        for name, vector in (("", self.to), ("way_", way), ("unknown_", toward)):
            unit = vector / vector.norm(dim=-1, keepdim=True).clamp_min(1e-6)
            columns[f"{name}ahead"] = (unit * ahead).sum(-1)
            columns[f"{name}aside"] = unit[..., 1] * ahead[..., 0] - unit[..., 0] * ahead[..., 1]
        return columns

    def _others(self, where: torch.Tensor) -> dict[str, torch.Tensor]:
        """``where``, float32 [E, N, 2]: where the robots would go [m]."""
        scene, s = self.scene, self.state
        ways = torch.where(scene.alive.unsqueeze(-1), self.nav.way / self.reach, torch.inf)
        plans, last = (where, self.some.any(-1)), (s["last"], s["has_last"])
        rival, *gaps = compare_with_others(self.point, self.best, ways, self.nav.state["comm"], plans, last)
        plan_gap, own_last, mates_last = ((gap / self.reach).clamp(max=FAR) for gap in gaps)
        return {
            "rival": rival.clamp(max=2 * FAR),
            "lead": (rival - self.travel).clamp(-FAR, FAR),
            "nearest": (self.travel <= rival).float(),
            "plan_gap": plan_gap,
            "own_last": own_last,
            "mates_last": mates_last,
        }

    def team(self) -> dict[str, torch.Tensor]:
        nav, env, tracker = self.nav, self.view.env, self.view.tracker
        speed, limit = tracker.speed(), nav.pick(env.simulation.robot_tensors["max_speed"])
        own = torch.eye(self.best.shape[1], dtype=torch.bool, device=self.best.device)
        mates = nav.state["comm"] & ~own & self.scene.alive.unsqueeze(1)
        cells = (nav.known != 0).sum(-1).float() * nav.cell_of_env().unsqueeze(-1) ** 2
        columns = {
            "count": self.some.sum(-1) / 10.0,
            "speed": speed / limit,
            "drive": tracker.drive(speed) / self.reach,
            "time_left": (1.0 - nav.state["macro_step"].float() / env.macro_steps).unsqueeze(-1),
            "known": (1.0 + cells / (math.pi * self.reach**2)).log(),
            "mates": mates.sum(-1) / 4.0,
        }
        return {name: value.unsqueeze(-1).float() for name, value in columns.items()}


def first_if_none(mask: torch.Tensor) -> torch.Tensor:
    """``mask`` [*, M], with the first entry where there is none: it stands for driving anywhere."""
    first = torch.arange(mask.shape[-1], device=mask.device) == 0
    return mask | (first & ~mask.any(-1, keepdim=True))


def draw_targets(
    draw: Callable[[TensorDictBase | None], TensorDictBase], tensordict: TensorDictBase | None = None
) -> TensorDictBase:
    """A random action as ``draw`` draws it, but of the targets that ``tensordict`` shows, if it shows any."""
    drawn = draw(tensordict)
    mask = drawn.get(("agents", "observation", "targets_mask"), None)
    if mask is not None:
        chances = first_if_none(mask).flatten(0, -2).float()
        drawn["agents", "action", "target"] = torch.multinomial(chances, 1).view(mask.shape[:-1])
    return drawn


def _best(value: torch.Tensor, count: int) -> torch.Tensor:
    """Places of the `count` highest of the values [E, N, K], int64 [E, N, count]; 0 where there are no more.

    The first of equals comes first, whatever K is: it depends on the other envs of the batch.
    """
    place = value.sort(dim=-1, descending=True, stable=True).indices[..., :count]
    return torch.nn.functional.pad(place, (0, count - place.shape[-1]))


def _pick(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Entries [E, N, M, 2] of [E, N, K, 2]."""
    return values.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, 2))
