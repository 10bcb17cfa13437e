"""What robots do about radios that do not reach: who goes to tell, where to, and that it repeats."""

import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp
from worlds import room

from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, RobotConfig, make_map
from maexp.envs.comm.strategy import PATIENCE
from maexp.envs.config import STRATEGIES
from maexp.kernels.types import REGIONS

WORLD = room(40, 22)
BASE = (2.0, 10.0)


def make(strategy: str = "return_to_base", robots: int = 2, envs: int = 1, base=BASE, **settings) -> ExplorationEnv:
    comm = CommConfig(
        range=settings.pop("range", 6.0),
        base_station=base,
        strategy=strategy,
        period=settings.pop("period", 3),
        bandwidth=settings.pop("bandwidth", math.inf),
    )
    settings = {"local_steps": 10, "macro_steps": 40, "num_threads": 1, "seed": 2, "success_coverage": 1.0} | settings
    return ExplorationEnv(WORLD, envs, robots, comm=comm, **settings)


def put(env: ExplorationEnv, places: dict[int, tuple[float, float]]) -> None:
    """Move robots by hand, and let one local step tell them whom they hear there."""
    s = env.simulation.tensors
    for robot, place in places.items():
        at = torch.tensor(place)
        s["path_length"][:, robot] += (s["center"][:, robot, :2] - at).norm(dim=-1)
        for name in ("center", "pose"):
            s[name][:, robot] = 0.0
            s[name][:, robot, :2] = at
    env.simulation.step(0, 1)


def stay(env: ExplorationEnv) -> TensorDict:
    """The action that keeps every robot where it is."""
    (left, low), (right, high) = WORLD.extent
    lower, size = torch.tensor([left, low]), torch.tensor([right - left, high - low]) / REGIONS
    cell = ((env.simulation.tensors["center"][..., :2] - lower) / size).clamp(0, REGIONS - 1e-3)
    index = cell.long()
    td = env.fake_tensordict().select(("agents", "action")).clone()
    td["agents", "action", "region"] = index[..., 0] * REGIONS + index[..., 1]
    td["agents", "action", "offset"] = 2.0 * (cell - index) - 1.0
    return td


def wait(env: ExplorationEnv, steps: int = 1) -> torch.Tensor:
    """Who is on duty after so many decisions to stay, bool [N]."""
    for _ in range(steps):
        env.step(stay(env))
    return env.strategy.state["duty"][0]


def goal_of(env: ExplorationEnv, robot: int) -> list[float]:
    return env.simulation.tensors["goal"][0, robot].tolist()


def start(env: ExplorationEnv, *poses) -> None:
    env.set_starts([[*pose, 0.0] for pose in poses])
    env.reset()


def shared_with_base(env: ExplorationEnv, robot: int) -> int:
    """Weight of the free points that a robot and the base station know, point by point."""
    words = env.simulation.tensors["known_free"][0, 0].tolist()
    maps, base = env.simulation.map_tensors, env.num_robots
    weights = maps["free_weight"].tolist()
    return sum(w for word, w in zip(words, weights, strict=True) if word >> robot & 1 and word >> base & 1)


LIMITS = {"bandwidth": {"bandwidth": 80.0}, "delay": {"delay": 5.0}, "loss": {"loss": 0.9}, "noise": {"noise": 40.0}}


