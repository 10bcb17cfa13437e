"""Branches that are worth what the base station, or the robot that knows least, learns: `algorithm.learn_from`.

They are played in the true world with its radios, and with what robots do to tell others (`maexp.envs.comm.strategy`).
Where only chance tells the base station (`comm.strategy=opportunistic`), robots report to it after the first decision
as with
`return_to_base`: else nothing that is seen in a branch would ever be worth anything.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import step_mdp

from maexp.agents.algorithms.expert_iteration import ADVANTAGE, TRIED
from maexp.agents.config.algorithms import ExpertSettings
from maexp.agents.errors import UserError
from maexp.agents.files import write_file, write_text
from maexp.agents.models.actor import PREFERENCE, TARGETS, TARGETS_MASK
from maexp.agents.models.distributions import ACTION
from maexp.agents.models.target_chooser import NEVER, SCORE, TRAVEL
from maexp.agents.policies.lookahead import list_candidates
from maexp.agents.policies.rollouts import Rollouts, branches_of, pick_tried
from maexp.envs import ExplorationEnv, LookaheadConfig, ObservationConfig, PlannerConfig, make_map
from maexp.envs.comm.strategy import Strategy
from maexp.envs.config_fields import check_settings, setting
from maexp.envs.imagined.branches import Branches
from maexp.envs.scenarios import GENERATED, cut_last_fifth, find_scenario, split
from maexp.envs.targets.observation import gather_points
from maexp.envs.targets.tracker import TargetTracker

SHOWN = 24  # candidates that a policy sees
DEPARTURE = 0.3  # random part of what a departing robot thinks of candidates [radar discs]


@dataclass(frozen=True)
class BranchingConfig:
    """Which branches are played."""

    out: str = setting("branches", "folder for the files")
    scenarios: list[str] = setting(
        list(GENERATED), "whose training maps are played; validation and held-out maps never are"
    )
    robots: int = setting(3, "of a team", low=1, high=64)
    teams: int = setting(24, "played at once, each an episode a round", low=1, high=1024)
    rounds: int = setting(2, "files of each scenario", low=1)
    every: int = setting(2, "decisions from one that is branched at to the next", low=1)
    candidates: int = setting(5, "that a robot tries, its own choice among them", low=2, high=24)
    horizon: int = setting(4, "decisions that are played in a branch", low=1, high=100)
    departures: float = setting(
        0.3, "share of the episodes' decisions in which a team departs from what `cost_utility` chooses", low=0, high=1
    )
    seed: int = setting(0, "of starts, departures and what is tried", low=0)


class BranchRollouts:
    """Teams that see targets, and what their candidates are worth.

    Args:
        env: of the teams; shows targets.
        candidates, horizon: as in `BranchingConfig`.
        seed: of what is tried; None: torch's own generator draws.
        learn_from: as in `ExpertSettings`.
    """

    def __init__(
        self, env: ExplorationEnv, candidates: int, horizon: int, seed: int | None = None, learn_from: str = "union"
    ):
        self.env, self.view = env, env.target_view
        config = replace(env.lookahead_config, candidates=candidates, horizon=horizon)
        branches = branches_of(env, config, self.view.tracker, true_world=True)
        if learn_from == "union":
            self.rollouts = Rollouts(branches, config, self.view.tracker)
        else:
            self.rollouts = ToldRollouts(env, branches, config, self.view.tracker, learn_from)
        self.draw = None if seed is None else torch.Generator().manual_seed(seed)

    def try_candidates(
        self, features: torch.Tensor, preference: torch.Tensor, among: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What candidates of every team are worth beside the choice by `preference`.

        Args:
            features: float32 [E, N, M, F], what the teams see now.
            preference: float32 [E, N, M], as for `TargetView.take`.
            among: bool [E], teams that try; None: all.

        Returns:
            int64 [E, N, K], the candidates tried, the own choice first, -1 = none; float32 [E, N, K], how much more
            than the own choice they were worth [radar discs], NaN where they were not played.
        """
        s, tracker, count = self.view.state, self.view.tracker, self.view.count
        if self.env.strategy is not None:
            self.env.strategy.look()
        liked = torch.where(s["mask"], preference[..., :count], -torch.inf)
        tells = torch.zeros_like(s["has_last"])
        if self.view.contacts is not None:
            tells = self.env.strategy.can_tell() & (preference[..., count] > liked.amax(-1))
            liked = liked.masked_fill(tells.unsqueeze(-1), -torch.inf)  # who tells leaves the targets to others
        own, waits = tracker.share(liked, s["way"], s["point"])
        own = torch.where(tells, count, own)
        index = list_candidates(self.rank_for_trial(features), own, self.rollouts.config.candidates)
        there, mine = index >= 0, self._offer(index, waits)
        active = self.env.simulation.tensors["active"] != 0
        active = active if among is None else active & among
        there = there & active.view(-1, 1, 1)
        there[..., 1:] &= (index[..., 1:] != own.unsqueeze(-1)) & there[..., :1]
        if isinstance(self.rollouts, ToldRollouts) and self.env.strategy is not None:
            there[..., 1:] &= ~self.env.strategy.busy().unsqueeze(-1)  # whatever they choose is not what they do
        worth = torch.full(index.shape, torch.nan, dtype=torch.float32)
        teams = active.nonzero().squeeze(-1)
        for some in teams.split(self.rollouts.branches.teams) if len(teams) else ():
            worth[some] = self._weigh(some, {name: array[some] for name, array in (mine | {"wanted": there}).items()})
        return torch.where(there, index, -1), worth - worth[..., :1]

    def _offer(self, index: torch.Tensor, waits: torch.Tensor) -> dict[str, torch.Tensor]:
        """What each robot may try, as of `Rollouts.weigh`; and "tells" bool [E, N, K], which of it is to go and tell
        the base station."""
        s, count = self.view.state, self.view.count
        place, frontier = index.clamp(0, count - 1), (index >= 0) & (index < count)
        block = torch.where(frontier, s["block"].gather(2, place), -1)
        toward = gather_points(s["toward"], place)
        goal = self.rollouts.goals(block, s["cell"].gather(2, place), toward, waits)
        tells = index == count
        if self.view.contacts is not None:
            goal = torch.where(tells.unsqueeze(-1), self.view.contacts.goals().unsqueeze(2), goal)
        return {"goal": goal, "block": block, "tells": tells}

    def rank_for_trial(self, features: torch.Tensor) -> torch.Tensor:
        """What each robot tries first, float32 [E, N, M]: the best of a classical score whose weight of the way is
        drawn for every robot, so that near candidates are tried as well as those where there is much to see. To tell
        the base station is always tried."""
        mask = self.view.state["mask"]
        beta = torch.empty(mask.shape[:2], dtype=torch.float32).uniform_(0.0, 0.3, generator=self.draw).unsqueeze(-1)
        value = features[..., SCORE] - beta * features[..., TRAVEL].expm1()
        if self.view.contacts is None:
            return torch.where(mask, value, -torch.inf)
        tells = torch.where(self.env.strategy.can_tell(), -NEVER, -torch.inf).unsqueeze(-1)
        return torch.cat([torch.where(mask, value[..., :-1], -torch.inf), tells], -1)

    def _weigh(self, teams: torch.Tensor, mine: dict[str, torch.Tensor]) -> torch.Tensor:
        """What each robot's candidates are worth while the others keep to their own choices, float32 [T, N, K]."""
        kept, found = self.rollouts.look(teams), []
        chosen = torch.zeros(mine["block"].shape[:2], dtype=torch.int64)
        for robot in range(chosen.shape[1]):
            wanted = mine["wanted"][:, robot]
            worth = self.rollouts.weigh(robot, mine, chosen, wanted, kept)
            kept = self.rollouts.keep(kept, worth, wanted, chosen[:, robot])
            found.append(torch.where(wanted, worth, torch.nan))
        return torch.stack(found, 1)


