"""Odometry that drifts: the kernels against their definition, and robots that drive by what they believe."""

import math

import pytest
import torch
from oracle import odometry
from torchrl.envs.utils import step_mdp
from worlds import drive, play_alike, room

from maexp.agents.policies import POLICIES
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    FaultsConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RobotConfig,
)

pytestmark = pytest.mark.kernels

WORLD = room(40, 22)
SOME = OdometryConfig(drift=0.1, turn=0.05, jump=0.7, jump_rate=0.3)
KINDS = [RobotConfig(kind=kind) for kind in ("ackermann", "differential", "omnidirectional")]


def make(odometry: OdometryConfig | None, robots: int = 3, envs: int = 2, **settings) -> ExplorationEnv:
    settings = {"local_steps": 4, "macro_steps": 15, "num_threads": 1, "seed": 3, "success_coverage": 1.0} | settings
    return ExplorationEnv(settings.pop("maps", WORLD), envs, robots, odometry=odometry, **settings)


@pytest.mark.parametrize("planner", ["direct", "wavefront"])
def test_errors_are_those_of_the_definition(planner):
    env = make(SOME, robot=KINDS, planner=PlannerConfig(name=planner), faults=FaultsConfig(probability=0.4))
    s, walkers, before, steps = env.simulation.tensors, {}, {}, []
    low, high = (env.simulation.map_tensors[name][0].tolist() for name in ("lower", "upper"))

    def compare(env):
        step = int(s["local_step"][0]) - 1
        for e in range(2):
            for i in range(len(KINDS)):
                walker = walkers.get((e, i))
                if step < 0:
                    values = SOME.drift, SOME.turn, SOME.jump, SOME.jump_rate
                    walker = walkers[e, i] = odometry.Walker((3, e, int(s["episode"][e])), i, *values)
                elif not before["collided"][e, i]:
                    down = bool(s["failed"][e, i])  # has stopped before it drove
                    speed, slip = (0.0 if down else float(before[name]) for name in ((e, i, 0), (e, i, 1)))
                    walker.drive(speed, slip, float(before["pose"][e, i, 3]), step)
                x, y, _, heading = s["pose"][e, i].tolist()
                offset = float(env.simulation.robot_tensors["center_offset"][e, i])
                at, believed = walker.estimate(x, y, heading, offset, low, high)
                found = s["center_estimate"][e, i].tolist()
                assert found[:2] == pytest.approx(at, abs=2e-3)
                turn = float(s["pose_estimate"][e, i, 3]) - believed
                assert abs(math.remainder(turn, 2.0 * math.pi)) < 2e-3
                assert float(s["pose_estimate"][e, i, 2]) == float(s["pose"][e, i, 2])
                before[e, i, 0], before[e, i, 1] = float(s["pose"][e, i, 2]), float(s["slip"][e, i])
        before["pose"], before["collided"] = s["pose"].clone(), s["collided"].clone()
        steps.append(step)

    env.set_step_hook(compare)
    env.reset()
    last = drive(env, 12)[-1]
    off = (s["center_estimate"] - s["center"]).norm(dim=-1)
    torch.testing.assert_close(last["info", "odometry_error"], off)
    assert len(steps) == 49 and off.max() > 0.3 and sum(walker.jumps for walker in walkers.values()) > 3


def test_the_error_grows_with_the_root_of_the_way():
    """Many robots that drive straight ahead in the open: the spread along each axis is drift sqrt(way)."""
    env = make(OdometryConfig(drift=0.2), robots=1, envs=400, planner=PlannerConfig(name="direct"), local_steps=40)
    env.set_starts([[6.0, 10.0, 0.0]])
    td, found = env.reset(), []
    for _ in range(2):
        td["agents", "action", "control"] = torch.tensor([0.15, 0.0]).expand(400, 1, 2)
        td = step_mdp(env.step(td))
        off = env.simulation.tensors["odometry_error"][:, 0]
        way = env.simulation.tensors["path_length"][:, 0]
        found.append((float(way[0]), off[:, :2].std(0).tolist(), off.mean(0).tolist()))
    assert not td["info", "collided"].any() and found[1][0] > 2.0 * found[0][0] > 0.2
    for way, spread, mean in found:
        assert spread == pytest.approx([0.2 * math.sqrt(way)] * 2, rel=0.12)
        assert mean == pytest.approx([0.0] * 3, abs=4 * 0.2 * math.sqrt(way / 400))


