"""One's own policies: a word means the same wherever a policy is named, and every mistake is told in a sentence."""

import json
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env

from maexp.agents import make_policy
from maexp.agents.cli import main
from maexp.agents.config.overrides import make_overrides
from maexp.agents.errors import UserError
from maexp.agents.policies.registry import NamedPolicy, find_named_policy, name_policies, policy_label, suit_observation
from maexp.agents.policies.remote import user_policy
from maexp.envs import ObservationConfig

SMALL = ["scenario.held_out=[70,71]", "episodes=2", "num_envs=2", "scenario.macro_steps=2", "device=cpu"]
MODULE = '''
import torch
import numpy as np

def make(env):
    from maexp.agents.policies import POLICIES
    return POLICIES["nearest_frontier"](env)

class Corner:
    """Sends everybody to one corner."""
    def __init__(self, env):
        self.shape = (env.num_envs, env.num_robots)
    def __call__(self, td):
        td["agents", "action", "region"] = torch.zeros(self.shape, dtype=torch.int64)
        td["agents", "action", "offset"] = torch.zeros(*self.shape, 2)

class Stay:
    def act(self, observation):
        return np.full((len(observation["alive"]), 2), np.nan)

class First:
    def __init__(self, env):
        self.shape = (env.num_envs, env.num_robots)
    def __call__(self, td):
        td["agents", "action", "target"] = torch.zeros(self.shape, dtype=torch.int64)
        return td

def nothing(env):
    pass

def an_agent(env):
    return Stay()

def looks(env):
    return lambda td: td["agents", "observation", "targets"]


def raises(env):
    raise RuntimeError("no weights")

def odd(what):
    def make(env):
        def policy(td):
            td = td.clone()
            shape = (env.num_envs, env.num_robots)
            action = {"region": torch.zeros(shape, dtype=torch.int64), "offset": torch.zeros(*shape, 2)}
            answer = what(action)
            if answer is not None and not isinstance(answer, dict):
                return answer
            for name, value in action.items():
                td["agents", "action", name] = value
            return td
        return policy
    return make

number = odd(lambda action: 3)
no_action = odd(lambda action: action.clear())
no_offset = odd(lambda action: action.__delitem__("offset"))
flat = odd(lambda action: action.update(goal=action["offset"][..., 0]))
endless = odd(lambda action: action.update(goal=action["offset"] / 0))
wide = odd(lambda action: action.update(offset=action["offset"][..., :1]))
floats = odd(lambda action: action.update(region=action["region"].float()))
beyond = odd(lambda action: action.update(region=action["region"] + 64))
not_finite = odd(lambda action: action.update(offset=action["offset"] * float("nan")))
divides = odd(lambda action: 1 // 0)
value = 3
agent = Stay()
'''


