"""A trained policy leaves torch: features and logits are the same, and a damaged folder is a sentence."""

import hashlib
import json
import shutil

import numpy as np
import pytest
import torch
from runtime_cases import inputs
from test_planner import survey

from maexp.agents import ModelConfig, make_policy
from maexp.agents.cli import main
from maexp.agents.deploy.planner.bundle import LearnedChoice
from maexp.agents.deploy.planner.features import Candidates, Motion, list_candidates
from maexp.agents.errors import UserError
from maexp.agents.policies.export import export_policy, find_chooser
from maexp.agents.runtime import TeamPlanner
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, make_map
from maexp.envs.targets.features import FEATURES, TABLE, Feature
from maexp.envs.targets.heuristics import LEAST_GAIN
from maexp.envs.targets.navigation import Navigation


def make_env(num_robots: int = 3, scenario: str = "maze_small") -> ExplorationEnv:
    return ExplorationEnv(
        maps=[make_map(scenario, 1)],
        num_envs=1,
        num_robots=num_robots,
        seed=5,
        num_threads=1,
        planner=PlannerConfig(name="wavefront"),
        observation=ObservationConfig(targets=24),
    )


def motion_of(env: ExplorationEnv) -> Motion:
    robots = env.simulation.robot_tensors
    return Motion(float(robots["max_speed"].max()), float(robots["max_accel"].max()), 0.1 * env.local_steps)


def play(env: ExplorationEnv, steps: int = 5):
    """Moments of an episode: what the env shows, our candidates, the moment, and where robots last went [m]."""
    nav, td = Navigation(env), env.reset()
    last, draw = np.full((env.num_robots, 2), np.nan), np.random.default_rng(0)
    for step in range(steps):
        nav.update()
        now = inputs(env, nav)
        heading, speed = nav.state["pose"][0, :, 3].numpy(), env.target_view.tracker.speed(nav)[0].numpy()
        here, left = last - np.array(now.call["origin"]), 1.0 - step / env.macro_steps
        ours = list_candidates(survey(now), 24, heading, speed, here, left, motion_of(env))
        seen = td["agents", "observation"]
        yield seen, ours, now, {"velocities": speed, "time_left": left}, last
        index = torch.as_tensor(draw.integers(0, seen["targets_mask"].sum(-1).min(), (1, env.num_robots)))
        td["agents", "action", "target"] = index
        td = env.step(td)["next"]
        last = env.target_view.state["last"][0].numpy().astype(float)
        if td["done"].any():
            break


