"""Targets that tell of radios: what robots remember, the target to go and tell, policies with and without."""

import math

import numpy as np
import pytest
import torch
from oracle import radio
from test_comm_strategy import BASE, WORLD, put, start
from torchrl.envs.utils import check_env_specs, step_mdp
from worlds import room

from maexp.agents import make_policy
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.model import ModelConfig
from maexp.agents.deploy.planner import TeamPlanner
from maexp.agents.deploy.planner.bundle import read_contract
from maexp.agents.errors import UserError
from maexp.agents.models.actor import TARGETS, TARGETS_MASK
from maexp.agents.models.target_chooser import TargetChooser
from maexp.agents.policies.export import export_policy
from maexp.agents.policies.lookahead import LookaheadPlanner
from maexp.agents.policies.registry import find_named_policy, suit_observation
from maexp.agents.training.imitation import widened
from maexp.envs import CommConfig, ExplorationEnv, LookaheadConfig, ObservationConfig, PlannerConfig
from maexp.envs.targets.features import FAR, FEATURES, RADIO_TABLE, feature_names
from maexp.kernels.constants import FREE

ACTION = ("agents", "action", "target")
COUNT = 24
TELL = COUNT  # the last candidate
PLACE = room(45, 36, "rotated")
HERE = CommConfig(range=6.0, base_station=True)


def make(robots: int = 2, envs: int = 1, maps=WORLD, told: bool = True, **settings) -> ExplorationEnv:
    comm = settings.pop("comm", CommConfig(range=6.0, base_station=BASE))
    settings = {"local_steps": 10, "macro_steps": 40, "num_threads": 1, "seed": 2, "success_coverage": 1.0} | settings
    shown = ObservationConfig(pictures=False, targets=COUNT, radio=told)
    return ExplorationEnv(maps, envs, robots, comm=comm, observation=shown, **settings)


def column(td, name: str) -> torch.Tensor:
    return td[TARGETS][..., feature_names(True).index(name)]


def play(env: ExplorationEnv, policy, steps: int, td=None) -> list:
    td, seen = env.reset() if td is None else td, []
    with torch.no_grad():
        for _ in range(steps):
            td = step_mdp(env.step(policy(td)))
            seen.append(td)
    return seen


def test_specs_hold():
    for comm in (CommConfig(range=6.0, base_station=BASE), CommConfig(line_of_sight=True), CommConfig(signal=True)):
        env = make(3, 2, comm=comm)
        check_env_specs(env)
        for td in play(env, env.rand_action, 3):
            assert torch.isfinite(td[TARGETS]).all() and td[TARGETS].abs().max() < 30.0
            assert (td[TARGETS][~td[TARGETS_MASK]] == 0).all()
            assert td[TARGETS].shape == (2, 3, COUNT + 1, len(feature_names(True)))


def test_who_was_connected_when_and_what_is_untold():
    """Two robots and the base station; one of them drives out of reach: step by step, with numbers by hand."""
    env = make()
    start(env, (4.0, 8.0), (6.0, 12.0))
    td = env.observe()
    known = env.simulation.tensors["known_weight"]
    disc = float(env.strategy._disc())
    for name in ("untold", "base_since", "mates_untold", "mates_since"):
        assert (column(td, name)[td[TARGETS_MASK]] == 0).all(), name
    assert (column(td, "base_linked")[td[TARGETS_MASK]] == 1).all() and not td[TARGETS_MASK][..., TELL].any()
    before = known[0].tolist()
    put(env, {0: (30.0, 8.0)})
    env.simulation.tensors["macro_step"] += 3
    td = env.observe()
    there, lost = known[0].tolist(), [before[0], 0]
    assert there[0] > before[0]
    untold = math.log1p((there[0] - lost[0]) / disc)
    some = td[TARGETS_MASK][0, 0]
    assert some[TELL] and not td[TARGETS_MASK][0, 1, TELL], "who is connected has nobody to go to"
    for name, wanted in {
        "untold": untold,
        "mates_untold": untold,  # both were connected until then
        "base_since": 3 / 40,
        "mates_since": 3 / 40,
        "base_linked": 0.0,
    }.items():
        assert column(td, name)[0, 0][some] == pytest.approx(wanted, abs=1e-5), name
    gap, reach = math.dist((30.0, 8.0), BASE), env.strategy.reach
    driven = math.dist((30.0, 8.0), (4.0, 8.0))
    way = min(driven, 1.5 * gap)
    assert column(td, "base_way")[0, 0][some] == pytest.approx(math.log1p(way / reach), abs=1e-3)
    spare = (37 - way / float(env.strategy.drive[0, 0])) / 40
    assert column(td, "base_spare")[0, 0][some] == pytest.approx(spare, abs=1e-3)
    points = env.target_view.state["point"][0, 0]
    frontier = some[:TELL].nonzero().flatten().tolist()
    assert frontier
    for k in frontier:
        far = math.dist(points[k].tolist(), BASE)
        assert float(column(td, "base_far")[0, 0, k]) == pytest.approx(math.log1p(far / reach), abs=1e-4)
        mate = math.dist(points[k].tolist(), (6.0, 12.0))
        assert float(column(td, "mates_far")[0, 0, k]) == pytest.approx(min(mate / reach, FAR), abs=1e-4)
        assert float(column(td, "base_signal")[0, 0, k]) == (1.0 if far <= 6.0 else -1.0)
    assert float(column(td, "base_far")[0, 0, TELL]) == 0.0 and float(column(td, "tells")[0, 0, TELL]) == 1.0
    assert (column(td, "tells")[..., :TELL] == 0).all() and (column(td, "gain")[..., TELL] == 0).all()
    count = column(td, "count")[0, 0][some] * 10.0
    assert count == pytest.approx(len(frontier)), "the target to tell is no frontier"