@pytest.mark.parametrize("limit", LIMITS)
def test_robots_take_for_told_what_the_base_station_has(limit):
    """Not what they have begun to send. Where links come and go, contacts between two decisions count, and what is
    learned after them and before the decision is taken for told, too."""
    signal = {"signal": True, "power": -5.0} if limit == "noise" else {"range": 6.0}
    comm = CommConfig(**signal, base_station=BASE, strategy="return_to_base", period=3, **LIMITS[limit])
    env = ExplorationEnv(WORLD, 1, 2, comm=comm, local_steps=10, macro_steps=40, num_threads=1, seed=2)
    policy, td, before, news, alone = POLICIES["nearest_frontier"](env), env.reset(), [0, 0], 0, 0
    slack = [0, 0]  # what a robot learns in a decision, at most
    for _ in range(25):
        env.strategy.look()
        has = env.simulation.tensors["known_weight"][0].tolist()
        for robot in range(2):
            told = int(env.strategy.state["told"][0, robot, 2])
            linked = bool(env.strategy.linked[0, robot, 2])
            slack[robot] = max(slack[robot], has[robot] - before[robot]) if env.strategy.fades else 0
            assert told <= shared_with_base(env, robot) + slack[robot], "never more than it has"
            news += told < has[robot]
            alone += linked and not env.simulation.tensors["hears"][0, robot, 0] >> 2 & 1
        before = has
        td = step_mdp(env.step(policy(td)))
    assert news > 5
    assert alone > 0 or not env.strategy.fades, "heard between two decisions, not in the last step"


def test_a_robot_stays_until_all_is_told():
    """With 80 B/s, 2 points in a local step."""
    env = make(bandwidth=80.0, period=1)
    start(env, (4.0, 10.0), (17.0, 10.0))
    assert wait(env, 2)[1]
    put(env, {1: (6.0, 12.0)})
    for _ in range(30):
        before = shared_with_base(env, 1)
        duty = wait(env)[1]
        if not duty:
            break
        assert shared_with_base(env, 1) > before, "while it stands there it tells"
    knows = int(env.simulation.tensors["known_weight"][0, 1])
    assert not duty and shared_with_base(env, 1) == knows


def test_a_robot_reports_and_is_released():
    env = make()
    start(env, (4.0, 10.0), (6.0, 12.0))
    assert not wait(env, 2).any(), "connected"
    put(env, {1: (17.0, 10.0)})
    assert not wait(env, 2).any(), "not yet"
    assert wait(env).tolist() == [False, True], "period after it was last connected"
    assert goal_of(env, 1) == pytest.approx(BASE, abs=1e-3)
    told = env.simulation.tensors["known_weight"][0, 2].item()
    put(env, {1: (6.0, 12.0)})
    assert wait(env, 2).tolist() == [False, False] and env.simulation.tensors["known_weight"][0, 2] > told


@pytest.mark.parametrize("x", [12.0, 20.0, 36.0])
def test_reports_are_rarer_the_longer_the_way(x):
    """By itself a robot turns back to report sqrt(c L / 2) decisions after the last time, c the way there and out."""
    env = make(robots=1, period="auto", macro_steps=60)
    start(env, (4.0, 10.0))
    wait(env)
    put(env, {0: (x, 10.0)})
    drive = 0.7 * env.robot_configs[0].max_speed * 1.0  # of a decision [m]
    s, found = env.simulation.tensors, []
    while not found or not found[-1]:
        env.strategy.state["grew"][:] = s["macro_step"].view(-1, 1)  # there is always news
        step, at = int(s["macro_step"][0]), s["center"][0, 0, :2]
        way = min(float(s["path_length"][0, 0]), 1.5 * float((at - torch.tensor(BASE)).norm())) / drive
        found.append(bool(wait(env)[0]))
        turns = step + way >= (0.5 * 2.0 * way * 60) ** 0.5 or 60 - step <= way + 1.0
        assert found[-1] == turns, (step, way)
    assert len(found) > 5


def test_the_next_meeting_is_farther_off_the_more_they_know():
    """All who meet agree on one time, also where one of them is slower."""
    env = make("rendezvous", robots=2, period="auto", robot=[RobotConfig(max_speed=speed) for speed in (1.0, 2.0)])
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    first = env.strategy.state["due"][0].tolist()
    disc = float(env.strategy._disc())
    wide = env.strategy.reach * (float(env.simulation.tensors["known_weight"][0, 0]) / disc) ** 0.5
    cost = 2.0 * 1.5 * wide / (0.7 * 1.0 * 1.0) + PATIENCE
    assert first[0] == first[1] == pytest.approx((0.5 * cost * 40) ** 0.5, abs=1.0)


