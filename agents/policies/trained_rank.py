"""What a trained policy thinks of targets, in place of a classical planner's rank: the base of a search.

A policy that may choose to go and tell the base station (`observation.radio`) is asked about targets alone.
"""

from __future__ import annotations

import torch

from maexp.agents.errors import UserError
from maexp.agents.policies.load import load_chooser
from maexp.envs import ExplorationEnv
from maexp.envs.target_view import TargetView
from maexp.envs.targets import TargetTracker, TensorScene

HIDDEN = -1e3  # what targets are worth that the policy is not shown [radar discs]: less than any


class TrainedRank:
    """Calling it with a `TensorScene` gives what each robot thinks of each target [radar discs], float32 [E, N, K].

    Args:
        word: a policy that ships, or a folder that `maexp export` wrote.
        env: of the teams; only read.
        tracker: with which the planner looks.
        setting: what messages call the word.

    Raises:
        UserError: there is no such policy, it is damaged, or it looks at radios and the env shows nothing of these.
    """

    def __init__(self, word: str, env: ExplorationEnv, tracker: TargetTracker, setting: str):
        chooser, count = load_chooser(word, setting)
        if chooser.radio and not env.settings.tells_of_radios:
            raise UserError(
                f"{setting}={word} was trained with observation.radio=true, and the env shows nothing of radios: add "
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
