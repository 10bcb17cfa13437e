"""What a learned choice among frontier targets sees: for every robot its best candidates, with the features of
`maexp.envs.targets.features`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase

from maexp.envs.comm.radio_features import ContactView
from maexp.envs.targets.features import AROUND, EDGE, NEAR, FeatureInputs, feature_names
from maexp.envs.targets.heuristics import WAY_AHEAD, value_targets
from maexp.envs.targets.tracker import TargetTracker, TensorScene, make_tracker, plan_in_turn
from maexp.kernels.greedy_assignment import compare_with_mates, gather_gain

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv


class TargetView:
    """The candidates of every robot of an env: `observe` lists them, `take` drives to some.

    M candidates per robot, those of the highest value first; masked where there are fewer. With `observation.radio`
    one more follows, the last: to go to the base station and tell it what it does not know
        (`maexp.envs.comm.radio_features`).

    Args:
        env: only read.
        count: M.
        tracker: of the env's targets, if others look with it too.

    Attributes:
        shown: candidates with that one.
        contacts: what is told of radios; None: nothing.
        tells: bool [E, N], who has been sent to tell the base station at the latest `take`.
        state: tensors that later decisions depend on, besides those of the tracker.
    """

    def __init__(self, env: ExplorationEnv, count: int, tracker: TargetTracker | None = None):
        self.env, self.count, self.tracker = env, count, tracker or make_tracker(env)
        shape, device, dims = (env.num_envs, env.num_robots), env.device, self.tracker.dims
        self.contacts = ContactView(env) if env.settings.observes_radios else None
        self.shown = count + (self.contacts is not None)
        self.features = len(feature_names(self.contacts is not None))
        self.tells = torch.zeros(shape, dtype=torch.bool, device=device)
        self.state = {
            # where each robot's latest target was [m]
            "last": torch.zeros((*shape, dims), dtype=torch.float32, device=device),
            "has_last": torch.zeros(shape, dtype=torch.bool, device=device),
            "block": torch.zeros((*shape, count), dtype=torch.int64, device=device),  # the candidates' numbers
            "cell": torch.zeros((*shape, count), dtype=torch.int64, device=device),  # and grid cells
            "point": torch.zeros((*shape, count, dims), dtype=torch.float32, device=device),  # and where they are [m]
            # middle of the unknown, from there [m]
            "toward": torch.zeros((*shape, count, dims), dtype=torch.float32, device=device),
            "way": torch.zeros((*shape, count), dtype=torch.float32, device=device),  # how far it is to drive there [m]
            "mask": torch.zeros((*shape, count), dtype=torch.bool, device=device),
        }

    @torch.no_grad()
    def observe(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Candidates now: ``features`` float32 [E, N, M, F] and ``mask`` bool [E, N, M], which of them may be chosen
        (M + 1 of `shown`).

        Without any (the robot has collided, or knows no way to a frontier) the first stands for driving anywhere, and
        is the one choice; its features are 0. ``mask`` int32 [E]: look at these envs only, the others show nothing.
        """
        if mask is None or bool(mask.all()):
            return self.show(self.tracker.look())[0]
        shape = (*self.state["mask"].shape[:2], self.shown)
        blank = {
            "features": torch.zeros((*shape, self.features), dtype=torch.float32, device=mask.device),
            "mask": torch.zeros(shape, dtype=torch.bool, device=mask.device),
        }
        envs = mask.nonzero().squeeze(-1)
        if not len(envs):
            return blank
        found = self.show(self.tracker.look(envs))[0]
        return {name: blank[name].index_copy_(0, envs, rows) for name, rows in found.items()}

    def show(self, scene: TensorScene) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
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
        s["point"], s["toward"] = gather_points(scene.points, best), gather_points(scene.middle, best)
        self.state.update({name: nav.put(value, s[name]) for name, value in self.state.items()})
        inputs = self._moment(s, scene, best, some, value.gather(2, best))
        if self.contacts is not None:
            self.contacts.look()
            inputs = self.contacts.add_to(inputs, nav)
        return {"features": inputs.features(), "mask": first_if_none(inputs.mask)}, best

    def _moment(
        self,
        state: dict[str, torch.Tensor],
        scene: TensorScene,
        best: torch.Tensor,
        some: torch.Tensor,
        value: torch.Tensor,
    ) -> FeatureInputs:
        """What features are made of; each robot hears only those it hears.

        Args:
            state: what `show` has just noted, of the envs that are looked at.
            best, some: of the candidates, int64 and bool [E, N, M].
            value: what they are worth, float32 [E, N, M].
        """
        nav, env, tracker = scene.nav, self.env, self.tracker
        reach, point, gain, hears = nav.radar_range, state["point"], scene.gain.gather(2, best), nav.state["comm"]
        open_value = torch.where(some, value, -torch.inf)
        score, taken, claimed = plan_in_turn(gain, open_value, point / reach, hears)
        where = gather_points(point, taken.unsqueeze(-1)).squeeze(2)
        ways = torch.where(scene.alive.unsqueeze(-1), nav.way / reach, torch.inf)
        plans, last = (where, some.any(-1)), (state["last"], state["has_last"])
        rival, *gaps = compare_with_mates(point, best, ways, hears, plans, last)
        plan_gap, own_last, mates_last = (gap / reach for gap in gaps)
        near, around = gather_gain(point, torch.where(some, gain, 0.0), reach, NEAR + EDGE, AROUND + EDGE)
        speed, at = tracker.speed(nav), nav.centers()
        own = torch.eye(best.shape[1], dtype=torch.bool, device=best.device)
        left = env.time_left(nav.state)
        return FeatureInputs(
            xp=torch,
            reach=reach,
            mask=some,
            travel=state["way"] / reach,
            to=point - at.unsqueeze(2),
            way=nav.points_on_way(torch.where(some, state["cell"], -1), WAY_AHEAD) - at.unsqueeze(2),
            toward=state["toward"],
            gain=gain,
            gain_near=near,
            gain_around=around,
            size=scene.size.gather(2, best),
            value=value,
            score=score,
            claimed=claimed,
            planned=torch.arange(best.shape[-1], device=best.device) == taken.unsqueeze(-1),
            plan_gap=plan_gap,
            own_last=own_last,
            mates_last=mates_last,
            rival=rival,
            at=at,
            heading=nav.state["pose"][..., 3:],
            speed=speed.unsqueeze(-1),
            max_speed=nav.pick(env.simulation.robot_tensors["max_speed"]).unsqueeze(-1),
            drive=tracker.drive(nav, speed).unsqueeze(-1),
            mates=hears & ~own & scene.alive.unsqueeze(1),
            time_left=left.view(-1, 1, 1),
            area=nav.known_area().unsqueeze(-1),
        )

    def note(self, chosen: torch.Tensor, where: torch.Tensor) -> None:
        """Remember where robots go: what they chose, int64 [E, N], -1 = nothing, and where that is, float32
        [E, N, 2] [m], in volumes [E, N, 3]."""
        self.state["has_last"], self.state["last"] = chosen >= 0, where

    def take(self, index: torch.Tensor, preference: torch.Tensor | None = None) -> torch.Tensor:
        """Send every robot to a candidate, int64 [E, N]; the goals, as `TargetTracker.take` gives them.

        With `targets.distinct` a robot gets another one where the one that is named is taken.

        Args:
            index: int64 [E, N], what each robot wants.
            preference: float32 [E, N, M], what it thinks of its candidates, where it gets another one; None: those of
                the highest value first.

        Raises:
            ValueError: an index that is none.
        """
        if bool(((index < 0) | (index >= self.shown)).any()):
            raise ValueError(f"action target={int(index.min())}..{int(index.max())}: give 0 to {self.shown - 1}")
        s = self.state
        if self.env.arrivals is not None:
            index = self.env.arrivals.hold(index)
        named = torch.arange(self.count, device=index.device) == index.unsqueeze(-1)
        there = s["mask"] & (s["mask"] & named).any(-1, keepdim=True)  # who names what is not there drives anywhere
        if preference is None:
            preference = -torch.arange(self.count, device=index.device).float()
        else:
            preference = preference[..., : self.count]
        preference = torch.where(named, torch.inf, preference.nan_to_num())
        preference = torch.where(there, preference, -torch.inf)
        chosen, waits = self.tracker.share(preference, s["way"], s["point"])
        self.tells = index == self.count
        index = chosen.clamp_min(0).unsqueeze(-1)
        self.note(chosen, gather_points(s["point"], index).squeeze(2))
        block = torch.where(chosen >= 0, s["block"].gather(2, index).squeeze(-1), -1)
        cell = s["cell"].gather(2, index).squeeze(-1)
        return self.tracker.take(block, cell, gather_points(s["toward"], index).squeeze(2), waits)

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


def gather_points(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Entries [E, N, M, D] of [E, N, K, D]; ``index`` int64 [E, N, M]."""
    return values.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, values.shape[-1]))
