"""Robots that fail: when, what they do then, and that nobody knows before."""

import numpy as np
import pytest
import torch
from oracle import faults
from torchrl.envs.utils import step_mdp
from worlds import drive, play_alike, room

from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, FaultsConfig, PlannerConfig

WORLD = room(40, 22)


def make(faults: FaultsConfig | None, robots: int = 3, envs: int = 2, **settings) -> ExplorationEnv:
    settings = {"local_steps": 4, "macro_steps": 15, "num_threads": 1, "seed": 3, "success_coverage": 1.0} | settings
    return ExplorationEnv(WORLD, envs, robots, faults=faults, **settings)


@pytest.mark.parametrize("seconds", [0.8, float("inf")])
def test_who_has_failed_when(seconds):
    """The kernel against its definition, in every local step."""
    env = make(FaultsConfig(probability=0.6, at=[(1, 1.0)], duration=seconds), envs=20, robots=4)
    s, steps, count = env.simulation.tensors, 8 if seconds < 1.0 else 10**9, []

    def compare(env):
        step = max(int(s["local_step"][0]) - 1, 0)  # the one just made; a reset looks at the first
        wanted = [
            [
                faults.has_failed(3, int(s["env_id"][e]), int(s["episode"][e]), i, step, 0.6, 60, steps, at)
                for i, at in enumerate((-1, 10, -1, -1))
            ]
            for e in range(20)
        ]
        assert s["failed"].bool().tolist() == wanted
        count.append(np.sum(wanted))

    env.set_step_hook(compare)
    env.reset()
    last = drive(env, 14)[-1]["info"]
    assert torch.equal(last["failed"], s["failed"] != 0)
    assert len(count) == 57 and max(count) > 10 and 5 < np.mean(count) < 60


def test_a_failed_robot_stands_sees_and_says_nothing_and_comes_back():
    env = make(FaultsConfig(at=[(0, 1.2)], duration=2.0))
    env.reset()
    s = env.simulation.tensors

    def look():
        own = (s["seen_free"] & 1).sum(), (s["known_free"] & 1).sum(), (s["known_free"] >> 1 & 1).sum()
        return s["pose"][:, 0, [0, 1, 3]].clone(), [int(number) for number in own]

    first = drive(env, 3)[-1]
    (before, (seen, known, mate)), heard = look(), first["agents", "observation", "comm"]
    assert heard.all() and not first["info", "failed"].any() and first["agents", "observation", "alive"].all()
    down = drive(env, 5, seed=1)
    stood, (seen_now, known_now, mate_now) = look()
    assert torch.equal(stood, before) and not s["pose"][:, 0, 2].any(), "it stands where it was"
    assert (seen_now, known_now) == (seen, known) and mate_now > mate, "it sees and hears nothing, the others go on"
    for td in down:
        heard = td["agents", "observation", "comm"]
        assert not heard[:, 0, 1:].any() and not heard[:, 1:, 0].any() and heard[:, 1:, 1:].all()
        assert td["agents", "observation", "alive"].tolist() == [[False, True, True]] * 2
    after = drive(env, 2, seed=2)[-1]
    assert after["agents", "observation", "comm"].all() and not after["info", "failed"].any()
    assert look()[1][1] == look()[1][2], "told everything at once"
    assert not torch.equal(look()[0], before)


def test_it_stands_in_the_way():
    env = make(FaultsConfig(at=[(1, 0.0)]), robots=2, envs=1, planner=PlannerConfig(name="direct"), macro_steps=60)
    env.set_starts([[6.0, 10.0, 0.0], [14.0, 10.0, 0.0]])
    td = env.reset()
    while not td["info", "collided"].any() and int(env.simulation.tensors["macro_step"]) < 40:
        td["agents", "action", "control"] = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
        td = step_mdp(env.step(td), keep_other=True, exclude_reward=True)
    assert td["info", "collided"].tolist() == [[True, True]], "who drives on runs into it"
    assert env.simulation.tensors["center"][0, 1, :2].tolist() == pytest.approx([14.0, 10.0], abs=1e-5)


@pytest.mark.parametrize("name", ["hungarian", "clairvoyant", "lookahead"])
def test_nobody_foresees_a_failure(name):
    """Up to the moment, choices are those of a team in which it comes later; after it, others."""
    found = []
    for inputs in (2.0, 5.0):
        env = make(FaultsConfig(at=[(0, inputs)]), envs=1, local_steps=10)
        policy, td, played = POLICIES[name](env), env.reset(), []
        for _ in range(4):
            td = policy(td)
            played.append(
                torch.cat(
                    [td["agents", "action", "region"].float().unsqueeze(-1), td["agents", "action", "offset"]], -1
                )
            )
            td = step_mdp(env.step(td))
        found.append(torch.stack(played))
    assert torch.equal(found[0][:3], found[1][:3])
    assert not torch.equal(found[0][3], found[1][3])


