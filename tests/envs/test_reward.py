"""The reward over an episode: what an early end costs, and that no robot gains by crashing."""

import numpy as np
import pytest
import torch
from oracle import team
from worlds import inputs, room

from maexp.envs import ExplorationEnv, PlannerConfig, RadarConfig, RewardConfig, RobotConfig, make_map
from maexp.envs.specs import REWARD_TERMS

DIRECT = PlannerConfig(name="direct")
V = 60.0 / 7000.0
GAMMA = 0.99


def drive(env, td, control):
    """One macro step with controls [E, N, 2]."""
    td["agents", "action", "control"] = control
    return env.step(td)["next"]


@pytest.mark.parametrize("charge, unfinished", [(True, 0.0), (False, 0.0), (True, 0.4)])
def test_the_rest_is_charged_once_when_the_last_robot_has_collided(charge, unfinished):
    """Every local step of teams at full throttle, until all have hit something, against the oracle."""
    maps = [room(17, 11, "rotated", 1), room(13, 14, "mixed", 2)]
    reward = RewardConfig(overlap=0.01, charge_rest=charge, unfinished=unfinished)
    env = ExplorationEnv(
        maps,
        4,
        2,
        seed=2,
        planner=DIRECT,
        reward=reward,
        radar=RadarConfig(range=4.0),
        num_threads=1,
        robot=RobotConfig(collision_threshold=0.6),
        local_steps=1,
        macro_steps=90,
        success_coverage=1.0,
    )
    control = torch.tensor([1.0, 0.0]).expand(4, 2, 2)
    td = env.reset()
    before, half, ends = [inputs(env, e) for e in range(4)], 0, 0
    for _ in range(80):
        td = drive(env, td, control.clone())
        after = [inputs(env, e) for e in range(4)]
        for old, now in zip(before, after, strict=True):
            if not old.active:
                assert not now.terms.any(), "a team that has ended pays nothing more"
                continue
            left = team.steps_charged(now.collided, now.coverage, now.step, 90, 1.0) if charge else 0
            weights = team.area_weights(now.map.free_spacing)
            new, overlap = team.counts(old.seen_free, now.visible, weights)
            want = team.reward_terms(
                new,
                overlap,
                old.coverage,
                False,
                now.crashed != 0,
                weights.sum(),
                coverage_now=now.coverage,
                charged=left,
                unfinished=unfinished,
            )
            for name, values in want.items():  # the terms that the oracle knows
                term = now.terms[:, REWARD_TERMS.index(name)]
                np.testing.assert_allclose(term, values, rtol=2e-5, atol=1e-6, err_msg=name)
            half += 0 < now.collided.sum() < 2
            ends += bool(now.collided.all())
            assert now.collided.all() == (left > 0) or not charge
        before = after
    assert ends == 4 and half > 4


def test_a_team_that_is_done_pays_nothing_for_the_rest():
    """Success in the very step in which the last robot has collided: this step costs, no other."""
    env = ExplorationEnv(make_map("maze_small", 0), 2, 2, planner=DIRECT, success_coverage=0.1, num_threads=1)
    before = env.reset()
    env.simulation.tensors["collided"].fill_(1)
    td = drive(env, before, torch.zeros(2, 2, 2))
    assert td["terminated"].all() and td["info", "collided"].all()
    assert (td["info", "local_steps"] == 1).all() and (td["info", "coverage"] < 0.9).all()
    want = (-V * (1.0 - td["info", "coverage"])).expand(2, 2)  # of before the step; nobody moved
    torch.testing.assert_close(td["agents", "reward"][..., 0], want, rtol=1e-4, atol=0)


@pytest.mark.parametrize("unfinished", [0.0, 0.5])
def test_gains_pay_at_once_what_time_would_have_cost(unfinished):
    """The same episodes, also those that end early, by success or by collisions: the sums differ by a constant."""
    earned, starts, ends = {}, {}, {}
    for kind in ("uncovered", "gained"):
        env = ExplorationEnv(
            [make_map("maze_small", 0), make_map("maze_small", 1)],
            8,
            2,
            planner=DIRECT,
            local_steps=10,
            macro_steps=9,
            reward=RewardConfig(explore=0.0, unfinished=unfinished, time_on=kind),
            success_coverage=0.3,
            num_threads=1,
            seed=5,
            robot=RobotConfig(collision_threshold=0.6),
        )
        time = REWARD_TERMS.index("time")
        env.set_seed(3)
        td, total = env.reset(), torch.zeros(8, 2)
        starts[kind] = torch.tensor([[inputs(env, e).coverage] for e in range(8)])
        generator = torch.Generator().manual_seed(4)
        for _ in range(9):
            control = torch.rand(8, 2, 2, generator=generator) * torch.tensor([1.0, 0.6]) - torch.tensor([0.0, 0.3])
            td = drive(env, td, control)
            total += env.simulation.tensors["terms"][:, :, time]
        earned[kind], ends[kind] = total, (td["info", "coverage"], td["info", "collided"], td["info", "local_steps"])
    for uncovered, gained in zip(ends["uncovered"], ends["gained"], strict=True):
        assert torch.equal(uncovered, gained)
    coverage, collided, steps = ends["gained"]
    assert (coverage >= 0.3).any() and (coverage < 0.3).any() and (steps < 90).any(), "some are done early, some never"
    constant = V * 90 * (1.0 - starts["gained"] + unfinished)
    torch.testing.assert_close(earned["gained"], earned["uncovered"] + constant, rtol=1e-4, atol=1e-4)


