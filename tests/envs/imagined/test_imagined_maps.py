"""Imagined worlds: made of what robots know, and of nothing else."""

import numpy as np
import pytest
import torch
from oracle.belief import imagine
from worlds import room

from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv
from maexp.envs.imagined.branches import Branches
from maexp.envs.imagined.maps import Beliefs
from maexp.envs.targets.navigation import Navigation
from maexp.envs.targets.region_action import from_regions
from maexp.kernels.state import STATE

pytestmark = pytest.mark.kernels


def explored(worlds, steps: int = 2, **settings) -> ExplorationEnv:
    """An env whose teams have been under way for some decisions."""
    env = ExplorationEnv(worlds, num_envs=3, num_robots=3, seed=2, local_steps=8, macro_steps=9, **settings)
    env.rollout(steps, POLICIES["cost_utility"](env), break_when_any_done=False)
    return env


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("kinds", [("lattice", "lattice"), ("jittered", "rotated")])
def test_worlds_are_what_is_known_and_a_guess(kinds, limited):
    """Points, walls beside them and what is known, against the definition in plain loops."""
    comm = CommConfig(range=8.0) if limited else None
    env = explored([room(29, 22, kinds[0]), room(21, 31, kinds[1])], comm=comm)
    nav = Navigation(env)
    nav.update()
    beliefs = Beliefs(env, 2, 2, nav)
    generator = torch.Generator().manual_seed(0)
    beliefs.guess.copy_(torch.randint(1, 3, beliefs.guess.shape, generator=generator))
    teams = torch.tensor([2, 0])
    beliefs.look(teams)
    robot = 1
    beliefs.branch(robot, torch.ones(2, 2, dtype=torch.bool))
    for t, team in enumerate(teams.tolist()):
        world = t * nav.rows + (robot if limited else 0)
        _check_world(env, nav, beliefs, team, world, t * 2, robot if limited else 0)


def _check_world(env, nav, beliefs, team: int, world: int, branch: int, row: int) -> None:
    m = int(env.simulation.tensors["map_id"][team])
    width, height = int(nav.width[m]), int(nav.height[m])
    wide, high, margin = (int(getattr(beliefs.sizes, name)[m]) for name in ("width", "height", "margin"))
    known = nav._known[team, row, : width * height].view(height, width).numpy()
    guess = beliefs.guess[world, : wide * high].view(high, wide).numpy()
    cell, corner = float(nav.cell_size[m]), nav.origin[m].tolist()
    wanted = imagine(known, guess, margin, corner, cell, _known_walls(env, nav, team, m, row, known, width))
    maps, grids = beliefs.env.simulation.map_tensors, beliefs.env.bank.grids[0]
    state = beliefs.env.simulation.tensors
    first, count = int(maps["free_begin"][world]), int(beliefs.total[world, 0])
    begin, walls = int(maps["boundary_begin"][world]), int(beliefs.total[world, 1])
    cells = grids.free_cell.numpy()[first : first + count]
    wall_cells = grids.boundary_cell.numpy()[begin : begin + walls]
    free = {divmod(int(c), wide): tuple(p[:2]) for c, p in zip(cells, maps["free"][first:].numpy(), strict=False)}
    points = zip(wall_cells, maps["boundary"][begin:].numpy(), strict=False)
    found = {divmod(int(c), wide): tuple(p[:2]) for c, p in points}
    assert count == len(free) and walls == len(found)
    for what, given in (("free", free), ("walls", found)):
        assert given.keys() == wanted[what].keys()
        gaps = [np.subtract(given[c], wanted[what][c]) for c in given]
        assert np.abs(gaps).max(initial=0.0) < 1e-4, what
    for seen, places in (("free", cells), ("boundary", wall_cells)):
        for prefix in ("seen", "viewers"):
            flags = state[f"{prefix}_{seen}"][branch, 0].numpy()
            assert {divmod(int(c), wide) for c in places[flags[: len(places)] != 0]} == wanted["known"] & (
                free if seen == "free" else found
            ).keys()
            assert not flags[len(places) :].any()
    near = maps["neighbour_begin"].numpy()
    for k in range(count):
        listed = maps["neighbour"][near[first + k] : near[first + k + 1]].numpy()
        assert {divmod(int(wall_cells[j]), wide) for j in listed} == wanted["beside"][divmod(int(cells[k]), wide)]


def _known_walls(env, nav, team: int, m: int, row: int, known, width: int) -> dict:
    """Where known walls stand: the first known point of their cell, or of the cell whose state theirs is."""
    state = env.simulation.tensors
    arrays, grids = env.simulation.map_tensors, nav.grids
    begin, end = arrays["boundary_begin"][m : m + 2].tolist()
    name = "known_boundary" if nav.rows > 1 else "viewers_boundary"
    flags = state[name][team, 0, : end - begin]
    flags = (flags >> row) & 1 if nav.rows > 1 else flags
    cells = grids.boundary_cell.numpy()[begin:end]
    first = {}
    for j in torch.nonzero(flags).flatten().tolist():
        first.setdefault(int(cells[j]), tuple(arrays["boundary"][begin + j, :2].tolist()))
    offset = int(grids.cell_begin.numpy()[m])
    stand_in = grids.stand_in.numpy()[offset : offset + known.size]
    return {divmod(c, width): first[int(stand_in[c])] for c in range(known.size) if int(stand_in[c]) in first}


def test_a_branch_of_the_same_choice_goes_as_the_original():
    """In the true world, bit for bit; and no branch touches the env."""
    env = explored([room(29, 22), room(21, 31, "rotated")])
    branches = Branches(env, 3, 2)
    policy, td = POLICIES["nearest_frontier"](env), env.observe()
    before = {name: tensor.clone() for name, tensor in env.simulation.tensors.items() if name in STATE}
    td = policy(td)
    branches.look(torch.arange(3))
    branches.branch(0, torch.ones(3, 2, dtype=torch.bool))
    ours, names = branches.env.simulation.tensors, ("pose", "covered", "covered_sum", "seen_free", "viewers_boundary")
    action = td["agents", "action"]
    ours["wanted"].copy_(from_regions(env.simulation, action["region"], action["offset"]).repeat_interleave(2, 0))
    branches.env.simulation.set_goals()
    branches.env.simulation.step(0, env.local_steps)
    assert all(torch.equal(env.simulation.tensors[name], tensor) for name, tensor in before.items())
    env.step(td)
    for name in names:
        assert torch.equal(ours[name], env.simulation.tensors[name].repeat_interleave(2, 0)), name
    assert not torch.equal(ours["covered"][::2], before["covered"])


def test_robots_that_are_not_heard_are_not_there():
    env = explored([room(29, 22)], steps=3, comm=CommConfig(range=4.0))
    nav = Navigation(env)
    nav.update()
    beliefs = Beliefs(env, 3, 1, nav)
    beliefs.look(torch.arange(3))
    heard = env.simulation.tensors["comm"]
    assert not heard.all()
    for robot in range(3):
        beliefs.branch(robot, torch.ones(3, 1, dtype=torch.bool))
        away = beliefs.env.simulation.tensors["center"][..., 0] > 1e5
        assert torch.equal(away, ~heard[:, robot])