@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_goals_are_missed_by_the_error(planner):
    """The robot drives until it believes to be there; its pose is the one it believes to have."""
    env = make(
        OdometryConfig(jump=1e-9, jump_rate=1e-9),
        robots=1,
        envs=1,
        planner=PlannerConfig(name=planner),
        local_steps=10,
        macro_steps=30,
    )
    env.set_starts([[6.0, 10.0, 0.0]])
    td, s = env.reset(), env.simulation.tensors
    s["odometry_error"][0, 0] = torch.tensor([1.5, -1.0, 0.0])
    region, goal = 8 * 2 + 4, None
    for _ in range(20):
        td["agents", "action", "region"] = torch.tensor([[region]])
        td["agents", "action", "offset"] = torch.zeros(1, 1, 2)
        td = step_mdp(env.step(td))
        goal = s["goal"][0, 0]
    believed, true = s["center_estimate"][0, 0, :2], s["center"][0, 0, :2]
    assert (believed - goal).norm() < 0.5 and not td["info", "collided"].any()
    torch.testing.assert_close(true - goal, torch.tensor([-1.5, 1.0]) + believed - goal, atol=1e-3, rtol=0)
    maps = env.simulation.map_tensors
    middle, side = 0.5 * (maps["lower"][0] + maps["upper"][0]), float(maps["pixel_size"][0]) * 125
    torch.testing.assert_close(td["agents", "observation", "pose"][0, 0, :2], (believed - middle) * 2.0 / side)


@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_robots_aim_from_where_they_are(planner):
    """Goals and waypoints turn and move with the error; waypoints may then be drawn nearer, on the same line."""
    env = make(SOME, robot=KINDS[0], planner=PlannerConfig(name=planner))
    s, poses, off = env.simulation.tensors, {}, []

    def compare(env):
        for e in range(2):
            for i in range(3):
                if int(s["local_step"][e]) > 1 and not s["collided"][e, i]:
                    true, believed = poses[e, i]
                    goal, waypoint = (
                        odometry.seen_from(true, believed, s[kind][e, i].tolist()) for kind in ("goal", "waypoint")
                    )
                    assert s["goal_aim"][e, i].tolist() == pytest.approx(goal, abs=5e-3)
                    aim = s["waypoint_aim"][e, i]
                    way, full = (point - torch.tensor(true[:2]) for point in (aim, torch.tensor(waypoint)))
                    share = 1.0 if planner == "dwa" else float(way.norm() / full.norm())
                    assert share <= 1.001
                    torch.testing.assert_close(way, share * full, atol=5e-3, rtol=1e-3)
                    off.append(math.dist(goal, s["goal"][e, i].tolist()))
                poses[e, i] = [
                    (*s[f"center{which}"][e, i, :2].tolist(), float(s[f"pose{which}"][e, i, 3]))
                    for which in ("", "_estimate")
                ]

    env.set_step_hook(compare)
    env.reset()
    drive(env, 6)
    assert len(off) > 60 and max(off) > 0.5


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_who_believes_a_wall_elsewhere_stops_before_it(kind):
    """A robot keeps clear of what it sees, though it believes to be three metres farther back."""
    for planner in ("dwa", "wavefront"):
        env = make(
            OdometryConfig(jump=1e-9, jump_rate=1e-9),
            robots=1,
            envs=1,
            local_steps=10,
            macro_steps=40,
            robot=RobotConfig(kind=kind),
            planner=PlannerConfig(name=planner),
        )
        env.set_starts([[14.0, 4.0, 0.0]])
        td, s = env.reset(), env.simulation.tensors
        s["odometry_error"][0, 0, 0] = -3.0
        for _ in range(25):
            td["agents", "action", "region"] = torch.tensor([[8 * 3 + 1]])
            td["agents", "action", "offset"] = torch.tensor([[[1.0, 0.0]]])
            td = step_mdp(env.step(td))
        assert not td["info", "collided"].any() and s["path_length"].min() > 1.0, planner