class BranchingActor(TensorDictModuleBase):
    """A policy whose choices are tried in branches while it acts: it writes `TRIED` and `ADVANTAGE` too.

    Args:
        policy: chooses among targets; its likeliest choice is the own one that others are compared with.
        env: in which it acts.
        settings: how it is branched.
    """

    def __init__(self, policy: TensorDictModuleBase, env: ExplorationEnv, settings: ExpertSettings):
        super().__init__()
        self.policy, self.share = policy, settings.at_pace().branch_share
        horizon, learn_from = settings.branch_horizon, settings.learn_from
        self.rollouts = BranchRollouts(env, settings.candidates, horizon, learn_from=learn_from)
        self.in_keys, self.out_keys = policy.in_keys, [*policy.out_keys, TRIED, ADVANTAGE]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = self.policy(tensordict)
        features = tensordict[TARGETS]
        among = torch.rand(len(features), dtype=torch.float32, device=features.device) < self.share
        tried, worth = self.rollouts.try_candidates(features, tensordict[PREFERENCE], among)
        tensordict[TRIED], tensordict[ADVANTAGE] = tried.to(torch.int8), worth
        return tensordict


@torch.no_grad()
def play_round(env: ExplorationEnv, rollouts: BranchRollouts, config: BranchingConfig) -> dict[str, np.ndarray]:
    """An episode of every team; what was seen and found at the decisions that were branched at.

    Returns:
        "features" float16 [D, N, M, F], "mask" bool [D, N, M], "index" int8 [D, N, K], "advantage" float32 [D, N, K],
        "team" int16 [D], "map" int16 [D] (of the env's), "decision" int16 [D]; D decisions of a team.

    Raises:
        UserError: no decision was branched at.
    """
    found, td, draw = [], env.reset(), rollouts.draw
    running = torch.ones(env.num_envs, dtype=torch.bool)
    phase = int(torch.randint(config.every, (1,), generator=draw))
    share = 2.0 * config.departures * torch.rand(env.num_envs, 1, generator=draw, dtype=torch.float32)
    for step in range(env.macro_steps):
        features, mask = td[TARGETS], td[TARGETS_MASK]
        preference = torch.where(mask, features[..., SCORE], NEVER)
        if step % config.every == phase:
            found += [describe(env, step, features, mask, *rollouts.try_candidates(features, preference))]
        leaves = torch.rand(mask.shape[:2], generator=draw, dtype=torch.float32) < share
        noise = torch.rand(mask.shape, generator=draw, dtype=torch.float32)
        other = rollouts.rank_for_trial(features) + DEPARTURE * noise
        preference = torch.where(leaves.unsqueeze(-1), other, preference).clamp_min(NEVER)
        td[(*ACTION, "preference")], td[(*ACTION, "target")] = preference, preference.argmax(-1)
        td = env.step(td)
        running = running & ~td["next", "done"].squeeze(-1)
        if not bool(running.any()):
            break
        td = step_mdp(td)
    if not found:
        raise UserError(f"every={config.every}: the episodes were over before any decision was branched at: lower it.")
    return {name: np.concatenate([batch[name] for batch in found]) for name in found[0]}