def test_the_signal_is_that_of_the_known_map():
    """Walls and unknown ground block: the oracle on each robot's own grid."""
    comm = CommConfig(signal=True, base_station=True, cell=0.3)
    env = make(2, 3, PLACE, comm=comm, seed=4)
    td = play(env, env.rand_action, 4)[-1]
    view, nav, checked, values = env.target_view, env.target_view.tracker.nav, 0, []
    base = env.simulation.tensors["base"][:, :2]
    for e, i, k in view.state["mask"].nonzero().tolist():
        m = int(nav.state["map_id"][e])
        width, height, edge = int(nav.width[m]), int(nav.height[m]), float(nav.cell_size[m])
        free = (nav.known[e, i, : width * height] == FREE).view(height, width).numpy()
        a, b = ((place - nav.origin[m]).double().numpy() for place in (base[e], view.state["point"][e, i, k]))
        received, sure = radio.power(free, edge, a, b, 0.3, comm.power)
        margin = (received - comm.threshold) / 10.0
        if sure:
            assert float(column(td, "base_signal")[e, i, k]) == pytest.approx(np.clip(margin, -FAR, FAR), abs=2e-3)
            checked += 1
            values.append(margin)
    assert checked > 20 and np.ptp(values) > 0.5


def test_who_goes_to_tell_gets_there_and_is_released():
    """Whatever its policy wants on the way; and the others do not lose a target to it."""
    env = make()
    start(env, (4.0, 8.0), (6.0, 12.0))
    put(env, {0: (30.0, 8.0)})
    td, told = env.observe(), []
    assert td[TARGETS_MASK][0, 0, TELL]
    knew = int(env.simulation.tensors["known_weight"][0, 2])
    for step in range(20):
        index = torch.tensor([[TELL if step == 0 else 0, 0]])
        td[ACTION] = index
        td = step_mdp(env.step(td))
        told.append(bool(env.strategy.state["duty"][0, 0]))
        if step == 0:
            assert env.simulation.tensors["goal"][0, 0].tolist() == pytest.approx(BASE, abs=1e-3)
            assert not env.target_view.state["has_last"][0, 0] and env.target_view.state["has_last"][0, 1]
        if not told[-1]:
            break
    assert told[0] and not told[-1] and len(told) > 2, "it went there and was released"
    assert int(env.simulation.tensors["known_weight"][0, 2]) > knew


def test_with_other_strategies_nobody_chooses_to_tell():
    for name, offered in (("return_to_base", True), ("courier", True), ("rendezvous", False), ("pursuit", False)):
        env = make(comm=CommConfig(range=6.0, base_station=BASE, strategy=name, period=9))
        start(env, (4.0, 8.0), (6.0, 12.0))
        put(env, {0: (30.0, 8.0)})
        assert bool(env.observe()[TARGETS_MASK][0, 0, TELL]) == offered


def test_a_saved_state_goes_on_bit_for_bit():
    env, other = (make(3, 4, PLACE, comm=HERE) for _ in range(2))
    torch.manual_seed(0)
    td = play(env, env.rand_action, 3)[-1]
    other.load_state_dict(env.state_dict())
    for _ in range(3):
        acted = env.rand_action(td.clone())
        td, same = step_mdp(env.step(acted.clone())), step_mdp(other.step(acted.clone()))
        assert torch.equal(td[TARGETS], same[TARGETS]) and torch.equal(td[TARGETS_MASK], same[TARGETS_MASK])


