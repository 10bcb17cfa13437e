"""The table of state and scratch (`kernels/state.py`) is true: arrays, shapes, types."""

import pytest
import torch
from kernel_source import arguments, kernels
from worlds import room

from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    FaultsConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
)
from maexp.envs.simulation import TRACK_LENGTH
from maexp.envs.specs import REWARD_TERMS
from maexp.kernels import state as plane_state
from maexp.kernels import step
from maexp.kernels.observe import picture_shapes
from maexp.kernels.planner import find_paths, pick_waypoints, set_goals
from maexp.kernels.state import AXES, SCRATCH, STATE
from maexp.kernels.volume import state as volume_state

FIELDS = STATE | SCRATCH
PLANNERS = ("dwa", "wavefront", "direct")


def make(planner: str, limited: bool, robots: int = 2, envs: int = 2, worlds=None, delay=0.2) -> ExplorationEnv:
    return ExplorationEnv(
        worlds or [room(22, 19)],
        num_envs=envs,
        num_robots=robots,
        local_steps=3,
        num_threads=1,
        planner=PlannerConfig(name=planner),
        comm=CommConfig(range=9.0, signal=True, delay=delay) if limited else None,
        observation=ObservationConfig(map="known"),
        faults=FaultsConfig(probability=0.5) if limited else None,
        radar=RadarConfig(evidence=2, false_alarm=0.1) if limited else None,
        odometry=OdometryConfig(drift=0.1, map_errors=True) if limited else None,
    )


def launches_of(env: ExplorationEnv) -> list[tuple]:
    """Every launch of a macro step, an observation and a reset: kernel, and the field (or None) of each argument."""
    found = []
    e, n = env.num_envs, env.num_robots
    for shard in env.simulation.shards:
        fields = {id(array): name for name, array in vars(shard.view).items()}

        def launch(kernel, dim, given, fields=fields):
            found.append((kernel, [fields.get(id(array)) for array in given]))

        pictures = [torch.zeros(shape, dtype=torch.uint8) for shape in picture_shapes(e, n)]
        for stage in (set_goals, find_paths, pick_waypoints, step.local_step, step.reset):
            stage(launch, shard)
        step.observe(launch, shard, *pictures, torch.zeros(e, n, 4), torch.zeros(e, n, 4, 8, 8))
    return found


@pytest.fixture(scope="module")
def met() -> list[tuple]:
    """The launches of every planner, with perfect and with limited communication, messages late or not."""
    envs = [make(planner, limited) for planner in PLANNERS for limited in (False, True)]
    return [launch for env in (*envs, make("dwa", True, delay=0.0)) for launch in launches_of(env)]


@pytest.mark.parametrize("robots, limited, envs", [(1, False, 5), (3, True, 4), (35, True, 2), (34, False, 3)])
def test_every_array_stands_in_the_table(robots, limited, envs):
    env = make("dwa", limited, robots, envs, [room(22, 19), room(31, 17)])
    tensors, bank = env.simulation.tensors, env.bank
    assert set(tensors) == set(FIELDS)
    words = 1 + (robots > 32)
    free, boundary = max(len(m.free) for m in env.maps), max(len(m.boundary) for m in env.maps)
    lengths = {
        "E": envs,
        "N": robots,
        "W": words,
        "F": free,
        "B": boundary,
        "H": words if limited else 1,
        "P": free if limited else 1,
        "Q": boundary if limited else 1,
        "L": words if limited else 1,
        "Z": free if limited else 1,
        "r": robots if limited else 1,
        "f": free if limited else 1,
        "b": boundary if limited else 1,
        "c": env.simulation.nav_cells if limited else 1,
        "X": robots if limited else 1,
        "S": robots,
        "M": 3,
        "1": 1,
        "R": len(REWARD_TERMS),
        "V": bank.free_in_range,
        "O": bank.boundary_in_range,
        "D": 384,
        "T": min(3 * env.macro_steps + 1, TRACK_LENGTH),
    }
    vectors = {"vec2f": (2,), "vec3f": (3,), "vec4f": (4,)}
    for name, field in FIELDS.items():
        axes = field.axes.split()
        assert set(axes) <= set(AXES), name
        vector = vectors.get(field.kind.__name__, ())
        given = tensors[name].shape
        assert len(given) == len(axes) + len(vector) and given[len(axes) :] == vector, name
        for axis, length in zip(axes, given, strict=False):
            assert length == lengths.get(axis, length), f"{name}: axis {axis}"
        assert tensors[name].dtype == (torch.float32 if vector else field.dtype), name
        view = vars(env.simulation.shards[0].view)[name]
        assert view.dtype is field.kind and view.shape == given[: len(axes)], name


def test_headings_name_the_table_that_an_array_is_of(met):
    """`State in:` and the like for the fields of `STATE`, `Scratch` ones for those of `SCRATCH`, neither for others."""
    given = {}
    for kernel, fields in met:
        for argument, name in zip(arguments(kernel), fields, strict=True):
            given.setdefault((kernel.module.name, kernel.key, argument.name), (argument, set()))[1].add(name)
    for kernel in kernels().values():  # those of `Navigation` are met by their names only
        for argument in arguments(kernel):
            volume = kernel.module.name.startswith("maexp.kernels.volume.")  # nobody has met these, scratch included
            known = argument.heading.startswith(("State", "Scratch ") if volume else "State")
            name = argument.name if known else None
            given.setdefault((kernel.module.name, kernel.key, argument.name), (argument, {name}))
    for (module, kernel, _), (argument, names) in given.items():
        own = names & {argument.name} or names  # `active` stands for `mask` where a reset scans
        tables = volume_state if module.startswith("maexp.kernels.volume.") else plane_state
        table = {"State" if name in tables.STATE else "Scratch" if name in tables.SCRATCH else "" for name in own}
        heading = argument.heading
        kind = heading.split()[0] if heading.startswith("State") or heading.startswith("Scratch ") else ""
        assert table == {kind} or own == {"map_id"}, f"{kernel}: {argument.name} ({own}) under {heading!r}"


def test_signatures_name_the_axes_of_the_table(met):
    """What a kernel calls the axes of an argument is what the table calls those of the array it gets."""
    common = {"free": "point", "boundary": "point", "1": "word"}
    for kernel, fields in met:
        for argument, name in zip(arguments(kernel), fields, strict=True):
            if name is not None:
                axes = [AXES[axis][0] for axis in FIELDS[name].axes.split()]
                fits = [given in (axis, common.get(axis)) for given, axis in zip(argument.shape, axes, strict=True)]
                assert all(fits), f"{kernel.key}: {argument.name} {argument.shape}, the table has {name} {axes}"


def test_each_field_says_what_it_is():
    for name, field in FIELDS.items():
        assert len(field.meaning) > 10, name
    assert not set(STATE) & set(SCRATCH)
