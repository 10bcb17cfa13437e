"""Branches that are worth what the base station, or the robot that knows least, learns: `algorithm.learn_from`.

They are played in the true world with its radios, and with what robots do to tell others (`maexp.envs.strategy`). Where
only chance tells the base station (`comm.strategy=opportunistic`), robots report to it after the first decision as with
`return_to_base`: else nothing that is seen in a branch would ever be worth anything.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from maexp.agents.policies.rollouts import Rollouts, pick_tried
from maexp.envs import ExplorationEnv, LookaheadConfig
from maexp.envs.branches import Branches
from maexp.envs.strategy import Strategy
from maexp.envs.targets import TargetTracker

SETTING = "algorithm.learn_from"


class ToldRollouts(Rollouts):
    """Rollouts in the true world that count what others are told.

    A branch ends where its episode does. What is known at its end counts on as `lookahead.rest` says, for as long as
    the episode goes on.

    Args:
        env: that branches start from.
        branches: in its true world.
        config, tracker: as of `Rollouts`.
        learner: "base", or "everyone": the robot that knows least.

    Raises:
        ValueError: there are no radios that part robots, no base station, or nothing ever sends robots there.
    """

    def __init__(
        self, env: ExplorationEnv, branches: Branches, config: LookaheadConfig, tracker: TargetTracker, learner: str
    ):
        _check(env, learner)
        super().__init__(branches, config, tracker)
        self.origin, self.learner, self.horizon = env, learner, config.horizon
        comm = env.comm_config
        self.begins_as = comm.strategy
        reports = comm.strategy == "opportunistic" and comm.has_base
        self.goes_on_as = "return_to_base" if reports else comm.strategy
        self.strategy = None if env.strategy is None else Strategy(self.branches.env, self.goes_on_as)
        self.branches.env.strategy = self.strategy  # whoever it sends somewhere has not tried its target

    def _play(
        self, robot: int, mine: dict[str, torch.Tensor], tried: torch.Tensor, wanted: torch.Tensor
    ) -> torch.Tensor:
        state = self.origin.simulation.tensors
        left = self.origin.macro_steps - int(state["macro_step"][self.branches.listed].min())
        self.config = replace(self.config, horizon=max(1, min(self.horizon, left)))
        self.tells = torch.zeros_like(self.branches.env.simulation.tensors["collided"], dtype=torch.bool)
        if "tells" in mine:
            self.tells[: wanted.numel()] = pick_tried(mine["tells"], tried)
        self.begins = True
        return super()._play(robot, mine, tried, wanted)

    def _step(self) -> None:
        env, state = self.branches.env, self.branches.env.simulation.tensors
        if self.begins:
            self._take_up()
        if self.strategy is not None:
            self.strategy.name = self.begins_as if self.begins else self.goes_on_as
            tells = self.tells if self.begins else None
            state["wanted"].copy_(self.strategy.direct(state["wanted"], tells))
        self.begins = False
        state["active"] *= (state["macro_step"] < env.macro_steps).int()
        super()._step()

    def _take_up(self) -> None:
        """What robots of the branches remember, and what is known before anything is played."""
        state = self.branches.env.simulation.tensors
        rows = self.branches.listed.repeat_interleave(self.config.candidates)
        state["path_length"][: len(rows)] = self.origin.simulation.tensors["path_length"][rows]
        if self.strategy is not None:
            for name, theirs in self.origin.strategy.state.items():
                self.strategy.state[name][: len(rows)] = theirs[rows]
        self.known, self.known_sum = (count.clone() for count in self._count())
        self.left = (self.origin.macro_steps - state["macro_step"]) * self.origin.local_steps

    def _count(self) -> tuple[torch.Tensor, torch.Tensor]:
        """What the learner knows, and the sum of that over the episode, [branches]."""
        state, robots = self.branches.env.simulation.tensors, self.origin.num_robots
        if self.learner == "base":
            return state["known_weight"][:, robots], state["base_sum"]
        return state["known_weight"][:, :robots].amin(1), state["worst_sum"]

    def _score(self, before: dict[str, torch.Tensor]) -> torch.Tensor:
        """What the learner has learned since, on average over the horizon, and after it as far as the episode goes on;
        less robots lost: [T * K]."""
        state, steps = self.branches.env.simulation.tensors, self.horizon * self.branches.env.local_steps
        known, known_sum = self._count()
        played, lost = (state[name] - before[name] for name in ("local_step", "collided"))
        gained = (known - self.known).long()
        over_time = known_sum - self.known_sum - played * self.known.long()
        over_time = over_time + (self.left.clamp(max=steps) - played) * gained  # of an episode that has ended
        after = ((self.left - steps) / steps).clamp(0.0, 1.0)
        area = (over_time / steps + self.config.rest * after * gained) / self.branches.disc()
        return (area - self.config.loss * lost.sum(-1)).float()


def _check(env: ExplorationEnv, learner: str) -> None:
    comm = env.comm_config
    if not comm.limited:
        raise ValueError(f"{SETTING}={learner} is about radios that do not reach: add comm=ir2, comm.range or the like")
    if learner == "base" and not comm.has_base:
        raise ValueError(f"{SETTING}=base needs a base station: add comm.base_station=true")
    if learner == "base" and env.strategy is None:
        raise ValueError(
            f"{SETTING}=base: nothing sends robots to the base station with comm.strategy=opportunistic; add "
            "observation.radio=true, so that they may choose to go there, or comm.strategy=courier"
        )