def test_who_has_nothing_to_tell_does_not_report():
    env = make(robots=1)
    start(env, (4.0, 10.0))
    wait(env)
    env.simulation.tensors["known_free"].fill_(-1)  # it knows everything already
    put(env, {0: (17.0, 10.0)})
    assert not wait(env, 5).any()


def test_one_reports_for_all_that_know_the_same():
    """Whoever has the shortest way; the others take it for told, and their period begins anew."""
    env = make("courier", robots=3)
    start(env, (4.0, 10.0), (6.0, 12.0), (6.0, 10.0))
    wait(env)
    put(env, {0: (20.0, 10.0), 1: (17.0, 10.0), 2: (33.0, 10.0)})
    assert not wait(env, 2).any(), "not yet"
    assert wait(env).tolist() == [False, True, True], "2 is alone"
    assert goal_of(env, 1) == pytest.approx(BASE, abs=1e-3)
    s = env.strategy.state
    told = s["told"][0, :, 3].tolist()
    assert told[0] > told[1] and s["eased"][0].tolist() == [3, 0, 0]
    put(env, {1: (2.0, 12.0), 2: (2.0, 10.0)})
    assert not wait(env, 2)[0], "its period has begun anew"


def test_whoever_carries_the_news_hands_them_over_on_its_way():
    env = make("courier", robots=2)
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    put(env, {0: (12.0, 10.0), 1: (30.0, 10.0)})
    wait(env)
    s, now = env.strategy.state, int(env.simulation.tensors["macro_step"][0])
    s["met"][:, 0, 2] = s["grew"][:, 0] = now  # 0 is not due for some time
    assert wait(env, 2).tolist() == [False, True]
    put(env, {1: (15.0, 10.0)})
    assert wait(env).tolist() == [True, False], "0 is nearer"
    put(env, {0: (2.0, 12.0)})
    assert wait(env).tolist() == [False, False], "and has told it all"


def test_the_slow_do_not_carry_what_the_fast_bring_sooner():
    """Soonest there is not nearest: the fast one is farther away."""
    env = make("courier", robots=2, robot=[RobotConfig(max_speed=3.0), RobotConfig(max_speed=0.3)])
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    put(env, {0: (20.0, 10.0), 1: (18.5, 10.0)})
    assert wait(env, 3).tolist() == [True, False]
    assert not wait(env)[1], "and the slow one has told it"


def test_who_was_heard_a_while_ago_carries_nothing():
    """Where links come and go, a contact since the last decision counts as one, but what was learned after it is not
    told: nobody takes it for told."""
    comm = CommConfig(signal=True, noise=13.0, base_station=True, strategy="courier")
    shown = ObservationConfig(pictures=False)
    env = ExplorationEnv(make_map("indoor_medium", 0), 4, 3, comm=comm, observation=shown, num_threads=1, seed=1)
    strategy, state, eased = env.strategy, env.strategy.state, []
    decide = strategy._courier

    def watched() -> tuple[torch.Tensor, torch.Tensor]:
        told = state["told"][..., 3].clone()
        found = decide()
        held = strategy.linked[..., :3] & (strategy._shared()[..., :3] >= strategy.known.unsqueeze(-1))
        eased.extend(held.sum(-1)[state["told"][..., 3] != told].tolist())
        return found

    strategy._courier = watched
    policy, td = POLICIES["cost_utility"](env), env.reset()
    for _ in range(45):
        td = step_mdp(env.step(policy(td)))
    assert len(eased) > 5 and min(eased) > 1, "itself is one that has it"


