"""Random configurations of the env, stepped with random actions, every invariant of `invariants.py` checked.

A few small examples by default. By hand: `pytest tests/envs/test_env_fuzz.py --hypothesis-profile=long -s` plays
episodes of 200 macro steps until MAEXP_FUZZ_MINUTES (30) are over, and prints how many it tried.
"""

import hashlib
import os
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from invariants import Watch
from torchrl.envs.utils import step_mdp
from worlds import room

from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    MapError,
    ObservationConfig,
    PlannerConfig,
    RadarConfig,
    RewardConfig,
    RobotConfig,
    make_map,
)

pytestmark = pytest.mark.slow  # fuzzing

REWARDS = [
    RewardConfig(overlap=0.01, charge_rest=True),
    RewardConfig(overlap=0.0, charge_rest=True, time_on="covered"),
    RewardConfig(overlap=0.01, charge_rest=False, events=0.0),
    RewardConfig(explore=0.0, unfinished=0.5, time_on="gained"),
]
LONG = settings.get_current_profile_name() == "long"
STEPS = 200 if LONG else 5
EXAMPLES = 1_000 if LONG else 10  # each is drawn even when the time is over
SECONDS = 60.0 * float(os.environ.get("MAEXP_FUZZ_MINUTES", 30))
KINDS = ("ackermann", "differential", "omnidirectional")
SMALL = ("lattice", "jittered", "rotated", "mixed")
LARGE = ("random_obstacles", "random_obstacles_adaptive", "maze", "outdoor")
INDOOR = ("indoor_small", "indoor_medium", "indoor_large")
tried = Counter()


@dataclass
class Case:
    """One configuration; maps are (kind, index)."""

    maps: list
    num_envs: int
    num_robots: int
    seed: int
    settings: dict
    hasty: bool = False  # finished envs are stepped on before they are reset
    threads: list = field(default_factory=lambda: [1, 1])


@cache
def get_map(kind: str, index: int):
    if kind in SMALL:
        return room(14 + 3 * (index % 4), 11 + 2 * (index % 7), kind, index)
    return make_map(kind, index)


@st.composite
def cases(draw) -> Case:
    """Configurations that should work; what has no room for its team is drawn again with one robot."""
    families = ["small", "small", "small", "maze", "indoor", "large"] if LONG else ["small", "maze"]
    family = draw(st.sampled_from(families))
    kinds = {"small": (*SMALL, "maze_small"), "maze": ("maze_small",), "indoor": INDOOR, "large": LARGE}[family]
    maps = draw(st.lists(st.tuples(st.sampled_from(kinds), st.integers(0, 30)), min_size=1, max_size=3))
    crowd = draw(st.integers(0, 8)) == 0
    robots = draw(st.integers(33, 40)) if crowd else draw(st.integers(1, 10))
    scale = {"small": 0.4, "indoor": 0.1}.get(family, 1.0)  # of the sizes of robots
    reach = {"small": 6.0, "maze": 8.0, "indoor": 1.2, "large": 9.0}[family]
    robot = st.builds(
        RobotConfig,
        kind=st.sampled_from(KINDS),
        length=st.floats(0.6, 1.6).map(lambda x: x * scale),
        width=st.floats(0.4, 1.2).map(lambda x: x * scale),
        max_speed=st.floats(1.0, 8.0).map(lambda x: x * scale),
        max_accel=st.floats(0.5, 6.0).map(lambda x: x * scale),
        collision_threshold=st.floats(0.5, 0.9).map(lambda x: x * scale),
        max_steer=st.floats(0.1, 1.5),
    )
    radius = draw(st.sampled_from(["auto", "auto", 0.0, 0.3 * reach / 8.0, 0.8 * reach / 8.0]))
    radar = st.builds(
        RadarConfig,
        range=st.floats(0.2, 1.5).map(lambda x: x * reach),
        fov=st.sampled_from([2 * np.pi, 2 * np.pi, 3.3, 1.5, 0.3]),
        alpha1=st.sampled_from([1e-3, 0.011, 0.0]),
        alpha2=st.sampled_from([1e-6, 0.05]),
        obstacle_radius=st.just(radius),
    )

    def team(member):
        return st.lists(member, min_size=robots, max_size=robots) if robots <= 10 else member

    planner = st.builds(
        PlannerConfig,
        name=st.sampled_from(["dwa", "wavefront", "direct"]),
        num_accel=st.integers(1, 4),
        num_steering=st.integers(1, 25),
        horizon=st.integers(1, 5),
        clearance_factor=st.floats(1.0, 5.0),
        replan_steps=st.integers(1, 6),
    )
    hearing = st.sampled_from([np.inf, np.inf, 0.0, 0.5 * reach, 2 * reach])
    chosen = {
        "robot": draw(team(robot)),
        "radar": draw(team(radar)),
        "planner": draw(planner),
        "collision": draw(st.sampled_from(["centre", "footprint"])),
        "comm": CommConfig(range=draw(hearing), line_of_sight=draw(st.booleans())),
        "observation": ObservationConfig(map=draw(st.sampled_from(["seen", "known"]))),
        "reward": draw(st.sampled_from(REWARDS)),
        "local_steps": draw(st.integers(1, 12)),
        "macro_steps": draw(st.sampled_from([1, 3, 17, 60] if LONG else [2, 3])),
        "success_coverage": draw(st.sampled_from([0.95, 0.95, 0.3, 0.6, 1.0])),
    }
    envs = draw(st.integers(1, 4)) if robots <= 10 else 1 + draw(st.booleans())
    threads = draw(st.lists(st.integers(1, 3), min_size=2, max_size=2))
    return Case(maps, envs, robots, draw(st.integers(0, 2**31 - 1)), chosen, draw(st.booleans()), threads)


