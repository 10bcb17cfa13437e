"""The target generator and the critics: any team size, no order among robots, nobody unheard, right pixels."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type
from toy_env import ToyEnv

from maexp.agents import ModelConfig, make_policy
from maexp.agents.algorithms.registry import find_algorithm
from maexp.agents.config.model import SIZES, model_config
from maexp.agents.models.actor import CELLS, MAP
from maexp.agents.models.critics import TEAM_VALUE, VALUE, build_critic
from maexp.agents.models.encoder import STRIDE, add_rows, add_state, compact, pool_regions, resampling
from maexp.agents.training.collectors import make_collector

PIXELS, SIDE = 29, 3
CONV = ModelConfig(stem="conv", channels=8, grid_features=8, depth=2, heads=2, merge_maps=False, critic_hidden=16)
MODELS = {"small": "small", "conv": CONV}


def states(batch, robots, seed=0) -> TensorDict:
    """Random observations whose regions cover most of the picture."""
    generator = torch.Generator().manual_seed(seed)
    pose = torch.rand(batch, robots, 4, generator=generator) * 2 - 1
    line = (torch.arange(SIDE) * 2 + 1) / SIDE - 1
    place = torch.stack(torch.meshgrid(0.9 * line, 0.6 * line, indexing="ij"))
    goal = torch.rand(batch, robots, 2, generator=generator)
    offsets = [(place - at[..., None, None]) / 2 for at in (pose[..., :2], goal)]
    observation = {
        "map": torch.randint(0, 256, (batch, robots, 4, PIXELS, PIXELS), generator=generator, dtype=torch.uint8),
        "pose": pose,
        "grid": torch.cat(offsets, dim=2),
        "comm": torch.ones(batch, robots, robots, dtype=torch.bool),
        "time_left": torch.rand(batch, robots, 1, generator=generator),
        "alive": torch.rand(batch, robots, generator=generator) < 0.7,
    }
    return TensorDict({"agents": {"observation": observation}}, batch_size=[batch])


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]


@pytest.fixture
def env():
    return ToyEnv(num_envs=2, side=SIDE, pixels=PIXELS)


def awake(network):
    """Undo the quiet start, so that what must not depend on something cannot hide in small numbers."""
    torch.manual_seed(1)
    for p in network.parameters():
        torch.nn.init.normal_(p, std=0.4)
    return network


def logits(policy, td) -> torch.Tensor:
    with torch.no_grad():
        return policy.module[0](td.clone())["agents", "params", "region", "logits"]


@pytest.mark.parametrize("robots", [1, 2, 6, 8])
def test_one_set_of_weights_serves_every_team_size(env, model, robots):
    policy = make_policy(env, model)
    td = policy(states(5, robots))
    assert td["agents", "action", "region"].shape == (5, robots)
    assert td["agents", "action", "region"].dtype == torch.int64
    assert td["agents", "action", "offset"].shape == (5, robots, 2)
    for head in ("region", "offset"):
        assert td["agents", "action", f"{head}_log_prob"].shape == (5, robots)
    for kind in ("local", "team", "mixed"):
        assert build_critic(kind, env, model)(states(5, robots))[VALUE].shape == (5, robots, 1)


def test_leading_shapes_make_no_difference(env, model):
    policy = awake(make_policy(env, model))
    td = states(6, 3)
    flat = logits(policy, td)
    torch.testing.assert_close(logits(policy, td.reshape(2, 3)), flat.unflatten(0, (2, 3)))
    torch.testing.assert_close(logits(policy, td[2]), flat[2], atol=1e-5, rtol=1e-4)


def permuted(td, order) -> TensorDict:
    out = td.clone()
    for name in ("map", "pose", "grid", "time_left", "alive"):
        out["agents", "observation", name] = td["agents", "observation", name][:, order]
    out["agents", "observation", "comm"] = td["agents", "observation", "comm"][:, order][:, :, order]
    return out


def test_permuting_robots_permutes_logits_and_values(env, model):
    order = torch.tensor([2, 0, 3, 1])
    td = states(3, 4)
    td["agents", "observation", "comm"][:, 0, 1] = False
    other = permuted(td, order)
    policy = awake(make_policy(env, model))
    torch.testing.assert_close(logits(policy, other), logits(policy, td)[:, order], atol=2e-4, rtol=1e-3)
    for kind in ("local", "team", "mixed"):
        critic = awake(build_critic(kind, env, model))
        a, b = critic(td.clone()), critic(other.clone())
        torch.testing.assert_close(b[VALUE], a[VALUE][:, order], atol=2e-4, rtol=1e-3)
        if kind == "mixed":
            torch.testing.assert_close(b[TEAM_VALUE], a[TEAM_VALUE], atol=2e-4, rtol=1e-3)


def changed(td, robot, name) -> TensorDict:
    """The same states with one part of one robot's observation drawn anew."""
    out = td.clone()
    new = states(td.shape[0], td["agents", "observation", "pose"].shape[1], seed=9)["agents", "observation", name]
    new = ~td["agents", "observation", name] if name == "alive" else new
    out["agents", "observation", name][:, robot] = new[:, robot]
    return out