def test_a_reset_of_some_envs_leaves_the_others():
    env = make(3, 4, PLACE, comm=HERE)
    torch.manual_seed(0)
    td = play(env, env.rand_action, 3)[-1]
    after = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False], [True]])))
    assert torch.equal(after[TARGETS][[0, 2]], td[TARGETS][[0, 2]])
    assert torch.equal(after[TARGETS_MASK][[0, 2]], td[TARGETS_MASK][[0, 2]])
    assert (column(after, "base_since")[[1, 3]] <= 1 / 40).all(), (
        "never connected counts from before the first decision"
    )


def test_a_policy_that_was_trained_without_it_plays_the_same():
    """It neither sees what is told nor goes to tell, and no bit of its episodes changes."""
    envs = [make(3, 4, PLACE, told=told, comm=HERE) for told in (False, True)]
    for env in envs:
        env.set_seed(3)
    plain, told = ([td["info"] for td in play(env, make_policy("universal", env), 5)] for env in envs)
    for first, second in zip(plain, told, strict=True):
        assert all(torch.equal(first[name], second[name]) for name in first.keys())


def chooser_of(policy) -> TargetChooser:
    return next(part for part in policy.modules() if isinstance(part, TargetChooser))


def test_weights_are_taken_by_a_policy_that_is_told():
    """The new inputs weigh 0: where nobody may go to tell, it thinks the same."""
    env = make(3, 4, PLACE, comm=CommConfig(range=6.0))  # no base station: nobody may
    td = play(env, env.rand_action, 2)[-1]
    universal = make_policy("universal", env)
    size = ModelConfig(action="targets")
    policy = make_policy(env, size)
    policy.load_state_dict(widened(universal.state_dict(), policy.state_dict()))
    assert chooser_of(policy).radio and not chooser_of(universal).radio
    with torch.no_grad():
        first, second = (each(td.clone())["agents", "action", "preference"] for each in (policy, universal))
    torch.testing.assert_close(first[..., :COUNT], second[..., :COUNT], atol=1e-4, rtol=1e-5)
    assert not td[TARGETS_MASK][..., TELL].any()


@pytest.mark.parametrize(
    "settings, told",
    [
        ({"comm": CommConfig()}, "observation.radio=true is about radios that do not reach"),
        ({"planner": PlannerConfig(name="dwa")}, "planner=dwa finds no way"),
    ],
)
def test_settings_that_do_not_go_together(settings, told):
    with pytest.raises(ValueError, match=told):
        make(**settings)
    with pytest.raises(ValueError, match=r"add observation\.targets=24"):
        ExplorationEnv(WORLD, 1, 1, observation=ObservationConfig(radio=True), comm=CommConfig(range=3.0))


def test_exported_it_plays_on_here_and_planners_on_robots_ask_for_the_radios(tmp_path):
    env, plain = make(2, 3, PLACE, comm=HERE), make(2, 3, PLACE, told=False, comm=HERE)
    policy = make_policy(env, ModelConfig(action="targets"))
    torch.nn.init.normal_(chooser_of(policy).head.weight)
    folder = tmp_path / "told"
    export_policy(policy, env, folder, "told", "", {})
    assert read_contract(folder).radio
    td = play(env, env.rand_action, 2)[-1]
    again = make_policy(str(folder), env)
    assert torch.equal(
        again(td.clone())["agents", "action", "preference"], policy(td)["agents", "action", "preference"]
    )
    with pytest.raises(ValueError, match=r"observation\.radio=true"):
        TeamPlanner(folder)
    with pytest.raises(UserError, match=r"add observation\.radio=true"):
        make_policy(str(folder), plain)
    cfg = compose_settings("evaluate", ["policy=cost_utility"])
    suit_observation(cfg, [find_named_policy("universal"), find_named_policy(str(folder))])
    assert cfg.observation.radio and cfg.observation.targets == COUNT
    config = LookaheadConfig(rollout_policy=str(folder), horizon=2, candidates=3)
    LookaheadPlanner(env, config)(None)
    with pytest.raises(UserError, match=r"lookahead\.rollout_policy.*observation\.radio=true"):
        LookaheadPlanner(plain, config)


def test_its_names_are_its_own():
    assert not {*FEATURES} & {*RADIO_TABLE} and feature_names() == FEATURES
    assert feature_names(True)[: len(FEATURES)] == FEATURES
