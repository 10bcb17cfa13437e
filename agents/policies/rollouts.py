"""Rollouts: what comes of a decision in copies of a team that a rollout policy plays on with.

The copies live in a world of what the robots know, or in the true one (`maexp.envs.imagined.maps`,
`maexp.envs.imagined.branches`).
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from maexp.agents.deploy.planner.bundle import shipped_names
from maexp.agents.models.map_predictor import predict
from maexp.agents.policies.classical import CLASSICAL, FrontierPlanner, rank_by_utility
from maexp.agents.policies.pretrained import is_exported
from maexp.envs import ExplorationEnv, LookaheadConfig
from maexp.envs.imagined.branches import Branches
from maexp.envs.imagined.maps import Beliefs, Guess, guess_nearest
from maexp.envs.targets.observation import gather_points
from maexp.envs.targets.tracker import TargetTracker

ROLLOUT_POLICY = "lookahead.rollout_policy"
BRANCHES = 256  # teams' branches that are played at once, at most


GUESSES: dict[str, Guess | None] = {"free": None, "nearest": guess_nearest, "predicted": predict}
"""What stands where nobody has looked: the values of `lookahead.unknown`."""


def branches_of(env: ExplorationEnv, config: LookaheadConfig, tracker: TargetTracker, true_world: bool) -> Branches:
    """Room for branches of an env's teams, in worlds of what their robots know or in the true one; the env is only
    read."""
    teams = max(1, min(env.num_envs, BRANCHES // config.candidates))
    if true_world:
        return Branches(env, teams, config.candidates, config.local_steps)
    return Beliefs(env, teams, config.candidates, tracker.nav, GUESSES[config.unknown], config.local_steps)


class Rollouts:
    """Branches of teams, and the policy that plays on in them.

    Args:
        branches: where they are played.
        config: how.
        tracker: of the targets of the env that branches start from, up to date when they are played.

    Raises:
        ValueError: the rollout policy is none.
    """

    def __init__(self, branches: Branches, config: LookaheadConfig, tracker: TargetTracker):
        check_rollout_policy(config)
        self.branches, self.config, self.tracker = branches, config, tracker
        self.follower = None
        if config.horizon > 1:
            self.follower = FrontierPlanner(branches.env, CLASSICAL.get(config.rollout_policy, rank_by_utility))
            branches.attach(self.follower.tracker)

    def goals(self, block: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor, waits: torch.Tensor) -> torch.Tensor:
        """The goals that lead to candidates, float32 [E, N, K, 2] [m].

        Args:
            block, cell: int64 [E, N, K], as for `TargetTracker.take`.
            toward: float32 [E, N, K, 2] [m].
            waits: bool [E, N], robots whose first candidate is to wait.
        """
        goals = [
            self.tracker.goals(block[..., k], cell[..., k], toward[..., k, :], waits if k == 0 else None)
            for k in range(block.shape[-1])
        ]
        return torch.stack(goals, 2)

    def look(self, teams: torch.Tensor) -> torch.Tensor:
        """Take up what some teams know now, and that no choice of theirs has been played: float32 [T], NaN.

        The branch in which nobody changes a choice need not be played for every robot: its worth is handed on from one
        to the next.
        """
        self.branches.look(teams)
        return torch.full((len(teams),), torch.nan, dtype=torch.float32, device=teams.device)

    def weigh(
        self, robot: int, mine: dict[str, torch.Tensor], chosen: torch.Tensor, wanted: torch.Tensor, kept: torch.Tensor
    ) -> torch.Tensor:
        """What a robot's candidates are worth while the others keep to theirs, float32 [T, K] [radar discs].

        Args:
            robot: its number.
            mine: what robots are offered: "goal" float32 [T, N, K, 2] [m] and "block" int64 [T, N, K], as of
                `LookaheadPlanner`.
            chosen: int64 [T, N], the candidates of all robots; the robot's own one is the first.
            wanted: bool [T, K], candidates that are tried; what is returned for the others means nothing.
            kept: float32 [T], what the first is worth as far as that is known, else NaN (`keep`).
        """
        unknown, wanted = kept.isnan(), wanted.clone()
        wanted[:, 0] &= unknown
        tried = chosen.unsqueeze(1).repeat(1, self.config.candidates, 1)
        tried[:, :, robot] = torch.arange(self.config.candidates, device=chosen.device)
        score = self._play(robot, mine, tried, wanted)
        score[:, 0] = torch.where(unknown, score[:, 0], kept)
        return score

    def keep(self, kept: torch.Tensor, score: torch.Tensor, wanted: torch.Tensor, best: torch.Tensor) -> torch.Tensor:
        """What the choices made so far are worth after a robot's, for the next one; NaN where robots decide in worlds
        of their own, or where none has been played yet.

        Args:
            score, wanted: of `weigh`, float32 and bool [T, K].
            best: int64 [T], the candidate that the robot takes.
        """
        if not self.branches.one_world:
            return kept
        best = best.unsqueeze(-1)
        return torch.where(wanted.gather(1, best).squeeze(-1), score.gather(1, best).squeeze(-1), kept)

    def _play(
        self, robot: int, mine: dict[str, torch.Tensor], tried: torch.Tensor, wanted: torch.Tensor
    ) -> torch.Tensor:
        """What the branches wanted, bool [T, K], are worth, in which robots take the candidates tried, int64 [T, K, N].

        Returns:
            float32 [T, K], radar discs.
        """
        env, count = self.branches.env, wanted.numel()
        state = env.simulation.tensors
        self.branches.branch(robot, wanted)
        names = ("covered", "covered_sum", "local_step", "collided")
        before = {name: state[name].clone() for name in names}
        state["wanted"][:count] = pick_tried(mine["goal"], tried)
        if self.follower is not None:
            self._brief(pick_tried(mine["block"], tried))
        self._step()
        for _ in range(1, self.config.horizon):
            state["wanted"].copy_(self.follower.goals())
            self._step()
        return self._score(before)[:count].view(wanted.shape)

    def _score(self, before: dict[str, torch.Tensor]) -> torch.Tensor:
        """What has been covered since on average over the horizon and what comes after, less robots lost: [T * K]."""
        state, steps = self.branches.env.simulation.tensors, self.config.horizon * self.branches.env.local_steps
        gained, played, lost = (state[name] - before[name] for name in ("covered", "local_step", "collided"))
        over_time = state["covered_sum"] - before["covered_sum"] - played * before["covered"].long()
        over_time = over_time + (steps - played) * gained  # of an episode that has ended
        area = (over_time.float() / steps + self.config.rest * gained.float()) / self.branches.disc()
        return area - self.config.loss * lost.sum(-1).float()

    def _brief(self, block: torch.Tensor) -> None:
        """Let the rollout policy remember what was given up, and where robots go now."""
        theirs, ours = self.tracker.state, self.follower.tracker.state
        rows = self.branches.listed.repeat_interleave(self.config.candidates)
        count = len(rows)
        ours["dwell"][:count] = self.branches.spread_blocks(theirs["dwell"])
        for name in ("stood", "counted", "home"):
            ours[name][:count] = theirs[name][rows]
        named = self.branches.blocks(block.clamp_min(0).view(len(self.branches.listed), -1)).view(block.shape)
        ours["chosen"][:count] = torch.where(block >= 0, named, -1).unsqueeze(-1)

    def _step(self) -> None:
        """One decision's time in all branches."""
        env, state = self.branches.env, self.branches.env.simulation.tensors
        running = state["active"].clone()
        env.simulation.set_goals()
        env.simulation.step(0, env.local_steps)
        env._raise_errors()
        state["macro_step"] += running