def test_mates_are_where_they_are_seen():
    """Two robots that believe to pass far from each other stop where they would meet."""
    env = make(OdometryConfig(jump=1e-9, jump_rate=1e-9), robots=2, envs=1, local_steps=10)
    env.set_starts([[6.0, 10.0, 0.0], [14.0, 10.0, math.pi]])
    td, s = env.reset(), env.simulation.tensors
    s["odometry_error"][0] = torch.tensor([[0.0, 2.9375, 0.0], [0.0, -2.8125, 0.0]])
    for _ in range(14):
        td["agents", "action", "region"] = torch.tensor([[8 * 3 + 4, 8 * 1 + 2]])
        td["agents", "action", "offset"] = torch.zeros(1, 2, 2)
        td = step_mdp(env.step(td))
    assert not td["info", "collided"].any() and s["path_length"].min() > 1.0


@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=6.0, base_station=True, strategy="return_to_base")])
@pytest.mark.parametrize("name", ["cost_utility", "rrt_frontiers", "hungarian", "lookahead", "clairvoyant"])
def test_who_believes_to_be_off_the_map_is_held_at_its_edge(name, comm):
    """Whatever plans goes on, with errors larger than the map."""
    env = make(OdometryConfig(drift=60.0, turn=3.0), comm=comm, observation=ObservationConfig(targets=6))
    policy, td = POLICIES[name](env), env.reset()
    low, high = (env.simulation.map_tensors[corner][0] for corner in ("lower", "upper"))
    for _ in range(5):
        _, td = env.step_and_maybe_reset(policy(td))
        at = env.simulation.tensors["center_estimate"][..., :2]
        assert ((at >= low) & (at <= high)).all()
        assert all(leaf.isfinite().all() for leaf in td["agents"].values(True, True))
    assert td["info", "odometry_error"].max() > 5.0 and env.simulation.tensors["odometry_error"].abs().max() > 30.0


def test_nobody_foresees_the_drift():
    """`lookahead` chooses the same whatever the errors to come are, and imagines robots where they believe to be."""
    found = []
    for drift in (0.001, 0.3):
        env = make(OdometryConfig(drift=drift), envs=1)
        td = POLICIES["lookahead"](env)(env.reset())
        found.append((td["agents", "action", "region"], td["agents", "action", "offset"]))
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_errors_repeat_in_any_batch_from_a_saved_state_and_in_a_copy():
    names = ("pose", "pose_estimate", "center_estimate", "odometry_error")
    *_, small = play_alike(make(SOME, envs=1), make(SOME, envs=3), 8, names)
    assert small.simulation.tensors["odometry_error"].abs().max() > 0.05
    small.reset()
    assert not small.simulation.tensors["odometry_error"].any()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(drift=-0.1), "odometry.drift=-0.1 must be"),
        (dict(turn=float("inf")), "odometry.turn=inf must be"),
        (dict(jump=True), "odometry.jump=True must be"),
        (dict(jump=1.0, jump_rate=11.0), "odometry.jump_rate=11.0 must be"),
        (dict(jump=1.0), "odometry.jump=1 m and odometry.jump_rate=0 1/s: jumps need both"),
        (dict(jump_rate=0.5), "jumps need both"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        make(OdometryConfig(**settings))