@pytest.fixture(autouse=True)
def module(tmp_path, monkeypatch):
    """A module in the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_robots.py").write_text(MODULE)
    (tmp_path / "broken_robots.py").write_text("import does_not_exist_either\n")
    (tmp_path / "raising_robots.py").write_text("raise ValueError('two\\nlines')\n")
    sys.modules.pop("my_robots", None)  # of another test
    yield tmp_path
    for name in ("my_robots", "broken_robots", "raising_robots"):
        sys.modules.pop(name, None)
    sys.path[:] = [folder for folder in sys.path if folder != str(tmp_path)]


def evaluated(folder: str, *specs: str) -> dict:
    said = {spec.partition("=")[0] for spec in specs}
    small = [spec for spec in SMALL if spec.partition("=")[0] not in said]
    assert main(["evaluate", *small, *specs, f"hydra.run.dir={folder}"]) == 0
    return json.loads(Path(folder, "results.json").read_text())


def test_ones_own_policies_stand_in_the_table_beside_the_others(capsys):
    named = "policy=my_robots:make,my_robots:Corner,my_robots:Stay,universal,nearest_frontier"
    found = evaluated("out", named, "episodes=8")
    assert list(found)[:5] == ["my_robots.make", "my_robots.Corner", "my_robots.Stay", "universal", "nearest_frontier"]
    assert found["my_robots.make"] == found["nearest_frontier"]
    assert found["my_robots.Stay"]["path_length"]["mean"] == 0.0 < found["my_robots.Corner"]["path_length"]["mean"]
    assert set(found["difference"]) == {"my_robots.make", "my_robots.Corner", "my_robots.Stay", "universal"}
    assert "my_robots.Stay is behind nearest_frontier" in capsys.readouterr().out


def test_a_callable_may_choose_targets_and_a_word_means_the_same_from_python():
    shown = ObservationConfig(pictures=False, targets=24)
    env = make_env(2, observation=shown)
    for spec in ("my_robots:First", "my_robots:Stay", "universal", "voronoi"):
        state = make_policy(spec, env)(env.reset())
        assert ("agents", "action") in state.keys(True), spec
        env.step(state)
    made = make_policy(make_env(1))
    assert len(list(made.parameters())) and len(list(make_policy(env=make_env(1), model="small").parameters()))
    for call in (lambda: make_policy(make_env(1), "paper"), lambda: make_policy(make_env(1), model="paper")):
        assert sum(p.numel() for p in call().parameters()) > sum(p.numel() for p in made.parameters())
    with pytest.raises(UserError, match=r"universal looks at 24 targets, and the env shows 0.*targets=24"):
        make_policy("universal", make_env(1))
    with pytest.raises(UserError, match="policy=universel is unknown: did you mean universal"):
        make_policy("universel", env)


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("nowhere:make", "policy=nowhere:make: there is no module nowhere, neither in this folder nor installed"),
        ("my_robots.sub:make", "importing my_robots.sub raised|there is no module my_robots.sub"),
        ("broken_robots:make", "importing broken_robots raised ModuleNotFoundError in broken_robots.py, line 1"),
        ("raising_robots:make", "importing raising_robots raised ValueError in raising_robots.py, line 1: two lines"),
        ("my_robots:mak", "my_robots has no mak: it has make, Corner, Stay"),
        ("my_robots:value", "value is a int, which cannot be called: give a function that takes the env"),
        ("my_robots:agent", "agent is a Stay, which cannot be called: name its class"),
        ("my_robots:nothing", "policy my_robots.nothing: called with the env it returned nothing"),
        ("my_robots:an_agent", "called with the env it returned a Stay: name its class itself"),
        ("my_robots:raises", r"calling it with the env raised RuntimeError in my_robots.py, line \d+: no weights"),
        ("my_robots:looks", r"raised KeyError.* The env shows no targets: add observation.targets=24\."),
        ("my_robots:number", "policy my_robots.number returned a int: return the tensordict"),
        ("my_robots:flat", r"policy my_robots.flat wrote a goal of shape \[\d+, 3\]: "),
        ("my_robots:endless", "policy my_robots.endless wrote a goal that is NaN or infinite: "),
        ("my_robots:no_action", "policy my_robots.no_action wrote no action: .* must hold goal, float"),
        ("my_robots:no_offset", "policy my_robots.no_offset wrote no offset"),
        ("my_robots:wide", r"wrote a offset of shape \[1, 3, 1\]"),
        ("my_robots:floats", "wrote a region of float32"),
        ("my_robots:beyond", "wrote region 64, of 64 there are"),
        ("my_robots:not_finite", "wrote a offset that is NaN or infinite"),
        ("my_robots:divides", r"policy my_robots.divides raised ZeroDivisionError in my_robots.py, line \d+"),
        ("my_robots", "policy=my_robots is a module: name its class or function, as policy=my_robots:NAME"),
        ("their_robots", "policy=their_robots is unknown: choose one of .*or module:function of your own"),
        (".", "policy=. is a folder without a policy: it holds neither the contract.json of maexp export nor"),
        ("my_robots.py", "policy=my_robots.py is a module: name its class or function, as policy=my_robots:NAME"),
        ("x" * 5000, "policy=x+ is unknown"),
    ],
)
def test_every_mistake_is_a_sentence_that_names_the_policy(spec, told):
    env = make_env(1)
    with pytest.raises(UserError, match=told) as error:
        find_named_policy(spec).make(env)(env.reset())
    assert "\n" not in str(error.value) and len(str(error.value)) < 600


def test_a_plug_in_is_found_by_its_name(monkeypatch, capsys):
    points = [
        metadata.EntryPoint(name, value, user_policy.GROUP)
        for name, value in (("swarm", "my_robots:Stay"), ("bent", "my_robots"), ("voronoi", "my_robots:Corner"))
    ]
    monkeypatch.setattr(
        user_policy.metadata, "entry_points", lambda group: [point for point in points if point.group == group]
    )
    found = find_named_policy("swarm")
    assert (found.name, found.kind, found.pictures) == ("swarm", "own", False)
    assert find_named_policy("voronoi").kind == "classical", "names of ours come first"
    with pytest.raises(UserError, match="policy=bent .*an entry point of maexp.policies is written module:function"):
        find_named_policy("bent")
    assert "swarm" in str(pytest.raises(UserError, find_named_policy, "swarn").value)


def test_names_in_tables_are_unique_and_readable(tmp_path):
    for folder in ("a/best", "b/best", "run"):
        (tmp_path / folder).mkdir(parents=True)
    assert policy_label("my_robots:Corner") == "my_robots.Corner"
    specs = ["outputs/mappo_3/checkpoints/iteration_000040.pt", "outputs/mappo_3/checkpoints/best.pt"]
    assert [policy_label(spec) for spec in specs] == ["mappo_3_iteration_40", "mappo_3_best"]
    named = name_policies(["a/best", "b/best", "run", "voronoi"], taken=["mappo"])
    assert list(named.values()) == ["best", "b-best", f"{tmp_path.name}-run", "voronoi"]
    for specs in (["voronoi", "voronoi"], ["a/best", "./a/best"]):
        with pytest.raises(UserError, match="twice"):
            name_policies(specs)


def policy(name: str, **shown) -> NamedPolicy:
    return NamedPolicy(name, lambda env: None, "own", **shown)


def test_an_env_shows_what_its_policies_look_at_and_no_more():
    from maexp.agents.config.compose import compose_settings

    def suited(*policies, specs=()):
        cfg = compose_settings("evaluate", ["policy=random", *specs])
        suit_observation(cfg, policies)
        return cfg.observation.targets, cfg.observation.pictures, cfg.observation.map

    assert suited(policy("a")) == (0, False, "seen"), "pictures that nobody looks at"
    assert suited(policy("a", targets=24), policy("b", pictures=True)) == (24, True, "seen")
    assert suited(policy("a", pictures=True, map="known")) == (0, True, "known")
    for policies, specs in (
        ([policy("a", targets=24), policy("b", targets=8)], []),
        ([policy("a", targets=24)], ["observation.targets=8"]),
        ([policy("a", pictures=True, map="known"), policy("b", pictures=True, map="seen")], []),
    ):
        with pytest.raises(UserError, match="cannot play together"):
            suited(*policies, specs=specs)


def test_folders_of_any_name_stand_in_lists(tmp_path):
    (tmp_path / "a b" / "c=(1)").mkdir(parents=True)
    assert make_overrides("evaluate", ["policy=universal,a b/c=(1),m:f"]) == ["policy=[universal,'a b/c=(1)','m:f']"]
    assert make_overrides("evaluate", ["policy=[universal,m:f]"]) == ["policy=[universal,'m:f']"]
    assert make_overrides("evaluate", ["policy=a b/c=(1)"]) == ["policy='a b/c=(1)'"]
    assert make_overrides("evaluate", ["policy=null"]) == ["policy=null"]
    there = tmp_path / "a b" / "c=(1)"
    assert make_overrides("benchmark", ["policies=[voronoi,a b/c=(1)]"]) == [f"policies=[voronoi,'{there}']"]
    assert make_overrides("benchmark", ["policies=[]"]) == ["policies=[]"]


def test_a_foreign_policy_cannot_steer():
    with pytest.raises(UserError, match=r"planner=direct takes controls, and my_robots.Stay picks goals"):
        find_named_policy("my_robots:Stay").make(make_env(1, planner="direct"))
    state = make_env(1)
    policy = make_policy("my_robots:Corner", state)
    td = policy(state.reset())
    assert td[REGION].dtype == torch.int64 and td[OFFSET].shape == (1, 3, 2)
    assert np.isfinite(td[OFFSET].numpy()).all()