def search_in_turn(
    rollouts: Rollouts,
    teams: torch.Tensor,
    mine: dict[str, torch.Tensor],
    distinct: bool,
    go_on: Callable[[], bool] = lambda: True,
) -> torch.Tensor:
    """Which candidate each robot of some teams takes, int64 [T, N], robots in turn; the own choice is number 0.

    Args:
        teams: int64 [T], which of those that `rollouts` plays.
        mine: what they are offered, as `Rollouts.weigh` takes it, and "point": float32 [T, N, K, 2] [m], "value":
            float32 [T, N, K], more than the own choice [radar discs], "wanted": bool [T, N, K], "body": float32 [T, N]
            [m], "hears": bool [T, N, N].
        distinct: no robot takes what one before it has chosen.
        go_on: asked before each robot's turn; after a no all others keep to their own choice.
    """
    config, kept = rollouts.config, rollouts.look(teams)
    chosen = torch.zeros(mine["value"].shape[:2], dtype=torch.int64, device=teams.device)
    for robot in range(chosen.shape[1]):
        if not go_on():
            break
        wanted = mine["wanted"][:, robot].clone()
        if distinct and robot:
            wanted &= ~_taken(robot, mine, chosen)
        if not bool(wanted[:, 1:].any()):
            continue
        worth = rollouts.weigh(robot, mine, chosen, wanted, kept)
        score = torch.where(wanted, worth + config.prior * mine["value"][:, robot], -torch.inf)
        best = score.argmax(-1)
        takes = score.gather(1, best.unsqueeze(-1)).squeeze(-1) - score[:, 0] > config.margin
        chosen[:, robot] = torch.where(takes, best, 0)
        kept = rollouts.keep(kept, worth, wanted, chosen[:, robot])
    return chosen


def _taken(robot: int, mine: dict[str, torch.Tensor], chosen: torch.Tensor) -> torch.Tensor:
    """Which of a robot's candidates leave no room beside what those before it have chosen, bool [T, K]."""
    where = gather_points(mine["point"], chosen.unsqueeze(-1)).squeeze(2)[:, :robot]  # [T, robot, 2]
    gap = (mine["point"][:, robot].unsqueeze(2) - where.unsqueeze(1)).norm(dim=-1)  # [T, K, robot]
    apart = (mine["body"][:, robot : robot + 1] + mine["body"][:, :robot]).unsqueeze(1)
    goes = mine["block"].gather(2, chosen.unsqueeze(-1)).squeeze(-1)[:, :robot] >= 0
    counts = goes & mine["hears"][:, robot, :robot] & mine["wanted"][:, :robot, 0]
    return ((gap < apart) & counts.unsqueeze(1)).any(-1)


def pick_tried(offered: torch.Tensor, tried: torch.Tensor) -> torch.Tensor:
    """What branches try, [T * K, N, ...], of what robots are offered, [T, N, K, ...]; `tried` int64 [T, K, N]."""
    rows, robots = torch.arange(len(tried), device=tried.device), torch.arange(tried.shape[2], device=tried.device)
    return offered[rows.view(-1, 1, 1), robots, tried].flatten(0, 1)


def check_rollout_policy(config: LookaheadConfig) -> None:
    """Raise ValueError where the rollout policy is none."""
    spec = config.rollout_policy
    if spec not in CLASSICAL and not is_exported(spec):
        raise ValueError(
            f"{ROLLOUT_POLICY}={spec!r} is unknown: choose one of {', '.join(CLASSICAL)}, or a trained policy: "
            f"{', '.join(shipped_names())}, or a folder that maexp export wrote"
        )
