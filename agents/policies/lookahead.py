"""Planning by rollouts: every robot in turn tries a few targets in a simulated future of its team, and takes the best.

Multi-agent rollout (Bertsekas 2021): the others keep to what they have chosen or would choose by themselves; the first
decision is played, then the rollout policy goes on for some more; what is covered over that time decides. The future
is played in the simulator itself: in a world of what the robots know (`lookahead`) or in the true one (`clairvoyant`,
a reference that cheats).
"""

from __future__ import annotations

import torch

from maexp.agents.errors import UserError
from maexp.agents.policies.classical import CLASSICAL, FrontierPlanner, rank_by_utility
from maexp.agents.policies.pretrained import load_chooser
from maexp.agents.policies.rollouts import (
    ROLLOUT_POLICY,
    Rollouts,
    branches_of,
    check_rollout_policy,
    search_in_turn,
)
from maexp.envs import ExplorationEnv, LookaheadConfig
from maexp.envs.targets.heuristics import Array, Scene, value_targets
from maexp.envs.targets.observation import TargetView, gather_points
from maexp.envs.targets.tracker import TargetTracker, TensorScene

HIDDEN = -1e3  # what targets are worth that the policy is not shown [radar discs]: less than any


class TrainedRank:
    """Calling it with a `TensorScene` gives what each robot thinks of each target [radar discs], float32 [E, N, K].

    Args:
        spec: a policy that ships, or a folder that `maexp export` wrote.
        env: of the teams; only read.
        tracker: with which the planner looks.
        setting: the setting that messages name.

    Raises:
        UserError: there is no such policy, it is damaged, or it looks at radios and the env shows nothing of these.
    """

    def __init__(self, spec: str, env: ExplorationEnv, tracker: TargetTracker, setting: str):
        chooser, count = load_chooser(spec, setting)
        if chooser.radio and not env.settings.observes_radios:
            raise UserError(
                f"{setting}={spec} was trained with observation.radio=true, and the env shows nothing of radios: add "
                "observation.radio=true."
            )
        self.chooser = chooser.to(env.device)
        self.view = TargetView(env, count, tracker)

    @torch.no_grad()
    def __call__(self, scene: TensorScene) -> torch.Tensor:
        seen, best = self.view.show(scene)
        logits = self.chooser(seen["features"], seen["mask"], scene.nav.state["comm"])[0][..., : self.view.count]
        there = self.view.state["mask"]
        worth = torch.where(scene.travel.isfinite(), HIDDEN - scene.travel, -torch.inf)
        shown = torch.where(there, logits / self.chooser.score_weight, -torch.inf)
        return worth.scatter_reduce(2, best, shown, "amax")

    def note(self, scene: TensorScene, chosen: torch.Tensor) -> None:
        """Remember which targets robots take, int64 [E, N], -1 = none."""
        place = chosen.clamp_min(0).view(*chosen.shape, 1, 1).expand(-1, -1, -1, 2)
        self.view.note(chosen, scene.points.gather(2, place).squeeze(2))


