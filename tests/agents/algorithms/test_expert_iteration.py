"""Expert iteration: learns what branches say, from all of them, and goes on bit for bit where it was stopped."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tiny_training import TINY, assert_same_runs, resume, run
from worlds import room

from maexp.agents import ALGORITHMS, make_policy
from maexp.agents.algorithms.expert_iteration import ADVANTAGE, TRIED
from maexp.agents.algorithms.registry import TRAININGS
from maexp.agents.cli import main
from maexp.agents.config.model import model_config
from maexp.agents.models.actor import ALIVE, COMM, PREFERENCE, TARGETS, TARGETS_MASK
from maexp.agents.policies import POLICIES
from maexp.agents.training.branch_rollouts import BranchingActor
from maexp.agents.training.checkpoint import START, find_checkpoint, load_checkpoint
from maexp.envs import ExplorationEnv, ObservationConfig
from maexp.envs.targets.features import FEATURES

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("somewhere", "no_pictures")]  # trainings

WORDS = ("algorithm=expert_iteration", "action=targets", "algorithm.branch_horizon=1", "algorithm.candidates=3")
WORDS += ("algorithm.branch_share=0.5",)
ROW = TRAININGS["expert_iteration"]


def make_env(robots: int = 2, envs: int = 4, **others) -> ExplorationEnv:
    return ExplorationEnv(
        [room(45, 36, "rotated"), room(41, 44)],
        num_envs=envs,
        num_robots=robots,
        seed=2,
        local_steps=8,
        macro_steps=6,
        observation=ObservationConfig(pictures=False, targets=8),
        **others,
    )


def build(env: ExplorationEnv, starts_from: str = "cost_utility", **settings):
    model = replace(model_config("small"), action="targets", starts_from=starts_from)
    settings = ROW.configure(candidates=3, branch_horizon=1, **settings)
    policy, critic = make_policy(env, model), ROW.make_critic(env, model, settings)
    return policy, ROW.make_updater(ROW.make_loss(policy, critic, settings), settings), settings


def batch(decisions: int, robots: int = 2, seed: int = 0) -> TensorDict:
    """A batch [decisions, 1] in which the second candidate tried is worth its feature "size" over the own choice."""
    draw = torch.Generator().manual_seed(seed)
    features = torch.randn(decisions, 1, robots, 8, len(FEATURES), generator=draw)
    features[..., FEATURES.index("score")] = 0.0
    tried = torch.tensor([0, 3, 5], dtype=torch.int8).expand(decisions, 1, robots, 3).clone()
    size = features[..., FEATURES.index("size")]
    advantage = size[..., [0, 3, 5]] - size[..., :1]
    advantage[..., 2] = torch.nan  # was not played
    tried[::7], advantage[::7] = -1, torch.nan  # were not branched at
    return TensorDict(
        {
            TARGETS: features,
            TARGETS_MASK: torch.ones(decisions, 1, robots, 8, dtype=torch.bool),
            COMM: torch.ones(decisions, 1, robots, robots, dtype=torch.bool),
            TRIED: tried,
            ADVANTAGE: advantage,
        },
        (decisions, 1),
    )


def test_it_learns_what_branches_say():
    """A planted worth is found; what was not tried counts nothing, not even as a NaN."""
    torch.manual_seed(0)
    policy, updater, _ = build(make_env(), lr=0.01, epochs=8, minibatch_size=32)
    told = [updater.update(batch(140, seed=k)) for k in range(6)]
    assert [row["branched"] for row in told] == [120 * (k + 1) for k in range(6)]
    assert told[-1]["advantage_error"] < 0.3 * told[0]["advantage_error"]
    fresh = batch(100, seed=9)[:, 0]
    with torch.no_grad():
        chosen = policy(fresh.select(TARGETS, TARGETS_MASK, COMM))[PREFERENCE].argmax(-1, keepdim=True)
    size = fresh[TARGETS][..., FEATURES.index("size")]
    assert size.gather(-1, chosen).mean() > 0.7 * size.amax(-1).mean(), "what it chooses is what is worth most"


def test_memory_and_headroom():
    policy, updater, _ = build(make_env(), memory=50)
    told = updater.update(batch(40), batch(80, robots=3))
    assert told["branched"] == 34 + 50
    best = torch.cat([found[ADVANTAGE][..., 1].flatten() for found in (batch(40), batch(80, robots=3))])
    assert told["headroom"] == pytest.approx(best[best.isfinite()].clamp_min(0).mean().item(), abs=1e-6)
    nothing = updater.update(batch(1))  # its one decision was not branched at
    assert nothing["branched"] == 84 and math.isnan(nothing["advantage_error"])


def test_untrained_it_acts_as_the_planner_and_tries_without_touching_the_episode():
    """The same episodes with and without branches, and those of the planner that it starts from."""
    env = make_env()
    policy, _, settings = build(env)
    actor = BranchingActor(policy, env, replace(settings, branch_share=1.0))
    with torch.no_grad():
        env.set_seed(3)
        branched = env.rollout(6, actor, break_when_any_done=False)
        env.set_seed(3)
        alone = env.rollout(6, policy, break_when_any_done=False)
        env.set_seed(3)
        planner = env.rollout(6, POLICIES["cost_utility"](env), break_when_any_done=False)
    key = ("next", "info", "coverage")
    assert torch.equal(branched[key], alone[key]) and torch.equal(alone[key], planner[key])
    tried, worth = branched[TRIED], branched[ADVANTAGE]
    assert (tried[..., 1:] >= 0).any() and torch.equal(worth.isfinite(), tried >= 0)
    own = worth[..., 0][tried[..., 0] >= 0]
    assert (own == 0).all() and (worth.nan_to_num().abs() > 0).any()
    assert not (tried >= 0)[~branched[ALIVE]].any()


def test_the_share_that_is_branched_at():
    env = make_env(envs=16)
    policy, _, settings = build(env)
    torch.manual_seed(1)
    actor = BranchingActor(policy, env, replace(settings, branch_share=0.3))
    none = BranchingActor(policy, env, replace(settings, branch_share=0.01, branch_horizon=2))
    with torch.no_grad():
        assert not (env.rollout(1, none)[TRIED] >= 0).any(), "decisions at which no team is branched are played too"
    with torch.no_grad():
        seen = env.rollout(4, actor, break_when_any_done=False)
    tried = (seen[TRIED][..., 0] >= 0).any(-1)
    assert 0.15 < tried.float().mean() < 0.45


def test_resumed_is_uninterrupted():
    words = (*WORDS, "algorithm.final_lr_share=1")  # which else would fall sooner in the shorter run
    whole = run("whole", 4, *words)
    parts = resume(run("parts", 2, *words), 4)
    assert_same_runs(whole, parts)
    rows = (whole / "metrics.csv").read_text().splitlines()
    assert {"branched", "headroom", "advantage_error"} <= set(rows[0].split(","))


def test_several_team_sizes_and_scenarios():
    teams = ["num_envs=4", "num_robots=1,2", "scenario.also=[indoor_small]"]
    assert main(["train", *TINY, *WORDS, *teams, "total_frames=8", "episodes=2", "classical=[]"]) == 0


@pytest.mark.parametrize(
    "words, sentence",
    [
        (("action=regions",), "needs action=targets"),
        (("planner=direct",), "needs action=targets"),
        (("collector=processes",), "needs collector=single"),
        (("algorithm.candidates=1",), "from 2 to 24"),
        (("tuning=reference",), "Leave tuning out"),
    ],
)
def test_settings_that_do_not_go_together(words, sentence, capsys):
    assert main(["train", "algorithm=expert_iteration", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and "Traceback" not in error


def test_the_six_stay_six():
    """Those that learn from Collector batches alone: user code loops over them."""
    assert len(ALGORITHMS) == 6 and "expert_iteration" not in ALGORITHMS


def test_begins_from_another_run(capsys):
    """With its policy and its decisions, on another scenario; stopped and resumed it is as in one go."""
    first = run("first", 2, *WORDS)
    known = find_checkpoint(first)[1]
    words = (*WORDS, "scenario=indoor_small", f"algorithm.begin_from={first}", "algorithm.final_lr_share=1")
    whole = run("whole", 2, *words)
    start = load_checkpoint(whole / "checkpoints" / START)
    assert all(torch.equal(start["policy"][name], tensor) for name, tensor in known["policy"].items())
    mine, theirs = start["updater"]["memory"], known["updater"]["memory"]
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[n]["features"], theirs[n]["features"]) for n in theirs)
    assert find_checkpoint(whole)[1]["updater"]["memory"]["2"]["mask"].shape[0] > len(theirs["2"]["mask"])
    assert_same_runs(whole, resume(run("parts", 1, *words), 2))
    other_start = run("criteria", 1, *WORDS, "model.starts_from=multi_criteria")
    begun = run("begun", 1, *WORDS, f"algorithm.begin_from={other_start}")
    assert "starts_from: multi_criteria" in (begun / "config.yaml").read_text()
    wrong = [f"algorithm.begin_from={other_start}", "model.starts_from=cost_utility", "hydra.run.dir=bad"]
    assert main(["train", *TINY, *WORDS, *wrong]) == 2
    assert "starts from multi_criteria, and model.starts_from=cost_utility" in capsys.readouterr().err
    other = run("other", 1, "action=targets", "algorithm=mappo")
    for place, sentence in (("nowhere", "nowhere does not exist"), (other, "was not trained by expert iteration")):
        capsys.readouterr()
        assert main(["train", *TINY, *WORDS, f"algorithm.begin_from={place}", "hydra.run.dir=bad"]) == 2
        assert sentence in capsys.readouterr().err