def build(case: Case, num_envs: int, threads: int) -> ExplorationEnv | None:
    """The env of a case, with fewer robots where its maps have no room; None where they have none at all."""
    maps, robots = [get_map(*wanted) for wanted in case.maps], case.num_robots
    while robots:
        chosen = dict(case.settings)
        for name in ("robot", "radar"):
            chosen[name] = chosen[name][:robots] if isinstance(chosen[name], list) else chosen[name]
        try:
            return ExplorationEnv(maps, num_envs, robots, seed=case.seed, num_threads=threads, **chosen)
        except MapError as error:
            assert "room" in str(error), error
            robots = robots // 2
    return None


def random_action(env: ExplorationEnv, seed: int, step: int):
    """Actions of env e that do not depend on how many envs there are; a third of them out of bounds."""
    action = env.fake_tensordict().select(("agents", "action")).clone()
    for e in range(env.num_envs):
        rng = np.random.default_rng([seed, step, e])
        wild = rng.random() < 0.3
        if env.planner_config.name == "direct":
            control = rng.uniform(-1, 1, (env.num_robots, 2)) * (10.0 ** rng.integers(0, 30) if wild else 1.0)
            action["agents", "action", "control"][e] = torch.from_numpy(control).float()
            continue
        region = rng.integers(0, 64, env.num_robots)  # others are refused: tests/envs/test_odd_actions.py
        offset = rng.uniform(-1, 1, (env.num_robots, 2)) * (10.0 ** rng.integers(0, 30) if wild else 1.0)
        action["agents", "action", "region"][e] = torch.from_numpy(region)
        action["agents", "action", "offset"][e] = torch.from_numpy(offset).float()
    return action


def play(env: ExplorationEnv, case: Case, steps: int, watch: Watch | None = None) -> list[list[bytes]]:
    """A fingerprint of every env after every macro step."""
    reset = watch.reset if watch else env.reset
    td = reset()
    prints = []
    for step in range(steps):
        stepped = env.step(td.update(random_action(env, case.seed, step)))
        if watch:
            watch.check_step(stepped)
        prints.append([fingerprint(stepped["next"][e]) for e in range(env.num_envs)])
        td = step_mdp(stepped)
        due = td["done"] if not case.hasty or step % 3 == 2 else torch.zeros_like(td["done"])
        if due.any():
            td = reset(td.set("_reset", due))
    return prints


def fingerprint(td) -> bytes:
    """A digest of all values of one env."""
    digest = hashlib.blake2b(digest_size=16)
    for name, value in sorted(td.items(True, True), key=lambda item: str(item[0])):
        digest.update(str(name).encode() + value.contiguous().numpy().tobytes())
    return digest.digest()


def assert_nan_is_refused(env: ExplorationEnv) -> None:
    """An action with NaN or infinity is an error that names the env, and the env goes on after a reset."""
    td = env.reset().update(random_action(env, 0, 0))
    name = "control" if env.planner_config.name == "direct" else "offset"
    bad = env.num_envs - 1
    td["agents", "action", name][bad, -1, 1] = [float("nan"), float("inf")][env.num_robots % 2]
    with pytest.raises(ValueError, match=f"action of env {bad} is NaN or infinite"):
        env.step(td)
    env.step(env.reset().update(random_action(env, 0, 1)))


@pytest.fixture(scope="module", autouse=True)
def tell(request):
    """Print what a long run tried."""
    yield
    if LONG:
        told = ", ".join(f"{count:,} {what}" for what, count in tried.items())
        request.config.pluginmanager.get_plugin("terminalreporter").write_line(f"\nenv fuzzing: {told}")


BEGIN = time.monotonic()


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=not LONG,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(case=cases())
def test_invariants(case):
    if LONG and time.monotonic() - BEGIN > SECONDS:
        return
    env = build(case, case.num_envs, case.threads[0])
    if env is None:
        tried["configurations without room"] += 1
        return
    watch = Watch(env)
    first = play(env, case, STEPS, watch)
    env.set_step_hook(None)
    tried.update(
        {
            "configurations": 1,
            "macro steps": STEPS * env.num_envs,
            "local steps": watch.local_steps,
            "episodes": watch.episodes,
            "collisions": watch.crashes,
            "successes": watch.successes,
        }
    )
    few = build(case, max(1, case.num_envs - 1), case.threads[1])
    for bits, others in zip(first, play(few, case, STEPS), strict=True):
        assert bits[: few.num_envs] == others, "the bits depend on the run, the number of envs or of threads"
    assert_nan_is_refused(env)


def test_the_scan_at_reset_earns_nothing_even_where_it_sees_all():
    """Design 4.5: it counts in coverage; such an episode ends as a success after one local step, unpaid."""
    place = room(9, 7)
    open_place = type(place)(place.free, place.obstacles[:0], 1.0, name="open", scenario="maze_small")
    env = ExplorationEnv(open_place, num_envs=2, num_robots=1, radar=RadarConfig(range=50.0), local_steps=5)
    after = env.step(env.reset().update(random_action(env, 0, 0)))["next"]
    assert after["terminated"].all() and (after["info", "coverage"] == 1).all()
    assert (after["info", "local_steps"] == 1).all() and (after["info", "coverage_step_95"] == 1).all()
    for term in ("explore", "success"):
        assert not after["info", f"reward_{term}"].any()