class LookaheadPlanner(FrontierPlanner):
    """The search as a policy; calling it plans for all envs.

    Args:
        env: the env to plan for.
        config: how; None: as the env's settings say.
        true_world: play in the true world.

    Raises:
        ValueError: the rollout policy is none.
    """

    def __init__(self, env: ExplorationEnv, config: LookaheadConfig | None = None, true_world: bool = False):
        config = env.lookahead_config if config is None else config
        check_rollout_policy(config)
        super().__init__(env, CLASSICAL.get(config.rollout_policy, rank_by_utility))
        self.trained = config.rollout_policy not in CLASSICAL
        if self.trained:
            self.rank = TrainedRank(config.rollout_policy, env, self.tracker, ROLLOUT_POLICY)
        self.env, self.config = env, config
        self.rollouts = Rollouts(branches_of(env, config, self.tracker, true_world), config, self.tracker)

    def choose(self, scene: TensorScene) -> tuple[torch.Tensor, torch.Tensor]:
        """The target of each robot, and which robots wait: as the rollout policy says, but where a branch is better."""
        preference = self.rank(scene)
        chosen, waits = self._improve(scene, preference)
        if self.trained:
            self.rank.note(scene, chosen)
        return chosen, waits

    def _improve(self, scene: TensorScene, preference: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As of `choose`, where robots think so of targets, float32 [E, N, T]."""
        own, waits = self.tracker.share(preference, scene.travel, scene.points)
        offers = self._offer(scene, preference, own, waits)
        chosen = torch.zeros_like(own)
        teams = (self.env.simulation.tensors["active"] != 0).nonzero().squeeze(-1)
        distinct = self.env.targets_config.distinct
        for some in teams.split(self.rollouts.branches.teams) if len(teams) else ():
            theirs = {name: offer[some] for name, offer in offers.items()}
            chosen[some] = search_in_turn(self.rollouts, some, theirs, distinct)
        if not bool(chosen.any()):
            return own, waits
        best = offers["index"].gather(2, chosen.unsqueeze(-1))
        wanted = torch.where((own >= 0).unsqueeze(-1), torch.inf, preference.gather(2, best))
        return self.tracker.share(preference.scatter(2, best, wanted), scene.travel, scene.points)

    def _offer(
        self, scene: TensorScene, preference: torch.Tensor, own: torch.Tensor, waits: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """What each robot may try, the choice of the rollout policy first.

        Returns:
            "index", "block": int64 [E, N, K], "goal", "point": float32 [E, N, K, 2] [m], "value": float32 [E, N, K],
            more than the own choice [radar discs], "wanted": bool [E, N, K], "body": float32 [E, N] [m], "hears": bool
            [E, N, N].
        """
        index = list_candidates(preference, own, self.config.candidates)
        there = (index >= 0) & scene.alive.unsqueeze(-1)
        place = index.clamp_min(0)
        cell, block = scene.cells().gather(2, place), scene.block.gather(2, place)
        toward, point = (gather_points(points, place) for points in (scene.middle, scene.points))
        block = torch.where(index >= 0, block, -1)
        value = (preference if self.trained else value_in_turn(scene)).gather(2, place)
        value = torch.where(there & there[..., :1], value - value[..., :1], 0.0)
        there[..., 1:] &= (index[..., 1:] != own.unsqueeze(-1)) & (own >= 0).unsqueeze(-1)
        return {
            "index": place,
            "block": block,
            "goal": self.rollouts.goals(block, cell, toward, waits),
            "point": point,
            "value": value,
            "wanted": there,
            "body": self.tracker.body,
            "hears": self.tracker.nav.state["comm"],
        }


def list_candidates(preference: torch.Tensor, own: torch.Tensor, count: int) -> torch.Tensor:
    """What each robot tries: its own choice, int64 [E, N], -1 = none, then the targets that it likes best.

    Args:
        preference: float32 [E, N, T], -inf for what is out of reach.

    Returns:
        int64 [E, N, count]; -1 where there is nothing.
    """
    first = preference.scatter(2, own.clamp_min(0).unsqueeze(-1), torch.inf)
    order = first.sort(dim=-1, descending=True, stable=True)
    place = torch.where(order.values > -torch.inf, order.indices, -1)[..., :count]
    place = torch.nn.functional.pad(place, (0, count - place.shape[-1]), value=-1)
    return torch.cat([own.unsqueeze(-1), place[..., 1:]], -1)


def value_in_turn(scene: Scene) -> Array:
    """What targets are worth to `cost_utility` when it is the robot's turn [radar discs], [..., N, K]; -inf: out of
    reach."""
    xp = scene.xp
    return scene.in_turn(scene.gain, xp.where(xp.isfinite(scene.travel), value_targets(scene), -xp.inf))