@pytest.mark.parametrize("name", ["map", "pose", "grid", "time_left", "alive"])
def test_only_robots_in_contact_matter(env, model, name):
    policy = awake(make_policy(env, model))
    td = states(3, 3)
    before, after = logits(policy, td), logits(policy, changed(td, 2, name))
    assert not torch.allclose(before[:, :2], after[:, :2])
    td["agents", "observation", "comm"][:, :2, 2] = False
    before, after = logits(policy, td), logits(policy, changed(td, 2, name))
    assert torch.equal(before[:, :2], after[:, :2])
    assert not torch.allclose(before[:, 2], after[:, 2])


@pytest.mark.parametrize("name", ["map", "pose", "grid", "time_left", "alive"])
def test_team_critic_sees_every_robot_and_local_only_its_own(env, model, name):
    td = states(3, 3)
    td["agents", "observation", "comm"][:] = torch.eye(3, dtype=torch.bool)  # critics do not ask who hears whom
    team, local = (awake(build_critic(kind, env, model)) for kind in ("team", "local"))
    for robot in range(3):
        other = changed(td, robot, name)
        moved = {
            k: critic(td.clone())[VALUE] != critic(other.clone())[VALUE]
            for k, critic in (("team", team), ("local", local))
        }
        assert moved["team"].all(), "a robot's value ignores what another one observes"
        alone = td.clone()
        alone["agents", "observation", "comm"][:] = True
        assert torch.equal(team(alone)[VALUE], team(td.clone())[VALUE]), "a critic asks who hears whom"
        own = torch.arange(3) == robot
        assert (moved["local"][..., 0] == own).all(), "a local value listens to others or not to its own"


def test_policy_starts_near_uniform_and_modes_differ_from_samples(env):
    torch.manual_seed(0)
    policy = make_policy(env)
    td = policy(states(64, 3))
    probabilities = td["agents", "params", "region", "logits"].softmax(-1)
    assert 0.5 / SIDE**2 < probabilities.min() and probabilities.max() < 2 / SIDE**2
    assert len(td["agents", "action", "region"].unique()) == SIDE**2
    scale = td["agents", "params", "offset", "scale"]
    assert ((0.05 <= scale) & (scale <= 1)).all() and td["agents", "params", "offset", "loc"].abs().max() < 0.2
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        calm = policy(states(64, 3))
    assert torch.equal(calm["agents", "action", "region"], probabilities.argmax(-1))
    every, chosen = calm["agents", "params", "offset", "loc"], calm["agents", "action", "region"]
    assert torch.equal(calm["agents", "action", "offset"], every.take_along_dim(chosen[..., None, None], -2)[..., 0, :])


def test_offsets_belong_to_regions_or_are_shared(env):
    for kind, shape in (("per_region", (4, 3, SIDE**2, 2)), ("shared", (4, 3, 2))):
        policy = make_policy(env, ModelConfig(offsets=kind))
        torch.nn.init.normal_(policy.module[0].module.network.cells.weight, std=0.3)
        td = policy(states(4, 3))
        loc = td["agents", "params", "offset", "loc"]
        assert loc.shape == td["agents", "params", "offset", "scale"].shape == shape
        if kind == "per_region":
            assert (loc.std(-2) > 1e-3).all(), "all regions have the same offset"


