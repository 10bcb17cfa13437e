"""The simulation and the planners with the threads of every launch in other orders, one after the other on the CPU.

`python launch_order.py CACHE` prints JSON: for each set-up a hash of all state, observations and actions by order, and
which kernels ran. Warp's loop over the threads of a launch is patched before anything compiles, hence a process and a
kernel cache of its own: the order is read from a field of the launch's bounds that is 1 otherwise.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import torch
import warp as wp
from warp._src import codegen
from warp._src import types as warp_types

ORDERS = {"forward": 1, "reversed": 2, "shuffled": 3, "shuffled, many lanes": 4}
"""Names and numbers of the orders; `many lanes` splits work among threads as on a GPU."""

LOOP = "for (size_t task_index = 0; task_index < dim->size; ++task_index)\n    {{"
ORDERED_LOOP = """
    const size_t order = dim->coord_mult, count = dim->size;
    dim->coord_mult = 1;
    size_t stride = order <= 1 ? 1 : order == 2 ? count - 1 : (count * (10 + order) / 23) | 1;
    for (size_t a = stride, b = count; order > 2 && b != 1; )  // the next stride without a common divisor
    {{
        if (b == 0) {{ a = ++stride; b = count; }}
        else {{ const size_t rest = a % b; a = b; b = rest; if (b == 0 && a == 1) break; }}
    }}
    for (size_t k = 0; k < count; ++k)
    {{
        const size_t task_index = order <= 1 ? k : (k * stride + (order == 2 ? count - 1 : count / 3)) % count;"""


class Order:
    """The order of the launches from now on, and the kernels launched."""

    number = 1
    kernels: set[str] = set()


def patch_warp() -> None:
    """Let bounds carry the order, and the compiled loop follow it."""
    assert LOOP in codegen.cpu_module_template_forward
    template = codegen.cpu_module_template_forward.replace(LOOP, ORDERED_LOOP)
    restore = "        {name}_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);\n    }}"
    assert restore in template
    codegen.cpu_module_template_forward = template.replace(restore, restore + "\n    dim->coord_mult = order;")
    for bounds in warp_types._launch_bounds_classes.values():

        def start(self, shape, before=bounds.__init__):
            before(self, shape)
            self.coord_mult = Order.number

        bounds.__init__ = start
    launch = wp.launch

    def noted(kernel, *args, **kwargs):
        Order.kernels.add(f"{kernel.module.name}.{kernel.key}")
        return launch(kernel, *args, **kwargs)

    wp.launch = noted


@wp.kernel(enable_backward=False)
def _keep_last(out: wp.array(dtype=wp.int32)):
    """Depends on the order: what the last thread writes remains."""
    out[0] = wp.tid()


def last_thread(count: int) -> int:
    out = wp.zeros(1, dtype=wp.int32, device="cpu")
    wp.launch(_keep_last, count, outputs=[out], device="cpu")
    return int(out.numpy()[0])


def threads_met(count: int) -> bool:
    """Whether every thread runs once."""
    out = wp.zeros(count, dtype=wp.int32, device="cpu")
    wp.launch(_count_thread, count, outputs=[out], device="cpu")
    return bool((out.numpy() == 1).all())


@wp.kernel(enable_backward=False)
def _count_thread(out: wp.array(dtype=wp.int32)):
    out[wp.tid()] += 1


def digest(*tensors: torch.Tensor) -> str:
    found = hashlib.blake2b(digest_size=8)
    for tensor in tensors:
        found.update(np.ascontiguousarray(tensor.detach().numpy()).tobytes())
    return found.hexdigest()


def setups() -> dict:
    """Name -> (settings of an env, policy); between them they launch every kernel of the simulation."""
    from maexp.envs import (
        CommConfig,
        FaultsConfig,
        ObservationConfig,
        OdometryConfig,
        PlannerConfig,
        RadarConfig,
        RobotConfig,
    )

    near, sight = CommConfig(range=9.0), CommConfig(range=20.0, line_of_sight=True)
    base = CommConfig(signal=True, power=-12.0, cell=0.1, noise=13.0, loss=0.2, base_station=True)
    kinds = [RobotConfig(kind=kind) for kind in ("ackermann", "differential", "omnidirectional", "ackermann")]
    astray = OdometryConfig(drift=0.2, turn=0.1, jump=0.5, jump_rate=1.0, map_errors=True)
    wrong = RadarConfig(missed=0.5, false_alarm=0.2)
    dwa, wavefront = (PlannerConfig(name=name) for name in ("dwa", "wavefront"))
    return {
        "dwa": (dict(planner=dwa), "cost_utility"),
        "wavefront": (dict(planner=wavefront, observation=ObservationConfig(targets=6)), "potential_field"),
        "wavefront, near": (dict(planner=wavefront, comm=near), "rrt_frontiers"),
        "dwa, sight": (
            dict(planner=dwa, comm=sight, collision="footprint", observation=ObservationConfig(map="known")),
            "hungarian",
        ),
        "mixed team": (dict(planner=wavefront, num_robots=4, robot=kinds, collision="footprint"), "oracle"),
        "large team": (dict(planner=dwa, num_robots=34, comm=near), "random"),
        "signals": (
            dict(
                planner=wavefront, comm=base, done="everyone", num_robots=6, observation=ObservationConfig(map="known")
            ),
            "cost_utility",
        ),
        "messages": (
            dict(planner=wavefront, comm=CommConfig(range=9.0, base_station=True, bandwidth=400.0, delay=0.2)),
            "voronoi",
        ),
        "told": (
            dict(planner=wavefront, comm=base, observation=ObservationConfig(targets=6, radio=True), num_robots=4),
            "cost_utility",
        ),
        "faults": (dict(planner=dwa, faults=FaultsConfig(probability=0.9, duration=0.5)), "voronoi"),
        "radars": (dict(planner=wavefront, radar=RadarConfig(missed=0.3, noise=0.4, evidence=2)), "cost_utility"),
        "false alarms": (
            dict(planner=wavefront, comm=near, radar=wrong),
            "cost_utility",
        ),
        "odometry": (
            dict(planner=wavefront, odometry=OdometryConfig(drift=0.2, turn=0.1, jump=0.5, jump_rate=1.0)),
            "hungarian",
        ),
        "map errors": (dict(planner=wavefront, odometry=astray, radar=wrong, num_robots=4), "cost_utility"),
        "map errors, near": (dict(planner=wavefront, comm=near, odometry=astray), "lookahead"),
        "rollouts": (dict(planner=wavefront), "lookahead"),
        "rollouts, near": (dict(planner=wavefront, comm=near), "lookahead"),
        "arrivals": (dict(planner=wavefront, decide="arrival"), "multi_criteria"),
        "direct": (dict(planner=PlannerConfig(name="direct")), None),
        "volumes": (dict(volumes=True, num_robots=3, radar=RadarConfig(range=2.0)), "cost_utility"),
        "volumes, near": (
            dict(
                volumes=True,
                num_robots=4,
                comm=CommConfig(range=1.5, line_of_sight=True, loss=0.2),
                radar=RadarConfig(range=2.0, fov=2.0, every=2),
                faults=FaultsConfig(probability=0.9, duration=0.5),
            ),
            "hungarian",
        ),
    }


def play(settings: dict, policy: str | None, steps: int = 3) -> str:
    """Hash of what two envs come to on maps of different kinds."""
    from voxel_worlds import maps
    from worlds import act, room

    from maexp.agents.policies import POLICIES
    from maexp.envs import ExplorationEnv

    settings = dict(settings)
    worlds = maps() if settings.pop("volumes", False) else [room(29, 22, "rotated"), room(24, 31)]
    env = ExplorationEnv(worlds, num_envs=2, seed=5, local_steps=6, macro_steps=2, num_threads=1, **settings)
    generator, found = torch.Generator().manual_seed(1), []
    chooser = POLICIES[policy](env) if policy else lambda td: td.update(act(env, generator))
    td = env.reset()
    for _ in range(steps):
        stepped, after = env.step_and_maybe_reset(chooser(td))
        found += [leaf for part in (stepped, after) for _, leaf in sorted_leaves(part)]
        found += [env.simulation.tensors[name].clone() for name in sorted(env.space.STATE)]
        td = after
    return digest(*found)


def sorted_leaves(td) -> list:
    return sorted(td.items(True, True), key=lambda pair: str(pair[0]))


def play_alone() -> str:
    """Hash of the kernels that are functions of tensors."""
    import maexp.kernels as mk

    generator = torch.Generator().manual_seed(2)
    points = torch.rand(200, 2, generator=generator) * 12.0
    grid = torch.rand(3, 17, 23, generator=generator) < 0.7
    visible = mk.visible_points(points[:150], points[150:], points[0], obstacle_radius=0.3)
    merged = mk.merge_maps(grid.flatten(1)[:, None].expand(-1, 3, -1), torch.rand(3, 3, 3, generator=generator) < 0.5)
    distance = mk.geodesic_distance(grid, torch.tensor([[5, 200]] * 3))
    power = mk.received_power(grid[0], points[:60], points[60:120], edge=0.7)
    frontier = mk.frontier_cells(grid, ~grid & (points[:51, 0].view(3, 17, 1) > 6.0))
    return digest(visible, merged, distance, power, frontier, *play_seeable())


def play_seeable() -> list[torch.Tensor]:
    """What can be seen of a map of voxels from some of its places."""
    from voxel_worlds import hall

    from maexp.kernels.volume.rays import grow_trees
    from maexp.kernels.volume.seeable import mark_seeable

    m = hall()
    free, occupied = (words.reshape(-1, m.num_words) for words in m.words())
    places = np.argwhere(m.free)[::500]
    return [torch.from_numpy(words) for words in mark_seeable(m.shape, free, occupied, places, grow_trees(6.0, 1.6))]


def main(cache: str) -> None:
    wp.config.kernel_cache_dir = cache
    patch_warp()
    from maexp.kernels import launches

    found, last = {}, {}
    for name, Order.number in ORDERS.items():
        launches.CPU_LANES = 5 if "lanes" in name else 1
        assert all(threads_met(count) for count in (1, 2, 3, 4, 6, 46, 60, 210)), name
        last[name] = last_thread(46)
        for setup, (settings, policy) in setups().items():
            found.setdefault(setup, {})[name] = play(settings, policy)
        found.setdefault("alone", {})[name] = play_alone()
    print(json.dumps({"hashes": found, "last_thread": last, "kernels": sorted(Order.kernels)}))


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]
    torch.set_num_threads(1)
    main(sys.argv[1])