def test_before_the_end_the_last_to_have_time_reports():
    """Who is farther away hands over what it knows, and looks on."""
    env = make("courier", robots=2, period=1000, macro_steps=24)
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    put(env, {0: (10.0, 10.0), 1: (15.0, 10.0)})
    duty, eased, s = [], [], env.strategy.state
    for _ in range(22):
        eased.append(int(s["eased"][0, 1]))
        s["grew"][:] = env.simulation.tensors["macro_step"].view(-1, 1)  # there is always news
        duty.append(wait(env).tolist())
        if any(duty[-1]):
            break
    assert duty[-1] == [True, False], "the nearer one, as late as it may"
    assert eased[-1] > 0, "the other had given it up before"
    drive = 0.7 * env.robot_configs[0].max_speed * 1.0  # of a decision [m]
    assert 24 - len(duty) == pytest.approx(8.0 / drive + 1, abs=2.0)


def test_robots_come_home_in_time():
    """Before the end they turn back as far away as they are, long before the period is over."""
    env = make(robots=1, period=1000)
    start(env, (4.0, 10.0))
    wait(env)
    put(env, {0: (36.0, 10.0)})
    duty = []
    for _ in range(38):
        env.strategy.state["grew"][:] = env.simulation.tensors["macro_step"].view(-1, 1)  # there is always news
        duty.append(bool(wait(env)[0]))
        if duty[-1]:
            break
    drive = 0.7 * env.robot_configs[0].max_speed * 1.0  # of a decision [m]
    assert 40 - len(duty) == pytest.approx(32.0 / drive + 1, abs=1.0), "no farther back than it has driven"


def test_an_appointment_is_kept_with_patience():
    env = make("rendezvous", base=False, period=6)
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    agreed = env.strategy.state
    assert agreed["due"].tolist() == [[6, 6]] and agreed["spot"][0, 1].tolist() == pytest.approx([4.0, 10.0], abs=0.01)
    put(env, {1: (30.0, 10.0)})
    duty = []
    for _ in range(5 + PATIENCE + 2):
        duty.append(wait(env).tolist())
        put(env, {1: (30.0, 10.0)})  # something holds it up
    assert agreed["due"][0, 1] != 6, "the other has not come: it is no longer waited for"
    assert [False, True] in duty[:5] or [True, True] in duty[:5], "who is far away leaves before the time"
    assert duty[6] == [True, True] and duty[-1] == [False, False]
    put(env, {1: (6.0, 12.0)})
    wait(env)
    assert agreed["party"][0].all() and agreed["due"][0, 0] == agreed["due"][0, 1], "they agree anew"


def test_the_earliest_promise_counts_for_all_who_are_together():
    env = make("rendezvous", robots=3, base=False, period=6)
    start(env, (4.0, 10.0), (6.0, 12.0), (30.0, 10.0))
    wait(env)
    put(env, {0: (24.0, 10.0)})  # 0 has promised 1 to be back, and now meets 2
    wait(env)
    wait(env)
    s = env.strategy.state
    assert s["due"][0].tolist() == [6, 6, 6] and s["spot"][0, 2].tolist() == pytest.approx([4.0, 10.0], abs=0.01)
    assert s["party"][0, 2].tolist() == [True, True, True]


def test_a_relay_goes_to_and_fro():
    env = make("relay")
    start(env, (9.5, 10.0), (4.0, 10.0))
    wait(env)
    put(env, {0: (17.0, 10.0)})
    assert wait(env).tolist() == [False, True] and goal_of(env, 1) == pytest.approx([9.5, 10.0], abs=0.5)
    put(env, {1: (20.0, 12.0)})  # they meet far from the base station, and have seen more
    wait(env)
    put(env, {0: (36.0, 10.0)})
    assert wait(env).tolist() == [False, True] and goal_of(env, 1) == pytest.approx(BASE, abs=1e-3)
    put(env, {1: (4.0, 10.0)})
    wait(env)
    assert env.strategy.state["duty"].tolist() == [[False, True]], "told, it looks for the explorer"
    assert goal_of(env, 1) == pytest.approx([17.0, 10.0], abs=1.0)