@pytest.mark.parametrize("name", ["cost_utility", "hungarian", "voronoi", "lookahead"])
def test_a_mate_out_of_reach_may_have_failed(name):
    """Who does not hear a robot goes where it would go if that had not failed."""
    found = []
    for at in ([(1, 0.0)], [(1, 5.0)]):
        env = make(FaultsConfig(at=at), robots=2, envs=1, comm=CommConfig(range=5.0))
        env.set_starts([[6.0, 10.0, 0.0], [34.0, 10.0, 0.0]])
        td = POLICIES[name](env)(env.reset())
        found.append((td["agents", "action", "region"][0, 0], td["agents", "action", "offset"][0, 0]))
    assert torch.equal(found[0][0], found[1][0]) and torch.equal(found[0][1], found[1][1])


def test_failures_repeat_in_any_batch_from_a_saved_state_and_in_a_copy():
    some = FaultsConfig(probability=0.7, duration=1.5)
    small, large = make(some, envs=1), make(some, envs=3)
    teams = play_alike(small, large, 12, ("pose", "failed", "known_free"))
    assert sum(int(env.simulation.tensors["failed"].sum()) for env in teams)


def test_who_has_failed_does_not_keep_an_episode_from_its_end():
    settings = {"robots": 2, "envs": 1, "success_coverage": 0.05, "done": "everyone"}
    env = make(FaultsConfig(at=[(1, 0.0)]), **settings)
    env.set_starts([[6.0, 10.0, 0.0], [34.0, 10.0, 0.0]])
    env.reset()
    td = drive(env, 1)[-1]
    assert td["info", "worst_coverage"] < 0.05 <= td["info", "counted_coverage"] and td["terminated"].all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(probability=1.5), "faults.probability=1.5 must be a number from 0 to 1"),
        (dict(probability=True), "faults.probability=True"),
        (dict(duration=0.0), "faults.duration=0.0 must be a number, 0.1 or more"),
        (dict(at=[(3, 1.0)]), "names robot 3: there are num_robots=3, from 0 to 2"),
        (dict(at=[(-1, 1.0)]), "names robot -1"),
        (dict(at=[(1, 1.0), (1, 2.0)]), "names robot 1 twice"),
        (dict(at=[(1, -1.0)]), "the moment of robot 1=-1.0 must be 0 or more"),
        (dict(at=[1, 2.0]), r"faults.at=\[1, 2.0\] must be pairs"),
        (dict(at=[(0, 10**400)]), "the moment of robot 0=1e.400 must be 0 or more seconds, and finite"),
        (dict(at=[(10**400, 1.0)]), "names robot 1e.400: there are"),
        (dict(at=[(0, float("inf"))]), "the moment of robot 0=inf must be"),
        (dict(at=[(0, 1e300)]), "robot 0 fails after 1e.300 s, and an episode ends at 6 s"),
        (dict(at=[(0, 5.99)]), "robot 0 fails after 5.99 s, and an episode ends at 6 s: give 5.9 s, when"),
        (dict(at=[(True, 1.0)]), "names robot True"),
        (dict(at=[(0.5, 1.0)]), "names robot 0.5"),
        (dict(at=np.array([0.0, 1.0])), "must be pairs"),
        (dict(at="soon"), "faults.at='soon' must be pairs"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        make(FaultsConfig(**settings))


@pytest.mark.parametrize(
    "at",
    [
        [(np.int64(0), 3.0), (1, np.float32(0.5))],
        np.array([[0, 3], [1, 0.5]]),
        torch.tensor([[0.0, 3.0], [1.0, 0.5]]),
        (np.array([0.0, 3.0]), [1, 0.5]),
    ],
)
def test_moments_of_any_numbers_are_pythons(at):
    config = FaultsConfig(at=at).checked()
    assert config == FaultsConfig(at=((0, 3.0), (1, 0.5))) and hash(config) == hash(FaultsConfig(at=config.at))
    assert {(type(robot), type(seconds)) for robot, seconds in config.at} == {(int, float)}


def test_the_last_moment_comes():
    env = make(FaultsConfig(at=[(0, 5.94)]), envs=1)
    env.reset()
    drive(env, 15)
    assert env.simulation.tensors["failed"][0].tolist() == [1, 0, 0]