@pytest.mark.parametrize("num_robots", [1, 3])
def test_features_are_those_of_the_env(num_robots):
    count, planned = 0, FEATURES.index("planned")
    for seen, ours, now, *_ in play(make_env(num_robots)):
        assert np.array_equal(seen["targets_mask"][0].numpy(), ours.mask)
        there, block = seen["targets"][0].numpy(), now.env.target_view.state["block"][0].numpy()
        targets = survey(now).targets
        across = -(-now.call["grid"].shape[1] // targets.side)
        number = targets.block[ours.target] @ (1, across)
        for robot, some in enumerate(ours.mask):  # targets of the same value may stand in another order
            both = ((ours.features, number), (there, block))
            a, b = (columns[robot, some][np.argsort(key[robot, some])] for columns, key in both)
            assert np.array_equal(np.sort(number[robot, some]), np.sort(block[robot, some]))
            np.testing.assert_allclose((a[:, planned] * a[:, 0]).sum(), (b[:, planned] * b[:, 0]).sum(), atol=1e-5)
            edge = np.abs(a[:, FEATURES.index("gain")] - LEAST_GAIN) < 1e-4  # there rounding says what is worth a way
            a[edge, FEATURES.index("worth")] = b[edge, FEATURES.index("worth")]
            for column in set(range(len(FEATURES))) - {planned}:
                np.testing.assert_allclose(a[:, column], b[:, column], atol=2e-4, err_msg=FEATURES[column])
        count += int(ours.mask.sum())
    assert count > 20


def test_a_feature_of_ones_own_is_the_same_for_robots(monkeypatch):
    """A row of the table is all that it takes: here how many others are within the radar's range."""

    def crowd(now):
        gap = now.length(now.at[..., :, None, :] - now.at[..., None, :, :])
        return 1.0 * now.xp.sum(now.mates & (gap < 1.0), -1)[..., None]

    monkeypatch.setitem(TABLE, "crowd", Feature(crowd, "robots", "others within the radar's range"))
    found = set()
    for seen, ours, now, *_ in play(make_env(3)):
        there = now.env.target_view.show(now.env.target_view.tracker.look())[0]["features"][0].numpy()
        assert ours.features.shape[-1] == there.shape[-1] == len(FEATURES) + 1
        np.testing.assert_array_equal(ours.features[..., -1], there[..., -1])
        found |= set(there[..., -1][seen["targets_mask"][0].numpy()].tolist())
    assert len(found) > 1


@pytest.fixture(scope="module")
def policy():
    """An untrained policy whose head says something."""
    torch.manual_seed(3)
    made = make_policy(make_env(), ModelConfig(action="targets"))
    torch.nn.init.normal_(find_chooser(made).head.weight, std=0.1)
    return made


@pytest.fixture(scope="module")
def folder(policy, tmp_path_factory):
    for name in ("onnx", "onnxscript", "onnxruntime", "safetensors"):
        pytest.importorskip(name, reason=f"THE EXTRA maexp[export] IS NOT INSTALLED ({name}): folders are not tested")
    where = tmp_path_factory.mktemp("policies") / "small"
    export_policy(policy, make_env(), where, "small", "# small\n", {"scenarios": ["maze_small"]})
    return where


@pytest.mark.parametrize("num_robots", [1, 3, 5])
def test_logits_are_those_of_torch_on_recorded_observations(policy, folder, num_robots):
    network, learned, batch = find_chooser(policy), LearnedChoice(folder), []
    for seen, ours, *_ in play(make_env(num_robots)):
        inputs = [seen[name] for name in ("targets", "targets_mask", "comm")]
        batch.append(inputs)
        with torch.no_grad():
            wanted = network(*inputs)[0][0].log_softmax(-1).numpy()
        given = learned.logits(Candidates(inputs[0][0].numpy(), inputs[1][0].numpy(), ours.target))
        given = torch.as_tensor(given).log_softmax(-1).numpy()
        np.testing.assert_allclose(given[ours.mask], wanted[ours.mask], atol=1e-5, rtol=1e-6)
        assert np.array_equal(given.argmax(-1), wanted.argmax(-1))
    several = [torch.cat(parts) for parts in zip(*batch, strict=True)]
    names = ("features", "mask", "comm")
    given = learned.session.run(["logits"], dict(zip(names, [tensor.numpy() for tensor in several], strict=True)))[0]
    with torch.no_grad():
        assert np.array_equal(given.argmax(-1), network(*several)[0].argmax(-1).numpy())


def test_the_runtime_takes_the_targets_that_the_policy_takes(policy, folder):
    network, count = find_chooser(policy), 0
    planner = None
    for seen, _, now, more, last in play(make_env()):
        planner = planner or TeamPlanner(folder, **now.settings)
        planner.last = {name: goal for name, goal in enumerate(last) if np.isfinite(goal).all()}
        plan = planner.plan(**now.call, **more, now=float(count))
        with torch.no_grad():
            index = network(*(seen[name] for name in ("targets", "targets_mask", "comm")))[0][0].argmax(-1)
        wanted = now.env.target_view.state["point"][0, torch.arange(3), index].numpy()
        np.testing.assert_allclose(plan.goals, wanted, atol=1e-4)
        count += 1
    assert count >= 3


def test_the_contract_gives_the_defaults(folder):
    planner, env = TeamPlanner(folder), make_env()
    assert planner.radar_range == env.radar_configs[0].range
    assert planner.robot_radius == pytest.approx(0.75)
    assert planner.motion == planner.learned.contract.motion == motion_of(env)
    assert TeamPlanner(folder, radar_range=4.0).radar_range == 4.0


@pytest.mark.parametrize(
    "file, change, part",
    [
        ("policy.onnx", lambda data: data[:-7] + b"changed", "is not the file that its contract names"),
        ("policy.onnx", None, "is not the folder of a policy: No such file"),
        ("contract.json", lambda data: data[:50], "is not JSON"),
        ("contract.json", lambda data: b"[]", "is not a contract of the kind"),
        ("contract.json", lambda data: b"[" * 100_000, "is not JSON"),
        ("contract.json", lambda data: data.replace(b'"detour"', b'"other"'), "was made for other features"),
        ("contract.json", lambda data: data.replace(b'"seconds"', b'"hours"'), "lacks one of"),
        ("contract.json", lambda data: data.replace(b'"candidates": 24', b'"candidates": -1'), "lacks one of"),
    ],
)
def test_a_damaged_folder_is_a_sentence(folder, tmp_path, file, change, part):
    broken = shutil.copytree(folder, tmp_path / "broken")
    data = (broken / file).read_bytes()
    (broken / file).unlink()
    if change is not None:
        assert change(data) != data
        (broken / file).write_bytes(change(data))
    with pytest.raises(ValueError) as caught:
        TeamPlanner(broken)
    assert part in str(caught.value) and "\n" not in str(caught.value)


def give_network(folder, data: bytes) -> None:
    """Another network, with the checksum that belongs to it."""
    (folder / "policy.onnx").write_bytes(data)
    contract = json.loads((folder / "contract.json").read_text())
    contract["sha256"]["policy.onnx"] = hashlib.sha256(data).hexdigest()
    (folder / "contract.json").write_text(json.dumps(contract))


def test_a_foreign_network_is_a_sentence(folder, tmp_path):
    broken = shutil.copytree(folder, tmp_path / "broken")
    give_network(broken, b"nothing")
    with pytest.raises(ValueError, match="is not a network that onnxruntime runs"):
        TeamPlanner(broken)
    whole = (folder / "policy.onnx").read_bytes()
    assert whole.count(b"logits")
    give_network(broken, whole.replace(b"logits", b"values"))
    with pytest.raises(ValueError, match="gives values, and no logits: export the policy again"):
        TeamPlanner(broken)


def test_what_cannot_be_exported_is_a_sentence(policy, folder, tmp_path):
    with pytest.raises(UserError, match="holds something already"):
        export_policy(policy, make_env(), folder, "small", "", {})
    regions = make_policy(ExplorationEnv(maps=[make_map("maze_small", 1)], num_envs=1), "small")
    with pytest.raises(UserError, match="action=targets"):
        export_policy(regions, make_env(), tmp_path / "new", "regions", "", {})
    assert not (tmp_path / "new").exists()


def test_weights_are_kept_without_pickle(policy, folder):
    from safetensors.torch import load_file

    weights, there = load_file(folder / "weights.safetensors"), find_chooser(policy).state_dict()
    assert weights.keys() == there.keys() and all(torch.equal(weights[name], there[name]) for name in there)


def test_from_a_run_to_a_plan(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = (
        "scenario=maze_small",
        "scenario.macro_steps=2",
        "scenario.local_steps=3",
        "scenario.maps=[0]",
        "scenario.held_out=[1]",
    )
    train = (
        "total_frames=8",
        "num_envs=2",
        "episodes=2",
        "evaluate_every=0",
        "classical=[]",
        "device=cpu",
        "hydra.run.dir=run",
    )
    assert main(["train", "action=targets", *small, *train]) == 0
    assert main(["export", "run", "out=made", "note=The first of three."]) == 0
    told = capsys.readouterr().out
    assert "Written to made: card.md" in told and "policy.onnx (" in told
    card = (tmp_path / "made" / "card.md").read_text()
    assert card.startswith("# made\n") and "| trained | " in card and "| random | " in card and "maze_small" in card
    assert "\n\nThe first of three.\n\n## Results" in card
    grid = np.full((60, 80), -1)
    grid[:, :40], grid[:, 0] = 0, 100
    poses = {"a": (1.0, 1.0, 0.0), "b": (1.0, 3.0, 1.5)}
    settings = {"radar_range": 3.0, "robot_radius": 0.3}
    plan = TeamPlanner("made", **settings).plan(grid, 0.1, (0, 0), poses, velocities=[0.2, 0.0], time_left=0.8)
    assert plan.active.all() and not plan.notes
    assert main(["export", "run", "out=made"]) == 2
    assert "made holds something already" in capsys.readouterr().err
    assert main(["export", "run"]) == 2
    assert "out is missing" in capsys.readouterr().err


def test_the_command_needs_a_run_and_a_place(capsys):
    assert main(["export"]) == 2
    assert "maexp: Nothing to export: give a run" in capsys.readouterr().err
    assert main(["export", "nowhere", "out=small"]) == 2
    assert "nowhere does not exist" in capsys.readouterr().err