def test_a_pursuit_pays_by_what_the_other_misses():
    env = make("pursuit", base=False)
    start(env, (4.0, 10.0), (6.0, 12.0))
    wait(env)
    put(env, {1: (17.0, 10.0)})
    assert not wait(env).any(), "too little"
    env.simulation.tensors["known_weight"][0, 1] += 800
    assert wait(env).tolist() == [False, True] and goal_of(env, 1) == pytest.approx([4.0, 10.0], abs=0.1)
    put(env, {0: (36.0, 10.0), 1: (4.0, 12.0)})
    assert not wait(env)[1], "there, and nobody to be heard"


@pytest.mark.parametrize("strategy", [strategy for strategy in STRATEGIES if strategy != "opportunistic"])
@pytest.mark.parametrize("period", [3, "auto"])
def test_decisions_repeat(strategy, period):
    """For any size of the batch, from a saved state and in a copy, with targets or a planner's goals."""
    world = {
        "base": True,
        "period": period,
        "local_steps": 10,
        "observation": ObservationConfig(targets=4),
        "robots": 3,
    }
    small, large = (make(strategy, envs=count, **world) for count in (1, 3))
    for env in (small, large):
        env.set_episodes(torch.arange(env.num_envs))
    generator = torch.Generator().manual_seed(1)
    picks = torch.randint(4, (6, 3, 3), generator=generator)
    single, many = small.reset(), large.reset()
    on_duty = 0
    for k, pick in enumerate(picks):
        if k == 3:
            saved = small.state_dict()
            small = pickle.loads(pickle.dumps(small))
            small.load_state_dict(saved)
        states = []
        for env, td, rows in ((small, single, pick[:1]), (large, many, pick)):
            td["agents", "action", "target"] = rows
            states.append(env.step(td))
        single, many = (step_mdp(state) for state in states)
        for name in ("pose", "known_weight", "hears"):
            assert torch.equal(small.simulation.tensors[name][0], large.simulation.tensors[name][0]), name
        for name, value in small.strategy.state.items():
            assert torch.equal(value[0], large.strategy.state[name][0]), name
        on_duty += int(large.strategy.state["duty"].sum())
    assert on_duty or strategy in ("pursuit", "relay") or period == "auto"


def test_a_new_episode_remembers_nothing():
    env = make("rendezvous", robots=3, envs=2, base=True, macro_steps=5)
    policy, td = POLICIES["cost_utility"](env), env.reset()
    for _ in range(4):
        td = step_mdp(env.step(policy(td)))
    fresh = make("rendezvous", robots=3, envs=2, base=True, macro_steps=5)
    fresh.reset()
    for either in (env, fresh):
        either.set_episodes(torch.arange(2))
        either.reset()
        either.step(stay(either))
    for name, value in env.strategy.state.items():
        if name not in ("place", "spot"):  # those that have never met are nowhere
            assert torch.equal(value, fresh.strategy.state[name]), name


@pytest.mark.parametrize(
    "comm, settings, words",
    [
        (dict(strategy="shout"), {}, "comm.strategy='shout'"),
        (dict(strategy="rendezvous"), {}, "is for radios that do not reach"),
        (dict(strategy="relay", range=5.0), {}, "needs a base station"),
        (dict(strategy="return_to_base", range=5.0), {}, "needs a base station"),
        (dict(strategy="courier", range=5.0), {}, "needs a base station"),
        (dict(strategy="relay", range=5.0, base_station=True), dict(num_robots=1), "num_robots=1"),
        (dict(strategy="pursuit", range=5.0), dict(planner=PlannerConfig(name="dwa")), "planner=dwa finds no way"),
        (dict(strategy="pursuit", range=5.0, period=0), {}, "comm.period=0"),
        (dict(strategy="pursuit", range=5.0, period=2.5), {}, "comm.period=2.5"),
        (dict(strategy="pursuit", range=5.0, period="often"), {}, "comm.period='often' must be auto or a whole number"),
    ],
)
def test_bad_settings_are_named(comm, settings, words):
    with pytest.raises(ValueError, match=words):
        ExplorationEnv(WORLD, comm=CommConfig(**comm), **settings)
