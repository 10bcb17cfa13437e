"""`make_env`: from Python the env that a command has, bit for bit."""

import pytest
import torch

from maexp.agents import make_env, make_policy
from maexp.agents.cli import main
from maexp.agents.cli.evaluate import evaluate_all
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides
from maexp.agents.errors import UserError
from maexp.agents.policies.registry import find_named_policy
from maexp.agents.training import train
from maexp.envs import ExplorationEnv, RewardConfig, make_map

WORDS = [
    "scenario=maze_small",
    "num_envs=3",
    "num_robots=2",
    "scenario.local_steps=5",
    "scenario.maps=[0,3]",
    "seed=4",
    "device=cpu",
    "radar.range=8",
]


def same(first, second) -> None:
    """Two envs: the same settings, maps and episodes."""
    assert first.settings == second.settings
    assert [world.name for world in first.maps] == [world.name for world in second.maps]
    for env in (first, second):
        env.simulation.tensors["episode"].fill_(-1)  # a collector has begun an episode already
    batches = [
        env.rollout(4, find_named_policy("nearest_frontier").make(env), break_when_any_done=False)
        for env in (first, second)
    ]
    keys = [{*batch.keys(True, True)} for batch in batches]
    assert keys[0] == keys[1] and len(keys[0]) > 20
    assert all(torch.equal(batches[0][key], batches[1][key]) for key in keys[0])


def test_the_env_is_that_of_maexp_train(tmp_path):
    cfg = compose_settings("train", make_overrides("train", WORDS))
    run = train.TrainingRun.build(cfg, tmp_path, WORDS)
    (collector,) = run.experience.collectors
    env = make_env(*WORDS)
    assert env.observation_config.targets == 24 and not env.observation_config.pictures
    assert env.settings.reward != RewardConfig(), "action=targets brings reward=time"
    same(env, collector.env)
    assert make_env(*WORDS, "reward=default").settings.reward == RewardConfig()
    plain = ExplorationEnv(run.suite.train, 3, 2, seed=4)
    assert plain.settings.reward == RewardConfig() and plain.observation_config.pictures


def test_maps_of_each_kind_and_the_settings_of_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [*WORDS, "scenario.held_out=[70]", "scenario.validation=[9]"]
    names = [
        [world.name for world in make_env(*words, split=split).maps] for split in ("train", "validation", "held_out")
    ]
    assert names == [["maze_small_0", "maze_small_3"], ["maze_small_9"], ["maze_small_70"]]
    assert make_env(*words, verb="evaluate").maps[0].name == "maze_small_70"
    assert main(["train", *words, "total_frames=6", "episodes=0", "evaluate_every=0", "hydra.run.dir=run"]) == 0
    again = make_env("resume=run")
    assert (again.radar_configs[0].range, again.num_envs, again.num_robots) == (8.0, 3, 2)
    held_out = make_env("checkpoint=run", "num_envs=2", verb="evaluate")
    assert held_out.settings.reward == again.settings.reward and held_out.num_envs == 2
    cfg = compose_settings("evaluate", [*words, "policy=voronoi", "episodes=2"])
    first, second = (
        evaluate_all(cfg, env, [find_named_policy("voronoi")], tmp_path / f"kept_{place}")[0].episodes["coverage_auc"]
        for place, env in enumerate((make_env(*words, verb="evaluate"), make_env(*words, split="held_out")))
    )
    assert (first == second).all(), "episode k comes from the seed and k alone"


@pytest.mark.parametrize(
    ("words", "options", "told"),
    [
        (["radar.rang=3"], {}, "radar.rang is not a setting of maexp train"),
        (["num_robots=2,3"], {}, r"num_robots=\[2, 3\] makes several envs"),
        (["scenario.also=[maze]"], {}, r"scenario.also=\['maze'\] makes several envs"),
        (["num_envs=0"], {}, "num_envs=0 must be a whole number"),
        ([], {"verb": "view"}, "verb=view has no env of its own"),
        ([], {"split": "test"}, "split=test is unknown: choose train, validation or held_out"),
        (["resume=nowhere"], {}, "nowhere does not exist"),
        (["scenario=pointcloud"], {}, "scenario=pointcloud needs a map"),
    ],
)
def test_mistakes_are_told_in_a_sentence(words, options, told):
    with pytest.raises(UserError, match=told):
        make_env(*words, **options)


def test_the_env_of_an_evaluation_shows_what_its_policy_looks_at():
    env = make_env("policy=universal", *WORDS, verb="evaluate")
    assert env.observation_config.targets == 24 and not env.observation_config.pictures
    make_policy("universal", env)
    blind = make_env("policy=voronoi", *WORDS, verb="evaluate")
    assert blind.observation_config.targets == 0
    with pytest.raises(UserError, match=r"looks at 24 targets, and the env shows 0: .* observation\.targets=24"):
        make_policy("universal", blind)


def test_a_map_of_ones_own(tmp_path):
    make_map("maze_small", 5).save(tmp_path / "mine.npz")
    env = make_env("scenario=pointcloud", f"scenario.path={tmp_path / 'mine.npz'}", "num_envs=2", "device=cpu")
    assert env.maps[0].name == "maze_small_5" and env.batch_size == torch.Size([2])