def test_stored_log_probabilities_are_those_of_the_stored_action(env, model):
    policy = awake(make_policy(env, model))
    td = ToyEnv(num_envs=4, side=SIDE, pixels=PIXELS).rollout(3, policy)
    again = policy.get_dist(td.clone()).log_prob(td)
    for head in ("region", "offset"):
        key = ("agents", "action", f"{head}_log_prob")
        torch.testing.assert_close(again[key], td[key], atol=1e-5, rtol=1e-5)


def test_control_actions_of_the_direct_planner():
    env = ToyEnv(num_envs=4, control=True)
    policy = make_policy(env)
    td = env.rollout(3, policy)
    assert td["agents", "action", "control"].shape == (4, 3, 3, 2)
    seen = {("agents", "observation", k) for k in ("map", "pose", "grid", "comm")}
    assert seen < set(policy.in_keys) and set(make_policy(env, "paper").in_keys) == seen


def test_rows_are_averaged_like_floats():
    picture = torch.randint(0, 256, (2, 3, 11, 7), dtype=torch.uint8)
    padded = torch.nn.functional.pad(picture.float(), (0, 0, 0, 1))
    torch.testing.assert_close(add_rows(picture), padded.unflatten(2, (3, STRIDE)).mean(3) / 255)


def test_a_lit_region_is_the_cell_of_that_region():
    """A picture lit over one region of an oblong map must light that region's cells and no other's."""
    pixels, side = 125, 8
    half = torch.tensor([0.9, 0.3])  # the extent covers little of the square frame along y
    centres = [(2 * torch.arange(side) + 1 - side) / side * reach for reach in half]
    along = (torch.arange(pixels) * 2 + 1) / pixels - 1
    ix, iy = 5, 2
    inside = [(along - c[k]).abs() <= reach / side for c, k, reach in zip(centres, (ix, iy), half, strict=True)]
    picture = (inside[0][:, None] & inside[1][None]).to(torch.uint8) * 255
    cells = pool_regions(picture[None, None], *(c[None] for c in centres))[0, 0].T  # x, y
    by_region = cells.unflatten(0, (side, -1)).unflatten(2, (side, -1)).mean((1, 3))
    assert by_region.argmax() == ix * side + iy
    assert by_region[ix, iy] > 0.8
    by_region[ix - 1 : ix + 2, iy - 1 : iy + 2] = 0
    assert by_region.max() < 0.01


def test_features_of_a_lit_region_land_in_that_regions_cell(env, model):
    model = replace(model_config(model), sees_time=True)
    encoder = make_policy(env, model).module[0].module.network.encoder
    for p in encoder.parameters():
        torch.nn.init.uniform_(p, 0, 0.1)  # no signs: every path counts
    td = states(1, 1)
    parts = [td["agents", "observation", name] for name in ("map", "pose", "grid", "comm")]
    parts[1] = add_state(parts[1], *(td["agents", "observation", name] for name in ("time_left", "alive")))
    dark = torch.zeros_like(parts[0])
    place = parts[1][0, 0, :2, None] + 2 * torch.stack((parts[2][0, 0, 0, :, 0], parts[2][0, 0, 1, 0]))
    for ix, iy in ((0, 2), (2, 1)):
        x, y = (int((place[axis, k] + 1) / 2 * PIXELS) for axis, k in enumerate((ix, iy)))
        lit = dark.clone()
        lit[..., x - 2 : x + 3, y - 2 : y + 3] = 255
        change = encoder(lit, *parts[1:]) - encoder(dark, *parts[1:])
        assert change.abs().sum(-1).argmax() == ix * SIDE + iy