def test_gains_by_the_oracle():
    env = ExplorationEnv(
        [room(17, 11, "rotated", 1), room(13, 14, "mixed", 2)],
        4,
        2,
        seed=2,
        planner=DIRECT,
        num_threads=1,
        reward=RewardConfig(explore=0.0, unfinished=0.4, time_on="gained"),
        radar=RadarConfig(range=4.0),
        local_steps=1,
        macro_steps=60,
        success_coverage=0.9,
    )
    td, time, paid = env.reset(), REWARD_TERMS.index("time"), 0
    before = [inputs(env, e) for e in range(4)]
    for _ in range(50):
        td = drive(env, td, torch.tensor([0.5, 0.1]).expand(4, 2, 2).clone())
        after = [inputs(env, e) for e in range(4)]
        for old, now in zip(before, after, strict=True):
            if old.active:
                done = old.coverage < 0.9 <= now.coverage
                want = team.reward_terms(
                    np.zeros(2),
                    np.zeros(2),
                    old.coverage,
                    done,
                    np.zeros(2),
                    1.0,
                    coverage_now=now.coverage,
                    unfinished=0.4,
                    gained_for=60 - now.step,
                )["time"]
                np.testing.assert_allclose(now.terms[:, time], want, rtol=2e-4, atol=1e-5)
                paid += want[0] > 0
        before = after
    assert paid > 20


def test_gains_need_the_rest_to_be_charged():
    with pytest.raises(ValueError, match="reward.charge_rest=False with reward.time_on='gained'"):
        ExplorationEnv(make_map("maze_small", 0), 1, 1, reward=RewardConfig(time_on="gained", charge_rest=False))


def branch(env, state, plan, robot: int, crash: bool) -> torch.Tensor:
    """What `robot` of every env earns from `state` to the end, [macro steps, E]: it crashes here, or stands still.

    The others take the planned controls, [macro steps, E, N, 2].
    """
    env.load_state_dict(state)
    tensors = env.simulation.tensors
    tensors["pose"][:, robot, 2] = 0.0
    tensors["collided"][:, robot] |= int(crash)
    td, earned = env.observe(), []
    for control in plan:
        control = control.clone()
        control[:, robot] = 0.0
        td = drive(env, td, control)
        earned.append(td["agents", "reward"][:, robot, 0])
    earned = torch.stack(earned)
    earned[0] -= crash * V * env.settings.reward.collision
    return earned


def gains(reward: RewardConfig, robots: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return of crashing minus that of standing still, at every moment of random play: plain and discounted."""
    maps, steps = [make_map("maze_small", 0), make_map("maze_small", 1), room(17, 11, "rotated", 1)], 7
    env = ExplorationEnv(
        maps, 10, robots, seed=1, planner=DIRECT, reward=reward, local_steps=8, macro_steps=steps, num_threads=1
    )
    plan = torch.rand(steps, 10, robots, 2, generator=torch.Generator().manual_seed(4)) * 2 - 1
    fall, td, found = GAMMA ** torch.arange(steps), env.reset(), []
    for step in range(steps):
        state = env.state_dict()
        for robot in range(robots):
            free = (state["active"] != 0) & (state["collided"][:, robot] == 0)
            crash, still = (branch(env, state, plan[step:], robot, choice) for choice in (True, False))
            more = (crash - still)[:, free]
            found.append(torch.stack([more.sum(0), (more * fall[: len(more), None]).sum(0)]))
        env.load_state_dict(state)
        td = drive(env, td, plan[step].clone())
    plain, discounted = torch.cat(found, 1)
    assert len(plain) > 20 * robots
    return plain, discounted


@pytest.mark.parametrize("robots", [1, 3])
@pytest.mark.parametrize("settings", [{}, {"collision": 0.0}, {"collision": 0.0, "overlap": 0.01}], ids=str)
def test_crashing_never_pays(robots, settings):
    """Not even where a collision costs nothing by itself, and whatever the others do."""
    plain, discounted = gains(RewardConfig(**settings), robots)
    assert (plain <= 1e-4).all() and (discounted <= 1e-4).all()
    if "collision" not in settings:
        assert plain.min() < -1.5


def test_crashing_paid_while_the_rest_was_not_charged():
    plain, discounted = gains(RewardConfig(collision=0.0, charge_rest=False), 1)
    assert (plain > 0.05).any() and (discounted > 0.05).any()