def describe(
    env: ExplorationEnv,
    step: int,
    features: torch.Tensor,
    mask: torch.Tensor,
    index: torch.Tensor,
    advantage: torch.Tensor,
) -> dict[str, np.ndarray]:
    """The teams that had anything to choose at a decision, as `play_round` returns them."""
    teams = (index[..., 1:] >= 0).flatten(1).any(1).nonzero().squeeze(-1)
    columns = {
        "features": features.half(),
        "mask": mask,
        "index": index.to(torch.int8),
        "advantage": advantage,
        "map": env.simulation.tensors["map_id"].to(torch.int16),
    }
    return {name: column[teams].numpy() for name, column in columns.items()} | {
        "team": teams.to(torch.int16).numpy(),
        "decision": np.full(len(teams), step, np.int16),
    }


def training_maps(scenario: str) -> list[int]:
    """Indices of the maps that are trained on."""
    return list(cut_last_fifth(split(scenario)[0])[0])


def write_branches(config: BranchingConfig) -> None:
    """Play what is missing and write it, round by round; the costs go to `costs.csv`."""
    folder = Path(config.out)
    for turn in range(config.rounds):
        for scenario in config.scenarios:
            place = folder / f"branches_{scenario}_{turn}.npz"
            if not place.exists():
                _write_round(config, scenario, turn, place)


def _write_round(config: BranchingConfig, scenario: str, turn: int, place: Path) -> None:
    begin, seed = time.perf_counter(), (config.seed << 12) + turn
    rng = np.random.default_rng([seed, *scenario.encode()])
    indices = training_maps(scenario)
    maps = [make_map(scenario, int(k)) for k in rng.choice(indices, min(config.teams, len(indices)), replace=False)]
    env = ExplorationEnv(
        maps,
        config.teams,
        config.robots,
        seed=seed,
        num_threads=1,
        planner=PlannerConfig(name="wavefront"),
        observation=ObservationConfig(pictures=False, targets=SHOWN),
    )
    found = play_round(env, BranchRollouts(env, config.candidates, config.horizon, seed), config)
    write_file(place, lambda file: np.savez_compressed(file, names=np.array([world.name for world in maps]), **found))
    tried, seconds = int(np.isfinite(found["advantage"]).sum()), time.perf_counter() - begin
    log = place.parent / "costs.csv"
    lines = log.read_text() if log.exists() else "scenario,round,decisions,branches,seconds\n"
    write_text(log, f"{lines}{scenario},{turn},{len(found['team'])},{tried},{seconds:.1f}\n")
    print(f"{place.name}: {len(found['team'])} decisions, {tried} branches, {seconds:.0f} s", flush=True)


def read_config(words: list[str]) -> BranchingConfig:
    """The settings given as `name=value`.

    Raises:
        UserError: a name or value that is none.
    """
    try:
        given = OmegaConf.merge(OmegaConf.structured(BranchingConfig), OmegaConf.from_dotlist(words))
        config = BranchingConfig(**{field.name: given[field.name] for field in fields(BranchingConfig)})
        check_settings(config, "branching")
        for name in config.scenarios:
            if find_scenario(name).build is None:
                raise ValueError(f"scenarios={name} has no training maps: choose among {', '.join(GENERATED)}.")
    except (OmegaConfBaseException, ValueError) as error:
        raise UserError(" ".join(str(error).split())) from error
    return config


def main(words: list[str]) -> int:
    """The command; see the head of this file."""
    try:
        write_branches(read_config(words))
    except UserError as error:
        print(f"branching: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))


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