def test_resampling_keeps_constants_and_positions():
    centres = torch.linspace(-0.7, 0.5, 4)[None]
    weights = resampling(centres, 1 / 31 - 1, 2 / 31, 31)[0]
    assert weights.shape == (31, 16)
    torch.testing.assert_close(weights.sum(0), torch.ones(16))
    source = (torch.arange(31) * 2 + 1) / 31 - 1
    torch.testing.assert_close((source @ weights).unflatten(0, (4, 4)).mean(1), centres[0], atol=2e-3, rtol=0)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_compact_pictures_serve_in_place_of_pictures(env, share):
    """Of a policy that hears some, of a critic that sees all and of one that sees itself; gradients too."""
    td = states(4, 3)
    observation = td["agents", "observation"]
    observation["comm"] = torch.rand(4, 3, 3, generator=torch.Generator().manual_seed(3)) < share
    pooled = td.clone()
    parts = (observation[name] for name in ("map", "pose", "grid", "comm"))
    pooled["agents", "observation", "map"] = compact(*parts)
    heads = [("agents", "params", "region", "logits"), VALUE, VALUE]
    networks = [make_policy(env).module[0], *(build_critic(kind, env) for kind in ("team", "local"))]
    for network, head in zip(networks, heads, strict=True):
        awake(network)
        plain, found = (network(batch.clone())[head] for batch in (td, pooled))
        torch.testing.assert_close(found, plain, rtol=5e-6, atol=1e-5)  # sums of hundreds, in another order
        slopes = [
            torch.autograd.grad(value.square().mean(), [*network.parameters()], allow_unused=True)
            for value in (plain, found)
        ]
        for slope, other in zip(*slopes, strict=True):
            assert (slope is None) == (other is None)
            if slope is not None:
                torch.testing.assert_close(other, slope, rtol=1e-3, atol=1e-5 * float(slope.abs().max()))


def test_a_policy_hands_on_what_it_pooled(env):
    """An updater learns from these cells, which are what it would make of the pictures; no pooling, no cells."""
    policy, row = make_policy(env), find_algorithm("mappo")
    updater = row.make_updater(row.make_loss(policy, build_critic("team", env)))
    batch = make_collector(env, policy, 5).next()
    found, plain = updater.prepare(batch), updater.prepare(batch.exclude(CELLS))
    torch.testing.assert_close(found[MAP], plain[MAP], rtol=0, atol=1e-6)
    assert found[MAP].is_floating_point() and found[MAP].std() > 0.01
    batch[CELLS] += 1
    assert (updater.prepare(batch)[MAP] > 0.9).all(), "these were not used"
    assert CELLS not in make_policy(env, CONV)(states(2, 3)).keys(True)


def test_heads_of_the_paper_preset():
    paper = SIZES["paper"]
    assert (paper.width, paper.depth, paper.stem, paper.channels) == (48, 2, "conv", 32)


@pytest.mark.parametrize(
    "given, message",
    [
        (dict(heads=3, channels=16, grid_features=16), "model.heads=3"),
        (dict(depth=0), "model.depth=0"),
        (dict(stem="fft"), "model.stem='fft'"),
    ],
)
def test_bad_sizes_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        ModelConfig(**given)


def test_unknown_preset_and_foreign_env_are_named():
    with pytest.raises(ValueError, match="model='huge'"):
        model_config("huge")
    env = ToyEnv()
    del env.observation_spec["agents", "observation", "comm"]
    with pytest.raises(ValueError, match="comm"):
        make_policy(env)


def test_pictures_and_offsets_of_the_real_env_agree():
    """The seam with `kernels/observe.py`: where pose and grid say robots and regions are, there they are drawn."""
    from maexp.agents.models.encoder import region_centres
    from maexp.envs import ExplorationEnv, make_map

    maze = make_map("maze_small", 3)
    env = ExplorationEnv([maze], num_envs=3, num_robots=2)
    observation = env.rollout(2, make_policy(env))["agents", "observation"].flatten(0, 1).flatten(0, 1)
    along = (torch.arange(125) * 2 + 1) / 125 - 1
    own = (observation["map"][:, 2] == 255).float()
    mass = own.sum((1, 2))
    drawn = torch.stack(((own.sum(2) @ along) / mass, (own.sum(1) @ along) / mass), dim=-1)
    torch.testing.assert_close(drawn, observation["pose"][:, :2], atol=2 / 125, rtol=0)
    (low_x, low_y), (high_x, high_y) = maze.extent
    for centres, low, high in zip(
        region_centres(observation["pose"], observation["grid"]), (low_x, low_y), (high_x, high_y), strict=True
    ):
        side = 1.1 * max(high_x - low_x, high_y - low_y)
        steps = ((torch.arange(8) + 0.5) / 8 - 0.5) * (high - low)
        torch.testing.assert_close(centres, (2 * steps / side).expand(12, 8), atol=0.02, rtol=0)
